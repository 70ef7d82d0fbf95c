"""Features of blur in each window of a frame: log power spectra and statistics of
brightness steps.
"""

import functools
import math

import torch
from torch import Tensor
from torch.nn import functional as F

GRID = 7  # windows along a side; neighbours overlap by half
WAVES = 8  # periods a window of the finest wave
COLUMNS, ROWS = WAVES + 1, 2 * WAVES  # of frequencies: 0 … 8 along x, -7 … 8 along y
FLOOR = 1e-2  # of the power, in units of the frame's variance a pixel

# along a side, on which steps are taken: the finest wave is at their Nyquist frequency
SAMPLES = 8 * (GRID + 1)
STEP_FLOOR = FLOOR / 4  # of a squared step, in units of the frame's variance
STEPS: tuple[
    tuple[tuple[int, int, int], ...], ...
] = (  # of a sample from its neighbours: (x, y, weight)
    ((0, 0, 1), (-1, 0, -1)),
    ((0, 0, 1), (0, -1, -1)),
    ((0, 0, 1), (-1, -1, -1)),
    ((0, 0, 1), (1, -1, -1)),
    ((-1, 0, 1), (0, 0, -2), (1, 0, 1)),
    ((0, -1, 1), (0, 0, -2), (0, 1, 1)),
    ((-1, 0, 1), (1, 0, 1), (0, -1, 1), (0, 1, 1), (0, 0, -4)),
)
REACHES = (1, 2)  # samples from neighbour to neighbour, of means over as many
# of every kind of step: mean and spread of the logarithm of its square, and its
# steepest
STATISTICS = 3
STEP_FEATURES = STATISTICS * len(STEPS) * len(REACHES)
STEP_MACS = SAMPLES**2 * (len(REACHES) * sum(len(taps) for taps in STEPS) + 4)


def step_of(size: int) -> int:
    """Pixels from window to window; a window is two of them wide.

    Args:
        size: side of the frame in pixels.
    """
    return max(size // (GRID + 1), 1)


def spectra_macs(size: int) -> int:
    """Multiply-accumulates of :func:`window_spectra` for a square frame of ``size``
    pixels.
    """
    step = step_of(size)
    kinds = 2 * WAVES + 1  # cosines and sines
    return ((GRID + 1) * step * GRID + GRID**2 * COLUMNS * 2) * kinds * step


@functools.lru_cache(maxsize=64)
def hann_filters(size: int) -> tuple[Tensor, Tensor]:
    """Cosines (step, 0 … 8 periods) and sines (step, 1 … 8) times the Hann weight.

    On the second half of a window, from its centre: cosines are even about it, sines
    odd.

    Args:
        size: side of the frame in pixels.
    """
    step = step_of(size)
    position = torch.arange(step, dtype=torch.float64)[:, None] + 0.5
    weight = torch.cos(math.pi * position / (2 * step)) ** 2
    weight = weight / (math.sqrt(2) * weight.norm())
    # pixels of one wave a window, before rounding of the window
    period = size / ((GRID + 1) / 2)
    frequency = torch.arange(WAVES + 1) / period
    # frequencies above Nyquist are 0
    window = (frequency <= 0.5 + 1e-9) * weight
    phase = 2 * math.pi * frequency * position
    return (window * torch.cos(phase)).float(), (window * torch.sin(phase))[
        :, 1:
    ].float()


def window_spectra(frames: Tensor) -> tuple[Tensor, Tensor]:
    """Hann-weighted power spectrum of every window, and its weighted mean.

    (batch, COLUMNS ROWS, GRID, GRID) and (batch, 1, GRID, GRID). Separable, and folded
    about the centre of a window: one product serves a pixel and its mirror image, a
    frequency and its negative.

    Args:
        frames: (batch, 1, size, size), standardised; the margin outside all windows is
            cut off evenly.
    """
    size = int(frames.shape[-1])
    step = step_of(size)
    first = (size - (GRID + 1) * step) // 2
    inside = slice(first, first + (GRID + 1) * step)
    cosine, sine = (f.to(frames) for f in hann_filters(size))
    even, odd = _folded(frames[:, 0, inside, inside], 2)
    # (batch, rows, windows along x, COLUMNS)
    real = even @ cosine
    imaginary = F.pad(odd @ sine, (1, 0))
    (real_even, real_odd), (imaginary_even, imaginary_odd) = (
        _folded(part, 1) for part in (real, imaginary)
    )
    # (batch, windows along y, along x, COLUMNS, frequencies)
    rc = real_even @ cosine
    ic = imaginary_even @ cosine
    rs, js = (F.pad(part @ sine, (1, 0)) for part in (real_odd, imaginary_odd))
    up = (rc - js) ** 2 + (ic + rs) ** 2
    down = (rc + js) ** 2 + (ic - rs) ** 2
    power = torch.cat([down[..., 1:WAVES].flip(-1), up], -1)
    # frequency 0 along both axes, over the squared sum of the weight
    mean = rc[..., 0, 0] / (4 / 3 * step)
    power = power.permute(0, 3, 4, 1, 2).reshape(-1, COLUMNS * ROWS, GRID, GRID)
    return power, mean[:, None]


def gradient_statistics(frames: Tensor) -> Tensor:
    """(batch, STEP_FEATURES, GRID, GRID) statistics of squared brightness steps by
    window.

    For every kind of step, squares s in units of STEP_FLOOR: mean of log(1 + s), its
    standard deviation, and log(1 + mean s⁴) / 4, which the steepest steps dominate.

    Args:
        frames: (batch, 1, size, size), standardised; resampled to SAMPLES along a side.
    """
    fine = resample_image(frames, (SAMPLES, SAMPLES))
    coarse = F.avg_pool2d(F.pad(fine, (0, 1, 0, 1), mode="replicate"), 2, 1)
    mean, second, steepest = (window_content(part) for part in _moments([fine, coarse]))
    spread = torch.sqrt((second - mean**2).clamp_min(0) + 1e-4)
    return torch.cat([mean, spread, torch.log1p(steepest / STEP_FLOOR**4) / 4], 1)


def window_content(maps: Tensor) -> Tensor:
    """(batch, channels, GRID, GRID) mean over every window of maps of the whole frame.

    The frame is averaged to GRID + 1 steps; a window is two steps wide.

    Args:
        maps: (batch, channels, y, x).
    """
    height, width = (int(n) for n in maps.shape[-2:])
    steps = GRID + 1
    sides = (max(1, height // (GRID + 1)), max(1, width // (GRID + 1)))
    coarse = F.avg_pool2d(maps, sides)
    if tuple(coarse.shape[-2:]) != (steps, steps):
        coarse = F.interpolate(
            coarse, size=(steps, steps), mode="bilinear", align_corners=False
        )
    return F.avg_pool2d(coarse, 2, 1)


def resample_image(x: Tensor, size: tuple[int, int]) -> Tensor:
    """(batch, channels, *size) resampled: averaged by whole factors, then interpolated.

    Args:
        x: (batch, channels, y, x) features. size: (y, x) of the result.
    """
    factor = [
        max(1, int(have) // want) for have, want in zip(x.shape[-2:], size, strict=True)
    ]
    pooled = F.avg_pool2d(x, factor) if max(factor) > 1 else x
    if tuple(int(s) for s in pooled.shape[-2:]) == size:
        return pooled
    return F.interpolate(pooled, size=size, mode="bilinear", align_corners=False)


def _folded(x: Tensor, along: int) -> tuple[Tensor, Tensor]:
    """Windows along an axis, from their centre outwards: sums and differences with the
    mirror.

    The windows become an axis of GRID, the pixels of half a window the last axis.

    Args:
        x: (batch, y, x, ...). along: axis that is split.
    """
    sides = [int(n) for n in x.shape[1:]]
    sides[along - 1 : along] = [GRID + 1, sides[along - 1] // (GRID + 1)]
    halves = x.reshape(-1, *sides).movedim(along + 1, -1)
    before = halves.narrow(along, 0, GRID).flip(-1)
    after = halves.narrow(along, 1, GRID)
    return after + before, after - before


def _moments(samples: list[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """(batch, kinds, y, x) each: log(1 + s / STEP_FLOOR), its square, and s⁴.

    s are the squared steps of :func:`_steps`; windows average the maps.

    Args:
        samples: (batch, 1, y, x) for each of REACHES.
    """
    steps = [_steps(grid, reach) for grid, reach in zip(samples, REACHES, strict=True)]
    square = torch.cat(steps, 1) ** 2
    logs = torch.log1p(square / STEP_FLOOR)
    # squared twice: a fourth power would be a function call for every number
    return logs, logs**2, (square**2) ** 2


def _steps(samples: Tensor, reach: int) -> Tensor:
    """(batch, kinds, y, x) differences of neighbours ``reach`` samples apart, edges
    replicated.

    Normalised to variance 1 on white noise.

    Args:
        samples: (batch, 1, y, x).
    """
    rows, columns = (int(n) for n in samples.shape[-2:])
    padded = F.pad(samples, (reach,) * 4, mode="replicate")

    def shifted(x: int, y: int) -> Tensor:
        top, left = reach * (1 + y), reach * (1 + x)
        return padded[..., top : top + rows, left : left + columns]

    kinds = []
    for taps in STEPS:
        norm = math.sqrt(sum(weight**2 for _, _, weight in taps))
        first, *rest = (weight / norm * shifted(x, y) for x, y, weight in taps)
        kinds.append(sum(rest, first))
    return torch.cat(kinds, 1)
