"""A lens for other programs: what they read is what the pillars do."""

import json
import math

import numpy as np
import pytest
from scipy.io import loadmat

from metalens import lens
from metalens.cell import Cell
from metalens.core.errors import LensError
from metalens.design import PhaseMap, phase_map
from metalens.lens import DiameterMap, Lens, export
from tests.command_line import call
from tests.proxies import proxy_of

# phase 3.5 + 3.5 (d - 0.2) / 0.1: a little above a turn over the domain
PROXY = proxy_of([3.5, 3.5], [0.95, 0.02], (0.1, 0.3), 0.85)
X = (np.arange(101) - 50) * 0.4


def made(phase):
    """Diameters that make a phase, wrapped into the proxy's turn, on a disc of 19.3 um."""
    wrapped = np.mod(phase - 0.2, 2 * math.pi) + 0.2
    diameter = 0.2 + 0.1 * (wrapped - 3.5) / 3.5
    diameter[X**2 + X[:, None] ** 2 > 19.3**2] = 0
    return Lens(
        DiameterMap(diameter, 0.4),
        Cell(0.4),
        PROXY,
        0.85,
        500.0,
        float("inf"),
        "hyperbolic",
    )


def smooth(x, y):
    """No symmetry in x or y; up to 0.9 rad from pillar to pillar."""
    return -0.05 * x**2 - 0.043 * y**2 + 0.3 * x - 0.11 * y + 4e-4 * x**2 * y


def test_unwrapping_finds_the_phase_up_to_a_constant():
    want = smooth(X, X[:, None])
    found = export.unwrap_phase(made(want))
    held = np.isfinite(found)
    assert held.sum() == (X**2 + X[:, None] ** 2 <= 19.3**2).sum()
    # rounding of 40 rad through diameters
    assert abs(found - (want - want[50, 50]))[held].max() < 1e-11


def test_a_grid_phase_is_read_back_as_the_same_function(tmp_path):
    """The reader of phase maps is held to files of OpticStudio's description elsewhere;
    +y up there, down here.
    """
    error = export.export_lens(
        tmp_path / "a.dat", made(smooth(X, X[:, None])), samples=161
    )
    head = (tmp_path / "a.dat").read_text().splitlines()[0].split()
    assert [int(head[0]), int(head[1]), int(head[4])] == [161, 161, 0]
    # mm; the outermost pillar, at 19.2 um
    assert float(head[2]) == pytest.approx(2 * 19.2e-3 / 160, rel=0.01)
    first = [line.split() for line in (tmp_path / "a.dat").read_text().splitlines()[1:]]
    assert first[0] == ["0", "0", "0", "0", "1"]  # the corner lies outside the disc
    middle = np.array([float(words[0]) for words in first]).reshape(161, 161)
    step = float(head[2]) * 1e3
    # rows run from the largest y of the file, which is our least
    below, right = (48 * step, -31 * step)
    want = smooth(right, below) - smooth(0, 0)
    # linear between pillars: curvature 0.1 rad/um² over 0.4 um, h²/8 of it
    assert middle[80 + 48, 80 - 31] == pytest.approx(
        want, abs=0.1 * 0.4**2 / 8 + 0.086 * 0.4**2 / 8
    )
    assert error < 2 * 0.19 * 0.4**2 / 8


def test_a_vortex_has_no_smooth_phase():
    x, y = np.meshgrid(X, X)
    with pytest.raises(LensError, match="have no smooth phase; write"):
        export.unwrap_phase(made(np.arctan2(y - 0.13, x + 0.07)))


@pytest.mark.parametrize("ending", ["npz", "mat"])
def test_arrays_hold_every_pillar_with_its_place(tmp_path, ending):
    source = made(smooth(X, X[:, None]))
    lens.save(tmp_path / "lens.h5", source)
    target = tmp_path / f"out.{ending}"
    assert call(f"export {tmp_path}/lens.h5 -o {target} --quiet") == 0
    read = np.load(target) if ending == "npz" else loadmat(target)
    row, column = 31, 67
    assert np.ravel(read["x_um"])[column] == pytest.approx(17 * 0.4)
    assert np.ravel(read["y_um"])[row] == pytest.approx(-19 * 0.4)
    assert read["diameter_um"][row, column] == source.diameters.diameter_um[row, column]
    want = smooth(17 * 0.4, -19 * 0.4)
    assert math.remainder(
        read["phase_rad"][row, column] - want, 2 * math.pi
    ) == pytest.approx(0, abs=1e-9)
    assert read["transmission"][0, 0] == 0


def test_bad_words_are_refused_by_name(tmp_path, capsys):
    lens.save(tmp_path / "lens.h5", made(smooth(X, X[:, None])))
    assert call(f"export {tmp_path}/lens.h5 -o {tmp_path}/lens.xyz") == 2
    assert (
        "cannot write this format; name it .npz, .mat, .dat" in capsys.readouterr().err
    )
    assert call(f"export {tmp_path}/lens.h5 -o {tmp_path}/a.dat --samples 3") == 2
    assert "3 samples across the aperture: need 5 or more" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["lens.h5"]


def test_the_written_map_reads_in_as_the_same_phase(tmp_path):
    """Out as a grid phase and in again as an own map, at places between its points."""
    export.export_lens(tmp_path / "a.dat", made(smooth(X, X[:, None])), samples=161)
    read = phase_map.read_phase_map(PhaseMap(tmp_path / "a.dat"))
    x, y = np.array([-7.31, 2.9, 9.02]), np.array([-11.7, 0.33, 8.6])
    found = phase_map.interpolate_phase(read, x, y)
    want = smooth(x, y[:, None]) - smooth(0, 0)
    # linear between pillars, then between points of 0.24 um: h²/8 of the curvatures
    # (0.1 + 0.086) rad/um² each time
    assert (
        np.abs(np.angle(np.exp(1j * (found - want)))).max()
        < 0.19 * (0.4**2 + 0.24**2) / 8
    )


def test_every_pillar_up_to_the_rim_can_be_read_from_the_written_map(tmp_path):
    source = made(smooth(X, X[:, None]))
    export.export_lens(tmp_path / "a.dat", source, samples=161)
    read = phase_map.read_phase_map(PhaseMap(tmp_path / "a.dat"))
    d, held = source.diameters, slice(2, -2)  # 19.2 um to each side
    at = X[held]
    found = phase_map.interpolate_phase(read, at, at, radius_um=d.radius_um)
    error = np.abs(
        np.angle(np.exp(1j * (found - (smooth(at, at[:, None]) - smooth(0, 0)))))
    )
    # between pillars and between points as above, with the curvatures of the rim, 0.116
    # and 0.086 rad/um²; the phasor's
    # argument between points D = 0.53 rad apart is wrong by D³ sqrt(3) / 216 along
    # either axis; beyond the rim a
    # parabola takes the place of a cubic of derivative 2.4e-3 rad/um³, 1e-4 rad one
    # site of 0.4 um out
    assert (
        error[np.asarray(d.diameter_um)[held, held] > 0].max()
        < 0.202 * (0.4**2 + 0.24**2) / 8 + 2 * 0.53**3 * 3**0.5 / 216 + 1e-4
    )


def test_rays_through_the_binary_2_surface_meet_in_the_focus(tmp_path):
    """sin of the ray behind it is phi'(r) / k: a hyperbolic phase of focus 71 um sends
    all collimated rays there, whatever its radius.
    """
    k, focus_um = 2 * math.pi / 0.85, 71.0
    phase = -k * (np.sqrt(X**2 + X[:, None] ** 2 + focus_um**2) - focus_um)
    residual = export.export_lens(tmp_path / "a.json", made(phase))
    surface = json.loads((tmp_path / "a.json").read_text())
    assert residual == surface["residual_rad"] < 1e-6
    radius_um = 1e3 * surface["norm_radius_mm"]
    r = np.array([0.5, 6.3, 11.9, 18.7])
    order = 2 * np.arange(1, 9)
    terms = surface["coefficients_rad"] * order / radius_um
    sine = -(terms * (r[:, None] / radius_um) ** (order - 1)).sum(1) / k
    assert r / np.tan(np.arcsin(sine)) == pytest.approx(focus_um, rel=1e-5)
    with pytest.raises(LensError, match="need a quarter wave"):
        export.export_lens(tmp_path / "b.json", made(smooth(X, X[:, None])))
