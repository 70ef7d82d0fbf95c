"""Spherical-eye solver: pupil centre and slippage to the optical axis of the eye.

Camera frame: z towards the eye, x right and y down on the image.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True, slots=True)
class EyeGeometry:
    """Where the eye of a population mean sits before the camera, and how it is built.

    centre_mm: rotation centre of the eye at zero slippage.
    radius_mm: rotation centre to the pupil (13.1 mm from the corneal apex less 3.05 mm
    of anterior chamber,
        Le Grand's eye; apex to rotation centre after Guestrin and Eizenman 2006).
    sensor_distance_mm: lens to sensor: turns a place on the sensor into a ray.
    """

    centre_mm: tuple[float, float, float]
    radius_mm: float = 10.05
    sensor_distance_mm: float = 2.0


def optical_axis(pupil_mm: Any, slip_mm: Any, geometry: EyeGeometry) -> Any:
    """(batch, 3) optical axis: the ray through the pupil's image meets the sphere on
    which the pupil moves.

    The slippage moves the camera, so the eye is at C = centre - slip. With the unit ray
    u the first intersection is at t = u·C - sqrt((u·C)² - |C|² + R²). A ray that
    misses gives the place on the sphere nearest to it, with a finite gradient.

    Arrays of numpy or torch; differentiable.

    Args:
        pupil_mm: (batch, 2) pupil centre x, y on the sensor, upright image, from the
            lens axis.
        slip_mm: (batch, 3) displacement of the camera. geometry: of the person.
    """
    xp: Any = torch if isinstance(pupil_mm, Tensor) else np
    x, y = pupil_mm[..., 0], pupil_mm[..., 1]
    ray = _unit(xp.stack([x, y, xp.full_like(x, geometry.sensor_distance_mm)], -1))
    centre = xp.asarray(geometry.centre_mm, dtype=ray.dtype) - slip_mm
    along = (ray * centre).sum(-1)
    # from the closest point of the ray to the centre
    perpendicular = centre - along[..., None] * ray
    discriminant = geometry.radius_mm**2 - (perpendicular**2).sum(-1)
    hit = discriminant > 0
    depth = xp.sqrt(xp.where(hit, discriminant, 1.0)) * hit
    return _unit(-perpendicular - depth[..., None] * ray)


def _unit(vectors: Any) -> Any:
    """Vectors (..., 3) over their lengths."""
    return vectors / ((vectors**2).sum(-1) ** 0.5)[..., None]


def angle_rad(one: Any, other: Any) -> Any:
    """(batch,) angle between directions, 2 atan2(|a - b|, |a + b|) of unit vectors,
    rad.

    Accurate and differentiable down to zero.

    Args:
        one: to compare. other: the reference.
    """
    xp: Any = torch if isinstance(one, Tensor) else np
    a, b = _unit(one), _unit(other)
    square = ((a - b) ** 2).sum(-1)
    distance = xp.sqrt(xp.where(square > 0, square, 1.0)) * (square > 0)
    return 2 * xp.atan2(distance, ((a + b) ** 2).sum(-1) ** 0.5)
