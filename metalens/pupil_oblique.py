"""Quick PSFs of smooth pupil phases at a field angle: the pupil seen from where the chief ray meets the sensor.

As :mod:`metalens.pupil`, whose nodes carry the phase: direction cosines are counted from the off-axis window, so that
the lens-to-window propagation stays a Fourier transform, and each of them takes the phase of the nearest node.
"""

import functools
import math
from dataclasses import dataclass

import torch

from metalens import pupil as pupils
from metalens.pupil import Pupil, wrapped

Tensor = torch.Tensor


@dataclass(frozen=True, slots=True)
class Field:
    """A place in the field: ``angle_rad`` from the axis, in the direction ``azimuth_rad`` from +x."""

    angle_rad: float = 0.0
    azimuth_rad: float = 0.0


@dataclass(frozen=True, eq=False, slots=True)
class Seen:
    """The pupil as seen from the window's centre, on (nodes, nodes) direction cosines.

    x_um, y_um: where the rays leave the lens. weight: share of each cell inside the aperture, and the solid angle.
    node: index of the nearest node of the pupil, row * nodes + column.
    lens_rad: hyperbolic phase of the focus and path to the window's centre, less that of the lens' centre.
    """

    x_um: Tensor
    y_um: Tensor
    weight: Tensor
    node: Tensor
    lens_rad: Tensor


def psf(
    phase_rad: Tensor,
    pupil: Pupil,
    *,
    depths_um: Tensor,
    fields: list[Field],
    focus_um: float,
    sample_um: float = 0.75,
    samples: int = 192,
) -> Tensor:
    """Intensity around the chief ray of point sources at depths and field angles, one of each for every image.

    Args:
        phase_rad: (nodes, nodes) on the nodes of the pupil, differentiable.
        depths_um: (images,) along the axis. fields: (images,) of them.
        focus_um, sample_um, samples: as for :func:`metalens.pupil.psf`.

    Returns:
        (images, samples, samples): share of the light through the aperture on each sample; float32.
    """
    kernel = pupils.kernel(pupil, sample_um, samples)
    k = 2 * math.pi / pupil.wavelength_um
    angles, weights = [], []
    flat = phase_rad.reshape(-1)
    for depth, field in zip(depths_um.tolist(), fields, strict=True):
        seen = view(pupil, field, focus_um)
        path = oblique_path(seen.x_um, seen.y_um, field, -depth)
        angles.append(wrapped(seen.lens_rad + k * path).float() + wrapped(flat[seen.node]).float())
        weights.append(seen.weight)
    image = kernel @ (torch.polar(torch.stack(weights), torch.stack(angles)) @ kernel.mT)
    return (image.real**2 + image.imag**2) * (sample_um / pupil.period_um) ** 2 / _light(weights)


def oblique_path(x_um: Tensor, y_um: Tensor, field: Field, distance_um: float) -> Tensor:
    """Path from the lens at (x, y) to the chief ray's point at a distance (below 0: in front), less the chief ray's."""
    out = distance_um * math.tan(field.angle_rad)
    px, py = out * math.cos(field.azimuth_rad), out * math.sin(field.azimuth_rad)
    extra = x_um**2 + y_um**2 - 2 * (x_um * px + y_um * py)
    chief = math.hypot(out, distance_um)
    return extra / (torch.sqrt(chief**2 + extra) + chief)


@functools.lru_cache(maxsize=64)
def view(pupil: Pupil, field: Field, focus_um: float) -> Seen:
    """The pupil from the place where the chief ray of a field meets the sensor."""
    d, edge, n = pupil.sensor_distance_um, pupil.edge, pupil.nodes
    out = d * math.tan(field.angle_rad)
    cx, cy = out * math.cos(field.azimuth_rad), out * math.sin(field.azimuth_rad)
    mx, my = _middle(pupil.radius_um, cx, cy, d)
    axis = pupils.axis(pupil)
    qy, qx = torch.meshgrid(axis + my, axis + mx, indexing="ij")
    rest = (1 - qx**2 - qy**2).clamp_min(1e-3)
    x, y = cx + qx * d / torch.sqrt(rest), cy + qy * d / torch.sqrt(rest)
    r = torch.hypot(x, y)
    step = 2 * edge / n * d / torch.sqrt(rest)  # of the nodes, on the lens, across the line of sight
    weight = ((pupil.radius_um - r) / step + 0.5).clamp(0, 1) / rest
    path = torch.sqrt(r**2 + d**2)
    row, column = (torch.round(a / path * n / (2 * edge) + (n - 1) / 2).clamp(0, n - 1).long() for a in (y, x))
    k = 2 * math.pi / pupil.wavelength_um
    focus = pupils.spherical_path(r, d) + pupils.spherical_path(r, focus_um)
    lens = k * (oblique_path(x, y, field, d) - focus)
    return Seen(x, y, weight.float(), row * n + column, lens)


def _middle(radius_um: float, cx: float, cy: float, d: float) -> tuple[float, float]:
    """Middle of the direction cosines that the aperture fills."""
    turn = torch.arange(256, dtype=torch.float64) * (2 * math.pi / 256)
    x, y = radius_um * torch.cos(turn) - cx, radius_um * torch.sin(turn) - cy
    path = torch.sqrt(x**2 + y**2 + d**2)
    qx, qy = x / path, y / path
    return float(qx.min() + qx.max()) / 2, float(qy.min() + qy.max()) / 2


def _light(weights: list[Tensor]) -> Tensor:
    return torch.stack([(w**2).sum() for w in weights])[:, None, None]
