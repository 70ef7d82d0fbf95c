"""Sums over all shapes of a smooth kernel, through a coarse grid: cubic interpolation
and its transpose.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from layout.mask.plan import PillarArray
from layout.pec.psf import PointExposure
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

MOST_NODES = 40_000_000
NODES_PER_WIDTH = 6  # nodes along the 1/e radius of the narrowest Gaussian


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

    def weights(self, position_um: Array) -> Any:
        """(n, count) sparse matrix: values at positions (n,) from those on the nodes,
        by cubic Lagrange interpolation between four nodes each.
        """
        from scipy.sparse import csr_array

        steps = (np.asarray(position_um, float) - self.origin_um) / self.spacing_um
        first = np.clip(np.floor(steps).astype(np.int64) - 1, 0, self.count - 4)
        t = steps - first - 1
        inner = (-t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2)
        outer = (-(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6)
        node = first[:, None] + np.arange(4)
        rows = np.arange(0, node.size + 1, 4)
        values = np.stack([*inner, *outer], -1).ravel()
        return csr_array((values, node.ravel(), rows), (len(first), self.count))


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
        step = width_um / NODES_PER_WIDTH
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
        across = self.x.weights(x_um).multiply(np.asarray(mass, float)[:, None])
        return np.asarray((self.y.weights(y_um).T @ across.tocsr()).toarray())

    def gather(self, lattice: PillarArray, value: Array, sums: Array) -> None:
        """Add what the pillars of a lattice carry to node sums (fields, y, x).

        Args:
            lattice: of class numbers.
            value: (fields, classes + 1) amount that each pillar of a class carries.
            sums: changed in place.
        """
        across = self.x.weights(lattice.columns_um)
        for first, block in lattice.blocks():
            down = self.y.weights(lattice.rows_um(first, len(block)))
            for total, amount in zip(sums, value, strict=True):
                total += down.T @ (amount[block] @ across)

    def convolution(self, point: PointExposure) -> "RadialConvolution":
        """Convolution of node sums with Gaussians."""
        spacing = self.y.spacing_um, self.x.spacing_um
        return gaussian_convolution(self.shape, spacing, point=point, hollow=False)

    def sample(self, field: Array, x_um: Array, y_um: Array) -> Array:
        """(n,) values of a node field at any places."""
        across, down = self.x.weights(x_um), self.y.weights(y_um)
        columns, rows = (each.indices.reshape(-1, 4) for each in (across, down))
        nodes = field[rows[:, :, None], columns[:, None]]
        weights = (each.data.reshape(-1, 4) for each in (down, across))
        return np.asarray(np.einsum("nij,ni,nj->n", nodes, *weights))


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
        down = self.grid.y.weights(lattice.rows_um(first, count))
        across = self.grid.x.weights(lattice.columns_um)
        exposure = np.asarray((across @ (down @ self.far).T).T, np.float32)
        return (
            exposure + self.near[number][first : first + count]
            if self.near
            else exposure
        )


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
