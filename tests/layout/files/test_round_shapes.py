"""Circles of a file as polygons: of their area, about their middle, as round as 64
corners are.
"""

import math

import numpy as np
import pytest

from layout.files import flat


@pytest.mark.parametrize(
    ("x", "y", "radius"), [(-4100, 730, 5300), (12, -9000, 80_000)]
)
def test_a_circle_is_a_polygon_of_its_area_about_its_middle(x, y, radius):
    corners = flat.circle(x, y, radius).astype(float)
    assert corners.shape == (64, 2)
    nx, ny = np.roll(corners, -1, 0).T
    cross = corners[:, 0] * ny - nx * corners[:, 1]
    assert cross.sum() / 2 == pytest.approx(
        math.pi * radius**2, rel=4 / radius
    )  # corners on whole units
    assert corners.mean(0) == pytest.approx([x, y], abs=0.5)
    reach = np.hypot(*(corners - [x, y]).T)
    assert reach.max() - reach.min() < 2
    assert reach.mean() / radius == pytest.approx(
        math.sqrt(2 * math.pi / 64 / math.sin(2 * math.pi / 64)), abs=1 / radius
    )
