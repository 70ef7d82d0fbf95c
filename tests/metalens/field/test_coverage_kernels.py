"""Coverage takes the first kernels of a patch, as many as that patch asks for."""

from types import SimpleNamespace

import torch

from metalens.field import together


def test_each_patch_takes_its_own_number_of_kernels():
    few = [SimpleNamespace(coverage=n) for n in (1, 3, 2)]
    weights = torch.arange(1.0, 3 * 5 + 1).reshape(3, 5, 1, 1, 1, 1)
    taken = together._covering(few, weights)[..., 0, 0, 0, 0]
    assert taken.tolist() == [[1, 0, 0], [6, 7, 8], [11, 12, 0]]
