"""Errors of a network's answers, from answers that are typed in."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from codesign.network import NetworkPrediction
from codesign.train import assess
from codesign.train.assess import SensorFrames


def frames(mask, slip):
    """Three frames of 5 x 5 pixels in batches of two."""
    return SensorFrames(torch.zeros(3, 1, 5, 5), mask, slip, 2, torch.zeros(3, 7, 7))


BLANK = frames(torch.zeros(3, 5, 5), torch.zeros(3, 3))


class Typed(torch.nn.Module):
    """Answers in the units of its scale, frame by frame."""

    def __init__(self, slip, logits):
        super().__init__()
        self.slip, self.logits, self.at = slip, logits, 0
        self.unused = torch.nn.Linear(1, 1)

    def forward(self, frames, architecture):
        assert not self.training  # judged frames move no running means
        part = slice(self.at, self.at + len(frames))
        self.at += len(frames)
        slip, depth = self.slip[part], torch.zeros(len(frames), 2, 7, 7)
        return NetworkPrediction(
            self.logits[part], slip[:, :2], slip, depth, slip, slip[:, None, :2], slip
        )


def test_answers_are_scaled_and_errors_are_means_over_frames():
    truth = torch.tensor([[0.3, -0.2, 1.1], [-0.6, 0.4, 0.2], [0.1, 0.9, -1.5]])
    off = torch.tensor([[0.1, -0.3, 0.7], [-0.2, 0.1, -0.4], [0.3, 0.8, 0.1]])
    scale = torch.tensor([0.5, 2.0, 4.0])
    logits, mask = -torch.ones(3, 5, 5), torch.zeros(3, 5, 5)
    # 10 and 10 pixels, 5 of them shared: 5 of 15
    logits[0, :2], mask[0, 1:3] = (1.0, 1.0)
    logits[1, 0] = mask[1, 0] = 1.0
    seen = frames(mask, truth)
    net = Typed((truth + off) / scale, logits)
    inner = SimpleNamespace(slip_scale_mm=scale.tolist(), axis_weight=1.0)
    got = assess.predict_frames(net, None, seen, inner)
    assert net.training
    error = (got.slip_mm - truth).abs().mean(0)
    assert float(error[2]) == pytest.approx((0.7 + 0.4 + 0.1) / 3)
    assert float(error[:2].mean()) == pytest.approx(
        (0.1 + 0.2 + 0.3 + 0.3 + 0.1 + 0.8) / 6
    )
    # two empty masks agree
    assert float(got.iou.mean()) == pytest.approx((1 / 3 + 1 + 1) / 3)


def test_standard_deviations_come_in_millimetres(monkeypatch):
    """exp of the logarithm times the scale of each axis; two batches in a row; depths
    as they are told.
    """
    log_sd = torch.tensor([[-1.0, 0.3, 0.5], [0.2, -0.4, 1.1], [0.0, 0.7, -2.0]])
    depth = torch.arange(3 * 2 * 4.0).reshape(3, 2, 2, 2)
    scale = torch.tensor([0.5, 2.0, 4.0])

    class Sure(Typed):
        def forward(self, frames, architecture):
            part = slice(self.at, self.at + len(frames))
            found = super().forward(frames, architecture)
            return replace(found, depth=depth[part], slip_log_sd=log_sd[part])

    net = Sure(torch.ones(3, 3), -torch.ones(3, 5, 5))
    got = assess.predict_frames(
        net, None, BLANK, SimpleNamespace(slip_scale_mm=scale.tolist(), axis_weight=1.0)
    )
    assert torch.allclose(got.slip_sd_mm, torch.exp(log_sd) * scale)
    assert torch.allclose(got.slip_mm, scale.expand(3, 3))
    assert torch.equal(got.depth, depth)


def test_an_axis_is_a_unit_vector_and_none_where_nothing_trained_it():
    class Turned(Typed):
        def forward(self, frames, architecture):
            found = super().forward(frames, architecture)
            axis = torch.tensor([[0.3, -0.4, 1.2]]).expand(len(frames), 3)
            return replace(found, axis=axis)

    told = [
        assess.predict_frames(
            Turned(torch.ones(3, 3), -torch.ones(3, 5, 5)),
            None,
            BLANK,
            SimpleNamespace(slip_scale_mm=(1.0,) * 3, axis_weight=weight),
        ).axis
        for weight in (0.5, 0.0)
    ]
    assert torch.allclose(told[0], torch.tensor([[3.0, -4.0, 12.0]]).expand(3, 3) / 13)
    assert told[1] is None
