"""Windowed propagation: only the field on the sensor window, from Legendre moments of
the lens.
"""

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.core.threads import one_blas_thread
from metalens.propagate.geometry import PropagationCase, window_tiles
from metalens.propagate.moments import (
    PillarMoments,
    Pupils,
    mix_components,
    plan_moments,
    reduce_to_moments,
)
from metalens.propagate.paths import (
    chief_path,
    cosine_y,
    direction_range,
    from_source,
    over_blocks,
    plane_wave_residual,
    probe_positions,
    ray_cosines,
    rayleigh_sommerfeld_kernel,
    reference_depth,
    to_sensor,
)

MOST_NODES = 400


MOST_TABLE = 4e6


# ratio of the error of a truncated series at the corner of a tile, where a PSF may lie,
# to its mean
EDGE = 8


MOST_PARTS = 16  # tiles along an axis


@dataclass(frozen=True, slots=True)
class NodeCounts:
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
class WindowLayout:
    """Nodes and tiles of a windowed propagation.

    nodes: (y, x) over the lens for the whole window. parts: tiles along each axis.
    sizes: counts of every tile.
    """

    nodes: tuple[int, int]
    parts: int
    sizes: NodeCounts


@functools.lru_cache(maxsize=1024)
def plan_layout(case: PropagationCase, tolerance: float) -> WindowLayout:
    """Nodes over the lens and tiles of the window.

    With more tiles along an axis the work on the window falls, and that of passing
    light to the tiles rises. Their sum is least for about √nodes / 4 tiles.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.

    Raises:
        PropagationError: more than 400 nodes, or tables of over 100 MB, would be
            needed: the window is too large for this method.
    """
    nodes = lens_nodes(case, tolerance / 4)
    parts = max(1, round(math.sqrt(max(nodes)) / 4))
    most_parts = min(MOST_PARTS, max(case.samples))
    while True:
        parts = min(parts, most_parts)
        rows = window_tiles(case, parts)[1]
        tiles = [tile for row in (rows[0], rows[-1]) for tile in (row[0], row[-1])]
        # the tile below the lens is seen under the largest angle
        tiles.append(
            min(itertools.chain(*rows), key=lambda t: math.hypot(*t.centre_um))
        )
        judged = {_mirrored(tile) for tile in tiles}
        try:
            sizes = _largest_counts([node_counts(tile, tolerance) for tile in judged])
        except PropagationError:
            if parts == most_parts:
                raise
        else:
            if sizes.table <= MOST_TABLE:
                return WindowLayout(nodes, parts, sizes)
            if parts == most_parts:
                raise _too_large("a table of over 100 MB")
        parts *= 2


def _mirrored(tile: PropagationCase) -> PropagationCase:
    """The tile with its centre mirrored to positive coordinates, along every axis
    without a source tangent.

    By symmetry the mirror image needs the same counts.
    """
    x, y = (
        abs(centre) if tangent == 0 else centre
        for centre, tangent in zip(tile.centre_um, tile.tangents, strict=True)
    )
    return replace(tile, centre_um=(x, y))


def _largest_counts(counts: list[NodeCounts]) -> NodeCounts:
    """Elementwise maximum of the counts."""
    largest_pairs = [
        tuple(max(getattr(c, name)[i] for c in counts) for i in (0, 1))
        for name in ("nodes", "window", "lens")
    ]
    return NodeCounts(
        largest_pairs[0],
        max(c.directions for c in counts),
        largest_pairs[1],
        largest_pairs[2],
    )


def lens_nodes(case: PropagationCase, tolerance: float) -> tuple[int, int]:
    """(y, x) nodes over the lens that the kernel needs.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.
    """
    extremes = min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)
    lines = functools.partial(
        _needed_nodes,
        functools.partial(rayleigh_sommerfeld_kernel, case),
        {
            "x": 0.9 * _around(0.0, case.half_size_um[1]),
            "y": 0.9 * _around(0.0, case.half_size_um[0]),
            "X": _around(0.0, case.half_window_um[1]),
            "Y": _around(0.0, case.half_window_um[0]),
            "inverse": np.array(extremes),
        },
        tolerance=tolerance,
    )
    high_y, high_x = case.half_size_um
    return lines("y", (0.0, high_y)), lines("x", (0.0, high_x))


def node_counts(case: PropagationCase, tolerance: float) -> NodeCounts:
    """The counts that a tile needs.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.

    Raises:
        PropagationError: more than 400 nodes would be needed.
    """
    quarter = tolerance / 4
    high_y = case.half_size_um[0]
    nodes = lens_nodes(case, quarter)
    row_nodes = legendre.mapped_nodes(nodes[0], -high_y, high_y)
    low, high = direction_range(case, row_nodes)
    spans = {
        "X": (0.0, case.half_window_um[1]),
        "Y": (0.0, case.half_window_um[0]),
        "p": ((low + high) / 2, (high - low) / 2),
        "e": (0.0, high_y),
    }
    probes = {name: _around(*span) for name, span in spans.items()}

    def kernel(p: Any, e: Any, X: Any, Y: Any) -> Array:
        """From a lens row to a window point, along the direction cosine p."""
        residual = plane_wave_residual(case, p, e, X, Y)
        q = cosine_y(case, p, e)
        return np.asarray(residual * np.exp(-1j * case.wavenumber * (p * X + q * Y)))

    rows = probes | {"e": 0.9 * probes["e"]}
    directions = _needed_nodes(kernel, rows, "p", spans["p"], tolerance=quarter)
    # rounding leaves no smaller tails than 1e-13
    edge_tolerance = max(quarter / EDGE, min(quarter, 1e-13))
    residual = functools.partial(plane_wave_residual, case)
    sizes = {
        name: _needed_nodes(residual, probes, name, span, tolerance=edge_tolerance)
        for name, span in spans.items()
    }
    return NodeCounts(
        nodes, directions, (sizes["Y"], sizes["X"]), (sizes["e"], sizes["p"])
    )


def _around(middle: float, half: float) -> Array:
    """Positions along an axis at which a smooth function is sampled."""
    return middle + half * probe_positions()


def _needed_nodes(
    function: Callable[..., Array],
    probes: dict[str, Array],
    along: str,
    span: tuple[float, float],
    *,
    tolerance: float,
) -> int:
    """Legendre nodes that interpolate a function along one variable.

    The number of trial nodes is doubled until it suffices on every line through the
    probes of the other variables.

    Args:
        function: of the named variables, which broadcast.
        probes: values of every variable.
        along: name of the variable.
        span: its middle and half range.
        tolerance: relative error of the interpolation.

    Raises:
        PropagationError: more than 400 nodes.
    """
    others = [name for name in probes if name != along]
    grid = np.meshgrid(*(probes[name] for name in others), indexing="ij")
    at = {name: g.reshape(-1, 1) for name, g in zip(others, grid, strict=True)}
    count = 32
    while count <= 1.5 * MOST_NODES:
        line = span[0] + span[1] * legendre.gauss_legendre_nodes(count)[0]
        values = function(**at, **{along: line})
        needed = legendre.needed_node_count(values, tolerance)
        if needed <= min(count, MOST_NODES):
            return max(needed, 2)
        count *= 2
    raise _too_large(f"more than {MOST_NODES} nodes along {along}")


def _too_large(need: str) -> PropagationError:
    return PropagationError(
        f"windowed propagation needs {need}; make the window smaller, or use propagate.exact"
    )


@dataclass(frozen=True, eq=False, slots=True)
class DepthBasis:
    """Fields on the lens nodes that span the curvatures of all depths.

    basis: (b, e, x); coefficients: (depth, b); strength: (b,).
    """

    basis: Array
    coefficients: Array
    strength: Array


def depth_factors(
    case: PropagationCase, e: Any, x: Any, tangents: Any, inverse: Any
) -> Any:
    """k(s_z - s_ref) on the lens nodes (depth, e, x), rad; numpy or torch operands.

    Args:
        case: geometry of the propagation.
        tangents: (x, y) of the field angle, in air.
        inverse: 1 / depth of the source, 1/um.
    """
    reference = from_source(case, x, e, case.tangents, reference_depth(case))
    return case.wavenumber * (from_source(case, x, e, tangents, inverse) - reference)


def depth_basis(
    case: PropagationCase, nodes_um: tuple[Array, Array], tolerance: float
) -> DepthBasis:
    """Orthonormal basis of the lens fields exp(i k (s_z - s_ref)) of all depths, by a
    truncated SVD.

    Orthonormal under the quadrature of the nodes.

    Args:
        case: geometry of the propagation.
        nodes_um: (e,) and (x,) positions on the lens.
        tolerance: relative root mean square error of the truncation.
    """
    e, x = nodes_um[0][:, None], nodes_um[1]
    weight = np.sqrt(
        np.outer(
            legendre.gauss_legendre_nodes(len(e))[1],
            legendre.gauss_legendre_nodes(len(x))[1],
        )
    )
    inverse = np.array(case.inverse_depths_per_um)
    count = 48
    # Depth nodes are doubled until the rank shows that they resolve all depths: nodes
    # need pi a period, the fields two.
    while True:
        is_sampled = len(inverse) > count
        samples = inverse
        if is_sampled:
            samples = legendre.mapped_nodes(count, inverse.min(), inverse.max())
            samples = np.clip(samples, 0, None)
        samples = samples[:, None, None]
        fields = np.exp(1j * depth_factors(case, e, x, case.tangents, samples)) * weight
        _, singular, right = np.linalg.svd(
            fields.reshape(len(fields), -1), full_matrices=False
        )
        tail = np.sqrt(np.cumsum(singular[::-1] ** 2)[::-1] / (singular**2).sum())
        rank = int(max(1, (tail > tolerance).sum()))
        if not is_sampled or rank <= 2 / np.pi * count:
            break
        count *= 2
    basis = right[:rank].reshape(rank, len(e), len(x))
    coefficients = np.empty((len(inverse), rank), complex)
    for start in range(0, len(inverse), 16):
        chunk = inverse[start : start + 16, None, None]
        fields = np.exp(1j * depth_factors(case, e, x, case.tangents, chunk)) * weight
        coefficients[start : start + 16] = (
            fields.reshape(len(chunk), -1) @ basis.reshape(rank, -1).conj().T
        )
    return DepthBasis(
        np.asarray(basis / weight),
        coefficients,
        np.asarray(singular[:rank] / singular[0]),
    )


def significant_pairs(strength: Array, size: Array, tolerance: float) -> Array:
    """(2, n) pairs (correction term, depth field) with a significant product of
    strengths.

    The omitted pairs sum to less than the tolerance, root mean square.

    Args:
        strength: (r,) of the correction terms.
        size: (b,) of the depth fields.
        tolerance: relative, in the root mean square.
    """
    joint = (np.outer(strength, size) ** 2).ravel()
    order = np.argsort(joint)
    negligible = np.cumsum(joint[order]) <= tolerance**2 * joint.sum()
    significant = np.sort(order[~negligible])
    return np.stack(np.unravel_index(significant, (len(strength), len(size))))


def _operators(
    case: PropagationCase, chosen: NodeCounts, tolerance: float
) -> dict[str, Array]:
    """Operators of a tile: lens nodes to directions, and directions to the window.

    Args:
        case: geometry of the tile.
        chosen: counts of nodes and directions.
        tolerance: relative error of the field.

    Returns:
        ``to_directions`` (e, x, p) from lens row and column nodes to directions;
        ``along_y`` (p, Y, e) and ``along_x`` (X, p) plane waves; ``lens_terms``
        (p, e, r) and ``window_terms`` (X, Y, r) of the correction, and their
        ``strength`` (r,).
    """
    ny, nx = chosen.nodes
    directions = chosen.directions
    high_y, high_x = case.half_size_um
    e = legendre.mapped_nodes(ny, -high_y, high_y)
    x = legendre.mapped_nodes(nx, -high_x, high_x)
    low, high = direction_range(case, e)
    p = legendre.mapped_nodes(directions, low, high)
    row_offset = (e - case.centre_um[1])[:, None]
    cosines = ray_cosines(case, x - case.centre_um[0], row_offset)
    y_um, x_um = case.window_um
    k = case.wavenumber
    q = cosine_y(case, p[:, None], e[None, :])
    lens_terms, window_terms, strength = _low_rank(
        case, chosen, tolerance / 2, (low, high)
    )
    return {
        "to_directions": legendre.interpolation_matrix(
            directions, (2 * cosines - low - high) / (high - low)
        ),
        "along_y": np.exp(-1j * k * y_um[:, None] * q[:, None, :]),
        "along_x": np.exp(-1j * k * x_um[:, None] * p),
        "lens_terms": lens_terms,
        "window_terms": window_terms * np.exp(1j * k * chief_path(case)),
        "strength": strength,
    }


def _low_rank(
    case: PropagationCase,
    chosen: NodeCounts,
    tolerance: float,
    span: tuple[float, float],
) -> tuple[Array, Array, Array]:
    """Low-rank factors of the correction times the pillar area: Σ_r lens_terms[p, e, r]
    window_terms[X, Y, r].

    The correction is tabulated on small Legendre grids, factorised, and interpolated.

    Args:
        case: geometry of the propagation.
        chosen: counts of the grids.
        tolerance: relative error in the Frobenius norm.
        span: lowest and highest direction cosine p.

    Returns:
        lens_terms (p, e, r), window_terms (X, Y, r) and strengths (r,).
    """
    wy, wx = case.half_window_um
    hy, _ = case.half_size_um
    my, mx = chosen.window
    me, mp = chosen.lens
    Y = legendre.mapped_nodes(my, -wy, wy)
    X = legendre.mapped_nodes(mx, -wx, wx)
    e = legendre.mapped_nodes(me, -hy, hy)
    p = legendre.mapped_nodes(mp, *span)
    positions = (p[:, None], e[None, :], X[:, None, None], Y[:, None, None, None])
    table = plane_wave_residual(case, *positions)
    left, right = _randomized_svd(
        table.reshape(my * mx, mp * me) * case.area_um2, tolerance
    )
    y_um, x_um = case.window_um
    Iy = legendre.interpolation_matrix(my, y_um / wy)
    Ix = legendre.interpolation_matrix(mx, x_um / wx)
    window_terms = np.einsum(
        "Yj,jir,Xi->XYr", Iy, left.reshape(my, mx, -1), Ix, optimize=True
    )
    e_um = legendre.gauss_legendre_nodes(chosen.nodes[0])[0]
    p_um = legendre.gauss_legendre_nodes(chosen.directions)[0]
    Ie = legendre.interpolation_matrix(me, e_um)
    Ip = legendre.interpolation_matrix(mp, p_um)
    lens_terms = np.einsum(
        "Pp,rpe,Ee->PEr", Ip, right.reshape(-1, mp, me), Ie, optimize=True
    )
    return lens_terms, window_terms, np.linalg.norm(left, axis=0)


def _randomized_svd(table: Array, tolerance: float) -> tuple[Array, Array]:
    """Factors of table ≈ left (row, r) @ right (r, column), by a randomised SVD.

    The range is sampled with random vectors, doubled in number until they capture it.

    Args:
        table: (row, column).
        tolerance: relative error in the Frobenius norm.
    """
    generator = np.random.default_rng(0)
    total = np.linalg.norm(table)
    rank = min(16, *table.shape)
    while True:
        left = np.linalg.qr(table @ generator.standard_normal((table.shape[1], rank)))[
            0
        ]
        right = left.conj().T @ table
        if (
            rank == min(table.shape)
            or np.linalg.norm(table - left @ right) <= tolerance * total / 4
        ):
            break
        rank = min(2 * rank, *table.shape)
    u, singular, v = np.linalg.svd(right, full_matrices=False)
    tail = np.sqrt(np.cumsum(singular[::-1] ** 2)[::-1]) / total
    needed = int(max(1, (tail > tolerance).sum()))
    return left @ u[:, :needed] * singular[:needed], v[:needed]


# additional nodes over the lens, and in a block, where smooth factors (``Pupils``)
# multiply the light
SMOOTH = (4, 2)


MORE = 8  # additional orders of the moments, for the posterior error


BUDGET_BYTES = 8e6  # of the operands of one product: larger blocks leave the cache


@dataclass(frozen=True, eq=False, slots=True)
class WindowPlan:
    """Everything that depends on the geometry alone, ready for many lenses.

    The moments go ``MORE`` orders beyond what the method uses, for the error estimate.
    tensors: the operators, those of the tiles stacked (tile, …); ``turn`` (tile, e, x)
    is the phase between the window's centre and the tile's, on the nodes of the whole
    window.
    """

    case: PropagationCase
    tolerance: float
    layout: WindowLayout
    depths: DepthBasis
    moments: PillarMoments
    tensors: dict[str, torch.Tensor]

    @property
    def nodes_um(self) -> tuple[Array, Array]:
        """(e,), (x,) positions of the lens nodes of the tiles."""
        return _nodes_um(self.case, self.layout.sizes.nodes)

    @property
    def whole_um(self) -> tuple[Array, Array]:
        """(e,), (x,) positions of the lens nodes of the whole window."""
        return _nodes_um(self.case, self.layout.nodes)

    @property
    def judged_um(self) -> tuple[Array, Array]:
        """(e,), (x,) positions of the nodes of all its moments, ``MORE`` than for the
        whole window.
        """
        ny, nx = self.layout.nodes
        return _nodes_um(self.case, (ny + MORE, nx + MORE))


@functools.lru_cache(maxsize=64)
def plan_window(
    case: PropagationCase, tolerance: float, dtype: torch.dtype, *, smooth: bool = False
) -> WindowPlan:
    """Plan of a windowed propagation; the last 64 are cached.

    Args:
        case, tolerance: geometry, and relative error of the field.
        dtype: of the maps; sums over blocks of pillars are in float64.
        smooth: with factors (``Pupils``) on the light of the nodes.

    Raises:
        PropagationError: the window is too large for the method.
    """
    with one_blas_thread():
        layout = plan_layout(case, tolerance)
        lens, inside = SMOOTH if smooth else (0, 0)
        ny, nx = (n + lens for n in layout.nodes)
        layout = replace(layout, nodes=(ny, nx))
        reference = reference_depth(case)
        pillars = plan_moments(
            case,
            reference,
            tuple(
                functools.partial(_legendre_basis, n + MORE, half_um)
                for n, half_um in zip((ny, nx), case.half_size_um, strict=True)
            ),
            over_blocks(case),
            tolerance=tolerance,
            dtype=dtype,
            more=inside,
        )
        depths = depth_basis(case, _nodes_um(case, layout.sizes.nodes), tolerance / 2)
        tensors = _window_tensors(case, layout, depths) | _tile_tensors(
            case, layout, depths, tolerance
        )
    return WindowPlan(case, tolerance, layout, depths, pillars, tensors)


def _legendre_basis(count: int, half_um: float, places_um: Array) -> Array:
    """(place, count) Legendre polynomials over an axis of the lens."""
    return legendre.legendre_values(count, places_um / half_um)


def _nodes_um(case: PropagationCase, counts: tuple[int, int]) -> tuple[Array, Array]:
    """(e,), (x,) positions of Legendre nodes on the lens, um; counts: (y, x)."""
    e, x = (
        np.asarray(legendre.mapped_nodes(count, -half_um, half_um))
        for count, half_um in zip(counts, case.half_size_um, strict=True)
    )
    return e, x


def _window_tensors(
    case: PropagationCase, layout: WindowLayout, depths: DepthBasis
) -> dict[str, torch.Tensor]:
    """Tensors of the whole window, complex128.

    ``rows_to_nodes``, ``columns_to_nodes``: moments to window nodes. ``rows_to_tile``,
    ``columns_to_tile``: window nodes to tile nodes. ``turn``: phases of the tiles.
    ``basis``, ``coefficients``: of the depths.
    """
    arrays = {"basis": depths.basis, "coefficients": depths.coefficients}
    for name, window_count, tile_count in zip(
        ("rows", "columns"), layout.nodes, layout.sizes.nodes, strict=True
    ):
        arrays[f"{name}_to_nodes"] = legendre.to_nodes(window_count)
        arrays[f"{name}_to_tile"] = legendre.interpolation_matrix(
            tile_count, legendre.gauss_legendre_nodes(window_count)[0]
        )
    e, x = _nodes_um(case, layout.nodes)
    parts = [part for row in window_tiles(case, layout.parts)[1] for part in row]
    paths = [to_sensor(one_case, x, e[:, None]) for one_case in (case, *parts)]
    arrays["turn"] = np.exp(1j * case.wavenumber * (np.stack(paths[1:]) - paths[0]))
    return {name: torch.tensor(a, dtype=torch.complex128) for name, a in arrays.items()}


def _tile_tensors(
    case: PropagationCase, layout: WindowLayout, depths: DepthBasis, tolerance: float
) -> dict[str, torch.Tensor]:
    """Operators of all tiles, stacked (tile, …), for all significant pairs.

    A pair is a correction term and a depth field. ``fields`` holds the depth field of
    each pair.

    Args:
        case: geometry of the propagation.
        layout: tiles and counts.
        depths: basis of the depth fields.
        tolerance: relative error of the field.
    """
    tiles = [tile for row in window_tiles(case, layout.parts)[1] for tile in row]
    of_tiles = [_operators(tile, layout.sizes, tolerance) for tile in tiles]
    terms = max(len(operators["strength"]) for operators in of_tiles)
    for operators in of_tiles:
        for name in ("strength", "lens_terms", "window_terms"):
            operators[name] = _padded(operators[name], terms)
    arrays = {n: np.stack([tile[n] for tile in of_tiles]) for n in of_tiles[0]}
    strength = arrays.pop("strength").max(0)
    pairs = significant_pairs(strength, depths.strength, tolerance / 2)
    for name in ("lens_terms", "window_terms"):
        arrays[name] = np.ascontiguousarray(arrays[name][..., pairs[0]])
    to_directions = arrays.pop("to_directions")
    tensors = {
        name: torch.tensor(a, dtype=torch.complex128) for name, a in arrays.items()
    }
    tensors["to_directions"] = torch.tensor(to_directions).flatten(0, 1)
    tensors["fields"] = torch.tensor(pairs[1])
    return tensors


def _padded(array: Array, count: int) -> Array:
    """Array with zeros appended to ``count`` along the last axis."""
    return np.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, count - array.shape[-1])])


def field_windowed(
    phase_rad: torch.Tensor, transmission: torch.Tensor, plan: WindowPlan
) -> torch.Tensor:
    """(depth, y, x) complex field on the window, differentiable once in both maps.

    Args:
        phase_rad, transmission: (y, x) maps. plan: of :func:`plan_window`.
    """
    moments, _ = reduce_to_moments(phase_rad, transmission, plan.moments)
    return _from_nodes(_on_nodes(moments, plan), plan)


def light_windowed(
    maps: tuple[torch.Tensor, torch.Tensor], plan: WindowPlan, pupils: Pupils | None
) -> tuple[torch.Tensor, Array, list[float]]:
    """Irradiance on the window, Σ_c sign_c |field_c|², differentiable once.

    Args:
        maps: (map, y, x) phase in rad, and transmission.
        plan: of :func:`plan_window`.
        pupils: factors on the light of the maps, for a ``smooth`` plan; None for the
            |U|² of one map.

    Returns:
        Irradiance (depth, y, x); light of every map on the nodes of the posterior
        error; sums of squares of the transmissions.
    """
    reduced = [
        reduce_to_moments(phase, transmission, plan.moments)
        for phase, transmission in zip(*maps, strict=True)
    ]
    moments = torch.stack([one_map for one_map, _ in reduced])
    powers = [power for _, power in reduced]
    parts = mix_components(_on_nodes(moments, plan), pupils, plan.whole_um)
    total: Any = 0
    for sign, light in parts:
        field = _from_nodes(light, plan)
        total = total + sign * (field.real**2 + field.imag**2)
    m, n = moments.shape[-2:]
    with one_blas_thread():
        rows, columns = legendre.to_nodes(m).T, legendre.to_nodes(n)
        return total, rows @ moments.detach().numpy() @ columns, powers


def _on_nodes(gathered: torch.Tensor, plan: WindowPlan) -> torch.Tensor:
    """(…, e, x) light on the nodes of the whole window from moments (…, m, n)."""
    ny, nx = plan.layout.nodes
    return (
        plan.tensors["rows_to_nodes"].T
        @ gathered[..., :ny, :nx]
        @ plan.tensors["columns_to_nodes"]
    )


def _from_nodes(light: torch.Tensor, plan: WindowPlan) -> torch.Tensor:
    """(depth, y, x) field on the window from the light on the window's lens nodes.

    Args:
        light: (e, x) complex.
        plan: of :func:`plan_window`.
    """
    tensors = plan.tensors
    tile_light = (
        tensors["rows_to_tile"].T
        @ (light * tensors["turn"])
        @ tensors["columns_to_tile"]
    )
    fields = zoom_to_tiles(tile_light[:, None] * tensors["basis"], tensors)
    at_depths = fields @ tensors["coefficients"].T  # (tile, X, Y, depth)
    return _join_tiles(at_depths.permute(0, 3, 2, 1), plan)


def _join_tiles(field: torch.Tensor, plan: WindowPlan) -> torch.Tensor:
    """(depth, y, x) field of the window from its overlapping tiles (tile, depth, Y, X).

    Each tile is cut where the next one begins.
    """
    (rows, columns), _ = window_tiles(plan.case, plan.layout.parts)
    my, mx = plan.case.samples
    n = len(columns)
    heights = np.diff([*rows, my]).tolist()
    widths = np.diff([*columns, mx]).tolist()
    bands = [
        torch.cat(
            [field[i * n + j, :, :height, :width] for j, width in enumerate(widths)], -1
        )
        for i, height in enumerate(heights)
    ]
    return torch.cat(bands, -2)


def zoom_to_tiles(light: torch.Tensor, t: dict[str, torch.Tensor]) -> torch.Tensor:
    """Propagate fields on the lens nodes to the window of their tile: (tile, b, e, x)
    to (tile, X, Y, b).

    Columns x are interpolated to directions p. Then each pair of a correction term and
    a depth field is summed over p and e with its plane waves.

    Args:
        light: (tile, b, e, x) complex; b counts the depth fields.
        t: tensors of the tiles.
    """
    tiles, b, e, _ = light.shape
    p = t["to_directions"].shape[2]
    X, Y = t["window_terms"].shape[1:3]
    parts = (
        torch.view_as_real(light).permute(0, 2, 1, 4, 3).reshape(tiles * e, 2 * b, -1)
    )
    cosines = (
        torch.bmm(parts, t["to_directions"])
        .view(tiles, e, b, 2, p)
        .permute(0, 4, 1, 2, 3)
        .contiguous()
    )
    spread = torch.view_as_complex(cosines)
    pairs = len(t["fields"])
    pairs_at_once = max(1, int(BUDGET_BYTES / (p * (Y + e) * light.element_size())))
    pair_step = min(pairs, pairs_at_once)
    tiles_at_once = max(1, pairs_at_once // pairs)
    windows = []
    for first in range(0, tiles, tiles_at_once):
        tile = slice(first, first + tiles_at_once)
        window = light.new_zeros((len(spread[tile]), X, Y, b))
        for start in range(0, pairs, pair_step):
            fields = t["fields"][start : start + pair_step]
            terms = t["lens_terms"][tile, ..., start : start + pair_step] * spread[
                tile
            ].index_select(3, fields)
            columns = t["along_y"][tile].flatten(0, 1) @ terms.flatten(0, 1)
            contribution = (t["along_x"][tile] @ columns.view(len(window), p, -1)).view(
                len(window), X, Y, -1
            )
            window = window.index_add(
                3,
                fields,
                contribution * t["window_terms"][tile, ..., start : start + pair_step],
            )
        windows.append(window)
    return torch.cat(windows)
