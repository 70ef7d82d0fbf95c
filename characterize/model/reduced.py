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
_KEPT = 12  # operators: of a place that each of some threads is at
_SPARE, _WIDER = (
    1.05,
    1.25,
)  # of bands over the nominal ones, and from there on: one serves all distances of a fit
# weight of directions that miss the lens, and of the rim, when the low-rank terms are
# chosen
_BESIDE = 0.1


class CompressedLens:
    """A lens on nodes for one field angle.

    nodes (q, p); x_um, y_um: (q, p) places of the nodes on the lens; u, v: the same
    over the lens radius.
    known: (q, p) phase there that was taken off, that of :meth:`path`.
    gathered: (r, q, p) one field for each function of :class:`Pillars`. kind: of the
    complex numbers.

    Tables and sums are in single precision where ``tolerance`` lets them be, else in
    double: see :func:`precision`.
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
        self.bench, self.tolerance, self.window_um = bench, tolerance, window_um
        self.kind = complex_precision(tolerance)
        self._layers, self.films = (
            lens.layers,
            FilmStack.of(lens.layers, bench.wavelength_um),
        )
        self._near_um = self.films.reduced_um(
            bench.distance_um
        )  # that directions are counted at
        self.half_um = np.array([lens.diameters.y_um[-1], lens.diameters.x_um[-1]])
        self.site_um2, self.radius_um = (
            lens.diameters.site_um2,
            lens.diameters.radius_um,
        )
        self.k = 2 * math.pi / bench.wavelength_um
        self._operators: dict[tuple[float, ...], WindowOperators] = {}
        self._near, self._usual = False, dict[tuple[float, ...], CouplingTerms]()
        self._lesser: dict[tuple[float, int], Any] = {}  # both of these, of quick ones
        self._from_few: dict[int, Array] = {}
        self._changing = threading.Lock()  # several fits may ask at once
        self._blur = self.k * float(
            np.abs(1 / np.asarray(depths_um) - 1 / bench.reference_um).max()
        )
        self._blur *= self.radius_um**2 / 2
        self._directions(2 * self._blur)
        self._hold(self._gather(lens, pillars))

    def _hold(self, gathered: Array) -> None:
        """Take the (r, q, p) fields of the lens on the nodes, and what else belongs to
        these.
        """
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
        """With terms that belong to the nominal wavelength and distance: what is left
        of the kernel when its factors
        are put on hardly changes with either. On fewer nodes, and fewer yet for a
        window narrower than its own, beside
        which there is no light: light that lands s off a place of the window turns by s
        over the nodes, and n of these
        show it there only where s is 2 n; half of what tells s from all others is
        enough to keep it off."""
        part = copy.copy(self)
        part._near, part.window_um = (
            True,
            min(window_um or self.window_um, self.window_um),
        )
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
        """Lit from a depth through the lens' stop; what does not hang on the pillars is
        shared with this one.
        """
        part = copy.copy(self)
        part._hold(self._gather(lens, pillars, depth_um))
        return part

    def seen_by(self, other: "CompressedLens", values: Array) -> Array:
        """(..., q, p) a smooth function on the nodes as it is on those of another one
        of the same lens.
        """
        to_q, to_p = self._between(self, other)
        return np.asarray(to_q @ values @ to_p.T)

    @staticmethod
    def _between(one: "CompressedLens", other: "CompressedLens") -> list[Array]:
        """Interpolation along q and along p from the nodes of one to those of the
        other.
        """
        ends = (one._q, other.q[:, 0]), (one._p, other.p[0])
        return [
            gather.even_interpolation(one.nodes, one._pull, span, at)
            for span, at in ends
        ]

    def _directions(self, beyond: float) -> None:
        """Nodes for waves as steep as the window makes them, and ``beyond``: radians a
        half span.
        """
        d, (cx, cy) = self._near_um, self.center_um
        hy, hx = self.half_um
        edge = np.linspace(-1, 1, 41)
        x, y = (g.ravel() for g in np.meshgrid(edge * hx - cx, edge * hy - cy))
        r = np.sqrt(x**2 + y**2 + d**2)
        self._p = float((x / r).min()), float((x / r).max())
        self._q = float((y / r).min()), float((y / r).max())
        swing = self.k * self.window_um / 2 * max(np.ptp(self._p), np.ptp(self._q)) / 2
        bands = (
            swing
            + beyond
            + 8
            + 2 * (swing + 1) ** (1 / 3)
            + 1.5 * extra_digits(self.tolerance)
        )
        self.nodes = next(
            n
            for n in itertools.count(12)
            if n * gather.node_density(n, self.tolerance) >= bands
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
        """(q, p) sum over r of the gathered fields times the series (b, r) in
        ``weight`` (b, q, p) real functions.
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
        """(r, q, p) fields; depth_um: of the source whose light the lens' stop shades,
        None for all that meets it.
        """
        d, (hy, hx) = lens.diameters, self.half_um
        x, y = d.x_um, d.y_um
        n, r = self.nodes + 6, len(pillars.basis)
        real_kind = real_of(self.kind)
        pull = gather.node_stretch(n, self.tolerance)
        y0, x0 = (
            (len(y) // 2, len(x) // 2)
            if gather.is_mirror_symmetric(d, self.bench.tangents, lens.layers.stop)
            else (0, 0)
        )
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

        def some(first: int, last: int) -> None:
            for i in range(first, last):
                rows = parts[i]
                some = x0 + np.flatnonzero((d.diameter_um[rows, x0:] > 0).any(0))
                built = slice(some[0], some[-1] + 1) if len(some) else slice(0)
                light = gather.gather_light(
                    table,
                    pillars.entries(d, rows, built),
                    self._met(lens, rows, built, depth_um),
                )
                halves = across[built].T @ light.reshape(len(light), -1)
                sums[i] = along[rows].T @ halves.reshape(n, -1, 2 * r)  # x, then y

        with threads.one_blas_thread():
            threads.run_split(len(parts), some)
        whole = sums.sum(0, dtype=float).T
        return self._to_directions(whole[:r] + 1j * whole[r:], n)

    def _met(
        self, lens: Lens, rows: slice, built: slice, depth_um: float | None
    ) -> Array:
        """(rows, columns) phasors that a block of pillars meets: of the path taken off,
        of how they are turned, and
        behind a stop its shadow."""
        d = lens.diameters
        places = d.x_um[None, built], d.y_um[rows, None]
        turn = np.broadcast_to(lens.geometric_rad(rows), d.diameter_um[rows].shape)[
            :, built
        ]
        found = wrapped_phasors(
            self.k * self.path(*places, self.bench.distance_um, self.bench) + turn,
            self.kind,
        )
        if depth_um is None:
            return found
        about = self.bench.tangents, depth_um, self.bench.wavelength_um
        return np.asarray(
            found
            * lens.layers.shadow(*about, places, math.sqrt(d.site_um2)).astype(
                self.kind
            )
        )

    def _to_directions(self, fields: Array, n: int) -> Array:
        """Lens nodes (y, x) to direction nodes (q, p): adjoint interpolation, first
        along x, then along y.
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
        at = functools.partial(gather.even_interpolation, m, self._pull)
        turned = np.stack([fields[:, j] @ at(self._p, p[j]) for j in range(n)], 1)
        q = (
            (y - cy)[None]
            * np.sqrt(1 - self.p[0][:, None] ** 2)
            / np.sqrt((y - cy)[None] ** 2 + d**2)
        )
        out = np.stack([turned[:, :, a] @ at(self._q, q[a]) for a in range(m)], 2)
        return np.asarray(out)

    def path(
        self, x: Array, y: Array, distance_um: float, bench: BenchGeometry
    ) -> Array:
        """Path from the reference source by (x, y) on the lens to the window's centre,
        um, less that by the axis.
        """
        centre = self.films.chief_um(distance_um, bench.tangents)
        come = media.source_path(
            self.films.front, x, y, bench.tangents, 1 / bench.reference_um
        )
        return np.asarray(come + self.films.sensor_path(x, y, centre, distance_um))

    def operators(
        self,
        *,
        wavelength_um: float,
        distance_um: float,
        axes_um: tuple[Array, Array],
        edge_um: float = 0.0,
    ) -> WindowOperators:
        """Arrays for an actual wavelength and distance, both exact; ``axes_um`` (y, x)
        of the window's samples.

        edge_um: width of a rim of the window where a tenfold error is allowed, since
            only its blur is seen.
        The last few are kept: an image is often followed by its derivatives.
        """
        key = wavelength_um, distance_um, *_named(axes_um)
        found = self._operators.get(key)
        if found is None:
            found = self._operators_of(wavelength_um, distance_um, axes_um, edge_um)
            with self._changing:
                self._operators[key] = found
                while len(self._operators) > _KEPT:
                    self._operators.pop(next(iter(self._operators)))
        return found

    def _operators_of(
        self, wavelength_um: float, distance_um: float, axes_um: Axes, edge_um: float
    ) -> WindowOperators:
        usual_um = self.bench.distance_um
        films = FilmStack.of(self._layers, wavelength_um)
        nominal = CompressedKernel(
            self.k,
            self._p,
            self._q,
            usual_um,
            usual_um,
            self.bench.tangents,
            self.films,
            self._near_um,
        )
        kernel = dataclasses.replace(
            nominal, k=2 * math.pi / wavelength_um, distance_um=distance_um, films=films
        )
        reach = [float(np.abs(axis).max()) for axis in axes_um]
        pairs = zip(
            nominal.bands(reach[0], reach[1]),
            kernel.bands(reach[0], reach[1]),
            strict=True,
        )
        bands = [
            _SPARE
            * usual
            * _WIDER ** math.ceil(math.log(band / usual / _SPARE, _WIDER))
            for usual, band in pairs
        ]
        about: dict[str, Any] = {
            "k": kernel.k,
            "tolerance": self.tolerance,
            "step_um": STEP * distance_um,
        }
        about["rim_um"] = edge_um
        y, down = axis_operators(
            kernel.by_y, self.q[:, 0], axes_um[0], bands[0], **about
        )
        x, across = axis_operators(
            kernel.by_x, self.p[0], axes_um[1], bands[1], **about
        )
        kind = self.kind
        parts = [one.of_kind(kind) for one in (down, across)]
        inner = reach[0] - edge_um, reach[1] - edge_um

        def moved(name: str) -> CouplingTerms:
            ends = [kernel.moved(name, sign * STEP) for sign in (1, -1)]
            step = 2 * STEP * (distance_um if name == "distance" else wavelength_um)
            return self._terms(kernel, ends, (1 / step, -1 / step), (y, x), inner)

        rest = (
            self._from(nominal, kernel, (y, x), inner)
            if self._near
            else self._terms(kernel, [kernel], (1.0,), (y, x), inner)
        )
        return WindowOperators(parts[0], parts[1], rest, moved)

    def _from(
        self,
        usual: CompressedKernel,
        kernel: CompressedKernel,
        axes_um: tuple[Array, Array],
        inner_um: tuple[float, float],
    ) -> CouplingTerms:
        """As :meth:`_terms` of the kernel alone, from those of the usual one: turned
        and as bright as its own are.
        """
        key, (y, x) = (*inner_um, *_named(axes_um)), axes_um
        if key not in self._usual:
            self._usual[key] = self._terms(usual, [usual], (1.0,), axes_um, inner_um)
        brighter = kernel.k / usual.k * usual.distance_um / kernel.distance_um
        turn = brighter * kernel.window(x, y[:, None]) / usual.window(x, y[:, None])
        found = self._usual[key]
        return dataclasses.replace(
            found, window=found.window * turn[:, None].astype(self.kind)
        )

    def _terms(
        self,
        kernel: CompressedKernel,
        rests: Sequence[CompressedKernel],
        shares: Sequence[float],
        axes_um: tuple[Array, Array],
        inner_um: tuple[float, float],
    ) -> CouplingTerms:
        """Terms of a sum of rests by shares, on coarse axes (y, x), turned as the
        window of ``kernel`` is.
        """
        y, x = axes_um
        wy, wx = float(np.abs(y).max()), float(np.abs(x).max())
        w, m = kernel.counts(wy, wx, self.tolerance)
        Y = legendre.mapped_nodes(w, -wy, wy)
        X = legendre.mapped_nodes(w, -wx, wx)
        P = legendre.mapped_nodes(m, *self._p)
        Q = legendre.mapped_nodes(m, *self._q)[:, None]
        weight = np.where(
            np.hypot(*self._on_lens(P, Q)) < 1.03 * self.radius_um, 1.0, _BESIDE
        )
        seen = np.where(
            (np.abs(Y)[:, None] <= inner_um[0]) & (np.abs(X) <= inner_um[1]),
            1.0,
            _BESIDE,
        )
        table = np.empty((w, w, m, m), self.kind)
        kind = self.kind if len(rests) == 1 else complex
        for layer, height, share in zip(table, Y, seen, strict=True):
            parts = [
                s * of.rest(P, Q, X[:, None, None], height, kind)
                for of, s in zip(rests, shares, strict=True)
            ]
            layer[:] = share[:, None, None] * weight * sum(parts)
        columns, rows, remainder = low_rank_factors(
            table.reshape(w * w, m * m), self.tolerance
        )
        left, size, across = np.linalg.svd(
            (rows.reshape(-1, m, m) / weight).reshape(-1, m), full_matrices=False
        )
        mixed = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1] / (size**2).sum())
        some = int((mixed > MIXED * self.tolerance).sum())
        amounts = (left * size)[:, :some].reshape(-1, m, some).transpose(
            1, 0, 2
        ) * self.site_um2
        iy, ix = (
            _on_even(w, float(a[0] / r), float(a[-1] / r), len(a))
            for a, r in ((y, wy), (x, wx))
        )
        to_p = self._to_nodes(m)
        shown = (columns / seen.reshape(-1, 1)).reshape(w, w, -1)
        spread = (iy @ shown.reshape(w, -1)).reshape(len(y), w, -1).transpose(
            0, 2, 1
        ) @ ix.T
        window = spread * kernel.window(x, y[:, None])[:, None]
        arrays = [
            one.astype(self.kind)
            for one in (across[:some] @ to_p.T, np.tensordot(to_p, amounts, 1), window)
        ]
        whole = float(np.linalg.norm(table)) / math.sqrt(table.size)
        return CouplingTerms(
            arrays[0], arrays[1], arrays[2], remainder, mixed[:some], whole
        )

    def _to_nodes(self, count: int) -> Array:
        """(nodes, count) from Legendre nodes of the directions; kept."""
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
    """What tells even axes apart, as they are kept by: counts and first places."""
    return tuple(float(part) for axis in axes_um for part in (len(axis), axis[0]))


def _pair(values: Array) -> tuple[Array, Array]:
    return values.real, values.imag
