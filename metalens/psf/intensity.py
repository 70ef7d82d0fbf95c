"""Irradiance of one lens in one direction by the cheapest method, repeated at a tighter
setting until its measured error is within the tolerance.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.optics import Layers, media
from metalens.propagate import (
    SHARE,
    NodeLight,
    PropagationCase,
    Pupils,
    check_aperture,
    chief_path,
    choose_method,
    field_exact,
    light_on_window,
    mix_components,
    paths,
    plan_wide,
    plan_window,
    pupil_error,
    relative_error,
)
from metalens.psf import extended
from metalens.psf.budget import PsfErrorBudget, worst_of_budgets
from metalens.psf.cells import (
    FINER,
    MOST,
    PixelCells,
    integrate_cells,
    plan_pixel_cells,
)
from metalens.psf.extended import SourceExtent
from metalens.psf.vector import PolarizationMixing, has_faces, s_and_p

# standard deviation of a pillar's phasor and relative error of three transforms, by
# rounding, several times the machine epsilon of the maps
ROUNDING = {torch.float32: (8e-7, 1e-6), torch.float64: (1e-11, 5e-15)}
EXACT = 4e-12  # rounding of exact sums in float64
FEW = 64  # samples whose rounding has no mean: their pillars are added in float64
TIGHTEST = 1e-12  # setting below which float64 has nothing left to give
HELD_BYTES = 2.5e9  # of the fields of all depths that are computed at once
SAMPLE_BYTES = 18  # for each sample and depth, per byte of a number of the maps
CELLS = 0.5  # of the tolerance, for the integration over cells; else for the sums
STRICTER = 4  # tolerance of point PSFs, whose differences judge a finite source

Maps = tuple[torch.Tensor, torch.Tensor]


@dataclass(frozen=True, eq=False, slots=True)
class IntensityRequest:
    """Which PSFs of one lens are computed, in one direction.

    maps: (wavelength · map, y, x) phase and transmission of the pillars.
    cases, weights: of the wavelengths, all with one direction, depths and window.
    tolerance: relative L2 error of the PSFs.
    mixing: of both polarisations; None for |U|² of one scalar.
    layers: whose stop lays its shadow on the maps.
    integrate, source: as in :func:`metalens.psf.psf_stack`.
    """

    maps: Maps
    cases: list[PropagationCase]
    weights: list[float]
    tolerance: float
    mixing: PolarizationMixing | None = None
    layers: Layers | None = None
    integrate: bool = True
    source: SourceExtent | None = None

    @property
    def differentiable(self) -> bool:
        """Whether the maps require a gradient."""
        return any(m.requires_grad for m in self.maps)

    @property
    def map_count(self) -> int:
        """Maps of every wavelength."""
        return 1 if self.mixing is None else self.mixing.maps

    @property
    def behind_stop(self) -> bool:
        """Whether the light of each depth meets another shadow on the pillars."""
        stop = None if self.layers is None else self.layers.stop
        return stop is not None and stop.distance_um > 0

    def at(self, like: PropagationCase, tolerance: float) -> "IntensityRequest":
        """This request with the direction, depths and window of another case."""
        names = ("tangents", "inverse_depths_per_um", "centre_um", "step_um", "samples")
        cases = [replace(c, **{n: getattr(like, n) for n in names}) for c in self.cases]
        return replace(self, cases=cases, tolerance=tolerance)

    def shaded(self) -> "IntensityRequest":
        """This request with the stop's shadow, at the first depth, on the maps."""
        if self.layers is None or self.layers.stop is None:
            return self
        shadows = []
        for case in self.cases:
            y, x = case.pillars_um
            inverse, width = case.inverse_depths_per_um[0], math.sqrt(case.area_um2)
            source = case.tangents, 1 / inverse if inverse else math.inf
            shadows.append(
                self.layers.shadow(*source, case.wavelength_um, (x, y[:, None]), width)
            )
        shadow = torch.from_numpy(np.repeat(shadows, self.map_count, 0))
        phase, level = self.maps
        maps = phase + shadow.angle().to(phase), level * shadow.abs().to(level)
        return replace(self, maps=maps, layers=None)

    def each(self) -> Iterator[tuple[Maps, PropagationCase, float, Pupils | None]]:
        """(maps, case, weight, mixing) of every wavelength."""
        count, (phase, level) = self.map_count, self.maps
        for i, (case, weight) in enumerate(zip(self.cases, self.weights, strict=True)):
            own = slice(i * count, (i + 1) * count)
            pupils = None if self.mixing is None else self.mixing.pupils(case)
            yield (phase[own], level[own]), case, weight, pupils

    @property
    def films_error(self) -> float:
        """Relative L2 error of the kernel through films, the worst over wavelengths."""
        return max(
            paths.films_error(case, maps[1].detach()[0].numpy())
            for maps, case, _, _ in self.each()
        )

    @property
    def own_mixing(self) -> Callable[[PropagationCase], Pupils] | None:
        """Mixing by the rays to a single point, with which the window's is compared; of
        s and p where a scalar meets faces of films."""
        if self.mixing is not None:
            return self.mixing.pupils
        return s_and_p if has_faces(self.cases[0]) else None

    def power(
        self, case: PropagationCase, powers: list[float], level: torch.Tensor
    ) -> float:
        """Power behind the pillars, from the sums of squares of the maps ``level``."""
        if self.mixing is None:
            return powers[0]
        return self.mixing.power(case, powers, level)


@dataclass(frozen=True, eq=False, slots=True)
class IntensityResult:
    """Irradiance on a window and its error by cause.

    intensity: (depth, y, x). reason: method, and why it stopped.
    power: sum of squares of what the pillars let through the faces behind them,
    wavelengths weighted; of each depth where they were computed in shares.
    """

    intensity: torch.Tensor
    budget: PsfErrorBudget
    reason: str
    power: Any


def compute_intensity(request: IntensityRequest) -> IntensityResult:
    """Irradiance on the window, cells as fine as they must be, with its error by cause.

    Cells wider than Nyquist's step are integrated over points inside them, with finer
    points until that error is within its share of the tolerance. As many depths are
    computed at once as memory holds; one by one behind a stop.

    Args:
        request: maps of the lens, direction, depths and window.

    Returns:
        IntensityResult: (depth, y, x) irradiance, power (depth,) and error budget.

    Raises:
        PropagationError: no light in the window, empty or infinite maps, too many
            samples.
    """
    shortest = min(request.cases, key=lambda case: case.wavelength_um)
    tolerance = request.tolerance
    for finer in FINER:
        fine = PixelCells(1, shortest)
        if request.integrate:
            fine = plan_pixel_cells(shortest, finer)
        wide = fine.case
        if request.source is not None:
            wide = extended.widen_case(wide, request.source)[0]
        if max(wide.samples) > MOST and fine.points > 1:
            raise PropagationError(
                f"cells of {fine.points} points in {wide.samples} samples: give a smaller window"
            )
        sum_tolerance = (
            tolerance if fine.points == 1 else tolerance * math.sqrt(1 - CELLS**2)
        )
        results = [
            _on_cells(request.at(part, sum_tolerance), part, fine)
            for part in _shares(wide, request)
        ]
        budget = worst_of_budgets([result.budget for result in results])
        if budget.sampling <= CELLS * tolerance or max(fine.case.samples) > MOST / 2:
            break
    reason = max(results, key=lambda result: result.budget.numerical).reason
    if len(results) > 1:
        reason += f"; depths in {len(results)} shares"
    if fine.points > 1:
        reason += (
            f"; light integrated over cells of {fine.points} x {fine.points} points"
        )
    intensity = results[0].intensity
    if len(results) > 1:
        intensity = torch.cat([result.intensity for result in results])
    power = [np.full(len(result.intensity), result.power) for result in results]
    steep = 1 + np.square(request.cases[0].tangents).sum()
    passed = media.passed_at(request.cases[0].media.order, 1 - 1 / steep)
    return IntensityResult(intensity, budget, reason, np.concatenate(power) * passed)


def _shares(
    wide: PropagationCase, request: IntensityRequest
) -> Iterator[PropagationCase]:
    """The case split by depths into equal parts that fit in ``HELD_BYTES`` of memory.

    Each depth is a part of its own behind a stop. All are one part where gradients keep
    every field in memory.

    Args:
        wide: window and all depths.
        request: maps and their gradients.
    """
    inverse = wide.inverse_depths_per_um
    count = 1
    if request.behind_stop:
        count = len(inverse)
    elif not request.differentiable:
        itemsize = request.maps[0].element_size()
        depth_bytes = math.prod(wide.samples) * SAMPLE_BYTES * itemsize
        count = -(-len(inverse) // max(1, int(HELD_BYTES / depth_bytes)))
    for i in range(count):
        part = slice(len(inverse) * i // count, len(inverse) * (i + 1) // count)
        yield replace(wide, inverse_depths_per_um=inverse[part])


def _on_cells(
    request: IntensityRequest, part: PropagationCase, fine: PixelCells
) -> IntensityResult:
    """Irradiance of some depths, blurred by the source and integrated over cells.

    Args:
        request: lens and light.
        part: the depths, and the window of the point PSFs.
        fine: cells of the window and their inner points.
    """
    source = request.source
    result = _blurred(request, part, fine, source) if source else _of_point(request)
    if fine.points > 1:
        light, sampling = integrate_cells(result.intensity, fine)
        budget = replace(result.budget, sampling=sampling)
        result = replace(result, intensity=light, budget=budget)
    return result


def _blurred(
    request: IntensityRequest,
    part: PropagationCase,
    fine: PixelCells,
    source: SourceExtent,
) -> IntensityResult:
    """Irradiance of a source of finite size, on the points of the cells.

    The PSF of its middle is convolved with the source's image. The error has two parts:
    the blur's own, and the change of the PSF over the source.

    Args:
        request: lens and light.
        part: depths, and the window widened by the source's image.
        fine: cells whose points are returned.
        source: shape and size.
    """

    def point(case: PropagationCase) -> IntensityResult:
        return _of_point(request.at(case, request.tolerance / STRICTER))

    result = point(part)
    rows, columns = (
        (n - m) // 2 for n, m in zip(part.samples, fine.case.samples, strict=True)
    )
    light, edge = extended.blur_by_source(
        result.intensity, part, source, (rows, columns)
    )
    with torch.no_grad():
        shift_variance = extended.shift_invariance_error(
            result.intensity, part, source, lambda case: point(case).intensity
        )
    budget = replace(result.budget, source=math.hypot(edge, shift_variance))
    reason = f"{result.reason}; blurred by a {source.shape} source"
    return replace(result, intensity=light, budget=budget, reason=reason)


def _of_point(request: IntensityRequest) -> IntensityResult:
    """Irradiance |U|² of a point source on the samples, summed over wavelengths.

    The exact sum is used where it is the cheapest method. Otherwise the windowed method
    is tried at three settings, each tighter. The first result whose measured error is
    within the tolerance is returned, else the last with its error. Pillars are summed
    in the precision of their maps where that suffices, then in float64.
    """
    request = request.shaded()
    phase = request.maps[0]
    case = request.cases[0]
    tolerance = request.tolerance
    model_error = math.hypot(torch.finfo(phase.dtype).eps, request.films_error)

    def finish(result: IntensityResult) -> IntensityResult:
        """In the precision of the maps, with what rounding and films add."""
        error = math.hypot(result.budget.numerical, model_error)
        budget = replace(result.budget, numerical=error)
        light = result.intensity.to(phase.dtype)
        return replace(result, intensity=light, budget=budget)

    if not request.differentiable:
        setting = max(tolerance / 2, TIGHTEST)
        choices = [choose_method(wave_case, setting) for wave_case in request.cases]
        if all(choice.method == "exact" for choice in choices):
            return finish(_exact(request, choices[0].reason))
    first = phase.dtype if tolerance > 1e-6 else torch.float64
    if math.prod(case.samples) < FEW:
        first = torch.float64
    start = tolerance / 2
    # gradients hold the kernel's error pillar by pillar, and nearly vanish in focus with
    # all light on the window
    if request.differentiable:
        start = max(tolerance / 32, min(tolerance / 8, 1e-6))
    tries = [(start, first), (start / 4, first), (start / 50, torch.float64)]
    for setting, dtype in tries:
        result = finish(_windowed(request, dtype, max(setting, TIGHTEST)))
        if result.budget.numerical <= tolerance:
            break
    return result


def _exact(request: IntensityRequest, reason: str) -> IntensityResult:
    """Exact sum over pillars, Σ weight · |U|² over wavelengths and components.

    Its error is that of float64: noise n on U of half an epsilon of the largest phase
    for each pillar, and twice the relative L2 norm of 2 Re U* n.

    Args:
        request: maps, cases and weights of the wavelengths.
        reason: words for why this method was chosen.
    """
    total: Any = 0.0
    power = 0.0
    noise = 0.0
    checked = []
    for (phase, level), case, weight, pupils in request.each():
        phase, level = phase.double(), level.double()
        powers = (level**2).sum((-1, -2)).tolist()
        power += weight * request.power(case, powers, level)
        angle = case.wavenumber * (chief_path(case) + math.hypot(*case.half_size_um))
        angle += float((phase.abs() * (level != 0)).max())
        rounding = np.finfo(float).eps / 2 * angle
        noise = max(noise, rounding * _incoherent(sum(powers), case))
        if request.own_mixing is not None:
            checked.append(_pillar_light((phase, level), case, weight, pupils))
        for sign, light in mix_components(
            torch.polar(level, phase), pupils, case.pillars_um
        ):
            field = field_exact(torch.angle(light).numpy(), light.abs().numpy(), case)
            total = total + weight * sign * np.abs(field) ** 2
    whole = np.maximum(np.abs(total.sum((1, 2))), 1e-300)
    squares = float((2 * noise**2 / whole).sum() / (total.T**2 / whole**2).sum())
    budget = PsfErrorBudget(
        math.hypot(EXACT, 2 * math.sqrt(squares)),
        polarisation=_mixing_error(request, checked, total),
    )
    return IntensityResult(torch.as_tensor(total), budget, reason, power)


def _pillar_light(
    maps: Maps, case: PropagationCase, weight: float, pupils: Pupils | None
) -> NodeLight:
    """Light of all pillars without its carrier, for the check of one mixing for all.

    The carrier is k times the path from source to pillar to window centre.
    """
    y, x = case.pillars_um
    path = paths.from_source(
        case, x, y[:, None], case.tangents, paths.reference_depth(case)
    )
    carrier = case.wavenumber * np.asarray(path + paths.to_sensor(case, x, y[:, None]))
    light = torch.polar(maps[1], maps[0] + torch.as_tensor(carrier)).numpy()
    at = None if pupils is None else pupils(y, x)
    return NodeLight(case, weight, light, (y, x), 0.0, pupils=at)


def _mixing_error(
    request: IntensityRequest, waves: list[NodeLight], light: Array
) -> float:
    """Relative L2 error of one polarisation mixing for the window; nan without one."""
    if request.own_mixing is None:
        return math.nan
    return pupil_error(waves, light, request.own_mixing)


def _windowed(
    request: IntensityRequest, dtype: torch.dtype, tolerance: float
) -> IntensityResult:
    """Irradiance by the windowed or wide method at one setting, with measured error.

    The error is measured against exact sums at points of the window.

    Args:
        request: maps, cases and weights of the wavelengths.
        dtype: in which pillars are summed.
        tolerance: setting of the method, relative L2.

    Raises:
        PropagationError: no light in the window.
    """
    shortest = min(request.cases, key=lambda case: case.wavelength_um)
    choice = choose_method(shortest, tolerance, differentiable=True)
    is_wide = choice.method == "wide"
    checked: list[NodeLight] = []
    total: Any = None
    power = 0.0
    for maps, case, weight, pupils in request.each():
        plan: Any = (
            plan_wide(case, tolerance, dtype)
            if is_wide
            else plan_window(case, tolerance, dtype, smooth=pupils is not None)
        )
        light, nodes, powers = light_on_window(maps, plan, pupils)
        _check(maps, case, sum(powers), nodes)
        at_um = plan.check_nodes_um
        mixing_at_nodes = None if pupils is None else pupils(*at_um)
        rounding = plan.moments.rounding_rad
        noise = math.hypot(ROUNDING[dtype][0], tolerance / SHARE, rounding)
        noise *= _incoherent(_noisy_power(powers, mixing_at_nodes), case)
        checked.append(NodeLight(case, weight, nodes, at_um, noise, mixing_at_nodes))
        light = light if weight == 1 else weight * light
        total = light if total is None else total + light
        power += weight * request.power(case, powers, maps[1])
    if not bool((total.detach().sum((-1, -2)) > 0).all()):
        raise PropagationError(
            "no light reaches the window at some depth; move or widen the window"
        )
    values = total.detach().numpy()
    error = relative_error(checked, values)
    if is_wide:
        error = math.hypot(error, ROUNDING[dtype][1])
    budget = PsfErrorBudget(error, polarisation=_mixing_error(request, checked, values))
    return IntensityResult(total, budget, choice.reason, power)


def _noisy_power(powers: list[float], mixing: tuple[Array, Array] | None) -> float:
    """Power that bounds the rounding noise: Σ |t|² of all components.

    Args:
        powers: sum of squares of each map's transmission.
        mixing: signs and factors of the mixing at the nodes; each factor counts at its
            largest. None for one scalar.
    """
    if mixing is None:
        return powers[0]
    return float((np.abs(mixing[1]).max((2, 3)) ** 2 @ np.array(powers)).sum())


def _check(maps: Maps, case: PropagationCase, power: float, nodes: Array) -> None:
    """Raise for maps that are empty or not finite.

    The sums over all pillars show this at no cost; only then are the maps searched.

    Raises:
        PropagationError: naming row and column.
    """
    finite = math.isfinite(power) and bool(np.isfinite(nodes).all())
    if finite and power > 0:
        return
    check_aperture(maps[0][0].detach().numpy(), maps[1][0].detach().numpy(), case)
    if not finite:
        raise PropagationError(
            "phase or transmission is too large for its dtype; use float64, or wrap the phase"
        )


def _incoherent(power: float, case: PropagationCase) -> float:
    """Field magnitude at the window centre if all pillars added with random phases.

    √(Σ |t|²) a (d / λ) / r²: a the area of a pillar, r the path of the chief ray.
    """
    distance_waves = case.sensor_distance_um * case.wavenumber / (2 * math.pi)
    return math.sqrt(power) * case.area_um2 * distance_waves / chief_path(case) ** 2
