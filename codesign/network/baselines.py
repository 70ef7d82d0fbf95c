"""Other people's networks under equal training, built from their papers' descriptions,
with their cost counted.

``nvgaze``: strided convolutions whose width grows by half a layer, then one linear
layer (Kim et al., CHI 2019).
``popovic``: a residual encoder that regresses an eyeball in space, whose pupil is drawn
to be compared with the mask
(after Popovic et al., model-aware 3-D eye gaze, 2023). ``de2gaze``: deformable
attention on convolutional features,
with separate queries for what turns and what shifts (after De²Gaze, 2024). None of the
papers' networks answers our
question (slippage beside gaze) or takes our frames: the bodies are theirs, sizes and
heads ours.
"""

import copy
import functools
import itertools
import math
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.flop_counter import FlopCounterMode

from codesign.network.architecture import Architecture, Space
from codesign.network.supernet import Prediction
from metalens.ground.arrays import Array
from metalens.ground.errors import ConfigError

Name = Literal["supernet", "nvgaze", "popovic", "de2gaze"]
NOMINAL_MM = (
    2.42,
    6.44,
    27.73,
)  # mean rotation centre before the camera at zero slippage
SLIP_UNIT_MM = (1.4, 1.2, 2.3)
TANGENT = 0.288  # half the frame of 128 samples of 9 um behind a lens 2 mm away


class Baseline(nn.Module):
    """A network of one size with the face of the supernet: ``forward(frames,
    architecture)``; the latter is unused.

    ``space`` is a space of one resolution, so that budgets and schedules read it as
    they do the supernet's.
    """

    def __init__(self) -> None:
        super().__init__()
        self.space = Space(resolution=(1.0, 1.0))

    def forward(
        self, frames: Tensor, architecture: Architecture | None = None
    ) -> Prediction:
        """See :class:`codesign.network.supernet.Prediction`."""
        raise NotImplementedError

    def sampling_macs(self, size: int) -> int:
        """Multiply-accumulates that the flop counter does not see: bilinear samples."""
        return 0

    def counts(self, architecture: Architecture, sizes: Array) -> Array:
        """Multiply-accumulates for square frames of these sizes (integers), by
        PyTorch's counter.
        """
        return np.array([_count(self, int(size)) for size in np.atleast_1d(sizes)])


def make(name: Name) -> Baseline:
    """The network of this name.

    Raises:
        ConfigError: no such baseline.
    """
    known: dict[str, type[Baseline]] = {
        "nvgaze": NVGaze,
        "popovic": Eyeball,
        "de2gaze": DeformableGaze,
    }
    if name not in known:
        raise ConfigError(
            f"no baseline network {name!r}; need one of {', '.join(known)}"
        )
    return known[name]()


@functools.lru_cache(maxsize=256)
def _count(net: Baseline, size: int) -> int:
    shadow = copy.deepcopy(net).to("meta").eval()
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        shadow(torch.empty(1, 1, size, size, device="meta"))
    return int(counter.get_total_flops()) // 2 + net.sampling_macs(size)


def _conv(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    convolution = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU())


class NVGaze(Baseline):
    """Six strided convolutions, 16 channels growing by 1.5, dropout and a linear layer;
    no mask.
    """

    def __init__(self, first: int = 16, layers: int = 6) -> None:
        super().__init__()
        widths = [1, *(round(first * 1.5**k) for k in range(layers))]
        self.body = nn.Sequential(
            *(_conv(a, b, 5 if a == 1 else 3, 2) for a, b in itertools.pairwise(widths))
        )
        self.drop = nn.Dropout(0.1)
        self.answer = nn.Linear(widths[-1] * 4, 5)

    def forward(
        self, frames: Tensor, architecture: Architecture | None = None
    ) -> Prediction:
        features = F.adaptive_avg_pool2d(self.body(frames), 2).flatten(1)
        found = self.answer(self.drop(features))
        return Prediction(
            frames.new_zeros(len(frames), 0, 0), 0.1 * found[:, :2], found[:, 2:]
        )


class _Residual(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.first = _conv(inputs, outputs, 3, 2)
        self.second = nn.Sequential(
            nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False), nn.BatchNorm2d(outputs)
        )
        self.skip = nn.Conv2d(inputs, outputs, 1, 2)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.second(self.first(x)) + self.skip(x))


class Eyeball(Baseline):
    """Regresses an eyeball: rotation centre, distance to the pupil, optical axis, pupil
    radius; draws the pupil.

    The pupil is the disc at that distance along the axis; the ray of every mask pixel
    meets its plane, and the logit
    is how far inside the rim. So mask, centre and slippage come from one body in space.
    """

    def __init__(self, widths: tuple[int, ...] = (12, 24, 40, 56)) -> None:
        super().__init__()
        self.stem = _conv(1, widths[0], 5, 2)
        self.body = nn.Sequential(
            *(_Residual(a, b) for a, b in itertools.pairwise(widths))
        )
        self.hidden = nn.Linear(widths[-1] * 16, 64)
        self.answer = nn.Linear(64, 7)
        nn.init.normal_(self.answer.weight, std=0.01)
        nn.init.zeros_(self.answer.bias)

    def forward(
        self, frames: Tensor, architecture: Architecture | None = None
    ) -> Prediction:
        features = F.adaptive_avg_pool2d(self.body(self.stem(frames)), 4).flatten(1)
        found = self.answer(F.relu(self.hidden(features)))
        slip = found[:, :3]
        centre = found.new_tensor(NOMINAL_MM) + slip * found.new_tensor(SLIP_UNIT_MM)
        axis = self._axis(found[:, 3:5])
        pupil = centre + 9.9 * torch.exp(0.1 * found[:, 5:6]) * axis
        rim = 1.9 * torch.exp(0.3 * torch.tanh(found[:, 6]))
        place = pupil[:, :2] / pupil[:, 2:].clamp_min(5.0) / (2 * TANGENT)
        return Prediction(_disc(pupil, axis, rim, frames.shape[-1] // 4), place, slip)

    @staticmethod
    def _axis(turn: Tensor) -> Tensor:
        """(batch, 3) optical axis: towards a camera 45 degrees below, turned by two
        angles.
        """
        yaw, rise = 0.3 * turn[:, 0], math.radians(45.0) + 0.3 * turn[:, 1]
        level = torch.cos(rise)
        return torch.stack(
            [torch.sin(yaw) * level, -torch.sin(rise), -torch.cos(yaw) * level], -1
        )


def _disc(pupil: Tensor, axis: Tensor, rim: Tensor, size: int) -> Tensor:
    """(batch, size, size) logits of a disc at ``pupil`` across ``axis``: above 0 inside
    its rim.
    """
    tangent = ((torch.arange(size, device=pupil.device) + 0.5) / size - 0.5) * (
        2 * TANGENT
    )
    ray = torch.stack(
        [
            tangent.expand(size, size),
            tangent[:, None].expand(size, size),
            torch.ones(size, size).to(tangent),
        ]
    )
    facing = torch.einsum("bk,kyx->byx", axis, ray)
    facing = torch.where(facing.abs() < 0.05, facing.new_tensor(-0.05), facing)
    reach = (pupil * axis).sum(1)[:, None, None] / facing
    offset = reach[:, None] * ray - pupil[:, :, None, None]
    inside = 1 - offset.square().sum(1) / rim[:, None, None] ** 2
    return 6 * inside.clamp(-4, 1)


class DeformableGaze(Baseline):
    """Convolutional features, two layers of deformable attention, and decoupled queries
    for pupil and slippage.
    """

    def __init__(
        self, width: int = 48, heads: int = 4, points: int = 4, layers: int = 2
    ) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            _conv(1, 16, 5, 2), _conv(16, 32, 3, 2), _conv(32, width, 3, 2)
        )
        self.place = nn.Linear(2, width)
        self.layers = nn.ModuleList(
            _Attention(width, heads, points) for _ in range(layers)
        )
        self.queries = nn.Parameter(0.1 * torch.randn(2, width))
        self.heads = nn.ModuleList(
            nn.Sequential(nn.Linear(width, 32), nn.ReLU(), nn.Linear(32, n))
            for n in (2, 3)
        )
        self.mask = nn.Conv2d(width, 4, 1)

    def forward(
        self, frames: Tensor, architecture: Architecture | None = None
    ) -> Prediction:
        features = self.stem(frames)
        for layer in self.layers:
            features = layer(features, self.place)
        tokens = features.flatten(2)
        share = torch.softmax(
            self.queries @ tokens / tokens.shape[1] ** 0.5, -1
        )  # (batch, queries, positions)
        seen = share @ tokens.mT
        y, x = _grid(features)
        spot = (
            share @ torch.stack([x.flatten(), y.flatten()], -1) / 2
        )  # where each query looks
        centre = spot[:, 0] + 0.1 * self.heads[0](seen[:, 0])
        return Prediction(
            F.pixel_shuffle(self.mask(features), 2)[:, 0],
            centre,
            self.heads[1](seen[:, 1]),
        )

    def sampling_macs(self, size: int) -> int:
        """Four products a sampled value, and the weighted sum over the points."""
        positions, width = (-(-size // 8)) ** 2, self.queries.shape[1]
        return sum(positions * layer.points * width * 5 for layer in self.layers)  # type: ignore[misc, operator]


class _Attention(nn.Module):
    """Every position looks at a few places of its own choice in every head (Zhu et al.
    2021), then a feed-forward.
    """

    def __init__(self, width: int, heads: int, points: int) -> None:
        super().__init__()
        self.heads, self.points = heads, points
        self.offset, self.weight = (
            nn.Linear(width, heads * points * 2),
            nn.Linear(width, heads * points),
        )
        self.value, self.out = nn.Linear(width, width), nn.Linear(width, width)
        self.feed = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(2))
        nn.init.zeros_(self.offset.weight)
        with torch.no_grad():  # the first look: a ring, farther out in every point
            turn = torch.arange(heads) * (2 * math.pi / heads)
            ring = (
                torch.stack([turn.cos(), turn.sin()], -1)[:, None]
                * torch.arange(1, points + 1)[:, None]
            )
            self.offset.bias.copy_(ring.flatten())

    def forward(self, features: Tensor, place: nn.Module) -> Tensor:
        batch, width, rows, columns = features.shape
        y, x = _grid(features)
        tokens = features.flatten(2).mT
        asked = self.norms[0](tokens) + place(
            torch.stack([x.flatten(), y.flatten()], -1)
        )
        value = self.value(tokens).mT.reshape(
            batch * self.heads, width // self.heads, rows, columns
        )
        offset = self.offset(asked).reshape(
            batch, rows * columns, self.heads, self.points, 2
        )
        step = offset.new_tensor([2 / columns, 2 / rows])
        where = (
            torch.stack([x.flatten(), y.flatten()], -1)[:, None, None] + offset * step
        )
        where = where.permute(0, 2, 1, 3, 4).reshape(
            batch * self.heads, rows * columns, self.points, 2
        )
        seen = F.grid_sample(
            value, where, align_corners=False
        )  # (batch heads, width / heads, positions, points)
        weight = torch.softmax(
            self.weight(asked).reshape(batch, -1, self.heads, self.points), -1
        )
        weight = weight.permute(0, 2, 1, 3).reshape(
            batch * self.heads, 1, rows * columns, self.points
        )
        mixed = (seen * weight).sum(-1).reshape(batch, width, rows * columns).mT
        tokens = tokens + self.out(mixed)
        tokens = tokens + self.feed(self.norms[1](tokens))
        found: Tensor = tokens.mT.reshape(batch, width, rows, columns)
        return found


def _grid(features: Tensor) -> tuple[Tensor, Tensor]:
    """(rows, columns) y and x of the positions, -1 to 1 from edge to edge."""
    y, x = (
        ((torch.arange(n, device=features.device) + 0.5) / n * 2 - 1)
        for n in features.shape[-2:]
    )
    rows, columns = torch.meshgrid(y, x, indexing="ij")
    return rows.to(features), columns.to(features)
