"""The public solve: one pillar cell, one wavelength, one angle, with an error estimate."""

import cmath
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from metalens import rcwa
from metalens.cell import Cell, Incidence, Polarization, Response, check_tolerance
from metalens.core.errors import CellError
from metalens.core.threads import one_blas_thread
from metalens.modal.assembly import AssembledDisc, assemble_disc
from metalens.modal.case import MeshSolution, ModalCase, case_of
from metalens.modal.few_modes import few_modes
from metalens.modal.homogeneous import HomogeneousBasis, homogeneous_modes
from metalens.modal.ladder import COMPARED, RUNGS, MeshLevel, first_rung
from metalens.modal.layer import LayerMedium, electric_modes, magnetic_modes
from metalens.modal.match import (
    CARRY,
    HalfSpace,
    ScatteringMatch,
    cutoff_proximity,
    few_scattering,
    half_space,
    scattering_matrix,
    zero_order,
)
from metalens.modal.mesh import MeshPlan
from metalens.modal.pencil import electric_pencil, is_lossless, magnetic_pencil
from metalens.modal.spaces import build_symmetry_class, class_topology
from metalens.modal.tilted import solve_tilted

QUICK = 1e-9  # accuracies above it allow the quick way to the homogeneous modes
QUICK_CAREFUL_RAD = 0.02
# of Bloch phase: below, digits of the nearly uniform gradient are worth a singular
# value problem
CAREFUL_RAD = 0.1
SMALL = 500  # unknowns of a symmetry class: bases of no more are kept for longer
# layer modes, the least decaying, whose wavenumbers the error estimate follows: the
# next move it by 1e-4
MOST = 8


@lru_cache(maxsize=4)
def disc_geometry(rho: float, plan: MeshPlan) -> AssembledDisc:
    """Finite-element matrices of a disc ``rho`` pitches wide on the mesh of a ``plan``,
    cached.
    """
    return assemble_disc(rho, plan)


def homogeneous_basis(
    rho: float, plan: MeshPlan, electric: bool, bloch: float, quick: bool = False
) -> HomogeneousBasis:
    """Homogeneous modes of one symmetry class, cached while only wavelength, height and
    indices change.

    Args:
        rho: diameter over pitch. plan: of the mesh.
        electric: whether the y walls are electric. bloch: half the Bloch phase.
        quick: as in :func:`metalens.modal.homogeneous.homogeneous_modes`.
    """
    small = class_topology(plan, electric, bloch or None).vectors.size <= SMALL
    return (small_cached_basis if small else cached_basis)(
        rho, plan, electric, bloch, quick
    )


@lru_cache(
    maxsize=6
)  # both classes of three diameters: the probes of a curve, for either polarisation
def cached_basis(
    rho: float, plan: MeshPlan, electric: bool, bloch: float, quick: bool
) -> HomogeneousBasis:
    """See :func:`homogeneous_basis`, which has the same ``rho``, ``plan``, ``electric``,
    ``bloch`` and ``quick``.
    """
    symmetry_class = build_symmetry_class(
        disc_geometry(rho, plan), electric=electric, half_phase_rad=bloch or None
    )
    careful = 0 < bloch < (QUICK_CAREFUL_RAD if quick else CAREFUL_RAD)
    return homogeneous_modes(symmetry_class, careful=careful, quick=quick)


small_cached_basis = lru_cache(maxsize=24)(
    cached_basis.__wrapped__
)  # what one polarisation adds to a curve, 5 MB each


def geometric_mean(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """first (first⁻¹ second)^(1/2) of two 2 x 2 matrices: unitary and symmetric where
    both are.

    The arithmetic mean, from which it differs in second order, where ``first`` is
    nearly singular (a black layer)
    or the ratio has no principal root.
    """
    if abs(determinant_2x2(first)) > 1e-3 * np.linalg.norm(first, 2) ** 2:
        ratio = np.linalg.solve(first, second)
        root = cmath.sqrt(determinant_2x2(ratio))
        trace = cmath.sqrt(ratio[0, 0] + ratio[1, 1] + 2 * root)
        if abs(trace) > 0.1:
            mean: np.ndarray = (second + root * first) / trace
            return mean
    arithmetic: np.ndarray = (first + second) / 2
    return arithmetic


def determinant_2x2(matrix: np.ndarray) -> complex:
    """Of a 2 x 2 matrix."""
    (a, b), (c, d) = matrix.tolist()
    return complex(a * d - b * c)


@dataclass(frozen=True, eq=False, slots=True)
class FormSolution:
    """What one form gives: zero-order matrix (2, 2), power out per unit power in, size;
    and of the layer modes that
    travel, by falling axial wavenumber, q (m,) and, for the electric form, the
    derivative of the matrix in each
    (m, 2, 2). grazing: change of the matrix when orders near their cutoff take the
    wavenumbers of the mesh.
    damping: see ``Match``; 1 in cells of lenses, which are not judged by it."""

    matrix: np.ndarray
    energy: float
    unknowns: int
    q: np.ndarray
    by_q: np.ndarray
    grazing: float
    damping: float


def layer_between(
    b: HomogeneousBasis, case: ModalCase, *, magnetic: bool, weak: float
) -> tuple[np.ndarray, Callable[[HalfSpace, HalfSpace], ScatteringMatch], bool]:
    """Axial wavenumbers of the modes that carry light across the layer, and what matches
    them between half-spaces.

    Args:
        b: homogeneous modes. case: the problem. magnetic: the form.
        weak: modes weaker than this over the height end where they start.

    Returns:
        (m,) wavenumbers, the match, and whether it is of the dual unknown. Few modes where
        the layer is without loss and so thick that few carry, else all.
    """
    medium = LayerMedium(case.k0, case.disc, case.around)
    clear = all(complex(e).imag == 0 for e, _ in (*case.under, *case.over))
    if clear and is_lossless(medium):
        pencil = (magnetic_pencil if magnetic else electric_pencil)(b, medium)
        modes = few_modes(pencil, case.height, weak=weak)
        if modes is not None:
            few = modes
            return (
                few.q,
                lambda foot, top: few_scattering(pencil, few, case.height, foot, top),
                magnetic,
            )
    layer = (magnetic_modes if magnetic else electric_modes)(b, medium)
    carry = np.flatnonzero(np.abs(np.exp(1j * layer.q * case.height)) > CARRY)
    return (
        layer.q[carry],
        lambda foot, top: scattering_matrix(layer, case.height, foot, top),
        False,
    )


def solve_form(
    case: ModalCase, plan: MeshPlan, *, magnetic: bool, weak: float = CARRY
) -> FormSolution:
    """Zero-order scattering matrix of one variational form on one mesh.

    Args:
        case: the problem. plan: of the mesh. magnetic: the form.
        weak: as in :func:`solve_on_mesh`.
    """
    # at normal incidence the magnetic form lives in the mirror image (x <-> y) of the
    # electric space
    b = homogeneous_basis(
        case.rho,
        plan,
        case.p == magnetic if case.bloch else False,
        case.bloch,
        weak > QUICK,
    )
    te = case.p == magnetic if case.bloch else True
    q, between, dual = layer_between(b, case, magnetic=magnetic, weak=weak)
    sign = (
        np.array([[-1.0, 1.0], [1.0, -1.0]])
        if magnetic and not dual
        else np.ones((2, 2))
    )

    sides = (case.below, case.under), (case.above, case.over)

    def matched(
        bloch: float | None,
    ) -> tuple[ScatteringMatch, int, list[int], tuple[HalfSpace, HalfSpace]]:
        below, above = (
            half_space(b, case.k0, *side, magnetic=magnetic, bloch=bloch)
            for side in sides
        )
        foot = zero_order(b, below, case.bloch, te=te)
        return (
            between(below, above),
            foot,
            [foot, len(below.ports) + zero_order(b, above, case.bloch, te=te)],
            (below, above),
        )

    match, foot, pair, halves = matched(case.bloch)
    matrix = match.matrix[pair][:, pair] * sign
    plain = [
        half_space(b, case.k0, *side, magnetic=magnetic).admittance for side in sides
    ]
    grazing = 0.0
    if any(
        (half.admittance != other).any()
        for half, other in zip(halves, plain, strict=True)
    ):
        other, _, ports, _ = matched(None)
        grazing = float(np.abs(matrix - other.matrix[ports][:, ports] * sign).max())
    travelling = np.argsort(-(q**2).real, kind="stable")[:MOST]
    moved = np.zeros((len(travelling), len(q)), complex)
    moved[np.arange(len(travelling)), travelling] = (
        1j * case.height * match.travel[travelling]
    )
    moved = moved[:0] if magnetic else moved
    return FormSolution(
        matrix=matrix,
        energy=float((np.abs(match.matrix[:, foot]) ** 2).sum()),
        unknowns=b.size,
        q=q[travelling],
        by_q=match.rate(moved)[:, pair][:, :, pair] * sign,
        grazing=grazing,
        damping=match.damping if case.regime_factor else 1.0,
    )


def solve_on_mesh(
    case: ModalCase, plan: MeshPlan, *, weak: float = CARRY
) -> MeshSolution:
    """Zero-order scattering matrix on one mesh: the mean of the electric and magnetic
    forms, whose errors have opposite tendency.

    Args:
        case: the problem. plan: of the mesh.
        weak: modes weaker than this over the height end at the interface they start from;
            the matrix root of the others is this accurate.

    Returns:
        The mean, and the difference of the forms, split into what the axial wavenumbers
        explain and the rest so that the two cannot cancel.

    Raises:
        CellError: a disc so thin or so wide that the matrices of its elements are singular.
    """
    try:
        # matrices of a few hundred rows: on two threads of BLAS a solve takes three to
        # six times as long
        with (
            one_blas_thread(),
            np.errstate(invalid="ignore"),
        ):  # of degenerate elements: refused below
            first, second = (
                solve_form(case, plan, magnetic=magnetic, weak=weak)
                for magnetic in (False, True)
            )
    except np.linalg.LinAlgError as singular:
        raise CellError(
            f"a diameter of {case.rho:.3g} pitches: the elements that follow the disc degenerate ({singular}); "
            "use metalens.rcwa for this pillar"
        ) from singular
    pairs = nearest_pairs(first.q, second.q)
    explained = (
        first.by_q[pairs[:, 0]]
        * (first.q[pairs[:, 0]] - second.q[pairs[:, 1]])[:, None, None]
    )
    rest = first.matrix - second.matrix - explained.sum(0)
    dense = case.k0**2 * max(case.disc, case.around, key=lambda e: e.real)
    slack = np.abs(dense - first.q**2) / (2 * np.abs(first.q))
    return MeshSolution(
        matrix=geometric_mean(first.matrix, second.matrix),
        waves=float(np.abs(explained).sum(0).max()) / 2,
        rim=float(np.abs(rest).max()) / 2,
        drift=float(
            (np.abs(first.by_q) * slack[:, None, None]).sum(0).max(initial=0.0)
        ),
        energy=(first.energy + second.energy) / 2,
        unknowns=first.unknowns + second.unknowns,
        grazing=max(first.grazing, second.grazing),
        cutoff=max(
            cutoff_proximity(case.k0**2 * e, case.bloch)
            for e in (case.below, case.above)
        ),
        bloch=case.bloch,
        size=math.sqrt(abs(dense)) / math.pi,
        regime_factor=case.regime_factor,
        damping=min(first.damping, second.damping),
    )


def nearest_pairs(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(m, 2) places of values that belong together, nearest pairs first, until one side
    has none left.

    Two layer modes that lie close may come in another order in the other form.
    """
    apart, pairs = np.abs(one[:, None] - other), []
    for _ in range(min(apart.shape)):
        place = np.unravel_index(int(np.argmin(apart)), apart.shape)
        pairs.append(place)
        apart[place[0]], apart[:, place[1]] = np.inf, np.inf
    return np.array(pairs, int).reshape(-1, 2)


@dataclass(frozen=True, eq=False, slots=True)
class RefinementResult:
    """Where the ladder was left: the solution, its rung and error estimate, and why."""

    solution: MeshSolution
    rung: MeshLevel
    error: float
    converged: bool
    reason: str


def refine_mesh(case: ModalCase, tolerance: float) -> RefinementResult:
    """Mesh refinement: the cheapest mesh whose error estimate meets the tolerance.

    Cells outside the calibrated regime (``case.regime_factor``) begin two meshes lower,
    and the change from mesh to mesh counts: at sharp resonances both forms may agree by
    accident.

    Args:
        case: the problem. tolerance: of t and r.
    """
    best: RefinementResult | None = None
    solved: list[MeshSolution] = []
    begin = (
        first_rung(tolerance, case.rho) - COMPARED
        if case.regime_factor
        else first_rung(tolerance, case.rho, case.size)
    )
    last: MeshPlan | None = None
    for rung in RUNGS[max(begin, 0) :]:
        plan = rung.choice(case.rho).plan
        if plan == last:  # of wide discs, for which two rungs have one mesh
            continue
        solution, last = solve_on_mesh(case, plan, weak=rung.weak), plan
        known = not case.regime_factor or len(solved) >= COMPARED
        error = rung.error(solution, case.rho, solved) if known else 1.0
        solved.append(solution)
        if error <= tolerance and known:
            reason = f"the {rung.name} mesh meets the tolerance"
            return RefinementResult(solution, rung, error, True, reason)
        if best is None or error < best.error:
            reason = f"the {rung.name} mesh leaves an estimated error of {error:.1e}, the least of all meshes"
            best = RefinementResult(solution, rung, error, False, reason)
    if best is None:
        raise CellError(f"tolerance = {tolerance}: no mesh to try")
    return best


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
    """Zero-order transmission and reflection of a round pillar by the modal method: exact
    along z, curved finite elements across.

    Pillars with tilted walls: see :mod:`metalens.modal.tilted`.

    Args:
        cell: round pillar on a square lattice, films allowed.
        diameter_um: above 0 and below the pitch.
        wavelength_um: in vacuum.
        angle_rad: of incidence, in vacuum (kx = k0 sin angle), the same in every layer by
            Snell's law.
        azimuth_rad: of the plane of incidence, a multiple of pi/2.
        polarization: "s" or "p", or "x" or "y" for the field along that axis of the plane
            of incidence.
        tolerance: of t and r; the mesh is refined until the estimate meets it.

    Returns:
        Co-polarised amplitudes; ``t_error`` holds for t and r and comes from the difference
        of the electric and magnetic forms.

    Raises:
        CellError, MaterialError: see :func:`metalens.modal.case.case_of`.
    """
    check_tolerance(tolerance)
    light = Incidence(
        float(wavelength_um), float(angle_rad), polarization, float(azimuth_rad)
    )
    direction: dict[str, Any] = {
        "angle_rad": angle_rad,
        "azimuth_rad": azimuth_rad,
        "polarization": polarization,
    }
    if cell.round and cell.height_um == 0:
        return rcwa.solve(cell, diameter_um, wavelength_um, **direction)
    if cell.round and cell.sidewall_rad:
        return solve_tilted(
            cell,
            float(diameter_um),
            light,
            lambda plain, d, tol: solve(
                plain, d, wavelength_um, tolerance=tol, **direction
            ),
            tolerance=tolerance,
        )
    case = case_of(cell, diameter_um, light)
    end = refine_mesh(case, tolerance)
    t, r = complex(end.solution.matrix[1, 0]), complex(end.solution.matrix[0, 0])
    unknowns, energy = end.solution.unknowns, end.solution.energy
    return Response(
        t, r, end.error, unknowns, energy, "modal", end.converged, end.reason
    )
