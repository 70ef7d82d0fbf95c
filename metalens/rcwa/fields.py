"""Near field of a unit cell: E and H at any points, from the eigenmodes of every slab."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Incidence, check_tolerance
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.rcwa.basis import (
    ROUNDING,
    Operation,
    OrderSet,
    ReducedOrders,
    count_orders,
    half_space,
    plane_waves,
    reduced_orders,
    toeplitz_matrix,
)
from metalens.rcwa.permittivity import (
    PillarSection,
    normals_at,
    permittivity_at,
    permittivity_coefficients,
    section_modes,
)
from metalens.rcwa.smatrix import match_layers
from metalens.rcwa.solver import (
    CellProblem,
    cell_problem,
    polarization_column,
    safety_factor,
    stack_sections,
    truncation_sequence,
)

# factor on the largest change from an earlier truncation, from so many harmonics on
_SAFETY, _ENOUGH = 2.5, 7


@dataclass(frozen=True, eq=False, slots=True)
class FieldGrid:
    """Points (z, y, x) of three axes; a cut takes one value of an axis.

    x_um (nx,), y_um (ny,): from the middle of the pillar; z_um (nz,): from its foot,
    light goes along +z.
    """

    x_um: Sequence[float] | Array
    y_um: Sequence[float] | Array
    z_um: Sequence[float] | Array

    def __post_init__(self) -> None:
        for name in ("x_um", "y_um", "z_um"):
            axis = np.asarray(getattr(self, name), float)
            if axis.ndim != 1 or not len(axis) or not np.isfinite(axis).all():
                raise CellError(
                    f"{name} has shape {axis.shape}: need a list of finite lengths, at "
                    "least one"
                )
            object.__setattr__(self, name, axis)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(nz, ny, nx)."""
        return len(self.z_um), len(self.y_um), len(self.x_um)


@dataclass(frozen=True, eq=False, slots=True)
class NearField:
    """Fields of one plane wave from the substrate on the points of a grid, exp(-iwt).

    e: (3, nz, ny, nx) Ex, Ey, Ez for an incident wave of electric amplitude 1, whose
        phase is 0 above the origin at the foot of the pillar (with films under it: at
        their outer face). h: likewise, times the impedance of vacuum. On an interface
        across z both are those just above it.
    index: (nz, ny, nx) refractive index there.
    error: estimate of the root-mean-square error of e over all the points, relative to
        e.
    orders: of the truncation. converged: whether ``error`` meets the tolerance.
    """

    grid: FieldGrid
    e: Array
    h: Array
    index: Array
    error: float
    orders: int
    converged: bool


@dataclass(frozen=True, eq=False, slots=True)
class _Stack:
    """Substrate, slabs and cover, and where they meet.

    slabs: foot first, with both half-spaces, and heights times k0.
    ends: (slabs - 1,) interfaces times k0, 0 at the pillar's foot.
    """

    problem: CellProblem
    slabs: list[tuple[PillarSection, float]]
    ends: Array

    @property
    def k0(self) -> float:
        return 2 * math.pi / self.problem.light.wavelength_um

    def places(self, z_um: Array) -> list[int]:
        """(nz,) places among the slabs of heights over the foot."""
        # a point on an interface may lie below it by rounding
        on = ROUNDING * (self.ends[-1] - self.ends[0])
        places: list[int] = np.searchsorted(
            self.ends, self.k0 * z_um + on, "right"
        ).tolist()
        return places

    def points(self, grid: FieldGrid) -> list[tuple[Array, Array | None]]:
        """Permittivity and normal field on the grid, for every slab.

        For each, eps (ny, nx), and the normal field N n n^T as (xx, yy, xy); None for a
        homogeneous slab.
        """
        cell = self.problem.cell
        y, x = np.meshgrid(grid.y_um, grid.x_um, indexing="ij")
        return [
            (
                permittivity_at(section, cell, x, y),
                normals_at(section.outlines, cell, x, y) if section.outlines else None,
            )
            for section, _ in self.slabs
        ]


def _stack(problem: CellProblem, steps: int) -> _Stack:
    """Slabs of a cell, foot first: substrate, films under the pillar, its sections,
    films over it, cover.

    Args:
        problem: cell and light.
        steps: of the staircase of a tilted wall.
    """
    substrate, cover = (PillarSection((), (), n**2) for n in problem.indices)
    slabs = [(substrate, 0.0), *stack_sections(problem, steps), (cover, 0.0)]
    ends = np.cumsum([height for _, height in slabs[:-1]])
    return _Stack(problem, slabs, ends - ends[len(problem.cell.under)])


def near_fields(
    cell: Cell,
    size_um: float,
    light: Incidence,
    grids: Sequence[FieldGrid],
    *,
    tolerance: float = 0.05,
    harmonics: int | None = None,
    steps: int = 12,
    most_points: int = 4_000_000,
) -> list[NearField]:
    """Near field by RCWA: E and H of a cell of any shape, lattice, layers and films.

    Other polarisations are sums: that of a circular wave is x + iy.

    Args:
        cell: the pillar.
        size_um: of the shape (what other stages call the diameter).
        light: polarisation x or y: E (its tangential part) along that axis; p: along
            the plane of incidence, s: along z x k.
        grids: points of each result.
        tolerance: of the relative root-mean-square error over the points of any grid.
        harmonics: fix the largest truncation instead.
        steps: of a tilted wall, as a staircase; half as many tell what they leave.
        most_points: of all grids: 1 GB with the truncations that are compared.

    Raises:
        CellError: as :func:`metalens.rcwa.jones`; too many points.
        MaterialError: a wavelength outside the range of a material.

    Accuracy: ``error`` is 2.5 times the largest change from the four truncations before
        the last (six where something is narrow), more below seven harmonics. Within a
        few nm of an edge along z the field has no bound and no truncation is near. A
        tilted wall is a staircase; its error is the change from half the steps.
    """
    check_tolerance(tolerance)
    count = sum(math.prod(grid.shape) for grid in grids)
    if not 0 < count <= most_points:
        raise CellError(
            f"{count} points: need 1 to {most_points} in one call; take cuts, or fewer "
            "samples"
        )
    problem = cell_problem(
        cell, size_um, light.wavelength_um, light.angle_rad, light.azimuth_rad
    )
    sequence = truncation_sequence(problem, harmonics)
    steps = steps if cell.sidewall_rad else 1
    stack, staircase_error = _stack(problem, steps), np.zeros(len(grids))
    if steps > 1:
        coarse = min(sequence.reaches[-1], sequence.reaches[0] + 2)
        half_steps = _fields(_stack(problem, steps // 2), light, grids, coarse)
        staircase_error = _differences(half_steps, _fields(stack, light, grids, coarse))
    history: list[list[tuple[Array, Array]]] = []
    for reach in sequence.reaches:
        fields = _fields(stack, light, grids, reach)
        changes = [_differences(earlier, fields) for earlier in history]
        largest = np.max(changes or [np.ones(len(grids))], axis=0)
        factor = _SAFETY if reach >= _ENOUGH else safety_factor(reach)
        error = np.minimum(sequence.factor * factor * largest + staircase_error, 2.0)
        if len(history) >= sequence.compared and error.max() <= tolerance:
            break
        history = [*history, fields][-sequence.compared :]
    orders = count_orders(reach)
    results = []
    for grid, (e, h), grid_error in zip(grids, fields, error.tolist(), strict=True):
        points = stack.points(grid)
        eps = np.stack([points[i][0] for i in stack.places(np.asarray(grid.z_um))])
        results.append(
            NearField(
                grid, e, h, np.sqrt(eps), grid_error, orders, grid_error <= tolerance
            )
        )
    return results


def near_field(
    cell: Cell,
    size_um: float,
    light: Incidence,
    *,
    x_um: Sequence[float] | Array,
    y_um: Sequence[float] | Array,
    z_um: Sequence[float] | Array,
    tolerance: float = 0.05,
    harmonics: int | None = None,
) -> NearField:
    """Near field by RCWA on one grid, see :func:`near_fields`.

    Args:
        cell, size_um, light, tolerance, harmonics: as there.
        x_um, y_um, z_um: axes of the grid; ``y_um=[0.0]`` gives a cut along x and z.
    """
    grid = FieldGrid(x_um, y_um, z_um)
    return near_fields(
        cell, size_um, light, [grid], tolerance=tolerance, harmonics=harmonics
    )[0]


def _differences(
    fields: list[tuple[Array, Array]], references: list[tuple[Array, Array]]
) -> Array:
    """(grid,) norm of the difference of e over the norm of the reference e.

    fields, references: (e, h) of every grid.
    """
    return np.array(
        [
            np.linalg.norm(field - reference_field) / np.linalg.norm(reference_field)
            for (field, _), (reference_field, _) in zip(fields, references, strict=True)
        ]
    )


def _fields(
    stack: _Stack, light: Incidence, grids: Sequence[FieldGrid], reach: int
) -> list[tuple[Array, Array]]:
    """(3, nz, ny, nx) e and h of every grid, at one truncation.

    The orders of every symmetry class are summed on the points. Then e is replaced
    along the normals by D / eps: e += N n n^T (D / eps - e) for the x and y components.

    Args:
        stack: slabs and half-spaces.
        light: plane wave.
        grids: points.
        reach: harmonics.
    """
    problem = stack.problem
    totals = [
        tuple(np.zeros((n, *grid.shape), complex) for n in (3, 3, 2)) for grid in grids
    ]
    for operations in problem.classes:
        space = reduced_orders(reach, problem.cell.lattice, operations)
        orders_at = _solve_class(stack, light, space)
        if orders_at is None:
            continue
        for grid, fields in zip(grids, totals, strict=True):
            sums = _point_sums(problem, operations, space.reach, grid)
            orders = orders_at(np.asarray(grid.z_um))
            for field, components in zip(fields, orders, strict=True):
                for i, (order_set, amplitude) in enumerate(components):
                    field[i] += sums(order_set, amplitude)
    for grid, (e, _, displacement) in zip(grids, totals, strict=True):
        points = stack.points(grid)
        for i, slab in enumerate(stack.places(np.asarray(grid.z_um))):
            eps, normal = points[slab]
            if normal is not None:
                xx, yy, xy = normal
                x, y = displacement[:, i] / eps - e[:2, i]
                e[:2, i] += np.stack([xx * x + xy * y, xy * x + yy * y])
    return [(e, h) for e, h, _ in totals]


Components = list[tuple[OrderSet, Array]]


def _solve_class(
    stack: _Stack, light: Incidence, space: ReducedOrders
) -> Callable[[Array], tuple[Components, Components, Components]] | None:
    """E, H (times the impedance of vacuum) and D (x and y) of one symmetry class; None
    if the light excites none.

    In a slab u = W (up + down), w = V (up - down), with modes exp(i q z) from its foot
    upwards and from its top downwards. u and w give the tangential fields. Ez follows
    from 1/eps of each medium times the curl of H, Hz from the curl of E, D from Q of
    the slab.

    Args:
        stack: slabs and half-spaces.
        light: plane wave.
        space: reduced orders of the class.

    Returns:
        Function of heights (nz,) over the foot, um: for each field a list of (order
        set, amplitudes (nz, k)).
    """
    problem, cell = stack.problem, stack.problem.cell
    waves = plane_waves(space, cell, problem.light)
    incident = np.zeros(len(waves.kappa), complex)
    for column, (zero_order, sign) in waves.zero.items():
        incident[zero_order] = sign * _incident_amplitudes(light)[column]
    if not incident.any():
        return None
    layers = [
        section_modes(space, waves, section, cell, height)
        for section, height in stack.slabs
    ]
    tables = (
        permittivity_coefficients(section, cell, space.reach)[0]
        for section, _ in stack.slabs
    )
    inverse_z = [np.linalg.inv(toeplitz_matrix(space, eps, "ez")) for eps in tables]
    substrate, cover = (half_space(waves, index) for index in problem.indices)
    source = 2 * substrate[0] * substrate[1] * incident
    symmetric = cell.outline(problem.size_um).keeps(-1, -1)
    fields = match_layers(layers[1:-1], cover, substrate, source, symmetric=symmetric)
    # the modes of the half-spaces are plane waves, in another order: W^T W = 1
    upward = substrate[0] * incident
    below, above = layers[0].W.T, layers[-1].W.T
    ups = [below @ upward, *fields.up, above @ fields.u_top]
    downs = [below @ (fields.u - upward), *fields.down, np.zeros_like(upward)]
    feet, tops = [stack.ends[0], *stack.ends], [*stack.ends, stack.ends[-1]]
    p_waves = slice(waves.bare, waves.p_count)
    curl = np.where(waves.is_p, 0.0, waves.kappa**2)  # R R^T: of s waves alone

    def orders_at(z_um: Array) -> tuple[Components, Components, Components]:
        u, w, d = np.zeros((3, len(z_um), len(waves.kappa)), complex)
        ez = np.zeros((len(z_um), len(space.ez.m)), complex)
        for i, place in enumerate(stack.places(z_um)):
            modes, z = layers[place], stack.k0 * z_um[i]
            up, down = (
                # waves that are not there may grow without bound
                amplitude * np.exp(1j * modes.q * distance * (amplitude != 0))
                for amplitude, distance in (
                    (ups[place], z - feet[place]),
                    (downs[place], tops[place] - z),
                )
            )
            u[i], w[i] = modes.W @ (up + down), modes.V @ (up - down)
            ez[i] = -inverse_z[place] @ (waves.kappa[p_waves] * w[i, p_waves])
            d[i] = modes.Q @ u[i] + curl * u[i]
        hz = (waves.kappa * u)[:, len(waves.kappa) - len(space.hz.m) :]
        e, h, d = (values @ waves.fold.T for values in (u, w, d))
        count = len(space.ex.m)
        return (
            [(space.ex, e[:, :count]), (space.ey, e[:, count:]), (space.ez, ez)],
            [(space.ey, -h[:, count:]), (space.ex, h[:, :count]), (space.hz, hz)],
            [(space.ex, d[:, :count]), (space.ey, d[:, count:])],
        )

    return orders_at


def _incident_amplitudes(light: Incidence) -> tuple[float, float]:
    """Amplitudes of the incident wave along (x, y) at normal incidence, else of (s, p)."""
    c, s = math.cos(light.azimuth_rad), math.sin(light.azimuth_rad)
    directions = {"x": (1.0, 0.0), "y": (0.0, 1.0), "p": (c, s), "s": (-s, c)}
    x, y = directions[light.polarization]
    if light.angle_rad == 0:
        return x, y
    along_s, along_p = c * y - s * x, c * x + s * y
    # one of them is 0 but for rounding
    return (0.0, along_p) if polarization_column(light) else (along_s, 0.0)


def _point_sums(
    problem: CellProblem,
    operations: tuple[Operation, ...],
    reach: tuple[int, int],
    grid: FieldGrid,
) -> Callable[[OrderSet, Array], Array]:
    """Sums of orders on the points of a grid, for one symmetry class.

    Reduced amplitudes are unfolded by the symmetry operations before the sum.

    Args:
        problem: cell and light. operations: of the class. reach: largest orders (m, n).
        grid: points.

    Returns:
        Function of an order set and amplitudes (nz, k) to the field (nz, ny, nx).
    """
    light, (mx, my) = problem.light, reach
    k0 = 2 * math.pi / light.wavelength_um
    periods = problem.cell.lattice.periods_um(problem.cell.pitch_um)
    along, across = (
        np.exp(
            1j
            * (k0 * k + 2 * np.pi / period * np.arange(-r, r + 1))
            * np.asarray(axis)[:, None]
        )
        for k, period, r, axis in zip(
            (light.kx, light.ky), periods, reach, (grid.x_um, grid.y_um), strict=True
        )
    )

    def sums(orders: OrderSet, amplitude: Array) -> Array:
        table = np.zeros((len(amplitude), 2 * my + 1, 2 * mx + 1), complex)
        for (sx, sy, _), sign in zip(operations, orders.signs, strict=True):
            table[:, sy * orders.n + my, sx * orders.m + mx] = (
                sign * amplitude / np.sqrt(orders.size)
            )
        return np.asarray(across @ table @ along.T)

    return sums
