"""Zero-order scattering matrix of a pillar on one mesh, from two variational forms."""

import cmath
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from metalens.core.errors import CellError
from metalens.core.threads import one_blas_thread
from metalens.modal.case import ModalCase
from metalens.modal.layer import few_modes, is_lossless, layer_modes, layer_pencil
from metalens.modal.match import half_space, scattering_matrix, zero_order
from metalens.modal.mesh import MeshPlan, assemble_disc
from metalens.modal.spaces import HomogeneousBasis, homogeneous_modes


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
