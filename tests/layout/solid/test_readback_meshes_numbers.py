"""How far meshes may be off before it is told: a tapered box whose volume, sides and
heights are known.
"""

import math
import struct

import numpy as np
import pytest

from layout.solid import readback_meshes as read
from layout.solid.sections import Section
from layout.solid.tile import Tile
from metalens.cell.shapes import Conic, Loop, Outline

HEIGHT = 0.7
FOOT, TOP = ((0.2, 0.13), (0.15, 0.09))  # half sides, um
# corners 0 to 3 of the foot, 4 to 7 of the top, counter-clockwise from above; triangles
# outwards
SIDES = [
    t
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0))
    for t in ((a, b, b + 4), (a, b + 4, a + 4))
]
TRIANGLES = np.array([(0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7), *SIDES])
SIGNS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def outline(half):
    return Outline((Loop(tuple((float(x), float(y)) for x, y in SIGNS * half)),))


SECTION = Section("S", outline(FOOT), outline(TOP))


def corners():
    flat = np.vstack([SIGNS * FOOT, SIGNS * TOP])
    return np.column_stack([flat, np.repeat([0, HEIGHT], 4)])


def told(made, triangles=TRIANGLES):
    return read._shape(read._Part(made, triangles, np.zeros((1, 3))), SECTION, HEIGHT)


def test_a_tapered_box_as_planned_has_its_volume():
    """(A0 + 4 Am + A1) h / 6 of 0.104, 0.077 and 0.054 um2."""
    assert told(corners()) == []
    lines = told(corners() * [1.1, 1, 1])
    assert (
        lines[0]
        == f"volume {1.1 * 0.7 / 6 * 0.466:.9g} um3, planned {0.7 / 6 * 0.466:.9g}"
    )
    assert told(corners(), TRIANGLES[:, ::-1])[0].startswith("volume -0.0543666667 um3")


@pytest.mark.parametrize(
    ("part", "count"), [(0.72e-5, 0), (-0.72e-5, 0), (0.8e-5, 1), (-0.8e-5, 1)]
)
def test_volumes_agree_to_fifteen_millionths(part, count):
    """Sides that are longer by this part hold twice as much more; corners may be off by
    a hundred thousandth.
    """
    lines = told(corners() * [1 + part, 1 + part, 1])
    assert [line.split()[0] for line in lines] == ["volume"] * count


@pytest.mark.parametrize(("part", "count"), [(0.97e-5, 0), (1.03e-5, 2)])
def test_corners_agree_to_a_hundred_thousandth_of_the_reach(part, count):
    lines = told(corners() * [1 + part, 1 - part, 1])
    assert [line.split(" um ")[0] for line in lines] == [
        f"corners of its {end} lie {reach:.6g} to {reach:.6g}"
        for end, (x, y) in (("foot", FOOT), ("top", TOP))
        for reach in (math.hypot(x * (1 + part), y * (1 - part)),)
    ][:count]


@pytest.mark.parametrize("count", [0, 1])
def test_heights_agree_to_five_millionths(count):
    away = (4.9e-6, 5.1e-6)[count] * HEIGHT
    up, part = np.array([0, 0, away]), away / HEIGHT
    for moved in (
        corners() + up,
        corners() - up,
        corners() * [1, 1, 1 + part],
        corners() * [1, 1, 1 - part],
    ):
        lines = told(moved)
        assert [line[:5] for line in lines] == ["from "] * count
    if count:
        assert lines[0] == "from 0 to 0.699996 um high, planned 0 to 0.7"


@pytest.mark.parametrize(("down", "closed"), [(2.05e-5, True), (2.13e-5, False)])
def test_a_surface_is_closed_to_a_part_of_its_sides(down, closed):
    """One triangle's top corner lower than its neighbours': 0.4 um of its foot times
    that, of 5e-5 r h.
    """
    assert 0.4 * 2.05e-5 < 5e-5 * math.hypot(*FOOT) * HEIGHT < 0.4 * 2.13e-5
    made = corners()[TRIANGLES].reshape(-1, 3)
    apart = np.arange(36).reshape(-1, 3)
    assert told(made, apart) == []
    made[3 * 4 + 2, 2] -= down  # of the first side
    assert told(made, apart) == ([] if closed else ["its surface is not closed"])


ELLIPSE = Conic(0.2, 0.1, angle_rad=0.3)


def around(form, count=8):
    """Corners on lines of one form of the ellipse, turned as it is."""
    angle = 2 * math.pi * (np.arange(count) + 0.2) / count
    x, y = 0.2 * form * np.cos(angle), 0.1 * form * np.sin(angle)
    c, s = math.cos(0.3), math.sin(0.3)
    return np.column_stack([c * x - s * y, s * x + c * y])


def test_corners_of_a_curve_lie_on_one_line_a_little_outside():
    form = np.full(8, 1.03)
    assert read._beside(around(form), Outline((ELLIPSE,)))[0] == pytest.approx(
        0, abs=1e-14
    )
    form[3] += 7e-6
    away, low, high = read._beside(around(form), Outline((ELLIPSE,)))
    assert away == pytest.approx(7e-6, rel=1e-6)
    reach = np.hypot(*around(form).T)
    assert (low, high) == (reach.min(), reach.max())
    for bad, least in (
        (0.9999, np.inf),
        (1.1001, np.inf),
        (1.0999, 0.0699),
        (1 - 4e-6, 0.030004),
    ):
        form[3] = bad
        found = read._beside(around(form), Outline((ELLIPSE,)))[0]
        assert found == pytest.approx(least, rel=1e-6)


def test_every_part_of_an_outline_has_three_corners_at_least():
    """An ellipse with a triangle cut out of it."""
    hole = Loop(((-0.02, -0.03), (0.05, -0.01), (0.0, 0.04)), sign=-1)
    both = Outline((ELLIPSE, hole))
    inner = np.array(hole.corners_um)
    every = np.vstack([around(np.full(8, 1.0)), inner])
    away, low, _ = read._beside(every, both)
    assert away == pytest.approx(0, abs=1e-14)
    assert low == pytest.approx(math.hypot(0.02, 0.03), rel=1e-14)
    assert read._beside(every[:-1], both)[0] == np.inf
    assert read._beside(every[6:], both)[0] == np.inf
    assert read._beside(every[5:], both)[0] == pytest.approx(0, abs=1e-14)
    moved = every.copy()
    moved[-1] += np.array([3.0, 4.0]) * 0.8e-7
    assert read._beside(moved, both)[0] == pytest.approx(
        4e-7 / both.radius_um, rel=1e-6
    )
    moved[-1] += np.array([3.0, 4.0]) * 8e-7  # more than 2e-6 um of 0.2
    assert read._beside(moved, both)[0] == np.inf
    assert read._beside(np.empty((0, 2)), both)[0] == np.inf


def test_copies_are_as_far_off_as_the_farthest_and_each_has_a_place():
    planned = np.array([[0.0, 0, 0], [5.0, 1, 0], [-3.0, 7, 0]])
    moved = planned[[2, 0, 1]] + np.array([[0, 0, 0], [0.3, 0.4, 0], [0, 0, -0.2]])
    assert read._off(moved, planned) == pytest.approx(0.5, rel=1e-14)
    assert read._off(planned[[0, 1, 1]], planned) == math.inf


def tile(x=(3.0, -8.0), y=(1.5, 0.25)):
    one, two = (
        Section("S", outline(FOOT), outline(TOP)),
        Section("E", outline((0.1, 0.07)), outline((0.1, 0.07))),
    )
    size = np.array([0.4, 0.2])
    return Tile(
        size,
        size,
        np.array([*x, 0.0]),
        np.array([*y, 9.0]),
        np.array([0, 0, 1]),
        HEIGHT,
        0.5,
        (one, two),
    )


def parts(**other):
    upright = np.vstack([SIGNS * (0.1, 0.07)] * 2)
    second = read._Part(
        np.column_stack([upright, np.repeat([0, HEIGHT], 4)]),
        TRIANGLES,
        np.array([[0.0, 9.0, 0.0]]),
    )
    first = read._Part(
        corners(), TRIANGLES, np.array([[-8.0, 0.25, 0.0], [3.0, 1.5, 0.0]])
    )
    return {"S": first, "E": second} | other


@pytest.mark.parametrize(("off", "fits"), [(0.98e-4, True), (1.02e-4, False)])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_copies_stand_within_a_tenth_of_a_nanometre(off, fits, axis):
    assert read._differences(parts(), tile()) == ()
    made = parts()
    made["S"].places[1, axis] += off
    want = () if fits else ("S: a copy stands 0.000102 um off its place",)
    assert read._differences(made, tile()) == want


def test_missing_copies_and_strange_meshes_are_counted():
    made = parts(X=read._Part(corners(), TRIANGLES, np.zeros((1, 3))))
    made["S"] = read._Part(corners(), TRIANGLES, np.array([[3.0, 1.5, 0.0]]))
    del made["E"]
    assert read._differences(made, tile()) == (
        "S: 1 copies, planned 2",
        "E: 0 copies, planned 1",
        "meshes that were not planned: X",
    )


def test_metres_with_y_up_are_micrometres_with_z_up():
    """North, which is -z in a glTF, is +y."""
    assert read._upright(np.array([[2e-6, 3e-6, -5e-6]])).tolist() == [[2.0, 5.0, 3.0]]


def test_positions_begin_where_view_and_accessor_say():
    buffer = struct.pack("<9f", 7, 7, *(1.5, -2.0, 3.25, 4.0, 5.5, -6.0), 9)
    tree = {
        "accessors": [
            {},
            {
                "componentType": 5126,
                "type": "VEC3",
                "bufferView": 1,
                "byteOffset": 4,
                "count": 2,
            },
        ],
        "bufferViews": [{}, {"byteOffset": 4}],
    }
    assert read._positions(tree, buffer, 1).tolist() == [
        [1.5, -2.0, 3.25],
        [4.0, 5.5, -6.0],
    ]
    tree["accessors"][1]["componentType"] = 5125
    with pytest.raises(ValueError, match="float32"):
        read._positions(tree, buffer, 1)
