"""The line of an edge by hand, where two steps share a row and where rows are unlike."""

import math

import numpy as np
import pytest

from characterize.measure import metrics

COLUMNS = np.arange(90)


def test_a_line_goes_to_the_steeper_of_two_edges_by_the_square_and_lets_go_of_the_other():
    """Steps seen through the slope of a Gaussian of one pixel, summed pixel by pixel:
    of variance 1 - 1/12, squared of
    half that. A Gaussian of the distance to the line before (12, 8, 6 pixels) takes its
    part of each."""
    square = (1 - 1 / 12) / 2
    steps = {37.5: 9.0, 50.5: -7.0}  # up and down
    pixels = np.tile(sum(size * (at < COLUMNS) for at, size in steps.items()), (6, 1))
    centre = sum(size**2 * at for at, size in steps.items()) / sum(
        size**2 for size in steps.values()
    )
    for reach in (12.0, 8.0, 6.0):
        far = {at: (at - centre) ** 2 / (reach**2 + square) for at in steps}
        share = {at: size**2 * math.exp(-far[at] / 2) for at, size in steps.items()}
        place = {
            at: (at / square + centre / reach**2) / (1 / square + 1 / reach**2)
            for at in steps
        }
        centre = sum(share[at] * place[at] for at in steps) / sum(share.values())
    slope, offset = metrics._edge_line(pixels, np.arange(6))
    assert slope == pytest.approx(0, abs=1e-12)
    assert offset == pytest.approx(
        centre, abs=2e-3
    )  # squared slopes are Gaussians but for their fourth moment
    assert 37.6 < centre < 40


@pytest.mark.parametrize(("height", "counts"), [(0.30, False), (0.34, True)])
def test_a_row_whose_squared_slope_is_a_tenth_of_the_others_has_no_part_in_the_line(
    height, counts
):
    """0.3² is less than a tenth of most, 0.34² is more, whatever one has; two rows'
    edges lie a pixel to the right.
    """
    rows = np.arange(9)
    edge = np.where(rows < 2, 41.5, 40.5)
    contrast = np.where(rows < 2, height, 1.0)
    contrast[8] = 4.0
    pixels = contrast[:, None] * (edge[:, None] < COLUMNS)
    seen = rows if counts else rows[2:]
    slope, offset = metrics._edge_line(pixels, rows)
    want = np.polyfit(seen, edge[seen], 1)
    assert (slope, offset) == pytest.approx(
        tuple(want), abs=0.02
    )  # 1 / (2 x 6²) of a pixel towards the line before
    assert abs(np.polyfit(rows, edge, 1)[0]) > 0.1


def test_the_steepest_sample_at_the_rim_is_its_own_top():
    """No parabola along an axis whose rim it lies on; along the other as ever."""
    light = np.array([[1.0, 4.0, 3.0], [0.5, 1.0, 0.7]])
    height, (dy, dx) = metrics._parabola(light, 0, 1)
    bend = 1.0 - 8.0 + 3.0
    assert (dy, dx) == pytest.approx((0.0, 0.5 * (1.0 - 3.0) / bend))
    assert height == pytest.approx(4.0 - (1.0 - 3.0) ** 2 / (8 * bend))
    turned, (dy, dx) = metrics._parabola(light[::-1, ::-1], 1, 1)
    assert (turned, dy, dx) == pytest.approx((height, 0.0, -0.5 * (1.0 - 3.0) / bend))
    lying, (dy, dx) = metrics._parabola(light.T[::-1, ::-1], 1, 1)
    assert (lying, dy, dx) == pytest.approx((height, -0.5 * (1.0 - 3.0) / bend, 0.0))
    assert metrics._parabola(np.full((3, 3), 2.0), 1, 1) == (2.0, (0.0, 0.0))


def test_strehl_of_spots_of_unlike_width_is_that_of_their_areas():
    """Of equal light, a Gaussian twice and half as wide has a third of the peak."""
    y, x = np.mgrid[-30:31, -40:41]

    def spot(sx, sy):
        return np.exp(-((x - 0.2) ** 2) / (2 * sx**2) - (y + 0.3) ** 2 / (2 * sy**2))

    found = metrics.strehl_ratio(7.0 * spot(6.0, 7.5), spot(3.0, 5.0))
    assert found == pytest.approx(
        3.0 * 5.0 / (6.0 * 7.5), rel=2e-3
    )  # parabola: (1/3)^4 / 24 at 0.3 samples
