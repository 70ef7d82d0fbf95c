"""Round pillars with tilted walls: RCWA corrected to the modal solution."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from metalens.cell import Cell, Incidence, Response
from metalens.core.arrays import Array
from metalens.rcwa import (
    CellProblem,
    choose_stage_count,
    problem_of_light,
    solve_problem,
)

REACHES = (4, 5, 6, 7, 8, 9)  # truncations; any four neighbours are compared
COMPARED = 4
NODES = 4  # diameters between foot and top at which (1) is solved
STEPS = 3  # of Gauss-Newton for (1)
STEP_UM = 1e-4
MOST_UM = 0.01  # of a shift
UNEXPLAINED = 0.5  # share of what (1) leaves of t that counts as error
SHARE = 0.2  # of the tolerance, for the modal solves


def solve_tilted(
    cell: Cell,
    diameter_um: float,
    light: Incidence,
    upright: Callable[[Cell, float, float], Response],
    *,
    tolerance: float,
) -> Response:
    """Zero-order response of a round pillar with a tilted wall, films allowed.

    Args:
        cell, diameter_um: the pillar, with its diameter at half height.
        light: plane wave.
        upright: modal response of an upright cell and diameter to a tolerance.
        tolerance: of t and r.

    Returns:
        Mean of four truncations; ``t_error`` is the largest difference from it, half of
        what (1) leaves, the error of the modal solves and that of the collocation.

    Raises:
        CellError, MaterialError: as :func:`metalens.rcwa.solve`.
    """
    problem = problem_of_light(cell, diameter_um, light)
    column = problem.columns[0]
    plain = dataclasses.replace(cell, sidewall_rad=0.0, under=(), over=())
    half = abs(math.tan(cell.sidewall_rad)) * cell.height_um
    nodes = diameter_um + half * np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    anchors = [upright(plain, d, max(SHARE * tolerance, 2e-6)) for d in nodes.tolist()]
    wanted = np.array([(one.t, one.r) for one in anchors])
    bare = [problem_of_light(plain, d, light) for d in nodes.tolist()]
    stages, left = choose_stage_count(
        lambda count: solve_problem(problem, REACHES[0], count).both, tolerance
    )
    found, unexplained = [], []
    for reach in REACHES:
        shift, rest = _fit_shift(bare, nodes, wanted, reach)
        here = dataclasses.replace(problem, shift=shift)
        one = solve_problem(here, reach, stages)
        found.append((*one.both[:, column, column], one.energy[column]))
        unexplained.append(rest)
        if len(found) < COMPARED:
            continue
        last = np.array(found[-COMPARED:])
        t, r, energy = last.mean(axis=0)
        error = float(
            np.abs(last[:, :2] - (t, r)).max()
            + UNEXPLAINED * np.mean(unexplained[-COMPARED:])
            + max(one.t_error for one in anchors)
            + left
        )
        if error <= tolerance:
            break
    met = error <= tolerance
    reason = f"orders within {reach}, corrected to the modal solution"
    m = np.arange(-reach, reach + 1)
    orders = int(np.count_nonzero(np.hypot(m[:, None], m) <= reach))
    bar = min(error, 1 + max(1.0, abs(t), abs(r)))
    return Response(
        complex(t), complex(r), bar, orders, float(energy.real), "rcwa", met, reason
    )


def _fit_shift(
    bare: list[CellProblem], nodes: Array, wanted: Array, reach: int
) -> tuple[np.polynomial.Polynomial, float]:
    """Solution of (1) at one truncation, as a polynomial of the diameter, and the root
    mean square of what it leaves of t.
    """

    def amplitudes(shift: Array) -> Array:
        found = []
        for problem, by in zip(bare, shift.tolist(), strict=True):
            moved = dataclasses.replace(problem, size_um=problem.size_um + by)
            column = problem.columns[0]
            found.append(solve_problem(moved, reach, 0).both[:, column, column])
        return np.array(found)

    shift = np.zeros(len(nodes))
    for _ in range(STEPS):
        here = amplitudes(shift)
        slope = (amplitudes(shift + STEP_UM) - here) / STEP_UM
        move = (slope.conj() * (wanted - here)).sum(axis=1).real
        shift = shift + move / (np.abs(slope) ** 2).sum(axis=1)
        shift = np.clip(shift, -MOST_UM, MOST_UM)
    rest = np.abs(wanted - amplitudes(shift))[:, 0]
    polynomial = np.polynomial.Polynomial.fit(nodes, shift, len(nodes) - 1)
    return polynomial, float(np.sqrt((rest**2).mean()))
