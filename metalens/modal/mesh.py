"""The quarter cell as curvilinear quadrilaterals that follow the disc."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from metalens.modal.shapes import (
    IntervalBasis,
    SquareBasis,
    polynomial_interval,
    rim_interval,
    square_basis,
)

X0, X1, Y0, Y1 = (
    1,
    2,
    4,
    8,
)  # walls of the quarter cell, as bits: x = 0, x = 1, y = 0, y = 1


@dataclass(frozen=True, slots=True)
class MeshPlan:
    """What fixes the topology and the basis of a mesh (everything but the diameter).

    radial, angular: polynomial degree across and along the rim; outside: radial degree
    outside the disc.
    exponents: of the rim bubbles. inner, outer: outer ends of the rings, as fractions
    of the way from the core to
    the circle, and from the circle to the edge of the cell. sectors: ends of the
    sectors, as fractions of 45
    degrees. core: half width of the core over the radius of the disc.
    """

    radial: int
    angular: int
    outside: int
    exponents: tuple[float, ...] = (0.7, 1.3)
    inner: tuple[float, ...] = (1.0,)
    outer: tuple[float, ...] = (1.0,)
    sectors: tuple[float, ...] = (1.0,)
    core: float = 0.6


@dataclass(frozen=True, eq=False, slots=True)
class MeshPatch:
    """Elements that share one reference basis. Jacobians are (elements, points, 2)
    arrays of (x, y).

    inside: whether the elements belong to the disc. copies: 2 where each stands for
    itself and its mirror image.
    rho_xi, rho_eta, rest_xi, rest_eta: derivatives of P and Q along xi and eta.
    vector, scalar: (copies, elements, functions) global numbers of the functions.
    """

    basis: SquareBasis
    inside: bool
    rho_xi: np.ndarray
    rho_eta: np.ndarray
    rest_xi: np.ndarray
    rest_eta: np.ndarray
    vector: np.ndarray
    scalar: np.ndarray


@dataclass(frozen=True, eq=False, slots=True)
class DiscMesh:
    """Patches and the global numbering; ``vector_wall`` and ``scalar_wall`` hold the
    wall bits of each function.
    """

    plan: MeshPlan
    patches: tuple[MeshPatch, ...]
    vector_wall: np.ndarray
    scalar_wall: np.ndarray


Vertex = tuple[str, int, int]


class FunctionNumbering:
    """Hands out global numbers for functions on vertices, edges and interiors; records
    the walls they lie on.
    """

    def __init__(self, rings: int, sectors: int) -> None:
        self.rings, self.sectors = rings, sectors
        self.vectors: dict[tuple[object, ...], int] = {}
        self.scalars: dict[tuple[object, ...], int] = {}
        self.vector_wall: list[int] = []
        self.scalar_wall: list[int] = []

    def wall_bits(self, vertex: Vertex) -> int:
        """Walls of the quarter cell that a vertex lies on, as bits."""
        kind, i, j = vertex
        if kind == "core":
            return (X0 if i == 0 else 0) | (Y0 if j == 0 else 0)
        last = i == self.rings
        if kind == "diagonal":
            return X1 | Y1 if last else 0
        start, end = (Y0, X1) if kind == "A" else (X0, Y1)
        return (start if j == 0 else 0) | (end if last else 0)

    def number_vector(self, wall: int, *key: object) -> int:
        """Number of the vector function ``key``; a new key takes the next number."""
        if key not in self.vectors:
            self.vectors[key] = len(self.vectors)
            self.vector_wall.append(wall)
        return self.vectors[key]

    def number_scalar(self, wall: int, *key: object) -> int:
        """Number of the scalar function ``key``; a new key takes the next number."""
        if key not in self.scalars:
            self.scalars[key] = len(self.scalars)
            self.scalar_wall.append(wall)
        return self.scalars[key]

    def number_element(
        self, v: tuple[Vertex, Vertex, Vertex, Vertex], px: int, py: int
    ) -> tuple[list[int], list[int]]:
        """Global numbers of the vector and scalar functions of one element.

        Functions on an edge or a vertex are shared with the neighbours; interior
        functions belong to the element.

        Args:
            v: corners v00, v10, v01, v11.
            px, py: polynomial degrees along both parameters.
        """
        walls = [self.wall_bits(vertex) for vertex in v]
        x_ends, y_ends = ((0, 1), (2, 3)), ((0, 2), (1, 3))

        def on_edge(ends: tuple[int, int], i: int) -> int:
            return self.number_vector(
                walls[ends[0]] & walls[ends[1]], v[ends[0]], v[ends[1]], i
            )

        def scalar_on_edge(ends: tuple[int, int], i: int) -> int:
            return self.number_scalar(
                walls[ends[0]] & walls[ends[1]], v[ends[0]], v[ends[1]], i
            )

        vectors = [
            on_edge(x_ends[j], i) if j < 2 else self.number_vector(0, "x", v, i, j)
            for i in range(px)
            for j in range(py + 1)
        ] + [
            on_edge(y_ends[i], j) if i < 2 else self.number_vector(0, "y", v, i, j)
            for i in range(px + 1)
            for j in range(py)
        ]
        scalars = []
        for i in range(px + 1):
            for j in range(py + 1):
                if i < 2 and j < 2:
                    scalars.append(self.number_scalar(walls[i + 2 * j], v[i + 2 * j]))
                elif j < 2:
                    scalars.append(scalar_on_edge(x_ends[j], i))
                elif i < 2:
                    scalars.append(scalar_on_edge(y_ends[i], j))
                else:
                    scalars.append(self.number_scalar(0, "z", v, i, j))
        return vectors, scalars


def core_vertex(i: int, j: int, n: int) -> Vertex:
    """Name of the corner (i, j) of a core of n by n elements; those on its rim are
    named as the rings name them.
    """
    if i == n and j == n:
        return ("diagonal", 0, 0)
    if i == n:
        return ("A", 0, j)
    return ("B", 0, i) if j == n else ("core", i, j)


def ring_vertex(side: str, ring: int, j: int, n: int) -> Vertex:
    """Name of corner j of a ring on one side ("A" below the diagonal, "B" above) with n
    sectors; both sides share the diagonal. ring: from the core.
    """
    return ("diagonal", ring, 0) if j == n else (side, ring, j)


def core_patch(plan: MeshPlan, numbers: FunctionNumbering) -> MeshPatch:
    """Core of the disc: a bilinear quadrilateral with corners (0, 0), (a, 0), (c, c),
    (0, a), cut along both parameters.

    Args:
        plan: of the mesh. numbers: hands out global numbers.
    """
    half_width = plan.core
    excess = 0.8 * half_width - half_width
    ends = np.concatenate([[0.0], plan.sectors])
    n = len(plan.sectors)
    line = polynomial_interval(plan.angular, plan.angular + 4)
    points = line.point
    along_u, along_v, vectors, scalars = [], [], [], []
    for i in range(n):
        for j in range(n):
            du, dv = ends[i + 1] - ends[i], ends[j + 1] - ends[j]
            u, v = np.meshgrid(
                ends[i] + du * points, ends[j] + dv * points, indexing="ij"
            )
            along_u.append(
                du * np.stack([half_width + excess * v, excess * v], -1).reshape(-1, 2)
            )
            along_v.append(
                dv * np.stack([excess * u, half_width + excess * u], -1).reshape(-1, 2)
            )
            corners = tuple(
                core_vertex(i + k, j + m, n) for m in (0, 1) for k in (0, 1)
            )
            numbered = numbers.number_element(corners, plan.angular, plan.angular)  # type: ignore[arg-type]
            vectors.append(numbered[0])
            scalars.append(numbered[1])
    xi, eta = np.array(along_u), np.array(along_v)
    zero = np.zeros_like(xi)
    return MeshPatch(
        square_basis(line, line),
        True,
        xi,
        eta,
        zero,
        zero,
        np.array([vectors]),
        np.array([scalars]),
    )


def ring_curves(plan: MeshPlan, inside: bool, v: np.ndarray) -> tuple[np.ndarray, ...]:
    """Start and end curve of a stack of rings at fractions ``v`` of 45 degrees, as
    parts P and Q of rho P + Q, each with its derivative.

    Args:
        plan: of the mesh. inside: whether the rings lie in the disc.
    """
    phi, rate = v * math.pi / 4, math.pi / 4
    circle = np.stack([np.cos(phi), np.sin(phi)], -1)
    d_circle = rate * np.stack([-np.sin(phi), np.cos(phi)], -1)
    if inside:
        a, c = plan.core, 0.8 * plan.core
        start = np.stack([a + (c - a) * v, c * v], -1)
        d_start = np.broadcast_to([c - a, c], start.shape)
        return start, d_start, circle, d_circle
    edge = np.stack([np.ones_like(phi), np.tan(phi)], -1)
    d_edge = rate * np.stack([np.zeros_like(phi), 1 / np.cos(phi) ** 2], -1)
    return circle, d_circle, edge, d_edge


def ring_patch(
    plan: MeshPlan,
    numbers: FunctionNumbering,
    rings: range,
    *,
    inside: bool,
    radial: IntervalBasis,
) -> MeshPatch:
    """Elements of some rings on both sides of the diagonal.

    An element maps (g, v) to (1 - g) start(v) + g end(v). Its Jacobian is stored as the
    parts P and Q of rho P + Q, for side A; side B is its mirror image.

    Args:
        plan: of the mesh. numbers: hands out global numbers.
        rings: counted from the core. inside: whether they lie in the disc.
        radial: basis along the radius.
    """
    ring_ends = np.concatenate([[0.0], plan.inner if inside else plan.outer])
    first = 0 if inside else len(plan.inner)
    sector_ends = np.concatenate([[0.0], plan.sectors])
    n = len(plan.sectors)
    angular = polynomial_interval(plan.angular, plan.angular + 5)
    jacobians: list[tuple[np.ndarray, ...]] = []
    vectors: list[list[list[int]]] = [[], []]
    scalars: list[list[list[int]]] = [[], []]
    for ring in rings:
        g0 = ring_ends[ring - first]
        dg = ring_ends[ring - first + 1] - ring_ends[ring - first]
        for j in range(n):
            dv = sector_ends[j + 1] - sector_ends[j]
            g, v = np.meshgrid(
                g0 + dg * radial.point,
                sector_ends[j] + dv * angular.point,
                indexing="ij",
            )
            start, d_start, end, d_end = ring_curves(plan, inside, v.ravel())
            g = g.reshape(-1, 1)
            from_start = (-dg * start, dv * (1 - g) * d_start)
            from_end = (dg * end, dv * g * d_end)
            zero = np.zeros_like(start)
            if inside:
                jacobians.append(
                    (
                        from_start[0] + from_end[0],
                        from_start[1] + from_end[1],
                        zero,
                        zero,
                    )
                )
            else:
                jacobians.append((*from_start, *from_end))
            for copy, side in enumerate("AB"):
                corners = tuple(
                    ring_vertex(side, ring + k, j + m, n)
                    for m in (0, 1)
                    for k in (0, 1)
                )
                numbered = numbers.number_element(corners, radial.degree, plan.angular)  # type: ignore[arg-type]
                vectors[copy].append(numbered[0])
                scalars[copy].append(numbered[1])
    parts = [np.array(part) for part in zip(*jacobians, strict=True)]
    return MeshPatch(
        square_basis(radial, angular),
        inside,
        parts[0],
        parts[1],
        parts[2],
        parts[3],
        np.array(vectors),
        np.array(scalars),
    )


@lru_cache(maxsize=32)
def build_mesh(plan: MeshPlan) -> DiscMesh:
    """All patches of a mesh plan; cached, as they do not depend on the diameter.

    From the centre: the core, the plain rings of the disc, the ring at the rim inside
    and the one outside with graded rules, and the plain rings around them.
    """
    inner, outer = len(plan.inner), len(plan.outer)
    numbers = FunctionNumbering(inner + outer, len(plan.sectors))
    points = plan.radial + 24  # of the graded rule: masses to 1e-13
    plain_inside = polynomial_interval(plan.radial, plan.radial + 5)
    patches = [core_patch(plan, numbers)]
    if inner > 1:
        patches.append(
            ring_patch(
                plan, numbers, range(inner - 1), inside=True, radial=plain_inside
            )
        )
    graded_inside = rim_interval(plan.radial, points, plan.exponents, True)
    patches.append(
        ring_patch(
            plan, numbers, range(inner - 1, inner), inside=True, radial=graded_inside
        )
    )
    graded_outside = rim_interval(plan.outside, points, plan.exponents, False)
    patches.append(
        ring_patch(
            plan, numbers, range(inner, inner + 1), inside=False, radial=graded_outside
        )
    )
    if outer > 1:
        plain_outside = polynomial_interval(plan.outside, plan.outside + 5)
        patches.append(
            ring_patch(
                plan,
                numbers,
                range(inner + 1, inner + outer),
                inside=False,
                radial=plain_outside,
            )
        )
    return DiscMesh(
        plan,
        tuple(patches),
        np.array(numbers.vector_wall),
        np.array(numbers.scalar_wall),
    )
