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
from metalens.propagate.moments import (
    PillarMoments,
    Pupils,
    mix_components,
    plan_moments,
    reduce_to_moments,
)
from metalens.propagate.paths import (
    from_source,
    over_blocks,
    ray_cosines,
    reference_depth,
    to_sensor,
)
from metalens.propagate.window import depth_basis

RAYS = 33  # along an axis, whose reach the quadratic follows


SPARE = 1.2  # grid of the lens over the least that the kernel's band asks for


MOST = 20000  # points of a transform along an axis


# points of the lens that a window asks for, and half-waves in it, from which no other
# method does as well; below some
# 35 the fading and the grid beyond the lens's rim are as wide as lens and window, and
# errors miss any setting (on
# random lenses of 20 to 120 pillars by up to 3e-2; their estimates say so)
WIDE = 120


# of the digits asked for that fading keeps where it does most: on light of the lens's
# far rim at the far end of the
# window, which weighs little; light that is even over both misses the setting, as the
# estimate says, and is done again
FADED = 0.4


STEEPEST = 0.93  # |p| of a ray, fading included, in units of the rarest index


@dataclass(frozen=True, slots=True)
class WideAxis:
    """One axis of a wide window.

    count, first_um, step_um: of the even grid over the lens, which stands over by
    ``taps`` on both sides; ``over``: as
    fine as the kernel asks for, times this. first: points of the first transform, of
    which the middle ``size`` are over
    the padded window, and go on. fine: of the last one, whose step is that
    of the window's samples or a whole part of it, ``every``. middle, reach_um,
    stretch_um: p0, A, D of the module.
    most, guard: largest |p - p0| of a ray to the window; band beyond it in which the
    light is faded out; sharp: half of
    that in standard deviations. steepest: |p| of a ray to the window.
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
    middle: float
    reach_um: float
    stretch_um: float
    most: float
    guard: float
    sharp: float
    steepest: float


@dataclass(frozen=True, slots=True)
class QuadraticFit:
    """The quadratic along one axis: p0, A, D of the module; most: largest |p - p0| of a
    ray to the window; extra: what
    the quadratic leaves of its reach; steepest: |p| of any ray."""

    middle: float
    reach_um: float
    stretch_um: float
    most: float
    extra_um: float
    steepest: float


@functools.lru_cache(maxsize=256)
def wide_axes(
    case: PropagationCase, tolerance: float
) -> tuple[WideAxis, WideAxis] | None:
    """(y, x) grids for a window; None where its rays are too steep or too far from
    quadratic for the method.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.
    """
    fits, extra = _fitted(case, list(case.half_window_um)), [0.0, 0.0]
    for _ in range(2):
        if fits is None:
            return None
        extra = [fit.extra_um for fit in fits]
        if any(
            e > 2 * (w + h)
            for e, w, h in zip(
                extra, case.half_window_um, case.half_size_um, strict=True
            )
        ):
            return None
        fits = _fitted(
            case, [w + e for w, e in zip(case.half_window_um, extra, strict=True)]
        )
    if fits is None:
        return None
    sharp = math.sqrt(2 * FADED * math.log(1 / tolerance))
    fade = 2 * sharp**2 / case.wavenumber
    widths = [
        2 * (w + fit.extra_um) for w, fit in zip(case.half_window_um, fits, strict=True)
    ]
    guards = [
        math.sqrt(2 * fade * fit.most / width)
        for width, fit in zip(widths, fits, strict=True)
    ]
    if fits[0].steepest + max(guards) > STEEPEST * case.media.layers[0][0]:
        return None
    beyond = _beyond(case, fits, guards)
    axes = [
        _axis(case, i, fits[i], (guards[i], sharp, beyond[i]), tolerance)
        for i in (0, 1)
    ]
    return None if axes[0] is None or axes[1] is None else (axes[0], axes[1])


def _beyond(
    case: PropagationCase, fits: tuple[QuadraticFit, QuadraticFit], guards: list[float]
) -> list[float]:
    """What the quadratic leaves of the reach of the light that is faded out, along y
    and x.
    """
    y, x = (
        f.middle + np.linspace(-1, 1, RAYS) * (f.most + g)
        for f, g in zip(fits, guards, strict=True)
    )
    w = y[:, None] ** 2 + x**2
    inside = w <= (fits[0].steepest + max(guards)) ** 2
    bend = media.reach_per_direction(case.media.layers, np.where(inside, w, 0.0))
    excess = []
    for fit, p in zip(fits, (y[:, None], x), strict=True):
        left = p * bend - fit.reach_um - fit.stretch_um * (p - fit.middle)
        excess.append(float(np.abs(np.where(inside, left, 0)).max()))
    return excess


def is_wide(case: PropagationCase, tolerance: float) -> bool:
    """Whether the method is the quickest without a look at the others, whose plans take
    long for such windows.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.
    """
    axes = wide_axes(case, tolerance)
    if axes is None:
        return False
    waves = (
        4 * axis.most * half / case.wavelength_um
        for axis, half in zip(axes, case.half_window_um, strict=True)
    )
    return min(*waves, *(axis.count - 2 * axis.taps for axis in axes)) > WIDE


def _fitted(
    case: PropagationCase, half: list[float]
) -> tuple[QuadraticFit, QuadraticFit] | None:
    """Along y and x, for rays to ``half`` about the window's middle."""
    unit = np.cos(np.pi * (np.arange(RAYS) + 0.5) / RAYS)
    centre = case.centre_um[::-1]
    y, x = (
        c + unit * (w + h)
        for c, w, h in zip(centre, half, case.half_size_um, strict=True)
    )
    both = [
        np.asarray(ray_cosines(case, *at)) for at in ((y[:, None], x), (x, y[:, None]))
    ]
    steepest = float(np.sqrt((both[0] ** 2 + both[1] ** 2).max()))
    if steepest > STEEPEST * case.media.layers[0][0]:
        return None
    out = []
    for along, p in zip((y[:, None], x), both, strict=True):
        reach = np.broadcast_to(along, p.shape)
        p0 = float(p.min() + p.max()) / 2
        slope, level = np.polyfit((p - p0).ravel(), reach.ravel(), 1)
        left = float(np.abs(reach - level - slope * (p - p0)).max())
        out.append(
            QuadraticFit(
                p0,
                float(level),
                float(slope),
                float(np.abs(p - p0).max()),
                left,
                steepest,
            )
        )
    return out[0], out[1]


def _axis(
    case: PropagationCase,
    i: int,
    fit: QuadraticFit,
    faded: tuple[float, float, float],
    tolerance: float,
) -> WideAxis | None:
    """The grids of an axis; faded: width in p of what is faded out, half of it in
    standard deviations, and how far
    that light goes astray."""
    guard, sharp, beyond = faded
    coarse = case.wavelength_um / 2 / (fit.most + guard)
    every = math.ceil(case.step_um / coarse)
    width = (
        2 * (case.half_window_um[i] + beyond) + 4 * sharp**2 / case.wavenumber / guard
    )
    fine = _quick(width * every / case.step_um)
    period = fine * case.step_um / every
    size = min(_quick(period / coarse), fine)
    least = (
        case.wavelength_um * fit.stretch_um * size / period
    )  # grid step of the lens times points of the first transform
    band, first = _band(case, i, fit.extra_um), size
    while first <= MOST:
        over = case.wavelength_um / (2 * band) * first / least
        if over >= SPARE:
            taps = math.ceil(
                1 + math.log(10 / tolerance) * over / (math.pi * (over - 1))
            )
            count = math.ceil(2 * case.half_size_um[i] * first / least) + 2 * taps + 1
            if count <= first:
                low = -(count - 1) / 2 * least / first
                grid = count, low, least / first, taps, over, first, size, fine, every
                return WideAxis(
                    *grid,
                    fit.middle,
                    fit.reach_um,
                    fit.stretch_um,
                    fit.most,
                    guard,
                    sharp,
                    fit.steepest,
                )
        first = _quick(max(first + 1, min(SPARE / over, 1.5) * first))
    return None


def _quick(points: float) -> int:
    """Size of a transform: the next multiple of 4 with small prime factors."""
    return int(4 * next_fast_len(math.ceil((points - 1e-9) / 4)))


def _band(case: PropagationCase, i: int, extra: float) -> float:
    """Largest |d path / d x| along an axis of the kernel without its carrier, over
    lens, window and depths.
    """
    (hy, hx), (wy, wx) = case.half_size_um, case.half_window_um
    ends = np.array([-1.0, 0.0, 1.0])
    y, x, Y, X = np.meshgrid(ends * hy, ends * hx, ends * wy, ends * wx, indexing="ij")
    Y, X = (Y + np.sign(Y) * extra, X) if i == 0 else (Y, X + np.sign(X) * extra)
    far = [(case.centre_um[1] - y, Y), (case.centre_um[0] - x, X)]
    away, beside = far[i], far[1 - i]
    turned = ray_cosines(case, away[0] + away[1], beside[0] + beside[1]) - ray_cosines(
        case, away[0], beside[0]
    )
    tiny = np.array([-0.5, 0.5])[:, None, None] * 1e-3
    at = [ends[:, None] * hy, ends * hx]
    at[i] = at[i] + tiny
    steep = 0.0
    for inverse in (min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)):
        path = from_source(case, at[1], at[0], case.tangents, inverse)
        path = np.asarray(
            path - from_source(case, at[1], at[0], case.tangents, reference_depth(case))
        )
        steep = max(steep, float(np.abs(path[1] - path[0]).max() / 1e-3))
    return max(float(np.abs(turned).max()) + steep, 1e-6)


def grid_um(axis: WideAxis) -> Array:
    """(count,) places of the even grid over the lens.

    Args:
        axis: grids along one axis.
    """
    return axis.first_um + axis.step_um * np.arange(axis.count)


def spread_weights(axis: WideAxis, places_um: Array) -> Array:
    """(place, grid) sinc under Kaiser's window: f(x) = Σ_m weight f(x_m) for what the
    kernel's band holds.

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


BAND_BYTES = 3e6  # of the depths that are mixed at once


EVERY = (
    3  # point of the grid of the lens whose light says which depth fields are needed
)


CHUNK_BYTES = 4e7  # of the depth fields that are transformed at once


@dataclass(frozen=True, eq=False, slots=True)
class WidePlan:
    """Everything that depends on the geometry alone. axes: (y, x); fields: (b, y, x)
    depth fields on the grid of the
    lens, its phases included; coefficients: (depth, b); chirp, transfer: (X, Y) behind
    the first and second transform,
    as light lies in memory between them.
    left: of the light of all depths that fewer fields may leave out, root mean square.
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
    def judged_um(self) -> tuple[Array, Array]:
        """(e,), (x,) positions of the grid over the lens."""
        y, x = (grid_um(axis) for axis in self.axes)
        return y, x


@functools.lru_cache(maxsize=2)
def plan_wide(case: PropagationCase, tolerance: float, dtype: torch.dtype) -> WidePlan:
    """Plan a wide window; the last two are kept.

    Args:
        case, tolerance: geometry, and relative error of the field.
        dtype: of the maps and of the transforms.

    Raises:
        PropagationError: rays too steep, or too unlike a quadratic, for the method.
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
        kind = torch.complex64 if dtype == torch.float32 else torch.complex128
        fields, coefficients = _depth_fields(case, axes, tolerance / 2)
        lens = _lens_phase(case, axes)
        arrays = (
            coefficients,
            *(np.ascontiguousarray(a.T) for a in _behind(case, axes)),
        )
        given = [torch.tensor(a, dtype=kind) for a in arrays]
        table = torch.empty((coefficients.shape[1], *lens.shape), dtype=kind)
        for one, field in zip(table, fields, strict=True):
            one.copy_(torch.from_numpy(field * lens))
    return WidePlan(case, axes, pillars, table, given[0], given[1], given[2], tolerance)


def _depth_fields(
    case: PropagationCase, axes: tuple[WideAxis, WideAxis], tolerance: float
) -> tuple[Iterator[Array], Array]:
    """(b, y, x) depth fields on the grid of the lens, one after the other, and (depth,
    b) coefficients.
    """
    grids = [grid_um(axis) for axis in axes]
    counts = [min(_coarse(case, i, g), len(g)) for i, g in enumerate(grids)]
    e, x = (
        legendre.mapped_nodes(n, g[0], g[-1])
        for n, g in zip(counts, grids, strict=True)
    )
    depths = depth_basis(case, (e, x), tolerance)
    to = [
        legendre.interpolation_matrix(n, g / g[-1])
        for n, g in zip(counts, grids, strict=True)
    ]
    return (to[0] @ one @ to[1].T for one in depths.basis), depths.coefficients


def _coarse(case: PropagationCase, i: int, grid: Array) -> int:
    """Legendre nodes that hold the phase of the extreme depths along an axis: two a
    turn, and some.
    """
    far = [np.array([0.0, *case.half_size_um])[:, None], grid[[0, -1]]]
    y, x = (far[1], far[0]) if i == 0 else (far[0], far[1])
    turns = 0.0
    for inverse in (min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)):
        path = from_source(case, x, y, case.tangents, inverse)
        path = path - from_source(case, x, y, case.tangents, reference_depth(case))
        turns = max(turns, float(np.abs(path).max()) / case.wavelength_um)
    return 24 + math.ceil(6 * turns)


def _lens_phase(case: PropagationCase, axes: tuple[WideAxis, WideAxis]) -> Array:
    """(y, x) what the light of the grid is multiplied by before the first transform,
    all constants included.
    """
    k, lam = case.wavenumber, case.wavelength_um
    total, ramp = np.zeros((1, 1)), np.ones((1, 1), complex)
    for i, (axis, c) in enumerate(zip(axes, case.centre_um[::-1], strict=True)):
        x, x0 = grid_um(axis), c - axis.reach_um
        path = (x - x0) ** 2 / (2 * axis.stretch_um) + axis.middle * (c - x)
        turn = np.exp(
            2j * np.pi * (axis.size // 2) * np.arange(axis.count) / axis.first
        )
        total, ramp = (
            (total + path[:, None], ramp * turn[:, None])
            if i == 0
            else (total + path, ramp * turn)
        )
    y, x = (grid_um(axis) for axis in axes)
    away = np.asarray(to_sensor(case, x, y[:, None]))
    scale = case.area_um2 / (
        1j * lam * math.sqrt(axes[0].stretch_um * axes[1].stretch_um)
    )
    start = float(_phase_path(case, axes[0].middle ** 2 + axes[1].middle ** 2))
    return np.asarray(scale * ramp * np.exp(1j * k * (total - away + start)))


def _phase_path(case: PropagationCase, w: Any) -> Any:
    """Φ = Σ t √(n² - w), um."""
    return sum(t * (n * n - w) ** 0.5 for n, t in case.media.layers)


def _behind(
    case: PropagationCase, axes: tuple[WideAxis, WideAxis]
) -> tuple[Array, Array]:
    """(Y, X) chirp of the window behind the first transform, and transfer of what the
    quadratic leaves.
    """
    k = case.wavenumber
    chirps, ramps, squares, paths = [], [], [], []
    for axis, samples, c in zip(axes, case.samples, case.centre_um[::-1], strict=True):
        period = axis.fine * case.step_um / axis.every
        n = np.arange(axis.size) - axis.size // 2
        width = period / axis.size
        place = (axis.first_um - (c - axis.reach_um)) / axis.step_um
        turns = n * (
            axis.size // 2 / axis.size - place / axis.first
        )  # the lowest order of the next transform is first
        chirps.append(
            np.exp(
                1j * k * (n * width) ** 2 / (2 * axis.stretch_um) + 2j * np.pi * turns
            )
        )
        u = n * case.wavelength_um / period
        first = -(samples - 1) / 2 * case.step_um / width + axis.size // 2
        ramps.append(
            np.exp(2j * np.pi * n * first / axis.size)
            * _fade(axis, np.abs(u) - axis.most)
            / axis.size
        )
        squares.append((axis.middle + u) ** 2)
        paths.append(axis.reach_um * u + axis.stretch_um / 2 * u * u)
    w = squares[0][:, None] + squares[1]
    narrow = max(axes, key=lambda axis: axis.guard)
    inside = w < (narrow.steepest + 1.1 * narrow.guard) ** 2
    w = np.where(inside, w, 0.0)
    psi = _phase_path(case, w) - _phase_path(
        case, axes[0].middle ** 2 + axes[1].middle ** 2
    )
    psi = psi + paths[0][:, None] + paths[1]
    level = _fade(narrow, np.sqrt(w) - narrow.steepest)
    level = level * np.sqrt(media.passed_at(case.media.order, w))
    transfer = np.where(
        inside, ramps[0][:, None] * ramps[1] * level * np.exp(1j * k * psi), 0
    )
    return chirps[0][:, None] * chirps[1], transfer


def _fade(axis: WideAxis, past: Array) -> Array:
    """1 for rays to the window, 0 past the end of the band, by the integral of a
    Gaussian between.
    """
    return np.asarray(
        scipy.special.erfc(axis.sharp / math.sqrt(2) * (2 * past / axis.guard - 1)) / 2
    )


def light_wide(
    maps: tuple[torch.Tensor, torch.Tensor],
    plan: WidePlan,
    pupils: Pupils | None = None,
) -> tuple[torch.Tensor, Array, list[float]]:
    """Irradiance on the window (depth, y, x); light of every map on the even grid of the
    lens; sums of squares of the transmissions.

    Differentiable once in the maps.

    Args:
        maps: (map, y, x) phase and transmission. plan: of :func:`plan_wide`.
        pupils: factors on the light of the maps; None for the |U|² of one map.
    """
    reduced = [
        reduce_to_moments(p, t, plan.moments) for p, t in zip(*maps, strict=True)
    ]
    grid, total = torch.stack([g for g, _ in reduced]), None
    for sign, light in mix_components(grid, pupils, plan.judged_um):
        mixture, coefficients = (
            (None, plan.coefficients) if light.requires_grad else _fewer(light, plan)
        )
        here = _mixed(fields_wide(light, plan, mixture), coefficients)
        here = here if sign == 1 else sign * here
        total = here if total is None else total + here
    powers = [power for _, power in reduced]
    return torch.as_tensor(total), grid.detach().numpy().astype(complex), powers


def _fewer(light: torch.Tensor, plan: WidePlan) -> tuple[torch.Tensor, torch.Tensor]:
    """(fewer, b) mixtures of the depth fields and (depth, fewer) coefficients for this
    light on the grid of the lens:
    a round lens leaves the corners of its square dark, where depths differ most.

        F_z L ≈ Σ_r U_zr (Uᴴ C B)_r L,    U: first eigenvectors of C G Cᴴ,    G_ij = Σ_x |L|² B_i B_j*
    """
    some = (
        (plan.fields[:, ::EVERY, ::EVERY] * light[::EVERY, ::EVERY])
        .flatten(1)
        .to(torch.complex128)
    )
    c = plan.coefficients.to(torch.complex128)
    power, axes = torch.linalg.eigh(c @ (some @ some.mH) @ c.mH)
    lost = torch.cumsum(power.clamp_min(0), 0)  # ascending
    first = min(int((lost <= plan.left**2 * lost[-1]).sum()), len(lost) - 1)
    kept = axes[:, first:]
    return (kept.mH @ c).to(plan.coefficients), kept.to(plan.coefficients)


def fields_wide(
    gathered: torch.Tensor, plan: WidePlan, mixture: torch.Tensor | None = None
) -> torch.Tensor:
    """(b, y, x) field of every depth field, or of every mixture (fewer, b) of them, on
    the window from the light on the
    grid of the lens, up to a phase of each sample that all share.

    Args:
        gathered: (y, x) light on the grid of the lens.
        plan: of :func:`plan_wide`.
    """
    y, x = plan.axes
    my, mx = plan.case.samples
    step = max(1, int(CHUNK_BYTES / (2 * y.fine * x.fine * gathered.element_size())))
    parts = []
    fields = (
        plan.fields if mixture is None else torch.tensordot(mixture, plan.fields, 1)
    )
    count = len(fields)
    out = None if gathered.requires_grad else gathered.new_empty((count, my, mx))
    for start in range(0, count, step):
        some = slice(start, start + step)
        light = torch.fft.fft(fields[some] * gathered, n=x.first)[
            ..., : x.size
        ].mT  # every transform is along the last
        light = torch.fft.fft(light, n=y.first)[..., : y.size] * plan.chirp
        light = torch.fft.fft2(light)
        light *= plan.transfer
        light = torch.fft.ifft(light, n=y.fine, norm="forward")[
            ..., : my * y.every : y.every
        ].mT
        field = torch.fft.ifft(light, n=x.fine, norm="forward")[
            ..., : mx * x.every : x.every
        ]
        if out is None:
            parts.append(field)
        else:
            out[some] = field
    return torch.cat(parts) if out is None else out


def _mixed(fields: torch.Tensor, coefficients: torch.Tensor) -> torch.Tensor:
    """(depth, y, x) |Σ_b coefficients[depth, b] fields[b]|², some rows at a time."""
    depths, (count, my, mx) = len(coefficients), fields.shape
    step = max(1, int(BAND_BYTES / (2 * depths * mx * fields.element_size())))
    bands = []
    out = None if fields.requires_grad else fields.real.new_empty((depths, my, mx))
    for start in range(0, my, step):
        some = fields[:, start : start + step]
        field = torch.view_as_real(
            (coefficients @ some.reshape(count, -1)).view(depths, -1, mx)
        )
        if out is None:
            bands.append(field.square().sum(-1))
        else:
            squares = field.square_()
            torch.add(
                squares[..., 0], squares[..., 1], out=out[:, start : start + step]
            )
    return torch.cat(bands, 1) if out is None else out
