"""Sheets weighted for every kernel, by plain numpy: the weight at the nearest code of
1/z, borders continued.
"""

import numpy as np
import pytest

from metalens.image.sources import weigh_sources

NEAR, FAR = 18.0, 150.0


def test_light_and_coverage_take_the_weight_of_their_depth():
    """Codes lie at equal steps of 1/z; depths beyond the ends take those of the ends."""
    rng = np.random.default_rng(8)
    light, cover = rng.uniform(0.1, 2.0, (2, 3, 2, 5, 7)).astype(np.float32)
    depth = rng.uniform(12.0, 260.0, light.shape).astype(np.float32)
    table = rng.normal(size=(4, 23)).astype(np.float32)
    out = weigh_sources(light, cover, depth, table, ends_um=(NEAR, FAR), shape=(9, 12))
    place = (
        np.clip((1 / NEAR - 1 / depth.astype(float)) / (1 / NEAR - 1 / FAR), 0, 1) * 22
    )
    clear = np.abs(place % 1 - 0.5) > 1e-4  # of two codes rounding takes either
    weight = table[:, np.floor(place + 0.5).astype(int)]
    assert out.shape == (4, 3, 2, 2, 9, 12)
    for k, kind in enumerate((light, cover)):
        want = np.where(clear, weight * kind, 0)
        assert np.where(clear, out[:, :, k, :, :5, :7], 0) == pytest.approx(
            want, rel=1e-5
        )


def test_spare_rows_and_columns_continue_the_nearer_border():
    """5 rows in 9: two more of the last, two of the first; 7 columns in 12: three and
    two.
    """
    light = np.arange(1.0, 36.0, dtype=np.float32).reshape(1, 1, 5, 7).repeat(2, 1)
    depth = np.full(light.shape, 40.0, np.float32)
    out = weigh_sources(
        light,
        light,
        depth,
        np.full((1, 9), 0.7, np.float32),
        ends_um=(NEAR, FAR),
        shape=(9, 12),
    )
    rows, columns = [0, 1, 2, 3, 4, 4, 4, 0, 0], [0, 1, 2, 3, 4, 5, 6, 6, 6, 6, 0, 0]
    assert out[0, 0, 0, 1] == pytest.approx(
        0.7 * light[0, 0][np.ix_(rows, columns)], rel=1e-6
    )
