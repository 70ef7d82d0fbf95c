"""A lens for other programs, number by number: grids of a bowl, rims by parabolas,
lines of the file.
"""

import io
import math
import zipfile

import numpy as np
import pytest
from scipy.io import loadmat

from metalens.cell import Cell, Lattice
from metalens.ground.errors import LensError
from metalens.lens import DiameterMap, Lens, export
from metalens.lens.export import GridPhase
from metalens.pillars import Proxy

# phase 3.5 + 3.5 (d - 0.2) / 0.1: a little above a turn over the diameters
PROXY = Proxy(
    np.array([[3.5, 3.5]]), np.array([[0.95, 0.02]]), (0.1, 0.3), (0.85, 0.85), 0.0, 0.0
)
PITCH, NY, NX = 0.5, 41, 31
X, Y = (np.arange(NX) - 15) * PITCH, (np.arange(NY) - 20) * PITCH


def lens(phase, there=None, lattice=None):
    wrapped = np.mod(phase - 0.2, 2 * math.pi) + 0.2
    d = np.where(True if there is None else there, 0.2 + 0.1 * (wrapped - 3.5) / 3.5, 0)
    other = {} if lattice is None else {"lattice": lattice}
    return Lens(
        DiameterMap(d, PITCH, **other),
        Cell(PITCH, **other),
        PROXY,
        0.85,
        500.0,
        9e3,
        "map",
    )


def bowl(x, y):
    """Not alike in x and y, and neither even nor odd; less than half a turn from pillar
    to pillar.
    """
    return -0.11 * x**2 - 0.04 * y**2 + 0.5 * x - 0.3 * y + 0.02 * x * y


DISC = X**2 + (Y[:, None] * 0.7) ** 2 <= 7.3**2


def test_a_phase_is_followed_from_the_middle_to_every_side():
    found = export.unwrapped(lens(bowl(X, Y[:, None]), DISC))
    assert np.array_equal(np.isfinite(found), DISC)
    assert found[DISC] == pytest.approx(
        (bowl(X, Y[:, None]) - bowl(0, 0))[DISC], abs=1e-11
    )  # of 20 rad by diameters
    low = Y[:, None] > 1.2  # the middle is empty: 0 stands where the column begins
    found = export.unwrapped(lens(bowl(X, Y[:, None]), low & (np.abs(X) < 9)))
    assert found[23, 15] == 0
    assert found[30, 4] == pytest.approx(bowl(X[4], Y[30]) - bowl(0, Y[23]), abs=1e-11)
    high = Y[:, None] < -1.2
    assert (
        export.unwrapped(lens(bowl(X, Y[:, None]), high & (np.abs(X) < 9)))[17, 15] == 0
    )


def test_gaps_and_steps_have_no_smooth_phase():
    gap = DISC.copy()
    gap[12, 15] = False
    with pytest.raises(LensError, match="middle column of the lens has gaps"):
        export.unwrapped(lens(bowl(X, Y[:, None]), gap))
    aside = DISC.copy()
    aside[:8, 15] = False  # rows that the middle column does not reach
    with pytest.raises(LensError, match="middle column of the lens has gaps"):
        export.unwrapped(lens(bowl(X, Y[:, None]), aside))
    with pytest.raises(LensError, match="middle column of the lens has gaps"):
        export.unwrapped(lens(bowl(X, Y[:, None]), np.broadcast_to(X > 1, (NY, NX))))
    hole = DISC.copy()
    hole[20, 22] = False
    with pytest.raises(LensError, match="differ by"):
        export.unwrapped(lens(bowl(X, Y[:, None]), hole))  # the row goes on behind it
    vortex = np.arctan2(Y[:, None] - 0.13, X + 0.07)
    with pytest.raises(LensError, match="have no smooth phase"):
        export.unwrapped(lens(vortex, DISC))


def test_a_grid_holds_the_bowl_between_the_pillars_and_a_few_points_beyond():
    one = lens(bowl(X, Y[:, None]), DISC)
    found = export.grid_phase(one, 61)
    radius = one.diameters.radius_um
    assert found.step_um == pytest.approx(2 * radius / 60)
    at = (np.arange(61) - 30) * found.step_um
    want = bowl(at, at[:, None]) - bowl(0, 0)
    # straight between pillars, along either axis: up to h²/8 of the curvatures 0.22 and
    # 0.08, and 0.02 of the twist
    most = PITCH**2 / 8 * (0.22 + 0.08 + 0.02)
    held = np.isfinite(found.phase_rad)
    assert (
        np.abs(found.phase_rad - want)[held].max() < 1.5 * most
    )  # beyond the rim the parabola goes on as exactly
    assert held.sum() > (at**2 + (at[:, None] * 0.7) ** 2 <= 7.3**2).sum()
    outside = np.hypot(at, 0.7 * at[:, None]) > 7.3 + 6 * found.step_um + 2 * PITCH
    assert np.isnan(found.phase_rad[outside]).all()
    assert 0.2 * most < found.error_rad < 2 * most
    rows = np.nonzero(held)[0]
    assert rows.min() == 60 - rows.max()
    for wrong, told in ((4, "need 5 or more"), (1, "need 5 or more")):
        with pytest.raises(LensError, match=told):
            export.grid_phase(one, wrong)


@pytest.mark.parametrize(("ratio", "sites"), [(0.26, 2), (0.42, 2)])
def test_a_grid_goes_on_by_four_of_its_points_and_a_site(ratio, sites):
    """4 · 0.26 + 1 and 4 · 0.42 + 1 sites: two whole ones, 6.0 um from the middle where
    pillars end at 5.0; three
    points would be one site at the first, five three at the second."""
    one = lens(bowl(X, Y[:, None]), X**2 + (Y[:, None] * 0.7) ** 2 <= 5.3**2)
    samples = 1 + 2 * round(one.diameters.radius_um / (ratio * PITCH))
    found = export.grid_phase(one, samples)
    assert found.step_um == pytest.approx(ratio * PITCH, rel=0.02)
    middle = (samples - 1) // 2
    last = np.flatnonzero(np.isfinite(found.phase_rad[middle])).max() - middle
    end = 5.0 + sites * PITCH
    assert end - found.step_um - 1e-9 < last * found.step_um <= end + 1e-9


def test_other_lattices_and_slits_have_no_grid():
    slit = np.zeros((NY, NX), bool)
    slit[20, 15] = True
    with pytest.raises(LensError, match="hardly a point"):
        export.grid_phase(lens(bowl(X, Y[:, None]), slit), 5)
    with pytest.raises(LensError, match="grid phase of a rectangular lattice"):
        export.grid_phase(
            lens(bowl(X, Y[:, None]), DISC, Lattice("rectangular", 1.3)), 61
        )


def test_sites_beyond_the_rim_take_the_parabola_line_or_value_that_there_is():
    nan = math.nan
    grid = np.full((7, 10), nan)
    grid[3, 2:7] = [4.0, 7.0, 12.0, 19.0, 28.0]  # squares and 3 of columns from 1 on
    out = export._continued(grid, 2.0)
    assert out[3, 7:9].tolist() == [39.0, 52.0]
    assert math.isnan(out[3, 9])  # three away
    assert out[3, :2].tolist() == [4.0, 3.0]
    assert out[3, 2:7].tolist() == grid[3, 2:7].tolist()
    pair = np.full((3, 6), nan)
    pair[1, :2] = [2.0, 5.0]
    assert export._continued(pair, 1.0)[1, 2] == 8.0  # a line
    lone = np.full((3, 4), nan)
    lone[1, 1] = 6.0
    made = export._continued(lone, 1.0)
    assert made[1].tolist()[:3] == [6.0, 6.0, 6.0]
    assert math.isnan(made[1, 3])
    assert (made[0, 1], made[2, 1]) == (6.0, 6.0)
    assert math.isnan(made[0, 0])  # √2 away


def test_points_without_data_take_the_nearest():
    nan = math.nan
    grid = np.array([[1.0, nan, nan, 4.0], [nan, nan, nan, nan]])
    assert export._filled(grid).tolist() == [[1.0, 1.0, 4.0, 4.0], [1.0, 1.0, 4.0, 4.0]]
    assert export._at(
        grid, np.array([[0, 3], [0, 0], [-1, 0], [2, 0], [0, 4], [0, -1]])
    ).tolist()[:2] == [4.0, 1.0]
    assert np.isnan(
        export._at(grid, np.array([[-1, 0], [2, 0], [0, 4], [0, -1]]))
    ).all()


def test_the_file_says_its_size_in_millimetres_and_flags_points_without_data():
    text = GridPhase(np.array([[0.25, math.nan], [-1.5, 3.0]]), 12.5, 0.0).text()
    assert (
        text
        == "2 2 0.0125 0.0125 0 0 0\t \t\n0.25 0 0 0 0\n0 0 0 0 1\n-1.5 0 0 0 0\n3.0 0 0 0 0\n"
    )


def test_each_format_is_written_with_the_values_of_the_lens(tmp_path):
    one = lens(bowl(X, Y[:, None]), DISC)
    error = export.write(tmp_path / "a.dat", one)
    plain = export.grid_phase(one)
    assert plain.phase_rad.shape == (501, 501)
    assert error == plain.error_rad
    assert (tmp_path / "a.dat").read_text().startswith("501 501 ")
    assert export.write(tmp_path / "a.npz", one) == 0.0
    assert export.write(tmp_path / "a.MAT", one) == 0.0
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert archive.comment == b"metalens lens, um and rad"
    head = (tmp_path / "a.MAT").read_bytes()[:128]
    assert head[:116] == b"MATLAB 5.0 MAT-file, metalens lens, um and rad".ljust(116)
    assert (
        head[124:128] == b"\x00\x01IM"
    )  # version and byte order, from byte 124 of the format on
    for read in (
        np.load(tmp_path / "a.npz"),
        loadmat(io.BytesIO((tmp_path / "a.MAT").read_bytes())),
    ):
        assert np.ravel(read["x_um"]) == pytest.approx(X)
        assert np.ravel(read["y_um"]) == pytest.approx(Y)
        assert float(np.ravel(read["pitch_um"])[0]) == PITCH
        assert float(np.ravel(read["wavelength_um"])[0]) == 0.85
        phase = np.mod(bowl(X[20], Y[9]), 2 * math.pi)
        assert read["phase_rad"][9, 20] == pytest.approx(phase, abs=1e-9)
        assert 0 <= read["phase_rad"].min() <= read["phase_rad"].max() < 2 * math.pi
        d = one.diameters.diameter_um[9, 20]
        assert read["transmission"][9, 20] == pytest.approx(
            0.95 + 0.02 * (d - 0.2) / 0.1
        )
        assert "angle_rad" not in read
    with pytest.raises(LensError, match=r"name it \.npz, \.mat, \.dat"):
        export.check("a.txt")
