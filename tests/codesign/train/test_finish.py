"""Numbers of a finished run, from answers that are typed in."""

import math
from types import SimpleNamespace

import pytest
import torch

from codesign.train import finish


def test_errors_of_slippage_are_means_over_frames_of_each_axis():
    truth = torch.tensor([[0.1, 0.5, 1.0], [0.2, -0.3, 2.0], [0.0, 0.0, -1.0]])
    off = torch.tensor([[0.3, -0.2, 0.7], [-0.6, 0.1, 0.2], [0.0, 0.9, -1.5]])
    answers = SimpleNamespace(slip_mm=truth + off, iou=torch.tensor([0.9, 0.4, 0.8]))
    got = finish._errors("dim_", answers, SimpleNamespace(slip_mm=truth))
    assert got["dim_axial_slip_mm"] == pytest.approx(0.8)
    assert got["dim_lateral_slip_mm"] == pytest.approx((0.3 + 0.4) / 2)
    assert got["dim_iou"] == pytest.approx(0.7)
    blind = SimpleNamespace(slip_mm=truth, iou=torch.tensor([math.nan]))
    assert finish._errors("", blind, SimpleNamespace(slip_mm=truth))["iou"] is None
