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
from scipy.special import j1, jv

from metalens import propagate
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.optics import media
from metalens.propagate import PropagationCase
from metalens.psf.cells import MOST, nyquist_um
from metalens.psf.record import SourceShape

# steps of Nyquist's around what the source blurs in: light that is cut there rings
GUARD = 12
SIGMA = {
    "disc": 1 / 4,
    "square": 1 / math.sqrt(12),
    "gaussian": 1 / math.sqrt(8 * math.log(2)),
}  # of the size
REACH = {"disc": 0.5, "square": 0.5, "gaussian": 4 * SIGMA["gaussian"]}


@dataclass(frozen=True, slots=True)
class Extent:
    """Size and shape of an incoherent source, parallel to the lens, of even radiance
    (Gaussian: falling off).

    shape: disc, square (sides along x and y) or gaussian.
    size_um: diameter, side, or full width at half maximum, of sources at finite depths.
    size_rad: in its place, size over depth: alike at all depths, and the only one at
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
        """(ŵ, |∇ŵ| / (2π)) at (u, v) cycles per size along x and y."""
        if self.shape == "square":
            along, across = np.sinc(u), np.sinc(v)
            return along * across, np.hypot(
                _sinc_slope(u) * across, along * _sinc_slope(v)
            ) / (2 * np.pi)
        rho = np.hypot(u, v)
        if self.shape == "gaussian":
            level = np.exp(-((np.pi * rho) ** 2) / (4 * math.log(2)))
            return level, level * np.pi * rho / (4 * math.log(2))
        z = np.pi * np.maximum(rho, 1e-9)
        return 2 * j1(z) / z, jv(2, z) / z


def _sinc_slope(u: Any) -> Array:
    """d sinc(u) / du, sinc(u) = sin(πu)/(πu)."""
    safe = np.where(np.abs(u) < 1e-4, 1.0, u)
    return np.where(
        np.abs(u) < 1e-4,
        -(np.pi**2) * u / 3,
        (np.cos(np.pi * safe) - np.sinc(safe)) / safe,
    )


def source_to_image_matrices(case: PropagationCase, extent: Extent) -> Array:
    """(depth, 2, 2) M of the module's heading times the size: sizes of the source to um
    on the sensor, [x, y].

    Args:
        case: maps, geometry and window of the propagation.
        extent: size and shape of the source.

    Raises:
        PropagationError: a size in um at infinity.
    """
    onto = _slopes(lambda t: _met(case, t), case)
    return np.array(
        [onto @ _turn(case, extent, inverse) for inverse in case.inverse_depths_per_um]
    )


def _turn(case: PropagationCase, extent: Extent, inverse: float) -> Array:
    """(2, 2) change of the tangents by one size of the source along x and y."""
    if extent.size_rad:
        return -extent.size_rad * np.eye(2)
    if inverse == 0:
        raise PropagationError(
            f"source of {extent.size_um:g} um at infinity has no angle: give its size as an angle (size_rad)"
        )
    return np.asarray(
        extent.size_um
        * np.linalg.inv(_slopes(lambda t: _place(case, t, 1 / inverse), case))
    )


def _met(case: PropagationCase, tangents: tuple[float, float]) -> list[float]:
    """(x, y) where the chief ray meets the sensor."""
    return [
        float(
            propagate.chief_ray_offset(
                case.behind, case.sensor_distance_um, tangents, i
            )
        )
        for i in (0, 1)
    ]


def _place(
    case: PropagationCase, tangents: tuple[float, float], depth_um: float
) -> list[float]:
    """(x, y) of the source of these tangents (in air) on its plane, through the films
    in front.
    """
    steep = 1 + tangents[0] ** 2 + tangents[1] ** 2
    thick = sum(t for _, t in case.front)
    away = float(
        media.reach_per_direction([(1.0, depth_um - thick), *case.front], 1 - 1 / steep)
    ) / math.sqrt(steep)
    return [-away * tangents[0], -away * tangents[1]]


def _slopes(of: Any, case: PropagationCase) -> Array:
    """(2, 2) derivatives of a place [x, y] by the tangents of the case [x, y], to 1e-9."""
    h = 1e-4
    tx, ty = case.tangents
    pairs = (((tx + h, ty), (tx - h, ty)), ((tx, ty + h), (tx, ty - h)))
    return np.array([np.subtract(of(a), of(b)) / (2 * h) for a, b in pairs]).T


def widen_case(
    fine: PropagationCase, extent: Extent
) -> tuple[PropagationCase, tuple[int, int]]:
    """The case with the samples around its window that the source blurs into it, and
    how many (y, x) on each side.

    Args:
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
    far = source_image_reach(fine, extent)
    more = far[0] + guard, far[1] + guard
    samples = fine.samples[0] + 2 * more[0], fine.samples[1] + 2 * more[1]
    if max(samples) > MOST:
        raise PropagationError(
            f"the image of the source is up to {2 * max(far) * fine.step_um:.4g} um wide, which with the window "
            f"would take {max(samples)} samples along an axis, at most {MOST}: give a smaller source or window"
        )
    return replace(fine, samples=samples), more


def blur_by_source(
    light: torch.Tensor, case: PropagationCase, extent: Extent, more: tuple[int, int]
) -> tuple[torch.Tensor, float]:
    """(depth, y, x) light on the window from that on the widened one, and what is wrong
    at its edges, relative L2.

    Args:
        case: maps, geometry and window of the propagation.
        extent: size and shape of the source.
    """
    whole = _filtered(light, case, extent, 0)
    with torch.no_grad():
        down, across = (
            (n - far) // 2
            for n, far in zip(more, source_image_reach(case, extent), strict=True)
        )
        inner = torch.zeros_like(light)
        inner[..., down:-down, across:-across] = light[..., down:-down, across:-across]
        cut = _cropped(_filtered(inner, case, extent, 0) - whole, more)
        edge = float(cut.norm() / _cropped(whole, more).norm())
    return _cropped(whole, more).clamp_min(0), edge


def source_image_reach(case: PropagationCase, extent: Extent) -> tuple[int, int]:
    """(y, x) samples that the image of the source reaches from its middle, at the depth
    where that is most.

    Args:
        case: maps, geometry and window of the propagation.
        extent: size and shape of the source.
    """
    x, y = np.ceil(
        np.abs(source_to_image_matrices(case, extent)).sum(2).max(0)
        * REACH[extent.shape]
        / case.step_um
    )
    return int(y), int(x)


def _cropped(light: torch.Tensor, more: tuple[int, int]) -> torch.Tensor:
    return light[..., more[0] : -more[0], more[1] : -more[1]]


def _filtered(
    light: torch.Tensor, case: PropagationCase, extent: Extent, which: int
) -> torch.Tensor:
    """Light through ŵ (which 0), or through √(|ŵ|² + |∇ŵ|²/(2πσ)²) (which 1)."""
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
    extent: Extent,
    probe: Callable[[PropagationCase], torch.Tensor],
) -> float:
    """Relative L2 error of a shift-invariant PSF over the source, at the nearest and
    the farthest depth.

    Args:
        extent: size and shape of the source.
        light: (depth, y, x) on the widened window of ``case``, from the middle of the
            source.
        probe: the same (1, y, x) for another case.
    """
    errors = []
    inverse = case.inverse_depths_per_um
    for depth in {int(np.argmin(inverse)), int(np.argmax(inverse))}:
        one = replace(case, inverse_depths_per_um=(inverse[depth],))
        middle = light[depth : depth + 1].detach()
        square = 0.0
        for axis in (0, 1):
            other = probe(
                _moved(
                    one,
                    _turn(case, extent, inverse[depth])[:, axis] * SIGMA[extent.shape],
                )
            )
            square += (
                float(_filtered(other.detach() - middle, one, extent, 1).norm()) ** 2
            )
        errors.append(
            math.sqrt(square) / float(_filtered(middle, one, extent, 0).norm())
        )
    return max(errors)


def _moved(case: PropagationCase, turn: Array) -> PropagationCase:
    """The case of a source whose tangents are changed; the window follows its chief
    ray.
    """
    tangents = case.tangents[0] + float(turn[0]), case.tangents[1] + float(turn[1])
    x, y = np.add(
        case.centre_um, np.subtract(_met(case, tangents), _met(case, case.tangents))
    ).tolist()
    return replace(case, tangents=tangents, centre_um=(x, y))
