"""Sheets of a patch weighted for its kernels: cubics between the depths, pixel by
pixel, no two alike.
"""

import numpy as np
import pytest
import torch
from torch.autograd import forward_ad

from metalens.field.compiled import plain, power, weigh

draw = np.random.default_rng(15)


@pytest.mark.parametrize("lit", [True, False])
@pytest.mark.parametrize("depths", [6, 3, 2, 1])
def test_every_pixel_takes_the_weights_of_its_own_depth(depths, lit):
    """Through the four nodes about a place (or all there are): the polynomial there,
    and nothing else.
    """
    high, wide, rank, few, first = 5, 4, 7, 2, 3
    content = draw.uniform(0.2, 1, (2, 3, high, wide)).astype(np.float32)
    content[1, 2, 2, 3], content[1, 2, 1, 1] = 0, 1
    place = draw.uniform(0, max(depths - 1, 0.5), content.shape).astype(np.float32)
    table = draw.normal(size=(high * wide, depths, rank)).astype(np.float32)
    energy = draw.uniform(0.5, 1, (high * wide, depths)).astype(np.float32)
    held = np.array([[1, 2], [0, 1], [1, 0]])
    out = np.full((high, few, len(held), wide), np.nan, np.float32)
    depths_first = tuple(
        np.ascontiguousarray(np.moveaxis(t, 0, -1)) for t in (table, energy)
    )
    weigh(content, place, held, depths_first, lit, first, out)
    n = min(4, depths)
    for job, (f, s) in enumerate(held):
        for y, x in np.ndindex(high, wide):
            at, pixel = float(place[f, s, y, x]), y * wide + x
            start = min(max(int(at) - (n // 2 - 1), 0), depths - n)
            nodes = np.arange(start, start + n)
            taps = [
                np.prod([(at - o) / (i - o) for o in nodes if o != i]) for i in nodes
            ]
            want = (
                taps
                @ table[pixel, nodes, first : first + few].astype(float)
                * content[f, s, y, x]
            )
            want = want * (taps @ energy[pixel, nodes].astype(float)) if lit else want
            assert out[y, :, job, x] == pytest.approx(
                want, abs=3e-6
            )  # float32 sums of numbers of 3


def test_power_is_the_square_of_the_field_of_any_shape():
    field = (draw.normal(size=(3, 4, 5)) + 1j * draw.normal(size=(3, 4, 5))).astype(
        np.complex64
    )[:, ::2]
    assert power(field) == pytest.approx(np.abs(field.astype(complex)) ** 2, rel=1e-6)
    assert power(field).shape == (3, 2, 5)


def test_values_with_derivatives_or_in_double_precision_are_not_for_compiled_loops():
    one = torch.ones(3)
    assert plain(one)
    assert plain(one.to(torch.complex64))
    assert not plain(one.double())
    assert not plain(one.clone().requires_grad_())
    assert not plain(one.to("meta"))
    with forward_ad.dual_level():
        assert not plain(forward_ad.make_dual(one, one))
