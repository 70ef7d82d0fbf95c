"""Places by square: numbers row by row by hand, and neighbours no further than the
square beside.
"""

import math

import numpy as np
import pytest

from layout.files.squares import Squares, first_from

DRAW = np.random.default_rng(61)


def by_hand(x, y, side, left, bottom, columns):
    return [
        math.floor((b - bottom) / side) * columns + math.floor((a - left) / side) + 1
        for a, b in zip(x, y, strict=True)
    ]


@pytest.mark.parametrize("moved", [False, True])
def test_squares_are_numbered_row_by_row_with_an_empty_one_at_both_ends(moved):
    """Places of kinds are moved by the middles of these; the room is that of the
    outermost middles.
    """
    x, y = DRAW.integers(-700, 2100, (2, 80)).astype(np.int32)
    kind = DRAW.integers(0, 3, 80).astype(np.int32)
    middle = (
        np.array([[-31.5, 4.25], [12.0, -60.5], [0.5, 33.0]])
        if moved
        else np.zeros((1, 2))
    )
    about = {"kind": kind, "middle": middle} if moved else {}
    made = Squares.of(x, y, 130.0, **about)
    left, bottom = x.min() + middle[:, 0].min(), y.min() + middle[:, 1].min()
    assert (made.side, made.left, made.bottom) == (130.0, left, bottom)
    assert made.columns == math.floor((x.max() + middle[:, 0].max() - left) / 130) + 3
    at = np.column_stack([x, y]) + middle[kind if moved else 0]
    key = np.array(by_hand(at[:, 0], at[:, 1], 130.0, left, bottom, made.columns))
    assert made.key.tolist() == sorted(key.tolist())
    assert made.key.tolist() == key[made.order].tolist()
    column = made.key % made.columns
    assert 1 <= column.min() <= column.max() <= made.columns - 2
    for square in np.unique(key):  # as they came
        mine = made.order[made.key == square]
        assert (np.diff(mine) > 0).all()


def test_places_nearer_than_a_side_are_in_squares_beside_each_other():
    x, y = DRAW.integers(-500, 900, (2, 120)).astype(np.int32)
    made = Squares.of(x, y, 90.0)
    key = np.empty(120, np.int64)
    key[made.order] = made.key
    beside = {row * made.columns + step for row in (-1, 0, 1) for step in (-1, 0, 1)}
    near = np.hypot(x[:, None] - x, y[:, None] - y) < 90
    assert {int(d) for d in (key[:, None] - key)[near]} <= beside
    other_x, other_y = x[::2] + 17, y[::2] - 31
    order, others = made.seen_by(other_x, other_y)
    want = by_hand(other_x, other_y, 90.0, made.left, made.bottom, made.columns)
    assert others.tolist() == sorted(want)
    assert others.tolist() == np.array(want)[order].tolist()


def test_the_first_place_of_a_square_or_beyond_is_looked_for_from_the_last_on():
    key = np.array([2, 2, 5, 9, 9, 9, 14])
    assert [first_from(key, wanted, 0) for wanted in (0, 2, 3, 5, 9, 10, 14, 15)] == [
        0,
        0,
        2,
        2,
        3,
        6,
        6,
        7,
    ]
    assert first_from(key, 2, 4) == 4
    assert first_from(key, 9, 4) == 4
