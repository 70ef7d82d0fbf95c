"""``metalens design`` and ``psf`` of a lens for circular light, from a library with a
known pillar.
"""

import math

import numpy as np
import pytest

from metalens import lens as lenses
from metalens import library
from metalens.cell import Cell, Index
from metalens.cell.shapes import Rectangle
from metalens.core.errors import PropagationError, SceneError
from metalens.library import GeometricPhase
from tests.command_line import call, printed
from tests.proxies import proxy_of
from tests.referees.turned_pillar import isolated

T_X, T_Y = 0.97 * np.exp(0.7j), 0.95 * np.exp(-2.2j)
DESIGN = """library = "known.h5"
aperture_mm = 0.021
wavelength_nm = 940.0
sensor_distance_mm = 0.04
source_distance_mm = inf
hand = "HAND"
limits = { min_diameter_nm = 100, min_gap_nm = 90 }
"""
PSF = """depths_mm = [1e6, 1e6, 1.0]
angles_deg = [0.0]
window_um = 6.1
samples = 61
tolerance = 1e-3
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    where = tmp_path_factory.mktemp("circular")
    c, sizes = (T_X - T_Y) / 2, np.linspace(0.2, 0.26, 20)
    t = np.stack([np.full(20, T_X), np.full(20, T_Y)])[:, None, None]
    proxy = proxy_of([np.angle(c), 0.0], [abs(c), 0.0], (0.2, 0.26), 0.94)
    angles = np.radians([0, 15, 30, 45, -30, -15])
    solved = isolated(T_X, T_Y, angles)
    turned = GeometricPhase(
        0.23, 0.94, angles, solved, np.full(6, 0.01), 1.01 * solved[:, None]
    )
    cell = Cell(0.41, 0.5, Index(3.6), shape=Rectangle(0.5))
    sweep = library.Sweep((0.94,), light="circular")
    small = np.full(t.shape, 1e-3)
    about = (t, t * 0, small, small, np.empty((0, 5)), "rcwa", 1, proxy)
    made = library.PillarLibrary(
        cell,
        sweep,
        ("x", "y"),
        np.zeros(1),
        np.array([0.94]),
        sizes,
        *about,
        turned=turned,
    )
    library.save(where / "known.h5", made)
    (where / "psf.toml").write_text(PSF)
    for hand in ("right", "left"):
        (where / f"{hand}.toml").write_text(DESIGN.replace("HAND", hand))
    assert call(f"design {where}/right.toml -o {where}/right.h5 --quiet") == 0
    return where


def test_a_design_without_a_wavelength_takes_the_one_of_its_library(folder, capsys):
    (folder / "silent.toml").write_text(
        DESIGN.replace("HAND", "right").replace("wavelength_nm = 940.0\n", "")
    )
    assert (
        call(f"design {folder}/silent.toml -o {folder}/silent.h5 --skip-focus-check")
        == 0
    )
    assert "0.021 mm, 940 nm" in capsys.readouterr().out
    assert lenses.load(folder / "silent.h5").wavelength_um == pytest.approx(
        0.94, rel=1e-12
    )  # nm to um and back


@pytest.mark.parametrize("hand", ["right", "left"])
def test_design_and_psf_of_either_hand(folder, capsys, hand):
    target = folder / f"{hand}_own.h5"
    assert (
        call(f"design {folder}/{hand}.toml -o {target} --json --skip-focus-check") == 0
    )
    found = printed(capsys)
    assert found["circular"]["hand"] == hand
    assert found["circular"]["converted"] == pytest.approx(abs(T_X - T_Y) ** 2 / 4)
    assert found["circular"]["isolated_error"] == pytest.approx(0, abs=1e-9)
    assert lenses.load(target).hand == hand
    out = folder / f"psf_{hand}.h5"
    assert call(f"psf {target} --config {folder}/psf.toml -o {out} --json") == 0
    assert printed(capsys)["converged"]


def test_the_image_is_that_of_the_converted_light(folder):
    """Energy: |t_x - t_y|² / 4 of what falls on the aperture, 2 % of it beyond the
    window (Airy rings).
    """
    from metalens import psf

    lens = lenses.load(folder / "right.h5")
    stack = psf.from_lens(
        lens, psf.View((math.inf,), window_um=24.0, samples=121), tolerance=1e-3
    )
    given = (
        np.count_nonzero(lens.diameters.diameter_um) * 0.41**2 * abs(T_X - T_Y) ** 2 / 4
    )
    assert 0.94 < float(stack.energy_um2[0, 0]) / given < 1.0


def test_vectors_and_the_image_of_the_field_are_refused_by_name(folder):
    from metalens import psf
    from metalens.image.waves import PillarWave

    lens = lenses.load(folder / "right.h5")
    with pytest.raises(PropagationError, match="circular light"):
        psf.from_lens(lens, psf.View((math.inf,)), polarisation="vector")
    with pytest.raises(SceneError, match="turned one by one"):
        PillarWave(lens)


def test_what_knows_only_fixed_pillars_refuses_the_lens(folder, capsys):
    assert call(f"budget {folder}/right.h5 -o {folder}/b.h5") == 2
    assert "turned one by one" in capsys.readouterr().err
