"""Operators P and Q of a patterned layer: permittivity from the exact Fourier factors
of its outlines, and a field of unit normals from its boundary.
"""

import itertools
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import j0, jv

from metalens.cell import Cell, Layer, materials
from metalens.cell.shapes import Outline
from metalens.cell.shapes.outline import EllipseArc
from metalens.core.arrays import Array
from metalens.rcwa.basis import ROUNDING, PlaneWaves, ReducedOrders, toeplitz_matrix
from metalens.rcwa.smatrix import FourierModes, film_modes, solve_eigenmodes

_GRID = 192  # points along the pitch on which normals are sampled


@dataclass(frozen=True, slots=True)
class PillarSection:
    """A section that is homogeneous along z.

    outlines: from the inside out; none: a film. inside: permittivity within each, down to the next
    smaller one. outside: permittivity around them.
    """

    outlines: tuple[Outline, ...]
    inside: tuple[complex, ...]
    outside: complex


def pillar_section(
    cell: Cell,
    layer: Layer,
    size_um: float,
    wavelength_um: float,
    *,
    grow_um: float = 0.0,
) -> PillarSection:
    """Outlines and permittivities of one layer of a pillar; a hole swaps the materials.

    Args:
        cell, layer: the pillar and one of its sections. size_um: of the shape.
        wavelength_um: in vacuum.
        grow_um: additional width along every pair of edges.
    """

    def eps(material: object) -> complex:
        return materials.index(material, wavelength_um) ** 2  # type: ignore[arg-type]

    pillar = eps(cell.pillar if layer.material is None else layer.material)
    around = eps(cell.fill if layer.between is None else layer.between)
    if cell.shape.hole:
        pillar, around = around, pillar
    width = layer.grow_um + grow_um
    wall = cell.outline(size_um, grow_um=width)
    if layer.coat is None:
        return PillarSection((wall,), (pillar,), around)
    side = -2 if cell.shape.hole else 2  # the coat of a hole lies inside the opening
    coated = cell.outline(size_um, grow_um=width + side * layer.coat_um)
    outlines = (coated, wall) if cell.shape.hole else (wall, coated)
    return PillarSection(outlines, (pillar, eps(layer.coat)), around)


def staircase_layers(cell: Cell, steps: int) -> list[Layer]:
    """Staircase approximation: the sections of a ``cell``, each of a tilted wall cut
    into ``steps`` upright ones of equal height.
    """
    count = steps if cell.sidewall_rad else 1
    layers = []
    for layer, growth in cell.tilted_sections:
        step_um = layer.height_um / count
        for i in range(count):
            step_growth = (i + 0.5 - count / 2) * step_um * cell.width_slope
            width = layer.grow_um + growth + step_growth
            layers.append(replace(layer, height_um=step_um, grow_um=width))
    return layers


def permittivity_coefficients(
    section: PillarSection, cell: Cell, reach: tuple[int, int]
) -> tuple[Array, Array]:
    """Fourier coefficients of eps and 1/eps, exact for every outline.

    Args:
        section: of the pillar. cell: its lattice.
        reach: orders (m, n); the tables run from -2 reach to 2 reach.

    Returns:
        Two (4 reach_x + 1, 4 reach_y + 1) tables, real where they can be.
    """
    periods = cell.lattice.periods_um(cell.pitch_um)
    gx, gy = (
        2 * np.pi / period * np.arange(-2 * r, 2 * r + 1)
        for period, r in zip(periods, reach, strict=True)
    )
    area = cell.lattice.area_um2(cell.pitch_um)
    direct = np.zeros((len(gx), len(gy)), complex)
    inverse = direct.copy()
    centre = 2 * reach[0], 2 * reach[1]
    direct[centre], inverse[centre] = section.outside, 1 / section.outside
    next_permittivities = (*section.inside, section.outside)[1:]
    boundaries = zip(section.outlines, section.inside, next_permittivities, strict=True)
    for outline, inner, outer in boundaries:
        factor = outline.fourier(gx[:, None], gy) / area
        direct += (inner - outer) * factor
        inverse += (1 / inner - 1 / outer) * factor
    return without_rounding(direct), without_rounding(inverse)


def normal_tables(
    outlines: tuple[Outline, ...], cell: Cell, reach: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """Fourier coefficients of the normal field: w nx nx, w ny ny and w nx ny.

    Args:
        outlines: whose boundaries count. cell: its lattice.
        reach: orders (m, n); the tables run from -2 reach to 2 reach.
    """
    radius_um = _disc_radius_um(outlines, cell)
    if radius_um:
        return _disc_normal_tables(radius_um / cell.pitch_um, reach)
    # all that the samples give, so that truncations share them
    sampled_reach = tuple(max(2 * r, _GRID // 2 - 1) for r in reach)
    rows, columns = (
        slice(m - 2 * r, m + 2 * r + 1)
        for m, r in zip(sampled_reach, reach, strict=True)
    )
    tables = _sampled_normals(outlines, cell, (sampled_reach[0], sampled_reach[1]))
    xx, yy, xy = (without_rounding(table[rows, columns]) for table in tables)
    return xx, yy, xy


def _disc_radius_um(outlines: tuple[Outline, ...], cell: Cell) -> float:
    """Radius of a section that is one disc on a square lattice, else 0."""
    if len(outlines) > 1 or len(outlines[0].parts) > 1 or cell.lattice.kind != "square":
        return 0.0
    part = outlines[0].parts[0]
    if not isinstance(part, EllipseArc) or part.half_x_um != part.half_y_um:
        return 0.0
    return part.half_x_um if part.centre_um == (0.0, 0.0) else 0.0


def _disc_normal_tables(
    radius: float, reach: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """Normal field of a disc in closed form: N = n n^T of the radial unit vector n at
    the boundary and outside, (r/R)^2 n n^T inside, where it is smooth at the centre.

    (1 - r^2/R^2) n n^T within the disc has the coefficients a + b cos 2f, b sin 2f,
    a - b cos 2f with Bessel functions a, b of |G| R; f is the direction of G.

    Args:
        radius: of the disc, in pitches. reach: orders (m, n).
    """
    even, odd = _radial_field(2 * reach[0])
    m = np.arange(-2 * reach[0], 2 * reach[0] + 1)
    mx, my = np.meshgrid(m, m, indexing="ij")
    square = mx**2 + my**2
    x = 2 * np.pi * radius * np.sqrt(square)
    small = x < 0.01
    safe = np.where(small, 1.0, x)
    disc_area = np.pi * radius**2
    bessel2 = jv(2, safe)
    a = disc_area * np.where(small, 0.25 - x**2 / 48, 2 * bessel2 / safe**2)
    b = -disc_area * np.where(
        small, x**2 / 96, (2 - 2 * j0(safe) - 4 * bessel2) / safe**2
    )
    cos2, sin2 = (
        product / np.where(square == 0, 1, square)
        for product in (mx**2 - my**2, 2 * mx * my)
    )
    radial = even[np.abs(mx), np.abs(my)]
    radial_xy = odd[np.abs(mx), np.abs(my)] * np.sign(mx) * np.sign(my)
    return radial - a - b * cos2, radial.T - a + b * cos2, radial_xy - b * sin2


@lru_cache(maxsize=32)
def _radial_field(largest_order: int) -> tuple[Array, Array]:
    """Fourier coefficients of x^2/r^2 and x y/r^2 over the unit cell, orders 0 to
    ``largest_order`` on both axes.

    Each eighth of the cell is mapped to a square (x = s, y = s v), where the field
    depends on v alone and the integrand is smooth: Gauss-Legendre is exact to rounding.
    """
    nodes, weights = np.polynomial.legendre.leggauss(3 * largest_order // 2 + 30)
    s, ws = (nodes + 1) / 4, weights / 4
    v, wv = (nodes + 1) / 2, weights / 2
    angle = 2 * np.pi * np.arange(largest_order + 1)
    along = angle[:, None] * s
    across = angle[:, None, None] * (s[:, None] * v)
    area = 4 * ws * s
    weight_x, weight_y = wv / (1 + v * v), wv * v * v / (1 + v * v)  # x > y, and y > x
    even = (np.cos(along) * area) @ (np.cos(across) @ weight_x).T + (
        np.cos(across) @ weight_y
    ) @ (np.cos(along) * area).T
    mixed = (np.sin(along) * area) @ (np.sin(across) @ (wv * v / (1 + v * v))).T
    return even, -(mixed + mixed.T)


@lru_cache(maxsize=16)
def _sampled_normals(
    outlines: tuple[Outline, ...], cell: Cell, reach: tuple[int, int]
) -> tuple[Array, Array, Array]:
    """As :func:`normal_tables`, by the FFT of samples; orders from -reach to reach.

    The weight falls with the distance to the boundary. The coefficients are averaged
    over the mirror images, which cancels rounding.

    Args:
        outlines: whose boundaries count. cell: its lattice.
        reach: orders (m, n).
    """
    x, y = cell.lattice.periods_um(cell.pitch_um)
    counts = [
        max(2 * m + 2, math.ceil(_GRID * edge / min(x, y) - 1e-6))
        for m, edge in zip(reach, (x, y), strict=True)
    ]
    counts = [count + count % 2 for count in counts]
    px, py = np.meshgrid(
        np.arange(counts[0]) * (x / counts[0]),
        np.arange(counts[1]) * (y / counts[1]),
        indexing="ij",
    )
    px, py = px - x * (px > x / 2), py - y * (py > y / 2)
    products, distance = _nearest(outlines, cell, px, py)
    weight = boundary_weight(distance, distance.max())
    mirrors = [
        flip
        for flip in itertools.product((1, -1), repeat=2)
        if all(outline.keeps(*flip) for outline in outlines)
    ]

    def table(values: Array, *, odd: bool = False) -> Array:
        spectrum = np.fft.fft2(values) / values.size
        m, k = (np.arange(-r, r + 1) for r in reach)
        centred = spectrum[m[:, None] % counts[0], k % counts[1]]
        images = [(sx * sy if odd else 1) * centred[::sx, ::sy] for sx, sy in mirrors]
        return np.asarray(np.mean(images, axis=0))

    xx, yy, xy = weight * products
    return table(xx), table(yy), table(xy, odd=True)


def _nearest(
    outlines: tuple[Outline, ...], cell: Cell, px: Array, py: Array
) -> tuple[Array, Array]:
    """(3, ...) products nx nx, ny ny, nx ny of the normal at the nearest boundary
    point, and (...) its distance, um.

    The mean is taken over two points at equal distance. All pillars of the lattice
    count.

    Args:
        outlines: whose boundaries count. cell: its lattice.
        px, py: (...) points in the middle rectangle, um.
    """
    sites = _sites(cell)
    parts = [part for outline in outlines for part in outline.parts]
    if all(isinstance(p, EllipseArc) and p.half_x_um == p.half_y_um for p in parts):
        radii = np.repeat([part.half_x_um for part in parts], len(sites))  # type: ignore[union-attr]
        centres = [part.centre_um + sites for part in parts]  # type: ignore[union-attr]
        return _nearest_circle(np.concatenate(centres), radii, px, py)
    step_um = min(cell.lattice.periods_um(cell.pitch_um)) / 200
    boundaries = [outline.boundary(step_um) for outline in outlines]
    points, normals = (
        np.concatenate(arrays) for arrays in zip(*boundaries, strict=True)
    )
    copies = (points[None] + sites[:, None]).reshape(-1, 2)
    distances, nearest = cKDTree(copies).query(np.stack([px, py], axis=-1), k=2)
    nx, ny = np.tile(normals, (len(sites), 1))[nearest].transpose(3, 0, 1, 2)
    products = np.stack([nx**2, ny**2, nx * ny])
    tie = distances[..., 1] - distances[..., 0] < ROUNDING * cell.pitch_um
    mean = np.where(tie, products.mean(axis=-1), products[..., 0])
    return mean, np.asarray(distances[..., 0])


def _nearest_circle(
    centres: Array, radii: Array, px: Array, py: Array
) -> tuple[Array, Array]:
    """As :func:`_nearest`, for circles, whose normals are radial.

    Circles at equal distance count with their mean. At a centre the products are those
    of a random direction.

    Args:
        centres: (k, 2), um. radii: (k,), um.
        px, py: (...) points, um.
    """
    tie = ROUNDING * radii.min()
    least = np.full(px.shape, np.inf)
    for (x, y), radius in zip(centres, radii, strict=True):
        least = np.minimum(least, np.abs(np.hypot(px - x, py - y) - radius))
    total, count = np.zeros((3, *px.shape)), np.zeros(px.shape)
    for (x, y), radius in zip(centres, radii, strict=True):
        dx, dy = px - x, py - y
        length = np.hypot(dx, dy)
        nearest = np.abs(length - radius) < least + tie
        at_centre = length < tie
        scale = np.where(at_centre, 1.0, length) ** 2
        products = np.stack([dx * dx, dy * dy, dx * dy]) / scale
        products[:2, at_centre] = 0.5
        total, count = total + nearest * products, count + nearest
    return total / count, least


def _sites(cell: Cell) -> Array:
    """(n, 2) the site at the origin and those around it that reach into the middle
    rectangle.
    """
    steps = np.array([(0.0, 0.0), *cell.lattice.steps_um(cell.pitch_um)])
    largest = 1.6 * max(cell.lattice.periods_um(cell.pitch_um))
    return np.asarray(steps[np.abs(steps).max(axis=1) < largest])


def _wrapped(cell: Cell, x_um: Array, y_um: Array) -> tuple[Array, Array]:
    """Points moved by whole periods into the middle rectangle."""
    px, py = cell.lattice.periods_um(cell.pitch_um)
    return x_um - px * np.round(x_um / px), y_um - py * np.round(y_um / py)


def normals_at(
    outlines: tuple[Outline, ...], cell: Cell, x_um: Array, y_um: Array
) -> Array:
    """(3, ...) sampled normal field w nx nx, w ny ny, w nx ny.

    Args:
        outlines: whose boundaries count. cell: its lattice.
        x_um, y_um: (...) points.
    """
    edges = cell.lattice.periods_um(cell.pitch_um)
    axes = (
        np.linspace(-edge / 2, edge / 2, 1 + math.ceil(_GRID * edge / min(edges)))
        for edge in edges
    )
    largest_um = _nearest(outlines, cell, *np.meshgrid(*axes, indexing="ij"))[1].max()
    products, distance = _nearest(outlines, cell, *_wrapped(cell, x_um, y_um))
    return products * boundary_weight(distance, largest_um)


def boundary_weight(distance: Array, largest: float, half: float = 0.5) -> Array:
    """Weight 1 / (1 + (d / d0)^4) of the normals at a distance d from the boundary.

    Args:
        distance: (...) from the boundary. largest: of them in the cell.
        half: d0 over the largest distance, where the weight is 1/2.
    """
    return np.asarray(1 / (1 + (distance / (half * largest)) ** 4))


def permittivity_at(
    section: PillarSection, cell: Cell, x_um: Array, y_um: Array
) -> Array:
    """(...) permittivity of a ``section`` on the lattice of a ``cell`` at the points
    ``x_um``, ``y_um``.
    """
    x, y = _wrapped(cell, x_um, y_um)
    eps = np.full(x.shape, section.outside, complex)
    pairs = zip(reversed(section.outlines), reversed(section.inside), strict=True)
    for outline, inner in pairs:
        for site in _sites(cell):
            eps[outline.inside(x - site[0], y - site[1])] = inner
    return eps


def without_rounding(values: Array) -> Array:
    """``values`` without their imaginary part where it is rounding."""
    rounding = 1e-12 * np.abs(values).max()
    real = np.abs(values.imag).max() <= rounding
    return np.asarray(values.real if real else values)


def section_operators(
    space: ReducedOrders,
    waves: PlaneWaves,
    section: PillarSection,
    cell: Cell,
    normals: tuple[Outline, ...] | None = None,
) -> tuple[Array, Array]:
    """Operators P and Q (see :mod:`metalens.rcwa.basis`) of a section, (n, n) each.

    D = ([[eps]] - (Δ N + N Δ) / 2) E with Δ = [[eps]] - [[1/eps]]^-1 and the normal
    products N, for x and y and their coupling. For Ez, [[eps]]^-1 is used.

    Args:
        space, waves: reduced orders, and their plane waves.
        section: outlines and permittivities. cell: its lattice.
        normals: outlines of the normal field; None: those of the section.
    """
    direct, inverse = permittivity_coefficients(section, cell, space.reach)
    outlines = section.outlines if normals is None else normals
    xx, yy, xy = normal_tables(outlines, cell, space.reach)
    laurent = [toeplitz_matrix(space, direct, link) for link in ("ex", "ey")]
    excess = [
        matrix - np.linalg.inv(toeplitz_matrix(space, inverse, link))
        for matrix, link in zip(laurent, ("ex", "ey"), strict=True)
    ]
    nx, ny, mixed = (
        toeplitz_matrix(space, table, link)
        for table, link in ((xx, "ex"), (yy, "ey"), (xy, "mixed"))
    )
    upper_left = laurent[0] - (excess[0] @ nx + nx @ excess[0]) / 2
    lower_right = laurent[1] - (excess[1] @ ny + ny @ excess[1]) / 2
    upper_right = -(excess[0] @ mixed + mixed @ excess[1]) / 2
    mixed_adjoint = mixed.conj().T
    lower_left = -(excess[1] @ mixed_adjoint + mixed_adjoint @ excess[0]) / 2
    Q = (
        waves.fold.T
        @ np.block([[upper_left, upper_right], [lower_left, lower_right]])
        @ waves.fold
    )
    s_waves = np.arange(waves.p_count, len(waves.kappa))
    Q[s_waves, s_waves] -= waves.kappa[s_waves] ** 2
    P = np.eye(len(waves.kappa), dtype=Q.dtype)
    with_ez = slice(waves.bare, waves.p_count)
    kappa = waves.kappa[with_ez]
    inverse_z = np.linalg.inv(toeplitz_matrix(space, direct, "ez"))
    P[with_ez, with_ez] -= kappa[:, None] * inverse_z * kappa
    return P, Q


def section_modes(
    space: ReducedOrders,
    waves: PlaneWaves,
    section: PillarSection,
    cell: Cell,
    height: float,
    normals: tuple[Outline, ...] | None = None,
) -> FourierModes:
    """Eigenmodes of a section or film.

    Args:
        space, waves, section, cell, normals: as for :func:`section_operators`.
        height: of the section, times k0.
    """
    if not section.outlines:
        return film_modes(waves, complex(np.sqrt(section.outside)), height)
    P, Q = section_operators(space, waves, section, cell, normals)
    return solve_eigenmodes(P, Q, height)
