"""Pillars of two sizes under change: t by the table of their lens at any sizes, and the
rates of a solver.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import RectBivariateSpline

from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.fabrication.perturbations import LEAST_TRANSMISSION
from metalens.fabrication.solved_rates import (
    ResponseRates,
    largest_row_error,
    pair_rates,
)
from metalens.lens import DiameterMap, Lens

_ENTRY_UM = 5e-5  # resolution of sizes; equal rounded sizes are one kind


@dataclass(frozen=True, eq=False, slots=True)
class PairTable:
    """t over both sizes for one light: cubic splines of Re t and Im t, and from the
    table's ends on along its tangents.

    x_um, y_um: sizes of the table. parts: splines of both parts.
    """

    x_um: Array
    y_um: Array
    parts: tuple[RectBivariateSpline, RectBivariateSpline]

    @classmethod
    def of(cls, lens: Lens) -> "PairTable":
        """Splines of a lens's table, for its light at its wavelength.

        Raises:
            LensError: a lens whose pillars have one size.
        """
        pairs = lens.pairs
        if pairs is None:
            raise LensError(
                "the pillars have one size each: their t is that of the proxy"
            )
        x, y = pairs.x_um, pairs.y_um
        t = pairs.amplitude(
            *np.meshgrid(x, y, indexing="ij"), lens.wavelength_um, lens.light
        )
        degree = {"kx": min(3, len(x) - 1), "ky": min(3, len(y) - 1)}
        return cls(
            x,
            y,
            (
                RectBivariateSpline(x, y, t.real, **degree),
                RectBivariateSpline(x, y, t.imag, **degree),
            ),
        )

    def t(self, width_um: Array, length_um: Array) -> Array:
        """(*shape) complex t at sizes; beyond the table |t| and phase continue along
        tangents.

        |t| = |t_end| + Re(change conj(t_end)) / |t_end|, phase = arg t_end + Im(change
        / t_end), with change = dx ∂t/∂x + dy ∂t/∂y. |t| stays within 1e-3 to 1.

        Args:
            width_um: (*shape) sizes along x, um.
            length_um: (*shape) sizes along y, um.
        """
        x = np.clip(width_um, self.x_um[0], self.x_um[-1])
        y = np.clip(length_um, self.y_um[0], self.y_um[-1])
        value = self._spline(x, y)
        if (x == width_um).all() and (y == length_um).all():
            return value
        by_width = (width_um - x) * self._spline(x, y, dx=1)
        change = by_width + (length_um - y) * self._spline(x, y, dy=1)
        level = np.abs(value) + (change * value.conj()).real / np.abs(value)
        phase = np.angle(value) + (change / value).imag
        return np.asarray(np.clip(level, LEAST_TRANSMISSION, 1.0) * np.exp(1j * phase))

    def _spline(self, x_um: Array, y_um: Array, *, dx: int = 0, dy: int = 0) -> Array:
        """(*shape) complex t, or its derivative of order dx, dy, from both splines."""
        real, imaginary = (part.ev(x_um, y_um, dx=dx, dy=dy) for part in self.parts)
        return np.asarray(real + 1j * imaginary)


@dataclass(frozen=True, eq=False, slots=True)
class PillarKinds:
    """The kinds of pillars that a lens has: (kinds,) width_um, length_um and count of
    each, rising.

    keys: (kinds,) by which :meth:`index` knows them.
    """

    width_um: Array
    length_um: Array
    count: Array
    keys: Array

    @classmethod
    def of(cls, diameters: DiameterMap) -> "PillarKinds":
        """Of a map; pillars of one size have a length of 0."""
        all_sites = _keys(diameters, slice(None), slice(None))
        used, count = np.unique(all_sites, return_counts=True)
        empty = int(used[0] == 0)  # 1 where some site holds no pillar
        keys = used[empty:]
        return cls(
            (keys >> 32) * _ENTRY_UM,
            (keys & 0xFFFFFFFF) * _ENTRY_UM,
            count[empty:],
            keys,
        )

    def index(
        self,
        diameters: DiameterMap,
        rows: slice = slice(None),
        columns: slice = slice(None),
    ) -> Array:
        """(y, x) int32 kind of each site, from 0; the number of kinds where no pillar
        stands.

        Args:
            diameters: map of pillars of these kinds.
            rows: of the map.
            columns: of the map.
        """
        keys = _keys(diameters, rows, columns)
        return np.where(
            keys > 0, np.searchsorted(self.keys, keys), len(self.keys)
        ).astype(np.int32)


def _keys(diameters: DiameterMap, rows: slice, columns: slice) -> Array:
    """(y, x) integer key of both sizes of every site, in steps of 0.05 nm; 0 for no
    pillar.

    The width is in the upper 32 bits, the length in the lower (0 for one size).

    Args:
        diameters: map of the pillars.
        rows: of the map.
        columns: of the map.
    """
    width = np.rint(
        np.asarray(diameters.diameter_um[rows])[:, columns] / _ENTRY_UM
    ).astype(np.int64)
    size = diameters.length_um
    length = (
        0
        if size is None
        else np.rint(np.asarray(size[rows])[:, columns] / _ENTRY_UM).astype(np.int64)
    )
    return np.where(width > 0, (width << 32) + length, 0)


def pair_sensitivities(lens: Lens, *, count: int = 24) -> dict[str, ResponseRates]:
    """Derivatives of ln t at size pairs of the lens, for light along "x" and along "y".

    Up to ``count`` pairs far from one another are solved by RCWA, by central
    differences at a fixed truncation. Between the pairs: radial functions |r - r_j| of
    both sizes.

    Args:
        lens: of pillars of two sizes.
        count: most pairs that are solved.

    Raises:
        CellError, MaterialError: from the solver.
    """
    kinds = PillarKinds.of(lens.diameters)
    pairs = np.stack([kinds.width_um, kinds.length_um], 1)
    width, length = pairs[_farthest_points(pairs, int(kinds.count.argmax()), count)].T
    solved = pair_rates(lens, width, length)
    return {
        light: replace(rates, error=rates.error + _held_out_error(rates))
        for light, rates in solved.items()
    }


def _farthest_points(points: Array, first: int, count: int) -> list[int]:
    """Indices of a farthest-point sample: each next point is farthest from all before
    it.

    Args:
        points: (n, 2) points.
        first: index of the first.
        count: most points.
    """
    chosen = [first]
    distance = np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < count and distance.max() > 0:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(
            distance, np.linalg.norm(points - points[chosen[-1]], axis=1)
        )
    return chosen


def _held_out_error(solved: ResponseRates) -> float:
    """Largest relative rms error over causes of rates predicted at held-out pairs.

    The second half of the pairs is predicted from the first half.

    Args:
        solved: (n,) pairs of sizes.
    """
    sizes, rates = solved.sizes_um, solved.rates
    half = (len(sizes) + 1) // 2
    if half == len(sizes):
        return 0.0
    first = replace(solved, sizes_um=sizes[:half], rates=rates[:, :half])
    predicted = first.at(*sizes[half:].T)[: len(rates)]
    return largest_row_error(predicted, rates[:, half:])
