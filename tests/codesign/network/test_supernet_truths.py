"""Small parts of the networks in closed form: centres of mass, scaled frames, a cost
between whole sizes.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.network import blur, cost, supernet, windows
from codesign.network.architecture import (
    BlockSpec,
    round_channels,
    smallest_architecture,
)
from codesign.network.cost import (
    MASK_CHANNELS,
    POINT_FEATURES,
    SLIP_CHANNELS,
    SLIP_GRID,
    lateral_strides,
)
from metalens.core.errors import TrainingError


def test_a_centre_counts_probabilities_above_a_twentieth_by_what_they_exceed_it():
    """Two pixels of 0.55 and 0.15 in a sea of 0.04: weights 0.5 and 0.1, middles of
    their pixels as shares.
    """
    probability = torch.full((1, 4, 10), 0.04, dtype=torch.float64)
    probability[0, 0, 8], probability[0, 3, 1] = 0.55, 0.15
    x, y = supernet.soft_argmax(torch.logit(probability))[0].tolist()
    assert x == pytest.approx(
        (0.5 * (8.5 / 10 - 0.5) + 0.1 * (1.5 / 10 - 0.5)) / 0.6, rel=1e-4
    )
    assert y == pytest.approx(
        (0.5 * (0.5 / 4 - 0.5) + 0.1 * (3.5 / 4 - 0.5)) / 0.6, rel=1e-4
    )


def test_a_landmark_is_the_centre_of_its_map_and_tells_how_wide_it_is():
    """Shares of 3/4 and 1/4 at two pixels; an even map of n by m pixels has variance (1
    - 1/n²) / 12 a side.
    """
    maps = torch.full((1, 2, 4, 10), -1e3, dtype=torch.float64)
    maps[0, 0, 1, 7], maps[0, 0, 3, 2] = np.log(3.0), 0.0
    maps[0, 1] = 0.3
    middle, width = supernet.soft_argmax_maps(maps)
    x, y = (
        0.75 * 0.25 + 0.25 * -0.25,
        0.75 * -0.125 + 0.25 * 0.375,
    )  # of pixels (7, 1) and (2, 3)
    assert middle[0].numpy() == pytest.approx(np.array([[x, y], [0.0, 0.0]]), abs=1e-6)
    apart = 0.75 * 0.25 * (0.5**2 + 0.5**2)
    even = (1 - 1 / 100) / 12 + (1 - 1 / 16) / 12
    assert width[0].numpy() == pytest.approx(np.sqrt([apart, even]), rel=1e-5)


@torch.no_grad()
def test_the_axis_is_told_without_depths_and_the_slip_with_them_both_from_landmarks():
    torch.manual_seed(2)
    head = supernet.CalibrationHead(24).eval()
    features, depths, points = (
        torch.randn(2, 24, 6, 6),
        torch.randn(2, blur.SLIP_FEATURES),
        torch.randn(2, 30),
    )
    slip, _, axis = head(features, depths, points)
    other_slip, _, other_axis = head(features, depths + 1, points)
    assert torch.equal(axis, other_axis)
    assert float((slip - other_slip).abs().min()) > 1e-4
    moved_slip, _, moved_axis = head(features, depths, points + 1)
    assert float((moved_axis - axis).abs().min()) > 1e-4
    assert float((moved_slip - slip).abs().min()) > 1e-4


def test_frames_are_averaged_by_whole_factors_and_then_drawn_between():
    frames = torch.from_numpy(np.random.default_rng(5).uniform(1, 9, (1, 1, 6, 8)))
    half = supernet.resize_frames(frames, 0.5)
    assert half[0, 0].numpy() == pytest.approx(
        frames[0, 0].reshape(3, 2, 4, 2).mean((1, 3)).numpy(), rel=1e-12
    )
    quarter = windows.resample_image(
        frames, (6, 2)
    )  # fours: drawn between two of them alone, it would be another
    assert quarter[0, 0].numpy() == pytest.approx(
        frames[0, 0].reshape(6, 2, 4).mean(2).numpy(), rel=1e-12
    )
    odd = windows.resample_image(
        frames, (4, 3)
    )  # 8 to 4 by pairs, then 4 to 3; 6 to 4 as they are
    pooled = frames[0, 0].reshape(6, 4, 2).mean(2).numpy()
    for i in range(4):
        for j in range(3):
            y, x = (i + 0.5) * 6 / 4 - 0.5, (j + 0.5) * 4 / 3 - 0.5
            a, b = int(y), int(x)
            c, d = min(a + 1, 5), min(b + 1, 3)
            u, v = y - a, x - b
            want = (1 - u) * ((1 - v) * pooled[a, b] + v * pooled[a, d]) + u * (
                (1 - v) * pooled[c, b] + v * pooled[c, d]
            )
            assert float(odd[0, 0, i, j]) == pytest.approx(want, rel=1e-5)


def test_a_cost_counts_the_pixels_of_every_stride_rounded_up():
    made = cost.MacPolynomial({2: 7, 8: 11}, 130)
    for size in (16, 17, 33):
        want = 7 * int(np.ceil(size / 2)) ** 2 + 11 * int(np.ceil(size / 8)) ** 2 + 130
        assert int(made.at(size)) == want
    assert made.at(np.array([16, 33])).tolist() == [
        7 * 64 + 11 * 4 + 130,
        7 * 17**2 + 11 * 25 + 130,
    ]


def test_a_backbone_costs_its_stem_and_its_blocks_at_their_own_strides():
    """Stem 1 to 6 by 5 x 5 at stride 2; a block without expansion; one with, of stride
    2 and a squeeze of 3.
    """
    fields = BlockSpec.__dataclass_fields__
    about = {name: 0 for name in fields}
    first = BlockSpec(
        **(
            about
            | {
                "inputs": 6,
                "hidden": 6,
                "outputs": 10,
                "kernel": 3,
                "stride": 1,
                "squeeze": 0,
            }
        )
    )
    second = BlockSpec(
        **(
            about
            | {
                "inputs": 10,
                "hidden": 24,
                "outputs": 14,
                "kernel": 5,
                "stride": 2,
                "squeeze": 3,
            }
        )
    )
    made = cost.backbone_cost(6, [first, second], stem_kernel=5)
    assert made.per_pixel == {2: 6 * 25 + 6 * (9 + 10) + 10 * 24, 4: 24 * (25 + 14)}
    assert made.constant == 2 * 24 * 3


def test_an_input_has_the_pixels_of_its_window():
    assert cost.input_size(900.0, 12.0, 0.6) == pytest.approx(45.0)
    assert cost.coarsest_um(900.0, 0.6) == pytest.approx(33.75)


def filled(module, seed=2):
    """The module with weights, biases and statistics of norms drawn, in double
    precision, as it is used.
    """
    draw = torch.Generator().manual_seed(seed)
    for part in (
        *module.parameters(),
        *(b for b in module.buffers() if b.is_floating_point()),
    ):
        part.data = (
            torch.rand(part.shape, generator=draw, dtype=torch.float64)
            + 0.2
            - 0.7 * (part.ndim > 1)
        )
    return module.double().eval()


def folded(conv, inputs, outputs, kernel=1, stride=1):
    """What a sliced convolution is by hand: the middle of its kernel on the first
    channels, then its norm.
    """
    side = conv.weight.shape[-1]
    inside = slice(side // 2 - kernel // 2, side // 2 + kernel // 2 + 1)
    weight = conv.weight[
        :outputs, : 1 if conv.depthwise else inputs, inside, inside
    ].detach()
    norm = conv.norm
    scale, mean, shift = (
        a[:outputs, None, None]
        for a in (norm.weight / (norm.variance + 1e-5) ** 0.5, norm.mean, norm.bias)
    )

    def by_hand(x):
        n = kernel // 2
        wide = torch.nn.functional.pad(x, (n, n, n, n))
        rows, columns = (range(0, s, stride) for s in x.shape[-2:])
        seen = torch.stack(
            [
                torch.stack(
                    [wide[..., i : i + kernel, j : j + kernel] for j in columns], 2
                )
                for i in rows
            ],
            2,
        )
        words = "nchwij,cij->nchw" if conv.depthwise else "nchwij,dcij->ndhw"
        made = torch.einsum(words, seen, weight[:, 0] if conv.depthwise else weight)
        return ((made - mean) * scale + shift).detach()

    return by_hand


def hardswish(x):
    return x * (x + 3).clamp(0, 6) / 6


@pytest.mark.parametrize(("stride", "outputs"), [(2, 4), (1, 4), (1, 6)])
def test_a_block_is_its_first_channels_and_the_middle_of_its_kernel(stride, outputs):
    """7 of 12 hidden channels, 3 of 5 of the kernel, 2 of 4 of the squeeze; added to
    what came in where sizes agree.
    """
    most = BlockSpec(
        inputs=6,
        hidden=12,
        outputs=6,
        kernel=5,
        stride=stride,
        squeeze=4,
        activation="hardswish",
    )
    block = replace(most, hidden=7, outputs=outputs, kernel=3, squeeze=2)
    whole = filled(supernet.ElasticBlock(most))
    x = torch.from_numpy(np.random.default_rng(1).normal(size=(2, 6, 5, 7)))
    y = hardswish(folded(whole.expand, 6, 7)(x))
    y = hardswish(folded(whole.depthwise, 7, 7, 3, stride)(y))
    down, up = whole.squeeze.down, whole.squeeze.up
    inside = (y.mean((2, 3)) @ down.weight[:2, :7].T + down.bias[:2]).clamp(min=0)
    gate = ((inside @ up.weight[:7, :2].T + up.bias[:7] + 3) / 6).clamp(0, 1)
    want = folded(whole.project, 7, outputs)(y * gate[..., None, None])
    want = want + x if stride == 1 and outputs == 6 else want
    assert torch.allclose(whole(x, block), want, rtol=1e-9, atol=1e-9)
    same = replace(block, hidden=6, activation="relu")  # nothing to expand
    y = folded(whole.depthwise, 6, 6, 3, stride)(x).clamp(min=0)
    inside = (y.mean((2, 3)) @ down.weight[:2, :6].T + down.bias[:2]).clamp(min=0)
    gate = ((inside @ up.weight[:6, :2].T + up.bias[:6] + 3) / 6).clamp(0, 1)
    want = folded(whole.project, 6, outputs)(y * gate[..., None, None])
    want = want + x if stride == 1 and outputs == 6 else want
    assert torch.allclose(whole(x, same), want, rtol=1e-9, atol=1e-9)


def test_a_mask_adds_its_strides_from_coarse_to_fine():
    head = filled(supernet.PerceptionHead([3, 5, 4]))
    draw = np.random.default_rng(3)
    fine, middle, coarse = (
        torch.from_numpy(draw.normal(size=(2, c, *size)))
        for c, size in ((3, (8, 12)), (5, (4, 6)), (4, (2, 3)))
    )
    laterals = [
        hardswish(folded(conv, x.shape[1], MASK_CHANNELS)(x))
        for conv, x in zip(head.laterals, (fine, middle, coarse), strict=True)
    ]

    def doubled(x):
        return x.repeat_interleave(2, -1).repeat_interleave(2, -2)

    total = laterals[0] + doubled(laterals[1] + doubled(laterals[2]))
    want = hardswish(folded(head.smooth, 1, MASK_CHANNELS, 3)(total))
    logits, maps, decoded = head([fine, middle, coarse])
    assert torch.allclose(decoded, want, rtol=1e-9, atol=1e-9)
    weight, bias = head.mask.weight[0, :, 0, 0], head.mask.bias
    assert torch.allclose(
        logits, torch.einsum("c,ncyx->nyx", weight, want) + bias, rtol=1e-9, atol=1e-9
    )
    weight, bias = head.points.weight[..., 0, 0], head.points.bias[:, None, None]
    assert torch.allclose(
        maps, torch.einsum("pc,ncyx->npyx", weight, want) + bias, rtol=1e-9, atol=1e-9
    )


def test_slip_is_read_from_all_features_the_axis_without_depths_and_uncertainty_shapes_none():
    head = filled(supernet.CalibrationHead(5))
    head.spread.weight.data[0] *= (
        1e-4  # the first within its limits, the others beyond both
    )
    draw = np.random.default_rng(8)
    features = torch.from_numpy(draw.normal(size=(2, 5, 2 * SLIP_GRID, SLIP_GRID)))
    depths = torch.from_numpy(draw.normal(size=(2, blur.SLIP_FEATURES)))
    points = torch.from_numpy(draw.normal(size=(2, POINT_FEATURES)))
    features.requires_grad_()
    slip, spread, axis = head(features, depths, points)
    reduced = hardswish(folded(head.reduce, 5, SLIP_CHANNELS)(features.detach()))
    grid = reduced.reshape(2, SLIP_CHANNELS, SLIP_GRID, 2, SLIP_GRID).mean(3).flatten(1)

    def linear(layer, x):
        return x @ layer.weight.T + layer.bias

    parts = [
        linear(head.hidden, grid),
        linear(head.points, points),
        linear(head.depths, depths),
    ]
    joined = hardswish(linear(head.joined, hardswish(torch.cat(parts, 1))))
    turned = hardswish(linear(head.turned, hardswish(torch.cat(parts[:2], 1))))
    assert torch.allclose(axis, linear(head.axis, turned), rtol=1e-9)
    assert torch.allclose(slip, linear(head.slip, joined), rtol=1e-9)
    assert torch.allclose(spread, linear(head.spread, joined).clamp(-4, 2), rtol=1e-9)
    assert ((spread > -4) & (spread < 2)).tolist() == [[True, False, False]] * 2
    spread.sum().backward(retain_graph=True)
    assert features.grad is None
    slip.sum().backward()
    assert float(features.grad.abs().sum()) > 0


@pytest.mark.parametrize(
    ("depthwise", "shape"), [(False, (600, 7, 3, 3)), (True, (600, 1, 3, 3))]
)
def test_weights_begin_with_the_variance_that_keeps_light_as_strong(depthwise, shape):
    """2 over what one input feeds: 9 places, of all outputs or of its own alone (He et
    al. 2015).
    """
    torch.manual_seed(1)
    weight = supernet.SlicedConv(7, 600, 3, depthwise=depthwise).weight.detach()
    assert weight.shape == shape
    want = 2 / (9 * (1 if depthwise else 600))
    assert float(weight.var()) == pytest.approx(
        want, rel=4 * (2 / weight.numel()) ** 0.5
    )
    assert supernet.SlicedConv(7, 5).weight.shape == (5, 7, 1, 1)


@pytest.mark.parametrize("measuring", [False, True])
def test_a_norm_that_is_trained_or_measured_goes_by_its_own_batch(measuring):
    """Mean 0 and variance 1 of each channel in use, times its weight and more its bias."""
    norm = supernet.SlicedNorm(5).double()
    norm.weight.data, norm.bias.data = (
        torch.arange(1.0, 6.0).double(),
        torch.arange(5.0).double(),
    )
    norm.train(not measuring)
    norm.measuring = measuring
    x = torch.from_numpy(np.random.default_rng(9).normal(3.0, 2.0, (4, 3, 5, 6)))
    got = norm(x).detach()
    assert got.mean((0, 2, 3)).numpy() == pytest.approx([0.0, 1.0, 2.0], abs=1e-9)
    assert got.std((0, 2, 3), unbiased=False).numpy() == pytest.approx(
        [1.0, 2.0, 3.0], rel=1e-5
    )
    assert int(norm.batches) == measuring  # what is trained measures nothing
    assert norm.mean[3:].tolist() == [0.0, 0.0]


def test_slip_along_the_axis_is_that_of_the_features_and_that_of_the_depths():
    """The branch of the blur adds to the third of it; the mask is read from the strides
    that it is made of.
    """
    torch.manual_seed(3)
    net, seen = supernet.Supernet(), {}
    for name in ("perception", "calibration", "blur"):
        part = getattr(net, name)
        part.register_forward_hook(
            lambda module, given, made, name=name: seen.__setitem__(name, (given, made))
        )
    net.eval()
    with torch.no_grad():
        made = net(
            torch.randn(2, 1, 64, 64),
            replace(smallest_architecture(net.space), resolution=1.0),
        )
    (features,), (logits, maps, decoded) = seen["perception"]
    (_, given), (depth, told, axial) = seen["blur"]
    (last, depths, points), (slip, spread, axis) = seen["calibration"]
    middle, width = supernet.soft_argmax_maps(maps)
    assert torch.equal(points, torch.cat([middle.flatten(1), width], 1))
    assert torch.equal(made.points, middle)
    assert made.axis is axis
    assert axial.abs().min() > 0
    assert torch.allclose(made.slip[:, :2], slip[:, :2])
    assert torch.allclose(made.slip[:, 2], slip[:, 2] + axial)
    assert made.slip.shape == made.slip_log_sd.shape == (2, 3)
    assert made.slip_log_sd is spread
    assert made.depth is depth
    assert (depths is told, given is decoded, made.mask_logits is logits) == (
        True,
        True,
        True,
    )
    assert torch.equal(made.centre, supernet.soft_argmax(logits))
    strides = [64 // one.shape[-1] for one in features]
    assert strides == [stride for _, stride in lateral_strides(net.space)]
    assert last is features[-1] or last.shape[-1] <= features[-1].shape[-1]


def test_recalibration_forgets_what_was_measured_before():
    """A norm alone as the network, whose architecture is of no matter."""

    class Net(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.norm = supernet.SlicedNorm(3)

        def forward(self, x, architecture):
            return self.norm(x)

    net, draw = Net(), torch.Generator().manual_seed(2)
    batches = [torch.randn(4, 2, 3, 5, generator=draw) * 3 + 1 for _ in range(2)]
    net.norm.mean.fill_(7.0)
    net.norm.variance.fill_(0.3)
    supernet.recalibrate_batch_norm(net, None, iter(batches))
    mean = torch.stack([one.mean((0, 2, 3)) for one in batches]).mean(0)
    variance = torch.stack([one.var((0, 2, 3)) for one in batches]).mean(0)
    assert torch.allclose(net.norm.mean, torch.cat([mean, torch.zeros(1)]))
    assert torch.allclose(
        net.norm.variance, torch.cat([variance, torch.ones(1)])
    )  # unused: as nothing
    assert not net.norm.measuring
    assert not net.training
    with pytest.raises(TrainingError, match="found none"):
        supernet.recalibrate_batch_norm(net, None, iter([]))


@pytest.mark.parametrize(
    ("channels", "found"),
    [
        (3, 8),
        (12, 16),
        (11, 16),
        (17, 16),
        (19, 24),
        (83.9, 80),
        (84, 88),
        (85, 88),
        (92, 96),
    ],
)
def test_channels_go_to_the_nearest_multiple_of_eight_or_up_where_a_tenth_would_be_lost(
    channels, found
):
    assert round_channels(channels) == found
