"""From nodes to a sensor window: products with two factors and few terms, on samples as
coarse as the band allows.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from characterize.model.kernel import real_of
from metalens.core import threads
from metalens.core.arrays import Array

MIXED = 0.1  # share of the tolerance for the functions of p in the terms
# the same where terms are left out too: it adds an eighth to their error
_MIXED_FEW = 0.5
ROOM = 1.3  # samples over those of the sampling theorem
_SHARE = 0.1  # share of the tolerance for the interpolation
_COARSEST = 0.2  # largest tolerance of a small part of a derivative
_TAPS = range(6, 42, 2)
# relative step of distance and wavelength for derivatives
STEP = 1e-3


@dataclass(frozen=True, eq=False, slots=True)
class AxisOperators:
    """Operators along one axis, from nodes to coarse to fine samples.

    to: (coarse, nodes). fine: (fine, coarse), real: fields on coarse samples lack
    their carrier, which no intensity depends on. moved: derivative of ``to`` per um
    of ``wave`` or ``distance`` at fixed carrier.
    """

    to: Array
    fine: Array
    moved: Callable[[str], Array]

    def of_kind(self, kind: Any) -> "AxisOperators":
        """In complex numbers of a kind."""
        moved = functools.cache(lambda name: self.moved(name).astype(kind))
        return AxisOperators(
            self.to.astype(kind), self.fine.astype(real_of(kind)), moved
        )


@dataclass(frozen=True, eq=False, slots=True)
class CouplingTerms:
    """Low-rank terms of the part of the kernel that is no product of both axes.

    R(Y, X; q, p) = sum over r, b of window[Y, r, X] amounts[q, r, b] across[b, p].

    across: (b, p) functions of p. amounts: (q, r, b). window: (Y, r, X) on the coarse
    samples.
    remainder: (r,) relative size of the terms from each on; mixed: (b,) the same of
    the functions of p. size: root mean square of R over the lens.
    """

    across: Array
    amounts: Array
    window: Array
    remainder: Array
    mixed: Array
    size: float

    def some(self, tolerance: float) -> tuple[Array, Array, Array]:
        """Functions, amounts and terms that leave a relative ``tolerance`` out."""
        r = max(1, int((self.remainder > tolerance).sum()))
        b = max(1, int((self.mixed > _MIXED_FEW * tolerance).sum()))
        return self.across[:b], self.amounts[:, :r, :b], self.window[:, :r]


@dataclass(frozen=True, eq=False, slots=True)
class WindowOperators:
    """From nodes to window for one wavelength and distance: both axes, and the rest.

    moved: derivative of the rest by ``wave`` or ``distance``, per um, as terms of its
    own.
    """

    y: AxisOperators
    x: AxisOperators
    rest: CouplingTerms
    moved: Callable[[str], CouplingTerms]

    def coarse(self, light: Array, tolerance: float = 0.0) -> Array:
        """(..., q, p) ``light`` to (..., Y, X) on the coarse samples.

        Terms below the relative ``tolerance`` are left out.
        """
        return self._sum(light, ((self.y.to, self.x.to, self.rest, tolerance),))

    def envelope(self, coarse: Array) -> Array:
        """(..., Y, X) field on the window's samples from that on the coarse ones.

        Less the carrier of the middle direction, which no intensity depends on.
        """
        flat = coarse.reshape(-1, *coarse.shape[-2:])
        out = np.empty((len(flat), len(self.y.fine), len(self.x.fine)), coarse.dtype)

        def fill(first: int, last: int) -> None:
            for i in range(first, last):
                out[i] = real_complex_product(
                    self.y.fine, real_complex_product(self.x.fine, flat[i].T).T
                )

        with threads.one_blas_thread():
            threads.run_split(len(flat), fill)
        return out.reshape(*coarse.shape[:-2], *out.shape[-2:])

    def rates(
        self, light: Array, name: str, tolerance: float = 0.0, *, beside: float = 0.0
    ) -> Array:
        """(..., Y, X) derivative of the field per um of ``wave`` or ``distance``.

        Phases of window places alone are left out: no intensity depends on them.

        Args:
            light: (..., q, p) field on the nodes.
            name: ``wave`` (wavelength) or ``distance``.
            tolerance: relative error, shared among the three parts by their size.
            beside: size of what is added to this derivative, over that of the field.
        """
        y_rate = self.y.moved(name)
        x_rate = self.x.moved(name)
        rest_rate = self.moved(name)
        # product rule: one factor differentiated at a time, and its relative size
        ways = (
            (y_rate, self.x.to, self.rest),
            (self.y.to, x_rate, self.rest),
            (self.y.to, self.x.to, rest_rate),
        )
        pairs = (y_rate, self.y.to), (x_rate, self.x.to)
        sizes = [
            *(float(np.linalg.norm(rate) / np.linalg.norm(to)) for rate, to in pairs),
            rest_rate.size / self.rest.size,
        ]
        whole = tolerance * math.hypot(*sizes, beside) / math.sqrt(len(sizes))
        shares = [min(whole / max(size, 1e-300), _COARSEST) for size in sizes]
        summands = tuple((*way, share) for way, share in zip(ways, shares, strict=True))
        return self.envelope(self._sum(light, summands))

    def _sum(
        self, light: Array, ways: tuple[tuple[Array, Array, CouplingTerms, float], ...]
    ) -> Array:
        """(..., Y, X) sum over ``ways`` (Fy, Fx, terms, tolerance) of ``light``.

        Each is the sum over r, q, b, p of W_r(Y, X) Fy(Y, q) a_rb(q) L(q, p) g_b(p)
        Fx(p, X), with L = ``light`` (..., q, p).
        """
        ny, nx, kind = len(self.y.to), len(self.x.to), self.y.to.dtype
        products = []
        for y, x, terms, tolerance in ways:
            across, amounts, window = terms.some(tolerance)
            # g_b(p) Fx(p, X) as a matrix (p, b X)
            by_x = (across[:, None] * x).reshape(len(across) * nx, -1).T
            products.append((y, by_x, amounts, window))
        light = light.astype(kind, copy=False)
        out = np.zeros((*light.shape[:-2], ny, nx), kind)
        flat = light.reshape(-1, *light.shape[-2:])
        result = out.reshape(-1, *out.shape[-2:])

        def sum_frames(first: int, last: int) -> None:
            frames = flat[first:last].reshape(-1, flat.shape[-1])
            for y, by_x, amounts, window in products:
                mixed = amounts @ (frames @ by_x).reshape(
                    last - first, len(amounts), -1, nx
                )
                for i, of_frame in enumerate(
                    mixed.reshape(last - first, len(amounts), -1), first
                ):
                    terms = (y @ of_frame).reshape(ny, -1, nx)
                    # five times as fast as einsum
                    result[i] += np.multiply(terms, window, out=terms).sum(1)

        with threads.one_blas_thread():
            threads.run_split(len(flat), sum_frames)
        return out


def real_complex_product(weights: Array, values: Array) -> Array:
    """(m, k) product of real (m, n) and complex (n, k) numbers: half the work of one of
    complex numbers.

    Args:
        weights: (m, n) real.
        values: (n, k) complex.
    """
    return np.asarray(
        (weights @ np.ascontiguousarray(values).view(weights.dtype)).view(values.dtype)
    )


def axis_operators(
    by: Callable[..., Array],
    nodes: Array,
    at_um: Array,
    band: float,
    *,
    k: float,
    tolerance: float,
    step_um: float,
    rim_um: float = 0.0,
) -> tuple[Array, AxisOperators]:
    """Coarse samples along one axis, and operators from nodes to them and on.

    Fields on the coarse samples are exp(i k (F - F_middle)), less their carrier.

    Args:
        by: path to a place of the window, :meth:`CompressedKernel.by_x` or ``by_y``.
        nodes: (n,) direction cosines.
        at_um: (m,) even samples of the window.
        band: of the field, rad/um.
        k: wave number, rad/um.
        tolerance: relative error of the field.
        step_um: of the distance, for derivatives.
        rim_um: at either end, where a tenfold error is allowed.
    """
    coarse, weights = _resampled(
        float(at_um[0]), float(at_um[-1]), len(at_um), band, tolerance, rim_um
    )
    middle = (nodes[0] + nodes[-1]) / 2
    phase = k * by(nodes, coarse[:, None])
    carrier = k * by(middle, coarse[:, None])
    to_coarse = np.exp(1j * (phase - carrier))

    def moved(name: str) -> Array:
        if name == "wave":
            # d(kF)/d(wavelength) = F dk/d(wavelength) = -k² F / (2 pi)
            return np.asarray(-1j * phase * k / (2 * np.pi) * to_coarse)
        ends = [by(nodes, coarse[:, None], off) for off in (step_um, -step_um)]
        return np.asarray(1j * k * (ends[0] - ends[1]) / (2 * step_um) * to_coarse)

    return coarse, AxisOperators(to_coarse, weights, moved)


def _nearby(
    at_um: Array, coarse_um: Array, band: float, taps: int
) -> tuple[Array, Array]:
    """(fine, taps) indices of the nearest coarse samples of every place, and (taps,
    taps) correlations sinc(band distance / pi) among them.
    """
    step = coarse_um[1] - coarse_um[0]
    first = np.clip(
        np.floor((at_um - coarse_um[0]) / step).astype(int) - taps // 2 + 1,
        0,
        len(coarse_um) - taps,
    )
    gram = np.sinc(band * step / np.pi * (np.arange(taps)[:, None] - np.arange(taps)))
    return first[:, None] + np.arange(taps), gram


@functools.lru_cache(maxsize=32)
def _resampled(
    first: float,
    last: float,
    count: int,
    band: float,
    tolerance: float,
    rim_um: float = 0.0,
) -> tuple[Array, Array]:
    """Coarse even samples of an axis and their interpolation weights (fine, coarse).

    For functions of up to ``band`` rad/um. The window's own samples where coarse ones
    are no fewer. Bisection chooses the fewest taps that are accurate enough: the error
    falls with their number. Taps reach beyond the window where its rim is narrower.
    Cached; treat as read-only.

    Args:
        first: first of the window's even samples, um.
        last: last of them, um.
        count: their number.
        tolerance: relative error of the field.
        rim_um: at either end, where ten times the error is allowed.
    """
    at_um = np.linspace(first, last, count)
    step = np.pi / band / ROOM
    width = last - first
    fine = (last - first) / (count - 1)
    inner = np.abs(at_um - (first + last) / 2) <= width / 2 - rim_um

    def with_taps(taps: int) -> tuple[Array, Array, float]:
        least = int(np.ceil(width / step)) + 1
        coarse_count = max(
            least, taps, int(np.ceil((width - 2 * rim_um) / step)) + taps
        )
        coarse = (first + last) / 2 + (
            np.arange(coarse_count) - (coarse_count - 1) / 2
        ) * step
        weights, missed = _weights(at_um, coarse, band, taps)
        return coarse, weights, float(np.where(inner, missed, missed / 10).max())

    best = None
    low, high = (0, len(_TAPS)) if step > 1.1 * fine else (0, 0)
    while low < high:  # bisection of the number of taps
        middle = (low + high) // 2
        trial = with_taps(_TAPS[middle])
        if trial[2] < _SHARE * tolerance:
            best = trial
            high = middle
        else:
            low = middle + 1
    if best is None or len(best[0]) >= len(at_um):
        return at_um, np.eye(len(at_um))
    return best[0], best[1]


def _weights(
    at_um: Array, coarse_um: Array, band: float, taps: int
) -> tuple[Array, Array]:
    """Least-squares interpolation weights, and their errors, over an even band.

    With sinc correlations G among the taps and s to the place: weights G⁻¹ s, mean
    square error 1 - 2 wᵀs + wᵀG w.

    Returns:
        (fine, coarse) weights of the nearest ``taps`` samples; (fine,) rms errors.
    """
    index, gram = _nearby(at_um, coarse_um, band, taps)
    target = np.sinc(band / np.pi * (at_um[:, None] - coarse_um[index]))
    weights = np.linalg.solve(gram, target.T).T
    missed = (
        1
        - 2 * (weights * target).sum(1)
        + np.einsum("ni,ij,nj->n", weights, gram, weights)
    )
    out = np.zeros((len(at_um), len(coarse_um)))
    np.put_along_axis(out, index, weights, 1)
    return out, np.sqrt(np.maximum(missed, 0.0))
