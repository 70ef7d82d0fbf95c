"""Symmetry: the field of the whole cell from the matrices of its quarter, always real."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.linalg as sl
import scipy.sparse

from metalens.modal.assembly import (
    AssembledDisc,
    CellMatrices,
    assemble_disc,
    gradient_matrix,
)
from metalens.modal.mesh import X0, X1, Y0, Y1, MeshPlan, build_mesh

PHASE_STEP = 0.25  # rad: phases that share a choice of cotree
TYPICAL = 0.5  # pitches: diameter of the disc whose mass weights the choice


@dataclass(frozen=True, eq=False, slots=True)
class FunctionSelection:
    """Which quarter-cell functions carry the unknowns, for the real and the imaginary
    part.

    order: quarter-cell numbers of the functions inside, at x = 0, and at x = pitch / 2.
    inside, start, end: their counts. The unknowns are the real parts inside and at x =
    0, the imaginary parts inside, and the moduli at x = pitch / 2. There the real part
    is ``real`` times the modulus, the imaginary part ``imaginary`` times. Without Bloch
    phase (``real`` = 0) the functions inside are all.
    """

    order: np.ndarray
    inside: int
    start: int
    end: int
    real: float
    imaginary: float

    @property
    def size(self) -> int:
        """Count of the unknowns."""
        return (
            2 * self.inside + self.start + self.end if self.is_periodic else self.inside
        )

    @property
    def is_periodic(self) -> bool:
        """Whether a Bloch phase ties the ends of the cell together."""
        return len(self.order) > self.inside


def select_functions(
    wall: np.ndarray, *, electric: bool, half_phase_rad: float | None
) -> FunctionSelection:
    """Unknowns of a Bloch wave with phase ``2 half_phase_rad`` over a pitch, or with
    electric x walls for None.

    Args:
        wall: bits of each function. electric: whether the y walls are electric.
        half_phase_rad: phase over half a pitch.
    """
    free = (wall & (Y0 | Y1)) == 0 if electric else np.ones(len(wall), bool)
    at_start, at_end = (wall & X0) != 0, (wall & X1) != 0
    inside = np.flatnonzero(free & ~at_start & ~at_end)
    if half_phase_rad is None:
        return FunctionSelection(inside, len(inside), 0, 0, 0.0, 1.0)
    start = np.flatnonzero(free & at_start)
    end = np.flatnonzero(free & at_end)
    order = np.concatenate([inside, start, end])
    return FunctionSelection(
        order,
        len(inside),
        len(start),
        len(end),
        float(np.cos(half_phase_rad)),
        float(np.sin(half_phase_rad)),
    )


def restrict_matrix(
    matrix: np.ndarray, rows: FunctionSelection, columns: FunctionSelection
) -> np.ndarray:
    """Quarter-cell matrix, acting on the real and imaginary parts of the unknowns.

    The blocks are, in order: real parts (inside and x = 0), imaginary parts (inside),
    and moduli at x = pitch / 2 with the cosine and sine of the half phase.

    Args:
        matrix: of the functions. rows, columns: unknowns.
    """
    selected = matrix.take(rows.order, 0).take(columns.order, 1)
    if not rows.is_periodic:
        return selected
    restricted = np.zeros((rows.size, columns.size))
    r, c = rows.inside, columns.inside
    first, second = r + rows.start, c + columns.start
    real_rows, real_columns = slice(first), slice(second)
    imaginary_rows = slice(first, first + r)
    imaginary_columns = slice(second, second + c)
    end_rows, end_columns = slice(first + r, None), slice(second + c, None)
    cos, sin = columns.real, columns.imaginary
    restricted[real_rows, real_columns] = selected[:first, :second]
    restricted[imaginary_rows, imaginary_columns] = selected[:r, :c]
    restricted[end_rows, end_columns] = selected[first:, second:]
    restricted[real_rows, end_columns] = cos * selected[:first, second:]
    restricted[imaginary_rows, end_columns] = sin * selected[:r, second:]
    restricted[end_rows, real_columns] = cos * selected[first:, :second]
    restricted[end_rows, imaginary_columns] = sin * selected[first:, :c]
    return restricted


@dataclass(frozen=True, eq=False, slots=True)
class SymmetryClass:
    """Matrices of one symmetry class, in half pitches; its y walls and its Bloch phase
    over half a pitch.

    cotree: unknowns that with all gradients make a well-conditioned basis (those of the
    edges off a spanning tree).
    transposed: of the gradient, sparse.
    """

    cell: CellMatrices
    disc: CellMatrices
    gradient: np.ndarray
    electric: bool
    half_phase_rad: float | None
    cotree: np.ndarray
    transposed: scipy.sparse.csr_array


@dataclass(frozen=True, eq=False, slots=True)
class ClassTopology:
    """Part of a symmetry class that holds for all diameters.

    vectors, scalars: unknowns. gradient, transposed: as in :class:`SymmetryClass`.
    """

    vectors: FunctionSelection
    scalars: FunctionSelection
    gradient: np.ndarray
    transposed: scipy.sparse.csr_array


@lru_cache(maxsize=32)
def class_topology(
    plan: MeshPlan, electric: bool, half_phase_rad: float | None
) -> ClassTopology:
    """Unknowns and gradient of a symmetry class, which do not depend on the diameter;
    cached.

    Args:
        plan: of the mesh. electric: whether the y walls are electric.
        half_phase_rad: Bloch phase over half a pitch, or None.
    """
    mesh = build_mesh(plan)
    vectors = select_functions(
        mesh.vector_wall, electric=electric, half_phase_rad=half_phase_rad
    )
    scalars = select_functions(
        mesh.scalar_wall, electric=electric, half_phase_rad=half_phase_rad
    )
    dense = restrict_matrix(gradient_matrix(plan), vectors, scalars)
    return ClassTopology(vectors, scalars, dense, scipy.sparse.csr_array(dense.T))


@lru_cache(maxsize=32)
def cotree_functions(
    plan: MeshPlan, electric: bool, half_phase_rad: float | None
) -> np.ndarray:
    """Unknowns off a spanning tree (n - scalars,), ascending.

    By QR with pivoting of the gradients, weighted by the mass of a typical disc; cached
    for a mesh and a phase.

    Args:
        plan: of the mesh. electric: whether the y walls are electric.
        half_phase_rad: Bloch phase over half a pitch, or None.
    """
    topology = class_topology(plan, electric, half_phase_rad)
    weights = np.sqrt(
        np.diag(
            restrict_matrix(
                assemble_disc(TYPICAL, plan).cell.mass,
                topology.vectors,
                topology.vectors,
            )
        )
    )
    pivots = sl.qr((weights[:, None] * topology.gradient).T, mode="r", pivoting=True)[1]
    return np.sort(pivots[topology.scalars.size :])


def build_symmetry_class(
    geometry: AssembledDisc, *, electric: bool, half_phase_rad: float | None
) -> SymmetryClass:
    """Matrices of a symmetry class of one disc.

    Args:
        geometry: assembled disc. electric: whether the y walls are electric, else
            natural.
        half_phase_rad: Bloch phase over half a pitch, or None.
    """
    plan = geometry.mesh.plan
    topology = class_topology(plan, electric, half_phase_rad)
    vectors, scalars = topology.vectors, topology.scalars

    def restrict(quarter: CellMatrices) -> CellMatrices:
        return CellMatrices(
            restrict_matrix(quarter.mass, vectors, vectors),
            restrict_matrix(quarter.curl, vectors, vectors),
            restrict_matrix(quarter.scalar, scalars, scalars),
        )

    typical_phase_rad = half_phase_rad
    if half_phase_rad is not None:
        step = math.floor(half_phase_rad / PHASE_STEP)
        typical_phase_rad = (step + 0.5) * PHASE_STEP
    return SymmetryClass(
        restrict(geometry.cell),
        restrict(geometry.disc),
        topology.gradient,
        electric,
        half_phase_rad,
        cotree_functions(plan, electric, typical_phase_rad),
        topology.transposed,
    )
