"""The kernel from a lens to a sensor window, split into factors of two coordinates and a rest as smooth as can be.

With the path F(p, q, X, Y) = r - r_w, seen from the window's centre, and the lens's middle direction (a, b):
F = F(p, b, X, 0) + F(a, q, 0, Y) + H(X, Y) + rest, where H makes the rest vanish at p = a, q = b, and wherever X = 0
and q = b, or Y = 0 and p = a. The three factors are put on exactly; what the window bends by itself, and along each
axis with the direction, is in them. The rest begins with X² q²: a window as wide as the lens is far needs few nodes.
"""

import math
from dataclasses import dataclass

import numpy as np

from metalens.store import Array

_COARSE = 9  # places a coordinate at which the rest's slopes are sampled
_BLOCK = 24  # columns by which a range grows
Span = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Kernel:
    """d / (2 pi r²) (1/r - ik) exp(ik(r - r_w)) of one wavelength and distance.

    p, q: spans of direction cosines of the lens seen from the window's centre, at the nominal distance.
    nominal_um, distance_um: lens to sensor. tangents: (x, y) of the chief ray.
    """

    k: float
    p: Span
    q: Span
    nominal_um: float
    distance_um: float
    tangents: tuple[float, float] = (0.0, 0.0)

    def path(self, p: Array | float, q: Array | float, X: Array | float, Y: Array | float) -> tuple[Array, Array]:
        """(r - r_w, r), um: to a point of the window and to its centre, without cancellation."""
        d, (tx, ty) = self.distance_um, self.tangents
        r_0 = self.nominal_um / np.sqrt(1 - np.square(p) - np.square(q))
        dx, dy = (d - self.nominal_um) * tx - r_0 * p, (d - self.nominal_um) * ty - r_0 * q
        r_w = np.sqrt(dx**2 + dy**2 + d**2)
        more = X * X + Y * Y + 2 * (X * dx + Y * dy)
        r = np.sqrt(r_w**2 + more)
        return np.asarray(more / (r + r_w)), np.asarray(r)

    def along_x(self, p: Array, X: Array) -> Array:
        """exp(ik F(p, b, X, 0)); arguments broadcast."""
        return np.asarray(np.exp(1j * self.k * self._by_x(p, X)))

    def along_y(self, q: Array, Y: Array) -> Array:
        """exp(ik F(a, q, 0, Y)); arguments broadcast."""
        return np.asarray(np.exp(1j * self.k * self._by_y(q, Y)))

    def window(self, X: Array, Y: Array) -> Array:
        """exp(ik H(X, Y)); arguments broadcast."""
        return np.asarray(np.exp(1j * self.k * self._by_window(X, Y)))

    def rest(self, p: Array, q: Array, X: Array, Y: Array) -> Array:
        """What the three factors leave, with the amplitude, in single precision; arguments broadcast."""
        path, r = self._left(p, q, X, Y)
        size = (self.distance_um / (2 * np.pi * r**2)).astype(np.float32)
        fade = (1 / r).astype(np.float32) - np.complex64(1j * self.k)
        return np.asarray(size * fade * turns(self.k * path))

    def counts(self, wy: float, wx: float) -> tuple[int, int]:
        """Legendre nodes an axis for :meth:`rest` on a window of half sides (wy, wx): of the window, of the directions.

        exp(ist) needs s + O(s^(1/3)) terms, s the slope of the phase a half span. Path and amplitude branch where
        r = 0, at imaginary X of about the distance, and at p² + q² = 1.
        """
        t = np.linspace(-1, 1, _COARSE)
        Y, X, q, p = np.meshgrid(wy * t, wx * t, _on(self.q, t), _on(self.p, t), indexing="ij", sparse=True)
        turn = self.k * self._left(p, q, X, Y)[0]
        slopes = [float(np.abs(np.diff(turn, axis=axis)).max()) / (t[1] - t[0]) for axis in range(4)]
        branch = 1 / math.asinh(self.distance_um / max(wy, wx))
        window = max(12, math.ceil(14 * branch), math.ceil(_terms(max(slopes[:2])) + 6 * branch))
        aperture = 10 + int(16 * float(np.abs([self.p, self.q]).max()))
        return window, max(aperture, math.ceil(_terms(max(slopes[2:]))))

    def _left(self, p: Array, q: Array, X: Array, Y: Array) -> tuple[Array, Array]:
        path, r = self.path(p, q, X, Y)
        return path - self._by_x(p, X) - self._by_y(q, Y) - self._by_window(X, Y), r

    def _by_x(self, p: Array | float, X: Array) -> Array:
        return self.path(p, _middle(self.q), X, 0.0)[0]

    def _by_y(self, q: Array | float, Y: Array) -> Array:
        return self.path(_middle(self.p), q, 0.0, Y)[0]

    def _by_window(self, X: Array, Y: Array) -> Array:
        a, b = _middle(self.p), _middle(self.q)
        return np.asarray(self.path(a, b, X, Y)[0] - self._by_x(a, X) - self._by_y(b, Y))


def turns(phase: Array) -> Array:
    """exp(i phase) in single precision, the phase wrapped in double."""
    whole = phase * (1 / (2 * np.pi))
    small = (whole - np.rint(whole)).astype(np.float32) * np.float32(2 * np.pi)
    out = np.empty(small.shape, np.complex64)
    out.real, out.imag = np.cos(small), np.sin(small)
    return out


def factors(table: Array, tolerance: float) -> tuple[Array, Array, Array]:
    """The least columns (m, r) and rows (r, n) whose product is ``table`` (m, n) but for ``tolerance`` of its norm.

    Their number need not be known: the range is found by random blocks (Halko, Martinsson and Tropp 2011) until what
    is left is a fifth of the tolerance. Third: (r,) share of the norm that is left out before each term.
    """
    rng, total = np.random.default_rng(0), float(np.linalg.norm(table)) ** 2
    found, most, missing = np.empty((len(table), 0), table.dtype), min(table.shape), total
    while found.shape[1] < most:
        count = min(_BLOCK, most - found.shape[1])
        block = table @ rng.standard_normal((table.shape[1], count)).astype(table.real.dtype)
        block -= found @ (found.conj().T @ block)
        missing = float(np.linalg.norm(block)) ** 2 / count  # its expectation is the power that is left
        if missing < (0.2 * tolerance) ** 2 * total:
            break
        block = np.linalg.qr(block)[0]  # twice is enough to be orthogonal to what is there
        found = np.concatenate([found, np.linalg.qr(block - found @ (found.conj().T @ block))[0]], 1)
        missing = 0.0
    rows = found.conj().T @ table
    power, turn = np.linalg.eigh((rows @ rows.conj().T).astype(complex))
    power, turn = np.maximum(power[::-1], 0), turn[:, ::-1].astype(table.dtype)
    remainder = np.sqrt((np.cumsum(power[::-1])[::-1] + missing) / total)
    rank = max(1, int((remainder > tolerance).sum()))
    return found @ turn[:, :rank], turn[:, :rank].conj().T @ rows, remainder[:rank]


def _terms(slope: float) -> float:
    return float(slope + 8 + 2.5 * (slope + 1) ** (1 / 3))


def _middle(span: Span) -> float:
    return (span[0] + span[1]) / 2


def _on(span: Span, t: Array) -> Array:
    return np.asarray(_middle(span) + (span[1] - span[0]) / 2 * t)
