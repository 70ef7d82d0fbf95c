"""Rates of what training moves, over the part of the run in which it moves; the pitch
between its bounds.
"""

import math

import pytest
import torch

from codesign.train import moving
from codesign.train.moving import LearningRateSchedule


@pytest.mark.parametrize(
    ("inside", "share"),
    [
        (0.0, 0.01),  # a hundredth to begin with
        (0.03, 0.31),
        (0.09, 0.91),
        (0.0995, 1.0),  # all from a tenth on
        (0.5, 1.0),
        (0.97, 1.0),
    ],
)
def test_rates_warm_up_over_a_tenth_and_fall_as_a_cosine(inside, share):
    """From 0.3 to 0.8 of the run: nothing before, and nothing from its end on."""
    made = LearningRateSchedule(0.07, 0.3, 0.8)
    want = 0.07 * share * math.cos(math.pi * inside / 2) ** 2
    assert made.at(0.3 + 0.5 * inside + 1e-15) == pytest.approx(want, rel=1e-9)
    assert (made.at(0.2999), made.at(0.8), made.at(0.95)) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("pitch", "held", "then"), [(3.1, 4.5, 4.5), (61.0, 40.0, 40.0), (17.0, None, 17.0)]
)
def test_the_pitch_is_brought_back_between_its_bounds(pitch, held, then):
    log = torch.nn.Parameter(torch.tensor(math.log(pitch), dtype=torch.float64))
    made = moving.TrainedModel(None, torch.nn.Parameter(torch.zeros(2)), log)
    assert made.hold(4.5, 40.0) == held
    assert float(made.pitch_um.detach()) == pytest.approx(then, rel=1e-12)
