"""How many nodes, directions, depth basis fields and correction terms a propagation needs, and the operators.

The kernel from a pillar to a window sample, carrier removed, is
K = d/(2πr²)(1/r - ik) exp(ik(r - r_w)) exp(ik(s_z - s_ref)).
It is smooth in everything, so each of its dependencies is sampled just finely enough: every count below is the least
whose Legendre tail on probing lines is under the tolerance. The smaller the window, the smoother the kernel: so the
light on the nodes of the whole window is passed on to the fewer nodes of its tiles.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from metalens.ground import legendre
from metalens.ground.arrays import Array
from metalens.ground.errors import PropagationError
from metalens.ground.paths import longer, source_path
from metalens.propagate.geometry import Case, chief_path, tiles

MOST_NODES = 400
MOST_TABLE = 4e6
EDGE = 8  # by which the error of a truncated series at the corner of a tile, where a PSF may lie, exceeds its mean
PARTS = (1, 2, 3, 4, 6, 8, 12, 16)


@dataclass(frozen=True, slots=True)
class Sizes:
    """Counts chosen for a case and tolerance.

    nodes: (y, x) Legendre nodes over the lens; directions: direction cosines p along x.
    window: (y, x), lens: (row, direction) grids on which the correction is sampled.
    """

    nodes: tuple[int, int]
    directions: int
    window: tuple[int, int]
    lens: tuple[int, int]

    @property
    def table(self) -> int:
        """Size of the table of the correction."""
        return self.window[0] * self.window[1] * self.lens[0] * self.lens[1]


@dataclass(frozen=True, slots=True)
class Layout:
    """nodes: (y, x) over the lens for the whole window; parts: tiles along each axis; sizes: of every tile;
    seconds: expected for all tiles on one core."""

    nodes: tuple[int, int]
    parts: int
    sizes: Sizes
    seconds: float


@dataclass(frozen=True, eq=False, slots=True)
class Depths:
    """Fields on the lens nodes that span the curvatures of all depths.

    basis: (b, e, x); coefficients: (depth, b); strength: (b,).
    """

    basis: Array
    coefficients: Array
    strength: Array


@dataclass(frozen=True, eq=False, slots=True)
class Operators:
    """Arrays of one tile, complex128 and float64; e = lens row nodes, x = lens column nodes, p = directions.

    to_directions: (e, x, p); along_y: (p, Y, e); along_x: (X, p).
    lens_terms: (p, e, r), window_terms: (X, Y, r) of the correction; strength: (r,).
    """

    to_directions: Array
    along_y: Array
    along_x: Array
    lens_terms: Array
    window_terms: Array
    strength: Array


def reference_depth(case: Case) -> float:
    """Inverse depth, 1/um, of the source whose phase is taken off: the middle of the range."""
    inverse = case.inverse_depths_per_um
    return (min(inverse) + max(inverse)) / 2


@functools.lru_cache(maxsize=64)
def layout(case: Case, tolerance: float) -> Layout | None:
    """How the window is cut so that it costs least; None where no cut brings the tables down to some 100 MB.

    Raises:
        PropagationError: more than 400 nodes would be needed; the window is too large for this method.
    """
    nodes = lens_nodes(case, tolerance / 4)
    best = None
    for parts in PARTS:
        if parts > max(case.samples):
            break
        rows = tiles(case, parts)[1]
        found = _largest([sizes(tile, tolerance) for row in (rows[0], rows[-1]) for tile in (row[0], row[-1])])
        passed_on = nodes[0] * nodes[1] * (1e-8 + 2e-10 * found.nodes[0])
        each = _seconds(rows[0][0], found, len(case.inverse_depths_per_um)) + passed_on
        seconds = 1e-3 + each * sum(map(len, rows))
        if found.table <= MOST_TABLE and (best is None or seconds < best.seconds):
            best = Layout(nodes, parts, found, seconds)
        elif best is not None:
            break
    return best


def _largest(found: list[Sizes]) -> Sizes:
    """Counts that do for all."""
    pairs = [tuple(max(getattr(s, name)[i] for s in found) for i in (0, 1)) for name in ("nodes", "window", "lens")]
    return Sizes(pairs[0], max(s.directions for s in found), pairs[1], pairs[2])


def _seconds(case: Case, found: Sizes, depths: int) -> float:
    """Expected time of one tile on one core: light on its own nodes, products along y and x."""
    (my, mx), (ny, nx), b = case.samples, found.nodes, min(depths, 14)
    fields = 0.75 * b * max(found.window)
    products = found.directions * fields * (ny * (4e-9 + 1.8e-10 * my) + 1.5e-10 * mx * my)
    return 2e-5 + products + 5e-9 * b * ny * nx


def lens_nodes(case: Case, tolerance: float) -> tuple[int, int]:
    """(y, x) nodes over the lens that the kernel needs."""
    high_y, high_x = case.half_size_um
    rows = _count(lambda t: _over_lens(case, None, t * high_y), tolerance, "lens rows")
    return rows, _count(lambda t: _over_lens(case, t * high_x, None), tolerance, "lens columns")


def sizes(case: Case, tolerance: float) -> Sizes:
    """The counts that a tile needs.

    Raises:
        PropagationError: more than 400 nodes would be needed.
    """
    share = tolerance / 4
    high_y = case.half_size_um[0]
    nodes = lens_nodes(case, share)
    low, high = direction_range(case, legendre.mapped(nodes[0], -high_y, high_y))
    middle, reach = (low + high) / 2, (high - low) / 2
    directions = _count(lambda t: _over_directions(case, middle + reach * t), share, "directions")
    wy, wx = case.half_window_um
    edge = max(share / EDGE, min(share, 1e-13))  # rounding leaves no smaller tails
    window_x = _count(lambda t: _over_window(case, (low, high), X=t * wx), edge, "window columns")
    window_y = _count(lambda t: _over_window(case, (low, high), Y=t * wy), edge, "window rows")
    lens_p = _count(lambda t: _over_window(case, (low, high), p=middle + reach * t), edge, "correction directions")
    lens_e = _count(lambda t: _over_window(case, (low, high), e=t * high_y), edge, "correction rows")
    return Sizes(nodes, directions, (window_y, window_x), (lens_e, lens_p))


def _count(lines: Callable[[Array], Array], tolerance: float, what: str) -> int:
    count = 32
    while count <= 1.5 * MOST_NODES:
        found = legendre.needed(lines(legendre.nodes(count)[0]), tolerance)
        if found <= min(count, MOST_NODES):
            return max(found, 2)
        count *= 2
    raise PropagationError(
        f"windowed propagation needs more than {MOST_NODES} nodes ({what}); "
        "make the window smaller, or use propagate.exact"
    )


def direction_range(case: Case, rows_um: Array) -> tuple[float, float]:
    """(least, largest) direction cosine p over the lens, for the row nodes given; never of zero width."""
    high_x = case.half_size_um[1]
    edge = np.array([-high_x, high_x]) - case.centre_um[0]
    far = np.concatenate([rows_um, [0.0]]) - case.centre_um[1]
    near = np.abs(far).min()
    p = edge / np.sqrt(edge**2 + np.array([[near**2], [np.abs(far).max() ** 2]]) + case.sensor_distance_um**2)
    low, high = float(p.min()), float(p.max())
    spare = max(1e-9, 1e-6 * (high - low))
    return max(low - spare, -1 + 1e-15), min(high + spare, 1 - 1e-15)


def _probe() -> Array:
    return np.array([-1.0, 0.0, 1.0])


def kernel(case: Case, x: Any, y: Any, X: Any, Y: Any, inverse: Any) -> Array:
    """K of the module's heading, without the pillar's area, at lens (x, y) and window offset (X, Y)."""
    k, d = case.wavenumber, case.sensor_distance_um
    dx, dy = case.centre_um[0] - x, case.centre_um[1] - y
    r_w = np.sqrt(dx * dx + dy * dy + d * d)
    away = longer(r_w, X * X + Y * Y + 2 * (X * dx + Y * dy))
    r = r_w + away
    path = away + source_path(x, y, case.tangents, inverse)
    path = path - source_path(x, y, case.tangents, reference_depth(case))
    return np.asarray(d / (2 * np.pi * r * r) * (1 / r - 1j * k) * np.exp(1j * k * path))


def _over_lens(case: Case, x: Array | None, y: Array | None) -> Array:
    """(line, node) of the kernel along lens columns (x given) or rows (y given)."""
    (hy, hx), (wy, wx) = case.half_size_um, case.half_window_um
    inverse = np.array([min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)])
    other = np.array([-0.9, 0.0, 0.9])
    grid = np.meshgrid(other, _probe() * wx, _probe() * wy, inverse, indexing="ij")
    o, X, Y, v = (g.reshape(-1, 1) for g in grid)
    return kernel(case, o * hx if x is None else x, o * hy if y is None else y, X, Y, v)


def _over_directions(case: Case, p: Array) -> Array:
    """(line, direction) of the window kernel along p at fixed lens rows."""
    (hy, _), (wy, wx) = case.half_size_um, case.half_window_um
    grid = np.meshgrid(np.array([-0.9, 0.0, 0.9]) * hy, _probe() * wx, _probe() * wy, indexing="ij")
    e, X, Y = (g.reshape(-1, 1) for g in grid)
    residual = correction(case, p, e, X, Y)
    q = _cosine_y(case, p, e)
    return np.asarray(residual * np.exp(-1j * case.wavenumber * (p * X + q * Y)))


def _over_window(case: Case, span: tuple[float, float], **line: Array) -> Array:
    """(line, node) of the correction along one of X, Y, p, e, the others on a few probes."""
    (hy, _), (wy, wx) = case.half_size_um, case.half_window_um
    low, high = span
    middle, reach = (low + high) / 2, (high - low) / 2
    probes = {"X": _probe() * wx, "Y": _probe() * wy, "p": middle + reach * _probe(), "e": _probe() * hy}
    names = [n for n in probes if n not in line]
    grid = np.meshgrid(*(probes[n] for n in names), indexing="ij")
    at: dict[str, Any] = {n: g.reshape(-1, 1) for n, g in zip(names, grid, strict=True)} | line
    return correction(case, at["p"], at["e"], at["X"], at["Y"])


def _cosine_y(case: Case, p: Any, e: Any) -> Any:
    """Direction cosine q along y of the ray from lens row e with cosine p to the window centre."""
    far = e - case.centre_um[1]
    return far * np.sqrt(1 - p * p) / np.sqrt(far * far + case.sensor_distance_um**2)


def correction(case: Case, p: Any, e: Any, X: Any, Y: Any) -> Array:
    """Kernel less the plane waves exp(-ik(pX + qY)): d/(2πr²)(1/r - ik) exp(ik(r - r_w + pX + qY))."""
    k, d = case.wavenumber, case.sensor_distance_um
    r, path = _residual(case, p, e, X, Y)
    return np.asarray(d / (2 * np.pi * r * r) * (1 / r - 1j * k) * np.exp(1j * k * path))


def _residual(case: Case, p: Any, e: Any, X: Any, Y: Any) -> tuple[Any, Any]:
    """(r, r - r_w + pX + qY) without cancellation."""
    far = e - case.centre_um[1]
    r_w = np.sqrt((far * far + case.sensor_distance_um**2) / (1 - p * p))
    g = p * X + _cosine_y(case, p, e) * Y
    q = X * X + Y * Y - 2 * r_w * g
    r = np.sqrt(r_w * r_w + q)
    return r, (X * X + Y * Y + g * q / (r + r_w)) / (r + r_w)


def slopes(case: Case, p: Any, e: Any, X: Any, Y: Any) -> Array:
    """(3, …) logarithmic derivatives of the kernel in sensor distance, window centre x and y, at fixed pillar."""
    k, d = case.wavenumber, case.sensor_distance_um
    r, _ = _residual(case, p, e, X, Y)
    far = e - case.centre_um[1]
    r_w = np.sqrt((far * far + d * d) / (1 - p * p))
    radial = 1j * k - 2 / r - 1 / (r * r) / (1 / r - 1j * k)
    along = np.stack(np.broadcast_arrays(d / r, (X - r_w * p) / r, (Y - far) / r))
    out = np.asarray(radial * along)
    out[0] += 1 / d
    return out


def over_blocks(case: Case) -> Callable[[Any, Any], Array]:
    """The kernel at (y, x) of the lens for the corners and the middle of the window and the extreme depths."""
    wy, wx = case.half_window_um
    inverse = np.array([min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)])
    X, Y, v = (g.reshape(-1, 1, 1, 1) for g in np.meshgrid(_probe() * wx, _probe() * wy, inverse, indexing="ij"))
    return lambda y, x: kernel(case, x, y, X, Y, v)


def operators(case: Case, chosen: Sizes, tolerance: float, *, slope: int | None = None) -> Operators:
    """All arrays of a tile; ``slope`` 0, 1, 2 gives the derivative in sensor distance, window centre x, y instead."""
    (ny, nx), m = chosen.nodes, chosen.directions
    high_y, high_x = case.half_size_um
    e, x = legendre.mapped(ny, -high_y, high_y), legendre.mapped(nx, -high_x, high_x)
    low, high = direction_range(case, e)
    p = legendre.mapped(m, low, high)
    far = (e - case.centre_um[1])[:, None]
    across = x - case.centre_um[0]
    cosines = across / np.sqrt(across**2 + far**2 + case.sensor_distance_um**2)
    y_um, x_um = case.window_um
    k = case.wavenumber
    q = _cosine_y(case, p[:, None], e[None, :])
    lens_terms, window_terms, strength = _low_rank(case, chosen, tolerance / 2, (low, high), slope)
    return Operators(
        to_directions=legendre.interpolation(m, (2 * cosines - low - high) / (high - low)),
        along_y=np.exp(-1j * k * y_um[:, None] * q[:, None, :]),
        along_x=np.exp(-1j * k * x_um[:, None] * p),
        lens_terms=lens_terms,
        window_terms=window_terms * np.exp(1j * k * chief_path(case)),
        strength=strength,
    )


def depth_factors(case: Case, e: Any, x: Any, tangents: Any, inverse: Any) -> Any:
    """k(s_z - s_ref) on the lens nodes (depth, e, x), rad; numpy or torch operands."""
    reference = source_path(x, e, case.tangents, reference_depth(case))
    return case.wavenumber * (source_path(x, e, tangents, inverse) - reference)


def depth_basis(case: Case, nodes_um: tuple[Array, Array], tolerance: float, *, moving: bool = False) -> Depths:
    """Few fields that span the curvatures of all depths.

    With ``moving`` they also span the derivatives in inverse depth and tangents. Orthonormal under the quadrature of
    the nodes; truncated at ``tolerance`` root mean square.
    """
    e, x = nodes_um[0][:, None], nodes_um[1]
    weight = np.sqrt(np.outer(legendre.nodes(len(e))[1], legendre.nodes(len(x))[1]))
    inverse = np.array(case.inverse_depths_per_um)
    count = 48
    while True:  # until the rank says that no depth lies between the nodes: they need pi a period, the fields two
        few = len(inverse) > count
        training = np.clip(legendre.mapped(count, inverse.min(), inverse.max()), 0, None) if few else inverse
        fields = np.exp(1j * depth_factors(case, e, x, case.tangents, training[:, None, None])) * weight
        if moving:
            fields = np.concatenate([fields, *_tangents(case, e, x, training[:, None, None], fields)])
        _, size, v = np.linalg.svd(fields.reshape(len(fields), -1), full_matrices=False)
        tail = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1] / (size**2).sum())
        rank = int(max(1, (tail > tolerance).sum()))
        if not few or rank <= 2 / np.pi * count:
            break
        count *= 2
    basis = v[:rank].reshape(rank, len(e), len(x))
    coefficients = np.empty((len(inverse), rank), complex)
    for start in range(0, len(inverse), 16):
        part = inverse[start : start + 16, None, None]
        fields = np.exp(1j * depth_factors(case, e, x, case.tangents, part)) * weight
        coefficients[start : start + 16] = fields.reshape(len(part), -1) @ basis.reshape(rank, -1).conj().T
    return Depths(np.asarray(basis / weight), coefficients, np.asarray(size[:rank] / size[0]))


def _tangents(case: Case, e: Array, x: Array, inverse: Array, fields: Array) -> list[Array]:
    """Derivatives of the depth fields in inverse depth and the tangents, each of the fields' own norm; complex step."""
    out = []
    h = 1e-30
    for step in ((0, 0, 1j * h), (1j * h, 0, 0), (0, 1j * h, 0)):
        tangents = case.tangents[0] + step[0], case.tangents[1] + step[1]
        slope = case.wavenumber * source_path(x, e, tangents, inverse + step[2]).imag / h
        slope = np.broadcast_to(slope, fields.shape)
        scale = np.sqrt((np.abs(slope * fields) ** 2).sum() / (np.abs(fields) ** 2).sum())
        if scale > 0:
            out.append(1j * slope / scale * fields)
    return out


def pairs(strength: Array, size: Array, tolerance: float) -> Array:
    """(2, n) pairs (correction term, depth field) whose joint strength matters; the rest sums below tolerance."""
    joint = (np.outer(strength, size) ** 2).ravel()
    order = np.argsort(joint)
    least = np.cumsum(joint[order]) <= tolerance**2 * joint.sum()
    kept = np.sort(order[~least])
    return np.stack(np.unravel_index(kept, (len(strength), len(size))))


def _low_rank(
    case: Case, chosen: Sizes, tolerance: float, span: tuple[float, float], slope: int | None
) -> tuple[Array, Array, Array]:
    """Correction as Σ_r lens_terms[p, e, r] window_terms[X, Y, r], pillar area included; and strengths (r,)."""
    (wy, wx), (hy, _) = case.half_window_um, case.half_size_um
    (my, mx), (me, mp) = chosen.window, chosen.lens
    Y, X = legendre.mapped(my, -wy, wy), legendre.mapped(mx, -wx, wx)
    e, p = legendre.mapped(me, -hy, hy), legendre.mapped(mp, *span)
    at = (p[:, None], e[None, :], X[:, None, None], Y[:, None, None, None])
    table = correction(case, *at)
    if slope is not None:
        table = table * slopes(case, *at)[slope]
    left, right = _factors(table.reshape(my * mx, mp * me) * case.pitch_um**2, tolerance)
    y_um, x_um = case.window_um
    Iy, Ix = legendre.interpolation(my, y_um / wy), legendre.interpolation(mx, x_um / wx)
    window_terms = np.einsum("Yj,jir,Xi->XYr", Iy, left.reshape(my, mx, -1), Ix, optimize=True)
    e_um = legendre.nodes(chosen.nodes[0])[0]
    p_um = legendre.nodes(chosen.directions)[0]
    Ie, Ip = legendre.interpolation(me, e_um), legendre.interpolation(mp, p_um)
    lens_terms = np.einsum("Pp,rpe,Ee->PEr", Ip, right.reshape(-1, mp, me), Ie, optimize=True)
    return lens_terms, window_terms, np.linalg.norm(left, axis=0)


def _factors(table: Array, tolerance: float) -> tuple[Array, Array]:
    """table ≈ left (row, r) @ right (r, column) within ``tolerance`` in the Frobenius norm; randomised range finder."""
    random = np.random.default_rng(0)
    total = np.linalg.norm(table)
    rank = min(16, *table.shape)
    while True:
        left = np.linalg.qr(table @ random.standard_normal((table.shape[1], rank)))[0]
        right = left.conj().T @ table
        if rank == min(table.shape) or np.linalg.norm(table - left @ right) <= tolerance * total / 4:
            break
        rank = min(2 * rank, *table.shape)
    u, size, v = np.linalg.svd(right, full_matrices=False)
    tail = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1]) / total
    keep = int(max(1, (tail > tolerance).sum()))
    return left @ u[:, :keep] * size[:keep], v[:keep]
