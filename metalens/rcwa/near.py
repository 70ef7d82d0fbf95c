"""The field in and around one cell: E and H at any points, from the coupled waves of every slab of the stack.

Films and sections are slabs alike. With the amplitudes a of the upward modes at the foot of a slab of height h and b of
the downward ones at its top (:mod:`metalens.rcwa.stack`), lengths in units of 1/k0,

    u = (Ex, Ey) = W (e^(iqz) a + e^(iq(h-z)) b),   w = (Hy, -Hx) = V (e^(iqz) a - e^(iq(h-z)) b),
    Ez = -[eps]^-1 K^T w,   Hz = R^T u,   D = Q u + R R^T u.                                                        (1)

At a wall the normal part of E jumps, and the sum of its orders rings; that of D does not. With the unit normal n of the
nearest boundary and a weight N that is 1 there (:func:`metalens.rcwa.pattern.normals_at`)

    E = E_sum + N n n^T (D_sum / eps - E_sum)                                                                       (2)

takes the normal part from D near boundaries, and jumps where eps does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Light, check_tolerance
from metalens.ground.arrays import Array
from metalens.ground.errors import CellError
from metalens.rcwa import layer as modes
from metalens.rcwa import made, mirrors, pattern
from metalens.rcwa.any_shape import ladder
from metalens.rcwa.conditions import direction
from metalens.rcwa.problem import Problem, problem, waves_of
from metalens.rcwa.solver import safety
from metalens.rcwa.stack import Fields, match, outgoing
from metalens.rcwa.waves import Waves, half_space, normal_component

MOST_POINTS = 4_000_000  # of one call: 1 GB with the truncations that are compared
_STEPS = 12  # of a tilted wall, as a staircase; half as many tell what they leave


@dataclass(frozen=True, eq=False, slots=True)
class NearField:
    """Fields of one plane wave from the substrate on the points (z, y, x), exp(-iwt).

    x_um (nx,), y_um (ny,): from the middle of the pillar; z_um (nz,): from its foot, light goes along +z. On an
        interface across z the fields are those just above it.
    e: (3, nz, ny, nx) Ex, Ey, Ez for an incident wave of electric amplitude 1, whose phase is 0 above the origin at the
        foot of the pillar (with films under it: at their outer face). h: likewise, times the impedance of vacuum.
    index: (nz, ny, nx) refractive index there.
    error: estimate of the root-mean-square error of e over all the points, relative to e.
    orders: of the truncation. converged: whether ``error`` meets the tolerance.
    """

    x_um: Array
    y_um: Array
    z_um: Array
    e: Array
    h: Array
    index: Array
    error: float
    orders: int
    converged: bool


@dataclass(frozen=True, eq=False, slots=True)
class _Grid:
    x_um: Array
    y_um: Array
    z_um: Array


@dataclass(frozen=True, slots=True)
class _Slab:
    """A film (an index alone) or a section; height times k0."""

    index: complex
    section: pattern.Slab | None
    height: float


@dataclass(frozen=True, eq=False, slots=True)
class _Look:
    """What the points of a slab see: eps (ny, nx) and N n n^T of (2) as (xx, yy, xy), None where it is homogeneous."""

    eps: Array
    normal: tuple[Array, Array, Array] | None


@dataclass(frozen=True, eq=False, slots=True)
class _Waves:
    """One symmetry class: its waves, the modes of every slab, 1/eps for Ez, and the incident amplitudes (n,)."""

    space: mirrors.Orders
    ways: Waves
    layers: list[modes.Layer]
    inverse_z: list[Array]
    incident: Array


def near_field(
    cell: Cell,
    size_um: float,
    light: Light,
    *,
    x_um: Sequence[float] | Array,
    y_um: Sequence[float] | Array,
    z_um: Sequence[float] | Array,
    tolerance: float = 0.05,
    harmonics: int | None = None,
) -> NearField:
    """E and H of a cell of any shape, lattice, layers and films on the points of three axes.

    A cut takes one value of the other axis: ``y_um=[0.0]``. Other polarisations are sums: a circular wave is x + iy.

    Args:
        size_um: of the shape (what other stages call the diameter).
        light: polarisation x or y: E (its tangential part) along that axis; p: along the plane of incidence, s: along
            z x k.
        tolerance: of the relative root-mean-square error over the points; harmonics: fix the largest truncation.

    Accuracy: ``error`` is 3 to 7 times the farthest of the four (six where something is narrow) truncations before the
        last, as for t. Within a few nm of an edge that runs along z no truncation is near: the field has no bound
        there. A tilted wall is a staircase of twelve steps, and half as many tell what it leaves.

    Raises:
        CellError: as :func:`metalens.rcwa.jones`; points that are not finite, or too many.
        MaterialError: a wavelength outside the range of a material.
    """
    check_tolerance(tolerance)
    grid = _checked(x_um, y_um, z_um)
    this = problem(cell, size_um, light.wavelength_um, light.angle_rad, light.azimuth_rad)
    climb = ladder(this, harmonics)
    steps = _STEPS if cell.sidewall_rad else 1
    slabs = _slabs(this, steps)
    looks, cut = _looks(this, slabs, grid), 0.0
    if steps > 1:
        coarse, half = min(climb.reaches[-1], climb.reaches[0] + 2), _slabs(this, steps // 2)
        fine = _fields(this, slabs, looks, light, grid, coarse)[0]
        cut = _apart(_fields(this, half, _looks(this, half, grid), light, grid, coarse)[0], fine)
    history: list[Array] = []
    for reach in climb.reaches:
        e, h = _fields(this, slabs, looks, light, grid, reach)
        farthest = max((_apart(one, e) for one in history[-climb.before :]), default=1.0)
        error = climb.crowded * safety(reach) * farthest + cut
        if len(history) >= climb.before and error <= tolerance:
            break
        history = [*history, e][-climb.before :]
    index = np.sqrt(np.stack([looks[i].eps for i in _places(this, slabs, grid.z_um)]))
    orders = int(np.count_nonzero(np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= reach))
    return NearField(grid.x_um, grid.y_um, grid.z_um, e, h, index, error, orders, error <= tolerance)


def _checked(x_um: Sequence[float] | Array, y_um: Sequence[float] | Array, z_um: Sequence[float] | Array) -> _Grid:
    axes = [np.atleast_1d(np.asarray(axis, float)) for axis in (x_um, y_um, z_um)]
    for name, axis in zip(("x_um", "y_um", "z_um"), axes, strict=True):
        if axis.ndim != 1 or not len(axis) or not np.isfinite(axis).all():
            raise CellError(f"{name} has shape {axis.shape}: need a list of finite lengths, at least one")
    count = math.prod(len(axis) for axis in axes)
    if count > MOST_POINTS:
        raise CellError(f"{count} points: need at most {MOST_POINTS} in one call; take cuts, or fewer samples")
    return _Grid(*axes)


def _apart(one: Array, other: Array) -> float:
    """Root-mean-square distance over that of the second."""
    return float(np.linalg.norm(one - other) / np.linalg.norm(other))


def _slabs(this: Problem, steps: int) -> list[_Slab]:
    """Films under the pillar, sections from the foot up, films over it; a tilted wall in equal steps."""
    k0, cell = 2 * math.pi / this.light.wavelength_um, this.cell
    found = [_Slab(index, None, thickness) for index, thickness in this.media.under]
    for part, grow in made.spread(cell):
        for i in range(steps):
            lift = ((i + 0.5) / steps - 0.5) * part.height_um * made.widening(cell)
            section = pattern.slab(cell, part, this.size_um, this.light.wavelength_um, grow_um=grow + lift)
            found.append(_Slab(0j, section, k0 * part.height_um / steps))
    return found + [_Slab(index, None, thickness) for index, thickness in this.media.over]


def _looks(this: Problem, slabs: list[_Slab], grid: _Grid) -> list[_Look]:
    """Of the substrate, every slab and the cover."""
    flat = np.ones((len(grid.y_um), len(grid.x_um)), complex)
    y, x = np.meshgrid(grid.y_um, grid.x_um, indexing="ij")
    found = [_Look(this.media.substrate**2 * flat, None)]
    for slab in slabs:
        if slab.section is None:
            found.append(_Look(slab.index**2 * flat, None))
            continue
        eps = pattern.permittivity(slab.section, this.cell, x, y)
        n, weight = pattern.normals_at(slab.section.outlines, this.cell, x, y)
        found.append(_Look(eps, (weight * n[..., 0] ** 2, weight * n[..., 1] ** 2, weight * n[..., 0] * n[..., 1])))
    return [*found, _Look(this.media.cover**2 * flat, None)]


def _places(this: Problem, slabs: list[_Slab], z_um: Array) -> Array:
    """(nz,) 0 for the substrate, then the slabs, last the cover."""
    return np.searchsorted(_edges(this, slabs), 2 * math.pi / this.light.wavelength_um * z_um, side="right")


def _edges(this: Problem, slabs: list[_Slab]) -> Array:
    """Interfaces along z times k0, 0 at the foot of the pillar."""
    heights = [slab.height for slab in slabs]
    return np.concatenate([[0.0], np.cumsum(heights)]) - sum(heights[: len(this.media.under)])


def _fields(
    this: Problem, slabs: list[_Slab], looks: list[_Look], light: Light, grid: _Grid, reach: int
) -> tuple[Array, Array]:
    """(3, nz, ny, nx) of e and of h, at one truncation."""
    shape = (len(grid.z_um), len(grid.y_um), len(grid.x_um))
    e, h, d = (np.zeros((n, *shape), complex) for n in (3, 3, 2))
    for operations in this.classes:
        space = mirrors.orders(reach, pattern.frame(this.cell, operations))
        one = _class(this, slabs, light, space)
        if one is None:
            continue
        found = _orders(this, slabs, one, grid.z_um)
        sets = (space.ex, space.ey, space.ez), (space.hz,), (space.ex, space.ey)
        summed = _Sum(this, space, operations, grid)
        for field, parts, amplitudes in zip((e, h[2:], d), sets, found[:3], strict=True):
            for i, part in enumerate(parts):
                field[i] += summed(part, amplitudes[i])
        h[0] -= summed(space.ey, found[3][1])
        h[1] += summed(space.ex, found[3][0])
    for i, place in enumerate(_places(this, slabs, grid.z_um)):
        if looks[place].normal is not None:
            e[:2, i] += _jump(looks[place], e[:2, i], d[:, i])
    return e, h


def _jump(look: _Look, e: Array, d: Array) -> Array:
    """What (2) adds to (Ex, Ey)."""
    xx, yy, xy = look.normal or (0.0, 0.0, 0.0)
    x, y = d / look.eps - e
    return np.stack([xx * x + xy * y, xy * x + yy * y])


def _class(this: Problem, slabs: list[_Slab], light: Light, space: mirrors.Orders) -> _Waves | None:
    """The waves and modes of one symmetry class; None where the light has no part in it."""
    ways, places = waves_of(space, this.cell, this.light)
    incident = np.zeros(len(ways.kappa), complex)
    for column, (place, sign) in places.items():
        incident[place] = sign * _come(light)[column]
    if not incident.any():
        return None
    symmetric = this.cell.outline(this.size_um).keeps(-1, -1)
    layers, inverse_z = [], []
    for slab in slabs:
        if slab.section is None:
            P, Q = _homogeneous(ways, slab.index)
            z = np.eye(len(space.ez.m)) / slab.index**2
        else:
            P, Q = pattern.operators(space, ways, slab.section, this.cell)
            z = np.linalg.inv(mirrors.product(space, pattern.tables(slab.section, this.cell, space.reach)[0], 2))
        layers.append(modes.layer(P, Q, symmetric=symmetric))
        inverse_z.append(z)
    return _Waves(space, ways, layers, inverse_z, incident)


def _come(light: Light) -> tuple[float, float]:
    """Amplitudes of the incident wave along x and y at normal incidence, of s and p else."""
    c, s = math.cos(light.azimuth_rad), math.sin(light.azimuth_rad)
    if light.angle_rad == 0:
        return {"x": (1.0, 0.0), "y": (0.0, 1.0), "p": (c, s), "s": (-s, c)}[light.polarization]
    wave = direction(light)[-1]
    along = {"x": (-s, c), "y": (c, s)}.get(light.polarization, (1.0, 1.0))  # of the unit vectors of s and of p
    return (math.copysign(1.0, along[0]), 0.0) if wave == "s" else (0.0, math.copysign(1.0, along[1]))


def _homogeneous(ways: Waves, index: complex) -> tuple[Array, Array]:
    """P and Q of a film."""
    is_p, square = np.arange(len(ways.kappa)) < ways.p_count, ways.kappa**2
    eps = index**2 if complex(index).imag else complex(index).real ** 2
    return np.diag(np.where(is_p, 1 - square / eps, 1.0)), np.diag(np.where(is_p, eps, eps - square))


def _orders(
    this: Problem, slabs: list[_Slab], one: _Waves, z_um: Array
) -> tuple[list[Array], list[Array], list[Array], list[Array]]:
    """Orders (nz, k) of [Ex, Ey, Ez], [Hz], [Dx, Dy] and w = [Hy, -Hx] at every height, by (1)."""
    ways, space = one.ways, one.space
    ex, p = len(space.ex.m), ways.p_count
    s = np.arange(len(ways.kappa)) >= p
    u, w = _heights(this, slabs, one, z_um)
    ez = np.zeros((len(z_um), len(space.ez.m)), complex)
    d = np.zeros_like(u)
    for i, place in enumerate(_places(this, slabs, z_um)):
        along = ways.kappa[ways.bare : p] * w[i, ways.bare : p]
        if 0 < place <= len(slabs):
            ez[i] = -one.inverse_z[place - 1] @ along
            d[i] = one.layers[place - 1].Q @ u[i] + np.where(s, ways.kappa**2, 0.0) * u[i]
        else:
            ez[i] = -along / (this.media.cover if place else this.media.substrate) ** 2
    hz = (ways.kappa * u)[:, len(ways.kappa) - len(space.hz.m) :]
    across, dual, flux = (values @ ways.fold.T for values in (u, w, d))
    return [across[:, :ex], across[:, ex:], ez], [hz], [flux[:, :ex], flux[:, ex:]], [dual[:, :ex], dual[:, ex:]]


def _heights(this: Problem, slabs: list[_Slab], one: _Waves, z_um: Array) -> tuple[Array, Array]:
    """(nz, n) amplitudes u and w of the waves at every height."""
    media, ways, come = this.media, one.ways, one.incident
    below, above = half_space(ways, media.substrate), half_space(ways, media.cover)
    heights = tuple(slab.height for slab in slabs)
    found: Fields = match(one.layers, heights, above, below, 2 * below[0] * below[1] * come)
    gone = outgoing(above, found.u_top, found.w_top)
    back = outgoing(below, found.u - below[0] * come, below[1] * come - found.w)
    kz_below, kz_above = (normal_component(ways.kappa, index) for index in (media.substrate, media.cover))
    edges = _edges(this, slabs)
    u, w = (np.zeros((len(z_um), len(come)), complex) for _ in range(2))
    for i, place in enumerate(_places(this, slabs, z_um)):
        z = 2 * math.pi / this.light.wavelength_um * z_um[i]
        if place == 0:
            up, down = np.where(come != 0, np.exp(1j * np.where(come != 0, kz_below, 0) * (z - edges[0])), 0) * come, 0.0
            down = back * np.exp(1j * kz_below * (edges[0] - z))
            u[i], w[i] = below[0] * (up + down), below[1] * (up - down)
        elif place > len(slabs):
            up = gone * np.exp(1j * kz_above * (z - edges[-1]))
            u[i], w[i] = above[0] * up, above[1] * up
        else:
            part = one.layers[place - 1]
            up = np.exp(1j * part.q * (z - edges[place - 1])) * found.up[place - 1]
            down = np.exp(1j * part.q * (edges[place] - z)) * found.down[place - 1]
            u[i], w[i] = part.W @ (up + down), part.V @ (up - down)
    return u, w


class _Sum:
    """Sums of orders on the points: a set of amplitudes (nz, k), unfolded by the symmetries, to (nz, ny, nx)."""

    def __init__(
        self, this: Problem, space: mirrors.Orders, operations: tuple[mirrors.Operation, ...], grid: _Grid
    ) -> None:
        k0 = 2 * math.pi / this.light.wavelength_um
        periods = this.cell.lattice.periods_um(this.cell.pitch_um)
        self.operations, self.reach = operations, space.reach
        self.along, self.across = (
            np.exp(1j * (k0 * k + 2 * np.pi / period * np.arange(-r, r + 1)) * axis[:, None])
            for k, period, r, axis in zip(
                (this.light.kx, this.light.ky), periods, space.reach, (grid.x_um, grid.y_um), strict=True
            )
        )

    def __call__(self, part: mirrors.Set, amplitude: Array) -> Array:
        mx, my = self.reach
        table = np.zeros((len(amplitude), 2 * my + 1, 2 * mx + 1), complex)
        for (sx, sy, _), sign in zip(self.operations, part.signs, strict=True):
            table[:, sy * part.n + my, sx * part.m + mx] = sign * amplitude / np.sqrt(part.size)
        return np.asarray(self.across @ table @ self.along.T)
