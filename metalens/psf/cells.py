"""Windows whose step is too coarse for samples: light integrated over their cells.

|U|² holds spatial frequencies up to B = (largest - least n sin θ) / λ of the rays to the window; samples farther apart
than 1/(2B) fold them. Such a cell is the mean of m x m points of half that distance or less, corrected for what the
midpoint rule leaves of second differences, h²/24 f''; the rest falls with the fourth power of their distance.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from metalens.ground.errors import PropagationError
from metalens.propagate import Case, cosines

MOST = 6000  # fine samples along an axis
FINER = (2, 4, 8)  # points in Nyquist's step that are tried


@dataclass(frozen=True, slots=True)
class Cells:
    """points: along each axis of a cell, 1 where samples are close enough; case: with the finer window.

    left: of the correction by second differences, what remains: 0.114 (pi f h)², f the highest frequency; a perfect
        lens's light leaves 0.088, a wave at f alone, which no lens sends, 0.32.
    """

    points: int
    case: Case
    left: float = 0.0


def nyquist_um(case: Case) -> float:
    """Largest step at which samples of |U|² on the window fold nothing."""
    (hy, hx), (cx, cy) = case.half_size_um, case.centre_um
    band = 0.0
    for half, centre, beside, away in ((hx, cx, hy, cy), (hy, cy, hx, cx)):
        far = max(abs(away) - beside, 0.0)
        p = cosines(case, np.array([-half, half]) - centre, np.array([far, far]))
        band = max(band, float(p[1] - p[0]) / case.wavelength_um)
    return 1 / (2 * band)


def cells(case: Case, finer: int = FINER[0]) -> Cells:
    """How a window is sampled: as it is, or ``finer`` points in Nyquist's step.

    Raises:
        PropagationError: a step so coarse that its cells would take more than ``MOST`` points along an axis.
    """
    limit = nyquist_um(case)
    if case.step_um <= limit * (1 + 1e-9):
        return Cells(1, case)
    points = finer * math.ceil(case.step_um / limit)
    count = max(case.samples) * points + 2
    if count > MOST:
        raise PropagationError(
            f"a window step of {case.step_um:.3g} um is above Nyquist's {limit:.3g} um of this aperture, and its cells "
            f"would take {count} points along an axis, at most {MOST}: give more samples or a smaller window"
        )
    fine = replace(
        case, step_um=case.step_um / points, samples=(case.samples[0] * points + 2, case.samples[1] * points + 2)
    )
    return Cells(points, fine, 0.114 * (math.pi / (2 * finer)) ** 2)


def integrated(light: torch.Tensor, fine: Cells) -> tuple[torch.Tensor, float]:
    """(…, y, x) means over the cells of fine samples with a border of one, and the error of the integration."""
    points = fine.points
    inner = light[..., 1:-1, 1:-1]
    beside = light[..., 2:, 1:-1] + light[..., :-2, 1:-1] + light[..., 1:-1, 2:] + light[..., 1:-1, :-2]
    plain, bent = _means(inner, points), _means(beside - 4 * inner, points) / 24
    size = float(plain.detach().norm())
    return plain + bent, fine.left * float(bent.detach().norm()) / size if size else 0.0


def _means(light: torch.Tensor, points: int) -> torch.Tensor:
    *batch, high, wide = light.shape
    parts = light.reshape(*batch, high // points, points, wide // points, points)
    return parts.mean((-3, -1))
