"""Statistics of a norm that are measured for one network: means over batches of each
channel's own.
"""

import numpy as np
import pytest
import torch

from codesign.network.supernet import SlicedNorm


def test_measured_statistics_are_means_over_batches_and_variances_without_bias():
    """Of five channels three are in use. By numpy, divided by one less than the number
    of values.
    """
    norm, draw = SlicedNorm(5), np.random.default_rng(4)
    norm.measuring = True
    batches = [draw.normal(2.3, 1.7, (n, 3, 2, 3)) for n in (1, 2, 4)]
    for one in batches:
        norm(torch.tensor(one, dtype=torch.float32))
    mean = np.mean([one.mean((0, 2, 3)) for one in batches], axis=0)
    variance = np.mean([one.var((0, 2, 3), ddof=1) for one in batches], axis=0)
    assert norm.mean[:3].numpy() == pytest.approx(mean, rel=1e-5)
    assert norm.variance[:3].numpy() == pytest.approx(variance, rel=1e-5)
