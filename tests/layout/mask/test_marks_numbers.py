"""Marks of a die corner by corner, in units of 2 nm on a grid of 5: lengths of the
process by hand.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.mask import marks
from layout.mask.marks import DatabaseUnits, MarkBox
from layout.process.process import DieSettings, Process
from metalens.core.errors import ProcessError

PLAN = SimpleNamespace(unit_nm=2.0, grid=5, lattices=[SimpleNamespace(constant=403)])
UNIT = DatabaseUnits(PLAN)
DIE = MarkBox(-200_000, -175_000, 200_000, 175_000)  # 800 x 700 um


def process(**die):
    about = {
        "mark_um": 150.0,
        "mark_width_um": 10.0,
        "street_um": 30.0,
        "vernier_pitch_um": 7.5,
        "vernier_step_nm": 70.0,
    }
    return Process(die=DieSettings(**about | die))


def edges(shape):
    """Left, bottom, right, top of a rectangle."""
    left, bottom = shape.min(0).tolist()
    right, top = shape.max(0).tolist()
    assert sorted(shape.tolist()) == sorted(
        [[left, bottom], [right, bottom], [right, top], [left, top]]
    )
    return left, bottom, right, top


def test_lengths_go_to_the_nearest_step_and_boxes_to_no_smaller_ones():
    unit = DatabaseUnits(PLAN)
    assert (unit.per_um, unit.grid, unit.pitch) == (500.0, 5, 403)
    assert [unit(v) for v in (1.0, 0.0049, 0.0051, 7.504, -3.307)] == [
        500,
        0,
        5,
        3750,
        -1655,
    ]
    assert UNIT.snapped(MarkBox(-12, -10, 11, 15)) == MarkBox(-15, -10, 15, 15)
    assert UNIT.snapped(MarkBox(1, 4, 6, -4)) == MarkBox(0, 0, 10, 0)
    assert edges(MarkBox(-12, -10, 11, 15).polygon) == (-12, -10, 11, 15)
    assert MarkBox(-12, -10, 11, 15).grown(7) == MarkBox(-19, -17, 18, 22)
    assert marks.bounding_box(np.array([[3, 9], [-4, 2], [8, -1]])) == MarkBox(
        -4, -1, 8, 9
    )


@pytest.mark.parametrize("by", [(10, 0), (-10, 0), (0, 20), (0, -20)])
def test_boxes_that_share_an_edge_do_not_meet(by):
    one = MarkBox(0, 0, 10, 20)
    x, y = by

    def moved(dx, dy):
        return MarkBox(dx, dy, 10 + dx, 20 + dy)

    assert not one.meets(moved(x, y))
    assert one.meets(moved(x - np.sign(x), y - np.sign(y)))
    assert not one.meets(moved(10, 20))
    assert one.meets(moved(9, 19))
    assert one.meets(moved(-9, -19))


def test_a_cross_has_four_arms_of_twice_the_half_width():
    got = marks.cross_polygon(100, -50, 40, 7).tolist()
    assert got[:4] == [[107, -43], [107, -10], [93, -10], [93, -43]]  # the upper arm
    assert got[4:8] == [[60, -43], [60, -57], [93, -57], [93, -90]]
    assert got[8:] == [[107, -90], [107, -57], [140, -57], [140, -43]]


def test_crosses_stand_in_the_corners_fine_ones_inwards_and_an_f_beside_the_upper_left():
    """Arms of 75 um, 40 um from the edge: middles at (285, 235) um; fine arms of 15 um,
    10 um from the coarse ones.
    """
    shapes, windows = marks.alignment_crosses(process(), UNIT, DIE)
    signs = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    for n, (sx, sy) in enumerate(signs):
        coarse = marks.cross_polygon(sx * 142_500, sy * 117_500, 37_500, 2500)
        fine = marks.cross_polygon(sx * 142_500, sy * 67_500, 7500, 500)
        assert shapes[2 * n].tolist() == coarse.tolist()
        assert shapes[2 * n + 1].tolist() == fine.tolist()
        assert windows[2 * n] == marks.bounding_box(coarse).grown(2500)  # half of 10 um
        assert windows[2 * n + 1] == marks.bounding_box(fine).grown(2500)
    s, x, y = 7500, -100_000, 80_000
    corners = [
        (0, 0),
        (1, 0),
        (1, 3),
        (4, 3),
        (4, 4),
        (1, 4),
        (1, 6),
        (5, 6),
        (5, 7),
        (0, 7),
    ]
    assert shapes[8].tolist() == [[x + u * s, y + v * s] for u, v in corners]
    assert windows[8] == MarkBox(x - 2500, y - 2500, x + 5 * s + 2500, y + 7 * s + 2500)
    assert (len(shapes), len(windows)) == (9, 9)


def test_fifths_are_whole_steps_and_one_at_least():
    """Arms of 37 840 and 2620 units: fifths of 7568 and 524 go down to 7565 and 520;
    those of 10 and 5 up to a step.
    """
    shapes, _ = marks.alignment_crosses(
        process(mark_um=151.36, mark_width_um=10.48), UNIT, DIE
    )
    fine = marks.bounding_box(shapes[1])
    assert fine.right - fine.left == 2 * 7565
    assert sorted(
        {abs(v - (fine.left + fine.right) // 2) for v in shapes[1][:, 0].tolist()}
    ) == [520, 7565]
    assert shapes[8][7:9, 0].tolist() == [shapes[8][0, 0] + 5 * 7565] * 2
    tiny, _ = marks.alignment_crosses(
        process(mark_um=0.04, mark_width_um=0.02), UNIT, DIE
    )
    fine = marks.bounding_box(tiny[1])
    assert (fine.right - fine.left, fine.top - fine.bottom) == (10, 10)
    assert sorted(set(np.abs(tiny[1] - tiny[1].mean(0)).ravel().tolist())) == [5.0]
    assert tiny[8][8].tolist() == (tiny[8][0] + np.array([25, 35])).tolist()


def test_a_wafer_cross_is_four_bars_about_a_fine_cross():
    """Bars of 120 um from 80 um to 200 um, 20 um wide; the fine cross has arms of 40
    um, 4 um wide.
    """
    *bars, fine = marks.wafer_cross(UNIT, 400.0, 20.0)
    assert [edges(bar) for bar in bars] == [
        (-5000, 40_000, 5000, 100_000),
        (-100_000, -5000, -40_000, 5000),
        (-5000, -100_000, 5000, -40_000),
        (40_000, -5000, 100_000, 5000),
    ]
    assert fine.tolist() == marks.cross_polygon(0, 0, 20_000, 1000).tolist()
    *bars, fine = marks.wafer_cross(
        UNIT, 400.1, 20.0
    )  # arms of 100 025: two fifths are 40 010
    assert edges(bars[0]) == (-5000, 40_010, 5000, 100_025)
    assert marks.bounding_box(fine) == MarkBox(-20_005, -20_005, 20_005, 20_005)


def test_verniers_and_boxes_stand_left_of_the_upper_right_cross():
    """Pitches of 7.5 and 7.57 um; bars 2.82 um wide (0.375 of 7.5, to the grid), 12 and
    16 um long, 2 um off
    the middle line.
    From the right, in um: 30 + 10 + 150 + 20, the upright scale's 20, another 20, the
    box of 20 between 10 and 10, and
    the level scale from its middle on: 10 x 7.57 + 3.75."""
    scales = marks.vernier_scales(process(), UNIT, DIE)
    assert (len(scales.drawn), len(scales.openings)) == (43, 45)
    for n in range(-10, 11):
        long = 6000 if n else 8000
        x = 15_275 + 3750 * n
        assert edges(scales.drawn[n + 10]) == (
            x - 705,
            146_000,
            x + 705,
            146_000 + long,
        )
        x = 15_275 + 3785 * n
        assert edges(scales.openings[n + 10]) == (
            x - 705,
            144_000 - long,
            x + 705,
            144_000,
        )
        y = 115_275 + 3750 * n
        assert edges(scales.drawn[n + 31]) == (84_000 - long, y - 705, 84_000, y + 705)
        y = 115_275 + 3785 * n
        assert edges(scales.openings[n + 32]) == (
            86_000,
            y - 705,
            86_000 + long,
            y + 705,
        )
    assert edges(scales.openings[21]) == (
        15_275 - 39_375,
        145_000,
        15_275 + 39_375,
        155_000,
    )
    assert edges(scales.openings[43]) == (
        75_000,
        115_275 - 39_375,
        85_000,
        115_275 + 39_375,
    )
    assert edges(scales.drawn[42]) == (62_500, 147_500, 67_500, 152_500)
    assert edges(scales.openings[44]) == (60_000, 145_000, 70_000, 155_000)
    assert marks.vernier_scales(
        process(verniers=False), UNIT, DIE
    ) == marks.VernierScales((), ())


def test_bars_are_a_step_wide_at_least_on_each_side():
    narrow = DatabaseUnits(
        SimpleNamespace(
            unit_nm=2.0, grid=1000, lattices=[SimpleNamespace(constant=403)]
        )
    )
    drawn, _ = marks._vernier(narrow, 2000, 1000)
    assert edges(drawn[10])[::2] == (-1000, 1000)
    finest = DatabaseUnits(
        SimpleNamespace(unit_nm=2.0, grid=1, lattices=[SimpleNamespace(constant=403)])
    )
    drawn, opened = marks._vernier(finest, 3771, 33)
    assert edges(drawn[11])[::2] == (3771 - 707, 3771 + 707)  # 0.375 of 3771 is 1414
    assert edges(opened[9])[::2] == (-3804 - 707, -3804 + 707)
    assert edges(opened[21]) == (-39_595, 0, 39_595, 10_000)  # ten and a half pitches


@pytest.mark.parametrize(("half", "fits"), [(183_475, True), (183_470, False)])
def test_a_die_is_wide_enough_for_verniers_between_the_crosses_and_the_f(half, fits):
    """369.45 um from the right edge to the middle of the level scale, 79.45 um of it,
    and 285 um
    of cross, room and F."""
    die = MarkBox(-half, -175_000, half, 175_000)
    if fits:
        assert len(marks.vernier_scales(process(), UNIT, die).drawn) == 43
    else:
        with pytest.raises(ProcessError, match="734 um are needed"):
            marks.vernier_scales(process(), UNIT, die)
