"""The quarter cell as curvilinear quadrilaterals that follow the disc, and its
finite-element matrices with every wall natural.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from metalens.modal.shapes import (
    IntervalBasis,
    SquareBasis,
    interval_basis,
    square_basis,
)

# walls of the quarter cell, as bits: x = 0, x = 1, y = 0, y = 1
X0, X1, Y0, Y1 = 1, 2, 4, 8
# of vertices at the centre, on the x axis (a), on the y axis (b) and on the diagonal;
# and in addition at the edge of the cell
WALLS = {"centre": X0 | Y0, "a": Y0, "b": X0, "diagonal": 0}
EDGE_WALLS = {"a": X1, "b": Y1, "diagonal": X1 | Y1}


@dataclass(frozen=True, slots=True)
class MeshPlan:
    """What fixes the topology and the basis of a mesh (everything but the diameter).

    radial, angular: polynomial degree across and along the rim.
    rings: ends of the rings around the disc but the last, as fractions of the way from
        the circle to the edge of the cell, rising; inside likewise, to the core.
    exponents: of the rim bubbles.
    core: half width of the core over the radius of the disc.
    """

    radial: int
    angular: int
    rings: tuple[float, ...] = ()
    exponents: tuple[float, ...] = (0.7, 1.3)
    core: float = 0.6


Vertex = tuple[str, int]  # place, ring from the core


@dataclass(frozen=True, eq=False, slots=True)
class MeshElement:
    """The core of the disc (ring -1), or one ring with its mirror image.

    start, end: of the ring, as fractions of the way from its inner to its outer curve.
    vector, scalar: (copies, functions) global numbers of the functions.
    """

    basis: SquareBasis
    inside: bool
    ring: int
    start: float
    end: float
    radial: IntervalBasis
    angular: IntervalBasis
    vector: np.ndarray
    scalar: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class DiscMesh:
    """Elements, and the wall bits of each function: ``vector_wall``, ``scalar_wall``."""

    plan: MeshPlan
    elements: tuple[MeshElement, ...]
    vector_wall: np.ndarray
    scalar_wall: np.ndarray


class FunctionNumbering:
    """Hands out global numbers for functions on vertices, edges and interiors, each
    with the walls it lies on.
    """

    def __init__(self, rings: int) -> None:
        self.rings = rings
        self.vectors: dict[object, tuple[int, int]] = {}
        self.scalars: dict[object, tuple[int, int]] = {}

    def wall_bits(self, vertex: Vertex) -> int:
        """Walls of the quarter cell that a vertex lies on, as bits."""
        place, ring = vertex
        return WALLS[place] | (EDGE_WALLS[place] if ring == self.rings else 0)

    def number_element(
        self, v: tuple[Vertex, ...], px: int, py: int
    ) -> tuple[list[int], list[int]]:
        """Global numbers of the vector and scalar functions of one element.

        A function belongs to the corner, edge or interior on which it does not vanish,
        and is shared by the elements there.

        Args:
            v: corners v00, v10, v01, v11.
            px, py: polynomial degrees along both parameters.
        """

        def number(
            table: dict[object, tuple[int, int]],
            xs: tuple[int, ...],
            ys: tuple[int, ...],
            *orders: object,
        ) -> int:
            corners = tuple(v[x + 2 * y] for y in ys for x in xs)
            wall = X0 | X1 | Y0 | Y1
            for corner in corners:
                wall &= self.wall_bits(corner)
            return table.setdefault((corners, orders), (len(table), wall))[0]

        def ends(order: int) -> tuple[int, ...]:
            return (order,) if order < 2 else (0, 1)

        vectors = [
            number(self.vectors, (0, 1), ends(j), i, *(("x", j) if j > 1 else ()))
            for i in range(px)
            for j in range(py + 1)
        ] + [
            number(self.vectors, ends(i), (0, 1), j, *(("y", i) if i > 1 else ()))
            for i in range(px + 1)
            for j in range(py)
        ]
        scalars = [
            number(self.scalars, ends(i), ends(j), *(k for k in (i, j) if k > 1))
            for i in range(px + 1)
            for j in range(py + 1)
        ]
        return vectors, scalars


@lru_cache(maxsize=32)
def build_mesh(plan: MeshPlan) -> DiscMesh:
    """Elements of a mesh plan from the centre: core, rings of the disc, rings around
    it; cached, as they do not depend on the diameter.

    The rings at the rim have singular functions and a graded rule.
    """
    count = len(plan.rings) + 1
    outer = (0.0, *plan.rings, 1.0)
    fractions = [*(1 - end for end in reversed(outer)), *outer[1:]]
    numbers = FunctionNumbering(2 * count)
    line = interval_basis(plan.angular, plan.angular + 4)
    corners = (("centre", 0), ("a", 0), ("b", 0), ("diagonal", 0))
    vector, scalar = numbers.number_element(corners, plan.angular, plan.angular)
    elements = [
        MeshElement(
            square_basis(line, line),
            True,
            -1,
            0.0,
            1.0,
            line,
            line,
            np.array([vector]),
            np.array([scalar]),
        )
    ]
    angular = interval_basis(plan.angular, plan.angular + 5)
    for ring in range(2 * count):
        inside = ring < count
        if ring in (count - 1, count):
            points = plan.radial + 24  # of the graded rule: masses to 1e-13
            radial = interval_basis(plan.radial, points, plan.exponents, inside)
        else:
            radial = interval_basis(plan.radial, plan.radial + 5)
        start = 0.0 if ring == count else fractions[ring]
        numbered = [
            numbers.number_element(
                (
                    (side, ring),
                    (side, ring + 1),
                    ("diagonal", ring),
                    ("diagonal", ring + 1),
                ),
                radial.degree,
                plan.angular,
            )
            for side in "ab"
        ]
        vectors, scalars = (np.array(both) for both in zip(*numbered, strict=True))
        elements.append(
            MeshElement(
                square_basis(radial, angular),
                inside,
                ring,
                start,
                fractions[ring + 1],
                radial,
                angular,
                vectors,
                scalars,
            )
        )
    walls = (
        np.array([wall for _, wall in table.values()])
        for table in (numbers.vectors, numbers.scalars)
    )
    return DiscMesh(plan, tuple(elements), *walls)


def element_jacobian(
    plan: MeshPlan, element: MeshElement, rho: float
) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (points, 2) of (x, y) along both parameters of an element.

    The core is bilinear, with corners (0, 0), (a, 0), (c, c), (0, a) and c = 0.8 a. A
    ring maps (g, v) to (1 - g) start(v) + g end(v), between the core and the circle or
    the circle and the edge of the cell; the mirror image has the same matrices.

    Args:
        plan: of the mesh. element: of it. rho: diameter over pitch.
    """
    a, c = rho * plan.core, 0.8 * rho * plan.core
    g, v = (
        axis.reshape(-1, 1)
        for axis in np.meshgrid(
            element.radial.point, element.angular.point, indexing="ij"
        )
    )
    if element.ring < 0:
        along = np.concatenate([a + (c - a) * v, (c - a) * v], 1)
        across = np.concatenate([(c - a) * g, a + (c - a) * g], 1)
        return along, across
    size = element.end - element.start
    g = element.start + size * g
    phi, rate = v * math.pi / 4, math.pi / 4
    circle = rho * np.concatenate([np.cos(phi), np.sin(phi)], 1)
    d_circle = rho * rate * np.concatenate([-np.sin(phi), np.cos(phi)], 1)
    if element.inside:
        start = np.concatenate([a + (c - a) * v, c * v], 1)
        d_start = np.array([[c - a, c]])
        return size * (circle - start), (1 - g) * d_start + g * d_circle
    edge = np.concatenate([np.ones_like(phi), np.tan(phi)], 1)
    d_edge = rate * np.concatenate([np.zeros_like(phi), 1 / np.cos(phi) ** 2], 1)
    return size * (edge - circle), (1 - g) * d_circle + g * d_edge


@dataclass(frozen=True, eq=False, slots=True)
class CellMatrices:
    """Mass, curl-curl and scalar mass matrices of a part of the cell."""

    mass: np.ndarray
    curl: np.ndarray
    scalar: np.ndarray


def element_matrices(
    basis: SquareBasis, xi: np.ndarray, eta: np.ndarray
) -> CellMatrices:
    """Finite-element matrices of one element.

    With the covariant components a, b of a function N along xi and eta, N_i N_j dA =
    (g22 a_i a_j - g12 (a_i b_j + b_i a_j) + g11 b_i b_j) / area.

    Args:
        basis: of the reference element. xi, eta: (points, 2) its Jacobian.
    """
    area = np.abs(xi[:, 0] * eta[:, 1] - xi[:, 1] * eta[:, 0])

    def gram(left: np.ndarray, weight: np.ndarray, right: np.ndarray) -> np.ndarray:
        product: np.ndarray = (left * (weight * basis.weight)) @ right.T
        return product

    cross = gram(basis.along_xi, -(xi * eta).sum(1) / area, basis.along_eta)
    mass = np.block(
        [
            [gram(basis.along_xi, (eta * eta).sum(1) / area, basis.along_xi), cross],
            [cross.T, gram(basis.along_eta, (xi * xi).sum(1) / area, basis.along_eta)],
        ]
    )
    curl = basis.curl.T @ gram(basis.turn, 1 / area, basis.turn) @ basis.curl
    return CellMatrices(mass, curl, gram(basis.scalar, area, basis.scalar))


@lru_cache(maxsize=32)
def gradient_matrix(plan: MeshPlan) -> np.ndarray:
    """Discrete gradient (vectors, scalars): coefficients of the gradients of the scalar
    functions in the vector functions, exact and by topology alone.

    plan: of the mesh.
    """
    mesh = build_mesh(plan)
    gradient = np.zeros((len(mesh.vector_wall), len(mesh.scalar_wall)))
    for element in mesh.elements:
        rows, columns = np.nonzero(element.basis.gradient)
        values = element.basis.gradient[rows, columns]
        gradient[element.vector[:, rows], element.scalar[:, columns]] = values
    return gradient


@lru_cache(maxsize=6)
def assemble_disc(rho: float, plan: MeshPlan) -> tuple[CellMatrices, CellMatrices]:
    """Finite-element matrices of the whole quarter cell and of its part inside a disc,
    in half pitches: what a geometry costs once, for all wavelengths; cached.

    Args:
        rho: diameter over pitch, between 0 and 1. plan: of the mesh.
    """
    mesh = build_mesh(plan)
    nv, ns = len(mesh.vector_wall), len(mesh.scalar_wall)
    whole, disc = (
        CellMatrices(np.zeros((nv, nv)), np.zeros((nv, nv)), np.zeros((ns, ns)))
        for _ in range(2)
    )
    for element in mesh.elements:
        blocks = element_matrices(element.basis, *element_jacobian(plan, element, rho))
        for part in (whole, disc) if element.inside else (whole,):
            for vectors, scalars in zip(element.vector, element.scalar, strict=True):
                corner = np.ix_(vectors, vectors)
                part.mass[corner] += blocks.mass
                part.curl[corner] += blocks.curl
                part.scalar[np.ix_(scalars, scalars)] += blocks.scalar
    return whole, disc
