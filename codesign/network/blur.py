"""The depth of every window of the frame, from what blur leaves of its texture
(:mod:`codesign.network.windows`).
"""

import functools
import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from codesign.network.windows import (
    COLUMNS,
    FLOOR,
    GRID,
    ROWS,
    STEP_FEATURES,
    STEP_MACS,
    gradient_statistics,
    spectra_macs,
    step_of,
    window_content,
    window_spectra,
)

# powers, the mean of the window, statistics of brightness steps
FEATURES = COLUMNS * ROWS + 1 + STEP_FEATURES
PLACES = 5  # polynomials of the position in the frame
HIDDEN = (48, 32)
# windows along a side that a block mixes: faces are smooth, so neighbours inform a
# window
REACH = 5
BLOCKS = 2  # in sequence
# unlabelled features of a window for the slippage, in addition to its depth: position of
# the eye, confidence in the texture
EXTRA = 8
# vergence, its spread, the mean and EXTRA features of every window; two means
SLIP_FEATURES = (3 + EXTRA) * GRID**2 + 2

# 1 / depth of a face before the camera: mean and spread
VERGENCE_PER_M = 45.0
VERGENCE_UNIT_PER_M = 8.0


def blur_branch_macs(size: int) -> int:
    """Multiply-accumulates of the branch for a square frame: spectra, steps, layers.

    Without those of the content (:func:`content_macs`).

    Args:
        size: pixels along a side of the frame.
    """
    block = HIDDEN[0] * REACH**2 + HIDDEN[0] ** 2
    layers = (
        (FEATURES + PLACES) * HIDDEN[0]
        + BLOCKS * block
        + HIDDEN[0] * HIDDEN[1]
        + HIDDEN[1] * (2 + EXTRA)
    )
    return (
        spectra_macs(size) + STEP_MACS + GRID**2 * layers + BLOCKS * 3 * HIDDEN[0] ** 2
    )


def content_macs(channels: int) -> int:
    """Multiply-accumulates of the branch for the content, whatever the frame's size.

    Args:
        channels: number of channels.
    """
    return GRID**2 * (channels * HIDDEN[0] + HIDDEN[1] * 2)


@functools.lru_cache(maxsize=16)
def window_weights(size: int) -> Tensor:
    """(GRID, size) weight of every pixel of a line in each window, sum 1 a window.

    sin⁴, the square of the Hann weight sin², since power is quadratic.

    Args:
        size: side of the frame in pixels.
    """
    step = step_of(size)
    first = (size - (GRID + 1) * step) // 2
    position = torch.arange(2 * step, dtype=torch.float64) + 0.5
    weight = torch.sin(math.pi * position / (2 * step)) ** 4
    weights = torch.zeros(GRID, size, dtype=torch.float64)
    for i in range(GRID):
        weights[i, first + i * step : first + (i + 2) * step] = weight / weight.sum()
    return weights.float()


def window_vergence(depth_um: Tensor) -> Tensor:
    """(batch, GRID, GRID) weighted mean 1 / depth of every window, in units of the
    branch.

    (1 / depth - VERGENCE_PER_M) / VERGENCE_UNIT_PER_M.

    Args:
        depth_um: (batch, y, x) depth before the lens.
    """
    rows, columns = (window_weights(int(n)).to(depth_um) for n in depth_um.shape[-2:])
    vergence = (1e6 / depth_um - VERGENCE_PER_M) / VERGENCE_UNIT_PER_M
    return rows @ vergence @ columns.mT


def depth_mm(vergence: Tensor) -> Tensor:
    """Depth in mm of vergences in the units of the branch, between 5 mm and 1 m.

    Args:
        vergence: of any shape, as the network has it.
    """
    return 1e3 / (vergence * VERGENCE_UNIT_PER_M + VERGENCE_PER_M).clamp(1, 200)


class NeighbourMixer(nn.Module):
    """Residual mixing of neighbouring windows: x + mix(hardswish(depthwise(x)))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gather = nn.Conv2d(
            channels, channels, REACH, padding=REACH // 2, groups=channels
        )
        self.mix = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        added: Tensor = self.mix(F.hardswish(self.gather(x)))
        return x + added


class GlobalContext(nn.Module):
    """Residual global context: x + give(hardswish(take(mean and spread over the
    windows))).
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.take = nn.Linear(2 * channels, channels)
        self.give = nn.Linear(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        mean = x.mean((2, 3))
        spread = torch.sqrt(((x - mean[:, :, None, None]) ** 2).mean((2, 3)) + 1e-4)
        added: Tensor = self.give(F.hardswish(self.take(torch.cat([mean, spread], 1))))
        return x + added[:, :, None, None]


class BlurBranch(nn.Module):
    """Depth of every window from its blur, given the content of the frame:
    ``forward(frames, content) -> (depth, features, axial)``.

    content: (batch, channels, y, x) of the whole frame, from which the pupil's mask is
    decoded. A power spectrum is that of texture times blur; content tells a pupil's
    edge from a lash, so the blur is learned from fewer frames.
    depth: (batch, 2, GRID, GRID) vergence in units of :data:`VERGENCE_UNIT_PER_M` about
    :data:`VERGENCE_PER_M`, and the logarithm of its standard deviation in [-3, 2].
    features: (batch, SLIP_FEATURES) for the slippage: depths, means and EXTRA features
    of every window, the precision-weighted mean vergence and the mean log standard
    deviation. axial: (batch,) axial slippage, in units of its scale: the mean of every
    window's estimate, weighted by the softmax of their claims. The calibration head's
    estimate from the depths is added to it.

    PSFs differ between windows of the field, so every window weights the spectra of the
    first layer by gains and offsets of its own. Its depth is then computed with those
    of its neighbours and the context of the frame, in BLOCKS blocks. Every window also
    contributes EXTRA features without labels to the slippage: depths alone leave a
    fifth more error.
    """

    place: Tensor

    def __init__(self, norm: nn.Module, channels: int) -> None:
        """``norm``: normalises the FEATURES channels. ``channels``: of the content."""
        super().__init__()
        self.norm = norm
        self.first = nn.Conv2d(FEATURES + PLACES, HIDDEN[0], 1)
        self.gain = nn.Parameter(torch.ones(HIDDEN[0], GRID, GRID))
        self.offset = nn.Parameter(torch.zeros(HIDDEN[0], GRID, GRID))
        pairs = (
            (NeighbourMixer(HIDDEN[0]), GlobalContext(HIDDEN[0])) for _ in range(BLOCKS)
        )
        self.together = nn.Sequential(*(block for pair in pairs for block in pair))
        self.second = nn.Conv2d(HIDDEN[0], HIDDEN[1], 1)
        self.depth = nn.Conv2d(HIDDEN[1], 2 + EXTRA, 1)
        line = torch.linspace(-1, 1, GRID)
        x, y = line.expand(GRID, GRID), line[:, None].expand(GRID, GRID)
        place = torch.stack([x, y, x**2, y**2, x * y])[None].clone()
        self.register_buffer("place", place, persistent=False)
        self.content = nn.Conv2d(channels, HIDDEN[0], 1)
        self.vote = nn.Conv2d(HIDDEN[1], 2, 1)

    def forward(self, frames: Tensor, content: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Depth, features and axial slippage of frames and content; see the class."""
        power, mean = window_spectra(frames)
        waves = torch.cat(
            [torch.log(power + FLOOR), mean, gradient_statistics(frames)], 1
        )
        # broadcast over the frames by a sum, which export can trace
        position = self.place + torch.zeros_like(mean)
        features = torch.cat([self.norm(waves), position], 1)
        spectra = self.first(features) * self.gain + self.offset
        informed = F.hardswish(spectra + self.content(window_content(content)))
        mixed = F.hardswish(self.second(self.together(informed)))
        estimate, claim = self.vote(mixed).flatten(2).unbind(1)
        axial = (torch.softmax(claim, 1) * estimate).sum(1)
        out = self.depth(mixed)
        log_sd = out[:, 1].clamp(-3, 2)
        depth = torch.stack([out[:, 0], log_sd], 1)
        precision = torch.exp(-2 * log_sd)
        vergence = (precision * depth[:, 0]).sum((1, 2)) / precision.sum((1, 2))
        means = torch.stack([vergence, log_sd.mean((1, 2))], 1)
        windows = (depth.flatten(1), mean.flatten(1), means, out[:, 2:].flatten(1))
        return depth, torch.cat(windows, 1), axial
