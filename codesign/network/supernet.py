"""Elastic MobileNetV3 with a branch for blur, and heads for mask, slip and depth."""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from codesign.batches import parallel
from codesign.network import blur
from codesign.network.architecture import (
    Activation,
    Architecture,
    BlockSpec,
    SearchSpace,
    active_blocks,
    largest_architecture,
    stem_channels,
)
from codesign.network.cost import (
    MASK_CHANNELS,
    POINT_FEATURES,
    POINTS,
    SLIP_CHANNELS,
    SLIP_GRID,
    SLIP_HIDDEN,
    lateral_strides,
)
from codesign.network.windows import resample_image
from metalens.core.errors import TrainingError


@dataclass(frozen=True, eq=False, slots=True)
class NetworkPrediction:
    """Predictions of the network for a batch of frames.

    mask_logits: (batch, y, x) at a quarter of the input resolution.
    centre: (batch, 2) pupil centre x, y as a fraction of the image from its centre,
    -0.5 at the left and top edge.
    slip: (batch, 3) camera displacement in units of the scale that the loss divides by
    (paper Eq. 7).
    depth: (batch, 2, windows, windows) vergence of each window from its blur
    (:mod:`codesign.network.blur`), and the logarithm of its standard deviation.
    slip_log_sd: (batch, 3) logarithm of the standard deviation of ``slip``.
    points: (batch, POINTS, 2) landmarks (:data:`codesign.eye.NAMES`), then the pupil's
    centre, in the coordinates of ``centre``.
    axis: (batch, 3) optic axis of the eye in the camera's frame, not normalised.
    """

    mask_logits: Tensor
    centre: Tensor
    slip: Tensor
    depth: Tensor
    slip_log_sd: Tensor
    points: Tensor
    axis: Tensor


def apply_activation(x: Tensor, kind: Activation | None) -> Tensor:
    """The activation alone.

    Args:
        x: (batch, channels, y, x) features.
        kind: name of the activation; None for the identity.
    """
    if kind is None:
        return x
    return F.relu(x) if kind == "relu" else F.hardswish(x)


class SlicedNorm(nn.Module):
    """Batch normalisation whose first channels serve narrower networks."""

    mean: Tensor
    variance: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("variance", torch.ones(channels))
        self.measuring = False
        self.batches = 0  # measured so far

    def forward(self, x: Tensor, act: Activation | None = None) -> Tensor:
        """Batch normalisation of the leading channels, then the activation.

        In training by the statistics of the batch (of all processes), otherwise by
        those last measured. While ``measuring``, these become the mean over batches of
        equal weight, so that the order of the batches does not matter.

        Args:
            x: (batch, channels, y, x) features.
            act: activation after the norm; None for none.
        """
        count = x.shape[1]
        weight, bias = self.weight[:count], self.bias[:count]
        mean: Tensor | None = self.mean[:count]
        variance: Tensor | None = self.variance[:count]
        if self.measuring:
            self.batches += 1
        elif self.training and parallel.process_count() > 1:
            return apply_activation(parallel.batch_norm(x, weight, bias), act)
        elif self.training:
            mean = variance = None
        y = F.batch_norm(
            x, mean, variance, weight, bias, self.training or self.measuring,
            momentum=1 / max(self.batches, 1),
        )  # fmt: skip
        return apply_activation(y, act)


class RunningNorm(nn.Module):
    """(x - m) / sqrt(v + 0.01) a channel, m and v those of the last batches, this
    one included.

    Of n batches the n-th has a share of 1 / n, from 100 batches on of 1 / 100.
    Gradients do not go through m and v.
    Evaluation moves nothing, nor does a batch that is not finite. In double precision:
    a power's mean is many times its
    spread, and the difference of squares would leave four digits.
    """

    mean: Tensor
    square: Tensor
    batches: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(channels, dtype=torch.float64))
        self.register_buffer(
            "square", torch.ones(channels, dtype=torch.float64)
        )  # mean of x^2
        self.register_buffer("batches", torch.zeros((), dtype=torch.int64))

    def forward(self, x: Tensor) -> Tensor:
        if self.training:
            self._follow(x)
        # a wave that is rare in frames is not amplified without bound
        scale = torch.rsqrt((self.square - self.mean**2).clamp_min(0) + 1e-2)
        return (x - self.mean.to(x)[:, None, None]) * scale.to(x)[:, None, None]

    @torch.no_grad()
    def _follow(self, x: Tensor) -> None:
        """Update the running moments by a batch; unchanged where it is not finite."""
        values = x.double()
        moments = parallel.mean_of(
            torch.stack([values.mean((0, 2, 3)), (values**2).mean((0, 2, 3))])
        )
        if bool(torch.isfinite(moments).all()):
            self.batches += 1
            share = 1 / min(int(self.batches), 100)
            self.mean.lerp_(moments[0], share)
            self.square.lerp_(moments[1], share)


class SlicedConv(nn.Module):
    """Convolution with norm, of which the leading channels and the centre of the kernel
    are used.
    """

    def __init__(
        self, inputs: int, outputs: int, kernel: int = 1, *, depthwise: bool = False
    ) -> None:
        super().__init__()
        fan_out = kernel**2 * (1 if depthwise else outputs)
        shape = (outputs, 1 if depthwise else inputs, kernel, kernel)
        self.weight = nn.Parameter(torch.randn(shape) * (2 / fan_out) ** 0.5)
        self.norm = SlicedNorm(outputs)
        self.depthwise = depthwise

    def forward(
        self,
        x: Tensor,
        outputs: int,
        *,
        kernel: int = 1,
        stride: int = 1,
        act: Activation | None = None,
    ) -> Tensor:
        """Convolution with the first ``outputs`` filters, cropped to ``kernel``, norm,
        activation.

        Args:
            x: (batch, channels, y, x), the leading channels of the inputs.
        """
        border = (self.weight.shape[-1] - kernel) // 2
        window = slice(border, border + kernel)
        weight = self.weight[
            :outputs, : 1 if self.depthwise else x.shape[1], window, window
        ]
        groups = outputs if self.depthwise else 1
        y: Tensor = self.norm(
            F.conv2d(x, weight, stride=stride, padding=kernel // 2, groups=groups), act
        )
        return y


class SqueezeExcite(nn.Module):
    """Channel gates from the mean of the image; leading channels serve narrower blocks."""

    def __init__(self, channels: int, squeeze: int) -> None:
        super().__init__()
        self.down = nn.Linear(channels, squeeze)
        self.up = nn.Linear(squeeze, channels)

    def forward(self, x: Tensor, squeeze: int) -> Tensor:
        """x * hardsigmoid(up relu(down mean(x))): a gate for every channel.

        Args:
            x: (batch, channels, y, x). squeeze: hidden channels.
        """
        count = x.shape[1]
        pooled = x.mean((2, 3))
        hidden = F.relu(
            F.linear(
                pooled, self.down.weight[:squeeze, :count], self.down.bias[:squeeze]
            )
        )
        gate = F.hardsigmoid(
            F.linear(hidden, self.up.weight[:count, :squeeze], self.up.bias[:count])
        )
        gated: Tensor = x * gate[:, :, None, None]
        return gated


class ElasticBlock(nn.Module):
    """Inverted residual at its largest; ``forward`` takes the block to act as."""

    def __init__(self, most: BlockSpec) -> None:
        super().__init__()
        self.expand = SlicedConv(most.inputs, most.hidden)
        self.depthwise = SlicedConv(
            most.hidden, most.hidden, most.kernel, depthwise=True
        )
        self.squeeze = (
            SqueezeExcite(most.hidden, most.squeeze) if most.squeeze else None
        )
        self.project = SlicedConv(most.hidden, most.outputs)

    def forward(self, x: Tensor, block: BlockSpec) -> Tensor:
        """Inverted residual: expand 1x1, depthwise k x k, squeeze-excite, project 1x1.

        Args:
            x: (batch, channels, y, x). block: sizes to use of the weights.
        """
        act = block.activation
        y = self.expand(x, block.hidden, act=act) if block.hidden != block.inputs else x
        y = self.depthwise(
            y, block.hidden, kernel=block.kernel, stride=block.stride, act=act
        )
        if self.squeeze is not None:
            y = self.squeeze(y, block.squeeze)
        projected: Tensor = self.project(y, block.outputs)
        return x + projected if block.residual else projected


class PerceptionHead(nn.Module):
    """Pupil mask and landmark maps from the features of every stride, summed from
    coarse to fine.

    ``forward(features) -> (mask, maps, decoded)``: the last is what both are decoded
    from.
    """

    def __init__(self, channels: list[int]) -> None:
        super().__init__()
        self.laterals = nn.ModuleList(SlicedConv(c, MASK_CHANNELS) for c in channels)
        self.smooth = SlicedConv(MASK_CHANNELS, MASK_CHANNELS, 3, depthwise=True)
        self.mask = nn.Conv2d(MASK_CHANNELS, 1, 1)
        self.points = nn.Conv2d(MASK_CHANNELS, POINTS, 1)

    def forward(self, features: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Mask logits (batch, y, x), landmark maps and decoded features at the finest
        stride.

        Args:
            features: (batch, channels, y, x) each, from fine to coarse.
        """
        total = self.laterals[-1](features[-1], MASK_CHANNELS, act="hardswish")
        for lateral, feature in zip(
            list(self.laterals)[-2::-1], features[-2::-1], strict=True
        ):
            total = F.interpolate(total, size=feature.shape[-2:], mode="nearest")
            total = total + lateral(feature, MASK_CHANNELS, act="hardswish")
        decoded = self.smooth(total, MASK_CHANNELS, kernel=3, act="hardswish")
        return self.mask(decoded)[:, 0], self.points(decoded), decoded


class CalibrationHead(nn.Module):
    """Slip, its log standard deviation and the optic axis: ``forward(features, depths,
    points)``.

    From the flattened last feature map, so that image position is retained (paper Eq.
    7), from window depths and from landmarks. The axis does not depend on depth and is
    read without it. The uncertainty is read from the features of the slip, without a
    gradient to them.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.reduce = SlicedConv(channels, SLIP_CHANNELS)
        self.hidden = nn.Linear(SLIP_CHANNELS * SLIP_GRID**2, SLIP_HIDDEN)
        self.depths = nn.Linear(blur.SLIP_FEATURES, SLIP_HIDDEN)
        self.points = nn.Linear(POINT_FEATURES, SLIP_HIDDEN)
        self.joined = nn.Linear(3 * SLIP_HIDDEN, SLIP_HIDDEN)
        self.slip = nn.Linear(SLIP_HIDDEN, 3)
        self.spread = nn.Linear(SLIP_HIDDEN, 3)
        self.turned = nn.Linear(2 * SLIP_HIDDEN, SLIP_HIDDEN)
        self.axis = nn.Linear(SLIP_HIDDEN, 3)

    def forward(
        self, features: Tensor, depths: Tensor, points: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """(slip, log standard deviation in [-4, 2], axis), (batch, 3) each.

        Args:
            features: (batch, channels, y, x). depths: (batch, SLIP_FEATURES).
            points: (batch, POINT_FEATURES).
        """
        reduced = self.reduce(features, SLIP_CHANNELS, act="hardswish")
        grid = resample_image(reduced, (SLIP_GRID, SLIP_GRID))
        appearance = F.hardswish(
            torch.cat([self.hidden(grid.flatten(1)), self.points(points)], 1)
        )
        joined = F.hardswish(
            self.joined(torch.cat([appearance, F.hardswish(self.depths(depths))], 1))
        )
        axis = self.axis(F.hardswish(self.turned(appearance)))
        return self.slip(joined), self.spread(joined.detach()).clamp(-4, 2), axis


class Supernet(nn.Module):
    """All architectures of ``space`` in one set of weights.

    ``forward(frames, architecture)``: frames (batch, 1, y, x), standardised; returns a
    :class:`NetworkPrediction`.
    """

    def __init__(self, space: SearchSpace | None = None) -> None:
        super().__init__()
        self.space = space or SearchSpace()
        largest = largest_architecture(self.space)
        rows = active_blocks(self.space, largest)
        self.stem = SlicedConv(1, stem_channels(self.space, largest), 3)
        self.stages = nn.ModuleList(
            nn.ModuleList(ElasticBlock(b) for b in row) for row in rows
        )
        self.perception = PerceptionHead(
            [rows[stage][-1].outputs for stage, _ in lateral_strides(self.space)]
        )
        self.calibration = CalibrationHead(rows[-1][-1].outputs)
        self.blur = blur.BlurBranch(RunningNorm(blur.FEATURES), MASK_CHANNELS)

    def forward(self, frames: Tensor, architecture: Architecture) -> NetworkPrediction:
        """Predictions of one member for standardised frames.

        Args:
            frames: (batch, 1, y, x). architecture: member of the search space.
        """
        height, width = (
            max(1, round(int(side) * architecture.resolution))
            for side in frames.shape[-2:]
        )
        resized = resample_image(frames, (height, width))
        channels = stem_channels(self.space, architecture)
        x = self.stem(resized, channels, kernel=3, stride=2, act="hardswish")
        lateral_stages = {stage for stage, _ in lateral_strides(self.space)}
        features = []
        for i, (stage, row) in enumerate(
            zip(self.stages, active_blocks(self.space, architecture), strict=True)
        ):
            for module, block in zip(stage.children(), row, strict=False):
                x = module(x, block)
            if i in lateral_stages:
                features.append(x)
        logits, maps, decoded = self.perception(features)
        depth, blur_features, axial = self.blur(resized, decoded)
        points, widths = soft_argmax_maps(maps)
        slip, slip_log_sd, axis = self.calibration(
            x, blur_features, torch.cat([points.flatten(1), widths], 1)
        )
        slip = slip + F.pad(axial[:, None], (2, 0))
        return NetworkPrediction(
            logits, soft_argmax(logits), slip, depth, slip_log_sd, points, axis
        )


def soft_argmax(logits: Tensor) -> Tensor:
    """(batch, 2) centre of mass x, y of the mask probability, fraction of the image.

    From the image's centre. Weights are relu(p - 0.05), so that a large background does
    not pull the centre; an empty mask gives (0, 0) with a finite gradient.

    Args:
        logits: (batch, y, x) log odds of the pupil.
    """
    probability = torch.sigmoid(logits)
    weight = F.relu(probability - 0.05)
    total = weight.sum((1, 2)) + 1e-6
    x, y = _pixel_centres(logits)
    sums = [(weight.sum(1) * x).sum(1), (weight.sum(2) * y).sum(1)]
    return torch.stack(sums, -1) / total[:, None]


def _pixel_centres(maps: Tensor) -> list[Tensor]:
    """x (columns,) and y (rows,) of the pixels of maps (..., y, x), from the image's
    centre in fractions of the image.
    """
    height, width = maps.shape[-2:]
    return [(torch.arange(n).to(maps) + 0.5) / n - 0.5 for n in (width, height)]


def soft_argmax_maps(maps: Tensor) -> tuple[Tensor, Tensor]:
    """Centre of mass (batch, points, 2) x, y of every map's softmax, and its RMS width.

    Fractions of the image; centres from its centre. The width (batch, points) is large
    where the point is hidden or outside the image.

    Args:
        maps: (batch, points, y, x).
    """
    share = torch.softmax(maps.flatten(2), 2).view(maps.shape)
    columns, rows = share.sum(2), share.sum(3)
    x, y = _pixel_centres(maps)
    centre = torch.stack([columns @ x, rows @ y], -1)
    variance_x = (columns * (x - centre[..., :1]) ** 2).sum(-1)
    variance_y = (rows * (y - centre[..., 1:]) ** 2).sum(-1)
    return centre, torch.sqrt(variance_x + variance_y + 1e-6)


@torch.no_grad()
def recalibrate_batch_norm(
    net: nn.Module, architecture: Architecture, batches: Iterable[Tensor]
) -> None:
    """Measure the batch statistics of one architecture anew on given batches, in place.

    Leaves the network in evaluation mode. Running means
    (:class:`RunningNorm`) belong to all architectures and
    stay.

    Args:
        net: network. architecture: whose statistics.
        batches: (batch, 1, y, x) frames each.

    Raises:
        TrainingError: no batch.
    """
    net.eval()
    device = next(net.parameters()).device
    norms = [m for m in net.modules() if isinstance(m, SlicedNorm)]
    for norm in norms:
        norm.batches = 0
        norm.measuring = True
    count = 0
    try:
        for frames in batches:
            net(frames.to(device), architecture)
            count += 1
    finally:
        for norm in norms:
            norm.measuring = False
    if count == 0:
        raise TrainingError(
            "recalibration needs at least one batch of frames, found none"
        )
