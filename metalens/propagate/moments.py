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

    def pillars_of(self, block: int) -> slice:
        """Pillars that belong to a block."""
        start = block * self.length
        return slice(start, min(start + self.length, self.pillars))

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


# (y_um, x_um) of the lens to (components,) signs and (components, maps, y, x) smooth
# factors on the light of several maps: light on the window is
# Σ_c sign_c |Σ_m factor_cm of map m, propagated|²
Pupils = Callable[[Array, Array], tuple[Array, Array]]


@dataclass(frozen=True, eq=False, slots=True)
class PillarMoments:
    """Plan of the reduction of a lens to moments.

    blocks: of rows and columns. polynomials: coefficients (chunk, order, column) of the
    carrier over a block row, in turns without whole turns: Σ_n coefficients[n] uⁿ for u
    in [-1, 1]. The columns are cut in chunks of equal size, the last padded with zeros.
    rounding_rad: standard deviation of the phase by rounding of these polynomials.
    dtype: of the maps. rows, columns: (y node, m) and (x node, n) weights of the nodes
    in the moments, in the dtype of the sums.
    """

    blocks: tuple[AxisBlocks, AxisBlocks]
    polynomials: Callable[[int], Array]
    rounding_rad: float
    dtype: torch.dtype
    rows: torch.Tensor
    columns: torch.Tensor


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
    chunks = -(-case.shape[1] // chunk)
    row_um, column_um = case.steps_um
    half_um = (rows.length - 1) / 2 * row_um
    middles_um = rows.middles_um(row_um)
    order = ORDER[itemsize]

    def polynomials(block: int) -> Array:
        along_rows = middles_um[block], half_um
        coefficients = _powers(case, reference, along_rows, case.pillars_um[1], order)
        coefficients[0] -= np.rint(coefficients[0])
        row = np.zeros((order, chunks * chunk), f"f{itemsize}")
        row[:, : case.shape[1]] = coefficients
        return np.ascontiguousarray(row.reshape(order, chunks, chunk).swapaxes(0, 1))

    if rows.count * order * case.shape[1] * itemsize < 1 << 26:  # lenses of some 5 mm
        polynomials = functools.cache(polynomials)
    y, x = (half * np.array([-1.0, 0.0, 1.0]) for half in case.half_size_um)
    longest = np.abs(carrier_turns(case, reference, x, y[:, None])).max()
    # a tenth of the largest error
    rounding_rad = float(2 * np.pi * ROUNDED / 10 * longest)
    nodes_um = rows.nodes_um(row_um), columns.nodes_um(column_um)
    values = [
        torch.tensor(np.ascontiguousarray(weight(at_um)), dtype=sums)
        for weight, at_um in zip(weights, nodes_um, strict=True)
    ]
    return PillarMoments(blocks, polynomials, rounding_rad, dtype, *values)


def reduce_to_moments(
    phase_rad: torch.Tensor, transmission: torch.Tensor, plan: PillarMoments
) -> tuple[torch.Tensor, float]:
    """(m, n) complex moments of a lens, and the sum of squares of its transmission.

    Differentiable in phase and transmission. Maps of another dtype than the plan's are
    converted, a block of rows at a time where no derivative is required. Values that
    are not finite give results that are not finite; tiles of closed pillars are
    skipped.

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


def _block_rows(plan: PillarMoments, dtype: Any) -> Callable[[int], tuple[Any, ...]]:
    """Function of a block row: its rows, and what the compiled loops take of it.

    Its results are the rows; (chunk, order, column) carrier; (row,) positions in the
    block; (rows, columns) shares of the nodes, (node, pillar) each; (block,) first
    columns.
    """
    rows, columns = plan.blocks
    along, bases = rows.along.astype(dtype), rows.bases
    # four rows are added at once: zeros follow the last
    row_shares = np.pad(rows.weights, ((0, 0), (0, 4))).astype(dtype)
    column_shares, column_bases = columns.weights.astype(dtype), columns.bases

    def block_row(block: int) -> tuple[Any, ...]:
        pillars = rows.pillars_of(block)
        first = pillars.start - bases[block]
        shares = np.ascontiguousarray(row_shares[:, first:]), column_shares
        return pillars, plan.polynomials(block), along[first:], shares, column_bases

    return block_row


def _gather(
    phase: torch.Tensor, level: torch.Tensor, plan: PillarMoments
) -> tuple[torch.Tensor, float]:
    """Moments (2, m, n), real and imaginary, and the sum of squares of the level.

    Three steps: pillars to the nodes of their blocks (compiled, one block row after the
    other), column nodes to column moments, row nodes to row moments.

    Args:
        phase: (y, x) phase, rad.
        level: (y, x) transmission.
        plan: blocks and weights.
    """
    maps = phase.detach().numpy(), level.detach().numpy()
    rows, columns = plan.blocks
    nodes = torch.zeros(
        (rows.count, rows.nodes, 2, columns.count * columns.nodes), dtype=plan.dtype
    )
    node_array = nodes.numpy()
    block_row = _block_rows(plan, node_array.dtype)
    compiled_loop: Any = grid_pillars
    powers: list[float] = []

    def work(low: int, high: int) -> None:
        for block in range(low, high):
            pillars, *arrays = block_row(block)
            row_maps = [
                np.asarray(values[pillars], node_array.dtype) for values in maps
            ]
            powers.append(compiled_loop(*row_maps, *arrays, node_array[block]))

    run_split(rows.count, work)
    light = nodes.flatten(0, 2).to(plan.columns.dtype)
    sums = (light @ plan.columns).view(len(plan.rows), -1)
    moments = (plan.rows.T @ sums).view(-1, 2, plan.columns.shape[1])
    return moments.movedim(1, 0).contiguous(), math.fsum(powers)


def _spread(
    maps: tuple[torch.Tensor, torch.Tensor],
    plan: PillarMoments,
    grad: torch.Tensor,
    gradients: tuple[Any, Any],
) -> None:
    """Write the gradients in phase and transmission, from those of the moments.

    The adjoint of :func:`_gather`, one block row after the other.

    Args:
        maps: (y, x) phase in rad, and transmission.
        plan: blocks and weights.
        grad: (2, m, n) gradients of the moments.
        gradients: (y, x) outputs, written in place; None where not needed.
    """
    phase, level = (one_map.detach().numpy() for one_map in maps)
    empty = np.empty((len(phase), 0), phase.dtype)
    targets = [empty if target is None else target.numpy() for target in gradients]
    rows = plan.blocks[0]
    sums = plan.rows @ grad.movedim(0, 1).flatten(1)
    nodes = sums.view(-1, plan.columns.shape[1]) @ plan.columns.T
    node_array = nodes.view(rows.count, rows.nodes, 2, -1).to(plan.dtype).numpy()
    block_row = _block_rows(plan, phase.dtype)
    compiled_loop: Any = interpolate_to_pillars

    def work(low: int, high: int) -> None:
        for block in range(low, high):
            pillars, *arrays = block_row(block)
            out = [target[pillars] for target in targets]
            compiled_loop(
                phase[pillars], level[pillars], *arrays, node_array[block], *out
            )

    run_split(rows.count, work)


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
def _light(phase, level, table, u, re, im):  # type: ignore[no-untyped-def]
    """Transmission times the phasors exp(i (phase + carrier)) along a row."""
    for j in range(phase.size):
        t = whole_turns_off(phase[j], re) + carrier_at(table, u, j, re)
        c, s = sincos_turns(t - np.rint(t), re)
        re[j], im[j] = level[j] * c, level[j] * s


@numba.njit(
    fastmath={"reassoc", "contract", "nsz"}, nogil=True, error_model="numpy", cache=True
)
def _power(level, start, stop):  # type: ignore[no-untyped-def]
    """Sum of squares of the transmission (y, x) of columns start to stop; NaN
    propagates."""
    total = 0.0
    for i in range(level.shape[0]):
        row = level[i, start:stop]
        squares = row.dtype.type(0)
        for j in range(row.size):
            squares += row[j] * row[j]
        total += squares
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
def grid_pillars(phase, level, table, u, shares, bases, out):  # type: ignore[no-untyped-def]
    """Interpolate the light of a block row to its nodes, added to ``out`` (row node,
    re/im, column node).

    phase, level: (row, x), rad and amplitude. table: (chunk, order, column) carrier.
    u: (row,) positions in the block. shares: (rows, columns) weights of the nodes
    (node, pillar), those of the rows with four zeros at their end. bases: (block,)
    first columns.

    Chunk by chunk: phasors of four rows are formed, added to the row nodes, and then to
    the column nodes. Returns the sum of squares of the transmission.
    """
    chunk = table.shape[2]
    rows = np.zeros((4, 2, chunk), out.dtype)
    sums = np.empty((out.shape[0], 2, chunk), out.dtype)
    power = 0.0
    for c in range(table.shape[0]):
        x0, x1 = c * chunk, min((c + 1) * chunk, phase.shape[1])
        light = _power(level, x0, x1)
        power += light
        if light == 0:
            continue
        sums[:] = 0
        for i in range(0, u.size, 4):
            for q in range(4):
                if i + q < u.size:
                    p, t = phase[i + q, x0:x1], level[i + q, x0:x1]
                    _light(p, t, table[c], u[i + q], rows[q, 0], rows[q, 1])
                else:
                    rows[q] = 0
            _add_rows(rows, shares[0], i, sums)
        _add_columns(sums, (x0, x1), shares[1], bases, out)
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
def _write_gradients(row, re, im, level, out_phase, out_level):  # type: ignore[no-untyped-def]
    """Gradients of a row: Re(conj(phasor) row) in transmission, and level ·
    Im(conj(phasor) row) in phase."""
    for j in range(out_phase.size):
        out_phase[j] = level[j] * (row[1, j] * re[j] - row[0, j] * im[j])
    for j in range(out_level.size):
        out_level[j] = row[0, j] * re[j] + row[1, j] * im[j]


@numba.njit(nogil=True, error_model="numpy", cache=True)
def interpolate_to_pillars(  # type: ignore[no-untyped-def]
    phase, level, table, u, shares, bases, grad, out_phase, out_level
):
    """Gradients in phase and transmission from those at the nodes: the adjoint of
    :func:`grid_pillars`, which has the other arguments.

    grad: as ``out`` there. out_phase, out_level: (row, x), written in place; an empty
    array (row, 0): no gradient is computed.
    """
    nodes, chunk = grad.shape[0], table.shape[2]
    row = np.empty((2, chunk), grad.dtype)
    re, im = np.empty(chunk, grad.dtype), np.empty(chunk, grad.dtype)
    ones = np.ones(chunk, level.dtype)
    sums = np.zeros(((nodes + 3) // 4 * 4, 2, chunk), grad.dtype)
    padded = np.zeros((len(sums), u.size), grad.dtype)
    padded[:nodes] = shares[0][:, : u.size]
    for c in range(table.shape[0]):
        x0, x1 = c * chunk, min((c + 1) * chunk, phase.shape[1])
        if out_level.size == 0 and _power(level, x0, x1) == 0:
            out_phase[:, x0:x1] = 0
            continue
        _spread_columns(grad, (x0, x1), shares[1], bases, sums)
        for i in range(u.size):
            _spread_row(sums, padded, i, row)
            _light(phase[i, x0:x1], ones, table[c], u[i], re, im)
            _write_gradients(
                row, re, im, level[i, x0:x1], out_phase[i, x0:x1], out_level[i, x0:x1]
            )
