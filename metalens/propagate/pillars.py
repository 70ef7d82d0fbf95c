"""From millions of pillars to a few thousand Legendre moments, with the known phase
taken off.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from metalens.core.arrays import Array
from metalens.core.errors import PropagationError
from metalens.core.threads import run_split
from metalens.propagate.blocks import (
    CHUNK,
    NODES,
    ORDER,
    SHARE,
    AxisBlocks,
    Kernel,
    ReferencePhase,
    choose_blocks,
)
from metalens.propagate.compiled import grid_pillars, interpolate_to_pillars
from metalens.propagate.geometry import PropagationCase

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
        nodes, carrier = (
            2 * rows.nodes * columns.count * columns.nodes,
            ORDER[itemsize] * self.carrier.case.shape[1],
        )
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
        kernel, nodes, more: as :func:`metalens.propagate.blocks.choose_blocks`.
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
    found = [weight(place) for weight, place in zip(weights, places, strict=True)]
    polynomials = [torch.tensor(np.ascontiguousarray(f), dtype=sums) for f in found]
    return PillarMoments(
        blocks,
        wave,
        table,
        dtype,
        polynomials[0],
        polynomials[1],
        (_bands(found[0]), _bands(found[1])),
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
