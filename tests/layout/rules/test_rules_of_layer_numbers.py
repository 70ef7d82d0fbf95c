"""Shapes of a layer gathered from cells by hand: what counts as one outline, what draws
nothing, where each stands.
"""

import numpy as np

from layout.files import CellContent, MaskContent, Placed, Turn
from layout.rules import layer
from layout.rules.layer import Layer

BAR = np.array([[0, 0], [30, 0], [30, 4], [0, 4]])
WEDGE = np.array([[-7, -3], [12, -5], [9, 8]])
LINE = np.array([[0, 0], [50, 0], [20, 0]])


def placed(children, *rows):
    """(child, x, y, quarter turns) of each."""
    child, x, y, turn = np.array(rows, np.int32).reshape(-1, 4).T
    return Placed(children, child, x, y, turn.astype(np.uint8))


def mask():
    """Bars of layers 1 and 4 and a line of layer 1 in A; a wedge and, once more, the
    bar in B; C is kept whole.
    """
    cells = {
        "A": CellContent("A", {(1, 0): [BAR, LINE], (4, 2): [BAR]}),
        "B": CellContent("B", {(1, 3): [WEDGE, BAR], (9, 0): [WEDGE]}),
        "C": CellContent("C", {(1, 0): [BAR]}),
        "TOP": CellContent(
            "TOP",
            placed=placed(
                ("A", "B", "C"),
                (0, 100, 7, 0),
                (0, 300, -9, 0),
                (1, -50, 20, 0),
                (2, 0, 0, 0),
            ),
        ),
    }
    return MaskContent("GDSII", 1.0, cells)


def told(some):
    """{(corners of an outline): places}."""
    found = {}
    for k, x, y in zip(
        some.kind.tolist(), some.x.tolist(), some.y.tolist(), strict=True
    ):
        found.setdefault(tuple(map(tuple, some.outlines[k].tolist())), set()).add(
            (x, y)
        )
    return found


def as_key(points):
    return tuple(map(tuple, points.tolist()))


def test_shapes_of_one_layer_number_and_outline_are_one_kind_wherever_they_are_drawn():
    found = layer.groups(mask(), ["TOP"], (9,), {"C"})
    assert set(found) == {1, 4}
    first = layer.gathered(found[1])
    assert told(first) == {
        as_key(BAR): {(100, 7), (300, -9), (-50, 20)},
        as_key(WEDGE): {(-50, 20)},
    }
    assert (len(first.outlines), first.cells) == (
        2,
        ["A", "B"],
    )  # the line draws nothing, and no cell either
    assert first.kind.dtype == first.x.dtype == np.int32
    assert told(layer.gathered(found[4])) == {as_key(BAR): {(100, 7), (300, -9)}}
    assert all(not group for group in found[4])  # let go on the way


def test_a_layer_number_may_count_as_another():
    found = layer.groups(mask(), ["TOP"], (), frozenset(), {4: 1, 9: 5})
    assert set(found) == {1, 5}
    first = layer.gathered(found[1])
    assert told(first)[as_key(BAR)] == {(100, 7), (300, -9), (-50, 20), (0, 0)}
    assert len(first.kind) == 6 + 1  # bars of layer 4 lie on those of layer 1
    assert told(layer.gathered(found[5])) == {as_key(WEDGE): {(-50, 20)}}
    zero = MaskContent(
        "GDSII", 1.0, {"Z": CellContent("Z", {(0, 0): [BAR], (3, 0): [WEDGE]})}
    )
    assert set(layer.groups(zero, ["Z"], (), frozenset())) == {0, 3}
    assert set(layer.groups(zero, ["Z"], (0,), frozenset())) == {3}


def some(outlines, *rows, cells=None):
    kind, x, y = np.array(rows, np.int32).T
    return Layer(outlines, cells or [f"C{k}" for k in range(len(outlines))], kind, x, y)


def test_joined_layers_have_each_outline_once_with_the_cell_that_was_first():
    one = some([BAR, WEDGE], (1, 10, 11), (0, 12, 13), cells=["P", "Q"])
    two = some(
        [WEDGE * 2, WEDGE, BAR + 1],
        (0, -1, -2),
        (1, -3, -4),
        (2, -5, -6),
        (1, -7, -8),
        cells=["R", "S", "T"],
    )
    both = layer.joined([one, two])
    assert [as_key(o) for o in both.outlines] == [
        as_key(o) for o in (BAR, WEDGE, WEDGE * 2, BAR + 1)
    ]
    assert both.cells == ["P", "Q", "R", "T"]
    assert both.kind.tolist() == [1, 0, 2, 1, 3, 1]
    assert both.x.tolist() == [10, 12, -1, -3, -5, -7]
    assert both.y.tolist() == [11, 13, -2, -4, -6, -8]
    assert layer.joined([two]) is two


def test_corners_that_repeat_or_lie_on_a_line_are_left_out():
    points = np.array(
        [[0, 0], [0, 0], [10, 0], [30, 0], [30, 4], [15, 4], [0, 4], [0, 3]]
    )
    assert layer.plain(points).tolist() == BAR.tolist()
    back = np.array([[0, 0], [30, 0], [30, 4], [0, 4], [0, 9], [0, 4]])
    assert layer.plain(back)[:3].tolist() == [[0, 0], [30, 0], [30, 4]]
    assert len(layer.plain(np.array([[0, 0], [5, 5], [9, 9]]))) == 0
    assert len(layer.plain(np.array([[3, 3], [3, 3], [3, 3]]))) == 0


def test_dents_of_less_than_a_unit_are_filled_and_deeper_ones_stay():
    """(50, 0.9) would be 0.9 deep: on whole units a slanted side of 100 by 1 has dents
    of less than one.
    """
    shallow = np.array(
        [[0, 0], [50, 1], [100, 1], [90, 60]]
    )  # (50, 1) lies half a unit within the side
    assert layer.filled(shallow).tolist() in (
        [[0, 0], [100, 1], [90, 60]],
        [[100, 1], [90, 60], [0, 0]],
        [[90, 60], [0, 0], [100, 1]],
    )
    deep = np.array([[0, 0], [50, 1], [100, 0], [90, 60]])  # one whole unit
    assert layer.filled(deep) is deep
    assert layer.filled(BAR) is BAR
    clockwise = WEDGE[::-1]
    assert layer.filled(clockwise) is clockwise  # too few corners for a dent


def test_convex_is_what_turns_left_once():
    assert layer.is_convex(BAR)
    assert layer.is_convex(WEDGE)
    assert not layer.is_convex(BAR[::-1])
    assert not layer.is_convex(
        np.array([[0, 0], [15, 0], [30, 0], [30, 4]])
    )  # straight on
    assert not layer.is_convex(np.array([[0, 0], [50, 1], [100, 0], [90, 60]]))
    angle = 2 * np.pi * np.arange(5) * 2 / 5  # a star goes around twice
    star = np.rint(1000 * np.column_stack([np.cos(angle), np.sin(angle)])).astype(int)
    assert not layer.is_convex(star)
    assert layer.is_convex(star[[0, 3, 1, 4, 2]])


def test_copies_of_all_shapes_are_turned_and_moved_place_by_place():
    """A mirror and a quarter: (x, y) -> (y, x); outlines stay counter-clockwise."""
    made = some([WEDGE], (0, 10, 3), (0, -5, 8)).copied(
        Turn(90.0, True), np.array([100, 700]), np.array([-20, 30])
    )
    assert made.x.tolist() == [103, 108, 703, 708]
    assert made.y.tolist() == [-10, -25, 40, 25]
    assert made.kind.tolist() == [0] * 4
    assert made.outlines[0].tolist() == [[8, 9], [-5, 12], [-3, -7]]
    turned = some([WEDGE], (0, 10, 3)).copied(
        Turn(90.0), np.array([100]), np.array([-20])
    )
    assert (turned.x.tolist(), turned.y.tolist()) == ([97], [-10])
    assert turned.outlines[0].tolist() == [[3, -7], [5, 12], [-8, 9]]
