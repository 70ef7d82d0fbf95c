"""The propagation kernel from a lens to a sensor window, split into factors of two
coordinates each and a smooth remainder.
"""

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import spherical_jn

from characterize.model.glass import AIR, FilmStack
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.optics.paths import hypot_minus_length

# least tolerance of a field in single precision: :func:`least_tolerance` of 4000
# columns is 4e-5
SINGLE = 1e-4
_USUAL = 5e-4  # tolerance that the counts of nodes below are written for
_COARSE = 9  # places a coordinate at which slopes of the remainder are sampled
_BLOCK = 24  # columns a step of the range finder
_STOP = 0.2  # share of the tolerance that may remain outside the range
Span = tuple[float, float]


@dataclass(frozen=True, slots=True)
class CompressedKernel:
    """d / (2 pi r²) (1/r - ik) exp(ik(r - r_w)) of one wavelength and distance.

    Through films r is the path of the ray, and d / r² is √(passed / spread) of
    :mod:`metalens.optics.media`.

    p, q: spans of direction cosines of the lens seen from the window's centre, at the
    nominal distance.
    nominal_um, distance_um: lens to sensor. tangents: (x, y) of the chief ray, in air.
    films: between them.
    nodes_um: distance in air that p and q are counted at; None for the nominal one.
    """

    k: float
    p: Span
    q: Span
    nominal_um: float
    distance_um: float
    tangents: tuple[float, float] = (0.0, 0.0)
    films: FilmStack = AIR
    nodes_um: float | None = None

    def path(
        self, p: Array | float, q: Array | float, X: Array | float, Y: Array | float
    ) -> tuple[Array, Array]:
        """Path difference r - r_w, um, of a node to (X, Y) and to the window's centre.

        Computed without cancellation. The node is that of direction cosines (p, q).

        Returns:
            (r - r_w, ray): ``ray`` is r in air, um; through films the squared lateral
            distance, um².
        """
        d = self.distance_um
        dx, dy = self._across(p, q)
        change2 = X * X + Y * Y + 2 * (X * dx + Y * dy)
        if self.films.none_behind:
            r_w = np.sqrt(dx**2 + dy**2 + d**2)
            path = hypot_minus_length(r_w, change2)
            return np.asarray(path), np.asarray(r_w + path)
        near2 = np.asarray(dx**2 + dy**2)
        far2 = near2 + change2
        rays = self.films.rays(d, max(near2.max(), far2.max()))
        return np.asarray(rays.chord(far2) - rays.chord(near2)), far2

    def _across(self, p: Array | float, q: Array | float) -> tuple[Any, Any]:
        """(x, y) from the nodes (p, q) to the window's centre, um."""
        off = self.distance_um - self.nominal_um
        tx, ty = self.films.drift(self.tangents)
        cosine = np.sqrt(1 - np.square(p) - np.square(q))
        r_0 = (self.nodes_um or self.nominal_um) / cosine
        return off * tx - r_0 * p, off * ty - r_0 * q

    def amplitude(self, ray: Array) -> tuple[Array, Array]:
        """(size, r) of the amplitude size (1/r - ik) exp(ikr).

        Args:
            ray: as :meth:`path` returns it.
        """
        if self.films.none_behind:
            return self.distance_um / (2 * np.pi * ray**2), ray
        rays = self.films.rays(self.distance_um, ray.max())
        return np.asarray(rays.level(ray) / (2 * np.pi)), np.asarray(
            rays.along_um + rays.chord(ray)
        )

    def window(self, X: Array, Y: Array) -> Array:
        """Window factor exp(ik H(X, Y)); arguments broadcast."""
        return np.asarray(np.exp(1j * self.k * self._by_window(X, Y)))

    def by_x(self, p: Array | float, X: Array, off_um: float = 0.0) -> Array:
        """Path difference F(p, b, X, 0), um, b the middle of q; arguments broadcast.

        Args:
            off_um: added to the distance of the sensor.
        """
        return self._off(off_um).path(p, _middle(self.q), X, 0.0)[0]

    def by_y(self, q: Array | float, Y: Array, off_um: float = 0.0) -> Array:
        """Path difference F(a, q, 0, Y), um, a the middle of p; arguments broadcast.

        Args:
            off_um: added to the distance of the sensor.
        """
        return self._off(off_um).path(_middle(self.p), q, 0.0, Y)[0]

    def _off(self, off_um: float) -> "CompressedKernel":
        return (
            dataclasses.replace(self, distance_um=self.distance_um + off_um)
            if off_um
            else self
        )

    def bands(self, wy: float, wx: float) -> tuple[float, float]:
        """(along y, along x) highest spatial frequency of the field, rad/um.

        On a window of half sides (wy, wx), less the carrier of the middle direction: k
        times the largest difference of dF/dY and dF/dX from those of (a, b).
        """
        t = np.linspace(-1, 1, _COARSE)
        Y, X, q, p = np.meshgrid(
            wy * t, wx * t, _on(self.q, t), _on(self.p, t), indexing="ij", sparse=True
        )
        slope_x, slope_y = self.turning(p, q, X, Y)
        return self.k * float(np.abs(slope_y).max()), self.k * float(
            np.abs(slope_x).max()
        )

    def turning(
        self, p: Array, q: Array, X: Array | float, Y: Array | float
    ) -> tuple[Array, Array]:
        """(dF/dX, dF/dY) less those of the middle direction (a, b) along its own axis.

        Times k: local spatial frequency of the field without its carrier.
        """
        a, b = _middle(self.p), _middle(self.q)
        by_x, by_y = self._steep(p, q, X, Y)
        return by_x - self._steep(a, b, X, 0.0)[0], by_y - self._steep(a, b, 0.0, Y)[1]

    def moved(self, name: str, share: float) -> "CompressedKernel":
        """The kernel with ``distance`` or ``wave`` (wavelength) longer by a share."""
        if name == "distance":
            return dataclasses.replace(self, distance_um=self.distance_um * (1 + share))
        return dataclasses.replace(self, k=self.k / (1 + share))

    def _steep(
        self, p: Array | float, q: Array | float, X: Array | float, Y: Array | float
    ) -> tuple[Array, Array]:
        """dF/dX and dF/dY at (X, Y): direction cosines of the node seen from there."""
        dx, dy = self._across(p, q)
        ray = self.path(p, q, X, Y)[1]
        bend = ray
        if not self.films.none_behind:
            bend = self.films.rays(self.distance_um, ray.max()).bend(ray)
        return np.asarray((X + dx) / bend), np.asarray((Y + dy) / bend)

    def rest(
        self, p: Array, q: Array, X: Array, Y: Array, kind: Any = np.complex64
    ) -> Array:
        """The kernel less its three phase factors, as complex numbers of ``kind``.

        Amplitude times exp(ik (F - F_x - F_y - H)); arguments broadcast.
        """
        path, ray = self._left(p, q, X, Y)
        size, r = self.amplitude(ray)
        fade = (1 / r).astype(real_of(kind)) - np.dtype(kind).type(1j * self.k)
        return np.asarray(
            size.astype(real_of(kind)) * fade * wrapped_phasors(self.k * path, kind)
        )

    def counts(
        self, wy: float, wx: float, tolerance: float = _USUAL
    ) -> tuple[int, int]:
        """Legendre nodes an axis for :meth:`rest`: (of the window, of the directions).

        exp(ist) needs s + O(s^(1/3)) terms, s the phase over half a span. Path and
        amplitude have branch points where r = 0, at imaginary X of about the distance,
        and at p² + q² = 1: there terms fall as exp(-n / branch).

        Args:
            wy: half side of the window along y, um.
            wx: the same along x.
        """
        digits = extra_digits(tolerance)
        t = np.linspace(-1, 1, _COARSE)
        Y, X, q, p = np.meshgrid(
            wy * t, wx * t, _on(self.q, t), _on(self.p, t), indexing="ij", sparse=True
        )
        phase = self.k * self._left(p, q, X, Y)[0]
        slopes = [
            float(np.abs(np.diff(phase, axis=axis)).max()) / (t[1] - t[0])
            for axis in range(4)
        ]
        branch = 1 / math.asinh(self.films.reduced_um(self.distance_um) / max(wy, wx))
        window_terms = _terms(max(slopes[:2]), tolerance) + (6 + digits) * branch
        window = max(12, math.ceil((14 + digits) * branch), math.ceil(window_terms))
        aperture = int(
            (10 + 16 * float(np.abs([self.p, self.q]).max())) * (1 + digits / 8)
        )
        return window, max(aperture, _terms(max(slopes[2:]), tolerance))

    def _left(self, p: Array, q: Array, X: Array, Y: Array) -> tuple[Array, Array]:
        path, ray = self.path(p, q, X, Y)
        return path - self.by_x(p, X) - self.by_y(q, Y) - self._by_window(X, Y), ray

    def _by_window(self, X: Array, Y: Array) -> Array:
        a, b = _middle(self.p), _middle(self.q)
        return np.asarray(self.path(a, b, X, Y)[0] - self.by_x(a, X) - self.by_y(b, Y))


def wrapped_phasors(phase: Array, kind: Any = np.complex64) -> Array:
    """exp(i phase) as complex numbers of type ``kind``.

    The phase is wrapped in double precision first. A complex phase attenuates.
    """
    if np.iscomplexobj(phase):
        return np.exp(1j * phase).astype(kind)
    out = np.empty(np.shape(phase), kind)
    turns = phase * (1 / (2 * np.pi))
    wrapped = (turns - np.rint(turns)).astype(out.real.dtype) * out.real.dtype.type(
        2 * np.pi
    )
    out.real, out.imag = np.cos(wrapped), np.sin(wrapped)
    return out


def extra_digits(tolerance: float) -> float:
    """ln(5e-4 / tolerance), the digits beyond the usual accuracy, or 0.

    Args:
        tolerance: relative error that is allowed.
    """
    return max(0.0, math.log(_USUAL / tolerance))


def complex_precision(tolerance: float) -> Any:
    """Complex numbers that hold a field to ``tolerance``.

    Raises:
        FitError: not even double precision does.
    """
    if not 1e-9 <= tolerance < 1:
        raise FitError(
            f"tolerance {tolerance:g} of the field: need 1e-9 to 1; the pillars are not known better"
        )
    return np.complex64 if tolerance >= SINGLE else np.complex128


def real_of(kind: Any) -> Any:
    """Real numbers in the precision of complex ones.

    Args:
        kind: number type.
    """
    return np.empty(0, kind).real.dtype


def least_tolerance(table: Array) -> float:
    """Least relative tolerance of :func:`low_rank_factors` above rounding.

    Projections of a block of the ``table`` are sums over a column, rounded to
    eps sqrt(rows) of the norm. Below that the search would mistake rounding for range.
    """
    return float(np.finfo(table.dtype).eps) * math.sqrt(max(table.shape)) / _STOP


def low_rank_factors(table: Array, tolerance: float) -> tuple[Array, Array, Array]:
    """Low-rank factors (m, r) and (r, n) of ``table`` (m, n), to a relative tolerance.

    Randomised range finder (Halko, Martinsson and Tropp 2011): random blocks extend an
    orthonormal basis until a fifth of the tolerance is outside it. A singular value
    decomposition in that basis then gives the least rank.

    Args:
        tolerance: of the Frobenius norm, relative.

    Returns:
        (columns, rows, (r,) share of the norm that is missing before each term).

    Raises:
        FitError: the tolerance is below what the table's precision allows; see
            :func:`least_tolerance`.
    """
    least = least_tolerance(table)
    if tolerance < least:
        raise FitError(
            f"{table.dtype} tables of {table.shape} hold {least:.1g} of their norm, not {tolerance:g}"
        )
    rng = np.random.default_rng(0)
    total = float(np.linalg.norm(table)) ** 2
    basis = np.empty((len(table), 0), table.dtype)
    most = min(table.shape)
    power_outside = total
    while basis.shape[1] < most:
        count = min(_BLOCK, most - basis.shape[1])
        block = table @ rng.standard_normal((table.shape[1], count)).astype(
            table.real.dtype
        )
        block -= basis @ (basis.conj().T @ block)
        # its expectation is the power outside the range
        power_outside = float(np.linalg.norm(block)) ** 2 / count
        if power_outside < (_STOP * tolerance) ** 2 * total:
            break
        # orthogonalised twice: enough against rounding
        block = np.linalg.qr(block)[0]
        block = np.linalg.qr(block - basis @ (basis.conj().T @ block))[0]
        basis = np.concatenate([basis, block], 1)
        power_outside = 0.0
    rows = basis.conj().T @ table
    # not from rows @ rows^H: squares of singular values would lose half the digits
    triangle = np.linalg.qr(rows.conj().T.astype(complex))[1].conj().T
    vectors, singular, _ = np.linalg.svd(triangle)
    remainder = np.sqrt((np.cumsum(singular[::-1] ** 2)[::-1] + power_outside) / total)
    rank = max(1, int((remainder > tolerance).sum()))
    vectors = vectors[:, :rank].astype(table.dtype)
    return basis @ vectors, vectors.conj().T @ rows, remainder[:rank]


def _terms(slope: float, tolerance: float) -> int:
    """Number of Legendre terms of exp(i slope t) on [-1, 1] to ``tolerance`` / 50.

    The power of term n is (2n+1) j_n(slope)².
    """
    n = np.arange(int(slope + 60 + 8 * slope ** (1 / 3)))
    power = (2 * n + 1) * spherical_jn(n, slope) ** 2
    return 1 + int((np.sqrt(np.cumsum(power[::-1])[::-1]) > tolerance / 50).sum())


def _middle(span: Span) -> float:
    return (span[0] + span[1]) / 2


def _on(span: Span, t: Array) -> Array:
    return np.asarray(_middle(span) + (span[1] - span[0]) / 2 * t)
