"""Marks of a die: what a vernier and a box in a box read is p1 - p2 for each bar, and
twice the shift.
"""

import numpy as np
import pytest

import layout
from layout.formats import job_files
from layout.mask import fields
from layout.process.process import DesignRules, DieSettings, ExposureSettings, Process
from metalens.core.errors import ProcessError
from metalens.lens.record import DiameterMap

STEP_NM, PITCH_UM = 70.0, 7.3


def lens_map():
    """13 by 13 pillars of two sizes."""
    return DiameterMap(np.where(np.arange(169).reshape(13, 13) % 2, 0.15, 0.2), 0.4)


def process(**die):
    settings = {"vernier_step_nm": STEP_NM, "vernier_pitch_um": PITCH_UM, **die}
    return Process(
        die=DieSettings(**settings), exposure=ExposureSettings(correct=False)
    )


def parts(plan, made):
    """Boxes (n, 4) of the pillars' scale, and of the openings that belong to it: bars
    and outer box, in nm.
    """
    drawn = next(f for f in plan.figures if f.name == "VERNIERS").polygons[
        made.layers.marks
    ]
    opened = next(f for f in plan.figures if f.name == "APERTURE").polygons[
        made.layers.aperture
    ]
    boxes = [
        np.array([np.r_[p.min(0), p.max(0)] for p in shapes])
        for shapes in (drawn, opened)
    ]
    sides = [np.sort(b[:, 2:] - b[:, :2], axis=1) for b in boxes]
    wide = sides[0][0, 0]  # of a bar
    bars = [
        b[(s[:, 0] == wide) & (s[:, 1] <= 16000)]
        for b, s in zip(boxes, sides, strict=True)
    ]
    inner = boxes[0][(sides[0] == 10000).all(1)]
    outer = boxes[1][(sides[1] == 20000).all(1)]
    return bars, inner, outer


def middles(bars, axis):
    """Middles along an axis of the bars whose width lies along it, rising."""
    own = bars[
        (bars[:, 2 + axis] - bars[:, axis]) < (bars[:, 3 - axis] - bars[:, 1 - axis])
    ]
    return np.sort((own[:, axis] + own[:, 2 + axis]) / 2)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("n", [-7, 3, 10])
def test_a_shift_of_n_steps_makes_bar_n_meet_and_no_other(axis, n):
    made = process()
    (drawn, opened), _, _ = parts(layout.plan(lens_map(), made), made)
    # d = n (p1 - p2)
    still, moved = (middles(drawn, axis), middles(opened, axis) - n * STEP_NM)
    assert len(still) == len(moved) == 21
    assert np.flatnonzero(still == moved).tolist() == [10 + n]
    assert set(np.diff(still)) == {1000 * PITCH_UM}
    assert set(np.diff(moved)) == {1000 * PITCH_UM + STEP_NM}


def test_middle_bars_are_longer_and_both_scales_lie_side_by_side():
    made = process()
    (drawn, opened), _, _ = parts(layout.plan(lens_map(), made), made)
    for bars in (drawn, opened):
        long = np.max(bars[:, 2:] - bars[:, :2], axis=1)
        assert sorted(set(long.tolist())) == [12000, 16000]
        assert (long == 16000).sum() == 2
    for axis in (0, 1):
        one, two = (b[(b[:, 2 + axis] - b[:, axis]) < 5000] for b in (drawn, opened))
        between = (
            one[:, 1 - axis].min() - two[:, 3 - axis].max(),
            two[:, 1 - axis].min() - one[:, 3 - axis].max(),
        )
        # twice the 2 um from the film's edge, on one side of it
        assert max(between) == 4000


def test_a_box_in_a_box_has_equal_margins_that_differ_by_twice_a_shift():
    made = process()
    _, inner, outer = parts(layout.plan(lens_map(), made), made)
    (inner,), (outer,) = inner, outer
    assert (
        (inner[:2] - outer[:2]).tolist()
        == (outer[2:] - inner[2:]).tolist()
        == [5000, 5000]
    )
    moved = outer + np.array([37, -12, 37, -12])
    assert ((outer[2:] - inner[2:]) - (inner[:2] - outer[:2])).tolist() == [0, 0]
    assert ((moved[2:] - inner[2:]) - (inner[:2] - moved[:2])).tolist() == [74, -24]


@pytest.mark.parametrize("grid", [1, 5])
def test_verniers_keep_the_rules_and_the_grid(grid):
    made = Process(
        rules=DesignRules(grid_nm=grid, diameter_step_nm=10),
        die=DieSettings(vernier_step_nm=35.0),
        exposure=ExposureSettings(correct=False),
    )
    plan = layout.plan(lens_map(), made)
    assert layout.check_plan(plan, made.rules).ok
    (drawn, opened), _, _ = parts(plan, made)
    assert len(middles(opened, 0)) == 21
    assert set(np.diff(middles(opened, 0)) - np.diff(middles(drawn, 0))) == {35.0}
    assert not (np.concatenate([drawn, opened]) % grid).any()


def test_verniers_are_said_on_the_job_sheet_and_can_be_left_out():
    for wanted in (True, False):
        made = process(verniers=wanted)
        plan = layout.plan(lens_map(), made)
        split = fields.split_write_fields(lens_map(), made)
        sheet = job_files.job_sheet(plan, made, split, {}, "fine")
        assert (f"{STEP_NM:g} nm longer from bar to bar" in sheet) == wanted
        assert any(f.name == "VERNIERS" for f in plan.figures) == wanted


def test_a_step_below_the_grid_and_a_die_without_room_are_refused_by_key():
    coarse = Process(
        rules=DesignRules(grid_nm=20, diameter_step_nm=20),
        die=DieSettings(vernier_step_nm=8.0),
    )
    with pytest.raises(
        ProcessError,
        match=r"die\.vernier_step_nm = 8\.0: need at least the grid of 20 nm",
    ):
        layout.plan(lens_map(), coarse)
    with pytest.raises(
        ProcessError, match=r"die is too narrow for VERNIERS: \d+ um are needed"
    ):
        layout.plan(lens_map(), process(size_um=(640.0, 900.0)))


SMALL = {"mark_um": 23.0, "mark_width_um": 2.0, "street_um": 7.0}


@pytest.mark.parametrize(
    ("die", "words"),
    [
        (
            {"margin_um": 180.0, **SMALL},
            r"WITNESS and VERNIERS overlap on a die of 367 x 367 um.*die.verniers = false",
        ),
        (
            {"size_um": (700.0, 72.0), "verniers": False},
            "DOSETEST and LABEL overlap .*raise die.margin_um or die.size",
        ),
        (
            {"size_um": (900.0, 110.0), "verniers": False, **SMALL, "mark_um": 40.0},
            "LABEL and the aperture overlap",
        ),
    ],
)
def test_structures_that_stand_on_each_other_are_refused_by_name(die, words):
    """Dies that are wide enough for each structure alone, around an aperture of 7 um."""
    with pytest.raises(ProcessError, match=words):
        layout.plan(lens_map(), process(**die))


def test_a_die_just_wide_enough_keeps_its_structures_apart():
    """Boxes around marks, verniers and label share nothing with those of dose test and
    witness cells.
    """
    plan = layout.plan(lens_map(), process(margin_um=190.0, **SMALL))
    drawn = [
        p
        for f in plan.figures
        if f.name in ("MARKS", "VERNIERS", "LABEL")
        for s in f.polygons.values()
        for p in s
    ]
    low, high = (
        np.array([getattr(p, end)(0) for p in drawn]) for end in ("min", "max")
    )
    assert len(plan.lattices) == 3
    for lattice in plan.lattices[1:]:
        left, top = lattice.x0, lattice.y0
        right = left + (lattice.columns - 1) * lattice.pitch
        bottom = top - (lattice.rows - 1) * lattice.pitch
        over = (low < (right, top)) & (high > (left, bottom))
        assert not over.all(1).any()
