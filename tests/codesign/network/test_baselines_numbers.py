"""What the heads of the baseline networks mean, on answers typed in: an eye in space,
its disc, looks and scales.
"""

import math

import numpy as np
import pytest
import torch
from torch import nn

from codesign.network import baselines
from codesign.network.baselines import DeformableGaze, Eyeball, NVGaze
from tests.codesign.network.told import Told


def test_an_eyeball_s_answers_are_its_place_axis_radius_and_rim():
    """Slippage in units of 1.4, 1.2 and 2.3 mm about the mean; 9.9 e^{0.1 a} to a pupil
    of 1.9 e^{0.3 tanh b}.
    """
    answer = torch.tensor(
        [
            [0.4, -0.7, 1.1, 0.5, -0.8, 0.9, -1.3],
            [-1.2, 0.3, -14.0, 0.1, 0.6, -0.2, 0.7],
        ]
    )
    net = Eyeball()
    net.answer = Told(answer)
    made = net(torch.zeros(2, 1, 64, 64))
    assert torch.equal(made.slip, answer[:, :3])
    for row, got, logits in zip(
        answer.double().numpy(),
        made.centre.double().numpy(),
        made.mask_logits,
        strict=True,
    ):
        centre = np.array([2.42, 6.44, 27.73]) + row[:3] * [1.4, 1.2, 2.3]
        yaw, rise = 0.3 * row[3], math.radians(45) + 0.3 * row[4]
        axis = np.array(
            [
                math.sin(yaw) * math.cos(rise),
                -math.sin(rise),
                -math.cos(yaw) * math.cos(rise),
            ]
        )
        pupil = centre + 9.9 * math.exp(0.1 * row[5]) * axis
        rim = 1.9 * math.exp(0.3 * math.tanh(row[6]))
        place = pupil[:2] / max(pupil[2], 5.0) / (2 * 0.288)  # no nearer than 5 mm
        assert got == pytest.approx(place, rel=1e-5)  # float32
        want = disc(pupil, axis, rim, 16)
        assert logits.double().numpy() == pytest.approx(want, abs=2e-3)
    assert made.centre[1].abs().max() > 0


def disc(pupil, axis, rim, size):
    """6 (1 - (d / rim)²), -24 to 6: d on the plane of the disc from its middle to the
    ray of a pixel.
    """
    out = np.empty((size, size))
    for i in range(size):
        for j in range(size):
            ray = np.array(
                [
                    ((j + 0.5) / size - 0.5) * 2 * 0.288,
                    ((i + 0.5) / size - 0.5) * 2 * 0.288,
                    1.0,
                ]
            )
            facing = axis @ ray
            facing = -0.05 if abs(facing) < 0.05 else facing  # a ray along the disc
            off = ray * (pupil @ axis) / facing - pupil
            out[i, j] = 6 * np.clip(1 - (off @ off) / rim**2, -4, 1)
    return out


def test_a_disc_that_rays_run_along_stays_finite():
    pupil, axis = (
        np.array([0.6, -0.4, 21.0]),
        np.array([math.cos(0.1), 0.0, math.sin(0.1)]),
    )
    axis = axis / np.linalg.norm(axis)
    got = baselines._disc(
        torch.tensor(pupil)[None].float(),
        torch.tensor(axis)[None].float(),
        torch.tensor([2.3]),
        24,
    )[0]
    assert got.double().numpy() == pytest.approx(disc(pupil, axis, 2.3, 24), abs=5e-3)


def test_nvgaze_answers_a_tenth_of_its_first_two_numbers():
    net = NVGaze().eval()
    net.answer = Told(torch.tensor([[0.7, -0.3, 1.1, 2.2, 3.3]]))
    made = net(torch.zeros(1, 1, 64, 64))
    assert made.centre[0].tolist() == pytest.approx([0.07, -0.03])
    assert made.slip[0].tolist() == pytest.approx([1.1, 2.2, 3.3])


def test_queries_answer_where_and_what_they_see():
    """Softmax of query times token over √width; the place of what is seen over 2, and a
    tenth of the head's answer.
    """
    torch.manual_seed(2)
    net = DeformableGaze(width=8, heads=2, points=3).eval()
    features = torch.randn(2, 8, 3, 5)
    net.stem, net.layers = Told(features), nn.ModuleList()
    with torch.no_grad():
        made = net(torch.zeros(2, 1, 24, 40))
        tokens = features.flatten(2).double().numpy()
        logits = net.queries.double().numpy() @ tokens / math.sqrt(8)
        share = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
        seen = share @ tokens.transpose(0, 2, 1)
        x, y = (np.arange(5) + 0.5) / 5 * 2 - 1, (np.arange(3) + 0.5) / 3 * 2 - 1
        place = np.stack([np.tile(x, 3), np.repeat(y, 5)], 1)
        one, other = (
            net.heads[k](torch.from_numpy(seen[:, k]).float()).double().numpy()
            for k in (0, 1)
        )
    assert made.centre.numpy() == pytest.approx(
        (share @ place)[:, 0] / 2 + 0.1 * one, abs=1e-5
    )
    assert made.slip.numpy() == pytest.approx(other, abs=1e-5)
    assert made.mask_logits.shape == (2, 6, 10)
    assert net.sampling_macs(40) == 0
    whole = DeformableGaze()
    assert (
        whole.sampling_macs(41) == 2 * 36 * 4 * 48 * 5
    )  # 6 x 6 places, 2 layers, 4 points


def test_the_first_look_is_a_ring_farther_out_in_every_point():
    layer = baselines._Attention(12, 3, 2)
    ring = layer.offset.bias.detach().reshape(3, 2, 2).numpy()
    for head in range(3):
        turn = 2 * math.pi * head / 3
        for point in range(2):
            assert ring[head, point] == pytest.approx(
                [(point + 1) * math.cos(turn), (point + 1) * math.sin(turn)], abs=1e-6
            )


def test_attention_weighs_samples_between_positions():
    """Two heads of two points each by loops: bilinear, nothing beyond the border,
    softmax over the points.
    """
    torch.manual_seed(5)
    layer = baselines._Attention(4, 2, 2).double()
    place = nn.Linear(2, 4).double()
    features = torch.randn(1, 4, 4, 5, dtype=torch.float64)
    with torch.no_grad():
        nn.init.normal_(layer.offset.weight, std=0.3)
        for linear in (layer.feed[0], layer.feed[2]):
            linear.weight.zero_(), linear.bias.zero_()
        found = (layer(features, place) - features)[0]
        y, x = (np.arange(4) + 0.5) / 4 * 2 - 1, (np.arange(5) + 0.5) / 5 * 2 - 1
        for row, column in ((0, 0), (2, 3), (3, 4)):
            token = features[0, :, row, column]
            asked = layer.norms[0](token) + place(torch.tensor([x[column], y[row]]))
            offset = layer.offset(asked).reshape(2, 2, 2)
            weight = torch.softmax(layer.weight(asked).reshape(2, 2), -1)
            mixed = []
            for head in range(2):
                value = torch.stack(
                    [
                        torch.stack(
                            [
                                layer.value(features[0, :, i, j])[
                                    2 * head : 2 * head + 2
                                ]
                                for j in range(5)
                            ]
                        )
                        for i in range(4)
                    ]
                )
                total = torch.zeros(2, dtype=torch.float64)
                for point in range(2):
                    total += weight[head, point] * bilinear(
                        value,
                        row + offset[head, point, 1],
                        column + offset[head, point, 0],
                    )
                mixed.append(total)
            assert found[:, row, column].numpy() == pytest.approx(
                layer.out(torch.cat(mixed)).numpy(), abs=1e-7
            )  # float32 grid


def bilinear(value, row, column):
    """(channels,) of (rows, columns, channels) between positions; nothing lies beyond."""
    total = 0
    for i in range(value.shape[0]):
        for j in range(value.shape[1]):
            share = max(1 - abs(float(row) - i), 0) * max(1 - abs(float(column) - j), 0)
            total = total + share * value[i, j]
    return total


def test_sizes_of_the_networks_are_those_that_their_costs_were_counted_with():
    net = NVGaze()
    assert (net.space.resolution, net.sampling_macs(64)) == ((1.0, 1.0), 0)
    assert (net.answer.in_features, net.answer.out_features) == (4 * 122, 5)
    assert [m.kernel_size[0] for m in net.modules() if isinstance(m, nn.Conv2d)] == [
        5,
        3,
        3,
        3,
        3,
        3,
    ]
    assert {m.stride[0] for m in net.modules() if isinstance(m, nn.Conv2d)} == {2}
    eyeball = Eyeball()
    assert (
        eyeball.hidden.in_features,
        eyeball.hidden.out_features,
        eyeball.answer.out_features,
    ) == (56 * 16, 64, 7)
    assert [m.skip.out_channels for m in eyeball.body] == [24, 40, 56]
