"""Windowed propagation: only the field on the sensor window, from Legendre moments of
the lens.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.linalg import interpolative

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.core.threads import one_blas_thread
from metalens.propagate.geometry import PropagationCase, window_tiles
from metalens.propagate.moments import PillarMoments, plan_moments, reduce_to_moments
from metalens.propagate.paths import (
    chief_path,
    from_source,
    over_blocks,
    ray_cosines,
    ray_to_offset,
    rayleigh_sommerfeld_kernel,
    reference_depth,
    to_sensor,
)

MOST_NODES = 400  # along an axis of the lens or of a tile
MOST_TABLE = 4e6  # entries of the correction of a tile
# ratio of the error of a truncated series at the corner of a tile, where a PSF may lie,
# to its mean
EDGE = 8
MOST_PARTS = 16  # tiles along an axis


@dataclass(frozen=True, slots=True)
class TileCounts:
    """Legendre nodes that a tile needs, each (y, x).

    nodes: over the lens, for its light. window, lens: grids on which the correction of
    the plane waves is sampled.
    """

    nodes: tuple[int, int]
    window: tuple[int, int]
    lens: tuple[int, int]


@dataclass(frozen=True, slots=True)
class WindowLayout:
    """Nodes and tiles of a windowed propagation.

    nodes: (y, x) over the lens for the whole window. parts: tiles along each axis.
    counts: of every tile.
    """

    nodes: tuple[int, int]
    parts: int
    counts: TileCounts


@functools.lru_cache(maxsize=1024)
def plan_layout(case: PropagationCase, tolerance: float) -> WindowLayout:
    """Nodes over the lens and tiles of the window.

    With more tiles along an axis the work on the window falls, and that of passing
    light to the tiles rises. Their sum is least for about √nodes / 2.5 tiles.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.

    Raises:
        PropagationError: more than 400 nodes, or tables of over 100 MB, would be
            needed: the window is too large for this method.
    """
    nodes = lens_nodes(case, tolerance / 4)
    parts = max(1, round(math.sqrt(max(nodes)) / 2.5))
    most_parts = min(MOST_PARTS, max(case.samples))
    while True:
        parts = min(parts, most_parts)
        rows = window_tiles(case, parts)
        tiles = {tile for row in (rows[0], rows[-1]) for tile in (row[0], row[-1])}
        # the tile below the lens is seen under the largest angle
        tiles.add(min(itertools.chain(*rows), key=lambda t: math.hypot(*t.centre_um)))
        try:
            of_tiles = [tile_counts(tile, tolerance) for tile in tiles]
        except PropagationError:
            if parts == most_parts:
                raise
        else:
            pairs = [
                np.max([getattr(counts, name) for counts in of_tiles], axis=0).tolist()
                for name in ("nodes", "window", "lens")
            ]
            if math.prod(pairs[1] + pairs[2]) <= MOST_TABLE:
                return WindowLayout(nodes, parts, TileCounts(*map(tuple, pairs)))
            if parts == most_parts:
                raise _too_large("a table of over 100 MB")
        parts *= 2


def lens_nodes(case: PropagationCase, tolerance: float) -> tuple[int, int]:
    """(y, x) nodes over the lens that the kernel needs.

    Args:
        case: geometry of the propagation.
        tolerance: relative error of the field.
    """
    extremes = min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)
    kernel = functools.partial(rayleigh_sommerfeld_kernel, case)
    probes = _probes(case, 0.9) | {"inverse": np.array(extremes)}
    high_y, high_x = case.half_size_um
    return (
        _needed_nodes(kernel, probes, "y", high_y, tolerance),
        _needed_nodes(kernel, probes, "x", high_x, tolerance),
    )


def tile_counts(case: PropagationCase, tolerance: float) -> TileCounts:
    """The counts that a tile needs.

    Args:
        case: geometry of the tile.
        tolerance: relative error of the field.

    Raises:
        PropagationError: more than 400 nodes would be needed.
    """
    quarter = tolerance / 4
    # rounding leaves no smaller tails than 1e-13
    edge_tolerance = max(quarter / EDGE, min(quarter, 1e-13))
    residual, probes = functools.partial(_residual_kernel, case), _probes(case, 1.0)
    axes = zip("YXyx", (*case.half_window_um, *case.half_size_um), strict=True)
    counts = [
        _needed_nodes(residual, probes, name, half_um, edge_tolerance)
        for name, half_um in axes
    ]
    return TileCounts(
        lens_nodes(case, quarter), (counts[0], counts[1]), (counts[2], counts[3])
    )


def _probes(case: PropagationCase, part: float) -> dict[str, Array]:
    """Positions on lens (x, y) and window (X, Y) at which functions are sampled, um:
    middle and ends, those of the lens at this part of its half size."""
    places = np.array([-1.0, 0.0, 1.0])
    (lens_y, lens_x), (window_y, window_x) = case.half_size_um, case.half_window_um
    return {
        "x": part * lens_x * places,
        "y": part * lens_y * places,
        "X": window_x * places,
        "Y": window_y * places,
    }


def _plane_waves(case: PropagationCase, x: Any, y: Any) -> tuple[Any, Any]:
    """Direction cosines p(x), q(y) of plane waves from the lens to the window.

    Those of rays to the window's centre, p from the root mean square of y over the
    lens, and q from that of x.
    """
    (high_y, high_x), (cx, cy) = case.half_size_um, case.centre_um
    return (
        ray_cosines(case, x - cx, math.hypot(cy, high_y / math.sqrt(3))),
        ray_cosines(case, y - cy, math.hypot(cx, high_x / math.sqrt(3))),
    )


def _residual_kernel(case: PropagationCase, x: Any, y: Any, X: Any, Y: Any) -> Array:
    """Kernel from lens (x, y) to the window offset (X, Y) over the plane waves
    exp(-ik(pX + qY)) of :func:`_plane_waves`.
    """
    level, path = ray_to_offset(case, x, y, X, Y)
    p, q = _plane_waves(case, x, y)
    return np.asarray(level * np.exp(1j * case.wavenumber * (path + p * X + q * Y)))


def _needed_nodes(
    function: Callable[..., Array],
    probes: dict[str, Array],
    along: str,
    half: float,
    tolerance: float,
) -> int:
    """Legendre nodes that interpolate a function along one variable.

    The number of trial nodes is doubled until it suffices on every line through the
    probes of the other variables.

    Args:
        function: of the named variables, which broadcast.
        probes: values of every variable.
        along: name of the variable.
        half: its range is -half to half.
        tolerance: relative error of the interpolation.

    Raises:
        PropagationError: more than 400 nodes.
    """
    others = [name for name in probes if name != along]
    grid = np.meshgrid(*(probes[name] for name in others), indexing="ij")
    at = {name: g.reshape(-1, 1) for name, g in zip(others, grid, strict=True)}
    count = 32
    while count <= 1.5 * MOST_NODES:
        line = half * legendre.gauss_legendre_nodes(count)[0]
        needed = legendre.needed_node_count(function(**at, **{along: line}), tolerance)
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


def coarse_lens_nodes(
    case: PropagationCase, half_um: Sequence[float], tolerance: float
) -> tuple[Array, Array]:
    """(e,), (x,) Legendre nodes that interpolate the fields of the extreme depths.

    Args:
        case: geometry of the propagation.
        half_um: (y, x) half sizes of the lens.
        tolerance: relative error of the interpolation.
    """

    def field(x: Any, y: Any, inverse: Any) -> Any:
        return np.exp(1j * depth_factors(case, y, x, case.tangents, inverse))

    extremes = min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)
    places = zip("yx", half_um, strict=True)
    probes = {name: np.array([-1.0, 0.0, 1.0]) * half for name, half in places}
    probes["inverse"] = np.array(extremes)
    e, x = (
        half
        * legendre.gauss_legendre_nodes(
            _needed_nodes(field, probes, name, half, tolerance)
        )[0]
        for name, half in zip("yx", half_um, strict=True)
    )
    return e, x


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

    def fields(inverse: Array) -> Array:
        """(depth, e · x) weighted lens fields."""
        phase_rad = depth_factors(case, e, x, case.tangents, inverse[:, None, None])
        return np.asarray((np.exp(1j * phase_rad) * weight).reshape(len(inverse), -1))

    count = 48
    # Depth nodes are doubled until the rank shows that they resolve all depths: nodes
    # need pi a period, the fields two.
    while True:
        samples = inverse
        if len(inverse) > count:
            nodes = legendre.mapped_nodes(count, inverse.min(), inverse.max())
            samples = np.clip(nodes, 0, None)
        _, singular, right = np.linalg.svd(fields(samples), full_matrices=False)
        rank = _significant_rank(singular, tolerance)
        if len(inverse) <= count or rank <= 2 / np.pi * count:
            break
        count *= 2
    basis = right[:rank]
    return DepthBasis(
        basis.reshape(rank, len(e), len(x)) / weight,
        fields(inverse) @ basis.conj().T,
        singular[:rank] / singular[0],
    )


def _significant_rank(singular: Array, tolerance: float) -> int:
    """Number of singular values that leave a smaller root sum square than a tolerance,
    relative to that of all.
    """
    tail = np.sqrt(np.cumsum(singular[::-1] ** 2)[::-1] / (singular**2).sum())
    return int(max(1, (tail > tolerance).sum()))


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


@dataclass(frozen=True, eq=False, slots=True)
class WindowTile:
    """Operators from the lens nodes (e, x) of a tile to its samples (Y, X).

    The kernel is Σ_r window_terms[r] lens_terms[r] times the plane waves along_y
    (Y, e) and along_x (x, X). pairs: of a term and a depth field, the significant ones.
    """

    along_y: torch.Tensor
    along_x: torch.Tensor
    lens_terms: torch.Tensor
    window_terms: torch.Tensor
    pairs: torch.Tensor


def _plan_tile(
    case: PropagationCase,
    counts: TileCounts,
    depths: DepthBasis,
    tolerance: float,
    dtype: torch.dtype,
) -> WindowTile:
    """Operators of a tile. The kernel over its plane waves is sampled on small Legendre
    grids of window and lens, factorised by an SVD from its interpolative decomposition,
    and interpolated.

    Args:
        case: geometry of the tile.
        counts: of nodes and grids.
        depths: basis of the depth fields.
        tolerance: relative error of the field.
        dtype: of the real and imaginary parts.
    """
    grids = [
        half_um * legendre.gauss_legendre_nodes(count)[0]
        for half_um, count in zip(
            case.half_window_um + case.half_size_um,
            counts.window + counts.lens,
            strict=True,
        )
    ]
    Y, X, y, x = np.ix_(*grids)
    table = _residual_kernel(case, x, y, X, Y) * case.area_um2
    left, size, right = interpolative.svd(
        table.reshape(math.prod(counts.window), -1), tolerance / 8, rand=False
    )
    rank = _significant_rank(size, tolerance / 2)
    pairs = significant_pairs(size[:rank], depths.strength, tolerance / 2)
    left = (left[:, :rank] * size[:rank]).T.reshape(rank, *counts.window)
    right = right.conj().T[:rank].reshape(rank, *counts.lens)
    y_um, x_um = case.window_um
    rows_um, columns_um = _nodes_um(case, counts.nodes)
    (half_Y, half_X), (half_y, half_x) = case.half_window_um, case.half_size_um
    shared_phase = np.exp(1j * case.wavenumber * chief_path(case))
    p, q = _plane_waves(case, columns_um, rows_um)
    arrays = (
        np.exp(-1j * case.wavenumber * y_um[:, None] * q),
        np.exp(-1j * case.wavenumber * p[:, None] * x_um),
        _interpolated(right, rows_um / half_y, columns_um / half_x),
        _interpolated(left, y_um / half_Y, x_um / half_X) * shared_phase,
    )
    along_y, along_x, lens_terms, window_terms = (
        torch.tensor(array, dtype=dtype.to_complex()) for array in arrays
    )
    return WindowTile(along_y, along_x, lens_terms, window_terms, torch.tensor(pairs))


def _interpolated(values: Array, y: Array, x: Array) -> Array:
    """(r, y, x) functions on Legendre nodes (r, node, node), at y and x in [-1, 1]."""
    rows, columns = (
        legendre.interpolation_matrix(count, at)
        for count, at in zip(values.shape[1:], (y, x), strict=True)
    )
    return np.asarray(rows @ values @ columns.T)


# additional nodes over the lens, and in a block, where smooth factors (``Pupils``)
# multiply the light
SMOOTH = (4, 2)
MORE = 8  # additional orders of the moments, for the posterior error


@dataclass(frozen=True, eq=False, slots=True)
class WindowPlan:
    """Everything that depends on the geometry alone, ready for many lenses.

    The moments go ``MORE`` orders beyond what the method uses, for the error estimate.
    tensors: from moments to nodes of the whole window, and on to those of the tiles
    (:func:`_window_tensors`); ``basis`` and ``coefficients`` of the depths. tiles: row
    by row.
    """

    case: PropagationCase
    layout: WindowLayout
    moments: PillarMoments
    tensors: dict[str, torch.Tensor]
    tiles: list[WindowTile]

    @property
    def nodes_um(self) -> tuple[Array, Array]:
        """(e,), (x,) positions of the lens nodes of the whole window."""
        return _nodes_um(self.case, self.layout.nodes)

    @property
    def check_nodes_um(self) -> tuple[Array, Array]:
        """(e,), (x,) positions of the nodes of all its moments, ``MORE`` than for the
        whole window.
        """
        ny, nx = self.layout.nodes
        return _nodes_um(self.case, (ny + MORE, nx + MORE))

    def on_nodes(self, moments: torch.Tensor) -> torch.Tensor:
        """(…, e, x) light on the nodes of the whole window from moments (…, m, n)."""
        ny, nx = self.layout.nodes
        left, right = self.tensors["rows_to_nodes"], self.tensors["columns_to_nodes"]
        return left.T @ moments[..., :ny, :nx] @ right

    def on_check_nodes(self, moments: torch.Tensor) -> Array:
        """(…, e, x) light on the nodes of all moments (…, m, n)."""
        m, n = moments.shape[-2:]
        with one_blas_thread():
            left, right = legendre.to_nodes(m).T, legendre.to_nodes(n)
            return np.asarray(left @ moments.detach().numpy() @ right)

    def irradiance(self, light: torch.Tensor) -> torch.Tensor:
        """(depth, y, x) irradiance on the window from light (e, x) on its lens nodes."""
        field = _field_from_nodes(light, self)
        return field.real**2 + field.imag**2


@functools.lru_cache(maxsize=32)
def plan_window(
    case: PropagationCase, tolerance: float, dtype: torch.dtype, *, smooth: bool = False
) -> WindowPlan:
    """Plan of a windowed propagation; the last 32 are cached.

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
        counts = layout.counts
        depths = depth_basis(case, _nodes_um(case, counts.nodes), tolerance / 2)
        cases = list(itertools.chain(*window_tiles(case, layout.parts)))
        tiles = [_plan_tile(tile, counts, depths, tolerance, dtype) for tile in cases]
        tensors = _window_tensors(case, cases, layout)
        for name in ("basis", "coefficients"):
            array = getattr(depths, name)
            tensors[name] = torch.tensor(array, dtype=dtype.to_complex())
    return WindowPlan(case, layout, pillars, tensors, tiles)


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
    case: PropagationCase, tiles: list[PropagationCase], layout: WindowLayout
) -> dict[str, torch.Tensor]:
    """Tensors of the whole window, complex128.

    ``rows_to_nodes``, ``columns_to_nodes``: moments to window nodes. ``rows_to_tile``,
    ``columns_to_tile``: window nodes to tile nodes. ``turn`` (tile, e, x): phase from
    the window's centre to the tile's, on the window nodes.
    """
    arrays = {}
    for name, window_count, tile_count in zip(
        ("rows", "columns"), layout.nodes, layout.counts.nodes, strict=True
    ):
        arrays[f"{name}_to_nodes"] = legendre.to_nodes(window_count)
        arrays[f"{name}_to_tile"] = legendre.interpolation_matrix(
            tile_count, legendre.gauss_legendre_nodes(window_count)[0]
        )
    e, x = _nodes_um(case, layout.nodes)
    paths = [to_sensor(one_case, x, e[:, None]) for one_case in (case, *tiles)]
    arrays["turn"] = np.exp(1j * case.wavenumber * (np.stack(paths[1:]) - paths[0]))
    return {name: torch.tensor(a, dtype=torch.complex128) for name, a in arrays.items()}


def field_windowed(
    phase_rad: torch.Tensor, transmission: torch.Tensor, plan: WindowPlan
) -> torch.Tensor:
    """(depth, y, x) complex field on the window, differentiable once in both maps.

    Args:
        phase_rad, transmission: (y, x) maps. plan: of :func:`plan_window`.
    """
    moments, _ = reduce_to_moments(phase_rad, transmission, plan.moments)
    return _field_from_nodes(plan.on_nodes(moments), plan)


def _field_from_nodes(light: torch.Tensor, plan: WindowPlan) -> torch.Tensor:
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
    basis, coefficients = tensors["basis"], tensors["coefficients"]
    fields = [
        _zoom_to_tile(one_light, basis, coefficients, tile)
        for one_light, tile in zip(tile_light.to(basis), plan.tiles, strict=True)
    ]
    columns = min(plan.layout.parts, plan.case.samples[1])
    rows = [
        torch.cat(fields[start : start + columns], -1)
        for start in range(0, len(fields), columns)
    ]
    return torch.cat(rows, -2)


def _zoom_to_tile(
    light: torch.Tensor,
    basis: torch.Tensor,
    coefficients: torch.Tensor,
    tile: WindowTile,
) -> torch.Tensor:
    """(depth, Y, X) field on a tile of the light (e, x) at all depths.

    Args:
        light: on the tile's lens nodes.
        basis: (b, e, x) depth fields.
        coefficients: (depth, b) of each depth.
        tile: its operators.
    """
    terms, depth = tile.pairs
    sources = light * tile.lens_terms[terms] * basis[depth]
    waves = tile.along_y @ (sources @ tile.along_x) * tile.window_terms[terms]
    window = waves.new_zeros((len(basis), *waves.shape[1:])).index_add(0, depth, waves)
    at_depths: torch.Tensor = torch.tensordot(coefficients, window, 1)
    return at_depths
