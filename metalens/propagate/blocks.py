"""Blocks of neighbouring pillars: a few nodes stand for each, and a polynomial carries
the known phase across it.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.propagate.geometry import PropagationCase
from metalens.propagate.paths import from_source, to_sensor

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
    found = []
    for axis, longest in ((0, height), (1, LENGTHS[1][0])):
        options = [n for n in LENGTHS[axis] if n <= min(longest, case.shape[axis])]
        blocks = [_needed(case, axis, n, kernel, tolerance, more) for n in options]
        found.append(min(blocks, key=lambda b: b.nodes * (1 + nodes / b.length)))
    return found[0], found[1]


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
    found = np.asarray(_to_powers(order) @ (values - middle))
    found[..., :1, :] += middle
    return found


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
        order, columns = ORDER[np.dtype(dtype).itemsize], self.case.shape[1]
        chunks = -(-columns // self.chunk)
        out = np.zeros((stop - start, chunks, order, self.chunk), dtype)
        for first in range(start, stop, TABLE_ROWS):
            some = slice(first, min(first + TABLE_ROWS, stop))
            found = self._coefficients(some, order)
            padded = np.zeros((*found.shape[:2], chunks * self.chunk), dtype)
            padded[..., :columns] = found
            parts = padded.reshape(*found.shape[:2], chunks, self.chunk)
            out[some.start - start : some.stop - start] = parts.swapaxes(1, 2)
        return out

    def _coefficients(self, some: slice, order: int) -> Array:
        """(block, order, column) float64 of some block rows."""
        middles = self.rows.middles_um(self.case.steps_um[0])[some, None, None]
        half = (self.rows.length - 1) / 2 * self.case.steps_um[0]
        found = _powers(
            self.case, self.reference, (middles, half), self.case.pillars_um[1], order
        )
        found[:, 0] -= np.rint(found[:, 0])
        return found
