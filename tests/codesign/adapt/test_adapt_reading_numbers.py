"""Errors of a network frame by frame: means of four frames typed in, and an interval of
draws done by hand.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.adapt.reading import Accuracy, accuracy, bootstrap

ERROR_MM = torch.tensor(
    [[0.1, 0.5, 0.9], [0.3, 0.7, 2.0], [0.2, 0.2, 0.5], [0.8, 0.4, 1.4]]
)
IOU = torch.tensor([0.9, 0.5, 0.8, 0.6])


def test_means_are_over_frames_and_over_the_axes_that_they_name():
    """Columns sum to 1.4, 1.8 and 4.8 over four frames."""
    read = Accuracy(ERROR_MM, IOU)
    assert read.slip_mm == pytest.approx(8.0 / 12, rel=1e-6)  # float32, as all below
    assert read.axial_mm == pytest.approx(4.8 / 4, rel=1e-6)
    assert read.lateral_mm == pytest.approx(3.2 / 8, rel=1e-6)
    told = read.values()
    assert (told["slip_mm"], told["axial_mm"], told["lateral_mm"]) == (
        read.slip_mm,
        read.axial_mm,
        read.lateral_mm,
    )
    assert told["iou"] == pytest.approx(2.8 / 4, rel=1e-6)
    assert (told["slip_low_mm"], told["slip_high_mm"]) == read.interval_mm()


def test_the_interval_is_that_of_the_means_of_frames():
    """Frames err by 0.5, 1.0, 0.3 and 2.6 / 3 mm; of draws of four frames the mean lies
    between the extremes.
    """
    read = Accuracy(ERROR_MM, IOU)
    frames = np.array([0.5, 1.0, 0.3, 2.6 / 3])
    for about in ({}, {"draws": 300}, {"draws": 300, "seed": 7}):
        assert read.interval_mm(**about) == pytest.approx(
            bootstrap(frames, **about), rel=1e-6
        )
    assert read.interval_mm(draws=300) != read.interval_mm(draws=300, seed=7)
    assert read.interval_mm() == read.interval_mm(draws=1000, seed=0)


def test_the_ends_leave_one_in_forty_draws_on_either_side():
    """The draws once more, counted: of 400 means 10 lie below the lower end and 10
    above the upper.
    """
    values = np.array([0.2, 0.9, 1.7, 0.4, 3.1, 0.6, 2.2])
    low, high = bootstrap(values, draws=400, seed=3)
    drawn = np.random.default_rng(3)
    means = [sum(values[k] for k in row) / 7 for row in drawn.integers(0, 7, (400, 7))]
    assert sum(m < low - 1e-12 for m in means) == pytest.approx(
        10, abs=1
    )  # between two neighbours
    assert sum(m > high + 1e-12 for m in means) == pytest.approx(10, abs=1)
    assert low < values.mean() < high


def test_an_error_is_the_distance_from_the_truth_of_its_frame():
    answers = SimpleNamespace(
        slip_mm=torch.tensor([[0.5, -1.0, 3.0]]), iou=torch.tensor([0.7])
    )
    seen = SimpleNamespace(slip_mm=torch.tensor([[0.2, 0.5, 3.5]]), above="too coarse")
    read = accuracy(answers, seen)
    assert torch.allclose(read.error_mm, torch.tensor([[0.3, 1.5, 0.5]]))
    assert (float(read.iou), read.above) == (pytest.approx(0.7), "too coarse")
