"""PSFs of one direction: windows chosen, sources blurred, cells integrated, depths
taken so many at a time as fit.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.optics import Layers, media
from metalens.propagate import MovingGeometry, PropagationCase
from metalens.psf import extended
from metalens.psf.among import NeighbourJonesFactors
from metalens.psf.budget import Polarisation
from metalens.psf.cells import (
    FINER,
    MOST,
    PixelCells,
    integrate_cells,
    plan_pixel_cells,
)
from metalens.psf.compute import IntensityRequest, IntensityResult, compute_intensity
from metalens.psf.extended import Extent
from metalens.psf.vector import PolarizationMixing, apart_maps

# of the fields of all depths that are computed at once; each share has a plan of its
# own
HELD_BYTES = 2.5e9
# held for each sample and depth, per byte of a number: field, intensity, and what the
# estimate takes
SAMPLE_BYTES = 18
COUNTED = ("scalar", "flux", "vector")
# of the tolerance that the integration over cells may take; the rest is the sums
CELLS = 0.5
STRICTER = (
    4  # settings for sources of finite size, whose estimate takes differences of PSFs
)


@dataclass(frozen=True, slots=True)
class DirectionRequest:
    """What is asked of a direction, as in :func:`metalens.psf.psf_stack`.

    Raises:
        PropagationError: a tolerance that is not above 0 and below 1, a polarisation
            that is none.
    """

    tolerance: float
    polarisation: Polarisation
    integrate: bool
    source: Extent | None
    fields: NeighbourJonesFactors | None = None

    def __post_init__(self) -> None:
        if not 0 < self.tolerance < 1:
            raise PropagationError(
                f"tolerance is {self.tolerance}, need a relative error above 0 and below 1"
            )
        if self.polarisation not in COUNTED:
            raise PropagationError(
                f"polarisation = {self.polarisation!r}: need one of {', '.join(COUNTED)}"
            )


@dataclass(frozen=True, eq=False, slots=True)
class LensMaps:
    """Maps (wavelength, y, x) of one lens, and the cases and weights of the
    wavelengths; with ``mixing`` both
    polarisations of so many maps a wavelength. layers: whose stop lays its shadow on
    the maps."""

    maps: tuple[torch.Tensor, torch.Tensor]
    cases: list[PropagationCase]
    weights: list[float]
    mixing: PolarizationMixing | None
    layers: Layers | None = None

    def at(self, like: PropagationCase) -> list[PropagationCase]:
        """The cases with the direction, depths and window of another."""
        alike = ("tangents", "inverse_depths_per_um", "centre_um", "step_um", "samples")
        return [
            replace(c, **{name: getattr(like, name) for name in alike})
            for c in self.cases
        ]

    def shaded(self, cases: list[PropagationCase]) -> tuple[torch.Tensor, torch.Tensor]:
        """The maps as the light of these cases meets them, each of their first depth."""
        if self.layers is None or self.layers.stop is None:
            return self.maps
        count = 1 if self.mixing is None else self.mixing.maps
        shadow = torch.stack(
            [
                torch.from_numpy(_shadow(case, self.layers))
                for case in cases
                for _ in range(count)
            ]
        )
        return self.maps[0] + shadow.angle().to(self.maps[0]), self.maps[
            1
        ] * shadow.abs().to(self.maps[1])


def _shadow(case: PropagationCase, layers: Layers) -> Array:
    """(y, x) complex amplitude of the light of a case's first depth at each pillar,
    over that without the stop.
    """
    y, x = case.pillars_um
    inverse = case.inverse_depths_per_um[0]
    depth = 1 / inverse if inverse else math.inf
    places = x, y[:, None]
    return layers.shadow(
        case.tangents, depth, case.wavelength_um, places, math.sqrt(case.area_um2)
    )


def compute_direction(
    maps: tuple[torch.Tensor, torch.Tensor],
    cases: list[PropagationCase],
    weights: list[float],
    wanted: DirectionRequest,
    moving: MovingGeometry | None,
    layers: Layers | None = None,
) -> tuple[torch.Tensor, list[IntensityResult], torch.Tensor]:
    """(…, depth, y, x) intensity of every lens, the results it is made of, and (…) the
    sum of squares of what its
    pillars let through the faces behind them.

    maps: (…, wavelength, y, x); cases, weights: of the wavelengths. layers: whose stop
    shades the pillars, alike for
    all depths of the cases.

    Args:
        wanted: what the command asks for.
    """
    if wanted.source is not None and moving is not None:
        raise PropagationError(
            "a source of finite size has no derivatives in the geometry: give numbers, or a point"
        )
    mixing = None
    if wanted.polarisation != "scalar":
        mixing = PolarizationMixing(
            wanted.polarisation == "flux", wanted.fields is not None
        )
        maps = maps if wanted.fields is None else apart_maps(maps, wanted.fields)
    shape = maps[0].shape
    lenses = zip(*(m.reshape(-1, *shape[-3:]) for m in maps), strict=True)
    found = [
        _lens(LensMaps(pair, cases, weights, mixing, layers), wanted, moving)
        for pair in lenses
    ]
    light, results = (
        _stacked([one for one, _ in found]),
        [result for _, result in found],
    )
    power = torch.tensor(
        [result.power for result in results], dtype=torch.float64
    ).view(shape[:-3])
    return light.view(*shape[:-3], *light.shape[1:]), results, power * _passed(cases[0])


def _lens(
    given: LensMaps, wanted: DirectionRequest, moving: MovingGeometry | None
) -> tuple[torch.Tensor, IntensityResult]:
    """(depth, y, x) intensity of one lens, cells as fine as they must be, and its
    result with all errors.
    """
    shortest = min(given.cases, key=lambda case: case.wavelength_um)
    for finer in FINER:
        fine = (
            plan_pixel_cells(shortest, finer)
            if wanted.integrate
            else PixelCells(1, shortest)
        )
        wide = (
            fine.case
            if wanted.source is None
            else extended.widen_case(fine.case, wanted.source)[0]
        )
        if max(wide.samples) > MOST and fine.points > 1:
            raise PropagationError(
                f"cells of {fine.points} points in {wide.samples} samples: give a smaller window"
            )
        lit, results = [], []
        own = (
            wanted
            if fine.points == 1
            else replace(wanted, tolerance=wanted.tolerance * math.sqrt(1 - CELLS**2))
        )
        for some in _few(wide, given, moving):
            light, result = _depths(given, fine, some, own, moving)
            lit.append(light)
            results.append(result)
        result = _together(results)
        if (
            result.sampling <= CELLS * wanted.tolerance
            or max(fine.case.samples) > MOST / 2
        ):
            break
    if fine.points > 1:
        why = f"; light integrated over cells of {fine.points} x {fine.points} points"
        result = replace(result, reason=result.reason + why)
    return lit[0] if len(lit) == 1 else torch.cat(lit), result


def _stacked(parts: list[torch.Tensor]) -> torch.Tensor:
    """As torch.stack, but for a single part, which is not copied."""
    return parts[0].unsqueeze(0) if len(parts) == 1 else torch.stack(parts)


def _few(
    wide: PropagationCase, given: LensMaps, moving: MovingGeometry | None
) -> Iterator[PropagationCase]:
    """The case with as many of its depths as fit in ``HELD_BYTES``; all of them where
    gradients hold them anyway.
    """
    inverse, phase = wide.inverse_depths_per_um, given.maps[0]
    each = wide.samples[0] * wide.samples[1] * SAMPLE_BYTES * phase.element_size()
    step = max(1, int(HELD_BYTES / each))
    if moving is not None or phase.requires_grad or given.maps[1].requires_grad:
        step = len(inverse)
    count = -(-len(inverse) // step)
    for i in range(count):  # even shares
        yield replace(
            wide,
            inverse_depths_per_um=inverse[
                len(inverse) * i // count : len(inverse) * (i + 1) // count
            ],
        )


def _depths(
    given: LensMaps,
    fine: PixelCells,
    some: PropagationCase,
    wanted: DirectionRequest,
    moving: MovingGeometry | None,
) -> tuple[torch.Tensor, IntensityResult]:
    """(depth, y, x) intensity on the window at some depths."""
    if wanted.source is None:
        result = _intensity(given, some, wanted.tolerance, moving)
        light = result.intensity
    else:
        light, result = _blurred(given, fine, some, wanted.source, wanted.tolerance)
    if fine.points > 1:
        light, sampling = integrate_cells(light, fine)
        result = replace(result, sampling=sampling)
    return light, replace(result, intensity=light)


def _intensity(
    given: LensMaps,
    case: PropagationCase,
    tolerance: float,
    moving: MovingGeometry | None,
) -> IntensityResult:
    cases = given.at(case)
    request = IntensityRequest(*given.shaded(cases), cases, given.weights, given.mixing)
    return compute_intensity(request, tolerance=tolerance, moving=moving)


def _blurred(
    given: LensMaps,
    fine: PixelCells,
    some: PropagationCase,
    source: Extent,
    tolerance: float,
) -> tuple[torch.Tensor, IntensityResult]:
    """As :func:`_depths` for a source of finite size, on the samples of the cells."""

    def point(case: PropagationCase) -> IntensityResult:
        return _intensity(given, case, tolerance / STRICTER, None)

    result = point(some)
    more = (
        (some.samples[0] - fine.case.samples[0]) // 2,
        (some.samples[1] - fine.case.samples[1]) // 2,
    )
    light, edge = extended.blur_by_source(result.intensity, some, source, more)
    with torch.no_grad():
        unlike = extended.shift_invariance_error(
            result.intensity, some, source, lambda case: point(case).intensity
        )
    reason = f"{result.reason}; blurred by a {source.shape} source"
    return light, replace(result, source=math.hypot(edge, unlike), reason=reason)


def _together(results: list[IntensityResult]) -> IntensityResult:
    """Of all depths: the largest of every error."""
    first = max(results, key=lambda result: result.error)
    if len(results) == 1:
        return first
    worst = {
        name: max(getattr(result, name) for result in results)
        for name in ("sampling", "source")
    }
    return replace(
        first, **worst, reason=f"{first.reason}; depths in {len(results)} shares"
    )


def _passed(case: PropagationCase) -> float:
    """Power that the faces behind the lens let through along the chief ray."""
    if case.behind is None:
        return 1.0
    steep = 1 + case.tangents[0] ** 2 + case.tangents[1] ** 2
    return float(media.passed_at(case.behind.order, 1 - 1 / steep))
