"""The public solve: polynomial degrees raised until the error estimate meets the
tolerance.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from metalens import rcwa
from metalens.cell import Cell, Incidence, Polarization, Response, check_tolerance
from metalens.core.errors import CellError
from metalens.core.threads import one_blas_thread
from metalens.modal.case import ModalCase, case_of
from metalens.modal.layer import few_modes, is_lossless, layer_modes, layer_pencil
from metalens.modal.match import half_space, scattering_matrix, zero_order
from metalens.modal.mesh import MeshPlan, assemble_disc
from metalens.modal.spaces import HomogeneousBasis, homogeneous_modes
from metalens.modal.tilted import solve_tilted


@dataclass(frozen=True, eq=False, slots=True)
class MeshSolution:
    """Solution on one mesh.

    matrix: (2, 2) zero-order scattering matrix, the mean of both forms, substrate
    first. half_difference: half of the largest difference of the forms.
    energy: power out per unit power in from the substrate, mean of both forms.
    unknowns: of both forms. loss: what the modes that are left out change at most.
    """

    matrix: np.ndarray
    half_difference: float
    energy: float
    unknowns: int
    loss: float


@lru_cache(maxsize=8)
def homogeneous_basis(
    rho: float, plan: MeshPlan, electric: bool, bloch: float
) -> HomogeneousBasis:
    """Homogeneous modes of one symmetry class, cached while only wavelength, height and
    indices change.

    Args:
        rho: diameter over pitch. plan: of the mesh.
        electric: whether the y walls are electric. bloch: half the Bloch phase.
    """
    return homogeneous_modes(
        assemble_disc(rho, plan), plan, electric=electric, half_phase_rad=bloch or None
    )


def geometric_mean(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """first (first⁻¹ second)^(1/2) of two 2 x 2 matrices: unitary and symmetric where
    both are.

    The arithmetic mean, from which it differs in second order, where ``first`` is
    nearly singular (a black layer)
    or the ratio has no principal root.
    """
    if abs(np.linalg.det(first)) > 1e-3 * np.linalg.norm(first, 2) ** 2:
        ratio = np.linalg.solve(first, second)
        root = cmath.sqrt(np.linalg.det(ratio))
        trace = cmath.sqrt(ratio[0, 0] + ratio[1, 1] + 2 * root)
        if abs(trace) > 0.1:
            mean: np.ndarray = (second + root * first) / trace
            return mean
    arithmetic: np.ndarray = (first + second) / 2
    return arithmetic


def solve_form(
    case: ModalCase, plan: MeshPlan, *, magnetic: bool, loss: float
) -> tuple[np.ndarray, float, int]:
    """Zero-order scattering matrix (2, 2) of one variational form on one mesh, power
    out per unit power in, unknowns.

    Args:
        case: the problem. plan: of the mesh. magnetic: the form.
        loss: as in :func:`solve_on_mesh`.
    """
    # at normal incidence the magnetic form lives in the mirror image (x <-> y) of the
    # electric space
    te = case.p == magnetic if case.bloch else True
    basis = homogeneous_basis(case.rho, plan, te and case.bloch > 0, case.bloch)
    foot, top = (
        half_space(basis, case.k0, *side, magnetic=magnetic, bloch=case.bloch)
        for side in ((case.below, case.under), (case.above, case.over))
    )
    layer = None
    if foot.lossless and top.lossless and is_lossless(case):
        pencil = layer_pencil(basis, case, magnetic=magnetic)
        layer = few_modes(pencil, case.height, weak=loss)
    if layer is None:  # it absorbs, or most modes carry light
        layer = layer_modes(basis, case, magnetic=magnetic)
    all_ports = scattering_matrix(layer, case.height, foot, top)
    first, second = (zero_order(basis, half, case.bloch, te=te) for half in (foot, top))
    zero_ports = [first, len(foot.ports) + second]
    matrix = all_ports[zero_ports][:, zero_ports]
    if magnetic and not layer.dual:
        matrix = matrix * [[-1.0, 1.0], [1.0, -1.0]]
    return matrix, float((np.abs(all_ports[:, first]) ** 2).sum()), basis.size


@lru_cache(maxsize=256)
def solve_on_mesh(case: ModalCase, plan: MeshPlan) -> MeshSolution:
    """Zero-order scattering matrix on one mesh: the mean of the electric and magnetic
    forms, whose errors tend to have opposite signs; cached.

    Layer modes that decay over the height below 1e-7, or 10^-(3 + degree), do not cross
    the layer. This is below the error of a mesh of that degree.

    Args:
        case: the problem. plan: of the mesh.

    Raises:
        CellError: a disc so thin or so wide that the matrices of its elements are
            singular.
    """
    loss = min(1e-7, 10.0 ** -(3 + plan.radial))
    try:
        # matrices of a few hundred rows: on two threads of BLAS a solve takes three to
        # six times as long; degenerate elements, which divide by 0, are refused below
        with one_blas_thread(), np.errstate(invalid="ignore"):
            (first, energy, count), (second, other_energy, other_count) = (
                solve_form(case, plan, magnetic=magnetic, loss=loss)
                for magnetic in (False, True)
            )
    except (np.linalg.LinAlgError, ValueError) as singular:
        raise CellError(
            f"a diameter of {case.rho:.3g} pitches: the elements that follow the disc "
            f"degenerate ({singular}); use metalens.rcwa for this pillar"
        ) from singular
    return MeshSolution(
        geometric_mean(first, second),
        float(np.abs(first - second).max()) / 2,
        (energy + other_energy) / 2,
        count + other_count,
        loss,
    )


def mesh_of_degree(degree: int, grading: float = 0.15) -> MeshPlan:
    """Mesh of a polynomial ``degree``, one more along the rim, where the gap between
    wide discs varies.

    From degree 5 on rings narrow geometrically towards the rim: the field is singular
    there, and degree alone gains little.

    Args:
        degree: across the rim.
        grading: width of a ring over that of the next; 0.15 is the rule of hp elements
            at a singular point (Szabo and Babuska, Finite Element Analysis (1991)).
    """
    rings = (degree - 3) // 2 if degree > 4 else 0
    ends = tuple(grading**k for k in range(rings, 0, -1))
    return MeshPlan(degree, degree + 1, ends)


LEVELS = tuple(mesh_of_degree(degree) for degree in range(2, 8))
LARGEST = 2.0  # error of a passive cell


def estimate_level_error(
    coarser: MeshSolution, finer: MeshSolution, safety: float = 2.0
) -> float:
    """Error estimate of the ``finer`` of two successive levels: ``safety`` times the
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
    return max(half, safety * math.sqrt(change * half)) + finer.loss


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
