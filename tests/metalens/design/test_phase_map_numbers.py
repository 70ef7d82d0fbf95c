"""Maps of unlike steps and middles, between their samples and at their ends, and what
is too coarse, by hand.
"""

import math

import numpy as np
import pytest

from metalens.design import phase_map
from metalens.design.phase_map import Samples
from metalens.design.profiles import PhaseMap
from metalens.ground.errors import LensError

STEPS, CENTRE = (1.6, 0.7), (3.1, -2.3)
PHASE = np.random.default_rng(2).uniform(-0.6, 0.6, (5, 4))


def mixed(x, y):
    """Angle of the phasors of the four samples about a place, each by the area across
    from it.
    """
    column, row = (x - CENTRE[0]) / STEPS[0] + 1.5, (y - CENTRE[1]) / STEPS[1] + 2.0
    i, k = min(max(math.floor(row), 0), 3), min(max(math.floor(column), 0), 2)
    a, b = min(max(row - i, 0), 1), min(max(column - k, 0), 1)
    corners = np.exp(1j * PHASE[i : i + 2, k : k + 2])
    return np.angle(np.array([1 - a, a]) @ corners @ np.array([1 - b, b]))


def test_between_samples_phasors_are_mixed_by_how_near_they_are():
    """And beyond the outermost samples, by half a step at most, the end sample is
    taken.
    """
    x = CENTRE[0] + np.array([-1.99, -1.5, -0.4, 0.0, 0.61, 1.49, 1.99]) * STEPS[0]
    y = CENTRE[1] + np.array([-2.49, -2.0, -1.3, 0.2, 1.9, 2.49]) * STEPS[1]
    found = phase_map.interpolate(Samples(PHASE, STEPS, CENTRE), x, y)
    assert found == pytest.approx(
        np.array([[mixed(a, b) for a in x] for b in y]), abs=1e-12
    )
    assert found[0, 0] == pytest.approx(PHASE[0, 0], abs=1e-12)
    assert found[-1, -1] == pytest.approx(PHASE[4, 3], abs=1e-12)
    assert found[1, -1] == pytest.approx(PHASE[0, 3], abs=1e-12)


@pytest.mark.parametrize(("x", "y"), [(-2.01, 0), (2.01, 0), (0, -2.51), (0, 2.51)])
def test_places_beyond_half_a_step_are_refused_with_what_the_map_covers(x, y):
    at = np.array([CENTRE[0] + x * STEPS[0]]), np.array([CENTRE[1] + y * STEPS[1]])
    with pytest.raises(
        LensError,
        match=r"covers 6\.4 x 3\.5 um about \(3\.1, -2\.3\) um, less than the aperture",
    ):
        phase_map.interpolate(Samples(PHASE, STEPS, CENTRE), *at)


@pytest.mark.parametrize(
    ("degrees", "known"),
    [(119.0, True), (121.0, False), (-119.0, True), (-121.0, False)],
)
@pytest.mark.parametrize("across", [True, False])
def test_half_way_between_samples_two_thirds_of_half_a_turn_is_the_most(
    degrees, across, known
):
    """cos 60° of two phasors 120° apart is a half; the place with the shortest is
    named, and the longer step.
    """
    phase = np.zeros((6, 7))
    phase[:, 4:] = math.radians(degrees)
    steps = (1.6, 0.7)
    if not across:
        phase, steps = phase.T.copy(), steps[::-1]
    # column 3.5 of rows -3 to 2, or the like turned: 0.5 sample beyond the middle
    x, y = np.array([-1.6, 0.8, 1.6]), np.array([-0.35, 0.35])
    samples = Samples(phase, steps)
    given = (x, y) if across else (y, x)
    if known:
        found = phase_map.interpolate(samples, *given)
        assert (found[:, 1] if across else found[1]) == pytest.approx(
            [math.radians(degrees) / 2] * 2, abs=1e-12
        )
        return
    words = r"near row 2\.0, column 3\.5" if across else r"near row 3\.5, column 2\.0"
    with pytest.raises(
        LensError,
        match=rf"between samples {words}; give it on a finer pitch than 1\.6 um",
    ):
        phase_map.interpolate(samples, *given)


def grid(folder, head, values):
    path = folder / "g.dat"
    path.write_text(
        f"! of another program\n\n{head}\n" + "".join(f"{v}\n" for v in values)
    )
    return path


def test_a_grid_phase_has_its_own_counts_steps_and_middle(tmp_path):
    """Three columns by two rows, 0.4 and 0.25 mm apart, of either sign; 7 and 9 mm from
    the axis, up in the file.
    """
    lines = [f"{v} 0 0 0 0" for v in (0.1, 0.2, 0.3, 0.4, 0.5)] + ["0.6 0 0 0 1"]
    found = phase_map.read(PhaseMap(grid(tmp_path, "3 2 -0.4 0.25 0 7 9", lines)))
    assert found.phase_rad[0].tolist() == [0.1, 0.2, 0.3]
    assert found.phase_rad[1, :2].tolist() == [0.4, 0.5]
    assert math.isnan(found.phase_rad[1, 2])
    assert found.step_um == pytest.approx((400.0, 250.0), rel=1e-12)
    assert found.centre_um == pytest.approx((7e3, -9e3), rel=1e-12)
    for head in ("3 2 0.4 0.25 0", "3 2 0.4 0.25 0 7"):
        assert phase_map.read(PhaseMap(grid(tmp_path, head, lines))).centre_um == (
            0.0,
            0.0,
        )
    turned = phase_map.read(
        PhaseMap(grid(tmp_path, "3 2 0.4 -0.25 1 7 9", lines), conjugate=True)
    )
    assert turned.step_um == pytest.approx((4e3, 2.5e3), rel=1e-12)
    assert turned.centre_um == pytest.approx((7e4, -9e4), rel=1e-12)
    assert turned.phase_rad[0].tolist() == [-0.1, -0.2, -0.3]


@pytest.mark.parametrize("flag", ["0.3", "0.3 0 0 0", "0.3 0 0 0 0", "0.3 0 0 0 2"])
def test_a_point_is_missing_where_its_fifth_word_is_one(tmp_path, flag):
    found = phase_map.read(
        PhaseMap(
            grid(tmp_path, "2 2 0.1 0.1 0 0 0", [flag, "0", "0.2 1 1 1", "0.4 0 0 0 1"])
        )
    )
    assert found.phase_rad[0].tolist() == [0.3, 0.0]
    assert found.phase_rad[1, 0] == 0.2
    assert math.isnan(found.phase_rad[1, 1])


@pytest.mark.parametrize(
    ("x", "y", "taken"),
    [
        (100.0, 100.0, True),
        (100.00009, 99.99991, True),
        (100.00011, 100.0, False),
        (100.0, 99.99989, False),
    ],
)
def test_a_pitch_that_is_given_too_is_the_files_within_a_millionth(
    tmp_path, x, y, taken
):
    path = grid(
        tmp_path, f"2 2 {x / 1e3:.9f} {y / 1e3:.9f} 0 0 0", [0.1, 0.2, 0.3, 0.4]
    )
    if taken:
        assert phase_map.read(PhaseMap(path, 100.0)).step_um == pytest.approx(
            (x, y), rel=1e-12
        )
    else:
        with pytest.raises(
            LensError, match=r"but pitch_um = 100\.0; leave pitch_um out"
        ):
            phase_map.read(PhaseMap(path, 100.0))


def test_rows_and_columns_of_numbers_are_no_map(tmp_path):
    """A matrix of one row is passed over where the only map is looked for, and refused
    where it is named.
    """
    held = {
        "map": PHASE,
        "x": np.zeros((1, 4)),
        "y": np.zeros((5, 1)),
        "stack": np.zeros((2, 3, 4)),
        "one": 3.0,
    }
    assert phase_map._named(tmp_path, held, None) is PHASE
    assert phase_map._named(tmp_path, held, "y") is held["y"]
    with pytest.raises(LensError, match=r"holds 2 matrices \(back, map\); name one"):
        phase_map._named(tmp_path, held | {"back": PHASE.T}, None)
    for name, shape in (
        ("x", r"\(1, 4\)"),
        ("y", r"\(5, 1\)"),
        ("stack", r"\(2, 3, 4\)"),
    ):
        np.save(tmp_path / "m.npy", held[name])
        with pytest.raises(
            LensError,
            match=rf"holds float64 of shape {shape}, need real \(y, x\) of 2 by 2",
        ):
            phase_map.read(PhaseMap(tmp_path / "m.npy", 0.9))
    np.save(tmp_path / "m.npy", PHASE)
    found = phase_map.read(PhaseMap(tmp_path / "m.npy", 0.9))
    assert np.array_equal(found.phase_rad, PHASE)
    assert (found.step_um, found.centre_um) == ((0.9, 0.9), (0.0, 0.0))


def test_steps_of_a_ring_below_a_third_of_a_turn_tell_a_vortex_and_one_turn_is_enough():
    """Twelve samples about four, of steps typed here: 0.33 of a turn at most is fine,
    0.34 is not.
    """
    at = [
        (0, 0),
        (0, 1),
        (0, 2),
        (0, 3),
        (1, 3),
        (2, 3),
        (3, 3),
        (3, 2),
        (3, 1),
        (3, 0),
        (2, 0),
        (1, 0),
    ]
    for steep, known in ((0.33, True), (-0.33, True), (0.34, False)):
        sign = math.copysign(1, steep)
        steps = [steep] + [sign * (1 - abs(steep)) / 11] * 11
        phase = np.full((4, 4), 0.5)
        for place, turn in zip(at, np.cumsum([0, *steps[:-1]]), strict=True):
            phase[place] = 2 * math.pi * turn
        phase[1, 2] = 7.7
        found = phase_map._vortex(phase, 1.4, 1.6)
        assert found == (7.7 if known else None)
    still = np.where(np.arange(4) > 1, 0.4, 0.0) * 2 + np.zeros((4, 1))
    assert phase_map._vortex(still, 1.4, 1.6) is None
