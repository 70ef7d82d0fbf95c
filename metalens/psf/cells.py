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
    """Largest step, um, at which samples of |U|² on the window have no aliases.

    λ / (2 (p1 - p0)), with p0 and p1 the direction cosines of the rays from both edges
    of the lens along an axis; the smaller of both axes.

    Args:
        case: geometry and window of the propagation.
    """
    hy, hx = case.half_size_um
    cx, cy = case.centre_um
    band = 0.0
    for half, centre, other_half, other in ((hx, cx, hy, cy), (hy, cy, hx, cx)):
        offset = max(abs(other) - other_half, 0.0)
        edges = np.array([-half, half]) - centre
        p = ray_cosines(case, edges, np.array([offset, offset]))
        band = max(band, float(p[1] - p[0]) / case.wavelength_um)
    return 1 / (2 * band)


def plan_pixel_cells(case: PropagationCase, finer: int = FINER[0]) -> PixelCells:
    """Sampling of a window: its own, or ``finer`` points within Nyquist's step.

    Args:
        case: geometry and window of the propagation.
        finer: points within Nyquist's step.

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
    # a wave of Nyquist's frequency advances by 2 angle from point to point; its mean
    # over a step is sin(angle) / angle, its corrections are s²/6 and 17 s⁴/360
    angle = math.pi / (2 * finer)
    s = math.sin(angle)
    second, fourth = s**2 / 6, 17 / 360 * s**4
    beyond = 1 - second - fourth - s / angle
    return PixelCells(points, fine, (beyond / fourth, fourth / second))


def integrate_cells(
    light: torch.Tensor, fine: PixelCells
) -> tuple[torch.Tensor, float]:
    """(…, y, x) means over cells of fine samples, and their relative L2 error.

    The mean over a sample's area is its value plus corrections by second and fourth
    differences. The error is estimated from both. Within a cell, differences add up to
    those of slopes at its borders; these may cancel in the fourth order alone, so the
    second order bounds the error as well.

    Args:
        light: (…, y, x) irradiance on the fine samples, with a border of two.
        fine: points of a cell, and the errors of the corrections.
    """
    points = fine.points
    whole = slice(BORDER, -BORDER)
    by_x = _second(light, -1)
    by_y = _second(light, -2)
    second_order = (by_x[..., whole, 1:-1] + by_y[..., 1:-1, whole]) / 24
    fourth_order = (
        -17 / 5760 * (_second(by_x, -1)[..., whole, :] + _second(by_y, -2)[..., whole])
    )
    fourth_order = fourth_order + _second(by_x, -2)[..., 1:-1, 1:-1] / 576
    first, second, last = (
        _means(part, points)
        for part in (light[..., whole, whole], second_order, fourth_order)
    )
    size, *sizes = (float(part.detach().norm()) for part in (first, second, last))
    error = 0.0
    if size:
        error = fine.left[0] * math.hypot(sizes[1], fine.left[1] * sizes[0]) / size
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
