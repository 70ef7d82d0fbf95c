"""A lens gathered on coarse nodes, and its field on a sensor window: phases of one
coordinate each, times a smooth remainder of low rank.
"""

import copy
import dataclasses
import functools
import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from characterize.model.glass import BenchGeometry, FilmStack
from characterize.model.pillars import PillarResponse
from metalens.core import legendre, threads
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.lens import Lens
from metalens.optics import media

_MOST_NODES = 600
# tolerance of the nodes of a window: nearer ones to its ends amplify rounding
_EVEN_ENOUGH = 1e-4
_TRIAL = 96  # nodes at which the remainder of the kernel is sampled, most it needs
_CELL = 0.005  # relative width of the cells of distance, each with its coupling terms
_STEP = 1e-3  # relative step of the distance for derivatives of the terms
_SHARE_OF_P = 0.1  # share of the tolerance for the functions of p in the terms
# the same where terms are left out too: it adds an eighth to their error
_SHARE_OF_P_CUT = 0.5
_OFF_LENS = 0.1  # weight of directions off the lens in the low-rank terms
Samples = tuple[int, float, float]  # number, first and last place of an axis, um
_KEPT = 24  # sets of coupling terms: for the windows and distances of several fits


@dataclass(frozen=True, slots=True)
class EvenNodes:
    """Nearly even places on [low, high]: arcsin(pull t) / arcsin(pull) of Gauss-Legendre
    nodes t (Kosloff and Tal-Ezer 1993).

    A wave of n radians a half span needs n + O(n^(1/3)) Legendre nodes, which crowd at
    the ends; of these about 0.7 n. The nearer ``pull`` is to 1, the more even the
    nodes, and the closer the branch of arcsin comes to their ends.
    """

    count: int
    low: float
    high: float
    pull: float

    @classmethod
    def of(cls, count: int, span: tuple[float, float], tolerance: float) -> "EvenNodes":
        """Nodes that resolve a wave to a relative ``tolerance``."""
        reach = (math.log(1e5 / tolerance) + count / 60) / count
        return cls(count, *span, 1 / math.cosh(reach))

    @classmethod
    def of_phase(
        cls, phase_rad: float, span: tuple[float, float], tolerance: float
    ) -> "EvenNodes":
        """The fewest nodes for waves of ``phase_rad`` over half the span.

        The Legendre series of such a wave falls below ``tolerance`` after
        phase + 8 + 2 phase^(1/3) terms at 5e-4, and 1.5 more for each factor e below.
        """
        terms = phase_rad + 8 + 2 * (phase_rad + 1) ** (1 / 3)
        terms += 1.5 * max(0.0, math.log(5e-4 / tolerance))
        enough = (
            cls.of(count, span, tolerance)
            for count in itertools.count(12)
            if count * cls.of(count, span, tolerance).density >= terms
        )
        return next(enough)

    @property
    def density(self) -> float:
        """Density in the middle over that of Gauss-Legendre nodes."""
        return math.asin(self.pull) / self.pull

    @property
    def places(self) -> Array:
        """(count,) places of the nodes."""
        nodes = legendre.gauss_legendre_nodes(self.count)[0]
        t = np.arcsin(self.pull * nodes) / math.asin(self.pull)
        return np.asarray((self.low + self.high) / 2 + (self.high - self.low) / 2 * t)

    def interpolation(self, values: Array) -> Array:
        """(*values, count) interpolation matrix from the nodes to ``values``."""
        t = (2 * values - self.low - self.high) / (self.high - self.low)
        t = np.sin(math.asin(self.pull) * t) / self.pull
        return np.asarray(legendre.interpolation_matrix(self.count, t))


@dataclass(frozen=True, slots=True)
class SmoothKernel:
    """Rayleigh-Sommerfeld kernel d / (2 pi r²) (1/r - ik) exp(ik(r - r_m)) from nodes
    of a lens to a window (X, Y), r_m the path of the middle node.

    Through films r is the path of the ray, and d / r² is √(passed / spread) of
    :mod:`metalens.optics.media`. Its phase is split into F_x(p, X), F_y(q, Y) and a
    smooth remainder.

    p, q: spans of direction cosines of the lens seen from the window's centre, at the
    nominal distance; a, b their middles.
    nominal_um, distance_um: lens to sensor. tangents: (x, y) of the chief ray, in air.
    films: between them. nodes_um: distance in air that p and q are counted at.
    """

    k: float
    p: tuple[float, float]
    q: tuple[float, float]
    nominal_um: float
    distance_um: float
    tangents: tuple[float, float]
    films: FilmStack
    nodes_um: float

    @property
    def middle(self) -> tuple[float, float]:
        """(a, b) direction cosines of the middle node."""
        return sum(self.p) / 2, sum(self.q) / 2

    def path(self, p: Any, q: Any, X: Any, Y: Any) -> tuple[Array, Array]:
        """(F, squared lateral distance): path r - r_w, um, of node (p, q) to (X, Y) and
        to the window's centre, without cancellation; um².
        """
        off_um = self.distance_um - self.nominal_um
        tx, ty = self.films.drift(self.tangents)
        r_0 = self.nodes_um / np.sqrt(1 - np.square(p) - np.square(q))
        dx, dy = off_um * tx - r_0 * p, off_um * ty - r_0 * q
        near2 = np.asarray(dx**2 + dy**2)
        change2 = X * X + Y * Y + 2 * (X * dx + Y * dy)
        path_um = self.films.path_change(self.distance_um, near2, change2)
        return path_um, near2 + change2

    def phase_x(self, p: Any, X: Array) -> Array:
        """k (F_x(p, X) - F_x(a, X)) with F_x(p, X) = F(p, b, X, 0), rad."""
        a, b = self.middle
        return np.asarray(
            self.k * (self.path(p, b, X, 0)[0] - self.path(a, b, X, 0)[0])
        )

    def phase_y(self, q: Any, Y: Array) -> Array:
        """k (F_y(q, Y) - F_y(b, Y)) with F_y(q, Y) = F(a, q, 0, Y), rad."""
        a, b = self.middle
        return np.asarray(
            self.k * (self.path(a, q, 0, Y)[0] - self.path(a, b, 0, Y)[0])
        )

    def remainder(self, p: Any, q: Any, X: Any, Y: Any) -> Array:
        """The kernel less its phases :meth:`phase_x` and :meth:`phase_y`; arguments
        broadcast.
        """
        path_um, reach2 = self.path(p, q, X, Y)
        middle_um = self.path(*self.middle, X, Y)[0]
        phase = self.k * (path_um - middle_um) - self.phase_x(p, X) - self.phase_y(q, Y)
        size, r = self.films.amplitude(self.distance_um, reach2)
        return np.asarray(size * (1 / r - 1j * self.k) * np.exp(1j * phase))


@dataclass(frozen=True, eq=False, slots=True)
class CouplingTerms:
    """Low-rank remainder of the kernel for a cell of distances, on the samples of a window.

    R(Y, X; q, p) = sum over r, b of (window[0] + ε window[1])[Y, r, X] amounts[q, r, b]
    across[b, p], with ε the distance over that of the cell, less 1.

    kernel: of the middle of the cell. axes_um: (y, x) coarse nodes of the window.
    fine: interpolation from them to the window's samples along y and x, real: fields
    are less the phase of the middle node, which no intensity depends on.
    tails: (r,) relative size of the terms from each on; tails_p: (b,) the same of the
    functions of p.
    """

    kernel: SmoothKernel
    axes_um: tuple[Array, Array]
    fine: tuple[Array, Array]
    across: Array
    amounts: Array
    window: Array
    tails: Array
    tails_p: Array


@dataclass(frozen=True, eq=False, slots=True)
class WindowOperators:
    """From nodes to a window for one wavelength and distance.

    y: (Y, q) and x: (p, X) phasors on the samples. window: (Y, r, X) of the
    terms at this distance.
    """

    y: Array
    x: Array
    window: Array
    terms: CouplingTerms

    def coarse(self, light: Array, tolerance: float = 0.0) -> Array:
        """(..., Y, X) field on the coarse nodes of (..., q, p) ``light`` on the nodes.

        The sum over r, q, b, p of W_r(Y, X) y(Y, q) a_rb(q) L(q, p) g_b(p) x(p, X).
        Terms below the relative ``tolerance`` are left out.
        """
        terms = self.terms
        r = max(1, int((terms.tails > tolerance).sum()))
        b = max(1, int((terms.tails_p > _SHARE_OF_P_CUT * tolerance).sum()))
        amounts, window = terms.amounts[:, :r, :b], self.window[:, :r]
        ny, nx = len(self.y), self.x.shape[1]
        # g_b(p) x(p, X) as a matrix (p, b X)
        by_x = (terms.across[:b, :, None] * self.x).transpose(1, 0, 2)
        by_x = by_x.reshape(len(self.x), -1)
        flat = light.astype(np.complex64, copy=False).reshape(-1, *light.shape[-2:])
        out = np.empty((len(flat), ny, nx), np.complex64)

        def sum_frames(first: int, last: int) -> None:
            frames = flat[first:last].reshape(-1, flat.shape[-1])
            # (q of all frames, b, X), then (q, r, X)
            spread = (frames @ by_x).reshape(last - first, len(amounts), -1, nx)
            for i, mixed in enumerate(amounts @ spread, first):
                parts = (self.y @ mixed.reshape(len(mixed), -1)).reshape(ny, -1, nx)
                out[i] = np.multiply(parts, window, out=parts).sum(1)

        with threads.one_blas_thread():
            threads.run_split(len(flat), sum_frames)
        return out.reshape(*light.shape[:-2], ny, nx)

    def envelope(self, coarse: Array) -> Array:
        """(..., y, x) field on the window's samples from that on the coarse ones."""
        fine_y, fine_x = self.terms.fine
        rows = real_complex_product(fine_y, coarse)
        return real_complex_product(fine_x, rows.swapaxes(-1, -2)).swapaxes(-1, -2)


def real_complex_product(weights: Array, values: Array) -> Array:
    """(..., m, k) product of real (m, n) and complex (..., n, k) numbers: half the work
    of one of complex numbers.

    Args:
        weights: (m, n) real.
        values: (..., n, k) complex.
    """
    return np.asarray(
        (weights @ np.ascontiguousarray(values).view(weights.dtype)).view(values.dtype)
    )


def wrapped_phasors(phase: Array) -> Array:
    """exp(i phase), complex64. The phase is wrapped in double precision first. A
    complex phase attenuates.
    """
    if np.iscomplexobj(phase):
        return np.exp(1j * phase).astype(np.complex64)
    out = np.empty(np.shape(phase), np.complex64)
    turns = phase * (1 / (2 * np.pi))
    wrapped = (turns - np.rint(turns)).astype(np.float32) * np.float32(2 * np.pi)
    out.real, out.imag = np.cos(wrapped), np.sin(wrapped)
    return out


def relative_tails(size: Array) -> Array:
    """(r,) norm of the singular values ``size`` from each on, over that of all."""
    return np.asarray(np.sqrt(np.cumsum(size[::-1] ** 2)[::-1] / (size**2).sum()))


class CompressedLens:
    """A lens on nodes for one field angle.

    p, q: (q, p) direction cosines of the nodes from the window's centre. x_um, y_um:
    (q, p) their places on the lens; u, v: the same over the lens radius.
    known: (q, p) phase that was removed at the nodes, rad: k times :meth:`path`.
    gathered: (r, q, p) one field for each basis function of the pillars.
    """

    def __init__(
        self,
        lens: Lens,
        pillars: PillarResponse,
        bench: BenchGeometry,
        *,
        window_um: float,
        depths_um: Array,
        tolerance: float,
    ) -> None:
        """Choose the nodes and gather the pillars on them.

        Args:
            lens: the design.
            pillars: basis functions of its pillars.
            bench: geometry of one field angle.
            window_um: side of a square about the chief ray that contains the window.
            depths_um: range of source depths, whose defocus the nodes resolve.
            tolerance: relative error of the field.
        """
        self.bench = bench
        self.tolerance = tolerance
        self.window_um = window_um
        self._layers = lens.layers
        self.films = FilmStack.of(lens.layers, bench.wavelength_um)
        # distance in air at which directions are counted
        self._near_um = self.films.reduced_um(bench.distance_um)
        self.half_um = np.array([lens.diameters.y_um[-1], lens.diameters.x_um[-1]])
        self.site_um2 = lens.diameters.site_um2
        self.radius_um = lens.diameters.radius_um
        self.k = 2 * math.pi / bench.wavelength_um
        self._terms = functools.lru_cache(_KEPT)(self._coupling)
        defocus = np.abs(1 / np.asarray(depths_um) - 1 / bench.reference_um).max()
        self._blur = self.k * float(defocus) * self.radius_um**2 / 2
        self._directions(2 * self._blur)
        self._set_fields(self._gather(lens, pillars))

    def _set_fields(self, gathered: Array) -> None:
        """Set the (r, q, p) fields on the nodes, and the coordinates and phase there."""
        self.gathered = gathered.astype(np.complex64)
        self.u, self.v = self.x_um / self.radius_um, self.y_um / self.radius_um
        self.known = self.k * self.path(self.x_um, self.y_um)

    def shaded(
        self, lens: Lens, pillars: PillarResponse, depth_um: float
    ) -> "CompressedLens":
        """The lens illuminated from ``depth_um`` through its stop.

        It shares with this one all that does not depend on the pillars.
        """
        part = copy.copy(self)
        part._set_fields(self._gather(lens, pillars, depth_um))
        return part

    def _directions(self, beyond_rad: float) -> None:
        """Set nodes of direction cosines (p, q), fine enough for the steepest wave.

        Its phase over half a span is that of the window's edge plus ``beyond_rad``.

        Raises:
            FitError: more than 600 nodes a side, or an aperture angle that is too wide.
        """
        d, (cx, cy) = self._near_um, self.center_um
        hy, hx = self.half_um
        edge = np.linspace(-1, 1, 41)
        x, y = np.meshgrid(edge * hx - cx, edge * hy - cy)
        r = np.sqrt(x**2 + y**2 + d**2)
        spans = [(float(s.min()), float(s.max())) for s in (x / r, y / r)]
        # phase over half the span of directions: of the window's edge, then in all
        swing = self.k * self.window_um / 2 * max(np.ptp(span) for span in spans) / 2
        self._p, self._q = (
            EvenNodes.of_phase(swing + beyond_rad, span, self.tolerance)
            for span in spans
        )
        if self._p.count > _MOST_NODES:
            raise FitError(
                f"window of {self.window_um:.0f} um needs {self._p.count} nodes a side; fit a smaller window"
            )
        self.p, self.q = np.meshgrid(self._p.places, self._q.places)
        if (self.p**2 + self.q**2).max() >= 0.98:
            raise FitError(
                "the aperture angle is too wide for the reduced model; need below 45 degrees across corners"
            )
        self.x_um, self.y_um = self._on_lens(self.p, self.q)

    def combined(self, weight: Array, series: Array) -> Array:
        """(q, p) field: sum over r of gathered fields times their coefficients.

        The coefficient of field r is the sum over b of weight[b] series[b, r].

        Args:
            weight: (b, q, p) real functions.
            series: (b, r) complex.
        """
        amount = np.tensordot(series.T, weight, 1)
        return np.asarray(np.einsum("rqp,rqp->qp", amount, self.gathered))

    @property
    def center_um(self) -> tuple[float, float]:
        """(x, y) of the window on the sensor at the nominal distance."""
        return self.films.chief_um(self.bench.distance_um, self.bench.tangents)

    def _gather(
        self, lens: Lens, pillars: PillarResponse, depth_um: float | None = None
    ) -> Array:
        """(r, q, p) fields of the lens on the direction nodes, one per pillar function.

        Each block of rows is summed onto (n, n) even nodes of the lens by adjoint
        interpolation; then follows :meth:`_to_directions`.

        Args:
            depth_um: of the source whose light the stop shades; None: without stop.
        """
        d = lens.diameters
        x, y = d.x_um, d.y_um
        n, r = self._p.count + 6, len(pillars.basis)
        nodes = [
            EvenNodes.of(n, (-half, half), self.tolerance) for half in self.half_um
        ]
        along, across = (
            axis.interpolation(t).astype(np.float32)
            for axis, t in zip(nodes, (y, x), strict=True)
        )
        table = np.ascontiguousarray(pillars.table().T, np.complex64)
        block = max(1, 100_000 // len(x))
        parts = [slice(start, start + block) for start in range(0, len(y), block)]
        sums = np.zeros((len(parts), n, n, 2 * r), np.float32)

        def sum_blocks(first: int, last: int) -> None:
            for i in range(first, last):
                rows = parts[i]
                filled = np.flatnonzero((d.diameter_um[rows] > 0).any(0))
                built = slice(filled[0], filled[-1] + 1) if len(filled) else slice(0)
                light = table[pillars.entries(d, rows, built)]
                light *= self._carrier(lens, rows, built, depth_um)[..., None]
                on_x = across[built].T @ light.view(np.float32)
                on_y = along[rows].T @ on_x.reshape(len(on_x), -1)
                sums[i] = on_y.reshape(n, n, 2 * r)

        with threads.one_blas_thread():
            threads.run_split(len(parts), sum_blocks)
        whole = sums.sum(0, dtype=float).view(complex)
        return self._to_directions(np.moveaxis(whole, -1, 0), nodes)

    def _carrier(
        self, lens: Lens, rows: slice, built: slice, depth_um: float | None
    ) -> Array:
        """(rows, columns) phasors that multiply a block of pillars.

        exp(i (k path + geometric phase)), times the shadow of the stop for a source at
        ``depth_um``.

        Args:
            rows: of the block.
            built: columns of the block.
        """
        d = lens.diameters
        places = d.x_um[None, built], d.y_um[rows, None]
        geometric_rad = np.broadcast_to(
            lens.geometric_rad(rows), d.diameter_um[rows].shape
        )[:, built]
        phasors = wrapped_phasors(self.k * self.path(*places) + geometric_rad)
        if depth_um is None:
            return phasors
        source = self.bench.tangents, depth_um, self.bench.wavelength_um
        shadow = lens.layers.shadow(*source, places, math.sqrt(d.site_um2))
        return np.asarray(phasors * shadow.astype(np.complex64))

    def _to_directions(self, fields: Array, nodes: list[EvenNodes]) -> Array:
        """(r, n, n) fields on lens ``nodes`` (y, x) to (r, q, p) on direction nodes.

        Adjoint interpolation, first along x, then along y.
        """
        (cx, cy), d = self.center_um, self._near_um
        x, y = nodes[1].places - cx, nodes[0].places - cy
        p = x / np.sqrt(x**2 + y[:, None] ** 2 + d**2)
        turned = np.stack(
            [fields[:, j] @ self._p.interpolation(row) for j, row in enumerate(p)], 1
        )
        cosine = np.sqrt(1 - self.p[0][:, None] ** 2)
        q = y * cosine / np.sqrt(y**2 + d**2)
        return np.stack(
            [turned[:, :, a] @ self._q.interpolation(row) for a, row in enumerate(q)], 2
        )

    def path(self, x: Array, y: Array) -> Array:
        """Path from the reference source by (x, y) on the lens to the window's centre
        at the nominal distance, less the path along the axis, um.
        """
        bench = self.bench
        before = media.source_path(
            self.films.front, x, y, bench.tangents, 1 / bench.reference_um
        )
        after = self.films.sensor_path(x, y, self.center_um, bench.distance_um)
        return np.asarray(before + after)

    def coupling(
        self, distance_um: float, axes_um: tuple[Array, Array]
    ) -> CouplingTerms:
        """Coupling terms of the cell that a distance lies in, cached.

        Args:
            axes_um: (y, x) samples of the window.
        """
        number = round(math.log(distance_um / self.bench.distance_um) / _CELL)
        rows, columns = ((len(a), float(a[0]), float(a[-1])) for a in axes_um)
        return self._terms(number, rows, columns)

    def operators(
        self, terms: CouplingTerms, *, wavelength_um: float, distance_um: float
    ) -> WindowOperators:
        """Operators from lens nodes to the window.

        The phases along each axis are those of wavelength and distance. The remainder
        is that of the nominal wavelength (1e-6 of the field for 3 nm) and of the middle
        of a cell of distances, with its slope.

        Args:
            terms: of the cell, see :meth:`coupling`.
        """
        kernel = dataclasses.replace(
            terms.kernel,
            k=2 * math.pi / wavelength_um,
            distance_um=distance_um,
            films=FilmStack.of(self._layers, wavelength_um),
        )
        y, x = terms.axes_um
        change = distance_um / terms.kernel.distance_um - 1
        window = kernel.k / self.k * (terms.window[0] + change * terms.window[1])
        return WindowOperators(
            wrapped_phasors(kernel.phase_y(self.q[:, 0], y[:, None])),
            wrapped_phasors(kernel.phase_x(self.p[0][:, None], x)),
            window.astype(np.complex64),
            terms,
        )

    def _coupling(self, number: int, rows: Samples, columns: Samples) -> CouplingTerms:
        """Low-rank terms of the remainder of a kernel and of its slope by the distance.

        Tabulated on Legendre nodes, (2 w², m²), and factored: R = sum over r, b of
        W_r(Y, X) a_rb(q) g_b(p).

        Args:
            number: of the cell of distances. rows, columns: of the window's samples.
        """
        nominal_um = self.bench.distance_um
        kernel = SmoothKernel(
            self.k,
            (self._p.low, self._p.high),
            (self._q.low, self._q.high),
            nominal_um,
            nominal_um * math.exp(_CELL * number),
            self.bench.tangents,
            self.films,
            self._near_um,
        )
        wy, wx = (max(-first, last) for _, first, last in (rows, columns))
        # a wave from the rim of the lens turns by k R / d along the window at most
        slopes = self.k * self.half_um / self.films.reduced_um(kernel.distance_um)
        nodes = [
            EvenNodes.of_phase(
                slope * (last - first) / 2,
                (first, last),
                max(self.tolerance, _EVEN_ENOUGH),
            )
            for slope, (_, first, last) in zip(slopes, (rows, columns), strict=True)
        ]
        y, x = (axis.places for axis in nodes)
        fine_y, fine_x = (
            axis.interpolation(np.linspace(first, last, count)).astype(np.float32)
            for axis, (count, first, last) in zip(nodes, (rows, columns), strict=True)
        )
        (w_y, w_x), m = self._counts(kernel, wy, wx)
        Y, X = legendre.mapped_nodes(w_y, -wy, wy), legendre.mapped_nodes(w_x, -wx, wx)
        P = legendre.mapped_nodes(m, *kernel.p)
        Q = legendre.mapped_nodes(m, *kernel.q)[:, None]
        on_lens = np.hypot(*self._on_lens(P, Q)) < 1.03 * self.radius_um
        weight = np.where(on_lens, 1.0, _OFF_LENS)

        def tabulate(share: float) -> Array:
            at = dataclasses.replace(kernel, distance_um=kernel.distance_um * share)
            places = X[:, None, None], Y[:, None, None, None]
            return (weight * at.remainder(P, Q, *places)).reshape(w_y * w_x, m * m)

        # the slope, times the largest relative offset in the cell
        slope = (tabulate(1 + _STEP) - tabulate(1 - _STEP)) * (_CELL / 4 / _STEP)
        table = np.concatenate([tabulate(1.0), slope])
        u, size, v = np.linalg.svd(table, full_matrices=False)
        tails = relative_tails(size)
        # the symmetry of a square window makes pairs of equal size: none is split
        r = int((size > 0.999 * size[tails > self.tolerance][-1]).sum())
        terms, v, tails = u[:, :r] * size[:r], v[:r], tails[:r]
        # functions of p in these: one more singular value decomposition
        mixing, size, across = np.linalg.svd(
            (v.reshape(-1, m, m) / weight).reshape(-1, m), full_matrices=False
        )
        tails_p = relative_tails(size)
        count = int((tails_p > _SHARE_OF_P * self.tolerance).sum())
        amounts = (mixing * size)[:, :count].reshape(-1, m, count).transpose(1, 0, 2)
        to_q, to_p = (
            legendre.interpolation_matrix(m, (2 * t - low - high) / (high - low))
            for t, (low, high) in ((self.q[:, 0], kernel.q), (self.p[0], kernel.p))
        )
        along_y = legendre.interpolation_matrix(w_y, y / wy)
        along_x = legendre.interpolation_matrix(w_x, x / wx)
        window = np.einsum(
            "Yi,cijr,Xj->cYrX",
            along_y,
            terms.reshape(2, w_y, w_x, -1),
            along_x,
            optimize=True,
        )
        window[1] *= 2 / _CELL
        return CouplingTerms(
            kernel,
            (y, x),
            (fine_y, fine_x),
            (across[:count] @ to_p.T).astype(np.complex64),
            (np.tensordot(to_q, amounts, 1) * self.site_um2).astype(np.complex64),
            window,
            tails,
            tails_p[:count],
        )

    def _counts(
        self, kernel: SmoothKernel, wy: float, wx: float
    ) -> tuple[tuple[int, int], int]:
        """Legendre nodes of the window (along y and x), and of the directions along an
        axis, that represent the remainder of a kernel on a window of half sides (wy,
        wx).
        """
        probes = np.array([-1.0, 0.0, 1.0])
        p, q = (np.linspace(*span, 3) for span in (kernel.p, kernel.q))
        across = {"p": p, "q": q, "X": wx * probes, "Y": wy * probes}

        def count(name: str, span: tuple[float, float]) -> int:
            others = [n for n in across if n != name]
            grid = np.meshgrid(*(across[n] for n in others), indexing="ij")
            at: dict[str, Any] = {
                n: g.reshape(-1, 1) for n, g in zip(others, grid, strict=True)
            }

            at[name] = legendre.mapped_nodes(_TRIAL, *span)
            values = kernel.remainder(**at)
            needed = legendre.needed_node_count(values, self.tolerance / 10)
            if needed > _TRIAL:
                raise FitError(
                    "the window is too large for the reduced model; fit a smaller one"
                )
            return needed

        window = count("Y", (-wy, wy)), count("X", (-wx, wx))
        return window, max(count("p", kernel.p), count("q", kernel.q))

    def _on_lens(self, p: Array, q: Array) -> tuple[Array, Array]:
        """(x, y) on the lens of direction cosines seen from the window's centre."""
        r = self._near_um / np.sqrt(1 - p**2 - q**2)
        return self.center_um[0] + r * p, self.center_um[1] + r * q
