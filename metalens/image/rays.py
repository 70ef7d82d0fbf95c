"""Rays of one field point: where they leave the lens, how the window bends them, and
their paths from the sources.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from metalens.optics import Layers, Media, interpolant, media

VERGENCES = 5  # Chebyshev points of 1/z for the paths of many depths


@dataclass(frozen=True, eq=False, slots=True)
class Rays:
    """Rays of nodes at equal steps of the direction p, (nodes, nodes) float64 on the
    lens.

    width_um: of a node on the lens; whole: √spread of each, 0 beyond the rim; passed:
    root of the power that faces let
    through; away_um: path to the window's centre less that along the normal. offset_p:
    (nodes,) p - p0 along x and along
    y; middle: (x, y) of p0, the middle of the pupil. slope, curvature: :func:`path_derivatives`
    there.
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


@dataclass(frozen=True, eq=False, slots=True)
class Paths:
    """Optical paths of many depths as mixtures of a few: mix (depths, few) times few_um
    (few, *shape), float64.
    """

    few_um: Tensor
    mix: Tensor

    @property
    def um(self) -> Tensor:
        """(depths, *shape) paths."""
        return (self.mix @ self.few_um.flatten(1)).reshape(-1, *self.few_um.shape[1:])


@functools.lru_cache(maxsize=4)  # a few MB each
def rays(
    after: Media,
    radius: float,
    at_um: tuple[float, float],
    nodes: tuple[int, float],
    device: torch.device,
) -> Rays:
    """Rays to a place (x, y) of the sensor from a lens of this radius; nodes: their
    number and their step of p.

    Args:
        after: media behind the pillars.
        at_um: (points, 2) field points on the sensor, um.
        device: torch device.
    """
    count, width = nodes
    centre = torch.tensor(at_um, dtype=torch.float64, device=device)
    axis = (
        torch.arange(count, dtype=torch.float64, device=device) - (count - 1) / 2
    ) * width
    turn = torch.arange(256, dtype=torch.float64, device=device) * (2 * math.pi / 256)
    rim = centre - radius * torch.stack([torch.cos(turn), torch.sin(turn)], -1)
    far = torch.hypot(rim[:, 0], rim[:, 1]).clamp_min(1e-9)
    edge = media.ray_direction(after, far)[:, None] * rim / far[:, None]
    middle = (edge.amin(0) + edge.amax(0)) / 2
    py, px = torch.meshgrid(axis + middle[1], axis + middle[0], indexing="ij")
    p = torch.hypot(px, py).clamp(1e-12, 0.98 * after.layers[0][0])
    out = media.lateral_reach(after, p) / p
    x, y = centre[0] - out * px, centre[1] - out * py
    r = torch.hypot(x, y).clamp_min(1e-9)
    wide = torch.sqrt(media.area_spreading(after, p))
    inside = ((radius - r) / (wide * width) + 0.5).clamp(
        0, 1
    )  # of a node across the rim, as wide as r changes with p
    passed = torch.sqrt(media.transmitted_power(after.order, p))
    return Rays(
        x,
        y,
        wide * width,
        inside * wide,
        passed,
        media.relative_path(after, p),
        axis,
        middle,
        *path_derivatives(after, middle),
    )


@functools.lru_cache(maxsize=4)  # a few MB each
def through_stop(
    layers: Layers,
    tangents: tuple[float, float],
    bundle: Rays,
    depths_um: tuple[float, ...],
    wavelength_um: float,
) -> Tensor:
    """(depths, *shape) complex64 amplitude of each source's light behind the stop at
    (x, y), over that without; 0
    beyond the rim of the lens.

    Args:
        layers: films and stop of the lens.
        tangents: tangents of the field angles along x and y.
        bundle: rays of the nodes.
        depths_um: source depths from the lens, um.
        wavelength_um: vacuum wavelength, um.
    """
    inside_rim = bundle.whole.cpu().numpy() > 0
    x, y, width = (
        part.cpu().numpy()[inside_rim]
        for part in (bundle.x_um, bundle.y_um, bundle.width_um)
    )
    out = np.zeros((len(depths_um), *inside_rim.shape), np.complex64)
    for one, depth in zip(out, depths_um, strict=True):
        one[inside_rim] = layers.shadow(tangents, depth, wavelength_um, (x, y), width)
    return torch.from_numpy(out).to(bundle.x_um.device)


def landing_offset(
    layers: Layers,
    carrier_rad: Callable[[Tensor, Tensor], Tensor],
    radius: float,
    seen_from: tuple[tuple[float, float], Media],
    depths_um: Tensor,
    wavelength_um: float,
) -> tuple[float, float]:
    """(x, y) um beside a field point at which its light lands, mean over its rays and
    depths; (0, 0) without a stop.

    A ray of direction p lands at -(1/k) ∂(phase)/∂p. A stop before a lens lets light
    from the side through one part of
    it alone, by which it lands beside the ray through the middle.

    Args:
        layers: films and stop of the lens.
        radius: radius of the aperture or circle, um.
        depths_um: source depths from the lens, um.
        wavelength_um: vacuum wavelength, um.
        carrier_rad: phase of the lens at places (x, y). seen_from: the field point, and
            the media behind the lens.
    """
    if layers.stop is None:
        return 0.0, 0.0
    place, after = seen_from
    rim, count = torch.tensor(radius, dtype=torch.float64), 24
    step = 2 * float(media.ray_direction(after, rim)) / count
    found = rays(after, radius, place, (count, step), torch.device("cpu"))
    tangents = place[0] / after.reduced_um, place[1] / after.reduced_um
    own = (
        carrier_rad(found.x_um, found.y_um) * (wavelength_um / (2 * math.pi))
        + found.away_um
    )
    paths = (
        own
        + source_paths(
            layers, torch.tensor(tangents), found, depths_um, wavelength_um
        ).um
    )
    sums = torch.zeros(3, dtype=torch.float64)
    for depth, path in zip(depths_um.tolist(), paths, strict=True):
        light = found.whole**2 * layers.stop_share(
            tangents, depth, wavelength_um, (found.x_um, found.y_um), found.width_um
        )
        y, x = torch.gradient(path, spacing=step)
        sums += torch.stack([-(light * x).sum(), -(light * y).sum(), light.sum()])
    x_um, y_um, given = sums.tolist()
    return (x_um / given, y_um / given) if given > 0 else (0.0, 0.0)


def path_derivatives(after: Media, middle: Tensor) -> tuple[Tensor, Tensor]:
    """(j, a, b) ∂H/∂p_j and (i, j, a, b) ∂²H/∂p_i∂p_j at a direction, 1/um.

    H = ∂p/∂X is 1/reach' along the ray's plane and p/reach across it; differences of
    1e-3, exact to 1e-5 of them.

    Args:
        after: media behind the pillars.
    """
    step = 1e-3
    unit = torch.eye(2, dtype=middle.dtype, device=middle.device) * step
    ends = torch.stack([unit, -unit])  # (sign, axis, 2)
    ahead, behind = _turning(after, middle + ends)
    both = _turning(
        after, middle + ends[:, :, None, None] + ends
    )  # (sign, i, sign, j, a, b)
    slopes = (both[:, :, 0] - both[:, :, 1]) / (2 * step)
    return (ahead - behind) / (2 * step), (slopes[0] - slopes[1]) / (2 * step)


def _turning(after: Media, p: Tensor) -> Tensor:
    """(…, 2, 2) H of directions (…, 2): how the direction towards a window turns as the
    window moves.
    """
    size = torch.hypot(p[..., 0], p[..., 1]).clamp_min(1e-9)
    reach, unit = media.lateral_reach(after, size), p / size[..., None]
    along, across = (
        part[..., None, None]
        for part in (reach / (size * media.area_spreading(after, size)), size / reach)
    )
    turning: Tensor = (
        across * torch.eye(2).to(p)
        + (along - across) * unit[..., :, None] * unit[..., None, :]
    )
    return turning


def source_paths(
    layers: Layers,
    tangents: Tensor,
    bundle: Rays,
    depths_um: Tensor,
    wavelength_um: float,
) -> Paths:
    """Optical path from each source to the lens at (x, y), less the path to its middle.

    More depths than ``VERGENCES`` are interpolated between that many Chebyshev points
    of 1/z: the path is smooth there
    (singular only where a source touches the lens), and the points cost what the
    sources would.

    Args:
        layers: films and stop of the lens.
        tangents: tangents of the field angles along x and y.
        bundle: rays of the nodes.
        depths_um: source depths from the lens, um.
        wavelength_um: vacuum wavelength, um.
    """
    wave = (
        wavelength_um if any(film.thickness_um > 0 for film in layers.front) else None
    )
    return _source_paths(
        layers, tuple(tangents.tolist()), bundle, tuple(depths_um.tolist()), wave
    )


@functools.lru_cache(maxsize=4)  # a few MB each
def _source_paths(
    layers: Layers,
    tangents: tuple[float, float],
    bundle: Rays,
    depths_um: tuple[float, ...],
    wavelength_um: float | None,
) -> Paths:
    """As :func:`source_paths`; without films in front no wavelength is needed."""
    given = layers, tangents, bundle
    if len(depths_um) <= VERGENCES:
        few = _each(*given, depths_um, wavelength_um)
        return Paths(few, torch.eye(len(depths_um), dtype=few.dtype, device=few.device))
    inverse = 1 / np.array(depths_um)
    low, high = float(inverse.min()), float(inverse.max())
    unit = np.cos(np.pi * (np.arange(VERGENCES) + 0.5) / VERGENCES)
    nodes = (low + high) / 2 + (high - low) / 2 * unit
    value = np.polynomial.chebyshev.chebvander(unit, VERGENCES - 1)
    wanted = (2 * inverse - low - high) / (high - low)
    mix = np.polynomial.chebyshev.chebvander(wanted, VERGENCES - 1) @ np.linalg.inv(
        value
    )
    few = _each(*given, tuple((1 / nodes).tolist()), wavelength_um)
    return Paths(few, torch.from_numpy(mix).to(few))


def _each(
    layers: Layers,
    tangents: tuple[float, float],
    bundle: Rays,
    depths_um: tuple[float, ...],
    wavelength_um: float | None,
) -> Tensor:
    """(depths, *shape) paths in um, one depth after the other; beyond the rim, behind
    films, those of places at it.
    """
    x, y = bundle.x_um, bundle.y_um
    slope = math.hypot(*tangents)
    p = torch.tensor(slope / math.hypot(1, slope), dtype=torch.float64, device=x.device)
    out = []
    for depth in depths_um:
        if math.isinf(depth):
            out.append((tangents[0] * x + tangents[1] * y) / math.hypot(1, slope))
            continue
        before = (
            Media((1.0,), (depth,))
            if wavelength_um is None
            else layers.before(depth, wavelength_um)
        )
        back = (
            float(media.lateral_reach(before, p)) / slope
            if slope > 0
            else before.reduced_um
        )
        sx, sy = -back * tangents[0], -back * tangents[1]
        if (
            len(before.layers) == 1
        ):  # √(z² + ρ²) less the same at the middle, without cancellation
            extra = x * x + y * y - 2 * (x * sx + y * sy)
            chief = math.sqrt(depth**2 + sx**2 + sy**2)
            out.append(
                before.layers[0][0] * extra / (torch.sqrt(chief**2 + extra) + chief)
            )
        else:
            chief = float(media.path_of_reach(before, np.float64(math.hypot(sx, sy))))
            away2 = (x - sx) ** 2 + (y - sy) ** 2
            away2 = away2.clamp(max=float((away2 * (bundle.whole > 0)).max()))
            out.append(
                interpolant.chebyshev_interpolant(
                    functools.partial(_chord, before), away2
                )
                - chief
            )
    return torch.stack(out)


def _chord(before: Media, away2: Any) -> Any:
    """:func:`metalens.optics.media.path_of_reach` of the squared reach; NumPy or torch."""
    return media.path_of_reach(before, away2**0.5)
