"""Pieces of marks and letters: doses for their outer edges, against the convolution of
a raster.
"""

import itertools

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import erf

from layout.pec import rects
from layout.pec.bodies import ExposedRectangles
from layout.pec.psf import PointExposure

ALPHA_UM = 0.05
PIXEL_UM = 0.005
# rows of a letter from the bottom: in pieces of 1.2 um the second ends 10 nm beside the
# middle of a piece
ROWS = [
    [0, 0, 3600, 1200],
    [610, 1200, 3010, 2400],
    [600, 2400, 1500, 3600],
    [2100, 2400, 3300, 3600],
]


def test_edges_of_letters_are_even_where_rows_end_over_a_piece():
    boxes = np.array(
        [
            [left, bottom, right, top]
            for low, bottom, high, top in ROWS
            for left, right in itertools.pairwise(
                np.linspace(low, high, -(-(high - low) // 1200) + 1).astype(int)
            )
        ]
    )
    cut = ExposedRectangles(
        boxes * 1e-3, np.zeros(len(boxes), int), np.ones(len(boxes))
    )
    own, points, piece = rects.self_exposure(
        cut, PointExposure(np.array([ALPHA_UM]), np.array([1.0]))
    )
    assert set(piece.tolist()) == set(range(len(boxes)))
    assert len(points) == len(piece)
    margin = 100  # pixels around the raster: 10 ranges
    image = np.zeros((720 + 2 * margin, 720 + 2 * margin))
    for (left, bottom, right, top), exposure in zip(
        boxes // 5 + margin, own, strict=True
    ):
        image[bottom:top, left:right] = 0.5 / exposure
    field = gaussian_filter(image, ALPHA_UM / np.sqrt(2) / PIXEL_UM, truncate=8)
    inside = image > 0
    corner = int(
        4 * ALPHA_UM / PIXEL_UM
    )  # edges that run straight for four ranges to both sides
    seen = 0
    for flip in (False, True):
        drawn, value = (v.T if flip else v for v in (inside, field))
        edge = drawn[1:] != drawn[:-1]
        straight = np.all(
            [np.roll(edge, k, axis=1) for k in range(-corner, corner + 1)], axis=0
        )
        between = ((value[1:] + value[:-1]) / 2)[
            straight
        ]  # an edge lies between two pixels
        seen += len(between)
        assert between == pytest.approx(
            0.5, abs=0.002
        )  # points lie within 4 ranges of corners: erfc(4), and raster
    assert seen > 2000


@pytest.mark.parametrize("off", [0.0, 1e-12, -1e-12])
def test_a_row_that_ends_over_the_middle_of_a_side_leaves_its_free_half(off):
    boxes = np.array(
        [[0.1, 0.2, 1.3, 0.9], [0.7 + off, 0.9, 2.0, 1.5], [1.3, 0.2, 2.0, 0.9]]
    )
    cut = ExposedRectangles(boxes, np.zeros(3, int), np.ones(3))
    _, points, piece = rects.self_exposure(
        cut, PointExposure(np.array([0.02]), np.array([1.0]))
    )
    first = sorted(map(tuple, points[piece == 0].round(9).tolist()))
    # below, the side runs on to 2.0: of its 0.1 to 1.3 two ranges at the corner count
    # for nothing
    assert first == [(0.1, 0.55), (0.4, 0.9), (0.72, 0.2)]


def test_a_dose_at_the_end_of_an_arm_is_judged_where_the_edge_is_straight():
    """Two ranges (0.1) off the corners; a shorter piece at the nearest such place, runs
    of 0.2 and less nowhere.
    """
    ends = [
        0.0,
        0.07,
        0.16,
        0.5,
    ]  # an arm 1.3 wide in slabs, then a foot of 0.2 at its side
    boxes = np.array([[0.3, low, 1.6, high] for low, high in itertools.pairwise(ends)])
    boxes = np.vstack([boxes, [[1.6, 0.3, 1.8, 0.5]]])
    cut = ExposedRectangles(boxes, np.zeros(4, int), np.ones(4))
    _, points, piece = rects.self_exposure(
        cut, PointExposure(np.array([0.05, 40.0]), np.array([0.6, 0.4]))
    )
    found = [sorted(map(tuple, points[piece == n].round(9).tolist())) for n in range(4)]
    assert found[0] == [(0.3, 0.1), (0.95, 0.0), (1.6, 0.1)]
    assert found[1] == [(0.3, 0.13), (1.6, 0.13)]
    assert found[2] == [
        (0.3, 0.28),
        (1.0, 0.5),
        (1.6, 0.18),
    ]  # the top runs on over the foot, the right one to it
    assert found[3] == [(1.65, 0.5)]
    core = PointExposure(np.array([0.05]), np.array([0.6]))
    assert rects.self_exposure(cut, core)[0][1] == pytest.approx(
        0.6 * (0.5 * erf(0.13 / 0.05) / 2 + 0.25), abs=1e-4
    )


def test_samples_of_rectangles_stand_in_the_middle_of_cells_no_longer_than_a_step():
    """The first in 4 by 2 cells of a quarter, the second, 0.6 by 0.2, in 3 by 1."""
    boxes = np.array([[0.0, 1.0, 1.0, 1.5], [5.0, 5.0, 5.6, 5.2]])
    points, area, of = rects.rectangle_samples(
        ExposedRectangles(boxes, np.zeros(2, int), np.ones(2)), 0.25
    )
    first = [(0.125 + 0.25 * i, 1.125 + 0.25 * j) for j in range(2) for i in range(4)]
    assert points == pytest.approx(
        np.array([*first, (5.1, 5.1), (5.3, 5.1), (5.5, 5.1)]), abs=1e-12
    )
    assert area == pytest.approx([0.0625] * 8 + [0.04] * 3, abs=1e-12)
    assert of.tolist() == [0] * 8 + [1] * 3


def test_pieces_of_a_shape_see_those_within_six_ranges_and_none_of_another():
    """Random boxes of three shapes, against every pair tried: apart by at most 6 widths
    and a tenth of a nanometre.
    """
    rng = np.random.default_rng(11)
    low = rng.uniform(0, 40, (150, 2))
    boxes = np.c_[low, low + rng.uniform(0.1, 9, (150, 2))]
    group = rng.integers(0, 3, 150)
    point = PointExposure(np.array([0.02, 0.7]), np.array([0.8, 0.2]))
    apart = 6 * 0.7 + 1e-4
    gap = np.maximum(
        boxes[:, None, :2] - boxes[None, :, 2:], boxes[None, :, :2] - boxes[:, None, 2:]
    )
    want = np.argwhere((gap <= apart).all(-1) & (group[:, None] == group))
    kept = rects.pairs_near(boxes, group, point)
    np.testing.assert_array_equal(np.stack(kept, -1), want)
    assert 150 < len(want) < 150**2 / 3


def test_no_boxes_have_no_pairs(monkeypatch):
    """Not compiled, so that a place beyond the arrays is refused."""
    monkeypatch.setattr(rects, "_pairs", getattr(rects._pairs, "py_func", rects._pairs))
    point = PointExposure(np.array([0.7]), np.array([1.0]))
    empty = rects.pairs_near(np.empty((0, 4)), np.empty(0), point)
    assert [len(part) for part in empty] == [0, 0]


@pytest.fixture
def interpreted(monkeypatch):
    """The loops not compiled, so that a place beyond the arrays is refused."""
    for name in ("_pairs", "_sum", "_free"):
        loop = getattr(rects, name)
        monkeypatch.setattr(
            rects, name, getattr(loop, "py_func", loop)
        )  # itself where nothing is compiled


def nine():
    """Three by three boxes of unlike sizes that abut, shuffled; which of them is the
    middle one.
    """
    x, y = [0.0, 1.3, 2.4, 4.1], [0.2, 0.9, 2.3, 2.9]
    boxes = np.array(
        [
            [a, b, c, d]
            for b, d in itertools.pairwise(y)
            for a, c in itertools.pairwise(x)
        ]
    )
    order = np.array([4, 2, 7, 0, 8, 5, 1, 6, 3])
    return boxes[order], 0


def by_boxes(x, y, boxes, point):
    """Exposure at one place: for each Gaussian the product of two differences of erf,
    halved.
    """
    return sum(
        weight
        / 4
        * (erf((b[2] - x) / a) - erf((b[0] - x) / a))
        * (erf((b[3] - y) / a) - erf((b[1] - y) / a))
        for a, weight in zip(point.widths_um, point.weights, strict=True)
        for b in boxes
    )


def test_a_piece_within_others_has_the_exposure_of_its_middle_less_half(interpreted):
    """Its middle, (1.85, 1.6), is the point; another shape beside it gives nothing."""
    boxes, middle = nine()
    point = PointExposure(np.array([0.1, 1.7]), np.array([0.6, 0.4]))
    more = np.vstack([boxes, [[5.0, 0.2, 6.0, 2.9]]])
    exposure, at, of = rects.self_exposure(
        ExposedRectangles(more, np.r_[np.zeros(9, int), 1], np.ones(10)), point
    )
    ((x, y),) = at[of == middle]
    assert (x, y) == pytest.approx((1.85, 1.6))
    assert exposure[middle] == pytest.approx(
        by_boxes(1.85, 1.6, boxes, point) / 2, rel=1e-12
    )
    for n in range(9):  # an outer one: the mean over its points
        want = [by_boxes(*place, boxes, point) for place in at[of == n]]
        assert exposure[n] == pytest.approx(
            np.mean(want) * (0.5 if n == middle else 1.0), rel=1e-12
        )


def test_pieces_in_another_order_have_the_same_points(interpreted):
    boxes, _ = nine()
    point = PointExposure(np.array([0.1]), np.array([1.0]))
    first = rects.self_exposure(
        ExposedRectangles(boxes, np.zeros(9, int), np.ones(9)), point
    )
    turned = rects.self_exposure(
        ExposedRectangles(boxes[::-1], np.zeros(9, int), np.ones(9)), point
    )
    assert turned[0][::-1] == pytest.approx(first[0])
    assert sorted(map(tuple, turned[1])) == sorted(map(tuple, first[1]))


def test_without_a_gaussian_there_is_no_exposure_and_an_edge_is_straight_to_its_corner(
    interpreted,
):
    """Two boxes that abut: three free sides each, judged in their middles."""
    boxes = np.array([[0.0, 0.0, 2.0, 1.0], [2.0, 0.0, 3.0, 1.0]])
    none = PointExposure(np.empty(0), np.empty(0))
    exposure, at, of = rects.self_exposure(
        ExposedRectangles(boxes, np.zeros(2, int), np.ones(2)), none
    )
    assert exposure.tolist() == [0.0, 0.0]
    assert sorted(map(tuple, at[of == 0])) == [(0.0, 0.5), (1.0, 0.0), (1.0, 1.0)]
    assert sorted(map(tuple, at[of == 1])) == [(2.5, 0.0), (2.5, 1.0), (3.0, 0.5)]


def test_one_box_alone_has_four_sides(interpreted):
    point = PointExposure(np.array([0.05]), np.array([1.0]))
    exposure, at, of = rects.self_exposure(
        ExposedRectangles(
            np.array([[0.0, 0.0, 3.0, 2.0]]), np.zeros(1, int), np.ones(1)
        ),
        point,
    )
    assert sorted(map(tuple, at)) == [(0.0, 1.0), (1.5, 0.0), (1.5, 2.0), (3.0, 1.0)]
    assert of.tolist() == [0] * 4
    assert exposure == pytest.approx([0.5])
    nothing = rects.self_exposure(
        ExposedRectangles(np.empty((0, 4)), np.empty(0, int), np.empty(0)), point
    )
    assert [part.shape for part in nothing] == [(0,), (0, 2), (0,)]


@pytest.mark.parametrize("across", [(0.2, 19.6), (0.2, 19.6, -1.1, 0.9)])
def test_exposure_at_crossings_has_lines_of_y_before_those_of_x(interpreted, across):
    """Fewer and more of them than the three of y, in one row, of the boxes that it
    sees: all but the second. Far lines
    have boxes there."""
    boxes = np.array(
        [
            [0.0, 0.0, 1.0, 2.0],
            [1.0, 0.0, 2.0, 3.0],
            [-2.0, 1.0, -0.5, 4.0],
            [19.0, 0.0, 20.0, 1.0],
            [0.0, 30.0, 1.0, 31.0],
        ]
    )
    point = PointExposure(np.array([0.8, 1.9]), np.array([0.7, 0.3]))
    x, y = np.array([across]), np.array([[0.3, 1.1, 30.2]])
    pairs = np.array([4, 5, 5, 5, 5, 6]), np.array([1, 0, 2, 3, 4, 1])
    got = rects.sums_of_boxes(x, y, np.array([5]), boxes, pairs, point)
    want = [[by_boxes(a, b, boxes[[0, 2, 3, 4]], point) for a in x[0]] for b in y[0]]
    assert got.shape == (1, 3, len(across))
    assert got[0] == pytest.approx(np.array(want), rel=1e-12)


def test_what_neighbours_leave_of_a_side_are_its_free_parts(interpreted):
    """On top two that cover 1 to 2 and 3 to 3.9, on the right one from 0.5 to the top
    less half of 0.1 nm.
    """
    boxes = np.array(
        [
            [0.0, 0.0, 5.0, 2.0],
            [3.0, 2.0, 3.9, 3.0],
            [1.0, 2.0, 2.0, 3.0],
            [5.0, 0.5, 6.0, 2.0 - 5e-5],
        ]
    )
    none = PointExposure(np.empty(0), np.empty(0))
    _, at, of = rects.self_exposure(
        ExposedRectangles(boxes, np.zeros(4, int), np.ones(4)), none
    )
    top = [(0.5, 2.0), (2.5, 2.0), (4.45, 2.0)]
    assert sorted(map(tuple, at[of == 0].round(9))) == sorted(
        [(0.0, 1.0), (2.5, 0.0), (5.0, 0.25), *top]
    )
