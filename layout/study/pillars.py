"""What t of the pillars of a lens follows from, each kind of them once, under any local bias and answering cause."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import RectBivariateSpline

from layout.study.sensitivity import PairSensitivities, Sensitivities
from metalens.ground.arrays import Array
from metalens.lens import Lens
from metalens.made import State, transmission
from metalens.pillars import Proxy

_ENTRY_UM = 5e-5  # resolution of the sizes
_DARKEST = 1e-3  # |t| that a tangent beyond a table falls to at most


class Pillars(Protocol):
    """Kinds of pillars, of one size or of two."""

    def curve(self, bias_um: Array, state: State) -> Array:
        """(bias, kinds) complex t for local biases and one made lens."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class OneSize:
    """t by the proxy of the lens at its wavelength, and the answers of a solver; diameter_um: (kinds,)."""

    proxy: Proxy
    wavelength_um: float
    sens: Sensitivities
    diameter_um: Array

    def curve(self, bias_um: Array, state: State) -> Array:
        """(bias, kinds) complex t for local biases and one made lens."""
        bias = np.reshape(bias_um, (-1, 1))
        d = self.diameter_um + bias
        return transmission(self.proxy, self.sens, d, self.wavelength_um, state.answers(), bias_um=bias)


@dataclass(frozen=True, eq=False, slots=True)
class TwoSizes:
    """t by a table over both sizes, and the answers of a solver.

    A bias moves all edges, so both sizes alike: cubic splines of Re t and Im t through the entries of the table, and
    from its ends on along their tangents.

    width_um, length_um: (kinds,). rates: (causes, kinds) of ln t. x_um, y_um: of the table. parts: of t there.
    """

    width_um: Array
    length_um: Array
    rates: Array
    x_um: Array
    y_um: Array
    parts: tuple[RectBivariateSpline, RectBivariateSpline]

    def curve(self, bias_um: Array, state: State) -> Array:
        """(bias, kinds) complex t for local biases and one made lens."""
        bias = np.reshape(bias_um, (-1, 1))
        change = np.exp(np.tensordot(state.answers(), self.rates, 1))
        return np.asarray(self.t(self.width_um + bias, self.length_um + bias) * change)

    def t(self, width_um: Array, length_um: Array) -> Array:
        """(*shape) of the table."""
        x, y = np.clip(width_um, self.x_um[0], self.x_um[-1]), np.clip(length_um, self.y_um[0], self.y_um[-1])
        value = self._spline(x, y)
        if (x == width_um).all() and (y == length_um).all():
            return value
        rate = (width_um - x) * self._spline(x, y, dx=1) + (length_um - y) * self._spline(x, y, dy=1)
        level = np.clip(np.abs(value) + (rate * value.conj()).real / np.abs(value), _DARKEST, 1.0)
        return np.asarray(level * np.exp(1j * (np.angle(value) + (rate / value).imag)))

    def _spline(self, x_um: Array, y_um: Array, *, dx: int = 0, dy: int = 0) -> Array:
        real, imaginary = (part.ev(x_um, y_um, dx=dx, dy=dy) for part in self.parts)
        return np.asarray(real + 1j * imaginary)


def kinds(lens: Lens, sens: Sensitivities | PairSensitivities) -> tuple[Array, Array, Pillars]:
    """((y, x) kind of each site from 1 on, 0 none; (kinds,) how many of each; what their t follows from)."""
    width = np.rint(np.asarray(lens.diameters.diameter_um) / _ENTRY_UM).astype(np.int64)
    length = lens.diameters.length_um
    long = 0 if length is None else np.rint(np.asarray(length) / _ENTRY_UM).astype(np.int64)
    used, place, count = np.unique(
        np.where(width > 0, (width << 32) + long, 0), return_inverse=True, return_counts=True
    )
    empty = int(used[0] == 0)
    index = (place.reshape(width.shape) + 1 - empty).astype(np.int32)
    size, other = (used[empty:] >> 32) * _ENTRY_UM, (used[empty:] & 0xFFFFFFFF) * _ENTRY_UM
    if isinstance(sens, Sensitivities):
        return index, count[empty:], OneSize(lens.proxy, lens.wavelength_um, sens, size)
    return index, count[empty:], _two_sizes(lens, sens, size, other)


def _two_sizes(lens: Lens, sens: PairSensitivities, width_um: Array, length_um: Array) -> TwoSizes:
    pairs = lens.pairs
    if pairs is None:
        raise TypeError("a table of pairs is needed for answers by two sizes")
    x, y = pairs.x_um, pairs.y_um
    t = pairs.amplitude(*np.meshgrid(x, y, indexing="ij"), lens.wavelength_um, lens.light)
    degree = {"kx": min(3, len(x) - 1), "ky": min(3, len(y) - 1)}
    parts = RectBivariateSpline(x, y, t.real, **degree), RectBivariateSpline(x, y, t.imag, **degree)
    return TwoSizes(width_um, length_um, sens.at(width_um, length_um), x, y, parts)
