"""Sources of a patch weighted for every kernel: cubics between the depths, pixel by pixel, no two alike."""

import numpy as np
import pytest

from metalens.field.compiled import weighted

draw = np.random.default_rng(15)


@pytest.mark.parametrize("depths", [6, 3])
def test_every_pixel_takes_the_weights_of_its_own_depth(depths):
    """Through the four nodes about a place (or all three): the polynomial there, and nothing else."""
    high, wide, rank, few = 5, 4, 3, 2
    light, cover = (draw.uniform(0.2, 1, (2, 2, high, wide)).astype(np.float32) for _ in range(2))
    light[0, 1, 2, 3] = cover[0, 1, 2, 3] = 0
    place = draw.uniform(0, depths - 1, light.shape).astype(np.float32)
    table = draw.normal(size=(high * wide, depths, rank)).astype(np.float32)
    energy = draw.uniform(0.5, 1, (high * wide, depths)).astype(np.float32)
    got, covered = weighted((light, cover, place), (table, energy), (7, 6), few)
    n = min(4, depths)
    for f, s, y, x in np.ndindex(light.shape):
        first = min(max(int(place[f, s, y, x]) - (n // 2 - 1), 0), depths - n)
        nodes, pixel = np.arange(first, first + n), y * wide + x
        rows = np.concatenate([table[pixel], energy[pixel, :, None]], axis=1)[nodes]
        *weights, level = (
            np.polynomial.Polynomial.fit(nodes, row, n - 1)(float(place[f, s, y, x])) for row in rows.T.astype(float)
        )
        want = np.array(weights) * level * light[f, s, y, x]
        assert got[:, f, s, y, x] == pytest.approx(want, abs=3e-6)  # float32 sums of numbers of 3
        assert covered[:, f, s, y, x] == pytest.approx(np.array(weights[:few]) * cover[f, s, y, x], abs=3e-6)
    assert not got[:, :, :, high:].any()
    assert not got[..., wide:].any()
