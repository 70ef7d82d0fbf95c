"""Curl-conforming elements of the quarter cell that follow the disc, and their
matrices with every wall natural.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

# s = t**10 makes s**0.7 and s**1.3, their slopes and their products polynomials of t
RIM_POWER = 10


@dataclass(frozen=True, eq=False, slots=True)
class IntervalBasis:
    """Functions of one element axis at quadrature points.

    point, weight: (n,) of the rule on [0, 1].
    value: (degree + 1, n) nodal functions and bubbles; slope: (degree, n) their
    derivatives, see the module.
    """

    point: np.ndarray
    weight: np.ndarray
    value: np.ndarray
    slope: np.ndarray

    @property
    def degree(self) -> int:
        """Highest degree of the polynomials."""
        return len(self.slope)


def gauss_rule(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre quadrature: ``n`` points and weights on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


def graded_rule(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Quadrature of ``n`` points on [0, 1] for integrands that are polynomials of
    ``s**(1 / RIM_POWER)`` and vary smoothly in s.
    """
    t, w = gauss_rule(n)
    return t**RIM_POWER, w * RIM_POWER * t ** (RIM_POWER - 1)


def polynomial_basis(degree: int, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (degree + 1, n) and slopes (degree, n) of the polynomial basis at points
    s.
    """
    legendre = np.polynomial.legendre.legvander(2 * s - 1, degree + 1).T
    norm = np.sqrt(2 * np.arange(degree) + 1)[:, None]
    value = np.empty((degree + 1, len(s)))
    value[0], value[1] = 1 - s, s
    value[2:] = (legendre[2 : degree + 1] - legendre[: degree - 1]) / (2 * norm[1:])
    return value, legendre[:degree] * norm


@lru_cache(maxsize=64)
def interval_basis(
    degree: int, points: int, exponents: tuple[float, ...] = (), at_end: bool = False
) -> IntervalBasis:
    """Integrated Legendre polynomials, and singular functions ``d**tau - d`` of the
    distance d to s = 0, or to s = 1 if ``at_end``.

    The slope of each singular function is orthonormal to the slopes before it,
    which keeps the matrices well conditioned.

    Args:
        degree: of the polynomials. points: of the rule, graded where functions are
            singular. exponents: tau of each singular function.
        at_end: where they are singular.
    """
    d, w = graded_rule(points) if exponents else gauss_rule(points)
    value, slope = polynomial_basis(degree, 1 - d if at_end else d)
    fine, fine_weight = graded_rule(80)
    fine_slope = polynomial_basis(degree, 1 - fine if at_end else fine)[1]
    side = -1.0 if at_end else 1.0
    for tau in exponents:
        bubble, rate = d**tau - d, side * (tau * d ** (tau - 1) - 1)
        fine_rate = side * (tau * fine ** (tau - 1) - 1)
        for _ in range(2):  # twice is enough (Kahan) for orthogonality to rounding
            overlap = (fine_slope[1:] * fine_weight) @ fine_rate
            bubble = bubble - overlap @ value[2:]
            rate = rate - overlap @ slope[1:]
            fine_rate = fine_rate - overlap @ fine_slope[1:]
        norm = np.sqrt(fine_weight @ fine_rate**2)
        value = np.vstack([value, bubble / norm])
        slope = np.vstack([slope, rate / norm])
        fine_slope = np.vstack([fine_slope, fine_rate / norm])
    return IntervalBasis(1 - d if at_end else d, w, value, slope)


@dataclass(frozen=True, eq=False, slots=True)
class SquareBasis:
    """Tensor products on the unit square, flattened: functions first, then quadrature
    points (xi slow, eta fast).

    along_xi, along_eta: covariant components of the vector functions; scalar: of the
    scalar ones.
    turn: the functions that span the curls. weight: of the points.
    curl: (turns, vectors), gradient: (vectors, scalars): exact relations between the
    coefficients.
    """

    weight: np.ndarray
    along_xi: np.ndarray
    along_eta: np.ndarray
    scalar: np.ndarray
    turn: np.ndarray
    curl: np.ndarray
    gradient: np.ndarray


def derivative_matrix(degree: int) -> np.ndarray:
    """(degree, degree + 1): derivative of values in terms of slopes."""
    d = np.zeros((degree, degree + 1))
    d[0, 0] = -1.0
    d[np.arange(degree), np.arange(1, degree + 1)] = 1.0
    return d


@lru_cache(maxsize=64)
def square_basis(xi: IntervalBasis, eta: IntervalBasis) -> SquareBasis:
    """Curl-conforming element basis, tensor products of interval bases ``xi`` and
    ``eta``; vector functions along xi come first.
    """

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        flat: np.ndarray = np.einsum("ia,jb->ijab", a, b).reshape(len(a) * len(b), -1)
        return flat

    px, py = xi.degree, eta.degree
    dx = derivative_matrix(px)
    dy = derivative_matrix(py)
    one_x = np.eye(px)
    one_y = np.eye(py)
    return SquareBasis(
        weight=np.outer(xi.weight, eta.weight).ravel(),
        along_xi=product(xi.slope, eta.value),
        along_eta=product(xi.value, eta.slope),
        scalar=product(xi.value, eta.value),
        turn=product(xi.slope, eta.slope),
        curl=np.hstack([-np.kron(one_x, dy), np.kron(dx, one_y)]),
        gradient=np.vstack([np.kron(dx, np.eye(py + 1)), np.kron(np.eye(px + 1), dy)]),
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
