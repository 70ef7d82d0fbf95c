"""Rectilinear polygons in rectangles, others in boxes, boxes in pieces: counted unit by
unit and by closed forms.
"""

import numpy as np
import pytest

from layout.shapes import rectilinear
from metalens.ground.errors import ProcessError

# an L with a notch from below; and two arms of unlike height
NOTCHED = np.array(
    [[0, 0], [3, 0], [3, 2], [5, 2], [5, 0], [9, 0], [9, 4], [6, 4], [6, 7], [0, 7]]
)
ARMS = np.array([[-4, -3], [8, -3], [8, 5], [6, 5], [6, 1], [-1, 1], [-1, 9], [-4, 9]])


def inside(shape, x, y):
    """Whether the middles of unit squares lie in a polygon: edges crossed on the way to
    +x.
    """
    start, end = shape, np.roll(shape, -1, axis=0)
    upright = start[:, 0] == end[:, 0]
    low, high = np.minimum(start, end)[upright, 1], np.maximum(start, end)[upright, 1]
    crossed = (
        (start[upright, 0] > x[..., None])
        & (low < y[..., None])
        & (y[..., None] < high)
    )
    return crossed.sum(-1) % 2 == 1


@pytest.mark.parametrize(
    "shape",
    [NOTCHED, ARMS, NOTCHED[::-1], np.roll(ARMS, 3, axis=0)],
    ids=["notched", "arms", "clockwise", "begun later"],
)
def test_rectangles_cover_every_unit_of_a_polygon_once(shape):
    x, y = np.meshgrid(np.arange(-6, 12) + 0.5, np.arange(-6, 12) + 0.5)
    times = np.zeros(x.shape, int)
    found = rectilinear.rectangles(shape)
    for left, bottom, right, top in found.tolist():
        assert left < right
        assert bottom < top
        times += (left < x) & (x < right) & (bottom < y) & (y < top)
    assert np.array_equal(times, inside(shape, x, y).astype(int))
    assert np.array_equal(rectilinear.covering(shape), found)


def test_slabs_of_a_notched_shape():
    want = [[0, 0, 3, 2], [5, 0, 9, 2], [0, 2, 9, 4], [0, 4, 6, 7]]
    assert rectilinear.rectangles(NOTCHED).tolist() == want


def test_a_slanted_edge_is_refused_where_rectangles_are_asked_for():
    with pytest.raises(ProcessError, match="slanted edges"):
        rectilinear.rectangles(np.array([[0, 0], [4, 0], [4, 3], [1, 4]]))


@pytest.mark.parametrize(
    ("shape", "count"),
    [
        ([[1000, 0], [31_000, 6000], [5000, 20_000]], 4),
        ([[0, 0], [30_000, 0], [0, 20_000]], 4),
        ([[0, -7000], [9000, 2999], [-4000, 1500]], 1),
        ([[0, 0], [9000, 0], [9000, 7000], [4000, 10_000], [0, 7000]], 2),
        ([[0, 0], [700_000, 100], [0, 640_001]], 64),
    ],
)
def test_slices_of_a_slanted_shape_are_as_wide_as_it_is_there(shape, count):
    """Against 50 000 points along each edge: rounded outwards to whole units, and to
    the next point.
    """
    shape = np.array(shape)
    share = np.linspace(0, 1, 50_001)[:, None]
    edge = np.concatenate(
        [
            a + share * (b - a)
            for a, b in zip(shape, np.roll(shape, -1, axis=0), strict=True)
        ]
    )
    step = 1 + np.ptp(shape, axis=0).max() / 50_000
    found = rectilinear.covering(shape)
    ends = np.linspace(shape[:, 1].min(), shape[:, 1].max(), count + 1)
    assert len(found) == count
    assert found[:, 1].tolist() == np.floor(ends[:-1]).tolist()
    assert found[:, 3].tolist() == np.ceil(ends[1:]).tolist()
    for (left, _, right, _), low, high in zip(
        found.tolist(), ends[:-1], ends[1:], strict=True
    ):
        x = edge[(edge[:, 1] >= low) & (edge[:, 1] <= high), 0]
        assert 0 <= x.min() - left <= step
        assert 0 <= right - x.max() <= step


def test_boxes_are_cut_evenly_on_the_grid():
    """Sides of 10 in pieces of 4 at most: three of 10 / 3, on a grid of 2 at 0, 4, 6,
    10; a side of 8 is cut in two.
    """
    boxes = np.array([[100, -6, 110, 2], [0, 0, 3, 3]])
    pieces, of = rectilinear.cut(boxes, 4.0, 2)
    columns, rows = [(100, 104), (104, 106), (106, 110)], [(-6, -2), (-2, 2)]
    assert pieces[:6].tolist() == [[a, c, b, d] for a, b in columns for c, d in rows]
    assert of.tolist() == [0] * 6 + [1] * (len(of) - 6)
    assert pieces[6:].tolist() == [[0, 0, 4, 4]]  # 3 is rounded to the grid
    none, of = rectilinear.cut(np.zeros((0, 4)), 4.0, 2)
    assert (none.shape, of.shape) == ((0, 4), (0,))
    exact, _ = rectilinear.cut(np.array([[0, 0, 8, 4]]), 4.0, 1)
    assert exact.tolist() == [[0, 0, 4, 4], [4, 0, 8, 4]]


def test_corners_run_counter_clockwise():
    assert rectilinear.corners([1, 2, 5, 9]).tolist() == [
        [1, 2],
        [5, 2],
        [5, 9],
        [1, 9],
    ]
