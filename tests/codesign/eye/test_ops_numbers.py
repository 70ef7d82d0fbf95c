"""Arithmetic of the scene model by closed forms, pictures of unlike pixels included."""

import numpy as np
import pytest
import torch

from codesign.eye import ops

BANK = torch.tensor(np.random.default_rng(3).uniform(1, 9, (3, 4, 4)))


def smooth(x):
    return x * x * (3 - 2 * x)


def test_a_step_is_smooth_between_minus_one_and_one():
    """t = (1 + x) / 2; t² (3 - 2 t); its slope at the middle is 3/4."""
    x = torch.tensor(
        [-3.0, -1.0, -0.4, 0.0, 0.7, 1.0, 2.5], dtype=torch.float64, requires_grad=True
    )
    found = ops.step(x)
    assert found.tolist() == pytest.approx([0, 0, smooth(0.3), 0.5, smooth(0.85), 1, 1])
    found.sum().backward()
    assert x.grad[[0, 2, 3, 4, 6]].tolist() == pytest.approx(
        [0, 3 * 0.3 * 0.7, 0.75, 3 * 0.85 * 0.15, 0]
    )


def test_values_are_held():
    x = torch.tensor([-0.5, 0.25, 1.75])
    assert ops.unit(x).tolist() == [0, 0.25, 1]
    assert ops.above(x, 0.5).tolist() == [0.5, 0.5, 1.75]
    assert ops.sqrt(torch.tensor([2.25])).tolist() == [1.5]


@pytest.mark.parametrize(
    ("u", "v"), [(1.3, 2.6), (3.7, 0.2), (-0.4, 3.9), (6.2, -5.8), (2.0, 1.0)]
)
def test_a_picture_is_read_between_its_pixels_and_over_its_rim(u, v):
    """Row v, column u, both modulo 4; blended by smooth steps along each."""
    i, j = int(np.floor(u)), int(np.floor(v))
    s, t = smooth(u - i), smooth(v - j)
    for k in (0, 2):
        at = [
            [float(BANK[k, (j + dy) % 4, (i + dx) % 4]) for dx in (0, 1)]
            for dy in (0, 1)
        ]
        rows = [row[0] * (1 - s) + row[1] * s for row in at]
        found = ops.tex(
            BANK,
            torch.tensor([float(k)]),
            *(torch.tensor([a], dtype=torch.float64) for a in (u, v)),
        )
        assert found.item() == pytest.approx(rows[0] * (1 - t) + rows[1] * t, rel=1e-12)
