"""Rays of one field point: where they leave the lens, how they turn over the window, and
their paths from the sources.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from metalens.optics import Layers, Media, interpolant, media
from metalens.psf import VectorPupil, beyond_faces, of_flux, transmitted_polarization

OF_FLUX, OF_ENERGY = 4, 6  # components of the polarisation that leave nothing out


@dataclass(frozen=True, eq=False, slots=True)
class Rays:
    """Rays of nodes at equal steps of the direction p, (nodes, nodes) float64.

    x_um, y_um: where the rays leave the lens.
    width_um: of a node on the lens.
    whole: √spread of each ray, 0 beyond the rim.
    passed: root of the power that passes the faces.
    away_um: path to the window's centre less that along the normal.
    offset_p: (nodes,) p - p0 along x and along y.
    middle: (x, y) of p0, the middle of the pupil.
    slope, curvature: :func:`path_derivatives` at p0.
    """

    x_um: Tensor
    y_um: Tensor
    width_um: Tensor
    whole: Tensor
    passed: Tensor
    away_um: Tensor
    offset_p: Tensor
    middle: Tensor
    slope: Tensor
    curvature: Tensor


@functools.lru_cache(maxsize=4)  # a few MB each
def rays(
    after: Media,
    radius: float,
    at_um: tuple[float, float],
    nodes: tuple[int, float],
    device: torch.device,
) -> Rays:
    """Rays from a round lens to a place on the sensor, at equal steps of p = n sin θ.

    The nodes are centred on the middle of the pupil. A node across the rim has the
    share of its width that lies within the radius.

    Args:
        after: media behind the pillars.
        radius: of the lens, um.
        at_um: (x, y) place on the sensor, um.
        nodes: number along each axis, and their step of p.
        device: of the tensors.
    """
    count, step = nodes
    centre = torch.tensor(at_um, dtype=torch.float64, device=device)
    axis = (
        torch.arange(count, dtype=torch.float64, device=device) - (count - 1) / 2
    ) * step
    middle = middle_direction(after, radius, centre)
    py, px = torch.meshgrid(axis + middle[1], axis + middle[0], indexing="ij")
    p = torch.hypot(px, py).clamp(1e-12, 0.98 * after.layers[0][0])
    reach_per_p = media.lateral_reach(after, p) / p
    x = centre[0] - reach_per_p * px
    y = centre[1] - reach_per_p * py
    r = torch.hypot(x, y).clamp_min(1e-9)
    root_spread = torch.sqrt(media.area_spreading(after.layers, p * p))
    # share of each node within the rim; r changes over a node by root_spread * step
    inside = ((radius - r) / (root_spread * step) + 0.5).clamp(0, 1)
    passed = torch.sqrt(media.passed_at(after.order, p * p))
    return Rays(
        x,
        y,
        root_spread * step,
        inside * root_spread,
        passed,
        media.relative_path(after, p),
        axis,
        middle,
        *path_derivatives(after, middle),
    )


def middle_direction(after: Media, radius: float, centre: Tensor) -> Tensor:
    """(x, y) middle of the directions p from the rim of a round lens to a place.

    Args:
        after: media behind the pillars.
        radius: of the lens, um.
        centre: (x, y) place on the sensor, um.
    """
    azimuth = torch.arange(256).to(centre) * (2 * math.pi / 256)
    rim = centre - radius * torch.stack([torch.cos(azimuth), torch.sin(azimuth)], -1)
    reach = torch.hypot(rim[:, 0], rim[:, 1]).clamp_min(1e-9)
    p = media.ray_direction(after, reach)[:, None] * rim / reach[:, None]
    middle: Tensor = (p.amin(0) + p.amax(0)) / 2
    return middle


def through_stop(
    layers: Layers,
    tangents: tuple[float, float],
    bundle: Rays,
    depths_um: Tensor,
    wavelength_um: float,
) -> Tensor:
    """(depths, *shape) complex64 amplitude behind the stop over that without it.

    It is that of each source's light at the rays' places on the lens; 0 beyond the rim.

    Args:
        layers: films and stop of the lens.
        tangents: tangents of the field angles along x and y.
        bundle: rays of the nodes.
        depths_um: (depths,) source depths from the lens, um.
        wavelength_um: vacuum wavelength, um.
    """
    inside_rim = bundle.whole.cpu().numpy() > 0
    x, y, width = (
        part.cpu().numpy()[inside_rim]
        for part in (bundle.x_um, bundle.y_um, bundle.width_um)
    )
    shades = np.zeros((len(depths_um), *inside_rim.shape), np.complex64)
    for shade, depth in zip(shades, depths_um.tolist(), strict=True):
        shade[inside_rim] = layers.shadow(tangents, depth, wavelength_um, (x, y), width)
    return torch.from_numpy(shades).to(bundle.x_um.device)


def landing_offset(
    layers: Layers,
    carrier_rad: Callable[[Tensor, Tensor], Tensor],
    radius: float,
    seen_from: tuple[tuple[float, float], Media],
    depths_um: Tensor,
    wavelength_um: float,
) -> tuple[float, float]:
    """(x, y) from a field point to the centroid of its light on the sensor, um.

    The mean over rays and depths; (0, 0) without a stop. A ray of direction p lands at
    -(1/k) ∂(phase)/∂p. Oblique light through a stop crosses a part of the lens alone,
    and so lands off the ray through the lens' middle.

    Args:
        layers: films and stop of the lens.
        carrier_rad: phase of the lens at places (x, y), rad.
        radius: of the lens, um.
        seen_from: (x, y) field point in um, and the media behind the lens.
        depths_um: (depths,) source depths from the lens, um.
        wavelength_um: vacuum wavelength, um.
    """
    if layers.stop is None:
        return 0.0, 0.0
    place, after = seen_from
    rim, count = torch.tensor(radius, dtype=torch.float64), 24
    step = 2 * float(media.ray_direction(after, rim)) / count
    bundle = rays(after, radius, place, (count, step), torch.device("cpu"))
    tangents = place[0] / after.reduced_um, place[1] / after.reduced_um
    lens_path = (
        carrier_rad(bundle.x_um, bundle.y_um) * (wavelength_um / (2 * math.pi))
        + bundle.away_um
    )
    before = source_paths(layers, tangents, bundle, depths_um, wavelength_um)
    paths = lens_path + before
    sums = torch.zeros(3, dtype=torch.float64)
    for depth, path in zip(depths_um.tolist(), paths, strict=True):
        light = bundle.whole**2 * layers.stop_share(
            tangents, depth, wavelength_um, (bundle.x_um, bundle.y_um), bundle.width_um
        )
        by_y, by_x = torch.gradient(path, spacing=step)
        sums += torch.stack([-(light * by_x).sum(), -(light * by_y).sum(), light.sum()])
    x_um, y_um, total = sums.tolist()
    return (x_um / total, y_um / total) if total > 0 else (0.0, 0.0)


def path_derivatives(after: Media, middle: Tensor) -> tuple[Tensor, Tensor]:
    """(j, a, b) ∂H/∂p_j and (i, j, a, b) ∂²H/∂p_i∂p_j at a direction, 1/um.

    H = ∂p/∂X is 1/reach' along the ray's plane and p/reach across it. Central
    differences with a step of 1e-3 are exact to 1e-5.

    Args:
        after: media behind the pillars.
        middle: (x, y) direction p.
    """
    step = 1e-3
    unit = torch.eye(2, dtype=middle.dtype, device=middle.device) * step
    ends = torch.stack([unit, -unit])  # (sign, axis, 2)
    forward, backward = _turning(after, middle + ends)
    second = _turning(
        after, middle + ends[:, :, None, None] + ends
    )  # (sign, i, sign, j, a, b)
    slopes = (second[:, :, 0] - second[:, :, 1]) / (2 * step)
    return (forward - backward) / (2 * step), (slopes[0] - slopes[1]) / (2 * step)


def _turning(after: Media, p: Tensor) -> Tensor:
    """(…, 2, 2) H = ∂p/∂X: change of a ray's direction p by its place X, 1/um.

    Args:
        p: (…, [x, y]) directions.
    """
    size = torch.hypot(p[..., 0], p[..., 1]).clamp_min(1e-9)
    reach = media.lateral_reach(after, size)
    unit = p / size[..., None]
    along, across = (
        part[..., None, None]
        for part in (
            reach / (size * media.area_spreading(after.layers, size * size)),
            size / reach,
        )
    )
    turning: Tensor = (
        across * torch.eye(2).to(p)
        + (along - across) * unit[..., :, None] * unit[..., None, :]
    )
    return turning


def source_paths(
    layers: Layers,
    tangents: tuple[float, float],
    bundle: Rays,
    depths_um: Tensor,
    wavelength_um: float,
) -> Tensor:
    """(depths, *shape) optical paths from each source to the lens, less that to its
    middle, um.

    A Chebyshev interpolant in the squared reach, which is clamped at the rim of the
    lens, of :func:`metalens.optics.media.path_difference`.

    Args:
        layers: films and stop of the lens.
        tangents: (x, y) slopes of the ray to the lens' middle.
        bundle: rays of the nodes.
        depths_um: (depths,) source depths from the lens, um.
        wavelength_um: vacuum wavelength, um.
    """
    x, y = bundle.x_um, bundle.y_um
    slope = math.hypot(*tangents)
    sine = slope / math.hypot(1, slope)
    out = []
    for depth in depths_um.tolist():
        if math.isinf(depth):
            out.append((tangents[0] * x + tangents[1] * y) / math.hypot(1, slope))
            continue
        pairs = layers.before(depth, wavelength_um).layers
        reach = media.reach_per_direction(pairs, sine**2) / math.hypot(1, slope)
        change = x * x + y * y + 2 * reach * (x * tangents[0] + y * tangents[1])
        change = change.clamp(max=float((change * (bundle.whole > 0)).max()))
        difference = functools.partial(
            media.path_difference, pairs, sine**2, (slope * reach) ** 2
        )
        path = interpolant.chebyshev_interpolant(
            lambda u: difference(u)[1],  # noqa: B023 (called at once)
            change,
        )
        out.append(path)
    return torch.stack(out)


def polarisation_factors(
    bundle: Rays, tangents: Tensor, order: tuple[float, ...], *, flux: bool
) -> VectorPupil:
    """Factors of both polarisations on the pupil's nodes, (components, nodes, nodes).

    The flux through the sensor's plane has 8, whose squares with their signs add up to
    2. |E|² has 6 (:func:`metalens.psf.transmitted_polarization`), whose squares add up
    to 2 / cos θ.

    Args:
        bundle: rays of the nodes.
        tangents: (x, y) slopes of the chief ray in air.
        order: indices of the media from the pillars to the sensor.
        flux: whether the flux, else |E|².
    """
    q, p = torch.meshgrid(
        bundle.offset_p + bundle.middle[1],
        bundle.offset_p + bundle.middle[0],
        indexing="ij",
    )
    # nodes beyond the rim, which have no light, keep cos² = 1e-3 in the rarest medium
    scale2 = (1 - 1e-3) * min(order) ** 2 / (p * p + q * q).clamp_min(1e-3)
    p, q = (side * torch.sqrt(scale2.clamp_max(1)) for side in (p, q))
    first, last = (_directions(p / n, q / n) for n in (order[0], order[-1]))
    slope = torch.cat([tangents, tangents.new_ones(1)])
    electric = beyond_faces(
        transmitted_polarization(slope / slope.norm(), first), first, order
    )
    return (
        of_flux(electric, last) if flux else VectorPupil(electric, (1.0,) * OF_ENERGY)
    )


def _directions(p: Tensor, q: Tensor) -> Tensor:
    """(3, y, x) unit vectors towards the sensor from their parts along x and y."""
    return torch.stack([p, q, torch.sqrt(1 - p * p - q * q)])
