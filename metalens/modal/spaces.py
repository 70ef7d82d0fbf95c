"""Symmetry: the field of the whole cell from the matrices of its quarter, always real.

Across the y walls the field is even or odd, so one kind of wall suffices (``natural``, or ``electric``: no
tangential component). Across the x walls a Bloch wave exp(i kx x) is neither; but mirroring x and conjugating
leaves the problem unchanged. Fields with that symmetry are complex on the quarter cell, real along x = 0, and
real times exp(i kx pitch / 2) along x = pitch / 2. Their real and imaginary parts are the unknowns: real matrices
of twice the size, also with absorption. At kx = 0 the two parts decouple; the imaginary one has electric x walls,
which is the case of light polarised along x at normal incidence.
"""

from dataclasses import dataclass, replace

import numpy as np

from metalens.modal.assembly import Geometry, Part, integrate
from metalens.modal.mesh import X0, X1, Y0, Y1


@dataclass(frozen=True, eq=False, slots=True)
class Selection:
    """Which quarter-cell functions carry the unknowns, for the real and the imaginary part.

    real, imaginary: quarter-cell numbers. real_at, imaginary_at: the unknown each belongs to. real_weight,
    imaginary_weight: its factor. size: of the unknowns.
    """

    real: np.ndarray
    real_at: np.ndarray
    real_weight: np.ndarray
    imaginary: np.ndarray
    imaginary_at: np.ndarray
    imaginary_weight: np.ndarray
    size: int


def select(wall: np.ndarray, *, electric: bool, half_phase_rad: float | None) -> Selection:
    """Unknowns of a Bloch wave with phase ``2 half_phase_rad`` over a pitch, or with electric x walls for None."""
    free = (wall & (Y0 | Y1)) == 0 if electric else np.ones(len(wall), bool)
    start, end = (wall & X0) != 0, (wall & X1) != 0
    inside = np.flatnonzero(free & ~start & ~end)
    n = len(inside)
    nothing = np.zeros(0, int)
    if half_phase_rad is None:
        return Selection(nothing, nothing, np.zeros(0), inside, np.arange(n), np.ones(n), n)
    start, end = np.flatnonzero(free & start), np.flatnonzero(free & end)
    ns, ne = len(start), len(end)
    size = 2 * n + ns + ne
    ends = np.arange(2 * n + ns, size)
    return Selection(
        np.concatenate([inside, start, end]),
        np.concatenate([np.arange(n + ns), ends]),
        np.concatenate([np.ones(n + ns), np.full(ne, np.cos(half_phase_rad))]),
        np.concatenate([inside, end]),
        np.concatenate([np.arange(n + ns, 2 * n + ns), ends]),
        np.concatenate([np.ones(n), np.full(ne, np.sin(half_phase_rad))]),
        size,
    )


def restrict(matrix: np.ndarray, rows: Selection, columns: Selection) -> np.ndarray:
    """The quarter-cell matrix acting on the real and imaginary parts of the unknowns."""
    out = np.zeros((rows.size, columns.size))
    real = matrix[np.ix_(rows.real, columns.real)] * np.multiply.outer(rows.real_weight, columns.real_weight)
    out[np.ix_(rows.real_at, columns.real_at)] = real
    imaginary = matrix[np.ix_(rows.imaginary, columns.imaginary)]
    imaginary = imaginary * np.multiply.outer(rows.imaginary_weight, columns.imaginary_weight)
    out[np.ix_(rows.imaginary_at, columns.imaginary_at)] += imaginary
    return out


def restrict_rate(matrix: np.ndarray, rows: Selection, columns: Selection) -> np.ndarray:
    """Derivative of ``restrict`` in the half phase, which enters by the weights along x = pitch / 2."""
    moving_rows, moving_columns = weight_rate(rows), weight_rate(columns)
    rate: np.ndarray = restrict(matrix, moving_rows, columns) + restrict(matrix, rows, moving_columns)
    return rate


def weight_rate(selection: Selection) -> Selection:
    """The selection with its weights replaced by their derivatives in the half phase."""
    real, imaginary = np.zeros_like(selection.real_weight), np.zeros_like(selection.imaginary_weight)
    shared = len(set(selection.real_at.tolist()) & set(selection.imaginary_at.tolist()))
    if shared:
        real[-shared:], imaginary[-shared:] = -selection.imaginary_weight[-shared:], selection.real_weight[-shared:]
    return replace(selection, real_weight=real, imaginary_weight=imaginary)


@dataclass(frozen=True, eq=False, slots=True)
class Space:
    """Matrices of one symmetry class, in half pitches; its y walls and its Bloch phase over half a pitch."""

    cell: Part
    disc: Part
    gradient: np.ndarray
    electric: bool
    half_phase_rad: float | None


def space(geometry: Geometry, *, electric: bool, half_phase_rad: float | None) -> Space:
    """The symmetry class with electric or natural y walls, and the given Bloch phase over half a pitch."""
    mesh = geometry.mesh
    vectors = select(mesh.vector_wall, electric=electric, half_phase_rad=half_phase_rad)
    scalars = select(mesh.scalar_wall, electric=electric, half_phase_rad=half_phase_rad)

    def part(p: Part) -> Part:
        return Part(
            restrict(p.mass, vectors, vectors), restrict(p.curl, vectors, vectors), restrict(p.scalar, scalars, scalars)
        )

    gradient = restrict(geometry.gradient, vectors, scalars)
    return Space(part(geometry.cell), part(geometry.disc), gradient, electric, half_phase_rad)


def space_rates(geometry: Geometry, *, electric: bool, half_phase_rad: float | None) -> tuple[Space, Space]:
    """Derivatives of ``space`` in the radius rho and in the half phase (zero without one)."""
    mesh = geometry.mesh
    vectors = select(mesh.vector_wall, electric=electric, half_phase_rad=half_phase_rad)
    scalars = select(mesh.scalar_wall, electric=electric, half_phase_rad=half_phase_rad)

    def by_radius(p: Part) -> Part:
        return Part(
            restrict(p.mass, vectors, vectors), restrict(p.curl, vectors, vectors), restrict(p.scalar, scalars, scalars)
        )

    def by_phase(p: Part) -> Part:
        return Part(
            restrict_rate(p.mass, vectors, vectors),
            restrict_rate(p.curl, vectors, vectors),
            restrict_rate(p.scalar, scalars, scalars),
        )

    cell, disc = integrate(mesh, geometry.rho, rate=True)
    still = np.zeros((vectors.size, scalars.size))
    turned = restrict_rate(geometry.gradient, vectors, scalars)
    return (
        Space(by_radius(cell), by_radius(disc), still, electric, half_phase_rad),
        Space(by_phase(geometry.cell), by_phase(geometry.disc), turned, electric, half_phase_rad),
    )
