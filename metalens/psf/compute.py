"""Intensity of one lens in one direction, by the cheapest method, checked and repeated
until the tolerance is met.
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
    ErrorSample,
    MethodChoice,
    MovingGeometry,
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

FEW = 64  # samples below which a window is summed in float64: its rounding has no mean
# times the light of random phases below which float32 loses what is left of the sum
BRIGHT = 30.0
MOVING = 1000  # by which the setting is tighter where the geometry carries gradients
FINEST = 1e-12  # setting below which float64 has nothing left to give
ROUNDING = {
    torch.float32: 8e-7,
    torch.float64: 1e-11,
}  # of a pillar's phasor, standard deviation
TRANSFORMS = {
    torch.float32: 1e-6,
    torch.float64: 5e-15,
}  # rounding of three transforms, above all that was found
MANY = 8192  # samples of a window from which an estimate looks at few of them
# of the setting of such a window: what rare errors those few may miss (0.002 and less
# were seen)
MISSED = 0.02
# times its estimate: errors beside a spot and where the window is dim are seen by few
# of the few
SCATTER = 1.5
EXACT = {
    torch.float32: 1e-7,
    torch.float64: 4e-12,
}  # rounding of exact sums and of what they are kept in
HALF_DIGIT, SPREAD = (
    1.1e-16,
    2.0,
)  # rounding of a number in float64; sums of few pillars vary about their mean noise
OUTPUT = {
    torch.float32: 4e-7,
    torch.float64: 2e-15,
}  # of the sums behind the pillars, in relative L2
KEPT = {
    torch.float32: 1.5e-7,
    torch.float64: 0.0,
}  # of intensities brought back to the caller's type and normalised in it


@dataclass(frozen=True, eq=False, slots=True)
class IntensityResult:
    """intensity: (depth, y, x); error: estimated relative L2 error; reason: method, and
    why it stopped.

    power: sum of squares of the transmission over the pillars, wavelengths weighted.
    brightness: mean of the window at
        the darkest depth, against pillars of random phases. sampling: error of an
        integration over cells. source: of a
        source of finite size taken as alike. rays: of both polarisations as rays to the
        window's middle have them; of a
        scalar behind films, of the mean of s and p that it takes; nan of a scalar in
        one medium.
    """

    intensity: torch.Tensor
    error: float
    reason: str
    power: float
    brightness: float = math.inf
    sampling: float = 0.0
    source: float = 0.0
    rays: float = math.nan

    @property
    def whole(self) -> float:
        """All errors together."""
        return math.hypot(self.error, self.sampling, self.source)


def compute_intensity(
    phase: torch.Tensor,
    level: torch.Tensor,
    cases: list[PropagationCase],
    weights: list[float],
    *,
    tolerance: float,
    moving: Any = None,
    mixing: PolarizationMixing | None = None,
) -> IntensityResult:
    """|U|² on the window, wavelengths added with their weights.

    Args:
        phase, level: (wavelength, y, x), or with ``mixing`` as many maps of a
            wavelength after each other as it takes.
        cases: one a wavelength, alike in everything else.
        moving: :class:`Moving` or None. mixing: both polarisations in place of |U|² of
            one scalar.

    The windowed method is repeated at a tighter setting, and at last in float64, until
    its own error estimate is within
    tolerance, all that is added to it later included; the result of the last try is
    returned with its estimate in any
    case. Dim and tiny windows are summed in float64, since the estimate knows rounding
    as noise of a mean size only.
    """
    lit = IntensityRequest(phase, level, cases, weights, mixing)
    needs_grad = phase.requires_grad or level.requires_grad or moving is not None
    if (
        not needs_grad and phase.device.type == "cpu"
    ):  # at the setting that the windowed method begins with
        choices = [choose_method(case, max(tolerance / 2, FINEST)) for case in cases]
        if all(choice.method == "exact" for choice in choices):
            return _exact(lit, choices[0].reason)
    first = phase.dtype if tolerance >= 2 * OUTPUT[phase.dtype] else torch.float64
    if cases[0].samples[0] * cases[0].samples[1] < FEW:
        first = torch.float64
    # gradients see the kernel's error pillar by pillar, and at a focus their parts
    # nearly cancel
    start = (
        max(tolerance / 32, min(tolerance / 8, 1e-6)) if needs_grad else tolerance / 2
    )
    if (
        moving is not None
    ):  # parts of a derivative in the geometry exceed it some hundred times
        start, first = tolerance / MOVING, torch.float64
    tries = [(start, first), (start / 4, first), (start / 50, torch.float64)]
    dim = False
    for setting, kind in tries:
        dtype = torch.float64 if dim else kind
        result = _windowed(lit, dtype, max(setting, FINEST), moving)
        error = math.hypot(result.error, OUTPUT[dtype], KEPT[phase.dtype], lit.films)
        dim = dtype != torch.float64 and result.brightness < BRIGHT
        if error <= tolerance and not dim:
            break
    return IntensityResult(
        result.intensity.to(phase.dtype),
        error,
        result.reason,
        result.power,
        rays=result.rays,
    )


@dataclass(frozen=True, eq=False, slots=True)
class IntensityRequest:
    """What :func:`compute_intensity` is asked of."""

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
        """(maps of one, case, weight, components) of every wavelength."""
        count = 1 if self.mixing is None else self.mixing.maps
        for i, (case, weight) in enumerate(zip(self.cases, self.weights, strict=True)):
            some = slice(i * count, (i + 1) * count)
            pupils = None if self.mixing is None else self.mixing.pupils(case)
            yield (self.phase[some], self.level[some]), case, weight, pupils

    @property
    def films(self) -> float:
        """Relative L2 error of what is left out behind films, the worst over
        wavelengths.
        """
        if self.cases[0].behind is None:
            return 0.0
        each = [
            (case, maps[1].detach()[0].cpu().numpy())
            for maps, case, _, _ in self.each()
        ]
        return max(paths.films_error(case, level) for case, level in each)

    @property
    def judged(self) -> Callable[[PropagationCase], Pupils] | None:
        """Factors on the light of single points that it is compared with: of both
        polarisations by their own rays, or
        of s and p apart where a scalar meets faces of films."""
        if self.mixing is not None:
            return self.mixing.pupils
        return s_and_p if has_faces(self.cases[0]) else None

    def power(
        self, case: PropagationCase, powers: list[float], level: torch.Tensor
    ) -> float:
        """What the pillars of a wavelength let through, from the sums of squares of its
        maps.
        """
        return (
            powers[0] if self.mixing is None else self.mixing.power(case, powers, level)
        )


def _exact(lit: IntensityRequest, reason: str) -> IntensityResult:
    total: Any = 0.0
    power, noise, samples = 0.0, 0.0, []
    for (phase, level), case, weight, pupils in lit.each():
        powers = (level.double() ** 2).sum((-1, -2)).tolist()
        power += weight * lit.power(case, powers, level)
        noise = max(noise, _turned(phase, level, case) * _incoherent(sum(powers), case))
        if lit.judged is not None:
            samples.append(_of_pillars((phase, level), case, weight, pupils))
        if pupils is None:
            total = (
                total
                + weight
                * np.abs(field_exact(phase[0].numpy(), level[0].numpy(), case)) ** 2
            )
            continue
        for sign, light in mix_components(
            torch.polar(level.double(), phase.double()), pupils, case.pillars_um
        ):
            field = field_exact(torch.angle(light).numpy(), light.abs().numpy(), case)
            total = total + weight * sign * np.abs(field) ** 2
    error = math.hypot(EXACT[lit.phase.dtype], lit.films, _noisy_sum(total, noise))
    found = IntensityResult(
        torch.as_tensor(total).to(lit.phase.dtype), error, reason, power
    )
    return _from_middle(found, lit, [samples], [total])


def _turned(phase: torch.Tensor, level: torch.Tensor, case: PropagationCase) -> float:
    """Rounding of a pillar's phase in float64, rad: of the paths to it and on to the
    window, and of its own phase.
    """
    turns = case.wavenumber * (chief_path(case) + math.hypot(*case.half_size_um))
    return HALF_DIGIT * (turns + float((phase.double().abs() * (level != 0)).max()))


def _noisy_sum(light: Array, noise: float) -> float:
    """Relative L2 error of PSFs from light (depth, y, x) to whose field noise of this
    size is added: its part along the
    field, 2 Re U* n. Nothing at a focus, where noise is of N pillars and light of N²,
    and most beside the light."""
    whole = np.maximum(np.abs(light.sum((1, 2))), 1e-300)
    share, square = light / whole[:, None, None], 2 * noise**2 / whole
    return float(SPREAD * math.sqrt(square.sum() / (share**2).sum()))


def _of_pillars(
    maps: tuple[torch.Tensor, torch.Tensor],
    case: PropagationCase,
    weight: float,
    pupils: Pupils | None,
) -> ErrorSample:
    """What a sum over all pillars took of a wavelength, to be judged."""
    y, x = case.pillars_um
    path = paths.from_source(
        case, x, y[:, None], case.tangents, paths.reference_depth(case)
    )
    turn = case.wavenumber * np.asarray(path + paths.to_sensor(case, x, y[:, None]))
    light = torch.polar(
        maps[1].double(), maps[0].double() + torch.as_tensor(turn)
    ).numpy()
    return ErrorSample(
        case, weight, light, 0.0, 1, (y, x), None if pupils is None else pupils(y, x)
    )


def _from_middle(
    result: IntensityResult,
    lit: IntensityRequest,
    samples: list[list[ErrorSample]],
    seen: list[Any],
) -> IntensityResult:
    """With what rays to the window's middle leave out of both polarisations; of a
    scalar behind films, what it does.
    """
    return (
        result
        if lit.judged is None
        else replace(result, rays=pupil_error(samples, seen, lit.judged))
    )


def _windowed(
    lit: IntensityRequest, dtype: torch.dtype, tolerance: float, moving: Any
) -> IntensityResult:
    """One try with sums of a dtype: every wavelength and window, then the estimate from
    all of them.
    """
    choice = choose_method(
        lit.cases[0], tolerance, differentiable=True, moving=moving is not None
    )
    if choice.method == "wide":
        return _wide(lit, dtype, tolerance, choice)
    samples: list[list[ErrorSample]] = [[] for row in choice.tiles for _ in row]
    seen: list[Any] = [0.0] * len(samples)
    total: Any = 0
    given = 0.0
    for maps, case, weight, pupils in lit.each():
        rows, index = [], 0
        for row in _windows(case, choice, tolerance):
            parts = []
            for window in row:
                made = plan_window(
                    window,
                    tolerance,
                    dtype,
                    maps[0].device,
                    moving is not None,
                    smooth=pupils is not None,
                )
                light, gathered, powers = light_windowed(
                    maps, made, _shifted(moving, case, window), pupils
                )
                _check(maps, case, sum(powers), gathered)
                power = lit.power(case, powers, maps[1])
                at = None if pupils is None else pupils(*made.judged_um)
                noise = _phasor(dtype, tolerance, made) * _incoherent(
                    _noisy(powers, at), case
                )
                moments = gathered.cpu().numpy().astype(complex)
                samples[index].append(
                    ErrorSample(
                        window, weight, moments, noise, made.layout.parts, pupils=at
                    )
                )
                here = weight * light
                parts.append(here)
                seen[index] = seen[index] + here.detach().cpu().numpy()
                index += 1
            rows.append(torch.cat(parts, -1))
        given += weight * power
        total = total + torch.cat(rows, -2)
    result = _judged(total, samples, seen, (lit.cases, lit.weights, given), choice)
    result = _from_middle(result, lit, samples, seen)
    return (
        _few_seen(result, tolerance) if math.prod(total.shape[-2:]) > MANY else result
    )


def _phasor(dtype: torch.dtype, tolerance: float, made: Any) -> float:
    """Standard deviation of a pillar's phasor: arithmetic, interpolation inside blocks,
    polynomials of long paths.
    """
    return math.hypot(
        ROUNDING[dtype], tolerance / SHARE, made.moments.carrier.rounding_rad
    )


def _noisy(powers: list[float], at: Any) -> float:
    """Sum of squares of the transmission of all components, each factor as large as it
    gets: what rounds.
    """
    if at is None:
        return powers[0]
    return float((np.abs(at[1]).max((2, 3)) ** 2 @ np.array(powers)).sum())


def _wide(
    lit: IntensityRequest, dtype: torch.dtype, tolerance: float, choice: MethodChoice
) -> IntensityResult:
    """One try of a wide window by Fourier transforms, as :func:`_windowed`."""
    total: Any = None
    power, samples = 0.0, []
    for maps, case, weight, pupils in lit.each():
        made = plan_wide(case, tolerance, dtype, maps[0].device)
        light, gathered, powers = light_wide(maps, made, pupils)
        _check(maps, case, sum(powers), gathered)
        at = None if pupils is None else pupils(*made.nodes_um)
        noise = _phasor(dtype, tolerance, made) * _incoherent(_noisy(powers, at), case)
        given = gathered.cpu().numpy().astype(complex)
        samples.append(ErrorSample(case, weight, given, noise, 1, made.nodes_um, at))
        light = light if weight == 1 else light * weight
        total = light if total is None else total + light
        power += weight * lit.power(case, powers, maps[1])
    seen = [total.detach().cpu().numpy()]
    result = _judged(total, [samples], seen, (lit.cases, lit.weights, power), choice)
    result = _few_seen(_from_middle(result, lit, [samples], seen), tolerance)
    return replace(result, error=math.hypot(result.error, TRANSFORMS[dtype]))


def _few_seen(result: IntensityResult, tolerance: float) -> IntensityResult:
    """With what an estimate from few of many samples may miss."""
    return replace(result, error=math.hypot(SCATTER * result.error, MISSED * tolerance))


def _judged(
    total: torch.Tensor,
    samples: list[list[ErrorSample]],
    seen: list[Any],
    given: tuple[list[PropagationCase], list[float], float],
    choice: MethodChoice,
) -> IntensityResult:
    """The result of a try with its estimate; seen: intensity of each part of the
    window; given: cases, weights, sum of
    squares of the transmission.

    Raises:
        PropagationError: no light in the window.
    """
    cases, weights, light = given
    if not bool((total.detach().sum((-1, -2)) > 0).all()):
        raise PropagationError(
            "no light reaches the window at some depth; move or widen the window"
        )
    seen_light = total.detach().flatten(-2)
    if (
        choice.method == "wide"
    ):  # of the light itself: what is dim about it weighs as little in the error
        lit = torch.stack([(row @ row) / row.sum() for row in seen_light]).min()
    else:
        lit = seen_light.mean(-1).min()
    brightness = float(lit) / sum(
        weight * _incoherent(1.0, case) ** 2
        for case, weight in zip(cases, weights, strict=True)
    )
    error, brightness = relative_error(samples, seen), brightness / max(light, 1e-300)
    return IntensityResult(total, error, choice.reason, light, brightness=brightness)


def _windows(
    case: PropagationCase, choice: MethodChoice, tolerance: float
) -> tuple[tuple[PropagationCase, ...], ...]:
    """Windows of a wavelength that are computed apart: cut as at the first wavelength."""
    found = choose_method(case, tolerance, differentiable=True).tiles
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
    moments: torch.Tensor,
) -> None:
    """Refuse maps that hold nothing or what is not finite, as the sums over all pillars
    tell.

    Raises:
        PropagationError: naming row and column.
    """
    if (
        power > 0
        and math.isfinite(power)
        and bool(torch.isfinite(torch.view_as_real(moments)).all())
    ):
        return
    check_aperture(
        maps[0][0].detach().cpu().numpy(), maps[1][0].detach().cpu().numpy(), case
    )
    if not (
        math.isfinite(power) and bool(torch.isfinite(torch.view_as_real(moments)).all())
    ):
        raise PropagationError(
            "phase or transmission is too large for its dtype; use float64, or wrap the phase"
        )


def _shifted(
    moving: MovingGeometry | None, case: PropagationCase, tile: PropagationCase
) -> MovingGeometry | None:
    """Moving geometry seen from a tile of the window."""
    if moving is None or tile.centre_um == case.centre_um:
        return moving
    shift = [a - b for a, b in zip(tile.centre_um, case.centre_um, strict=True)]
    return replace(
        moving,
        centre=moving.centre
        + torch.tensor(shift, dtype=torch.float64, device=moving.centre.device),
    )


def _incoherent(power: float, case: PropagationCase) -> float:
    """Magnitude of the field at the window centre if all pillars added with random
    phases.
    """
    area = (
        case.area_um2
        * case.sensor_distance_um
        * case.wavenumber
        / (2 * math.pi * chief_path(case) ** 2)
    )
    return math.sqrt(power) * area
