"""Exposure at the rims of pillars by the plain sum over all pillars: what every quick
way is judged by.
"""

import numpy as np

from layout.pec.psf import PointExposure, disc_exposure, rim_of_own_disc
from metalens.core.arrays import Array


def at_edges(
    centres_um: Array,
    diameter_um: Array,
    dose: Array,
    point: PointExposure,
    *,
    which: Array,
    rim_points: int = 24,
) -> Array:
    """Exposure at the edge of pillars, averaged round the rim, by the direct sum over
    all pillars.

    Args:
        centres_um: (n, 2) x, y; diameter_um, dose: (n,).
        which: (m,) indices of the pillars that are looked at.

    Returns:
        (m,) exposure; 1/2 at the edge of a wide area of dose 1.

    Accuracy: trapezoidal mean of a periodic function: exact to rounding for smooth
    neighbours; costs m n rim_points.
    """
    angle = 2 * np.pi * (np.arange(rim_points) + 0.5) / rim_points
    ring = np.stack([np.cos(angle), np.sin(angle)], -1)
    result = np.zeros(len(which))
    for row, index in enumerate(np.asarray(which)):
        others = np.arange(len(dose)) != index
        points = centres_um[index] + diameter_um[index] / 2 * ring
        distance = np.linalg.norm(points[:, None] - centres_um[others], axis=-1)
        for width, weight in zip(point.widths_um, point.weights, strict=True):
            near = (
                (disc_exposure(distance, diameter_um[others], width) * dose[others])
                .sum(-1)
                .mean()
            )
            result[row] += weight * (
                near + dose[index] * rim_of_own_disc(diameter_um[index], width)
            )
    return result
