"""The lens gathered on coarse nodes, and the way from there to a sensor window."""

import copy
import dataclasses
import functools
import itertools
import math
import threading
from collections.abc import Sequence
from typing import Any

import numpy as np

from characterize.model import gather
from characterize.model.glass import BenchGeometry, FilmStack
from characterize.model.kernel import (
    CompressedKernel,
    complex_precision,
    extra_digits,
    low_rank_factors,
    real_of,
    wrapped_phasors,
)
from characterize.model.pillars import PillarResponse
from characterize.model.window import (
    MIXED,
    STEP,
    CouplingTerms,
    WindowOperators,
    axis_operators,
)
from metalens.core import legendre, threads
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.lens import Lens
from metalens.optics import media

Axes = tuple[Array, Array]
_KEPT = 12  # cached operators: for the places of several threads
# bands are rounded up to _SPARE * _WIDER**n of the nominal one: one for all distances
_SPARE, _WIDER = 1.05, 1.25
# weight of directions off the lens, and of the window's rim, in the low-rank terms
_BESIDE = 0.1


class CompressedLens:
    """A lens on nodes for one field angle.

    p, q: (q, p) direction cosines of the nodes from the window's centre. x_um, y_um:
    (q, p) their places on the lens; u, v: the same over the lens radius.
    known: (q, p) phase that was removed at the nodes, rad: k times :meth:`path`.
    gathered: (r, q, p) one field for each basis function of the pillars.
    kind: complex number type, single precision where ``tolerance`` allows it, else
    double; see :func:`complex_precision`.
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
        self.kind = complex_precision(tolerance)
        self._layers = lens.layers
        self.films = FilmStack.of(lens.layers, bench.wavelength_um)
        # distance in air at which directions are counted
        self._near_um = self.films.reduced_um(bench.distance_um)
        self.half_um = np.array([lens.diameters.y_um[-1], lens.diameters.x_um[-1]])
        self.site_um2 = lens.diameters.site_um2
        self.radius_um = lens.diameters.radius_um
        self.k = 2 * math.pi / bench.wavelength_um
        self._operators: dict[tuple[float, ...], WindowOperators] = {}
        self._near = False  # whether the nominal terms serve every place: see quick
        self._usual = dict[tuple[float, ...], CouplingTerms]()
        # operators and nominal terms of quick copies, by (window, nodes)
        self._lesser: dict[tuple[float, int], Any] = {}
        self._from_few: dict[int, Array] = {}  # interpolation matrices: see _to_nodes
        self._changing = threading.Lock()  # several fits may ask at once
        self._blur = self.k * float(
            np.abs(1 / np.asarray(depths_um) - 1 / bench.reference_um).max()
        )
        self._blur *= self.radius_um**2 / 2
        self._directions(2 * self._blur)
        self._hold(self._gather(lens, pillars))

    def _hold(self, gathered: Array) -> None:
        """Set the (r, q, p) fields on the nodes, and the coordinates and phase there."""
        self.gathered = gathered.astype(self.kind)
        self._parts = [
            np.ascontiguousarray(part).reshape(len(gathered), -1)
            for part in _pair(self.gathered)
        ]
        self.u, self.v = self.x_um / self.radius_um, self.y_um / self.radius_um
        self.known = self.k * self.path(
            self.x_um, self.y_um, self.bench.distance_um, self.bench
        )

    def quick(self, window_um: float | None = None) -> "CompressedLens":
        """A fast copy whose rest of the kernel is that of the nominal place.

        The rest hardly changes with wavelength and distance, once the factors of the
        actual ones are applied. The copy has fewer nodes, and fewer still for a
        narrower window with no light outside. Light at s half turns from a place has
        a phase of slope s on the nodes; n nodes confuse both only at s = 2 n.

        Args:
            window_um: half width of the window; its own without it.
        """
        part = copy.copy(self)
        part._near = True
        part.window_um = min(window_um or self.window_um, self.window_um)
        part._directions(0.0 if part.window_um < self.window_um else self._blur)
        part._operators, part._usual = self._lesser.setdefault(
            (part.window_um, part.nodes), ({}, {})
        )
        if part.nodes < self.nodes:
            part._from_few = {}
            to_q, to_p = self._between(part, self)
            part._hold(to_q.T @ self.gathered @ to_p)
        return part

    def shaded(
        self, lens: Lens, pillars: PillarResponse, depth_um: float
    ) -> "CompressedLens":
        """The lens lit from ``depth_um`` through its stop.

        It shares with this one all that does not depend on the pillars.
        """
        part = copy.copy(self)
        part._hold(self._gather(lens, pillars, depth_um))
        return part

    def seen_by(self, other: "CompressedLens", values: Array) -> Array:
        """(..., q, p) smooth ``values`` interpolated to the nodes of ``other``."""
        to_q, to_p = self._between(self, other)
        return np.asarray(to_q @ values @ to_p.T)

    @staticmethod
    def _between(source: "CompressedLens", target: "CompressedLens") -> list[Array]:
        """Interpolation matrices along q and p from the nodes of one to another."""
        axes = (source._q, target.q[:, 0]), (source._p, target.p[0])
        return [
            gather.even_interpolation(source.nodes, source._pull, span, places)
            for span, places in axes
        ]

    def _directions(self, beyond_rad: float) -> None:
        """Set nodes of direction cosines (p, q), fine enough for the steepest wave.

        Its phase over half a span is that of the window's edge plus ``beyond_rad``.

        Raises:
            FitError: more than 600 nodes a side, or an aperture angle that is too wide.
        """
        d, (cx, cy) = self._near_um, self.center_um
        hy, hx = self.half_um
        edge = np.linspace(-1, 1, 41)
        x, y = (g.ravel() for g in np.meshgrid(edge * hx - cx, edge * hy - cy))
        r = np.sqrt(x**2 + y**2 + d**2)
        self._p = float((x / r).min()), float((x / r).max())
        self._q = float((y / r).min()), float((y / r).max())
        # phase over half the span of directions: of the window's edge, then in all
        swing = self.k * self.window_um / 2 * max(np.ptp(self._p), np.ptp(self._q)) / 2
        phase_rad = (
            swing
            + beyond_rad
            + 8
            + 2 * (swing + 1) ** (1 / 3)
            + 1.5 * extra_digits(self.tolerance)
        )
        self.nodes = next(
            n
            for n in itertools.count(12)
            if n * gather.node_density(n, self.tolerance) >= phase_rad
        )
        if self.nodes > 600:
            raise FitError(
                f"window of {self.window_um:.0f} um needs {self.nodes} nodes a side; fit a smaller window"
            )
        self._pull = gather.node_stretch(self.nodes, self.tolerance)
        p, q = (
            gather.even_nodes(self.nodes, self._pull, *span)
            for span in (self._p, self._q)
        )
        self.p, self.q = np.meshgrid(p, q)
        if (self.p**2 + self.q**2).max() >= 0.98:
            raise FitError(
                "the aperture angle is too wide for the reduced model; need below 45 degrees across corners"
            )
        r_w = d / np.sqrt(1 - self.p**2 - self.q**2)
        self.x_um, self.y_um = cx + r_w * self.p, cy + r_w * self.q

    def combined(self, weight: Array, series: Array) -> Array:
        """(q, p) field: sum over r of gathered fields times their coefficients.

        The coefficient of field r is the sum over b of weight[b] series[b, r].

        Args:
            weight: (b, q, p) real functions.
            series: (b, r) complex.
        """
        flat, (real, imaginary) = weight.reshape(len(weight), -1), self._parts
        c, s = (part.T.astype(weight.dtype) @ flat for part in _pair(series))
        out = np.empty(flat.shape[1:], self.kind)
        out.real = np.einsum("rn,rn->n", c, real) - np.einsum("rn,rn->n", s, imaginary)
        out.imag = np.einsum("rn,rn->n", c, imaginary) + np.einsum("rn,rn->n", s, real)
        return out.reshape(weight.shape[1:])

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
        d, (hy, hx) = lens.diameters, self.half_um
        x, y = d.x_um, d.y_um
        n, r = self.nodes + 6, len(pillars.basis)
        real_kind = real_of(self.kind)
        pull = gather.node_stretch(n, self.tolerance)
        y0, x0 = 0, 0  # first row and column to sum
        if gather.is_mirror_symmetric(d, self.bench.tangents, lens.layers.stop):
            y0, x0 = len(y) // 2, len(x) // 2  # one quarter, folded
        across, along = (
            gather.fold_weights(
                gather.even_interpolation(n, pull, (-h, h), t), first
            ).astype(real_kind)
            for h, t, first in ((hx, x, x0), (hy, y, y0))
        )
        table = np.ascontiguousarray(pillars.table().astype(self.kind).T)
        block = max(1, 100_000 // (len(x) - x0))
        parts = [slice(start, start + block) for start in range(y0, len(y), block)]
        sums = np.zeros((len(parts), n, n, 2 * r), real_kind)

        def sum_blocks(first: int, last: int) -> None:
            for i in range(first, last):
                rows = parts[i]
                filled = x0 + np.flatnonzero((d.diameter_um[rows, x0:] > 0).any(0))
                built = slice(filled[0], filled[-1] + 1) if len(filled) else slice(0)
                light = gather.gather_light(
                    table,
                    pillars.entries(d, rows, built),
                    self._met(lens, rows, built, depth_um),
                )
                halves = across[built].T @ light.reshape(len(light), -1)
                sums[i] = along[rows].T @ halves.reshape(n, -1, 2 * r)  # x, then y

        with threads.one_blas_thread():
            threads.run_split(len(parts), sum_blocks)
        whole = sums.sum(0, dtype=float).T
        return self._to_directions(whole[:r] + 1j * whole[r:], n)

    def _met(
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
        phasors = wrapped_phasors(
            self.k * self.path(*places, self.bench.distance_um, self.bench)
            + geometric_rad,
            self.kind,
        )
        if depth_um is None:
            return phasors
        source = self.bench.tangents, depth_um, self.bench.wavelength_um
        return np.asarray(
            phasors
            * lens.layers.shadow(*source, places, math.sqrt(d.site_um2)).astype(
                self.kind
            )
        )

    def _to_directions(self, fields: Array, n: int) -> Array:
        """(r, n, n) fields on lens nodes (y, x) to (r, q, p) on direction nodes.

        Adjoint interpolation, first along x, then along y.
        """
        hy, hx = self.half_um
        x, y = (
            gather.even_nodes(n, gather.node_stretch(n, self.tolerance), -h, h)
            for h in (hx, hy)
        )
        (cx, cy), d, m = self.center_um, self._near_um, self.nodes
        p = (x[None] - cx) / np.sqrt(
            (x[None] - cx) ** 2 + (y[:, None] - cy) ** 2 + d**2
        )
        matrix = functools.partial(gather.even_interpolation, m, self._pull)
        turned = np.stack([fields[:, j] @ matrix(self._p, p[j]) for j in range(n)], 1)
        q = (
            (y - cy)[None]
            * np.sqrt(1 - self.p[0][:, None] ** 2)
            / np.sqrt((y - cy)[None] ** 2 + d**2)
        )
        out = np.stack([turned[:, :, a] @ matrix(self._q, q[a]) for a in range(m)], 2)
        return np.asarray(out)

    def path(
        self, x: Array, y: Array, distance_um: float, bench: BenchGeometry
    ) -> Array:
        """Path from the reference source by (x, y) to the window's centre, um.

        (x, y) lie on the lens. Less the path along the axis.
        """
        centre = self.films.chief_um(distance_um, bench.tangents)
        before = media.source_path(
            self.films.front, x, y, bench.tangents, 1 / bench.reference_um
        )
        return np.asarray(before + self.films.sensor_path(x, y, centre, distance_um))

    def operators(
        self,
        *,
        wavelength_um: float,
        distance_um: float,
        axes_um: tuple[Array, Array],
        edge_um: float = 0.0,
    ) -> WindowOperators:
        """Operators from lens nodes to the window, cached.

        Wavelength and distance are exact, not expanded.

        Args:
            axes_um: (y, x) samples of the window.
            edge_um: width of a rim of the window in which ten times the error is
                allowed, since only its blur enters the image.
        """
        key = wavelength_um, distance_um, *_named(axes_um)
        operators = self._operators.get(key)
        if operators is None:
            operators = self._operators_of(wavelength_um, distance_um, axes_um, edge_um)
            with self._changing:
                self._operators[key] = operators
                while len(self._operators) > _KEPT:
                    self._operators.pop(next(iter(self._operators)))
        return operators

    def _operators_of(
        self, wavelength_um: float, distance_um: float, axes_um: Axes, edge_um: float
    ) -> WindowOperators:
        """Operators of :meth:`operators`, computed.

        Both axes take the samples that their bands need. The rest is of the nominal
        kernel in a quick copy, else of the actual one.
        """
        nominal_um = self.bench.distance_um
        films = FilmStack.of(self._layers, wavelength_um)
        nominal = CompressedKernel(
            self.k,
            self._p,
            self._q,
            nominal_um,
            nominal_um,
            self.bench.tangents,
            self.films,
            self._near_um,
        )
        kernel = dataclasses.replace(
            nominal, k=2 * math.pi / wavelength_um, distance_um=distance_um, films=films
        )
        half_um = [float(np.abs(axis).max()) for axis in axes_um]
        pairs = zip(
            nominal.bands(half_um[0], half_um[1]),
            kernel.bands(half_um[0], half_um[1]),
            strict=True,
        )
        # bands, rad/um, along y and x: the actual ones rounded up
        bands = [
            _SPARE
            * usual
            * _WIDER ** math.ceil(math.log(band / usual / _SPARE, _WIDER))
            for usual, band in pairs
        ]
        options: dict[str, Any] = {
            "k": kernel.k,
            "tolerance": self.tolerance,
            "step_um": STEP * distance_um,
            "rim_um": edge_um,
        }
        y, along_y = axis_operators(
            kernel.by_y, self.q[:, 0], axes_um[0], bands[0], **options
        )
        x, along_x = axis_operators(
            kernel.by_x, self.p[0], axes_um[1], bands[1], **options
        )
        kind = self.kind
        parts = [along.of_kind(kind) for along in (along_y, along_x)]
        inner_um = half_um[0] - edge_um, half_um[1] - edge_um

        def moved(name: str) -> CouplingTerms:
            ends = [kernel.moved(name, sign * STEP) for sign in (1, -1)]
            step = 2 * STEP * (distance_um if name == "distance" else wavelength_um)
            return self._terms(kernel, ends, (1 / step, -1 / step), (y, x), inner_um)

        terms = (
            self._from(nominal, kernel, (y, x), inner_um)
            if self._near
            else self._terms(kernel, [kernel], (1.0,), (y, x), inner_um)
        )
        return WindowOperators(parts[0], parts[1], terms, moved)

    def _from(
        self,
        nominal: CompressedKernel,
        kernel: CompressedKernel,
        axes_um: tuple[Array, Array],
        inner_um: tuple[float, float],
    ) -> CouplingTerms:
        """As :meth:`_terms` of ``kernel`` alone, from the terms of the nominal one.

        The window functions take the ratio of both window factors and of k / distance.
        """
        y, x = axes_um
        key = *inner_um, *_named(axes_um)
        if key not in self._usual:
            self._usual[key] = self._terms(
                nominal, [nominal], (1.0,), axes_um, inner_um
            )
        brighter = kernel.k / nominal.k * nominal.distance_um / kernel.distance_um
        ratio = brighter * kernel.window(x, y[:, None]) / nominal.window(x, y[:, None])
        terms = self._usual[key]
        return dataclasses.replace(
            terms, window=terms.window * ratio[:, None].astype(self.kind)
        )

    def _terms(
        self,
        kernel: CompressedKernel,
        rests: Sequence[CompressedKernel],
        shares: Sequence[float],
        axes_um: tuple[Array, Array],
        inner_um: tuple[float, float],
    ) -> CouplingTerms:
        """Low-rank terms of the sum of ``rests`` weighted by ``shares``.

        The rest R(Y, X; q, p) is tabulated on Legendre nodes, (w², m²), and factored:
        R = sum over r, b of W_r(Y, X) a_rb(q) g_b(p). Window functions W include the
        window factor of ``kernel``.

        Args:
            kernel: whose window factor is applied.
            rests: kernels (k,) whose rests are summed.
            shares: their factors (k,).
            axes_um: coarse samples (y, x) of the window.
            inner_um: (y, x) half sides without the rim, which counts ``_BESIDE``.
        """
        y, x = axes_um
        wy, wx = float(np.abs(y).max()), float(np.abs(x).max())
        w, m = kernel.counts(wy, wx, self.tolerance)
        Y = legendre.mapped_nodes(w, -wy, wy)
        X = legendre.mapped_nodes(w, -wx, wx)
        P = legendre.mapped_nodes(m, *self._p)
        Q = legendre.mapped_nodes(m, *self._q)[:, None]
        # weights of directions and window places in the low-rank error
        weight = np.where(
            np.hypot(*self._on_lens(P, Q)) < 1.03 * self.radius_um, 1.0, _BESIDE
        )
        inside = np.where(
            (np.abs(Y)[:, None] <= inner_um[0]) & (np.abs(X) <= inner_um[1]),
            1.0,
            _BESIDE,
        )
        table = np.empty((w, w, m, m), self.kind)
        kind = self.kind if len(rests) == 1 else complex
        for table_row, place_y, row_weight in zip(table, Y, inside, strict=True):
            parts = [
                factor * each.rest(P, Q, X[:, None, None], place_y, kind)
                for each, factor in zip(rests, shares, strict=True)
            ]
            table_row[:] = row_weight[:, None, None] * weight * sum(parts)
        columns, rows, remainder = low_rank_factors(
            table.reshape(w * w, m * m), self.tolerance
        )
        # functions of p in the rows: one more singular value decomposition
        mixing, size, across = np.linalg.svd(
            (rows.reshape(-1, m, m) / weight).reshape(-1, m), full_matrices=False
        )
        mixed = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1] / (size**2).sum())
        count = int((mixed > MIXED * self.tolerance).sum())
        amounts = (mixing * size)[:, :count].reshape(-1, m, count).transpose(
            1, 0, 2
        ) * self.site_um2
        iy, ix = (
            _on_even(w, float(a[0] / r), float(a[-1] / r), len(a))
            for a, r in ((y, wy), (x, wx))
        )
        to_p = self._to_nodes(m)
        columns_on_nodes = (columns / inside.reshape(-1, 1)).reshape(w, w, -1)
        spread = (iy @ columns_on_nodes.reshape(w, -1)).reshape(
            len(y), w, -1
        ).transpose(0, 2, 1) @ ix.T
        window = spread * kernel.window(x, y[:, None])[:, None]
        arrays = [
            part.astype(self.kind)
            for part in (
                across[:count] @ to_p.T,
                np.tensordot(to_p, amounts, 1),
                window,
            )
        ]
        whole = float(np.linalg.norm(table)) / math.sqrt(table.size)  # rms
        return CouplingTerms(
            arrays[0], arrays[1], arrays[2], remainder, mixed[:count], whole
        )

    def _to_nodes(self, count: int) -> Array:
        """(nodes, count) interpolation from Legendre to direction nodes, cached."""
        if count not in self._from_few:
            self._from_few[count] = legendre.interpolation_matrix(
                count, gather.even_nodes(self.nodes, self._pull, -1.0, 1.0)
            )
        return self._from_few[count]

    def _on_lens(self, p: Array, q: Array) -> tuple[Array, Array]:
        """(x, y) on the lens of direction cosines seen from the window's centre."""
        r = self._near_um / np.sqrt(1 - p**2 - q**2)
        return self.center_um[0] + r * p, self.center_um[1] + r * q


@functools.lru_cache(maxsize=16)
def _on_even(count: int, first: float, last: float, samples: int) -> Array:
    """(samples, count) from Legendre nodes on [-1, 1] to even places; treat as
    read-only.
    """
    return legendre.interpolation_matrix(count, np.linspace(first, last, samples))


def _named(axes_um: tuple[Array, Array]) -> tuple[float, ...]:
    """Cache key of even axes (y, x): count and first place of each."""
    return tuple(float(part) for axis in axes_um for part in (len(axis), axis[0]))


def _pair(values: Array) -> tuple[Array, Array]:
    return values.real, values.imag
