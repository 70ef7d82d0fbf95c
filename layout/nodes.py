"""Sums over all pillars of a smooth kernel, through a coarse grid: cubic interpolation and its transpose.

A kernel that is smooth over ``step`` sites needs no sum over sites: spread each pillar to the four nearest nodes
of each axis with the weights of cubic interpolation, convolve on the nodes, and interpolate back. Both
interpolations are of order 4, also at the edge of the lens, since what is interpolated is the kernel and not
the pattern.
"""

from dataclasses import dataclass

import numpy as np

from layout.exposure import PointExposure
from metalens.store import Array


@dataclass(frozen=True, slots=True)
class Axis:
    """Nodes at every ``step``-th site, one more before the first site and two after the last.

    cells: number of intervals of ``step`` sites.
    step: sites between nodes; 1 makes nodes and sites the same.
    """

    cells: int
    step: int

    @property
    def sites(self) -> int:
        """Number of lattice sites."""
        return self.cells * self.step

    @property
    def nodes(self) -> int:
        """Number of nodes."""
        return self.cells + 3

    @property
    def weights(self) -> Array:
        """(step, 4) cubic Lagrange weights of the sites between two nodes."""
        t = np.arange(self.step) / self.step
        inner = (-t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2)
        outer = (-(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6)
        return np.stack([*inner, *outer], -1)

    def gather(self, values: Array) -> Array:
        """(..., sites) to (..., nodes): the transpose of :meth:`spread`."""
        split = values.reshape(-1, self.step) @ self.weights.astype(values.dtype)
        split = split.reshape(*values.shape[:-1], self.cells, 4)
        result = np.zeros((*values.shape[:-1], self.nodes), values.dtype)
        for offset in range(4):
            result[..., offset : offset + self.cells] += split[..., offset]
        return result

    def spread(self, values: Array) -> Array:
        """(..., nodes) to (..., sites): cubic interpolation."""
        around = np.stack([values[..., k : k + self.cells] for k in range(4)], -1)
        return np.asarray((around @ self.weights.T.astype(values.dtype)).reshape(*values.shape[:-1], self.sites))


@dataclass(frozen=True, eq=False, slots=True)
class Convolution:
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


def convolution(shape: tuple[int, int], spacing_um: float, *, point: PointExposure, hollow: bool) -> Convolution:
    """Convolution with a sum of Gaussians on nodes ``spacing_um`` apart, cut 5 widths out (exp(-25)).

    hollow: leave out what a node gives to itself.
    """
    from scipy import fft

    far = int(np.ceil(5 * float(point.widths_um.max()) / spacing_um))
    ny, nx = (fft.next_fast_len(n + min(n, far), real=True) for n in shape)
    y, x = (np.minimum(np.arange(n), n - np.arange(n)) * spacing_um for n in (ny, nx))
    kernel = np.zeros((ny, nx))
    for width, weight in zip(point.widths_um, point.weights, strict=True):
        kernel += weight / (np.pi * width**2) * np.outer(np.exp(-((y / width) ** 2)), np.exp(-((x / width) ** 2)))
    if hollow:
        kernel[0, 0] = 0
    return Convolution(fft.rfft2(kernel), shape, (ny, nx))
