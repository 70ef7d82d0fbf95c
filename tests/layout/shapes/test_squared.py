"""Boxes as marked squares, against each unit square looked at by itself."""

import numpy as np
import pytest

from layout.shapes import squared


def boxes_of(rng, count, reach):
    corner = rng.integers(-reach, reach, (count, 2))
    return np.hstack([corner, corner + rng.integers(0, reach // 4, (count, 2))])


def meet(one, two):
    """(n, m) whether closed boxes have a point in common."""
    one, two = one[:, None], two[None]
    return ((one[..., :2] <= two[..., 2:]) & (two[..., :2] <= one[..., 2:])).all(-1)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("squares", [1, 7, 64])
def test_boxes_told_again_cover_what_was_put_in_and_little_more(seed, squares):
    rng = np.random.default_rng(seed)
    around = np.array([-310, -95, 420, 123 + seed])
    put = boxes_of(rng, 9, 380)
    made = squared.Squared.of(around, squares, [put[:4], put[4:]])
    again = made.boxes()
    inside = put[meet(put, around[None])[:, 0]]
    inside = np.hstack(
        [np.maximum(inside[:, :2], around[:2]), np.minimum(inside[:, 2:], around[2:])]
    )
    y, x = np.mgrid[around[1] : around[3] + 1, around[0] : around[2] + 1]
    units = np.column_stack([x.ravel(), y.ravel()] * 2)
    wanted, found = meet(units, inside).any(1), meet(units, again).any(1)
    assert found[wanted].all()
    side = (
        730 / squares
    )  # the longer side of `around`; a box told again ends within a square and a unit of one put in
    assert made.side == side
    wider = put + (side + 1) * np.array([-1, -1, 1, 1])
    assert meet(units, wider).any(1)[found].all()


def test_equal_runs_of_rows_that_follow_each_other_are_one_box():
    """Two bars side by side and a wider one above, on squares of 10 units: three boxes,
    to the ends of squares.
    """
    put = np.array([[0, 0, 19, 39], [50, 3, 59, 38], [0, 40, 99, 59]])
    made = squared.Squared.of(np.array([0, 0, 100, 100]), 10, [put])
    assert made.side == 10
    assert sorted(made.boxes().tolist()) == [
        [0, 0, 20, 40],
        [0, 40, 100, 60],
        [50, 0, 60, 40],
    ]
    assert made.marked.shape == (11, 11)
    assert made.marked.sum() == 2 * 4 + 1 * 4 + 10 * 2


def test_nothing_put_in_is_no_box_and_touches_none():
    far = np.array([[500, 0, 600, 9], [-70, -70, -1, -1]])
    made = squared.Squared.of(np.array([0, 0, 100, 60]), 16, [far])
    assert made.boxes().shape == (0, 4)
    assert not made.touched(np.array([[0, 0, 100, 60], [40, 40, 700, 700]])).any()


@pytest.mark.parametrize("seed", range(4))
def test_who_lies_on_a_marked_square_is_told(seed):
    """Whoever touches a box is told; whoever is further than a square from all of them
    is not.
    """
    rng = np.random.default_rng(seed)
    around = np.array([-200, -300, 230, 280])
    put, asked = boxes_of(rng, 12, 300), boxes_of(rng, 400, 300)
    asked = asked[meet(asked, around[None])[:, 0]]
    put = put[meet(put, around[None])[:, 0]]
    put = np.hstack(
        [np.maximum(put[:, :2], around[:2]), np.minimum(put[:, 2:], around[2:])]
    )
    made = squared.Squared.of(around, 20, [put])
    told = made.touched(asked)
    inside = np.hstack(
        [np.maximum(asked[:, :2], around[:2]), np.minimum(asked[:, 2:], around[2:])]
    )
    assert told[meet(inside, put).any(1)].all()
    assert not told[
        ~meet(inside, put + 29.1 * np.array([-1, -1, 1, 1])).any(1)
    ].any()  # squares of 580 / 20
    assert 0 < told.sum() < len(told)
