"""Sums over all shapes of a smooth kernel, through a coarse grid: cubic interpolation
and its transpose.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.plan import PillarArray
from layout.pec.psf import PointExposure
from layout.process.jit import compile_loop
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

MOST_NODES = 40_000_000
_PER_WIDTH = 6  # nodes along the 1/e radius of the narrowest Gaussian


@dataclass(frozen=True)
class NodeAxis:
    """Nodes at ``origin_um + k spacing_um``, k from 0 to ``count - 1``."""

    origin_um: float
    spacing_um: float
    count: int

    @classmethod
    def over(cls, low_um: float, high_um: float, spacing_um: float) -> "NodeAxis":
        """Nodes that hold four around every position from ``low_um`` to ``high_um``."""
        return cls(
            low_um - 1.5 * spacing_um,
            spacing_um,
            int((high_um - low_um) / spacing_um) + 5,
        )

    def at(self, position_um: Array) -> tuple[Array, Array]:
        """First of the four nodes around each position (n,), and their cubic Lagrange
        weights (n, 4).
        """
        steps = (np.asarray(position_um, float) - self.origin_um) / self.spacing_um
        first = np.clip(np.floor(steps).astype(np.int64) - 1, 0, self.count - 4)
        t = steps - first - 1
        inner = (-t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2)
        outer = (-(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6)
        return first, np.stack([*inner, *outer], -1)


@dataclass(frozen=True)
class NodeGrid:
    """Nodes of a die."""

    y: NodeAxis
    x: NodeAxis

    @classmethod
    def over(
        cls, box_um: tuple[float, float, float, float], width_um: float
    ) -> "NodeGrid":
        """Nodes over (left, bottom, right, top), fine enough for Gaussians of
        ``width_um`` (1/e radius).

        Raises:
            ProcessError: more than 4e7 nodes.
        """
        left, bottom, right, top = box_um
        step = width_um / _PER_WIDTH
        grid = cls(NodeAxis.over(bottom, top, step), NodeAxis.over(left, right, step))
        if grid.y.count * grid.x.count > MOST_NODES:
            raise ProcessError(
                f"a Gaussian of {width_um:.3g} um over a die of {right - left:.0f} x {top - bottom:.0f} um needs "
                f"{grid.y.count * grid.x.count:,} nodes, at most {MOST_NODES:,}; leave out the range of the point "
                "exposure between a tenth of a micrometre and some micrometres, or correct a smaller die"
            )
        return grid

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x) nodes."""
        return self.y.count, self.x.count

    def deposit(self, x_um: Array, y_um: Array, mass: Array) -> Array:
        """(y, x) node sums of masses (n,) at any places."""
        out = np.zeros(self.shape)
        _deposit(*self.x.at(x_um), *self.y.at(y_um), np.asarray(mass, float), out)
        return out

    def gather(self, lattice: PillarArray, value: Array, sums: Array) -> None:
        """Add what the pillars of a lattice carry to node sums (fields, y, x).

        Args:
            lattice: of class numbers.
            value: (fields, classes + 1) amount that each pillar of a class carries.
            sums: changed in place.
        """
        across = self.x.at(lattice.columns_um)
        for first, block in lattice.blocks():
            down = self.y.at(lattice.rows_um(first, len(block)))
            _gather(block, value, *down, *across, sums)

    def convolution(self, point: PointExposure) -> "RadialConvolution":
        """Convolution of node sums with Gaussians."""
        spacing = self.y.spacing_um, self.x.spacing_um
        return gaussian_convolution(self.shape, spacing, point=point, hollow=False)

    def sample(self, field: Array, x_um: Array, y_um: Array) -> Array:
        """(n,) values of a node field at any places."""
        first_x, weight_x = self.x.at(x_um)
        first_y, weight_y = self.y.at(y_um)
        near = np.arange(4)
        rows = first_y[:, None, None] + near[:, None]
        nodes = field[rows, first_x[:, None, None] + near]
        return np.asarray(np.einsum("nij,ni,nj->n", nodes, weight_y, weight_x))


@compile_loop
def _deposit(
    x_node: Array,
    x_weight: Array,
    y_node: Array,
    y_weight: Array,
    mass: Array,
    out: Array,
) -> None:
    """Add masses (n,) to the 4 x 4 nodes around each place, by cubic weights."""
    for n in range(mass.shape[0]):
        for i in range(4):
            for j in range(4):
                out[y_node[n] + i, x_node[n] + j] += (
                    mass[n] * y_weight[n, i] * x_weight[n, j]
                )


@compile_loop
def _gather(
    block: Array, value: Array, yn: Array, yw: Array, xn: Array, xw: Array, out: Array
) -> None:
    """Add what the pillars of a block of rows carry to the nodes, by cubic weights.

    Args:
        block: (rows, columns) entries; 0: no pillar.
        value: (fields, entries) amount that each entry carries.
        yn: (rows,) first node of each row.
        yw: (rows, 4) weights.
        xn: (columns,) first node of each column.
        xw: (columns, 4) weights.
        out: (fields, y, x) sums, in place.
    """
    fields = out.shape[0]
    wide = out.shape[2]
    line = np.zeros((fields, wide))
    for row in range(block.shape[0]):
        line[:] = 0
        for column in range(block.shape[1]):
            entry = block[row, column]
            if entry:
                for f in range(fields):
                    for j in range(4):
                        line[f, xn[column] + j] += value[f, entry] * xw[column, j]
        for f in range(fields):
            for i in range(4):
                for node in range(wide):
                    out[f, yn[row] + i, node] += yw[row, i] * line[f, node]


@dataclass(frozen=True, eq=False)
class ScatterBackground:
    """Exposure of a die by all that scatters far.

    grid: nodes.
    far: (y, x) exposure on the nodes.
    near: (rows, columns) exposure on the sites of each lattice by middle ranges; empty
        for none.
    """

    grid: NodeGrid
    far: Array
    near: Sequence[Array]

    def at_sites(
        self, lattice: PillarArray, number: int, first: int, count: int
    ) -> Array:
        """(count, columns) float32 exposure of rows of a lattice.

        Args:
            lattice: of pillars, in um.
            number: of the lattice.
            first: row.
            count: of rows.
        """
        exposure = np.empty((count, lattice.columns), np.float32)
        down = self.grid.y.at(lattice.rows_um(first, count))
        _interpolate(self.far, *down, *self.grid.x.at(lattice.columns_um), exposure)
        return (
            exposure + self.near[number][first : first + count]
            if self.near
            else exposure
        )


@compile_loop
def _interpolate(
    field: Array, yn: Array, yw: Array, xn: Array, xw: Array, out: Array
) -> None:
    """Interpolate a node field at the sites of a block of rows, by cubic weights.

    Args:
        field: (y, x) values at the nodes.
        yn: (rows,) first node of each row.
        yw: (rows, 4) weights.
        xn: (columns,) first node of each column.
        xw: (columns, 4) weights.
        out: (rows, columns) float32, filled.
    """
    line = np.zeros(field.shape[1])
    for row in range(out.shape[0]):
        line[:] = 0
        for i in range(4):
            for node in range(field.shape[1]):
                line[node] += yw[row, i] * field[yn[row] + i, node]
        for column in range(out.shape[1]):
            total = 0.0
            for j in range(4):
                total += xw[column, j] * line[xn[column] + j]
            out[row, column] = total


@dataclass(frozen=True, eq=False)
class RadialConvolution:
    """Convolution with a radial kernel on a grid of nodes, zero outside, by FFT.

    spectrum: of the kernel. shape: (y, x) of the nodes. size: (y, x) of the transform.
    """

    spectrum: Array
    shape: tuple[int, int]
    size: tuple[int, int]

    def __call__(self, mass: Array) -> Array:
        """(y, x) sum over all nodes of kernel times ``mass``."""
        from scipy import fft

        field = fft.irfft2(fft.rfft2(mass, self.size) * self.spectrum, self.size)
        return np.asarray(field[: self.shape[0], : self.shape[1]])


def gaussian_convolution(
    shape: tuple[int, int],
    spacing_um: tuple[float, float],
    *,
    point: PointExposure,
    hollow: bool,
) -> RadialConvolution:
    """Convolution with a sum of Gaussians on a grid of nodes.

    kernel = sum weight / (pi width^2) exp(-r^2 / width^2), cut at 5 widths (exp(-25)).

    Args:
        shape: (y, x) nodes.
        spacing_um: (y, x) distance of the nodes.
        point: sum of Gaussians.
        hollow: whether a node gives nothing to itself.
    """
    from scipy import fft

    reach = 5 * float(point.widths_um.max(initial=0.0))
    reach_nodes = (int(np.ceil(reach / step)) for step in spacing_um)
    rows, columns = (
        fft.next_fast_len(n + min(n, m), real=True)
        for n, m in zip(shape, reach_nodes, strict=True)
    )
    y, x = (
        np.minimum(np.arange(n), n - np.arange(n)) * step
        for n, step in zip((rows, columns), spacing_um, strict=True)
    )
    kernel = np.zeros((rows, columns))
    for width, weight in zip(point.widths_um, point.weights, strict=True):
        kernel += (
            weight
            / (np.pi * width**2)
            * np.outer(np.exp(-((y / width) ** 2)), np.exp(-((x / width) ** 2)))
        )
    if hollow:
        kernel[0, 0] = 0
    return RadialConvolution(fft.rfft2(kernel), shape, (rows, columns))
