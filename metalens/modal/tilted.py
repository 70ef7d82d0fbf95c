"""Round pillars with tilted walls: RCWA corrected to the modal solution.

At one truncation RCWA sees a slightly different width. The shift s(D) with

    t_RCWA(D + s(D)) = t_modal(D),  and likewise r,                             (1)

for upright pillars of every diameter D of the wall corrects the tilted pillar.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from metalens.cell import Cell, Incidence, Response
from metalens.core.arrays import Array
from metalens.rcwa import CellProblem, count_orders, problem_of_light, solve_problem


def solve_tilted(
    cell: Cell,
    diameter_um: float,
    light: Incidence,
    upright: Callable[[Cell, float, float], Response],
    *,
    tolerance: float,
    truncations: Sequence[int] = (4, 5, 6, 7, 8, 9),
    compared: int = 4,
    node_count: int = 4,
    modal_share: float = 0.2,
    unexplained_share: float = 0.5,
) -> Response:
    """Zero-order response of a round pillar with a tilted wall, films allowed.

    Args:
        cell, diameter_um: the pillar, with its diameter at half height.
        light: plane wave.
        upright: modal response of an upright cell and diameter to a tolerance.
        tolerance: of t and r.
        truncations: harmonics, tried until any ``compared`` neighbours agree.
        compared: number of truncations in the mean.
        node_count: diameters between foot and top at which (1) is solved.
        modal_share: of the tolerance, for the modal solves.
        unexplained_share: of the misfit of t after (1) that counts as error.

    Returns:
        Mean of the compared truncations. ``t_error`` is the sum of the largest
        difference from it, the share of the misfit of (1), and the errors of modal
        solves and staircases.

    Raises:
        CellError, MaterialError: as :func:`metalens.rcwa.solve`.
    """
    problem = problem_of_light(cell, diameter_um, light)
    column = problem.columns[0]
    plain = dataclasses.replace(cell, sidewall_rad=0.0, under=(), over=())
    half = abs(math.tan(cell.sidewall_rad)) * cell.height_um
    angles = np.pi * (np.arange(node_count) + 0.5) / node_count
    nodes = diameter_um + half * np.cos(angles)
    modal_tolerance = max(modal_share * tolerance, 2e-6)
    anchors = [upright(plain, d, modal_tolerance) for d in nodes.tolist()]
    modal_amplitudes = np.array([(anchor.t, anchor.r) for anchor in anchors])
    bare = [problem_of_light(plain, d, light) for d in nodes.tolist()]
    results, unexplained = [], []
    for reach in truncations:
        shift, misfit = _fit_shift(bare, nodes, modal_amplitudes, reach)
        shifted = dataclasses.replace(problem, shift=shift)
        truncation = solve_problem(shifted, reach, tolerance)
        results.append((*truncation.both[:, column, column], truncation.energy[column]))
        unexplained.append(misfit)
        if len(results) < compared:
            continue
        last = np.array(results[-compared:])
        t, r, energy = last.mean(axis=0)
        error = float(
            np.abs(last[:, :2] - (t, r)).max()
            + unexplained_share * np.mean(unexplained[-compared:])
            + max(anchor.t_error for anchor in anchors)
            + truncation.wall_error
        )
        if error <= tolerance:
            break
    met = error <= tolerance
    reason = f"orders within {reach}, corrected to the modal solution"
    t_error = min(error, 1 + max(1.0, abs(t), abs(r)))
    return Response(
        complex(t),
        complex(r),
        t_error,
        count_orders(reach),
        float(energy.real),
        "rcwa",
        met,
        reason,
    )


def _fit_shift(
    bare: list[CellProblem],
    nodes: Array,
    modal_amplitudes: Array,
    reach: int,
    *,
    steps: int = 3,
    slope_step_um: float = 1e-4,
    most_um: float = 0.01,
) -> tuple[np.polynomial.Polynomial, float]:
    """Width shift that solves (1) at one truncation, as a polynomial of the diameter,
    and the root-mean-square misfit of t.

    Gauss-Newton on t and r of the upright pillar at each node, with the derivative by a
    finite difference.

    Args:
        bare: upright pillars at the nodes, without films.
        nodes: (k,) diameters, um.
        modal_amplitudes: (k, 2) t and r of the modal solution.
        reach: harmonics.
        steps: of Gauss-Newton. slope_step_um: of width, for the slope of t and r.
        most_um: of a shift.
    """

    def amplitudes(shift: Array) -> Array:
        responses = []
        for problem, width in zip(bare, shift.tolist(), strict=True):
            moved = dataclasses.replace(problem, size_um=problem.size_um + width)
            column = problem.columns[0]
            responses.append(solve_problem(moved, reach).both[:, column, column])
        return np.array(responses)

    shift = np.zeros(len(nodes))
    for _ in range(steps):
        current = amplitudes(shift)
        slope = (amplitudes(shift + slope_step_um) - current) / slope_step_um
        change = (slope.conj() * (modal_amplitudes - current)).sum(axis=1).real
        shift = shift + change / (np.abs(slope) ** 2).sum(axis=1)
        shift = np.clip(shift, -most_um, most_um)
    misfit = np.abs(modal_amplitudes - amplitudes(shift))[:, 0]
    polynomial = np.polynomial.Polynomial.fit(nodes, shift, len(nodes) - 1)
    return polynomial, float(np.sqrt((misfit**2).mean()))
