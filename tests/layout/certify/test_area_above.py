"""Area of a picture above a level, of planes over pictures that are not square."""

import numpy as np
import pytest

from layout.certify.raster import _areas


@pytest.mark.parametrize(("rows", "columns"), [(4, 11), (9, 3)])
def test_the_area_above_a_level_of_a_plane_is_that_beyond_its_line(rows, columns):
    """Of 0.3 x the part beyond v / 0.3; of a plane turned to both axes, by a million
    points.
    """
    y, x = np.mgrid[:rows, :columns].astype(float)
    levels = np.array([0.53, 0.21, -0.1])
    got = _areas(0.3 * x, levels)
    wide = columns - 1 - np.maximum(levels, 0) / 0.3
    assert got == pytest.approx((rows - 1) * np.clip(wide, 0, None), abs=1e-12)
    fine = (
        0.001 * (rows - 1) * (np.arange(1000) + 0.5),
        0.001 * (columns - 1) * (np.arange(1000) + 0.5),
    )
    plane = 0.21 * fine[1][None] - 0.13 * fine[0][:, None]
    for level, found in zip(levels, _areas(0.21 * x - 0.13 * y, levels), strict=True):
        want = (plane > level).mean() * (rows - 1) * (columns - 1)
        assert found == pytest.approx(
            want, abs=2e-3 * (rows + columns)
        )  # a strip of half a point along the line
