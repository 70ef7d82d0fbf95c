"""Shapes of a layer: boxes, circles, copies and what is left of their corners, point by
point.
"""

import math

import numpy as np
import pytest

from layout.files import Turn
from layout.rules import layer
from layout.rules.layer import Layer

OUTLINES = [
    np.array([[-7, -3], [12, -5], [9, 8], [-2, 11]], np.int64),
    np.array([[0, 0], [30, 0], [30, 4]], np.int64),
    np.array([[-40, -20], [-10, -20], [-10, 15], [-40, 15]], np.int64),
]


def shapes(count=9, seed=1):
    draw = np.random.default_rng(seed)
    kind = draw.integers(0, 3, count).astype(np.int32)
    kind[:3] = (0, 1, 2)
    x, y = draw.integers(-900, 1700, (2, count)).astype(np.int32)
    return Layer(OUTLINES, ["A", "B", "C"], kind, x, y)


def corners(some):
    """[(n, 2) corners of every shape]."""
    return [
        OUTLINES[k] + np.array([a, b])
        for k, a, b in zip(some.kind, some.x, some.y, strict=True)
    ]


def test_boxes_hold_the_corners_of_each_shape_and_of_all():
    some = shapes()
    every = corners(some)
    want = [[*c.min(0), *c.max(0)] for c in every]
    assert some.boxes().tolist() == want
    assert some.boxes(np.array([4, 1])).tolist() == [want[4], want[1]]
    assert some.around.tolist() == [
        [*np.concatenate(every).min(0), *np.concatenate(every).max(0)]
    ]
    assert some.points(5).tolist() == every[5].tolist()
    two = np.concatenate([every[2], every[6]])
    assert some.box(2, 6) == (*two.min(0).tolist(), *two.max(0).tolist())
    assert layer.EMPTY.around.shape == (0, 4)
    part = some.only(np.array([3, 0]))
    assert [c.tolist() for c in corners(part)] == [every[3].tolist(), every[0].tolist()]


def test_circles_are_about_the_middles_of_boxes_and_reach_the_farthest_corner():
    some = shapes()
    for number, every in enumerate(corners(some)):
        kind = some.kind[number]
        middle = (every.min(0) + every.max(0)) / 2
        at = np.array([some.x[number], some.y[number]]) + some.discs.middle[kind]
        assert at == pytest.approx(middle)
        assert some.discs.reach[kind] == pytest.approx(
            np.hypot(*(every - middle).T).max()
        )


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_copies_are_turned_corner_by_corner_and_stay_anticlockwise(quarters, mirrored):
    """A mirror at the x axis, quarters to the left, then each of three places."""
    some = shapes(5)
    x, y = np.array([100, -2000, 31], np.int32), np.array([7, 50, -900], np.int32)
    made = some.copied(Turn(90.0 * quarters, mirrored), x, y)
    want = []
    for a, b in zip(x.tolist(), y.tolist(), strict=True):
        for every in corners(some):
            turned = (
                every[:, 0] + 1j * every[:, 1] * (-1 if mirrored else 1)
            ) * 1j**quarters
            want.append(sorted((round(p.real) + a, round(p.imag) + b) for p in turned))
    got = [sorted(map(tuple, made.points(n).tolist())) for n in range(len(made.kind))]
    assert sorted(got) == sorted(want)
    assert (made.kind.reshape(3, 5) == some.kind).all()
    for outline in made.outlines:
        u, v = outline.T
        assert (u * np.roll(v, -1) - v * np.roll(u, -1)).sum() > 0


def test_equal_outlines_of_layers_become_one():
    one, two = shapes(4, seed=2), shapes(6, seed=3)
    kinds = [OUTLINES[2].copy(), OUTLINES[0] + 1]
    other = Layer(
        kinds, ["D", "E"], np.array([1, 0, 0], np.int32), two.x[:3], two.y[:3]
    )
    made = layer.joined([one, other])
    assert len(made.outlines) == len(made.cells) == 4
    assert made.cells == ["A", "B", "C", "E"]
    got = [made.points(n).tolist() for n in range(len(made.kind))]
    assert got == [
        part.points(n).tolist() for part in (one, other) for n in range(len(part.kind))
    ]


def test_distances_are_between_the_nearest_corners_and_sides():
    """Boxes of 30 x 35 a vector apart: max(|dx| - 30, 0) and max(|dy| - 35, 0); none beyond what is asked."""
    place = np.array(
        [[0, 0], [70, 10], [64, -95], [-31, 36], [500, 500], [12, 20]], np.int32
    )
    some = Layer(OUTLINES[2:], ["C"], np.zeros(6, np.int32), place[:, 0], place[:, 1])
    found = some.distances(np.zeros(5, int), np.arange(1, 6), 90.0)
    assert found == pytest.approx(
        [40.0, math.hypot(34, 60), math.hypot(1, 1), 90.0, 0.0]
    )


def test_corners_that_turn_nothing_are_left_out():
    square = np.array(
        [[0, 0], [5, 0], [9, 0], [9, 0], [9, 7], [4, 7], [0, 7], [0, 3], [0, 0]],
        np.int64,
    )
    assert layer.plain(square).tolist() == [[9, 0], [9, 7], [0, 7], [0, 0]]
    slanted = np.array([[0, 0], [6, 2], [9, 3], [9, 8]], np.int64)
    assert layer.plain(slanted).tolist() == [[0, 0], [9, 3], [9, 8]]


def test_convex_outlines_turn_left_once_around():
    star = (
        np.array([[math.cos(t), math.sin(t)] for t in 4 * math.pi / 5 * np.arange(5)])
        * 100
    )
    assert layer.is_convex(OUTLINES[0])
    assert not layer.is_convex(OUTLINES[0][::-1])  # the other way around
    assert not layer.is_convex(star)  # twice around
    assert not layer.is_convex(np.array([[0, 0], [9, 0], [9, 9], [4, 3]]))  # a dent
    assert not layer.is_convex(
        np.array([[0, 0], [5, 0], [9, 0], [9, 9]])
    )  # straight on


@pytest.mark.parametrize(("depth", "kept"), [(0.8, False), (1.2, True), (9.0, True)])
def test_dents_shallower_than_a_unit_are_filled(depth, kept):
    """In the slanted side of a triangle of 900 x 900, from its middle inwards."""
    inwards = depth / math.sqrt(2)
    dented = np.array([[0, 0], [900, 0], [450 - inwards, 450 - inwards], [0, 900]])
    made = layer.filled(dented)
    assert len(made) == (4 if kept else 3)
    assert set(map(tuple, made.tolist())) == set(
        map(tuple, (dented if kept else dented[[0, 1, 3]]).tolist())
    )
