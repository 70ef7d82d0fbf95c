"""The public derivatives of a cell of any shape, each with an estimate of its error."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, check_tolerance
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.rcwa.any_shape import (
    JonesResponse,
    choose_stages,
    estimate_error,
    refine_truncation,
    truncation_sequence,
    without_error,
)
from metalens.rcwa.problem import CellProblem, cell_problem
from metalens.rcwa.rates.parameters import (
    PillarParameter,
    parameter_motion,
    pillar_parameters,
)
from metalens.rcwa.rates.truncated import (
    ParameterMotion,
    TruncatedRates,
    solve_with_rates,
)


@dataclass(frozen=True, eq=False, slots=True)
class ParameterDerivative:
    """Derivative by one number, per um, rad or 1 as its name says.

    t, r: (2, 2) as of :class:`metalens.rcwa.JonesResponse`. error: estimate of the
    largest
    |rate - exact| of both.
    """

    t: Array
    r: Array
    error: float


@dataclass(frozen=True, eq=False, slots=True)
class JonesDerivatives:
    """jones: the value. by: name of a number -> its derivative, see
    :func:`jones_derivatives`.
    """

    jones: JonesResponse
    by: dict[str, ParameterDerivative]


def jones_derivatives(
    cell: Cell,
    size_um: float,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    tolerance: float = 1e-3,
    harmonics: int | None = None,
    by: Iterable[str] | None = None,
) -> JonesDerivatives:
    """The result of :func:`metalens.rcwa.jones` and its derivatives by every number of
    shape, section and material.

    Args:
        by: which numbers, None: all. They are named as in a cell file: size_um,
            height_um (of a pillar without
            layers), sidewall_rad, shape.ratio, shape.angle_rad, shape.corners.2.y (the
            third corner),
            layers.0.height_um (also grow_um, coat_um), under.0.thickness_um,
            over.0.thickness_um, pillar.n, between.n,
            layers.0.material.n (also between.n, coat.n), and grow_um, by which every
            section is wider along every
            pair of edges, whatever its shape. The rest as for ``jones``.

    Accuracy: the exact derivatives of the truncation that ``jones`` gives (1e-9 of the
    largest), with its field of
        normals held: it is sampled, and any gives the same limit. By k: 1j times that
            by n. ``error`` follows from how
        the derivative moves between truncations as ``t_error`` does from t.

    Raises:
        CellError, MaterialError: as ``jones``; a number that the cell does not have, or
            at which it has no derivative
            (the hole of a ring is just closing, a ratio at its end).

    >>> from metalens.cell import Cell, Index
    >>> from metalens.cell.shapes import Rectangle
    >>> cell = Cell(0.4, pillar=Index(2.4), shape=Rectangle(0.6))
    >>> found = jones_derivatives(cell, 0.2, 0.85, harmonics=2, by=["height_um", "shape.angle_rad"])
    >>> bool(abs(found.by["height_um"].t[0, 0]) > 1), bool(abs(found.by["shape.angle_rad"].t[0, 0]) < 1e-9)
    (True, True)
    """
    check_tolerance(tolerance)
    this = cell_problem(cell, size_um, wavelength_um, angle_rad, azimuth_rad)
    wanted = _wanted(pillar_parameters(cell, size_um, wavelength_um), by)
    motions = {one.name: parameter_motion(one, wavelength_um) for one in wanted}
    climb = truncation_sequence(this, harmonics, collocated=bool(cell.sidewall_rad))
    stages, cut = choose_stages(this, climb, tolerance)
    found: list[TruncatedRates] = []

    def at(reach: int) -> JonesResponse:
        found.append(solve_with_rates(this, reach, stages, motions))
        return without_error(this, reach, found[-1].both, found[-1].energy)

    value = refine_truncation(climb, cut, tolerance, at)
    last = climb.reaches[len(found) - 1]
    left = _left_by_collocation(this, motions, stages, climb.reaches[0])
    rates = {}
    for name in motions:
        history = [one.by[name] for one in found]
        error = (
            climb.crowded * estimate_error(history, last, climb.before)
            if len(history) > 1
            else math.inf
        )
        rates[name] = ParameterDerivative(
            history[-1][0], history[-1][1], error + left[name]
        )
    return JonesDerivatives(value, rates)


def _wanted(
    known: dict[str, PillarParameter], by: Iterable[str] | None
) -> list[PillarParameter]:
    names = list(known) if by is None else list(by)
    for name in names:
        if name not in known:
            raise CellError(
                f"no number {name!r} in this cell; it has {', '.join(known)}"
            )
    return [known[name] for name in names]


def _left_by_collocation(
    this: CellProblem, motions: dict[str, ParameterMotion], stages: int, reach: int
) -> dict[str, float]:
    """What one stage more changes at a coarse truncation; 0 for upright walls."""
    if not stages:
        return dict.fromkeys(motions, 0.0)
    few, more = (
        solve_with_rates(this, reach, count, motions).by
        for count in (stages - 1, stages)
    )
    return {name: float(np.abs(more[name] - few[name]).max()) for name in motions}
