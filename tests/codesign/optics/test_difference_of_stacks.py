"""The difference of two stacks of PSFs, whatever their light."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.optics import built


def test_stacks_of_unlike_light_differ_by_the_rms_of_their_shapes_over_the_second():
    draw = np.random.default_rng(6)
    one, other = draw.uniform(0.1, 3, (2, 3, 7, 8)), draw.uniform(0.1, 3, (2, 3, 7, 8))
    shapes = [a / a.sum((-2, -1), keepdims=True) for a in (one, other)]
    want = np.sqrt(((shapes[0] - shapes[1]) ** 2).sum() / (shapes[1] ** 2).sum())
    stacks = [
        SimpleNamespace(intensity=torch.tensor(a * f))
        for a, f in ((one, 3.1e4), (other, 0.7))
    ]
    assert built.psf_error(*stacks) == pytest.approx(want, rel=1e-12)
