"""The example cells: they read, propagate no order, fit their lattice, and do what
their heads say.
"""

import dataclasses
import json
import math
from pathlib import Path

import pytest

from metalens import library, rcwa
from metalens.commands.library import CellFile
from metalens.core import config
from metalens.library import axes
from tests.command_line import call

FOLDER = Path(__file__).parents[3] / "examples" / "cells"
FILES = sorted(FOLDER.glob("*.toml"))
# of 40, more than half of the error would be the proxy's, and be refused
COARSE = {"samples": 80, "tolerance": 1e-2}


@pytest.mark.parametrize("path", FILES, ids=lambda p: p.stem)
def test_example_cells_read_and_are_subwavelength(path):
    wanted = config.load(path, CellFile)
    (axes.check_axes_sweep if wanted.sweep.lengths_um else library.check_sweep)(
        wanted.cell, wanted.sweep
    )
    low, high = wanted.sweep.span_um(wanted.cell)
    assert wanted.cell.gap_um(high) > 0.04
    got = rcwa.jones(
        wanted.cell, (low + high) / 2, wanted.sweep.wavelengths_um[0], harmonics=5
    )
    assert abs(got.energy - 1).max() < 1e-2  # power; the TiO2 film absorbs little


def coarse(text, **sweep):
    """The sweep of a cell file with other settings; a key that it holds is replaced."""
    kept = [
        line for line in text.splitlines() if line.split("=")[0].strip() not in sweep
    ]
    return "\n".join(kept).replace(
        "[sweep]", "\n".join(["[sweep]", *(f"{k} = {v}" for k, v in sweep.items())])
    )


def chained(folder, name, library, capsys, **sweep):
    """The commands in the head of a lens file, with some keys of the sweep changed;
    what ``metalens design`` says.
    """
    text = (FOLDER / f"{name}.toml").read_text()
    (folder / "cell.toml").write_text(coarse(text, **sweep))
    lens = (FOLDER.parent / "lenses" / f"{name}.toml").read_text()
    (folder / "lens.toml").write_text(lens)
    words = ["--accept-partial-turn", "--quiet"]
    assert call(f"library {folder}/cell.toml -o {folder}/{library}", *words) == 0
    capsys.readouterr()
    assert (
        call(f"design {folder}/lens.toml -o {folder}/lens.h5", *words[:1], "--json")
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    fine = (
        ["--process", str(FOLDER.parent / "lenses" / "fine_process.toml")]
        if "fine_process" in lens
        else []
    )
    assert call(f"layout {folder}/lens.h5 -o {folder}/mask --gds --quiet", *fine) == 0
    assert (folder / "mask" / "mask.gds").stat().st_size > 10_000
    return found


@pytest.mark.slow
def test_silicon_on_sapphire_from_toml_to_mask(tmp_path, capsys):
    found = chained(tmp_path, "si_on_sapphire_1550", "si.h5", capsys)
    assert found["numerical_aperture"] == pytest.approx(
        math.sin(math.atan(15 / 50)), rel=0.01
    )
    assert 0.8 < found["wavefront_efficiency"] <= found["transmission"] <= 1
    assert found["focus_passed"]


@pytest.mark.slow
def test_titania_lens_from_toml_to_mask(tmp_path, capsys):
    found = chained(tmp_path, "tio2_532", "tio2.h5", capsys, **COARSE)
    assert found["numerical_aperture"] == pytest.approx(0.8, abs=0.01)
    assert 0.7 < found["wavefront_efficiency"] <= found["transmission"] <= 1
    assert found["turns"] < 1


@pytest.mark.slow
def test_rectangles_with_geometric_phase_from_toml_to_mask(tmp_path, capsys):
    found = chained(tmp_path, "a_si_rectangle_940", "rectangle.h5", capsys)
    assert found["numerical_aperture"] == pytest.approx(
        math.sin(math.atan(30 / 100)), rel=0.01
    )
    assert found["focus_passed"]
    light = found["circular"]
    assert light["hand"] == "right"
    assert light["converted"] > 0.95
    # the rest is reflected
    assert light["converted"] + light["unconverted"] <= 1 + light["converted_error"]
    shown = call(
        f"psf {tmp_path}/lens.h5 --config {FOLDER.parent}/lenses/psf.toml --quiet -o"
        f" {tmp_path}/psf.h5"
    )
    assert shown == 0


@pytest.mark.slow
def test_a_hexagonal_lens_from_toml_to_mask(tmp_path, capsys):
    found = chained(tmp_path, "hexagonal_850", "hexagonal.h5", capsys)
    assert found["numerical_aperture"] == pytest.approx(
        math.sin(math.atan(30 / 100)), rel=0.01
    )
    assert found["focus_passed"]
    assert found["steepest"] < found["sampled_aperture"]
    assert 0.8 < found["wavefront_efficiency"] <= found["transmission"] <= 1


@pytest.mark.slow
def test_two_phases_by_width_and_length_from_toml_to_mask(tmp_path, capsys):
    found = chained(tmp_path, "a_si_two_sizes_940", "two_sizes.h5", capsys)
    for light, distance in (("along_x", 80), ("along_y", 110)):
        own = found[light]
        assert own["numerical_aperture"] == pytest.approx(
            math.sin(math.atan(20 / distance)), rel=0.01
        )
        assert own["focus_passed"]
        assert 0.6 < own["wavefront_efficiency"] <= own["transmission"] <= 1
        assert own["leaked"] < 1e-20  # mirrors
    view = "depths_mm = [1e3, 1e3, 1.0]\nangles_deg = [0.0]\nsamples = 40\nwindow_um = 16.0\ntolerance = 1e-3\n"
    words = f"psf {tmp_path}/lens.h5 --config {tmp_path}/psf.toml --quiet"
    (tmp_path / "psf.toml").write_text(view)
    assert call(f"{words} -o {tmp_path}/both.h5") == 2
    assert "give light" in capsys.readouterr().err
    (tmp_path / "psf.toml").write_text(view + 'light = "y"\n')
    assert call(f"{words} -o {tmp_path}/y.h5") == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "library"),
    [
        ("tio2_cross_532", "cross.h5"),
        ("si_ring_1550", "ring.h5"),
        ("si_hook_1550", "hook.h5"),
        ("tio2_square_holes_532", "holes.h5"),
    ],
)
def test_lenses_of_other_shapes_from_toml_to_mask(tmp_path, capsys, name, library):
    found = chained(tmp_path, name, library, capsys)
    assert found["numerical_aperture"] == pytest.approx(
        math.sin(math.atan(15 / 60)), rel=0.01
    )
    assert found["turns"] > 1
    assert found["focus_passed"]
    assert 0.8 < found["wavefront_efficiency"] <= found["transmission"] <= 1


@pytest.mark.parametrize(("turned", "least", "most"), [(0, 0.5, 1), (1, 0, 1e-20)])
def test_a_hook_along_the_lattice_sends_light_into_the_other_polarisation_and_a_turned_one_none(
    turned, least, most
):
    wanted = config.load(FOLDER / "si_hook_1550.toml", CellFile)
    shape = dataclasses.replace(
        wanted.cell.shape, angle_rad=turned * wanted.cell.shape.angle_rad
    )
    got = rcwa.jones(
        dataclasses.replace(wanted.cell, shape=shape), 0.32, 1.55, harmonics=4
    )
    assert least <= abs(got.t[1, 0]) ** 2 <= most
