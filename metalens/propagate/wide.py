"""Wide windows: the field by three Fourier transforms, on grids as fine as aperture and
window ask for.
"""

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.special
import torch
from scipy.fft import next_fast_len

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.core.threads import one_blas_thread
from metalens.optics import media
from metalens.propagate.geometry import PropagationCase
from metalens.propagate.moments import PillarMoments, plan_moments
from metalens.propagate.paths import (
    over_blocks,
    ray_cosines,
    rayleigh_sommerfeld_kernel,
    reference_depth,
    to_sensor,
)
from metalens.propagate.window import coarse_lens_nodes, depth_basis

RAYS = 33  # along an axis, to whose reach the quadratic is fitted
SPARE = 1.2  # ratio of the lens grid's density to the least for the kernel's band
MOST = 20000  # points of a transform along an axis
# Least number of lens points and of half-waves in the window for which this method is
# the best. Below some 35 the fading and the grid beyond the lens's rim are as wide as
# lens and window, and errors miss any setting (on random lenses of 20 to 120 pillars by
# up to 3e-2; their estimates say so).
WIDE = 120
# Share of the requested digits that fading keeps where it acts most: on light of the
# lens's rim at the opposite end of the window, which weighs little. Light that is even
# over both misses the setting, as the estimate says, and is computed again.
FADED = 0.4
STEEPEST = 0.93  # |p| of a ray, fading included, in units of the rarest index


@dataclass(frozen=True, slots=True)
class QuadraticFit:
    """Quadratic path along one axis: the reach of a ray is A + D (p - p0).

    p is the direction cosine n sin θ of a ray along the axis.

    middle, reach_um, stretch_um: p0, A, D. most: largest |p - p0| of a ray to the
    window. extra_um: largest residual of the reach. steepest: |p| of any ray.
    """

    middle: float
    reach_um: float
    stretch_um: float
    most: float
    extra_um: float
    steepest: float


@dataclass(frozen=True, slots=True)
class WideAxis:
    """One axis of a wide window.

    count, first_um, step_um: even grid over the lens, ``taps`` points larger on both
    sides. over: its density over the least for the kernel. first: points of the first
    transform; its middle ``size`` points cover the padded window. fine: points of the
    last transform, whose step is the window's step divided by ``every``. fit: its
    quadratic path. guard: band beyond the rays to the window in which the light is
    faded out. sharp: half of that in standard deviations.
    """

    count: int
    first_um: float
    step_um: float
    taps: int
    over: float
    first: int
    size: int
    fine: int
    every: int
    fit: QuadraticFit
    guard: float
    sharp: float


@functools.lru_cache(maxsize=256)
def wide_axes(
    case: PropagationCase, tolerance: float
) -> tuple[WideAxis, WideAxis] | None:
    """(y, x) grids of a wide window; None if its rays are too steep or not quadratic.

    The quadratics are fitted twice more, each time to the window enlarged by the
    residual of the last fit. Then the width of the fading and the grids follow.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.
    """
    sizes = np.add(case.half_window_um, case.half_size_um)
    half_um, steepest = list(case.half_window_um), STEEPEST * case.media.layers[0][0]
    for _ in range(3):
        fits = _fit_quadratics(case, half_um)
        extra_um = [fit.extra_um for fit in fits]
        if fits[0].steepest > steepest or (np.array(extra_um) > 2 * sizes).any():
            return None
        half_um = np.add(case.half_window_um, extra_um).tolist()
    sharp = math.sqrt(2 * FADED * math.log(1 / tolerance))
    fade = 2 * sharp**2 / case.wavenumber
    guards = [
        math.sqrt(fade * fit.most / half)
        for half, fit in zip(half_um, fits, strict=True)
    ]
    if fits[0].steepest + max(guards) > steepest:
        return None
    strays = _stray_reach(case, fits, guards)
    y, x = (
        _axis(case, i, fits[i], (guards[i], sharp, strays[i]), tolerance)
        for i in (0, 1)
    )
    return (y, x) if y and x else None


def _stray_reach(
    case: PropagationCase, fits: tuple[QuadraticFit, QuadraticFit], guards: list[float]
) -> list[float]:
    """Largest residual of the quadratic reach in the faded band, along y and x, um.

    Args:
        case: geometry of the propagation.
        fits: (y, x) quadratics.
        guards: (y, x) widths of the faded band, in p.
    """
    y, x = (
        fit.middle + np.linspace(-1, 1, RAYS) * (fit.most + guard)
        for fit, guard in zip(fits, guards, strict=True)
    )
    squared = y[:, None] ** 2 + x**2
    in_band = squared <= (fits[0].steepest + max(guards)) ** 2
    reach_per_p = media.reach_per_direction(
        case.media.layers, np.where(in_band, squared, 0.0)
    )
    excess = []
    for fit, p in zip(fits, (y[:, None], x), strict=True):
        residual = p * reach_per_p - fit.reach_um - fit.stretch_um * (p - fit.middle)
        excess.append(float(np.abs(np.where(in_band, residual, 0)).max()))
    return excess


def is_wide(case: PropagationCase, tolerance: float) -> bool:
    """Whether this method is certainly the fastest, so that the others need no plan.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.
    """
    axes = wide_axes(case, tolerance)
    if axes is None:
        return False
    waves = (
        4 * axis.fit.most * half / case.wavelength_um
        for axis, half in zip(axes, case.half_window_um, strict=True)
    )
    return min(*waves, *(axis.count - 2 * axis.taps for axis in axes)) > WIDE


def _fit_quadratics(
    case: PropagationCase, half: list[float]
) -> tuple[QuadraticFit, QuadraticFit]:
    """Quadratics along y and x, fitted to rays from the lens to the window.

    The reach of each ray is fitted by a line in its direction cosine, A + D (p - p0).

    Args:
        case: geometry of the propagation.
        half: (y, x) half sizes of the window, um.
    """
    chebyshev = np.cos(np.pi * (np.arange(RAYS) + 0.5) / RAYS)
    centre = case.centre_um[::-1]
    y, x = (
        middle + chebyshev * (w + h)
        for middle, w, h in zip(centre, half, case.half_size_um, strict=True)
    )
    cosines = [
        np.asarray(ray_cosines(case, *point))
        for point in ((y[:, None], x), (x, y[:, None]))
    ]
    steepest = float(np.sqrt((cosines[0] ** 2 + cosines[1] ** 2).max()))
    fits = []
    for along, p in zip((y[:, None], x), cosines, strict=True):
        reach = np.broadcast_to(along, p.shape)
        p0 = float(p.min() + p.max()) / 2
        slope, intercept = np.polyfit((p - p0).ravel(), reach.ravel(), 1)
        residual = float(np.abs(reach - intercept - slope * (p - p0)).max())
        fits.append(
            QuadraticFit(
                p0,
                float(intercept),
                float(slope),
                float(np.abs(p - p0).max()),
                residual,
                steepest,
            )
        )
    return fits[0], fits[1]


def _axis(
    case: PropagationCase,
    i: int,
    fit: QuadraticFit,
    fade: tuple[float, float, float],
    tolerance: float,
) -> WideAxis | None:
    """Grids of one axis; None if a transform would exceed ``MOST`` points.

    The first transform grows until its lens grid is dense enough for the kernel's band
    and it holds the whole lens.

    Args:
        case: geometry of the propagation.
        i: 0 for y, 1 for x.
        fit: quadratic along the axis.
        fade: width of the faded band in p; half of it in standard deviations; how far
            its light strays, um.
        tolerance: relative error of the field.
    """
    guard, sharp, stray = fade
    coarse = case.wavelength_um / 2 / (fit.most + guard)
    every = math.ceil(case.step_um / coarse)
    width = (
        2 * (case.half_window_um[i] + stray) + 4 * sharp**2 / case.wavenumber / guard
    )
    fine = _fast_size(width * every / case.step_um)
    period = fine * case.step_um / every
    size = min(_fast_size(period / coarse), fine)
    # grid step of the lens times points of the first transform
    lens_unit = case.wavelength_um * fit.stretch_um * size / period
    band = _band(case, i, fit.extra_um)
    first = size
    while first <= MOST:
        over = case.wavelength_um / (2 * band) * first / lens_unit
        if over >= SPARE:
            taps = math.ceil(
                1 + math.log(10 / tolerance) * over / (math.pi * (over - 1))
            )
            count = (
                math.ceil(2 * case.half_size_um[i] * first / lens_unit) + 2 * taps + 1
            )
            if count <= first:
                first_um = -(count - 1) / 2 * lens_unit / first
                return WideAxis(
                    count,
                    first_um,
                    lens_unit / first,
                    taps,
                    over,
                    first,
                    size,
                    fine,
                    every,
                    fit,
                    guard,
                    sharp,
                )
        first = _fast_size(max(first + 1, min(SPARE / over, 1.5) * first))
    return None


def _fast_size(points: float) -> int:
    """Size of a transform: the next multiple of 4 with small prime factors."""
    return int(4 * next_fast_len(math.ceil((points - 1e-9) / 4)))


def _band(case: PropagationCase, i: int, extra: float) -> float:
    """Largest |d path / d x| along an axis of the kernel without its carrier.

    By differences over 1 nm, at the ends and middles of lens and window.

    Args:
        case: geometry of the propagation.
        i: 0 for y, 1 for x.
        extra: enlargement of the window along the axis, um.
    """
    half_um = np.array([*case.half_size_um, *case.half_window_um])
    half_um[2 + i] += extra
    inverse = case.inverse_depths_per_um
    y, x, Y, X, depths = np.meshgrid(
        *np.outer(half_um, [-1, 0, 1]), [min(inverse), max(inverse)], indexing="ij"
    )
    high, low = (
        rayleigh_sommerfeld_kernel(case, x + i * h, y + (1 - i) * h, X, Y, depths)
        for h in (5e-4, -5e-4)
    )
    slope = np.abs(np.angle(high * low.conj())).max() / case.wavenumber * 1e3
    return max(float(slope), 1e-6)


def grid_um(axis: WideAxis) -> Array:
    """(count,) places of the even grid over the lens.

    Args:
        axis: grids along one axis.
    """
    return axis.first_um + axis.step_um * np.arange(axis.count)


def spread_weights(axis: WideAxis, places_um: Array) -> Array:
    """(place, grid) interpolation weights, a sinc under a Kaiser window: f(x) = Σ_m
    weight f(x_m).

    Exact to the tolerance for functions within the kernel's band.

    Args:
        axis: grids along one axis.
        places_um: positions on the lens.
    """
    t = (places_um[:, None] - grid_um(axis)) / axis.step_um
    inside = np.clip(1 - (t / axis.taps) ** 2, 0, None)
    beta = math.pi * axis.taps * (1 - 1 / axis.over)
    return np.asarray(
        np.sinc(t)
        * np.where(inside > 0, np.i0(beta * np.sqrt(inside)), 0)
        / np.i0(beta)
    )


MIXED_ROWS = 32  # of the window, whose depths are mixed at once
# step of the samples of the lens grid whose light selects the depth fields
EVERY = 3
CHUNK_BYTES = 4e7  # of the depth fields that are transformed at once


@dataclass(frozen=True, eq=False, slots=True)
class WidePlan:
    """Plan of a wide window: everything that depends on the geometry alone.

    axes: (y, x). fields: (b, y, x) depth fields on the lens grid, its phases included.
    coefficients: (depth, b). chirp, transfer: (X, Y) factors after the first and second
    transform, in the memory order of the light. left: relative root mean square of the
    light of all depths that a reduced basis may omit.
    """

    case: PropagationCase
    axes: tuple[WideAxis, WideAxis]
    moments: PillarMoments
    fields: torch.Tensor
    coefficients: torch.Tensor
    chirp: torch.Tensor
    transfer: torch.Tensor
    left: float

    @property
    def check_nodes_um(self) -> tuple[Array, Array]:
        """(e,), (x,) positions of the grid over the lens."""
        y, x = (grid_um(axis) for axis in self.axes)
        return y, x

    nodes_um = check_nodes_um

    def on_nodes(self, moments: torch.Tensor) -> torch.Tensor:
        """(…, y, x) light on the grid: the moments themselves."""
        return moments

    def on_check_nodes(self, moments: torch.Tensor) -> Array:
        """(…, y, x) light on the grid."""
        return moments.detach().numpy().astype(complex)

    def irradiance(self, light: torch.Tensor) -> torch.Tensor:
        """(depth, y, x) irradiance on the window from light (y, x) on the grid."""
        fields, coefficients = self.fields, self.coefficients
        if not light.requires_grad:
            fields, coefficients = _fewer_fields(light, self)
        return _mix_depths(fields_wide(light, fields, self), coefficients)


@functools.lru_cache(maxsize=2)
def plan_wide(case: PropagationCase, tolerance: float, dtype: torch.dtype) -> WidePlan:
    """Plan a wide window; the last two are kept.

    Args:
        case, tolerance: geometry, and relative error of the field.
        dtype: of the maps and of the transforms.

    Raises:
        PropagationError: rays too steep, or too far from a quadratic, for the method.
    """
    with one_blas_thread():
        axes = wide_axes(case, tolerance)
        if axes is None:
            raise PropagationError(
                "rays to this window are too steep for Fourier transforms; see propagate.choose"
            )
        pillars = plan_moments(
            case,
            reference_depth(case),
            tuple(functools.partial(spread_weights, axis) for axis in axes),
            over_blocks(case),
            tolerance=tolerance,
            dtype=dtype,
            sums=dtype,
            nodes=max(axis.count for axis in axes) // 2,
        )
        complex_dtype = torch.complex64 if dtype == torch.float32 else torch.complex128
        fields, coefficients = _depth_fields(case, axes, tolerance / 2)
        lens = _lens_phase(case, axes)
        arrays = (
            coefficients,
            *(np.ascontiguousarray(a.T) for a in _window_factors(case, axes)),
        )
        tensors = [torch.tensor(a, dtype=complex_dtype) for a in arrays]
        table = torch.empty((coefficients.shape[1], *lens.shape), dtype=complex_dtype)
        for slot, field in zip(table, fields, strict=True):
            slot.copy_(torch.from_numpy(field * lens))
    return WidePlan(
        case, axes, pillars, table, tensors[0], tensors[1], tensors[2], tolerance
    )


def _depth_fields(
    case: PropagationCase, axes: tuple[WideAxis, WideAxis], tolerance: float
) -> tuple[Iterator[Array], Array]:
    """Depth fields (b, y, x) on the lens grid, one by one, and coefficients.

    The basis is computed on a coarse Legendre grid and interpolated.

    Args:
        case: geometry of the propagation.
        axes: (y, x) grids.
        tolerance: relative root mean square error of the basis.
    """
    grids = [grid_um(axis) for axis in axes]
    nodes = coarse_lens_nodes(case, [grid[-1] for grid in grids], tolerance)
    depths = depth_basis(case, nodes, tolerance)
    rows, columns = (
        legendre.interpolation_matrix(len(at_um), grid / grid[-1])
        for at_um, grid in zip(nodes, grids, strict=True)
    )
    fields = (rows @ field @ columns.T for field in depths.basis)
    return fields, depths.coefficients


def _lens_phase(case: PropagationCase, axes: tuple[WideAxis, WideAxis]) -> Array:
    """(y, x) complex factor on the light of the lens grid, before the first transform.

    It holds the quadratic phase of both axes less the carrier's, the shift of the
    transform's orders, and all constants.

    Args:
        case: geometry of the propagation.
        axes: (y, x) grids.
    """
    k, wavelength_um = case.wavenumber, case.wavelength_um
    path_sum, ramp = np.zeros((1, 1)), np.ones((1, 1), complex)
    for i, (axis, centre) in enumerate(zip(axes, case.centre_um[::-1], strict=True)):
        x, x0 = grid_um(axis), centre - axis.fit.reach_um
        path = (x - x0) ** 2 / (2 * axis.fit.stretch_um) + axis.fit.middle * (
            centre - x
        )
        turn = np.exp(
            2j * np.pi * (axis.size // 2) * np.arange(axis.count) / axis.first
        )
        if i == 0:
            path, turn = path[:, None], turn[:, None]
        path_sum = path_sum + path
        ramp = ramp * turn
    y, x = (grid_um(axis) for axis in axes)
    removed = np.asarray(to_sensor(case, x, y[:, None]))
    scale = case.area_um2 / (
        1j * wavelength_um * math.sqrt(axes[0].fit.stretch_um * axes[1].fit.stretch_um)
    )
    start = float(_phase_path(case, axes[0].fit.middle ** 2 + axes[1].fit.middle ** 2))
    return np.asarray(scale * ramp * np.exp(1j * k * (path_sum - removed + start)))


def _phase_path(case: PropagationCase, w: Any) -> Any:
    """Φ = Σ t √(n² - w), um."""
    return sum(t * (n * n - w) ** 0.5 for n, t in case.media.layers)


def _window_factors(
    case: PropagationCase, axes: tuple[WideAxis, WideAxis]
) -> tuple[Array, Array]:
    """(Y, X) chirp after the first transform, and transfer function after the second.

    The transfer function corrects the path from its quadratic to the exact one, applies
    the transmission of the layers, and fades steep rays out.

    Args:
        case: geometry of the propagation.
        axes: (y, x) grids.
    """
    k = case.wavenumber
    chirps, ramps, squares, paths = [], [], [], []
    for axis, samples, centre in zip(
        axes, case.samples, case.centre_um[::-1], strict=True
    ):
        period = axis.fine * case.step_um / axis.every
        n = np.arange(axis.size) - axis.size // 2
        width = period / axis.size
        place = (axis.first_um - (centre - axis.fit.reach_um)) / axis.step_um
        # the lowest order of the next transform is first
        turns = n * (axis.size // 2 / axis.size - place / axis.first)
        chirps.append(
            np.exp(
                1j * k * (n * width) ** 2 / (2 * axis.fit.stretch_um)
                + 2j * np.pi * turns
            )
        )
        u = n * case.wavelength_um / period
        first = -(samples - 1) / 2 * case.step_um / width + axis.size // 2
        ramps.append(
            np.exp(2j * np.pi * n * first / axis.size)
            * _fade(axis, np.abs(u) - axis.fit.most)
            / axis.size
        )
        squares.append((axis.fit.middle + u) ** 2)
        paths.append(axis.fit.reach_um * u + axis.fit.stretch_um / 2 * u * u)
    squared = squares[0][:, None] + squares[1]
    fading = max(axes, key=lambda axis: axis.guard)
    in_band = squared < (fading.fit.steepest + 1.1 * fading.guard) ** 2
    squared = np.where(in_band, squared, 0.0)
    path_left = _phase_path(case, squared) - _phase_path(
        case, axes[0].fit.middle ** 2 + axes[1].fit.middle ** 2
    )
    path_left = path_left + paths[0][:, None] + paths[1]
    level = _fade(fading, np.sqrt(squared) - fading.fit.steepest)
    level = level * np.sqrt(media.passed_at(case.media.order, squared))
    transfer = np.where(
        in_band, ramps[0][:, None] * ramps[1] * level * np.exp(1j * k * path_left), 0
    )
    return chirps[0][:, None] * chirps[1], transfer


def _fade(axis: WideAxis, excess: Array) -> Array:
    """Weight of rays at an excess |p| over the steepest to the window: 1 at 0, 0 at the
    guard's end.

    Half of erfc((2 excess / guard - 1) sharp / √2).
    """
    return np.asarray(
        scipy.special.erfc(axis.sharp / math.sqrt(2) * (2 * excess / axis.guard - 1))
        / 2
    )


def _fewer_fields(
    light: torch.Tensor, plan: WidePlan
) -> tuple[torch.Tensor, torch.Tensor]:
    """Reduced depth basis for this light: fields (r, y, x), coefficients (depth, r).

        F_z L ≈ Σ_r U_zr (Uᴴ C B)_r L, U: leading eigenvectors of C G Cᴴ,
        G_ij = Σ_x |L|² B_i B_j*

    A round lens leaves the corners of its square dark, where depths differ most.

    Args:
        light: (y, x) light L on the lens grid.
        plan: of :func:`plan_wide`.
    """
    some = (slice(None, None, EVERY),) * 2
    coefficients = plan.coefficients.to(torch.complex128)
    sampled = (plan.fields[:, *some] * light[some]).flatten(1).to(coefficients)
    power, vectors = torch.linalg.eigh(
        coefficients @ (sampled @ sampled.mH) @ coefficients.mH
    )
    omitted = torch.cumsum(power.clamp_min(0), 0)  # ascending
    first = min(int((omitted <= plan.left**2 * omitted[-1]).sum()), len(omitted) - 1)
    basis = vectors[:, first:]
    mixtures = (basis.mH @ coefficients).to(plan.fields)
    return torch.tensordot(mixtures, plan.fields, 1), basis.to(plan.fields)


def fields_wide(
    gathered: torch.Tensor, fields: torch.Tensor, plan: WidePlan
) -> torch.Tensor:
    """(b, y, x) field on the window of every depth field, by three Fourier transforms.

    A phase of each sample, common to all fields, is left out.

    Args:
        gathered: (y, x) light on the lens grid.
        fields: (b, y, x) depth fields on it.
        plan: of :func:`plan_wide`.
    """
    y, x = plan.axes
    my, mx = plan.case.samples
    step = max(1, int(CHUNK_BYTES / (2 * y.fine * x.fine * gathered.element_size())))
    parts = []
    for chunk in torch.split(fields, step):
        # every transform is along the last axis
        light = torch.fft.fft(chunk * gathered, n=x.first)[..., : x.size].mT
        light = torch.fft.fft(light, n=y.first)[..., : y.size] * plan.chirp
        light = torch.fft.fft2(light)
        light *= plan.transfer
        light = torch.fft.ifft(light, n=y.fine, norm="forward")[
            ..., : my * y.every : y.every
        ].mT
        field = torch.fft.ifft(light, n=x.fine, norm="forward")
        parts.append(field[..., : mx * x.every : x.every])
    return torch.cat(parts)


def _mix_depths(fields: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
    """(depth, y, x) irradiance |Σ_b coefficients[depth, b] fields[b]|², by rows.

    Args:
        fields: (b, y, x) complex.
        coefficients: (depth, b).
    """
    bands = []
    for rows in torch.split(fields, MIXED_ROWS, 1):
        squares = torch.view_as_real(coefficients @ rows.flatten(1)).square()
        irradiance = squares[..., 0] + squares[..., 1]
        bands.append(irradiance.view(len(coefficients), *rows.shape[1:]))
    return torch.cat(bands, 1)
