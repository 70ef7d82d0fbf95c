"""What an exported graph says, before it is one: standardised frames in, lengths and
angles out.
"""

import math
from types import SimpleNamespace

import pytest
import torch
from torch import nn

from codesign.network.exported import OPSET, OUTPUTS, ExportedNetwork, OutputScale

SCALE = OutputScale(frame_mm=1.7, slip_mm=(2.0, 3.0, 5.0), elevation_rad=0.35)


class Net(nn.Module):
    """Answers with numbers; keeps what it was shown."""

    def forward(self, frames, architecture):
        self.shown = frames, architecture
        n = len(frames)
        return SimpleNamespace(
            mask_logits=torch.full((n, 4, 4), -0.3),
            centre=torch.tensor([[0.2, -0.1]]).expand(n, 2),
            slip=torch.tensor([[0.5, -0.25, 0.125]]).expand(n, 3),
            slip_log_sd=torch.tensor([[0.0, 1.0, -1.0]]).expand(n, 3),
            points=torch.linspace(-0.4, 0.6, 20).view(1, 10, 2).expand(n, 10, 2),
            axis=torch.tensor([AXIS]).expand(n, 3),
        )


AXIS = [0.3, -0.2, -0.9]


def told(scale=SCALE, frames=None):
    made = object.__new__(ExportedNetwork)
    nn.Module.__init__(made)
    made.net, made.scale = SimpleNamespace(net=Net(), architecture="member"), scale
    out = made.forward(torch.rand(2, 1, 5, 5) if frames is None else frames)
    return dict(zip(scale.outputs, out, strict=True)), made.net.net.shown


def test_frames_come_to_mean_nothing_and_deviation_one_whatever_their_unit():
    """Deviations of 25 pixels are over 24; an even frame is divided by 1e-6 at least
    and stays even.
    """
    plain = torch.rand(2, 1, 5, 5, dtype=torch.float64)
    _, (shown, member) = told(frames=800 + 90 * plain)
    assert member == "member"
    want = (plain - plain.mean((2, 3), keepdim=True)) / plain.std((2, 3), keepdim=True)
    torch.testing.assert_close(shown, want, rtol=1e-9, atol=1e-9)
    _, (even, _) = told(frames=torch.full((1, 1, 5, 5), 7.0))
    assert not even.any()
    faint = torch.zeros(1, 1, 5, 5, dtype=torch.float64)
    faint[0, 0, 1, 2] = 1e-7  # a deviation of 2e-8
    _, (shown, _) = told(frames=faint)
    assert float(shown[0, 0, 1, 2]) == pytest.approx(1e-7 * 24 / 25 / 1e-6, rel=1e-9)


def test_answers_are_lengths_in_mm_and_angles_of_the_face_in_degrees():
    """The camera looks along z, the face's normal is turned up from the way to it by
    0.35: across is the angle of
    right and out, down that below the level plane."""
    found, _ = told()
    assert found["mask_logits"][0, 2, 1].item() == pytest.approx(-0.3)
    assert found["pupil_mm"][1].tolist() == pytest.approx([0.34, -0.17])
    assert found["slip_mm"][1].tolist() == pytest.approx([1.0, -0.75, 0.625])
    assert found["slip_sd_mm"][0].tolist() == pytest.approx(
        [2.0, 3 * math.e, 5 / math.e]
    )
    assert found["points_mm"][0, 9].tolist() == pytest.approx(
        [1.7 * (0.6 - 1 / 19), 1.7 * 0.6]
    )
    x, y, z = AXIS
    down = math.cos(0.35) * y - math.sin(0.35) * z
    out = -math.sin(0.35) * y - math.cos(0.35) * z
    want = [
        math.degrees(math.atan2(x, out)),
        math.degrees(math.asin(down / math.hypot(x, y, z))),
    ]
    assert found["axis_deg"][0].tolist() == pytest.approx(
        want, rel=1e-5
    )  # single precision


@pytest.mark.parametrize(
    ("axis", "points", "gone"),
    [
        (True, True, set()),
        (False, True, {"axis_deg"}),
        (True, False, {"points_mm"}),
        (False, False, {"axis_deg", "points_mm"}),
    ],
)
def test_what_training_gave_no_weight_is_left_out(axis, points, gone):
    scale = OutputScale(1.7, (2.0, 3.0, 5.0), 0.35, axis=axis, points=points)
    assert scale.outputs == tuple(name for name in OUTPUTS if name not in gone)
    found, _ = told(scale)
    assert set(found) == set(OUTPUTS) - gone
    assert found["slip_mm"].shape == (2, 3)
    assert OPSET == 17
