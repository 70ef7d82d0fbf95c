"""Windows whose step is too coarse for samples: light integrated over their cells."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from metalens.core.errors import PropagationError
from metalens.propagate import PropagationCase, ray_cosines

MOST = 6000  # fine samples along an axis
BORDER = 2  # points around the window, for its differences
FINER = (2, 4, 8)  # points in Nyquist's step that are tried


@dataclass(frozen=True, slots=True)
class PixelCells:
    """points: along each axis of a cell, 1 where samples are close enough; case: with
    the finer window.

    left: of a wave at the highest frequency, which has most: what remains over the
    correction by fourth differences,
        and that correction over the one by second differences.
    """

    points: int
    case: PropagationCase
    left: tuple[float, float] = (0.0, 0.0)


def nyquist_um(case: PropagationCase) -> float:
    """Largest step at which samples of |U|² on the window fold nothing.

    Args:
        case: maps, geometry and window of the propagation.
    """
    (hy, hx), (cx, cy) = case.half_size_um, case.centre_um
    band = 0.0
    for half, centre, beside, away in ((hx, cx, hy, cy), (hy, cy, hx, cx)):
        far = max(abs(away) - beside, 0.0)
        p = ray_cosines(case, np.array([-half, half]) - centre, np.array([far, far]))
        band = max(band, float(p[1] - p[0]) / case.wavelength_um)
    return 1 / (2 * band)


def plan_pixel_cells(case: PropagationCase, finer: int = FINER[0]) -> PixelCells:
    """How a window is sampled: as it is, or ``finer`` points in Nyquist's step.

    Args:
        case: maps, geometry and window of the propagation.

    Raises:
        PropagationError: a step so coarse that its cells would take more than ``MOST``
            points along an axis.
    """
    limit = nyquist_um(case)
    if case.step_um <= limit * (1 + 1e-9):
        return PixelCells(1, case)
    points = finer * math.ceil(case.step_um / limit)
    count = max(case.samples) * points + 2 * BORDER
    if count > MOST:
        raise PropagationError(
            f"a window step of {case.step_um:.3g} um is above Nyquist's {limit:.3g} um of this aperture, and its cells "
            f"would take {count} points along an axis, at most {MOST}: give more samples or a smaller window"
        )
    down, across = (n * points + 2 * BORDER for n in case.samples)
    fine = replace(case, step_um=case.step_um / points, samples=(down, across))
    return PixelCells(points, fine, _left(math.sin(math.pi / (2 * finer))))


def _left(s: float) -> tuple[float, float]:
    """Of a wave that turns by 2 asin(s) from point to point, whose mean over the step
    between them is s / asin(s).
    """
    second, fourth = s**2 / 6, 17 / 360 * s**4
    return (1 - second - fourth - s / math.asin(s)) / fourth, fourth / second


def integrate_cells(
    light: torch.Tensor, fine: PixelCells
) -> tuple[torch.Tensor, float]:
    """(…, y, x) means over the cells of fine samples with a border of two, and the
    error of the integration.

    Within cells the differences add up to those of slopes at their borders, which may
    meet at 0 in the fourth order
    and not in the sixth: the second vouches for it.

    Args:
        light: (..., y, x) irradiance.
    """
    points, whole = fine.points, slice(BORDER, -BORDER)
    across, down = _second(light, -1), _second(light, -2)
    bent = (across[..., whole, 1:-1] + down[..., 1:-1, whole]) / 24
    fourth = (
        -17
        / 5760
        * (_second(across, -1)[..., whole, :] + _second(down, -2)[..., whole])
    )
    fourth = fourth + _second(across, -2)[..., 1:-1, 1:-1] / 576
    first, second, last = (
        _means(part, points) for part in (light[..., whole, whole], bent, fourth)
    )
    size, *sizes = (float(part.detach().norm()) for part in (first, second, last))
    error = (
        fine.left[0] * math.hypot(sizes[1], fine.left[1] * sizes[0]) / size
        if size
        else 0.0
    )
    return first + second + last, error


def _second(light: torch.Tensor, axis: int) -> torch.Tensor:
    """Second differences along an axis, two fewer."""
    count = light.shape[axis]
    low, middle, high = (light.narrow(axis, start, count - 2) for start in range(3))
    return low + high - 2 * middle


def _means(light: torch.Tensor, points: int) -> torch.Tensor:
    *batch, high, wide = light.shape
    parts = light.reshape(*batch, high // points, points, wide // points, points)
    return parts.mean((-3, -1))
