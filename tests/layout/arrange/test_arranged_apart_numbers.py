"""Room between parts in nanometres: boxes turned by hand, the nearest pair of several,
both limits and their reach.
"""

import math

import numpy as np
import pytest

from layout.arrange import At, apart, joined, parts
from layout.process.process import Exposure, Process, Rules
from metalens.ground.errors import ProcessError

PLAIN = Process(rules=Rules(minimum_gap_nm=70))
BEAM = Process(
    exposure=Exposure(alpha_um=0.01, beta_um=3.0, eta=0.7, tolerance=0.013),
    rules=Rules(minimum_gap_nm=70),
)
NONE = np.empty((0, 4), np.int64)


def part(name, pillars, *, aperture=NONE, corrected=False, extent=(-9, -8, 7, 6)):
    boxes = {
        parts.PILLARS: np.array(pillars, np.int64).reshape(-1, 4),
        parts.APERTURE: np.array(aperture, np.int64),
    }
    return parts.Part(name, name, {}, {}, {}, boxes, np.array(extent), corrected)


def at(x, y, **more):
    """Where the origin stands, in nanometres."""
    return At(x_um=x / 1000, y_um=y / 1000, **more)


def found(*placed, process=PLAIN):
    return apart.check(
        [joined.Placing(one, (where,)) for one, where in placed], process
    )


def test_boxes_go_round_what_is_mirrored_then_turned_then_moved():
    """(x, y) -> (x, -y) -> (y, x) for a mirror and a quarter; all corners of a box at
    30 degrees, by hand.
    """
    one = part(
        "A",
        [(100, 20, 300, 70), (-50, -10, 0, 0)],
        aperture=[(0, 500, 10, 600)],
        extent=(-60, -20, 310, 700),
    )
    placed = [joined.Placing(one, (at(1000, -4000, turn_deg=90.0, mirrored=True),))]
    assert apart.extent(placed).tolist() == [980, -4060, 1700, -3690]
    assert apart.extent(placed, exposed=True).tolist() == [990, -4050, 1600, -3700]
    both = [*placed, joined.Placing(one, (at(7, 11),))]
    assert apart.extent(both).tolist() == [-53, -4060, 1700, 711]
    c, s = math.sqrt(3) / 2, 0.5
    slanted = apart.extent(
        [
            joined.Placing(
                part("B", [], extent=(100, 20, 300, 70)), (at(7, 11, turn_deg=30.0),)
            )
        ]
    )
    want = [
        100 * c - 70 * s + 7,
        100 * s + 20 * c + 11,
        300 * c - 20 * s + 7,
        300 * s + 70 * c + 11,
    ]
    assert slanted.tolist() == [round(v) for v in want]


def test_a_part_that_exposes_nothing_lies_at_the_origin():
    nothing = part("N", [])
    assert apart.extent(
        [joined.Placing(nothing, (at(5, 9),))], exposed=True
    ).tolist() == [0, 0, 0, 0]
    assert found((nothing, at(0, 0)), (part("A", [(0, 0, 40, 40)]), at(0, 0))) == []
    assert found((part("A", [(0, 0, 40, 40)]), at(0, 0)), (nothing, at(0, 0))) == []


def test_the_nearest_pair_is_told_with_its_box_its_distance_and_the_kind():
    """Of three boxes beside two the nearest are the second and the third, 30 along x
    and 40 along y apart.
    """
    one = part("A", [(0, 0, 100, 50), (0, 200, 130, 260), (0, 500, 60, 560)])
    two = part("B", [(180, 520, 240, 600), (300, 0, 340, 50), (160, 300, 290, 380)])
    (told,) = found((one, at(-7, 11)), (two, at(-7, 11)))
    assert told.value == pytest.approx(50.0, rel=1e-12)
    assert told.box == (-7, 211, 283, 391)
    assert (told.rule, told.limit) == ("structures", 70.0)
    assert told.text == "A at (-0.007, 0.011) um to B at (-0.007, 0.011) um, pillars"
    assert (
        found((one, at(0, 0)), (two, at(16, 13))) == []
    )  # 46 along x, 53 along y: 70.2
    (touch,) = found(
        (one, at(0, 0)), (two, at(-31, 5))
    )  # they meet along x, and are 45 apart along y
    assert touch.value == pytest.approx(45.0, rel=1e-12)


def test_each_exposure_is_held_to_the_gap_by_itself():
    one = part("A", [(0, 0, 100, 50)], aperture=[(0, 300, 100, 360)])
    two = part("B", [(120, 300, 240, 360)], aperture=[(140, 0, 200, 60)])
    assert found((one, at(0, 0)), (two, at(0, 0))) == []
    near = part("C", [(120, 0, 240, 50)], aperture=[(155, 310, 200, 360)])
    told = found((one, at(0, 0)), (near, at(0, 0)))
    assert [(v.value, v.text.rpartition(" ")[2]) for v in told] == [
        (55.0, "aperture"),
        (20.0, "pillars"),
    ]


def test_the_reach_of_scattered_electrons_is_met_to_a_nanometre_from_above():
    """Two Gaussians that both count: the exposure that a half-plane adds, by its error
    function.
    """
    process = Process(
        exposure=Exposure(alpha_um=1.1, beta_um=3.0, eta=0.7, tolerance=0.13)
    )

    def added(away):
        return (math.erfc(away / 1.1) + 0.7 * math.erfc(away / 3.0)) / 1.7 / 2

    reach = apart.reach_um(process)
    assert added(reach) <= 0.13 / 2 < added(reach - 1e-3)
    wide = Process(
        exposure=Exposure(alpha_um=0.02, beta_um=0.5, eta=0.7, tolerance=1.1)
    )
    assert (
        0 < apart.reach_um(wide) <= 1e-3
    )  # nothing adds as much: no more than the last halving


@pytest.mark.parametrize(("first", "second"), [(True, False), (False, True)])
def test_doses_of_either_part_that_know_nothing_of_the_other_need_the_reach(
    first, second
):
    reach = apart.reach_um(BEAM) * 1e3
    one = part("A", [(0, 0, 100, 50)], aperture=[(0, 0, 100, 50)], corrected=first)
    two = part("B", [(0, 0, 90, 50)], aperture=[(33, 0, 90, 50)], corrected=second)
    near, far = math.floor(reach) - 1, math.ceil(reach) + 1
    (told,) = found((one, at(0, 0)), (two, at(100 + near, 0)), process=BEAM)
    assert (told.value, told.limit) == (near, pytest.approx(reach, rel=1e-12))
    assert told.box == (0, 0, 190 + near, 50)
    assert "backscatter of one that the doses of the other do not know of" in told.text
    assert found((one, at(0, 0)), (two, at(100 + far, 0)), process=BEAM) == []
    told = found(
        (one, at(0, 0)), (two, at(130, 0)), process=BEAM
    )  # nearer than the gap: that is told, of both
    assert [(v.value, v.limit) for v in told] == [(63.0, 70), (30.0, 70)]


def test_pairs_of_many_parts_are_told_by_their_names():
    boxes = {name: part(name, [(0, 0, 100, 50)]) for name in "ABCDE"}
    line = [
        (boxes["A"], 0),
        (boxes["B"], 700),
        (boxes["C"], 165),
        (boxes["D"], 1500),
        (boxes["E"], 859),
    ]
    told = found(*((one, at(x, 0)) for one, x in line))
    assert [(v.value, v.text[0], v.text.split(" to ")[1][0]) for v in told] == [
        (65.0, "A", "C"),
        (59.0, "B", "E"),
    ]


def test_a_gap_wider_than_the_reach_is_held_all_the_same():
    short = Process(
        exposure=Exposure(alpha_um=0.004, beta_um=0.01, eta=0.7),
        rules=Rules(minimum_gap_nm=70),
    )
    assert 0 < apart.reach_um(short) < 0.03
    one = part("A", [(0, 0, 100, 50)], corrected=True)
    assert [
        v.value for v in found((one, at(0, 0)), (one, at(169, 0)), process=short)
    ] == [69.0]
    assert found((one, at(0, 0)), (one, at(170, 0)), process=short) == []


def test_four_thousand_copies_are_the_most():
    line = [
        joined.Placing(
            part("A", [(0, 0, 9, 9)]), (At(columns=4000, step_um=(3.7, 1.1)),)
        )
    ]
    assert sum(1 for _ in apart._all(line)) == 4000
    halves = [
        joined.Placing(
            part("A", [(0, 0, 9, 9)]), (At(columns=2001, step_um=(3.7, 1.1)),)
        )
    ] * 2
    with pytest.raises(ProcessError, match="4002 parts on a die, at most 4000"):
        apart.check(halves, PLAIN)
