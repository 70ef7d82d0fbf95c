"""What fills the space between pillars, and light lost to orders of the substrate."""

import cmath
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from metalens import library, modal, rcwa
from metalens.cell import Cell, Film, Index, Layer, index, substrate_orders
from metalens.commands.library import CellFile
from metalens.core import config
from metalens.core.errors import CellError
from metalens.library.record import Sweep
from tests.command_line import call

COVER = Index(1.66)
# n = 2.67 on itself at 527 nm: pitch 224 nm > 527 / 2.67 = 197 nm, < 527 nm in air
SIC = Cell(0.224, 0.6, pillar=Index(2.67), substrate=Index(2.67))
WAVE = 0.527


def slab_amplitude(n_in, n_slab, n_out, height_um, wavelength_um):
    """Power-normalised t of a slab at normal incidence (Born and Wolf, 1.6 (58))."""
    phase = 2 * math.pi / wavelength_um * n_slab * height_um
    t1, t2 = 2 * n_in / (n_in + n_slab), 2 * n_slab / (n_slab + n_out)
    r1 = (n_in - n_slab) / (n_in + n_slab)
    r2 = (n_slab - n_out) / (n_slab + n_out)
    t = t1 * t2 * cmath.exp(1j * phase) / (1 + r1 * r2 * cmath.exp(2j * phase))
    return math.sqrt(n_out / n_in) * t


@pytest.mark.parametrize("solve", [rcwa.solve, modal.solve])
def test_a_pillar_of_the_covers_index_is_a_slab_of_the_cover(solve):
    """Nothing is left to scatter where the cover fills the space around the pillar."""
    cell = Cell(0.42, 0.61, pillar=COVER, substrate=Index(1.45), cover=COVER)
    got = solve(cell, 0.23, 0.85, tolerance=1e-4)
    want = slab_amplitude(1.45, 1.66, 1.66, 0.61, 0.85)
    assert abs(got.t - want) < got.t_error + 1e-10


def test_the_fill_follows_the_cover_until_it_is_stated():
    text = "pitch_um = 0.4\ncover = { n = 1.66 }\n"
    cell = config.loads(text, Cell, where="cell.toml")
    stated = config.loads(text + 'between = "air"\n', Cell, where="cell.toml")
    assert (cell.fill, stated.fill) == (COVER, "air")
    assert replace(cell, cover=Index(1.5)).fill == Index(1.5)
    assert replace(stated, cover=Index(1.5)).fill == "air"
    assert config.loads(config.dumps(cell), Cell, where="again") == cell
    assert Cell(0.4).fill == "air"


def test_layers_and_shapes_take_the_fill_too():
    """A square pillar in two sections of the cover's index is a slab as well."""
    layers = (Layer(0.2), Layer(0.3, grow_um=0.03))
    cell = Cell(0.4, 0.5, pillar=COVER, cover=COVER, layers=layers)
    got = rcwa.jones(cell, 0.2, 0.94, harmonics=3)
    glass = index("SiO2", 0.94).real
    want = slab_amplitude(glass, 1.66, 1.66, 0.5, 0.94)
    assert got.t == pytest.approx(want * np.eye(2), abs=1e-9)


def test_derivatives_know_the_fill():
    cell = Cell(0.42, 0.6, pillar=Index(2.1), cover=Index(1.4))
    stated = replace(cell, between=Index(1.4))
    got, same = (rcwa.jones(one, 0.2, 0.9, harmonics=4).t for one in (cell, stated))
    assert got == pytest.approx(same, abs=1e-13)


def test_orders_of_the_substrate_carry_what_a_textbook_rcwa_finds():
    """Laurent's rule errs as 1/M: the line through M = 7 and 9 meets the limit within
    the 5e-3 that it moves from the parabola through 5, 7, 9."""
    found = modal.solve(SIC, 0.16, WAVE, tolerance=1e-3)
    coupled = rcwa.solve(SIC, 0.16, WAVE, tolerance=5e-3)
    plain = [rcwa.solve_textbook_rcwa(SIC, 0.16, WAVE, harmonics=m) for m in (7, 9)]
    lost = [one.reflected[(one.m != 0) | (one.n != 0), 0].sum() for one in plain]
    limit = lost[1] + (lost[1] - lost[0]) * (1 / 9) / (1 / 7 - 1 / 9)
    assert len(substrate_orders(SIC, WAVE)) == 4
    assert limit == pytest.approx(found.other_orders, abs=5e-3)
    assert coupled.other_orders == pytest.approx(found.other_orders, abs=4e-3)
    assert found.energy == pytest.approx(1, abs=1e-9)
    assert found.other_orders > 0.1


def test_textbook_rcwa_is_a_film_stack_where_nothing_varies_along_the_layers():
    film = Film(Index(1.9), 0.07)
    cell = Cell(0.3, 0.4, pillar=COVER, cover=COVER, under=(film,), substrate=COVER)
    got = rcwa.solve_textbook_rcwa(cell, 0.2, 0.8, harmonics=1)
    want = slab_amplitude(1.66, 1.9, 1.66, 0.07, 0.8)
    want *= cmath.exp(2j * math.pi * 1.66 * 0.4 / 0.8)
    assert got.t == pytest.approx(want * np.eye(2), abs=1e-10)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_the_engine_meets_the_textbook_at_oblique_incidence(kind):
    """Low contrast: Laurent's error at M = 4 is below 0.02 |t| of first order in 1/M."""
    from metalens.cell import Lattice

    cell = Cell(
        0.4, 0.5, Index(1.7), Index(1.45), Index(1.2), lattice=Lattice(kind),
        over=(Film(Index(1.6), 0.05),), layers=(Layer(0.2), Layer(0.3, 0.02)),
    )  # fmt: skip
    light = {"angle_rad": 0.3, "azimuth_rad": 0.7}
    got = rcwa.jones(cell, 0.2, 0.95, tolerance=2e-3, **light)
    plain = rcwa.solve_textbook_rcwa(cell, 0.2, 0.95, harmonics=4, **light)
    assert abs(got.t - plain.t).max() < 0.02
    assert abs(got.r - plain.r).max() < 0.01
    assert (plain.transmitted + plain.reflected).sum(0) == pytest.approx([1, 1])
    assert np.abs(got.t).max() > 0.9


@pytest.mark.slow
def test_silicon_on_silicon_of_the_infrared_is_swept_designed_and_imaged(
    tmp_path, capsys
):
    """Pitch 2.2 um at 5 um: the silicon substrate (n = 3.4) carries orders, air none.

    Nothing absorbs: the loss that is printed is 1 - |t|² - |r|² of the entries."""
    (tmp_path / "cell.toml").write_text(
        "[cell]\npitch_um = 2.2\nheight_um = 3.6\npillar = { n = 3.4 }\n"
        "substrate = { n = 3.4 }\n[sweep]\nwavelengths_um = [5.0]\nsamples = 40\n"
        "tolerance = 2e-2\ndiameters_um = [0.5, 1.5]\n"
    )
    (tmp_path / "lens.toml").write_text(
        'library = "library.h5"\naperture_mm = 0.2\nwavelength_nm = 5000.0\n'
        "sensor_distance_mm = 1.0\nsource_distance_mm = 20.0\n"
        "[limits]\nmin_diameter_nm = 500.0\nmin_gap_nm = 700.0\n"
    )
    path, lens = str(tmp_path / "library.h5"), str(tmp_path / "lens.h5")
    run = ["library", str(tmp_path / "cell.toml"), "-o", path, "--json"]
    assert call(*run, "--accept-partial-turn") in (0, 1)
    values = json.loads(capsys.readouterr().out)
    made = library.load(path)
    lost = 1 - np.abs(made.t) ** 2 - np.abs(made.r) ** 2
    assert values["lost"]["mean"] == pytest.approx(lost.mean(), abs=1e-9)
    assert lost.max() > 0.05
    with pytest.raises(CellError, match=r"\(-1, 0\).* in the cover"):
        library.check_sweep(replace(made.cell, cover=Index(3.4)), made.sweep)
    run = ["design", str(tmp_path / "lens.toml"), "-o", lens]
    assert call(*run, "--accept-partial-turn --skip-focus-check") in (0, 1)
    shown = capsys.readouterr().out
    assert "(-1, 0)" in shown
    assert "propagate in the substrate" in shown
    fast = "--sources-mm 20 --angles-deg 0 --samples 32 --tolerance 0.05"
    assert call("psf", lens, f"-o {tmp_path}/psf.h5 {fast}") in (0, 1)
    assert "propagate in the substrate" in capsys.readouterr().out


def test_cells_that_are_refused_and_swept_differ_by_the_cover_alone():
    wanted = CellFile(SIC, Sweep(wavelengths_um=(WAVE,), diameters_um=(0.08, 0.17)))
    library.check_sweep(wanted.cell, wanted.sweep)
    with pytest.raises(CellError, match="in the cover"):
        library.check_sweep(replace(SIC, cover=Index(2.67)), wanted.sweep)
