"""From millions of pillars to a few thousand moments, by blocks of neighbouring pillars.

The known phase is carried across a block by a polynomial and taken off; a few nodes
stand for the pillars of a block.
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
}  # of the carrier in turns, beside the rounding of the path itself


# of the longest path: what path and polynomial round to in float64 (up to 3.5e-15 was
# found)
ROUNDED = 5e-15


SHARE = 40  # of the tolerance that interpolation inside blocks may take


# positions in a block where the kernel is looked at; blocks that need more keep their
# pillars
PROBES = 48


TABLE_ROWS = 8  # block rows whose carrier is formed at once, in float64


NODES = 60  # of a lens along an axis, about, where nothing else is said


CHUNK = 512  # columns handled at once: their sums stay in the nearest cache


@dataclass(frozen=True, slots=True)
class AxisBlocks:
    """Pillars along one axis in blocks of ``length``, ``nodes`` points in each.

    The last block is as long as the others and overlaps the one before it; every pillar
    belongs to the first block
    that holds it. Where a block would need as many nodes as pillars, the nodes are the
    pillars.
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
        """(nodes, length): share of a pillar's light that each node gets."""
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
    """(rows, columns) blocks that cost least.

    Args:
        case: geometry of the propagation.
        reference: inverse depth whose phase is taken off, 1/um.
        itemsize: bytes of a number of the maps.
        kernel: (y, x) in um to (line, …) values whose variation over a block must be
            met, broadcasting.
        tolerance: root mean square error of the interpolation, relative.
        nodes: of the lens along an axis, to which the light of every block's goes on,
            about.
        more: nodes of a block beyond those that the kernel needs.
    """
    height = next(
        n
        for n in LENGTHS[0]
        if n <= case.shape[0] and _carried(case, reference, n, itemsize)
    )
    chosen = []
    for axis, longest in ((0, height), (1, LENGTHS[1][0])):
        options = [n for n in LENGTHS[axis] if n <= min(longest, case.shape[axis])]
        blocks = [_needed(case, axis, n, kernel, tolerance, more) for n in options]
        chosen.append(min(blocks, key=lambda b: b.nodes * (1 + nodes / b.length)))
    return chosen[0], chosen[1]


def _needed(
    case: PropagationCase,
    axis: int,
    length: int,
    kernel: Kernel,
    tolerance: float,
    more: int,
) -> AxisBlocks:
    """Blocks of a length along an axis with as few nodes as the kernel needs at its
    ends and its middle.
    """
    if length < 4:
        return AxisBlocks(case.shape[axis], length, length)
    step_um = case.steps_um[axis]
    bases = AxisBlocks(case.shape[axis], length, length).middles_um(step_um)
    middles = bases[[0, len(bases) // 2, -1], None, None]
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


def _carried(
    case: PropagationCase, reference: float, length: int, itemsize: int
) -> bool:
    """Whether polynomials over blocks of ``length`` rows are as exact as asked."""
    rows = AxisBlocks(case.shape[0], length, length)
    picked = np.unique([0, rows.count // 4, rows.count // 2, rows.count - 1])
    x = case.pillars_um[1][:: max(1, case.shape[1] // 16)]
    y = rows.middles_um(case.steps_um[0])[picked, None, None]
    half = (length - 1) / 2 * case.steps_um[0]
    got = _powers(case, reference, (y, half), x, ORDER[itemsize])
    want = carrier_turns(case, reference, x, y + half * rows.along[:, None])
    error = np.abs(rows.along[:, None] ** np.arange(ORDER[itemsize]) @ got - want).max()
    return bool(error <= ACCURACY[itemsize] + ROUNDED * np.abs(want).max())


def _powers(
    case: PropagationCase,
    reference: float,
    rows: tuple[Any, float],
    x: Array,
    order: int,
) -> Array:
    """(block, order, x) power coefficients of the carrier in turns along the rows of
    blocks at ``rows`` middles.

    Of the differences to the middle node, u = 0: the transform would round thousands of
    turns that all nodes share, by
    its large entries.
    """
    u = np.cos(np.pi * (np.arange(order) + 0.5) / order)
    values = carrier_turns(case, reference, x, rows[0] + rows[1] * u[:, None])
    middle = values[..., order // 2 : order // 2 + 1, :]
    powers = np.asarray(_to_powers(order) @ (values - middle))
    powers[..., :1, :] += middle
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
    """The known phase in turns, c(u) = Σ_n coefficients[n] uⁿ for u in [-1, 1] along
    the rows of a block.
    """

    case: PropagationCase
    reference: float
    rows: AxisBlocks
    chunk: int

    @property
    def rounding_rad(self) -> float:
        """Standard deviation of the phase from what its polynomials round, a tenth of
        the largest.
        """
        y, x = (half * np.array([-1.0, 0.0, 1.0]) for half in self.case.half_size_um)
        longest = np.abs(carrier_turns(self.case, self.reference, x, y[:, None])).max()
        return float(2 * np.pi * ROUNDED / 10 * longest)

    def table(self, start: int, stop: int, dtype: Any) -> Array:
        """(block, chunk, order, column) coefficients of block rows start to stop; whole
        turns are left out.
        """
        order = ORDER[np.dtype(dtype).itemsize]
        columns = self.case.shape[1]
        chunks = -(-columns // self.chunk)
        out = np.zeros((stop - start, chunks, order, self.chunk), dtype)
        for first in range(start, stop, TABLE_ROWS):
            some = slice(first, min(first + TABLE_ROWS, stop))
            coefficients = self._coefficients(some, order)
            padded = np.zeros((*coefficients.shape[:2], chunks * self.chunk), dtype)
            padded[..., :columns] = coefficients
            parts = padded.reshape(*coefficients.shape[:2], chunks, self.chunk)
            out[some.start - start : some.stop - start] = parts.swapaxes(1, 2)
        return out

    def _coefficients(self, some: slice, order: int) -> Array:
        """(block, order, column) float64 of some block rows."""
        middles = self.rows.middles_um(self.case.steps_um[0])[some, None, None]
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
    """How pillars are reduced.

    blocks: of rows and columns; carrier: the phase that is taken off; table: its
    polynomials, where they are small enough to be kept; dtype: of the maps.
    rows: (y, m), columns: (x, n) polynomials at the nodes of the blocks, in the dtype of
    the sums; bands: of each, the nodes that are taken at once and the moments that have
    a share.
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
    """Blocks, and what light at their nodes is worth in each moment.

    Args:
        case, reference: geometry, and inverse depth whose phase is taken off.
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
    wave = ReferencePhase(
        case,
        reference,
        rows,
        width * max(1, min(CHUNK // width, -(-case.shape[1] // width))),
    )
    places = (rows.nodes_um(case.steps_um[0]), columns.nodes_um(case.steps_um[1]))
    table = None
    if case.shape[0] / rows.length * case.shape[1] * 10 * itemsize <= KEEP_BYTES:
        table = wave.table(0, rows.count, np.dtype(f"f{itemsize}"))
    values = [weight(place) for weight, place in zip(weights, places, strict=True)]
    polynomials = [torch.tensor(np.ascontiguousarray(f), dtype=sums) for f in values]
    return PillarMoments(
        blocks,
        wave,
        table,
        dtype,
        polynomials[0],
        polynomials[1],
        (_bands(values[0]), _bands(values[1])),
    )


def _bands(weights: Array) -> Bands:
    """Nodes and the moments that are not 0 at all of them; one band of all where most
    are not.
    """
    bands = []
    for start in range(0, len(weights), BAND):
        at = slice(start, min(start + BAND, len(weights)))
        there = np.flatnonzero(weights[at].any(0))
        bands.append(
            (
                at,
                slice(int(there[0]), int(there[-1]) + 1) if len(there) else slice(0, 0),
            )
        )
    if sum(to.stop - to.start for _, to in bands) > weights.shape[1] * len(bands) / 2:
        return [(slice(0, len(weights)), slice(0, weights.shape[1]))]
    return bands


def _in(bands: Bands, start: int, stop: int) -> Bands:
    """The bands of nodes from start to stop."""
    cut = [(slice(max(at.start, start), min(at.stop, stop)), to) for at, to in bands]
    return [(at, to) for at, to in cut if at.start < at.stop]


def reduce_to_moments(
    phase_rad: torch.Tensor, transmission: torch.Tensor, plan: PillarMoments
) -> tuple[torch.Tensor, float]:
    """(m, n) complex moments of a lens, and the sum of squares of its transmission.

    Differentiable in phase and transmission, (y, x) real; sums are of the plan's dtype,
    to which maps of another are
    brought some rows at a time where no derivative is wanted. Values that are not
    finite give moments or a sum that is
    not; closed pillars are passed over where a whole tile is closed.

    Args:
        phase_rad: (y, x) phase of every pillar.

    Accuracy: float32 2e-6, float64 1e-12 of the root sum of squares of the pillars,
    incoherent, and the interpolation
    inside blocks that the plan allows.
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
    by = torch.as_tensor(factors, device=light.device).to(light.real.dtype)
    return [
        (float(sign), (factor * light).sum(0))
        for sign, factor in zip(signs, by, strict=True)
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


def _fixed(plan: PillarMoments, dtype: Any) -> tuple[Array, Any, Any]:
    """What both loops know of the blocks: positions of the rows, shares of the nodes,
    first pillars.
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
    """Moments by the compiled loops."""
    maps = phase.detach().numpy(), level.detach().numpy()
    (rows, columns), (m, n) = plan.blocks, plan.counts
    out = torch.zeros((m, 2 * n), dtype=plan.rows.dtype)
    kernel: Any = grid_pillars
    powers: list[float] = []
    along, shares, (row_bases, column_bases) = _fixed(
        plan, torch.empty(0, dtype=plan.dtype).numpy().dtype
    )
    # block rows at once, where maps of another dtype are copied
    step = max(
        1,
        int(KEEP_BYTES / (len(maps) * rows.length * maps[0].shape[1] * along.itemsize)),
    )
    for panel in plan.panels:
        table = _table(plan, panel, along.dtype)
        count = panel.stop - panel.start
        nodes = torch.zeros(
            (count * rows.nodes, 2, columns.count * columns.nodes), dtype=plan.dtype
        )
        view = nodes.numpy()

        def work(
            a: int,
            b: int,
            first: int = panel.start,
            table: Any = table,
            view: Any = view,
        ) -> None:
            for i in range(a, b, step):
                end = min(i + step, b)
                begin = (first + i) * rows.length
                few = [
                    np.asarray(one[begin : (first + end) * rows.length], along.dtype)
                    for one in maps
                ]
                bases = row_bases[first + i : first + end] - begin, column_bases
                part = view[i * rows.nodes : end * rows.nodes]
                powers.append(kernel(*few, table[i:end], along, shares, bases, 0, part))

        run_split(count, work)
        sums = torch.zeros((count * rows.nodes * 2, n), dtype=out.dtype)
        light = nodes.flatten(0, 1).to(out.dtype)
        for at, to in plan.bands[1]:
            sums[:, to].addmm_(light[:, at], plan.columns[at, to])
        sums, before = sums.view(-1, 2 * n), panel.start * rows.nodes
        for at, to in _in(plan.bands[0], before, panel.stop * rows.nodes):
            out[to].addmm_(
                plan.rows[at, to].T, sums[at.start - before : at.stop - before]
            )
    return out.view(m, 2, n).movedim(1, 0).contiguous(), math.fsum(powers)


def _spread(
    maps: tuple[torch.Tensor, torch.Tensor],
    plan: PillarMoments,
    grad: torch.Tensor,
    out: tuple[Any, Any],
) -> None:
    """Gradients of the moments to those of phase and transmission by the compiled
    loops.
    """
    phase, level = (m.detach().numpy() for m in maps)
    none = np.empty((0, 0), phase.dtype)
    targets = tuple(none if t is None else t.numpy() for t in out)
    rows, (m, n) = plan.blocks[0], plan.counts
    inner = grad.movedim(0, 1).reshape(m, 2 * n)
    kernel: Any = interpolate_to_pillars
    fixed = _fixed(plan, phase.dtype)
    for panel in plan.panels:
        table = _table(plan, panel, phase.dtype)
        nodes = _given(plan, panel, inner).to(plan.dtype).numpy()

        def work(
            a: int, b: int, table: Any = table, nodes: Any = nodes, panel: slice = panel
        ) -> None:
            part = nodes[a * rows.nodes : b * rows.nodes]
            kernel(phase, level, table[a:b], *fixed, panel.start + a, part, *targets)

        run_split(panel.stop - panel.start, work)


def _given(plan: PillarMoments, panel: slice, inner: torch.Tensor) -> torch.Tensor:
    """Gradients (m, re/im · n) of the moments to those of the nodes of a panel (row
    node, re/im, column node).
    """
    (rows, columns), n = plan.blocks, plan.counts[1]
    before, stop = panel.start * rows.nodes, panel.stop * rows.nodes
    sums = torch.cat(
        [plan.rows[at, to] @ inner[to] for at, to in _in(plan.bands[0], before, stop)]
    ).view(-1, n)
    nodes = torch.cat(
        [sums[:, to] @ plan.columns[at, to].T for at, to in plan.bands[1]], 1
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
    """Phase in turns less its whole turns, in the precision of ``like``: 2π in two
    parts, the first of few bits, so that its multiples are exact.
    """
    number = like.dtype.type
    whole = np.rint(phase * number(PER_RAD))
    rest = (phase - whole * number(6.28125)) - whole * number(2 * np.pi - 6.28125)
    return rest * number(PER_RAD)


def reference_phase_at(table: Any, u: Any, j: Any, like: Any) -> Any:
    """Carrier of column j at row position u of a block; compiled loops choose while
    compiled.
    """
    return (_short if like.dtype == np.float32 else _long)(table, u, j, like)  # type: ignore[no-untyped-call]


def _short(table, u, j, like):  # type: ignore[no-untyped-def]
    return table[0, j] + u * (
        table[1, j] + u * (table[2, j] + u * (table[3, j] + u * table[4, j]))
    )


def _long(table, u, j, like):  # type: ignore[no-untyped-def]
    t = table[4, j] + u * (
        table[5, j] + u * (table[6, j] + u * (table[7, j] + u * table[8, j]))
    )
    return table[0, j] + u * (
        table[1, j] + u * (table[2, j] + u * (table[3, j] + u * t))
    )


@overload(reference_phase_at, inline="always")
def _reference_phase_at(table, u, j, like):  # type: ignore[no-untyped-def]
    return _short if like.dtype == numba.float32 else _long


@numba.njit(fastmath=EXACT, nogil=True, error_model="numpy", cache=True)
def _phasors(phase, table, u, re, im):  # type: ignore[no-untyped-def]
    """Cosine and sine of phase plus carrier along a row."""
    for j in range(phase.size):
        t = whole_turns_off(phase[j], re) + reference_phase_at(table, u, j, re)
        re[j], im[j] = sincos_turns(t - np.rint(t), re)


@numba.njit(fastmath=EXACT, nogil=True, error_model="numpy", cache=True)
def _light(phase, level, table, u, re, im):  # type: ignore[no-untyped-def]
    """Transmission times the phasors along a row."""
    for j in range(phase.size):
        t = whole_turns_off(phase[j], re) + reference_phase_at(table, u, j, re)
        c, s = sincos_turns(t - np.rint(t), re)
        re[j], im[j] = level[j] * c, level[j] * s


@numba.njit(
    fastmath={"reassoc", "contract", "nsz"}, nogil=True, error_model="numpy", cache=True
)
def _power(level, first, last, start, stop):  # type: ignore[no-untyped-def]
    """(sum of squares, sum of magnitudes) of a tile, kept open to NaN."""
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
    """0, or NaN where a phase of a tile is not finite."""
    total = phase.dtype.type(0)
    for i in range(first, last):
        row = phase[i, start:stop]
        for j in range(row.size):
            total += row[j] * row.dtype.type(0)
    return total


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _add_rows(rows, shares, first, sums):  # type: ignore[no-untyped-def]
    """Add four rows (row, re/im, column) to the row nodes: sums (node, re/im, column)."""
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
    """Add the columns span[0] to span[1] of a tile to the column nodes: out (node,
    re/im, column node).
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
    """Light of some block rows at their nodes, added to ``out`` (block row · node,
    re/im, column node).

    phase, level: (y, x). table: (block row, chunk, order, column) of those block rows,
    the first being ``first``.
    u: (length,) row positions. shares, bases: a pair each, for rows and columns.

    Returns the sum of squares of the transmission, NaN where a phase of a closed tile
    is not finite.
    """
    (ny, nx), (nodes, length), chunk = phase.shape, shares[0].shape, table.shape[3]
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
    """Adjoint of :func:`_add_columns`: column nodes to the columns of a tile."""
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
    """Adjoint of :func:`_add_rows` for one row: row (re/im, column); nodes are taken
    four at a time.
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
def _turned(row, re, im, level, out):  # type: ignore[no-untyped-def]
    """Gradient in phase."""
    for j in range(out.size):
        out[j] = level[j] * (row[1, j] * re[j] - row[0, j] * im[j])


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _scaled(row, re, im, out):  # type: ignore[no-untyped-def]
    """Gradient in transmission."""
    for j in range(out.size):
        out[j] = row[0, j] * re[j] + row[1, j] * im[j]


@numba.njit(nogil=True, error_model="numpy", cache=True)
def interpolate_to_pillars(  # type: ignore[no-untyped-def]
    phase, level, table, u, shares, bases, first, grad, out_phase, out_level
):
    """Gradients at the nodes, as ``out`` of :func:`grid_pillars`, to those of phase and
    transmission; empty arrays: none.
    """
    (ny, nx), (nodes, length), chunk = phase.shape, shares[0].shape, table.shape[3]
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
                    _turned(row, re, im, level[i, x0:x1], out_phase[i, x0:x1])
                if out_level.size:
                    _scaled(row, re, im, out_level[i, x0:x1])
