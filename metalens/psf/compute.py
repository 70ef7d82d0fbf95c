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
from metalens.propagate import (
    SHARE,
    MethodChoice,
    MovingGeometry,
    NodeLight,
    PropagationCase,
    Pupils,
    check_aperture,
    chief_path,
    choose_method,
    field_exact,
    light_wide,
    light_windowed,
    mix_components,
    paths,
    plan_wide,
    plan_window,
    pupil_error,
    relative_error,
)
from metalens.psf.vector import PolarizationMixing, has_faces, s_and_p

# standard deviation of a pillar's phasor and relative error of three transforms, by
# rounding, several times the machine epsilon of the maps
ROUNDING = {torch.float32: (8e-7, 1e-6), torch.float64: (1e-11, 5e-15)}
EXACT = 4e-12  # rounding of exact sums in float64
FEW = 64  # samples whose rounding has no mean: their pillars are added in float64
TIGHTEST = 1e-12  # setting below which float64 has nothing left to give
MOVING = 1000  # tighter setting: parts of a derivative in the geometry nearly cancel


@dataclass(frozen=True, eq=False, slots=True)
class IntensityResult:
    """Irradiance on a window and its errors, relative L2.

    intensity: (depth, y, x). error: of the sums. reason: method, and why it stopped.
    power: sum of squares of the transmission over the pillars, wavelengths weighted.
    sampling: of the integration over cells. source: of a finite source taken as
    shift-invariant.
    rays: of both polarisations as rays to the window's middle have them; of a scalar
    behind films, of the mean of s and p; nan of a scalar in one medium.
    """

    intensity: torch.Tensor
    error: float
    reason: str
    power: float
    sampling: float = 0.0
    source: float = 0.0
    rays: float = math.nan

    @property
    def whole(self) -> float:
        """All errors together."""
        return math.hypot(self.error, self.sampling, self.source)


@dataclass(frozen=True, eq=False, slots=True)
class IntensityRequest:
    """Maps (wavelength · map, y, x), a case and a weight for each wavelength, and the
    mixing of both polarisations; None for |U|² of one scalar."""

    phase: torch.Tensor
    level: torch.Tensor
    cases: list[PropagationCase]
    weights: list[float]
    mixing: PolarizationMixing | None = None

    def each(
        self,
    ) -> Iterator[
        tuple[tuple[torch.Tensor, torch.Tensor], PropagationCase, float, Pupils | None]
    ]:
        """(maps, case, weight, mixing) of every wavelength."""
        count = 1 if self.mixing is None else self.mixing.maps
        for i, (case, weight) in enumerate(zip(self.cases, self.weights, strict=True)):
            some = slice(i * count, (i + 1) * count)
            pupils = None if self.mixing is None else self.mixing.pupils(case)
            yield (self.phase[some], self.level[some]), case, weight, pupils

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


def compute_intensity(
    request: IntensityRequest, *, tolerance: float, moving: MovingGeometry | None = None
) -> IntensityResult:
    """|U|² on the window, wavelengths added with their weights.

    Pillars are added in the precision of their maps where that holds the tolerance, all
    later sums in float64. The result of the last try is returned with its estimate in
    any case.

    Args:
        request: maps, cases (alike in all but the wavelength), weights and mixing.
        tolerance: relative L2 error of the PSFs.
        moving: geometry with gradients, or None.
    """
    phase, case = request.phase, request.cases[0]
    differentiable = (
        phase.requires_grad or request.level.requires_grad or moving is not None
    )
    rest = math.hypot(torch.finfo(phase.dtype).eps, request.films_error)
    if not differentiable:
        setting = max(tolerance / 2, TIGHTEST)
        choices = [choose_method(one, setting) for one in request.cases]
        if all(choice.method == "exact" for choice in choices):
            return _finished(_exact(request, choices[0].reason), rest, phase.dtype)
    first = phase.dtype if tolerance > 1e-6 else torch.float64
    if math.prod(case.samples) < FEW or moving is not None:
        first = torch.float64
    start = tolerance / 2
    if moving is not None:
        start = tolerance / MOVING
    elif differentiable:  # gradients hold the kernel's error pillar by pillar
        start = max(tolerance / 32, min(tolerance / 8, 1e-6))
    tries = [(start, first), (start / 4, first), (start / 50, torch.float64)]
    for setting, dtype in tries:
        result = _windowed(request, dtype, max(setting, TIGHTEST), moving)
        if math.hypot(result.error, rest) <= tolerance:
            break
    return _finished(result, rest, phase.dtype)


def _finished(
    result: IntensityResult, rest: float, dtype: torch.dtype
) -> IntensityResult:
    """In the precision of the maps, with what rounding and films add to its error."""
    error = math.hypot(result.error, rest)
    return replace(result, intensity=result.intensity.to(dtype), error=error)


def _exact(request: IntensityRequest, reason: str) -> IntensityResult:
    """The exact sum over pillars, of every component of the light."""
    total: Any = 0.0
    power, noise, checked = 0.0, 0.0, []
    for (phase, level), case, weight, pupils in request.each():
        phase, level = phase.double(), level.double()
        powers = (level**2).sum((-1, -2)).tolist()
        power += weight * request.power(case, powers, level)
        turns = case.wavenumber * (chief_path(case) + math.hypot(*case.half_size_um))
        turns += float((phase.abs() * (level != 0)).max())
        rounding = np.finfo(float).eps / 2 * turns
        noise = max(noise, rounding * _incoherent(sum(powers), case))
        if request.own_mixing is not None:
            checked.append(_pillar_light((phase, level), case, weight, pupils))
        for sign, light in mix_components(
            torch.polar(level, phase), pupils, case.pillars_um
        ):
            field = field_exact(torch.angle(light).numpy(), light.abs().numpy(), case)
            total = total + weight * sign * np.abs(field) ** 2
    error = math.hypot(EXACT, _noise_error(total, noise))
    result = IntensityResult(torch.as_tensor(total), error, reason, power)
    return _with_rays(result, request, [checked], [total])


def _noise_error(light: Array, noise: float) -> float:
    """Twice the relative L2 error of PSFs by noise of this size on the field of
    ``light`` (depth, y, x): its part along the field, 2 Re U* n."""
    whole = np.maximum(np.abs(light.sum((1, 2))), 1e-300)
    share, square = light / whole[:, None, None], 2 * noise**2 / whole
    return 2 * math.sqrt(float(square.sum() / (share**2).sum()))


def _pillar_light(
    maps: tuple[torch.Tensor, torch.Tensor],
    case: PropagationCase,
    weight: float,
    pupils: Pupils | None,
) -> NodeLight:
    """Light of all pillars with its carrier taken off, to be checked."""
    y, x = case.pillars_um
    path = paths.from_source(
        case, x, y[:, None], case.tangents, paths.reference_depth(case)
    )
    turn = case.wavenumber * np.asarray(path + paths.to_sensor(case, x, y[:, None]))
    light = torch.polar(maps[1], maps[0] + torch.as_tensor(turn)).numpy()
    at = None if pupils is None else pupils(y, x)
    return NodeLight(case, weight, light, (y, x), 0.0, pupils=at)


def _with_rays(
    result: IntensityResult,
    request: IntensityRequest,
    checked: list[list[NodeLight]],
    light: list[Any],
) -> IntensityResult:
    """With the error of one polarisation mixing for the whole window."""
    own = request.own_mixing
    if own is None:
        return result
    return replace(result, rays=pupil_error(checked, light, own))


def _windowed(
    request: IntensityRequest,
    dtype: torch.dtype,
    tolerance: float,
    moving: MovingGeometry | None,
) -> IntensityResult:
    """One try: every wavelength and part of the window, then the measured error.

    Raises:
        PropagationError: no light in the window.
    """
    choice = choose_method(
        request.cases[0], tolerance, differentiable=True, moving=moving is not None
    )
    is_wide = choice.method == "wide"
    checked: list[list[NodeLight]] = [[] for row in choice.tiles for _ in row]
    seen: list[Any] = [0.0] * len(checked)
    total: Any = 0
    whole_power = 0.0
    for maps, case, weight, pupils in request.each():
        rows, index = [], 0
        for row in _windows(case, choice, tolerance):
            parts = []
            for window in row:
                plan: Any
                if is_wide:
                    plan = plan_wide(window, tolerance, dtype)
                    light, nodes, powers = light_wide(maps, plan, pupils)
                else:
                    plan = plan_window(
                        window,
                        tolerance,
                        dtype,
                        moving is not None,
                        smooth=pupils is not None,
                    )
                    shifted = _shifted(moving, case, window)
                    light, nodes, powers = light_windowed(maps, plan, shifted, pupils)
                _check(maps, case, sum(powers), nodes)
                at_um = plan.judged_um
                at = None if pupils is None else pupils(*at_um)
                rounding = plan.moments.carrier.rounding_rad
                noise = math.hypot(ROUNDING[dtype][0], tolerance / SHARE, rounding)
                noise *= _incoherent(_noisy_power(powers, at), case)
                cut = 1 if is_wide else plan.layout.parts
                checked[index].append(
                    NodeLight(window, weight, nodes, at_um, noise, cut, at)
                )
                parts.append(light if weight == 1 else weight * light)
                seen[index] = seen[index] + parts[-1].detach().numpy()
                index += 1
            rows.append(parts[0] if len(parts) == 1 else torch.cat(parts, -1))
        whole_power += weight * request.power(case, powers, maps[1])
        here = rows[0] if len(rows) == 1 else torch.cat(rows, -2)
        total = here if isinstance(total, int) else total + here
    if not bool((total.detach().sum((-1, -2)) > 0).all()):
        raise PropagationError(
            "no light reaches the window at some depth; move or widen the window"
        )
    error = relative_error(checked, seen)
    if is_wide:
        error = math.hypot(error, ROUNDING[dtype][1])
    result = IntensityResult(total, error, choice.reason, whole_power)
    return _with_rays(result, request, checked, seen)


def _noisy_power(powers: list[float], at: tuple[Array, Array] | None) -> float:
    """Sum of squares of the transmission of all components, each factor at its largest:
    what rounds."""
    if at is None:
        return powers[0]
    return float((np.abs(at[1]).max((2, 3)) ** 2 @ np.array(powers)).sum())


def _windows(
    case: PropagationCase, choice: MethodChoice, tolerance: float
) -> tuple[tuple[PropagationCase, ...], ...]:
    """Parts of the window of a wavelength, cut as at the first wavelength."""
    if choice.method == "wide":
        return ((case,),)
    found = choose_method(case, tolerance, differentiable=True, moving=True).tiles
    if [len(row) for row in found] == [len(row) for row in choice.tiles]:
        return found
    return tuple(
        tuple(replace(w, wavelength_um=case.wavelength_um) for w in row)
        for row in choice.tiles
    )


def _check(
    maps: tuple[torch.Tensor, torch.Tensor],
    case: PropagationCase,
    power: float,
    nodes: Array,
) -> None:
    """Refuse maps that hold nothing or what is not finite, as the sums over all pillars
    tell.

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


def _shifted(
    moving: MovingGeometry | None, case: PropagationCase, tile: PropagationCase
) -> MovingGeometry | None:
    """Moving geometry seen from a tile of the window."""
    if moving is None or tile.centre_um == case.centre_um:
        return moving
    shift = np.subtract(tile.centre_um, case.centre_um)
    return replace(moving, centre=moving.centre + torch.from_numpy(shift))


def _incoherent(power: float, case: PropagationCase) -> float:
    """Magnitude of the field at the window centre if all pillars added with random
    phases.
    """
    near = case.sensor_distance_um * case.wavenumber / (2 * math.pi)
    return math.sqrt(power) * case.area_um2 * near / chief_path(case) ** 2
