"""Moments of blocks of neighbouring pillars on a few interpolation nodes.

The carrier is a polynomial over each block and is removed.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
import torch
from numba.extending import overload
from numpy.polynomial import chebyshev

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.core.threads import run_split
from metalens.propagate.geometry import PropagationCase
from metalens.propagate.paths import from_source, to_sensor
from metalens.propagate.sincos import sincos_turns

LENGTHS = (
    (64, 32, 16, 8, 4, 2, 1),
    (512, 256, 128, 64, 32, 16, 8, 4, 2, 1),
)  # of rows, of columns


ORDER = {4: 5, 8: 9}  # of the carrier polynomials, by bytes of a number


ACCURACY = {
    4: 2e-8,
    8: 1e-11,
}  # of the carrier in turns, in addition to the rounding of the path


# rounding of path and polynomial in float64, relative to the longest path (largest
# measured: 3.5e-15)
ROUNDED = 5e-15


SHARE = 40  # of the tolerance that interpolation inside blocks may take


# positions in a block where the kernel is sampled; blocks that need more nodes keep
# their pillars
PROBES = 48


TABLE_ROWS = 8  # block rows whose carrier is formed at once, in float64


NODES = 60  # default of the approximate number of nodes of a lens along an axis


CHUNK = 512  # columns handled at once: their sums stay in the nearest cache


@dataclass(frozen=True, slots=True)
class AxisBlocks:
    """Pillars along one axis in blocks of ``length``, ``nodes`` points in each.

    The last block is as long as the others and overlaps its neighbour; every pillar
    belongs to the first block that holds it. Where a block would need as many nodes as
    pillars, the nodes are the pillars.
    """

    pillars: int
    length: int
    nodes: int

    @property
    def count(self) -> int:
        """Number of blocks."""
        return -(-self.pillars // self.length)

    @property
    def bases(self) -> Array:
        """(block,) index of the first pillar."""
        return np.minimum(
            np.arange(self.count) * self.length, self.pillars - self.length
        )

    @property
    def places(self) -> Array:
        """(nodes,) positions of the nodes from the block's middle, in half-lengths."""
        return np.asarray(
            legendre.gauss_legendre_nodes(self.nodes)[0]
            if self.nodes < self.length
            else self.along
        )

    @property
    def along(self) -> Array:
        """(length,) positions of the pillars from the block's middle, in half-lengths."""
        return np.linspace(-1, 1, self.length) if self.length > 1 else np.zeros(1)

    @property
    def weights(self) -> Array:
        """(nodes, length): share of each node in a pillar's light."""
        if self.nodes == self.length:
            return np.eye(self.length)
        return np.ascontiguousarray(
            legendre.interpolation_matrix(self.nodes, self.along).T
        )

    def middles_um(self, pitch_um: float) -> Array:
        """(block,) middles of the blocks from the lens axis."""
        return (self.bases + (self.length - self.pillars) / 2) * pitch_um

    def nodes_um(self, pitch_um: float) -> Array:
        """(block · nodes,) positions of all nodes from the lens axis."""
        half = (self.length - 1) / 2 * pitch_um
        return np.asarray(
            (self.middles_um(pitch_um)[:, None] + half * self.places).ravel()
        )


Kernel = Callable[[Any, Any], Array]


def choose_blocks(
    case: PropagationCase,
    reference: float,
    kernel: Kernel,
    tolerance: float,
    itemsize: int,
    *,
    nodes: int = NODES,
    more: int = 0,
) -> tuple[AxisBlocks, AxisBlocks]:
    """Row blocks and column blocks of the least cost, nodes (1 + lens nodes / length).

    Args:
        case: geometry of the propagation.
        reference: inverse depth of the carrier, 1/um.
        itemsize: bytes of a number of the maps.
        kernel: (y, x) in um to (line, …) values, broadcasting; their variation over a
            block must be met.
        tolerance: root mean square error of the interpolation, relative.
        nodes: approximate number of nodes of the lens along an axis, to which the light
            of the blocks is passed on.
        more: nodes of a block beyond those that the kernel needs.
    """
    tallest = next(
        length
        for length in LENGTHS[0]
        if length <= case.shape[0]
        and _polynomials_suffice(case, reference, length, itemsize)
    )
    cheapest = []
    for axis, longest in ((0, tallest), (1, LENGTHS[1][0])):
        blocks = [
            _fewest_nodes(case, axis, length, kernel, tolerance, more)
            for length in LENGTHS[axis]
            if length <= min(longest, case.shape[axis])
        ]
        cheapest.append(min(blocks, key=lambda b: b.nodes * (1 + nodes / b.length)))
    return cheapest[0], cheapest[1]


def _fewest_nodes(
    case: PropagationCase,
    axis: int,
    length: int,
    kernel: Kernel,
    tolerance: float,
    more: int,
) -> AxisBlocks:
    """Blocks of ``length`` pillars along an axis, with the fewest nodes per block.

    The kernel is sampled over the first, the middle and the last block, on three lines
    across the axis. Blocks that would need more than ``PROBES`` nodes keep their
    pillars.

    Args:
        case: geometry of the propagation.
        axis: 0 rows (y), 1 columns (x).
        length: pillars of a block.
        kernel: (y, x) in um to values, broadcasting.
        tolerance: relative root mean square error of the interpolation.
        more: nodes added to those that the kernel needs.
    """
    if length < 4:
        return AxisBlocks(case.shape[axis], length, length)
    step_um = case.steps_um[axis]
    all_middles = AxisBlocks(case.shape[axis], length, length).middles_um(step_um)
    middles = all_middles[[0, len(all_middles) // 2, -1], None, None]
    across = case.half_size_um[1 - axis] * np.array([-1.0, 0.0, 1.0])[:, None]
    line = (
        middles + legendre.gauss_legendre_nodes(PROBES)[0] * (length - 1) / 2 * step_um
    )
    values = kernel(line, across) if axis == 0 else kernel(across, line)
    count = max(legendre.needed_node_count(values, tolerance), 2) + more
    return AxisBlocks(
        case.shape[axis], length, length if count > PROBES else min(count, length)
    )


def carrier_turns(case: PropagationCase, reference: float, x: Any, y: Any) -> Any:
    """Source path (of the reference depth) plus sensor path (to the window centre), in
    wavelengths.

    Args:
        case: geometry of the propagation.
        x: column positions, um.
        y: row positions, um.
    """
    return (
        from_source(case, x, y, case.tangents, reference) + to_sensor(case, x, y)
    ) / case.wavelength_um


def _polynomials_suffice(
    case: PropagationCase, reference: float, length: int, itemsize: int
) -> bool:
    """Whether polynomials over blocks of ``length`` rows meet ``ACCURACY``.

    The carrier is compared with its polynomials at four block rows and about 16
    columns, in turns.
    """
    rows = AxisBlocks(case.shape[0], length, length)
    block_rows = np.unique([0, rows.count // 4, rows.count // 2, rows.count - 1])
    x = case.pillars_um[1][:: max(1, case.shape[1] // 16)]
    y = rows.middles_um(case.steps_um[0])[block_rows, None, None]
    half = (length - 1) / 2 * case.steps_um[0]
    coefficients = _powers(case, reference, (y, half), x, ORDER[itemsize])
    exact = carrier_turns(case, reference, x, y + half * rows.along[:, None])
    error = np.abs(
        rows.along[:, None] ** np.arange(ORDER[itemsize]) @ coefficients - exact
    ).max()
    return bool(error <= ACCURACY[itemsize] + ROUNDED * np.abs(exact).max())


def _powers(
    case: PropagationCase,
    reference: float,
    rows: tuple[Any, float],
    x: Array,
    order: int,
) -> Array:
    """(block, order, x) power coefficients of the carrier along the rows, in turns.

    The carrier is sampled at Chebyshev nodes u in [-1, 1]. The value at the middle node
    is subtracted before the transform and added after it: the transform has large
    entries and would round the thousands of turns that all nodes share.

    Args:
        case: geometry of the propagation.
        reference: inverse depth of the carrier, 1/um.
        rows: middles of the blocks (block, 1, 1) and their half height, um.
        x: (x,) column positions, um.
        order: number of coefficients.
    """
    u = np.cos(np.pi * (np.arange(order) + 0.5) / order)
    values = carrier_turns(case, reference, x, rows[0] + rows[1] * u[:, None])
    middle_node = values[..., order // 2 : order // 2 + 1, :]
    powers = np.asarray(_to_powers(order) @ (values - middle_node))
    powers[..., :1, :] += middle_node
    return powers


@functools.cache
def _to_powers(order: int) -> Array:
    """(power, node): power coefficients of the polynomial through values at the
    Chebyshev nodes.
    """
    u = np.cos(np.pi * (np.arange(order) + 0.5) / order)
    coefficients = np.linalg.inv(chebyshev.chebvander(u, order - 1))
    columns = [
        np.pad(chebyshev.cheb2poly(c), (0, order))[:order] for c in coefficients.T
    ]
    return np.array(columns).T


@dataclass(frozen=True, slots=True)
class ReferencePhase:
    """The carrier in turns along the rows of a block, c(u) = Σ_n coefficients[n] uⁿ for
    u in [-1, 1].

    reference: inverse depth, 1/um. rows: blocks of rows. chunk: columns in a chunk.
    """

    case: PropagationCase
    reference: float
    rows: AxisBlocks
    chunk: int

    @property
    def rounding_rad(self) -> float:
        """Standard deviation of the phase by rounding of its polynomials, rad: a tenth
        of the largest error.
        """
        y, x = (half * np.array([-1.0, 0.0, 1.0]) for half in self.case.half_size_um)
        longest = np.abs(carrier_turns(self.case, self.reference, x, y[:, None])).max()
        return float(2 * np.pi * ROUNDED / 10 * longest)

    def table(self, start: int, stop: int, dtype: Any) -> Array:
        """(block, chunk, order, column) coefficients of block rows start to stop, in
        turns, without whole turns.

        The columns are cut in chunks of equal size; the last is padded with zeros.
        """
        order = ORDER[np.dtype(dtype).itemsize]
        columns = self.case.shape[1]
        chunks = -(-columns // self.chunk)
        table = np.zeros((stop - start, chunks, order, self.chunk), dtype)
        for begin in range(start, stop, TABLE_ROWS):
            block_rows = slice(begin, min(begin + TABLE_ROWS, stop))
            coefficients = self._coefficients(block_rows, order)
            padded = np.zeros((*coefficients.shape[:2], chunks * self.chunk), dtype)
            padded[..., :columns] = coefficients
            parts = padded.reshape(*coefficients.shape[:2], chunks, self.chunk)
            table[block_rows.start - start : block_rows.stop - start] = parts.swapaxes(
                1, 2
            )
        return table

    def _coefficients(self, block_rows: slice, order: int) -> Array:
        """(block, order, column) float64 of block_rows block rows."""
        middles = self.rows.middles_um(self.case.steps_um[0])[block_rows, None, None]
        half = (self.rows.length - 1) / 2 * self.case.steps_um[0]
        coefficients = _powers(
            self.case, self.reference, (middles, half), self.case.pillars_um[1], order
        )
        coefficients[:, 0] -= np.rint(coefficients[:, 0])
        return coefficients


# (y_um, x_um) of the lens to (components,) signs and (components, maps, y, x) smooth
# factors on the light of several
# maps: light on the window is Σ_c sign_c |Σ_m factor_cm of map m, propagated|²
Pupils = Callable[[Array, Array], tuple[Array, Array]]


Bands = list[tuple[slice, slice]]


BAND = 128  # nodes whose shares of an even grid are taken at once


# of carrier polynomials and of nodes held at once, and of maps' copies in a thread
KEEP_BYTES = 32e6


@dataclass(frozen=True, eq=False, slots=True)
class PillarMoments:
    """Plan of the reduction of a lens to moments.

    blocks: of rows and columns. carrier: the phase that is removed. table: its
    polynomials, or None where they exceed ``KEEP_BYTES``. dtype: of the maps.
    rows, columns: (y node, m) and (x node, n) weights of the nodes in the moments, in
    the dtype of the sums. bands: of both, nodes handled at once and their moments.
    """

    blocks: tuple[AxisBlocks, AxisBlocks]
    carrier: ReferencePhase
    table: Any
    dtype: torch.dtype
    rows: torch.Tensor
    columns: torch.Tensor
    bands: tuple[Bands, Bands]

    @property
    def counts(self) -> tuple[int, int]:
        """(m, n) numbers of moments."""
        return self.rows.shape[1], self.columns.shape[1]

    @property
    def panels(self) -> list[slice]:
        """Block rows that are handled at once, so that their nodes and their carrier
        stay below ``KEEP_BYTES``.
        """
        rows, columns = self.blocks
        itemsize = self.dtype.itemsize
        nodes = 2 * rows.nodes * columns.count * columns.nodes
        carrier = ORDER[itemsize] * self.carrier.case.shape[1]
        step = max(4, int(KEEP_BYTES / ((nodes + carrier) * itemsize)))
        return [slice(a, min(a + step, rows.count)) for a in range(0, rows.count, step)]


def plan_moments(
    case: PropagationCase,
    reference: float,
    weights: tuple[Callable[[Array], Array], ...],
    kernel: Kernel,
    *,
    tolerance: float,
    dtype: torch.dtype,
    sums: torch.dtype = torch.float64,
    nodes: int = NODES,
    more: int = 0,
) -> PillarMoments:
    """Plan the reduction of a lens to moments: blocks, carrier and weights of the
    nodes.

    Args:
        case, reference: geometry, and inverse depth (1/um) of the carrier.
        tolerance: relative root mean square error of the moments.
        dtype, sums: of the maps, and of what is summed over blocks.
        weights: of the rows and of the columns, (place,) um to (place, m): polynomials,
            or shares of an even grid.
        kernel, nodes, more: as :func:`choose_blocks`.
    """
    itemsize = dtype.itemsize
    blocks = choose_blocks(
        case, reference, kernel, tolerance / SHARE, itemsize, nodes=nodes, more=more
    )
    rows, columns = blocks
    width = columns.length
    chunk = width * max(1, min(CHUNK // width, -(-case.shape[1] // width)))
    carrier = ReferencePhase(case, reference, rows, chunk)
    nodes_um = (rows.nodes_um(case.steps_um[0]), columns.nodes_um(case.steps_um[1]))
    table = None
    if case.shape[0] / rows.length * case.shape[1] * 10 * itemsize <= KEEP_BYTES:
        table = carrier.table(0, rows.count, np.dtype(f"f{itemsize}"))
    values = [weight(at_um) for weight, at_um in zip(weights, nodes_um, strict=True)]
    tensors = [torch.tensor(np.ascontiguousarray(v), dtype=sums) for v in values]
    return PillarMoments(
        blocks,
        carrier,
        table,
        dtype,
        tensors[0],
        tensors[1],
        (_bands(values[0]), _bands(values[1])),
    )


def _bands(weights: Array) -> Bands:
    """Bands of nodes, each with the range of moments that have a weight there.

    Where the bands hold more than half of the matrix, one band holds all of it.

    Args:
        weights: (node, moment) share of a node's light in each moment.
    """
    bands = []
    for start in range(0, len(weights), BAND):
        nodes = slice(start, min(start + BAND, len(weights)))
        nonzero = np.flatnonzero(weights[nodes].any(0))
        group = slice(0, 0)
        if len(nonzero):
            group = slice(int(nonzero[0]), int(nonzero[-1]) + 1)
        bands.append((nodes, group))
    if (
        sum(group.stop - group.start for _, group in bands)
        > weights.shape[1] * len(bands) / 2
    ):
        return [(slice(0, len(weights)), slice(0, weights.shape[1]))]
    return bands


def _clip_bands(bands: Bands, start: int, stop: int) -> Bands:
    """The bands, cut to the nodes from start to stop; empty bands are dropped."""
    clipped = [
        (slice(max(nodes.start, start), min(nodes.stop, stop)), group)
        for nodes, group in bands
    ]
    return [(nodes, group) for nodes, group in clipped if nodes.start < nodes.stop]


def reduce_to_moments(
    phase_rad: torch.Tensor, transmission: torch.Tensor, plan: PillarMoments
) -> tuple[torch.Tensor, float]:
    """(m, n) complex moments of a lens, and the sum of squares of its transmission.

    Differentiable in phase and transmission. Maps of another dtype than the plan's are
    converted, some rows at a time where no derivative is required. Values that are not
    finite give results that are not finite; tiles of closed pillars are skipped.

    Args:
        phase_rad: (y, x) phase of every pillar.
        transmission: (y, x) amplitude of every pillar.
        plan: of :func:`plan_moments`.

    Accuracy: float32 2e-6, float64 1e-12 of the root sum of squares of the pillars. The
    interpolation inside blocks adds what the plan allows.
    """
    if phase_rad.requires_grad or transmission.requires_grad:
        phase_rad, transmission = (m.to(plan.dtype) for m in (phase_rad, transmission))
    parts, power = _Reduce.apply(phase_rad, transmission, plan)  # type: ignore[no-untyped-call]
    return torch.complex(parts[0], parts[1]), float(power)


def mix_components(
    light: torch.Tensor, pupils: Pupils | None, places_um: tuple[Array, Array]
) -> list[tuple[float, torch.Tensor]]:
    """Sign and light of every component, from the light of every map (map, e, x) at
    these places (e,), (x,).

    Args:
        pupils: factors on the light; None for one map.
        places_um: positions on the lens.
    """
    if pupils is None:
        return [(1.0, light[0])]
    signs, factors = pupils(*places_um)
    weights = torch.as_tensor(factors, device=light.device).to(light.real.dtype)
    return [
        (float(sign), (weight * light).sum(0))
        for sign, weight in zip(signs, weights, strict=True)
    ]


class _Reduce(torch.autograd.Function):
    """Moments (2, m, n); the backward pass forms the phasors again rather than keep
    them.
    """

    @staticmethod
    def forward(
        ctx: Any, phase: torch.Tensor, level: torch.Tensor, plan: PillarMoments
    ) -> tuple[torch.Tensor, torch.Tensor]:
        ctx.save_for_backward(phase, level)
        ctx.plan = plan
        out, power = _gather(phase, level, plan)
        total = torch.tensor(power, dtype=torch.float64)
        ctx.mark_non_differentiable(total)
        return out, total

    @staticmethod
    def backward(
        ctx: Any, *grads: torch.Tensor
    ) -> tuple[torch.Tensor | None, torch.Tensor | None, None]:
        if torch.is_grad_enabled():
            raise PropagationError(
                "second derivatives of sums over pillars are not known: leave create_graph out, and take differences "
                "of gradients"
            )
        phase, level = ctx.saved_tensors
        need = ctx.needs_input_grad
        out_phase = torch.empty_like(phase) if need[0] else None
        out_level = torch.empty_like(level) if need[1] else None
        _spread((phase, level), ctx.plan, grads[0], (out_phase, out_level))
        return out_phase, out_level, None


def _table(plan: PillarMoments, panel: slice, dtype: Any) -> Any:
    """Carrier polynomials of a panel."""
    return (
        plan.carrier.table(panel.start, panel.stop, dtype)
        if plan.table is None
        else plan.table[panel]
    )


def _block_arrays(plan: PillarMoments, dtype: Any) -> tuple[Array, Any, Any]:
    """Arrays of the blocks that both compiled loops take.

    Returns:
        Row positions in a block (length,); (rows, columns) shares of the nodes, (nodes,
        length) each; (rows, columns) indices of the first pillars, (block,) each.
    """
    rows, columns = plan.blocks
    return (
        rows.along.astype(dtype),
        tuple(b.weights.astype(dtype) for b in plan.blocks),
        (rows.bases, columns.bases),
    )


def _gather(
    phase: torch.Tensor, level: torch.Tensor, plan: PillarMoments
) -> tuple[torch.Tensor, float]:
    """Moments (2, m, n), real and imaginary, and the sum of squares of the level.

    Each panel of block rows goes through three steps: pillars to the nodes of their
    blocks (compiled), column nodes to column moments, row nodes to row moments.

    Args:
        phase: (y, x) phase, rad.
        level: (y, x) transmission.
        plan: blocks and weights.
    """
    maps = phase.detach().numpy(), level.detach().numpy()
    rows, columns = plan.blocks
    m, n = plan.counts
    moments = torch.zeros((m, 2 * n), dtype=plan.rows.dtype)
    compiled_loop: Any = grid_pillars
    tile_powers: list[float] = []
    u, shares, (row_bases, column_bases) = _block_arrays(
        plan, torch.empty(0, dtype=plan.dtype).numpy().dtype
    )
    # block rows at once, where maps of another dtype are copied
    step = max(
        1, int(KEEP_BYTES / (len(maps) * rows.length * maps[0].shape[1] * u.itemsize))
    )
    for panel in plan.panels:
        table = _table(plan, panel, u.dtype)
        count = panel.stop - panel.start
        nodes = torch.zeros(
            (count * rows.nodes, 2, columns.count * columns.nodes), dtype=plan.dtype
        )
        node_array = nodes.numpy()

        def work(
            low: int,
            high: int,
            first: int = panel.start,
            table: Any = table,
            node_array: Any = node_array,
        ) -> None:
            for i in range(low, high, step):
                end = min(i + step, high)
                first_row = (first + i) * rows.length
                row_maps = [
                    np.asarray(
                        one_map[first_row : (first + end) * rows.length], u.dtype
                    )
                    for one_map in maps
                ]
                bases = row_bases[first + i : first + end] - first_row, column_bases
                node_rows = node_array[i * rows.nodes : end * rows.nodes]
                tile_powers.append(
                    compiled_loop(
                        *row_maps, table[i:end], u, shares, bases, 0, node_rows
                    )
                )

        run_split(count, work)
        sums = torch.zeros((count * rows.nodes * 2, n), dtype=moments.dtype)
        light = nodes.flatten(0, 1).to(moments.dtype)
        for span, group in plan.bands[1]:
            sums[:, group].addmm_(light[:, span], plan.columns[span, group])
        sums, first_node = sums.view(-1, 2 * n), panel.start * rows.nodes
        for span, group in _clip_bands(
            plan.bands[0], first_node, panel.stop * rows.nodes
        ):
            moments[group].addmm_(
                plan.rows[span, group].T,
                sums[span.start - first_node : span.stop - first_node],
            )
    return moments.view(m, 2, n).movedim(1, 0).contiguous(), math.fsum(tile_powers)


def _spread(
    maps: tuple[torch.Tensor, torch.Tensor],
    plan: PillarMoments,
    grad: torch.Tensor,
    gradients: tuple[Any, Any],
) -> None:
    """Write the gradients in phase and transmission, from those of the moments.

    The adjoint of :func:`_gather`, one panel of block rows after the other.

    Args:
        maps: (y, x) phase in rad, and transmission.
        plan: blocks and weights.
        grad: (2, m, n) gradients of the moments.
        gradients: (y, x) outputs, written in place; None where not needed.
    """
    phase, level = (one_map.detach().numpy() for one_map in maps)
    empty = np.empty((0, 0), phase.dtype)
    targets = tuple(
        empty if gradient is None else gradient.numpy() for gradient in gradients
    )
    rows = plan.blocks[0]
    m, n = plan.counts
    moment_gradient = grad.movedim(0, 1).reshape(m, 2 * n)
    compiled_loop: Any = interpolate_to_pillars
    fixed = _block_arrays(plan, phase.dtype)
    for panel in plan.panels:
        table = _table(plan, panel, phase.dtype)
        nodes = _node_gradients(plan, panel, moment_gradient).to(plan.dtype).numpy()

        def work(
            low: int,
            high: int,
            table: Any = table,
            nodes: Any = nodes,
            panel: slice = panel,
        ) -> None:
            node_rows = nodes[low * rows.nodes : high * rows.nodes]
            compiled_loop(
                phase,
                level,
                table[low:high],
                *fixed,
                panel.start + low,
                node_rows,
                *targets,
            )

        run_split(panel.stop - panel.start, work)


def _node_gradients(
    plan: PillarMoments, panel: slice, moment_gradient: torch.Tensor
) -> torch.Tensor:
    """Gradients at the nodes of a panel (row node, re/im, column node).

    Args:
        plan: blocks and weights.
        panel: block rows.
        moment_gradient: (m, re/im · n) gradients of the moments.
    """
    rows, columns = plan.blocks
    n = plan.counts[1]
    first_node, last_node = panel.start * rows.nodes, panel.stop * rows.nodes
    sums = torch.cat(
        [
            plan.rows[span, group] @ moment_gradient[group]
            for span, group in _clip_bands(plan.bands[0], first_node, last_node)
        ]
    ).view(-1, n)
    nodes = torch.cat(
        [sums[:, group] @ plan.columns[span, group].T for span, group in plan.bands[1]],
        1,
    )
    return nodes.view(-1, 2, columns.count * columns.nodes)


EXACT = {
    "contract",
    "arcp",
    "nsz",
    "afn",
}  # order of sums is kept: the phase is reduced in two steps


PER_RAD = 1 / (2 * np.pi)


@numba.njit(inline="always")
def whole_turns_off(phase, like):  # type: ignore[no-untyped-def]
    """``phase`` (rad) in turns, reduced to [-1/2, 1/2], in the precision of ``like``.

    2π is split in two parts; the first has few bits, so that its multiples are exact.
    """
    number = like.dtype.type
    whole = np.rint(phase * number(PER_RAD))
    reduced = (phase - whole * number(6.28125)) - whole * number(2 * np.pi - 6.28125)
    return reduced * number(PER_RAD)


def _carrier_of_order(order: int) -> Callable[..., Any]:
    """Carrier of column j at row position u of a block; the loop is unrolled."""

    def carrier_at(table, u, j, like):  # type: ignore[no-untyped-def]
        total = table[order - 1, j]
        for n in range(order - 2, -1, -1):
            total = table[n, j] + u * total
        return total

    return carrier_at


carrier_at: Any = _carrier_of_order(ORDER[8])


@overload(carrier_at, inline="always")
def _carrier_at(table, u, j, like):  # type: ignore[no-untyped-def]
    return _carrier_of_order(ORDER[like.dtype.bitwidth // 8])


@numba.njit(fastmath=EXACT, nogil=True, error_model="numpy", cache=True)
def _phasors(phase, table, u, re, im):  # type: ignore[no-untyped-def]
    """Cosine and sine of phase plus carrier along a row."""
    for j in range(phase.size):
        t = whole_turns_off(phase[j], re) + carrier_at(table, u, j, re)
        re[j], im[j] = sincos_turns(t - np.rint(t), re)


@numba.njit(fastmath=EXACT, nogil=True, error_model="numpy", cache=True)
def _light(phase, level, table, u, re, im):  # type: ignore[no-untyped-def]
    """Transmission times the phasors exp(i (phase + carrier)) along a row."""
    for j in range(phase.size):
        t = whole_turns_off(phase[j], re) + carrier_at(table, u, j, re)
        c, s = sincos_turns(t - np.rint(t), re)
        re[j], im[j] = level[j] * c, level[j] * s


@numba.njit(
    fastmath={"reassoc", "contract", "nsz"}, nogil=True, error_model="numpy", cache=True
)
def _power(level, first, last, start, stop):  # type: ignore[no-untyped-def]
    """(sum of squares, sum of magnitudes) of the transmission of a tile; NaN
    propagates.

    level: (y, x). first, last: rows. start, stop: columns.
    """
    total, size = 0.0, 0.0
    for i in range(first, last):
        row = level[i, start:stop]
        squares, magnitudes = row.dtype.type(0), row.dtype.type(0)
        for j in range(row.size):
            squares += row[j] * row[j]
            magnitudes += abs(row[j])
        total += squares
        size += magnitudes
    return total, size


@numba.njit(
    fastmath={"reassoc", "contract", "nsz"}, nogil=True, error_model="numpy", cache=True
)
def _taint(phase, first, last, start, stop):  # type: ignore[no-untyped-def]
    """0, or NaN where a phase of a tile is not finite.

    phase: (y, x). first, last: rows. start, stop: columns.
    """
    total = phase.dtype.type(0)
    for i in range(first, last):
        row = phase[i, start:stop]
        for j in range(row.size):
            total += row[j] * row.dtype.type(0)
    return total


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _add_rows(rows, shares, first, sums):  # type: ignore[no-untyped-def]
    """Add four rows of light to the row nodes: sums[a] += Σ_q shares[a, first + q]
    rows[q].

    rows: (4, re/im, column). shares: (node, row). sums: (node, re/im, column).
    """
    for a in range(sums.shape[0]):
        s0 = shares[a, first]
        s1 = shares[a, first + 1]
        s2 = shares[a, first + 2]
        s3 = shares[a, first + 3]
        for k in range(2):
            for j in range(sums.shape[2]):
                sums[a, k, j] += (
                    s0 * rows[0, k, j]
                    + s1 * rows[1, k, j]
                    + s2 * rows[2, k, j]
                    + s3 * rows[3, k, j]
                )


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _add_columns(sums, span, shares, bases, out):  # type: ignore[no-untyped-def]
    """Add the columns span[0] to span[1] of a tile to the column nodes.

    sums: (row node, re/im, column). shares: (node, column of a block). bases: (block,)
    first columns. out: (row node, re/im, column node).
    """
    nodes, length = shares.shape
    for block in range(span[0] // length, (span[1] - 1) // length + 1):
        low = max(block * length, span[0])
        high = min((block + 1) * length, span[1])
        for a in range(sums.shape[0]):
            for k in range(2):
                values = sums[a, k, low - span[0] : high - span[0]]
                for b in range(nodes):
                    share = shares[b, low - bases[block] : high - bases[block]]
                    total = sums.dtype.type(0)
                    for j in range(values.size):
                        total += values[j] * share[j]
                    out[a, k, block * nodes + b] += total


@numba.njit(nogil=True, error_model="numpy", cache=True)
def grid_pillars(phase, level, table, u, shares, bases, first, out):  # type: ignore[no-untyped-def]
    """Interpolate the light of some block rows to their nodes, added to ``out`` (block
    row · node, re/im, column node).

    phase, level: (y, x), rad and amplitude. table: (block row, chunk, order, column)
    carrier, from block row ``first`` on. u: (length,) row positions in a block. shares,
    bases: (rows, columns) weights of the nodes and first pillars.

    Tile by tile: phasors of four rows are formed, added to the row nodes, and then to
    the column nodes. Returns the sum of squares of the transmission, NaN where a phase
    of a closed tile is not finite.
    """
    ny, nx = phase.shape
    nodes, length = shares[0].shape
    chunk = table.shape[3]
    rows = np.zeros((4, 2, chunk), out.dtype)
    sums = np.empty((nodes, 2, chunk), out.dtype)
    padded = np.zeros((nodes, length + 4), out.dtype)
    padded[:, :length] = shares[0]
    power = 0.0
    for block in range(table.shape[0]):
        start = (first + block) * length
        stop = min((first + block + 1) * length, ny)
        base = bases[0][first + block]
        for c in range(table.shape[1]):
            x0, x1 = c * chunk, min((c + 1) * chunk, nx)
            light, size = _power(level, start, stop, x0, x1)
            power += light
            if size == 0:
                power += _taint(phase, start, stop, x0, x1)
                continue
            sums[:] = 0
            for i in range(start, stop, 4):
                for q in range(4):
                    if i + q < stop:
                        p, t = phase[i + q, x0:x1], level[i + q, x0:x1]
                        _light(
                            p,
                            t,
                            table[block, c],
                            u[i + q - base],
                            rows[q, 0],
                            rows[q, 1],
                        )
                    else:
                        rows[q] = 0
                _add_rows(rows, padded, i - base, sums)
            _add_columns(
                sums,
                (x0, x1),
                shares[1],
                bases[1],
                out[block * nodes : (block + 1) * nodes],
            )
    return power


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _spread_columns(grad, span, shares, bases, sums):  # type: ignore[no-untyped-def]
    """Adjoint of :func:`_add_columns`: column nodes to the columns of a tile.

    grad: (row node, re/im, column node). span: first and last column. shares: (node,
    column of a block). bases: (block,) first columns. sums: (row node, re/im, column),
    written in place.
    """
    nodes, length = shares.shape
    for block in range(span[0] // length, (span[1] - 1) // length + 1):
        low = max(block * length, span[0])
        high = min((block + 1) * length, span[1])
        for a in range(grad.shape[0]):
            for k in range(2):
                values = sums[a, k, low - span[0] : high - span[0]]
                values[:] = 0
                for b in range(nodes):
                    share = shares[b, low - bases[block] : high - bases[block]]
                    for j in range(values.size):
                        values[j] += grad[a, k, block * nodes + b] * share[j]


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _spread_row(sums, shares, i, row):  # type: ignore[no-untyped-def]
    """Adjoint of :func:`_add_rows` for one row: row = Σ_a shares[a, i] sums[a].

    Nodes are taken four at a time. sums: (node, re/im, column). shares: (node, row). i:
    index of the row. row: (re/im, column), written in place.
    """
    row[:] = 0
    for a in range(0, sums.shape[0], 4):
        s0 = shares[a, i]
        s1 = shares[a + 1, i]
        s2 = shares[a + 2, i]
        s3 = shares[a + 3, i]
        for k in range(2):
            for j in range(sums.shape[2]):
                row[k, j] += (
                    s0 * sums[a, k, j]
                    + s1 * sums[a + 1, k, j]
                    + s2 * sums[a + 2, k, j]
                    + s3 * sums[a + 3, k, j]
                )


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _phase_gradient(row, re, im, level, out):  # type: ignore[no-untyped-def]
    """Gradient in phase of a row: level · Im(conj(phasor) row)."""
    for j in range(out.size):
        out[j] = level[j] * (row[1, j] * re[j] - row[0, j] * im[j])


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _level_gradient(row, re, im, out):  # type: ignore[no-untyped-def]
    """Gradient in transmission of a row: Re(conj(phasor) row)."""
    for j in range(out.size):
        out[j] = row[0, j] * re[j] + row[1, j] * im[j]


@numba.njit(nogil=True, error_model="numpy", cache=True)
def interpolate_to_pillars(  # type: ignore[no-untyped-def]
    phase, level, table, u, shares, bases, first, grad, out_phase, out_level
):
    """Gradients in phase and transmission from those at the nodes: the adjoint of
    :func:`grid_pillars`, which has the other arguments.

    grad: as ``out`` there. out_phase, out_level: (y, x), written in place; an empty
    array: no gradient is computed.
    """
    ny, nx = phase.shape
    nodes, length = shares[0].shape
    chunk = table.shape[3]
    row = np.empty((2, chunk), grad.dtype)
    re, im = np.empty(chunk, grad.dtype), np.empty(chunk, grad.dtype)
    sums = np.zeros(((nodes + 3) // 4 * 4, 2, chunk), grad.dtype)
    padded = np.zeros((len(sums), length), grad.dtype)
    padded[:nodes] = shares[0]
    for block in range(table.shape[0]):
        start = (first + block) * length
        stop = min((first + block + 1) * length, ny)
        base = bases[0][first + block]
        for c in range(table.shape[1]):
            x0, x1 = c * chunk, min((c + 1) * chunk, nx)
            if out_level.size == 0 and _power(level, start, stop, x0, x1)[1] == 0:
                for i in range(start, stop):
                    out_phase[i, x0:x1] = 0
                continue
            _spread_columns(
                grad[block * nodes : (block + 1) * nodes],
                (x0, x1),
                shares[1],
                bases[1],
                sums,
            )
            for i in range(start, stop):
                _spread_row(sums, padded, i - base, row)
                _phasors(phase[i, x0:x1], table[block, c], u[i - base], re, im)
                if out_phase.size:
                    _phase_gradient(row, re, im, level[i, x0:x1], out_phase[i, x0:x1])
                if out_level.size:
                    _level_gradient(row, re, im, out_level[i, x0:x1])
