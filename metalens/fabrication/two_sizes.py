"""Pillars of two sizes under change: t by the table of their lens at any sizes, and the
answers of a solver.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RectBivariateSpline

from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.fabrication.own import pair_rates
from metalens.fabrication.perturbations import with_missing
from metalens.lens import DiameterMap, Lens

_PAIRS = 24  # that are solved
_DARKEST = 1e-3  # |t| that a tangent beyond a table falls to at most
_ENTRY_UM = 5e-5  # by which sizes differ that are of two kinds


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
        """Of a lens, for its light at its wavelength.

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
        """(*shape) of the table."""
        x = np.clip(width_um, self.x_um[0], self.x_um[-1])
        y = np.clip(length_um, self.y_um[0], self.y_um[-1])
        value = self._spline(x, y)
        if (x == width_um).all() and (y == length_um).all():
            return value
        rate = (width_um - x) * self._spline(x, y, dx=1) + (
            length_um - y
        ) * self._spline(x, y, dy=1)
        level = np.clip(
            np.abs(value) + (rate * value.conj()).real / np.abs(value), _DARKEST, 1.0
        )
        return np.asarray(level * np.exp(1j * (np.angle(value) + (rate / value).imag)))

    def _spline(self, x_um: Array, y_um: Array, *, dx: int = 0, dy: int = 0) -> Array:
        real, imaginary = (part.ev(x_um, y_um, dx=dx, dy=dy) for part in self.parts)
        return np.asarray(real + 1j * imaginary)


@dataclass(frozen=True, eq=False, slots=True)
class Kinds:
    """The kinds of pillars that a lens has: (kinds,) width_um, length_um and count of
    each, rising.

    keys: (kinds,) by which :meth:`index` knows them.
    """

    width_um: Array
    length_um: Array
    count: Array
    keys: Array

    @classmethod
    def of(cls, diameters: DiameterMap) -> "Kinds":
        """Of a map; pillars of one size have a length of 0."""
        used, count = np.unique(
            _keys(diameters, slice(None), slice(None)), return_counts=True
        )
        empty = int(used[0] == 0)
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
        """(y, x) kind of each site, from 0 on; as many as there are kinds where no
        pillar stands.
        """
        keys = _keys(diameters, rows, columns)
        return np.where(
            keys > 0, np.searchsorted(self.keys, keys), len(self.keys)
        ).astype(np.int32)


def _keys(diameters: DiameterMap, rows: slice, columns: slice) -> Array:
    """(y, x) whole numbers that tell both sizes of every site; 0 for no pillar."""
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


@dataclass(frozen=True, eq=False, slots=True)
class PairSensitivities:
    """Logarithmic derivatives of t by the pillar-response errors, of pillars of two
    sizes and one polarisation.

    width_um, length_um: (n,) pairs that were solved. rates: (pillar-response errors, n)
        complex, by the base unit of each (um, rad, 1). error: largest relative change
        of one of them from a coarser truncation, and what the rates of the second half
        of the pairs differ by from those of the first half, carried there.
    """

    width_um: Array
    length_um: Array
    rates: Array
    error: float

    def at(self, width_um: Array, length_um: Array) -> Array:
        """(pillar-response errors, n) derivatives of ln t."""
        found = _interpolate_rates(
            (self.width_um, self.length_um), self.rates, (width_um, length_um)
        )
        return with_missing(list(found))


def pair_sensitivities(
    lens: Lens, *, count: int = _PAIRS
) -> dict[str, PairSensitivities]:
    """For light along "x" and along "y": derivatives of ln t at up to ``count`` pairs
    of the lens, far from each other.

    Exact ones of RCWA at a fixed truncation; between the pairs by radial functions |r -
    r_j| of both sizes.

    Raises:
        CellError, MaterialError: from the solver.
    """
    kinds = Kinds.of(lens.diameters)
    pairs = np.stack([kinds.width_um, kinds.length_um], 1)
    width, length = pairs[_farthest_points(pairs, int(kinds.count.argmax()), count)].T
    found = pair_rates(lens, width, length)
    return {
        light: PairSensitivities(
            width,
            length,
            each.rates,
            each.error + _held_out_error(width, length, each.rates),
        )
        for light, each in found.items()
    }


def _farthest_points(points: Array, first: int, count: int) -> list[int]:
    """The first, then always the point that is farthest from all before it."""
    chosen = [first]
    away = np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < count and away.max() > 0:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen


def _interpolate_rates(
    nodes: tuple[Array, Array], rates: Array, places: tuple[Array, Array]
) -> Array:
    """(causes, places) rates between the nodes."""
    from scipy.interpolate import RBFInterpolator

    return np.asarray(
        RBFInterpolator(np.stack(nodes, 1), rates.T, kernel="linear", degree=0)(
            np.stack(places, 1)
        ).T
    )


def _held_out_error(width_um: Array, length_um: Array, rates: Array) -> float:
    """Largest rms error over causes, relative, of the second half of the pairs from the
    first.
    """
    half = (len(width_um) + 1) // 2
    if half == len(width_um):
        return 0.0
    fitted, judged = slice(half), slice(half, None)
    predicted = _interpolate_rates(
        (width_um[fitted], length_um[fitted]),
        rates[:, fitted],
        (width_um[judged], length_um[judged]),
    )
    off = np.linalg.norm(predicted - rates[:, judged], axis=1) / np.maximum(
        np.linalg.norm(rates[:, judged], axis=1), 1e-9
    )
    known = np.abs(rates).max(1) > 1e-6 * np.abs(rates).max()
    return float((off * known).max())
