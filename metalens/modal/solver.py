"""The public solve: polynomial degrees raised until the error estimate meets the
tolerance.
"""

import math
from collections.abc import Sequence

import numpy as np

from metalens import rcwa
from metalens.cell import Cell, Incidence, Polarization, Response, check_tolerance
from metalens.modal.case import ModalCase, case_of
from metalens.modal.engine import MeshSolution, solve_on_mesh
from metalens.modal.mesh import MeshPlan
from metalens.modal.tilted import solve_tilted


def mesh_of_degree(degree: int) -> MeshPlan:
    """Mesh of a polynomial ``degree``, one more along the rim, where the gap between
    wide discs varies.

    From degree 5 on rings narrow geometrically towards the rim: the field is singular
    there, and degree alone gains little.
    """
    rings = (degree - 3) // 2 if degree > 4 else 0
    ends = tuple(GRADING**k for k in range(rings, 0, -1))
    return MeshPlan(degree, degree + 1, ends)


GRADING = 0.15
LEVELS = tuple(mesh_of_degree(degree) for degree in range(2, 8))
SAFETY = 2.0
LARGEST = 2.0  # error of a passive cell


def estimate_level_error(coarser: MeshSolution, finer: MeshSolution) -> float:
    """Error estimate of the ``finer`` of two successive levels: ``SAFETY`` times the
    geometric mean of its change from the ``coarser`` and half the difference of its two
    forms, but at least that half.

    The forms bound smooth waves from opposite sides. An error common to both shows in
    the change, which is the error of the coarser level. Where the forms differ more on
    the finer level, neither is reliable yet: ``LARGEST``.
    """
    change = float(np.abs(finer.matrix - coarser.matrix).max())
    half = finer.half_difference
    if half > coarser.half_difference + coarser.loss:
        return LARGEST
    return max(half, SAFETY * math.sqrt(change * half)) + finer.loss


def resolves_waves(case: ModalCase, plan: MeshPlan) -> bool:
    """Whether k h < 2 p - 1 for the widest elements in and around the disc, where the
    dispersion error of degree p begins to fall (Ainsworth, SIAM J. Numer. Anal. 42,
    553 (2004)).

    Args:
        case: the problem. plan: of the mesh.
    """
    inside = math.sqrt(abs(case.disc)) * plan.core * case.rho
    outside = math.sqrt(abs(case.around)) * (math.sqrt(2) - case.rho)
    return case.k0 * max(inside, outside) < 2 * plan.radial - 1


def solve_level(case: ModalCase, level: int, tolerance: float) -> Response:
    """Response on one level, with the error estimate from the level before.

    Args:
        case: the problem. level: place in ``LEVELS``, 1 or more.
        tolerance: of t and r, for ``converged``.
    """
    coarser, finer = (solve_on_mesh(case, LEVELS[i]) for i in (level - 1, level))
    resolved = resolves_waves(case, LEVELS[level - 1])
    error = estimate_level_error(coarser, finer) if resolved else LARGEST
    met = error <= tolerance
    degree = LEVELS[level].radial
    reason = f"degree {degree}: estimate {'meets' if met else 'above'} the tolerance"
    t, r = complex(finer.matrix[1, 0]), complex(finer.matrix[0, 0])
    return Response(t, r, error, finer.unknowns, finer.energy, "modal", met, reason)


def refine_case(
    case: ModalCase, tolerance: float, levels: Sequence[int] = range(1, len(LEVELS))
) -> Response:
    """Response to a ``case`` of the lowest of the ``levels`` that meets the
    ``tolerance``, else of the level with the least estimate.
    """
    tried = []
    for level in levels:
        tried.append(solve_level(case, level, tolerance))
        if tried[-1].converged:
            break
    return min(tried, key=lambda response: response.t_error)


def solve(
    cell: Cell,
    diameter_um: float,
    wavelength_um: float,
    *,
    angle_rad: float = 0.0,
    azimuth_rad: float = 0.0,
    polarization: Polarization = "x",
    tolerance: float = 1e-3,
) -> Response:
    """Zero-order transmission and reflection of a round pillar by the modal method:
    exact along z, curved finite elements across.

    Pillars with tilted walls: see :mod:`metalens.modal.tilted`.

    Args:
        cell: round pillar on a square lattice, films allowed.
        diameter_um: above 0 and below the pitch.
        wavelength_um: in vacuum.
        angle_rad: of incidence, in vacuum (kx = k0 sin angle), the same in every layer
            by Snell's law.
        azimuth_rad: of the plane of incidence, a multiple of pi/2.
        polarization: "s" or "p", or "x" or "y" for the field along that axis of the
            plane of incidence.
        tolerance: of t and r; the mesh is refined until the estimate meets it.

    Returns:
        Co-polarised amplitudes; ``t_error`` holds for t and r, see
        :func:`estimate_level_error`.

    Raises:
        CellError, MaterialError: see :func:`metalens.modal.case.case_of`.
    """
    check_tolerance(tolerance)
    light = Incidence(
        float(wavelength_um), float(angle_rad), polarization, float(azimuth_rad)
    )
    if cell.round and cell.height_um == 0:
        return rcwa.solve(
            cell,
            diameter_um,
            wavelength_um,
            angle_rad=angle_rad,
            azimuth_rad=azimuth_rad,
            polarization=polarization,
        )
    if cell.round and cell.sidewall_rad:
        return solve_tilted(
            cell,
            float(diameter_um),
            light,
            lambda plain, d, tol: refine_case(case_of(plain, d, light), tol),
            tolerance=tolerance,
        )
    return refine_case(case_of(cell, diameter_um, light), tolerance)
