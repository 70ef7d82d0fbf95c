"""The field in and around one cell: E and H at any points, from the coupled waves of
every slab of the stack.

Films and sections are slabs alike. With the amplitudes a of the upward modes at the
foot of a slab of height h and b of
the downward ones at its top (:mod:`metalens.rcwa.stack`), lengths in units of 1/k0,

    u = (Ex, Ey) = W (e^(iqz) a + e^(iq(h-z)) b),   w = (Hy, -Hx) = V (e^(iqz) a - e^(iq(h-z)) b),
    Ez = -[eps]^-1 K^T w,   Hz = R^T u,   D = Q u + R R^T u.                                                        (1)

At a wall the normal part of E jumps, and the sum of its orders rings; that of D does
not. With the unit normal n of the
nearest boundary and a weight N that is 1 there
(:func:`metalens.rcwa.pattern.normals_at`)

    E = E_sum + N n n^T (D_sum / eps - E_sum)                                                                       (2)

takes the normal part from D near boundaries, and jumps where eps does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Incidence, check_tolerance
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.rcwa import pattern
from metalens.rcwa.any_shape import TruncationSequence, truncation_sequence
from metalens.rcwa.near_waves import (
    FieldSlab,
    PointSums,
    orders_at,
    slab_indices,
    slabs_of,
    solve_class,
)
from metalens.rcwa.orders import mirrors
from metalens.rcwa.problem import CellProblem, cell_problem
from metalens.rcwa.solver import safety_factor

MOST_POINTS = 4_000_000  # of one call: 1 GB with the truncations that are compared
_SAFETY, _ENOUGH = (
    2.5,
    7,
)  # times the farthest truncation before, from so many orders on; below, as for t
_STEPS = 12  # of a tilted wall, as a staircase; half as many tell what they leave


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
                    f"{name} has shape {axis.shape}: need a list of finite lengths, at least one"
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
    phase is 0 above the origin at the
        foot of the pillar (with films under it: at their outer face). h: likewise,
        times the impedance of vacuum. On an
        interface across z both are those just above it.
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
class _Look:
    """What the points of a slab see: eps (ny, nx) and N n n^T of (2) as (xx, yy, xy),
    None where it is homogeneous.
    """

    eps: Array
    normal: tuple[Array, Array, Array] | None


@dataclass(frozen=True, eq=False, slots=True)
class _Stack:
    """Slabs, and what the points of every grid see of substrate, slabs and cover."""

    slabs: list[FieldSlab]
    looks: list[list[_Look]]


def near_fields(
    cell: Cell,
    size_um: float,
    light: Incidence,
    grids: Sequence[FieldGrid],
    *,
    tolerance: float = 0.05,
    harmonics: int | None = None,
) -> list[NearField]:
    """E and H of a cell of any shape, lattice, layers and films, on every grid.

    Other polarisations are sums: that of a circular wave is x + iy.

    Args:
        size_um: of the shape (what other stages call the diameter).
        light: polarisation x or y: E (its tangential part) along that axis; p: along
            the plane of incidence, s: along
            z x k.
        tolerance: of the relative root-mean-square error over the points of any grid;
            harmonics: fix the largest
            truncation instead.

    Accuracy: ``error`` is 2.5 times the farthest of the four (six where something is
    narrow) truncations before the
        last, more below seven orders. On 40 random cells (circles to crosses, index 1.8
        to 3.7, some absorbing, some
        oblique; 7 to 13 orders against 16) the error was at most 1.8 times the
        farthest, half of it in the median.
        Within a few nm of an edge that runs along z no truncation is near: the field
        has no bound
        there. A tilted wall is a staircase of twelve steps, and half as many tell what
        it leaves.

    Raises:
        CellError: as :func:`metalens.rcwa.jones`; too many points.
        MaterialError: a wavelength outside the range of a material.
    """
    check_tolerance(tolerance)
    count = sum(math.prod(grid.shape) for grid in grids)
    if not 0 < count <= MOST_POINTS:
        raise CellError(
            f"{count} points: need 1 to {MOST_POINTS} in one call; take cuts, or fewer samples"
        )
    this = cell_problem(
        cell, size_um, light.wavelength_um, light.angle_rad, light.azimuth_rad
    )
    climb = truncation_sequence(this, harmonics)
    steps = _STEPS if cell.sidewall_rad else 1
    stack = _stack(this, steps, grids)
    cut = (
        np.zeros(len(grids))
        if steps == 1
        else _staircase(this, stack, steps, light, grids, climb)
    )
    history: list[list[tuple[Array, Array]]] = []
    for reach in climb.reaches:
        found = _fields(this, stack, light, grids, reach)
        farthest = np.max(
            [[1.0] * len(grids)]
            if not history
            else [_apart(one, found) for one in history],
            axis=0,
        )
        factor = climb.crowded * (_SAFETY if reach >= _ENOUGH else safety_factor(reach))
        error = np.minimum(factor * farthest + cut, 2.0)
        if len(history) >= climb.before and error.max() <= tolerance:
            break
        history = [*history, found][-climb.before :]
    orders = int(
        np.count_nonzero(
            np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= reach
        )
    )
    return [
        NearField(
            grid,
            e,
            h,
            _index(this, stack.slabs, looks, grid),
            float(bar),
            orders,
            bool(bar <= tolerance),
        )
        for grid, looks, (e, h), bar in zip(
            grids, stack.looks, found, error, strict=True
        )
    ]


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
    """As :func:`near_fields`, on one grid: ``y_um=[0.0]`` gives a cut along x and z."""
    return near_fields(
        cell,
        size_um,
        light,
        [FieldGrid(x_um, y_um, z_um)],
        tolerance=tolerance,
        harmonics=harmonics,
    )[0]


def _apart(
    some: list[tuple[Array, Array]], others: list[tuple[Array, Array]]
) -> list[float]:
    """For every grid the root-mean-square distance of e, over that of the second."""
    return [
        float(np.linalg.norm(one - other) / np.linalg.norm(other))
        for (one, _), (other, _) in zip(some, others, strict=True)
    ]


def _staircase(
    this: CellProblem,
    stack: _Stack,
    steps: int,
    light: Incidence,
    grids: Sequence[FieldGrid],
    climb: TruncationSequence,
) -> Array:
    """What half as many steps of a tilted wall change, at few orders."""
    coarse = min(climb.reaches[-1], climb.reaches[0] + 2)
    half = _fields(this, _stack(this, steps // 2, grids), light, grids, coarse)
    return np.array(_apart(half, _fields(this, stack, light, grids, coarse)))


def _stack(this: CellProblem, steps: int, grids: Sequence[FieldGrid]) -> _Stack:
    slabs = slabs_of(this, steps)
    return _Stack(slabs, [_looks(this, slabs, grid) for grid in grids])


def _looks(this: CellProblem, slabs: list[FieldSlab], grid: FieldGrid) -> list[_Look]:
    """Of the substrate, every slab and the cover."""
    y, x = np.meshgrid(grid.y_um, grid.x_um, indexing="ij")
    flat = np.ones(x.shape, complex)
    found = [_Look(this.media.substrate**2 * flat, None)]
    for slab in slabs:
        if slab.section is None:
            found.append(_Look(slab.index**2 * flat, None))
            continue
        n, weight = pattern.normals_at(slab.section.outlines, this.cell, x, y)
        normal = (
            weight * n[..., 0] ** 2,
            weight * n[..., 1] ** 2,
            weight * n[..., 0] * n[..., 1],
        )
        found.append(
            _Look(pattern.permittivity_at(slab.section, this.cell, x, y), normal)
        )
    return [*found, _Look(this.media.cover**2 * flat, None)]


def _index(
    this: CellProblem, slabs: list[FieldSlab], looks: list[_Look], grid: FieldGrid
) -> Array:
    """(nz, ny, nx)."""
    return np.asarray(
        np.sqrt(
            np.stack(
                [looks[i].eps for i in slab_indices(this, slabs, np.asarray(grid.z_um))]
            )
        )
    )


def _fields(
    this: CellProblem,
    stack: _Stack,
    light: Incidence,
    grids: Sequence[FieldGrid],
    reach: int,
) -> list[tuple[Array, Array]]:
    """(3, nz, ny, nx) e and h of every grid, at one truncation."""
    found = [
        tuple(np.zeros((n, *grid.shape), complex) for n in (3, 3, 2)) for grid in grids
    ]
    for operations in this.classes:
        space = mirrors.reduced_orders(
            reach, pattern.lattice_frame(this.cell, operations)
        )
        one = solve_class(this, stack.slabs, light, space)
        if one is None:
            continue
        for grid, (e, h, d) in zip(grids, found, strict=True):
            at = orders_at(this, stack.slabs, one, np.asarray(grid.z_um))
            summed = PointSums(
                this,
                operations,
                space.reach,
                (np.asarray(grid.x_um), np.asarray(grid.y_um)),
            )
            e += [
                summed(space.ex, at.ex),
                summed(space.ey, at.ey),
                summed(space.ez, at.ez),
            ]
            h += [
                summed(space.ey, at.hx),
                summed(space.ex, at.hy),
                summed(space.hz, at.hz),
            ]
            d += [summed(space.ex, at.dx), summed(space.ey, at.dy)]
    for grid, looks, (e, _, d) in zip(grids, stack.looks, found, strict=True):
        for i, place in enumerate(
            slab_indices(this, stack.slabs, np.asarray(grid.z_um))
        ):
            e[:2, i] += _jump(looks[place], e[:2, i], d[:, i])
    return [(e, h) for e, h, _ in found]


def _jump(look: _Look, e: Array, d: Array) -> Array:
    """What (2) adds to (Ex, Ey)."""
    if look.normal is None:
        return np.zeros_like(e)
    xx, yy, xy = look.normal
    x, y = d / look.eps - e
    return np.stack([xx * x + xy * y, xy * x + yy * y])
