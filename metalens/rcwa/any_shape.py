"""Cells of any shape, lattice and layers: the 2 x 2 Jones matrices of transmission and
reflection, with error bars.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from metalens.cell import Cell, Incidence, Response, check_tolerance
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.rcwa import layer as modes
from metalens.rcwa import made, pattern, wall
from metalens.rcwa.conditions import incidence_of
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import Operation
from metalens.rcwa.problem import (
    CellProblem,
    cell_problem,
    symmetry_classes,
    tangential_wave,
    waves_of,
)
from metalens.rcwa.solver import (
    MOST_COMPARED,
    NARROWEST,
    compared_truncations,
    gap_factor,
    largest_error,
    safety_factor,
)
from metalens.rcwa.stack import scatter_zero_order

_FIRST = 3  # orders of the first truncation
_LAST = {4: 15, 2: 10, 1: 9}  # by the number of operations: about a second a solve
_TILTED = {
    4: 10,
    2: 7,
    1: 6,
}  # of tilted walls, whose collocation costs some hundred times as much: some seconds
_COMPARED = 4
SAFETY = 7.0  # the most that :func:`metalens.rcwa.solver.safety_factor` gives
_ROUNDING = 1e-13
_THIN = 1.0  # times more for walls of no width
_COARSE = 3  # orders that suffice to see what the collocation of a tilted wall leaves


@dataclass(frozen=True, eq=False, slots=True)
class JonesResponse:
    """Zero-order response of one cell to both polarisations, power-normalised,
    exp(-iwt), incidence from the substrate.

    basis: ("x", "y") at normal incidence, ("s", "p") else, for an azimuth φ from +x to
    +y: s is a field along
        (-sin φ, cos φ), p one in the plane of incidence whose part along the layers
        lies along (cos φ, sin φ).
    t, r: (2, 2); column: polarisation that comes, row: that leaves. (For r, p is taken
    along the same tangential
        direction as that of the light that comes.)
    t_error: estimate of the largest |t - exact| and |r - exact|, not below the true error.
    energy: (2,) sum of |t|² and |r|² of all propagating orders, for each polarisation that comes: 1 without absorption.
        In a substrate that absorbs, powers of light that comes and that is reflected do
        not add: it may exceed 1.
    orders: harmonics of the finest truncation. converged, reason: whether the tolerance
    is met, and why it ended.
    earlier: (k, 2, 2) t of the up to six truncations before, the first of them again
    where fewer are looked at. A
        number that follows from t has as error bar, like t itself, ``SAFETY`` times its
        farthest change over them.
    """

    basis: tuple[str, str]
    t: Array
    r: Array
    t_error: float
    energy: Array
    orders: int
    converged: bool
    reason: str
    earlier: Array = field(default_factory=lambda: np.empty((0, 2, 2), complex))


def jones(
    cell: Cell,
    size_um: float,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    tolerance: float = 1e-3,
    harmonics: int | None = None,
) -> JonesResponse:
    """Both polarisations of a cell of any shape, at the least number of harmonics that
    meets the tolerance.

    Args:
        size_um: of the shape (what other stages call the diameter).
        angle_rad: of the light outside, in vacuum; azimuth_rad: of the plane of
            incidence, from +x to +y.
        harmonics: fix the largest truncation instead (orders as on a square lattice of
            the same area).

    Accuracy: ``t_error`` is 3 (from 13 orders on) to 7 times the farthest of the four
    truncations before the last (six
        where pillar or gap is narrow), of coarse ones the share that tells of the last,
        and what the collocation of a
        tilted wall leaves. Corners and high contrast
        converge slowly: 1e-2 is usual.

    Raises:
        CellError: pillars that touch or lose their outline, an impossible angle or
            tolerance, no zero order,
            less than one harmonic.
        MaterialError: a wavelength outside the range of a material.
    """
    check_tolerance(tolerance)
    this = cell_problem(cell, size_um, wavelength_um, angle_rad, azimuth_rad)
    climb = truncation_sequence(this, harmonics, collocated=bool(cell.sidewall_rad))
    stages, cut = choose_stages(this, climb, tolerance)
    return refine_truncation(
        climb, cut, tolerance, lambda reach: _truncated(this, reach, stages)
    )


@dataclass(frozen=True, slots=True)
class TruncationSequence:
    """Truncations to try, how many before the last an error looks at, and the factor on
    it for what none resolves.

    Errors swing with each narrow width by itself: gaps, walls of rings, bars of
    crosses, holes, hollows. Walls of
    less than a fiftieth of the pitch are resolved by no truncation; there the factor
    rises to two, for gaps as
    :func:`metalens.rcwa.solver.gap_factor` has it. Of 72 rings and crosses with walls
    of
    0.004 to 0.2 pitches, at 7 to
    15 orders against 21, two of 648 errors lay above a bar that went by outlines alone,
    by up to 2.3 times; now none
    does, nor any of 540 of 60 thinner ones drawn afterwards: at most 0.8 of the bar.

    The first truncation that may be the last one has ``before`` below it, but where few
    are asked for.
    """

    reaches: range
    before: int
    crowded: float


def truncation_sequence(
    this: CellProblem, harmonics: int | None, *, collocated: bool = False
) -> TruncationSequence:
    """Of one cell and light; harmonics: the largest truncation, in place of the one
    that takes about a second
    (or some, of walls that are collocated).

    Raises:
        CellError: less than one harmonic.
    """
    if harmonics is not None and harmonics < 1:
        raise CellError(f"harmonics = {harmonics}: need at least 1")
    cell, size_um = this.cell, this.size_um
    gap = cell.gap_um(size_um)
    within = np.array(cell.outline(size_um).spans_um) / cell.pitch_um
    before = int(
        max(
            compared_truncations(gap / cell.pitch_um),
            *compared_truncations(np.maximum(within, NARROWEST)),
        )
    )
    last = _last(this.classes, collocated) if harmonics is None else harmonics
    first = (
        _FIRST + _COMPARED - before if harmonics is None else max(1, harmonics - before)
    )
    thin = 1 + _THIN * max(0.0, 1 - float(within.min()) / NARROWEST)
    return TruncationSequence(
        range(first, last + 1), before, max(thin, float(gap_factor(gap, cell.pitch_um)))
    )


def refine_truncation(
    climb: TruncationSequence,
    cut: float,
    tolerance: float,
    at: Callable[[int], JonesResponse],
) -> JonesResponse:
    """The result of the least truncation that meets the tolerance, or of the last; cut:
    what its collocation leaves.
    """
    before = climb.before
    history: list[Array] = []
    for reach in climb.reaches:
        found = at(reach)
        history.append(_both(found))
        error = climb.crowded * estimate_error(history, reach, before) + cut
        if len(history) > before and error <= tolerance:
            break
    error = min(error, float(largest_error(np.ravel(history[-1]))))
    met = error <= tolerance
    reason = f"orders within {reach}: estimate {'meets' if met else 'above'} the tolerance {tolerance:.3g}"
    looked_at = [both[0] for both in history[-1 - before : -1]]
    earlier = np.array(looked_at[:1] * (MOST_COMPARED - before) + looked_at).reshape(
        -1, 2, 2
    )
    return dataclasses.replace(
        found, t_error=error, converged=met, reason=reason, earlier=earlier
    )


def choose_stages(
    this: CellProblem, climb: TruncationSequence, tolerance: float
) -> tuple[int, float]:
    """Stages of a tilted wall and what they leave of t; (0, 0) for an upright one."""
    if not this.cell.sidewall_rad:
        return 0, 0.0
    coarse = min(climb.reaches[-1], _COARSE)
    return wall.choose_stage_count(
        lambda count: _both(_truncated(this, coarse, count)), tolerance
    )


def _both(found: JonesResponse) -> Array:
    """(2, 2, 2) t and r."""
    return np.stack([found.t, found.r])


def estimate_error(history: list[Array], reach: int, before: int) -> float:
    """Error of the last truncation: :func:`metalens.rcwa.solver.safety_factor` times
    the
    farthest of those before it, of each
    what it tells of the last (:func:`_told`)."""
    earlier = history[-1 - before : -1][::-1]
    farthest = max(
        (
            _told(reach, reach - k) * float(np.abs(history[-1] - both).max())
            for k, both in enumerate(earlier, 1)
        ),
        default=1.0,
    )
    return safety_factor(reach) * farthest + _ROUNDING


def _told(reach: int, earlier: int) -> float:
    """Share of the distance to an earlier truncation that may be left at this one, 1 at
    most.

    Errors e fall at least as reach^-2, so |t_n - t_m| = e_m - e_n leaves e_n = |t_n - t_m| m² / (n² - m²): of the way
    from three orders to seven, 0.23. From 14 orders on all of the four before count
    whole.
    """
    return min(1.0, earlier**2 / (reach**2 - earlier**2))


def co_polarised(
    cell: Cell,
    size_um: float,
    light: Incidence,
    *,
    tolerance: float,
    harmonics: int | None,
) -> Response:
    """One diagonal element of :func:`jones`; the same arguments and refusals."""
    place = (
        ("x", "y").index(light.polarization)
        if light.polarization in ("x", "y")
        else None
    )
    if light.angle_rad:
        place = ("s", "p").index(incidence_of(light)[-1])
    elif place is None:  # p lies in the plane of incidence that the azimuth names
        turned = round(light.azimuth_rad / (math.pi / 2)) % 2
        place = turned if light.polarization == "p" else 1 - turned
    about = {"angle_rad": light.angle_rad, "azimuth_rad": light.azimuth_rad}
    found = jones(
        cell,
        size_um,
        light.wavelength_um,
        **about,
        tolerance=tolerance,
        harmonics=harmonics,
    )
    t, r, energy = (
        complex(found.t[place, place]),
        complex(found.r[place, place]),
        float(found.energy[place]),
    )
    return Response(
        t, r, found.t_error, found.orders, energy, "rcwa", found.converged, found.reason
    )


def most_harmonics(
    cell: Cell, size_um: float, *, angle_rad: float = 0.0, azimuth_rad: float = 0.0
) -> int:
    """Largest truncation that :func:`jones` takes by itself: less without mirrors, and
    where walls are tilted.
    """
    return _last(
        symmetry_classes(cell, size_um, tangential_wave(1.0, angle_rad, azimuth_rad)),
        bool(cell.sidewall_rad),
    )


def _last(found: tuple[tuple[Operation, ...], ...], collocated: bool) -> int:
    """Largest truncation for the sets of operations of a cell."""
    return (_TILTED if collocated else _LAST)[
        min(len(operations) for operations in found)
    ]


def _truncated(this: CellProblem, reach: int, stages: int) -> JonesResponse:
    """All polarisations at one truncation; stages: of the collocation of a tilted wall,
    0 for an upright one.
    """
    cell, size_um, light = this.cell, this.size_um, this.light
    t, r, energy = np.zeros((2, 2), complex), np.zeros((2, 2), complex), np.zeros(2)
    for operations in this.classes:
        space = mirrors.reduced_orders(reach, pattern.lattice_frame(cell, operations))
        ways, places = waves_of(space, cell, light)
        operators = functools.partial(pattern.section_operators, space, ways, cell=cell)
        walls = made.section_walls(cell, size_um, light.wavelength_um, operators)
        media, layers, between = this.media, [], None
        if stages:
            between = functools.partial(wall.match_walls, walls, stages=stages)
        else:
            symmetric = cell.outline(size_um).keeps(-1, -1)
            layers = [
                modes.solve_eigenmodes(*part.sample(0.5), symmetric=symmetric)
                for part in walls
            ]
            media = dataclasses.replace(
                media, heights=tuple(part.reduced_height for part in walls)
            )
        for column, come in places.items():
            found = scatter_zero_order(ways, media, layers, come[0], between=between)
            energy[column] = float(
                (np.abs(found.t) ** 2).sum() + (np.abs(found.r) ** 2).sum()
            )
            for row, leave in places.items():
                sign = come[1] * leave[1]
                t[row, column], r[row, column] = (
                    sign * found.t[leave[0]],
                    sign * found.r[leave[0]],
                )
    return without_error(this, reach, np.stack([t, r]), energy)


def without_error(
    this: CellProblem, reach: int, both: Array, energy: Array
) -> JonesResponse:
    """One truncation as a record, before its error is known."""
    names = ("x", "y") if this.light.normal else ("s", "p")
    count = int(
        np.count_nonzero(
            np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= reach
        )
    )
    return JonesResponse(names, both[0], both[1], math.inf, energy, count, False, "")
