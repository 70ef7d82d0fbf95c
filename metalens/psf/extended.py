"""Sources of finite size: the PSF of a point, blurred by the geometric image of the
source.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.fft
import torch
from scipy.special import j1, jv, spherical_jn

from metalens import propagate
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.optics import media
from metalens.propagate import PropagationCase
from metalens.psf.cells import MOST, nyquist_um
from metalens.psf.record import SourceShape

# steps of Nyquist's around the reach of the source: light that is cut off rings
GUARD = 12
SIGMA = {
    "disc": 1 / 4,
    "square": 1 / math.sqrt(12),
    "gaussian": 1 / math.sqrt(8 * math.log(2)),
}  # of the size
REACH = {"disc": 0.5, "square": 0.5, "gaussian": 4 * SIGMA["gaussian"]}


@dataclass(frozen=True, slots=True)
class SourceExtent:
    """Size and shape of an incoherent source, parallel to the lens, of even radiance
    (Gaussian: falling off).

    shape: disc, square (sides along x and y) or gaussian.
    size_um: diameter, side, or full width at half maximum, of sources at finite depths.
    size_rad: in its place, size over depth: equal at all depths, and required at
        infinity.

    Raises:
        PropagationError: not one size above 0, or a shape that is not known.
    """

    shape: SourceShape = "disc"
    size_um: float = 0.0
    size_rad: float = 0.0

    def __post_init__(self) -> None:
        sizes = self.size_um, self.size_rad
        if not (
            all(math.isfinite(s) and s >= 0 for s in sizes)
            and (sizes[0] > 0) != (sizes[1] > 0)
        ):
            raise PropagationError(
                f"source of {sizes[0]} um and {sizes[1]} rad: need one of both, above 0"
            )
        if self.shape not in SIGMA:
            raise PropagationError(
                f"source shape {self.shape!r}: need {', '.join(SIGMA)}"
            )

    def transform(self, u: Any, v: Any) -> tuple[Array, Array]:
        """Fourier transform ŵ of the radiance, and |∇ŵ| / (2π); ŵ(0) = 1.

        A square has sinc u sinc v, a Gaussian exp(-(πρ)² / (4 ln 2)), a disc
        2 J1(πρ) / (πρ), with ρ² = u² + v².

        Args:
            u, v: cycles per size of the source along x and y.
        """
        if self.shape == "square":
            along = np.sinc(u)
            across = np.sinc(v)
            # d sinc(u) / du = -π j1(πu)
            along_slope, across_slope = (
                spherical_jn(1, np.pi * np.abs(axis)) for axis in (u, v)
            )
            slope = np.hypot(along_slope * across, along * across_slope)
            return along * across, slope / 2
        rho = np.hypot(u, v)
        if self.shape == "gaussian":
            level = np.exp(-((np.pi * rho) ** 2) / (4 * math.log(2)))
            return level, level * np.pi * rho / (4 * math.log(2))
        z = np.pi * np.maximum(rho, 1e-9)
        return 2 * j1(z) / z, jv(2, z) / z


def source_to_image_matrices(case: PropagationCase, extent: SourceExtent) -> Array:
    """(depth, 2, 2) matrices from the source, in its sizes, to the sensor, in um.

    Rows and columns are [x, y]. A matrix is the product of ∂(place on
    sensor)/∂(tangents) and :func:`_tangent_change`.

    Args:
        case: direction, depths and films.
        extent: size and shape of the source.

    Raises:
        PropagationError: a size in um at infinity.
    """
    to_sensor = _slopes(lambda t: _sensor_place(case, t), case)
    changes = [_tangent_change(case, extent, z) for z in case.inverse_depths_per_um]
    return np.asarray(to_sensor @ np.array(changes))


def _tangent_change(
    case: PropagationCase, extent: SourceExtent, inverse: float
) -> Array:
    """(2, 2) change of the tangents [x, y] by one size of the source along x and y.

    Args:
        case: direction and films.
        extent: size of the source, as a length or an angle.
        inverse: 1 / depth, 1/um.

    Raises:
        PropagationError: a size in um at infinity.
    """
    if extent.size_rad:
        return -extent.size_rad * np.eye(2)
    if inverse == 0:
        raise PropagationError(
            f"source of {extent.size_um:g} um at infinity has no angle: give its size as an angle (size_rad)"
        )
    by_tangent = _slopes(lambda t: _source_place(case, t, 1 / inverse), case)
    return np.asarray(extent.size_um * np.linalg.inv(by_tangent))


def _sensor_place(case: PropagationCase, tangents: tuple[float, float]) -> list[float]:
    """(x, y) where the chief ray of these tangents meets the sensor, um."""
    reach = case.behind, case.sensor_distance_um, tangents
    return [propagate.chief_ray_offset(*reach, axis) for axis in (0, 1)]


def _source_place(
    case: PropagationCase, tangents: tuple[float, float], depth_um: float
) -> list[float]:
    """(x, y) of the source on its plane, um, for a chief ray through the films before.

    Args:
        case: films before the lens.
        tangents: (x, y) slopes of the chief ray in air.
        depth_um: of the source's plane.
    """
    steep = 1 + tangents[0] ** 2 + tangents[1] ** 2
    thick = sum(t for _, t in case.front)
    layers = [(1.0, depth_um - thick), *case.front]
    reach = float(media.reach_per_direction(layers, 1 - 1 / steep)) / math.sqrt(steep)
    return [-reach * tangents[0], -reach * tangents[1]]


def _slopes(of: Any, case: PropagationCase) -> Array:
    """(2, 2) derivatives of a place [x, y] by the tangents [x, y], exact to 1e-9."""
    h = 1e-4
    tx, ty = case.tangents
    pairs = (((tx + h, ty), (tx - h, ty)), ((tx, ty + h), (tx, ty - h)))
    return np.array([np.subtract(of(a), of(b)) / (2 * h) for a, b in pairs]).T


def widen_case(
    fine: PropagationCase, extent: SourceExtent
) -> tuple[PropagationCase, tuple[int, int]]:
    """The case with a wider window, and the samples (y, x) added on each side.

    The margin is the reach of the source's image plus ``GUARD`` steps of Nyquist.

    Args:
        fine: case with the samples of the window.
        extent: size and shape of the source.

    Raises:
        PropagationError: samples farther apart than Nyquist's step, a size in um at
            infinity, or too many samples.
    """
    limit = nyquist_um(fine)
    if fine.step_um > limit * (1 + 1e-9):
        raise PropagationError(
            f"a source of finite size needs samples within Nyquist's {limit:.3g} um, found {fine.step_um:.3g} um: let "
            "the cells be integrated, or give more samples"
        )
    guard = GUARD * math.ceil(limit / fine.step_um)
    reach = source_image_reach(fine, extent)
    margin = reach[0] + guard, reach[1] + guard
    samples = fine.samples[0] + 2 * margin[0], fine.samples[1] + 2 * margin[1]
    if max(samples) > MOST:
        raise PropagationError(
            f"the image of the source is up to {2 * max(reach) * fine.step_um:.4g} um wide, which with the window "
            f"would take {max(samples)} samples along an axis, at most {MOST}: give a smaller source or window"
        )
    return replace(fine, samples=samples), margin


def blur_by_source(
    light: torch.Tensor,
    case: PropagationCase,
    extent: SourceExtent,
    more: tuple[int, int],
) -> tuple[torch.Tensor, float]:
    """(depth, y, x) light of a finite source on the window, and its relative L2 error.

    The light of a point is convolved with the source's image. The error is the change
    of the result when the outer half of the guard samples is set to 0.

    Args:
        light: (depth, y, x) of a point source, on the widened window.
        case: with the widened window.
        extent: size and shape of the source.
        more: (y, x) samples added on each side of the window.
    """
    rows, columns = (slice(margin, -margin) for margin in more)
    whole = _filtered(light, case, extent, 0)
    blurred = whole[..., rows, columns]
    with torch.no_grad():
        down, across = (
            (n - reach) // 2
            for n, reach in zip(more, source_image_reach(case, extent), strict=True)
        )
        inner = torch.zeros_like(light)
        inner[..., down:-down, across:-across] = light[..., down:-down, across:-across]
        change = (_filtered(inner, case, extent, 0) - whole)[..., rows, columns]
        error = float(change.norm() / blurred.norm())
    return blurred.clamp_min(0), error


def source_image_reach(case: PropagationCase, extent: SourceExtent) -> tuple[int, int]:
    """(y, x) half width of the source's image in samples, the largest over depths.

    Args:
        case: direction, depths and step of the samples.
        extent: size and shape of the source.
    """
    size_um = np.abs(source_to_image_matrices(case, extent)).sum(2).max(0)
    x, y = np.ceil(size_um * REACH[extent.shape] / case.step_um)
    return int(y), int(x)


def _filtered(
    light: torch.Tensor, case: PropagationCase, extent: SourceExtent, which: int
) -> torch.Tensor:
    """(depth, y, x) light filtered by the source's transform, with zero padding.

    Args:
        light: (depth, y, x) of a point source.
        case: step of the samples, direction and depths.
        extent: size and shape of the source.
        which: 0 for the filter ŵ, 1 for √(|ŵ|² + |∇ŵ|² / (2πσ)²).
    """
    shape = [scipy.fft.next_fast_len(n, real=True) for n in light.shape[-2:]]
    fy = np.fft.fftfreq(shape[0], case.step_um)[:, None]
    fx = np.fft.rfftfreq(shape[1], case.step_um)
    filters = []
    for m in source_to_image_matrices(case, extent):
        level, slope = extent.transform(
            m[0, 0] * fx + m[1, 0] * fy, m[0, 1] * fx + m[1, 1] * fy
        )
        filters.append(
            level if which == 0 else np.hypot(level, slope / SIGMA[extent.shape])
        )
    response = torch.as_tensor(np.array(filters)).to(light)
    filtered: torch.Tensor = torch.fft.irfft2(
        torch.fft.rfft2(light, s=shape) * response, s=shape
    )
    return filtered[..., : light.shape[-2], : light.shape[-1]]


def shift_invariance_error(
    light: torch.Tensor,
    case: PropagationCase,
    extent: SourceExtent,
    probe: Callable[[PropagationCase], torch.Tensor],
) -> float:
    """Relative L2 error of one PSF for all points of the source.

    The larger of those at the nearest and the farthest depth. PSFs of two points, one
    standard deviation from the middle along x and along y, are compared with that of
    the middle.

    Args:
        light: (depth, y, x) PSFs of the source's middle, on the widened window.
        case: with the widened window.
        extent: size and shape of the source.
        probe: function from a case of one depth to its PSF (1, y, x).
    """
    errors = []
    inverse = case.inverse_depths_per_um
    for depth in {int(np.argmin(inverse)), int(np.argmax(inverse))}:
        single = replace(case, inverse_depths_per_um=(inverse[depth],))
        middle = light[depth : depth + 1].detach()
        square = 0.0
        sizes = _tangent_change(case, extent, inverse[depth])
        for axis in (0, 1):
            x, y = single.tangents + sizes[:, axis] * SIGMA[extent.shape]
            tangents = float(x), float(y)
            shift = np.subtract(
                _sensor_place(case, tangents), _sensor_place(case, case.tangents)
            )
            centre_um = np.add(case.centre_um, shift).tolist()
            other = probe(
                replace(single, tangents=tangents, centre_um=tuple(centre_um))
            )
            change = _filtered(other.detach() - middle, single, extent, 1)
            square += float(change.norm()) ** 2
        blurred = _filtered(middle, single, extent, 0)
        errors.append(math.sqrt(square) / float(blurred.norm()))
    return max(errors)
