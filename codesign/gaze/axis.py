"""Spherical-eye solver: pupil centre and slippage to the optical axis of the eye.

Camera frame: z towards the eye, x right and y down on the image.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from metalens.core.errors import SceneError


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

    def __post_init__(self) -> None:
        if not (self.radius_mm > 0 and self.sensor_distance_mm > 0):
            raise SceneError(
                f"radius_mm = {self.radius_mm}, sensor_distance_mm = {self.sensor_distance_mm}: need both above 0"
            )


def optical_axis(pupil_mm: Tensor, slip_mm: Tensor, geometry: EyeGeometry) -> Tensor:
    """(batch, 3) optical axis: the ray through the pupil's image meets the sphere on
    which the pupil moves.

    The slippage moves the camera, so the eye is at C = centre - slip. With the unit ray
    u the first intersection is at t = u·C - sqrt((u·C)² - |C|² + R²). A ray that
    misses gives the place on the sphere nearest to it, with a finite gradient.

    Args:
        pupil_mm: (batch, 2) pupil centre x, y on the sensor, upright image, from the
            lens axis.
        slip_mm: (batch, 3) displacement of the camera. geometry: of the person.
    """
    x, y = pupil_mm[..., 0], pupil_mm[..., 1]
    ray = torch.stack([x, y, torch.full_like(x, geometry.sensor_distance_mm)], -1)
    ray = ray / ray.norm(dim=-1, keepdim=True)
    centre = (
        torch.tensor(geometry.centre_mm, dtype=ray.dtype, device=ray.device) - slip_mm
    )
    along = (ray * centre).sum(-1)
    # from the closest point of the ray to the centre
    perpendicular = centre - along[..., None] * ray
    discriminant = geometry.radius_mm**2 - (perpendicular**2).sum(-1)
    hit = discriminant > 0
    depth = (
        torch.sqrt(torch.where(hit, discriminant, torch.ones_like(discriminant))) * hit
    )
    offset = -perpendicular - depth[..., None] * ray
    direction: Tensor = offset / offset.norm(dim=-1, keepdim=True)
    return direction


def angle_rad(one: Tensor, other: Tensor) -> Tensor:
    """(batch,) angle between directions, 2 atan2(|a - b|, |a + b|) of unit vectors,
    rad.

    Accurate and differentiable down to zero.

    Args:
        one: to compare. other: the reference.
    """
    a = one / one.norm(dim=-1, keepdim=True)
    b = other / other.norm(dim=-1, keepdim=True)
    square = ((a - b) ** 2).sum(-1)
    distance = torch.sqrt(torch.where(square > 0, square, torch.ones_like(square))) * (
        square > 0
    )
    return 2 * torch.atan2(distance, (a + b).norm(dim=-1))
