"""Local blur: log power of windows of the frame under quadrature filters, and the depth that it tells in each.

A window is a quarter of the frame wide, and the filters are waves of 0 … 8 periods a window under a Hann weight:

    P(i, f) = |Σ_x w(x - x_i) e^{2πi f·x} frame(x)|² / Σ w²         log P: texture and blur add up in it

Places and frequencies are fractions of the frame, so frames of any number of pixels give the same features as far as
their pixels reach; waves beyond Nyquist are left out. The filters are separable: along x first, then along y.
"""

import functools
import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

GRID = 7  # windows along a side; neighbours overlap by half
WAVES = 8  # periods a window of the finest filter
COLUMNS, ROWS = WAVES + 1, 2 * WAVES  # of frequencies: 0 … 8 along x, -7 … 8 along y
FEATURES = COLUMNS * ROWS + 1  # and the mean of the window
PLACES = 5  # polynomials of the place in the frame
FLOOR = 1e-2  # of the power, in units of the frame's variance a pixel
HIDDEN = (48, 32)
REACH = 5  # windows along a side that a block reads together: a face is smooth, and neighbours tell of a window
BLOCKS = 2  # one after the other
BESIDE = 8  # numbers that a window tells the slippage beside its depth: where the eye is in it, how sure its texture is
SLIP_FEATURES = (3 + BESIDE) * GRID**2 + 2  # vergence, its spread, the mean and these of every window; means

VERGENCE_PER_M, VERGENCE_UNIT_PER_M = 45.0, 8.0  # 1 / depth of a face before the camera: mean and spread


def step_of(size: int) -> int:
    """Pixels from window to window; a window is two of them wide."""
    return max(size // (GRID + 1), 1)


def macs(size: int) -> int:
    """Multiply-accumulates of the branch for a square frame of ``size`` pixels: filters and the layers behind them."""
    step = step_of(size)
    width, rows = 2 * step, (GRID + 1) * step
    along_x = rows * GRID * 2 * COLUMNS * width
    along_y = GRID**2 * COLUMNS * 2 * ROWS * 2 * width
    around = HIDDEN[0] * REACH**2 + HIDDEN[0] ** 2
    layers = (FEATURES + PLACES) * HIDDEN[0] + BLOCKS * around + HIDDEN[0] * HIDDEN[1] + HIDDEN[1] * (2 + BESIDE)
    return along_x + along_y + GRID**2 * layers


def content_macs(channels: int) -> int:
    """Multiply-accumulates that :class:`InformedBranch` adds, for frames of any size."""
    return GRID**2 * (channels * HIDDEN[0] + HIDDEN[1] * 2)


@functools.lru_cache(maxsize=64)
def filters(size: int) -> tuple[Tensor, Tensor]:
    """Real and imaginary waves under their Hann weight: (2 COLUMNS, 1, 1, w) along x, (2 ROWS, 2, w, 1) along y.

    The second takes the real and imaginary part of the first and gives those of the product.
    """
    step = step_of(size)
    place = torch.arange(2 * step, dtype=torch.float64) + 0.5
    weight = torch.sin(math.pi * place / (2 * step)) ** 2
    weight = weight / weight.norm()
    period = size / ((GRID + 1) / 2)  # pixels of one wave a window, whatever the window was rounded to

    def waves(first: int, count: int) -> tuple[Tensor, Tensor]:
        frequency = (torch.arange(count) + first)[:, None] / period
        seen = (frequency.abs() <= 0.5 + 1e-9) * weight
        turn = 2 * math.pi * frequency * (place - step)
        return seen * torch.cos(turn), seen * torch.sin(turn)

    real, imaginary = waves(0, COLUMNS)
    across = torch.stack([real, imaginary], 1).reshape(2 * COLUMNS, 1, 1, -1)
    real, imaginary = waves(1 - WAVES, ROWS)
    down = torch.cat([torch.stack([real, -imaginary], 1), torch.stack([imaginary, real], 1)])[..., None]
    return across.float(), down.float()


def spectra(frames: Tensor) -> tuple[Tensor, Tensor]:
    """(batch, COLUMNS ROWS, GRID, GRID) power of every window, and (batch, 1, GRID, GRID) its mean under the weight.

    Args:
        frames: (batch, 1, size, size), standardised; the margin that no window covers is cut off evenly.
    """
    size = int(frames.shape[-1])
    step = step_of(size)
    first = (size - (GRID + 1) * step) // 2
    inside = slice(first, first + (GRID + 1) * step)
    across, down = (f.to(frames) for f in filters(size))
    half = F.conv2d(frames[..., inside, inside], across, stride=(1, step))
    rows = int(half.shape[2])
    both = F.conv2d(half.reshape(-1, 2, rows, GRID), down, stride=(step, 1))
    both = both.reshape(-1, COLUMNS, 2, ROWS, GRID, GRID)
    power = both[:, :, 0] ** 2 + both[:, :, 1] ** 2
    mean = both[:, 0, 0, WAVES - 1] / (4 / 3 * step)  # frequency 0 along both axes; the weight's sum squared
    return power.reshape(-1, COLUMNS * ROWS, GRID, GRID), mean[:, None]


@functools.lru_cache(maxsize=16)
def window_weights(size: int) -> Tensor:
    """(GRID, size) share of every pixel of a line in each window: the square of the weight, which power has; sum 1."""
    step = step_of(size)
    first = (size - (GRID + 1) * step) // 2
    weight = torch.sin(math.pi * (torch.arange(2 * step, dtype=torch.float64) + 0.5) / (2 * step)) ** 4
    out = torch.zeros(GRID, size, dtype=torch.float64)
    for i in range(GRID):
        out[i, first + i * step : first + (i + 2) * step] = weight / weight.sum()
    return out.float()


def window_vergence(depth_um: Tensor) -> Tensor:
    """(batch, GRID, GRID) mean 1 / depth of every window, in the units of the branch, from (batch, y, x) depths."""
    rows, columns = (window_weights(int(n)).to(depth_um) for n in depth_um.shape[-2:])
    vergence = (1e6 / depth_um - VERGENCE_PER_M) / VERGENCE_UNIT_PER_M
    return rows @ vergence @ columns.mT


def window_content(maps: Tensor) -> Tensor:
    """(batch, channels, GRID, GRID) mean over every window of maps (batch, channels, y, x) of the whole frame.

    The frame is averaged to as many steps of windows as it has, GRID + 1; a window is two of them wide.
    """
    height, width = (int(n) for n in maps.shape[-2:])
    steps, sides = GRID + 1, (max(1, height // (GRID + 1)), max(1, width // (GRID + 1)))
    coarse = F.avg_pool2d(maps, sides)
    if tuple(coarse.shape[-2:]) != (steps, steps):
        coarse = F.interpolate(coarse, size=(steps, steps), mode="bilinear", align_corners=False)
    return F.avg_pool2d(coarse, 2, 1)


def depth_mm(vergence: Tensor) -> Tensor:
    """Depth in mm of vergences in the units of the branch, between 5 mm and 1 m."""
    return 1e3 / (vergence * VERGENCE_UNIT_PER_M + VERGENCE_PER_M).clamp(1, 200)


class Around(nn.Module):
    """What its neighbours tell of a window, added to what it tells itself: x + mix(hardswish(depthwise(x)))."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.gather = nn.Conv2d(channels, channels, REACH, padding=REACH // 2, groups=channels)
        self.mix = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        added: Tensor = self.mix(F.hardswish(self.gather(x)))
        return x + added


class BlurBranch(nn.Module):
    """Depth of every window from its blur, with its spread: ``forward(frames) -> (depth, features)``.

    depth: (batch, 2, GRID, GRID) vergence in units of :data:`VERGENCE_UNIT_PER_M` about :data:`VERGENCE_PER_M`, and
    the logarithm of its standard deviation. features: (batch, SLIP_FEATURES) for the slippage.

    A PSF differs from window to window of the field, so every window weighs the spectra that the first layer has
    learned by gains and offsets of its own; they cost next to nothing. Its depth is then read together with its
    neighbours'. Beside it every window tells the slippage a few numbers that no label holds: depths alone, trained on
    their own, leave a fifth more error.
    """

    place: Tensor

    def __init__(self, norm: nn.Module) -> None:
        """``norm``: normalises the FEATURES channels."""
        super().__init__()
        self.norm = norm
        self.first = nn.Conv2d(FEATURES + PLACES, HIDDEN[0], 1)
        self.gain = nn.Parameter(torch.ones(HIDDEN[0], GRID, GRID))
        self.offset = nn.Parameter(torch.zeros(HIDDEN[0], GRID, GRID))
        self.around = nn.Sequential(*(Around(HIDDEN[0]) for _ in range(BLOCKS)))
        self.second = nn.Conv2d(HIDDEN[0], HIDDEN[1], 1)
        self.depth = nn.Conv2d(HIDDEN[1], 2 + BESIDE, 1)
        line = torch.linspace(-1, 1, GRID)
        x, y = line.expand(GRID, GRID), line[:, None].expand(GRID, GRID)
        self.register_buffer("place", torch.stack([x, y, x**2, y**2, x * y])[None].clone(), persistent=False)

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        weighed, mean = self._weighed(frames)
        return self._told(self.depth(self._read(weighed)), mean)

    def _weighed(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Spectra of every window under its own weights, (batch, HIDDEN[0], GRID, GRID), and its mean."""
        power, mean = spectra(frames)
        told = self.norm(torch.cat([torch.log(power + FLOOR), mean], 1))
        told = torch.cat([told, self.place + torch.zeros_like(mean)], 1)  # of as many frames, traced too
        return self.first(told) * self.gain + self.offset, mean

    def _read(self, weighed: Tensor) -> Tensor:
        """(batch, HIDDEN[1], GRID, GRID) of every window with its neighbours."""
        read: Tensor = F.hardswish(self.second(self.around(F.hardswish(weighed))))
        return read

    def _told(self, out: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
        spread = out[:, 1].clamp(-3, 2)
        depth = torch.stack([out[:, 0], spread], 1)
        trust = torch.exp(-2 * spread)
        total = trust.sum((1, 2))
        means = torch.stack([(trust * depth[:, 0]).sum((1, 2)) / total, spread.mean((1, 2))], 1)
        return depth, torch.cat([depth.flatten(1), mean.flatten(1), means, out[:, 2:].flatten(1)], 1)


class InformedBranch(BlurBranch):
    """The branch that is told what a window shows: ``forward(frames, content) -> (depth, features, axial)``.

    content: (batch, channels, y, x) of the whole frame, as the pupil's mask is decoded from. A power spectrum is that
    of texture times blur; whoever knows a pupil's edge from a lash knows the texture, and reads the blur from fewer
    frames. axial: (batch,) axial slippage, in units of its scale: every window's own estimate, with the shares that
    the windows claim (their softmax). What the calibration head makes of the depths is added to it.
    """

    def __init__(self, norm: nn.Module, channels: int) -> None:
        """``norm``: normalises the FEATURES channels. ``channels``: of the content."""
        super().__init__(norm)
        self.content = nn.Conv2d(channels, HIDDEN[0], 1)
        self.vote = nn.Conv2d(HIDDEN[1], 2, 1)

    def forward(self, frames: Tensor, content: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # type: ignore[override]
        weighed, mean = self._weighed(frames)
        read = self._read(weighed + self.content(window_content(content)))
        estimate, claim = self.vote(read).flatten(2).unbind(1)
        depth, features = self._told(self.depth(read), mean)
        return depth, features, (torch.softmax(claim, 1) * estimate).sum(1)
