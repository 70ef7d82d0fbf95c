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

MIXED = 0.1  # of the tolerance, for functions of p in the terms
# the same where terms are left out: beside these it adds an eighth to what is missed
_MIXED_FEW = 0.5
ROOM = 1.3  # samples over those of the sampling theorem
_SHARE = 0.1  # of the tolerance, for the interpolation
_COARSEST = 0.2  # tolerance of a small part of a derivative
_TAPS = range(6, 42, 2)
# of distance and wavelength, for derivatives: paths bend over as much as they are long
STEP = 1e-3


@dataclass(frozen=True, eq=False, slots=True)
class AxisOperators:
    """Along one axis: nodes to coarse samples, ``to`` (coarse, nodes); coarse to fine
    samples, ``fine`` (fine, coarse).

    Fields on coarse samples are less their carrier, which no intensity sees, so that
    ``fine`` is real. moved: derivative of ``to`` by ``wave`` or ``distance``, per um, the carrier held.
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
    """What is no product of both axes, as few terms: functions of p (b, p), their
    amounts in every term (q, r, b), and
    every term on coarse samples (Y, r, X).

    remainder, mixed: (r,), (b,) relative size of what is left out before each term,
    each function of p.
    size: root mean square of the whole where the lens is seen.
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
        """(..., q, p) -> (..., Y, X) on the coarse samples, by all terms or with some
        left out.
        """
        return self._sum(light, ((self.y.to, self.x.to, self.rest, tolerance),))

    def envelope(self, coarse: Array) -> Array:
        """(..., Y, X) on the window's samples of a field on the coarse ones, less the
        turns of the middle direction, which no intensity sees.
        """
        flat = coarse.reshape(-1, *coarse.shape[-2:])
        out = np.empty((len(flat), len(self.y.fine), len(self.x.fine)), coarse.dtype)

        def some(first: int, last: int) -> None:
            for i in range(first, last):
                out[i] = real_complex_product(
                    self.y.fine, real_complex_product(self.x.fine, flat[i].T).T
                )

        with threads.one_blas_thread():
            threads.run_split(len(flat), some)
        return out.reshape(*coarse.shape[:-2], *out.shape[-2:])

    def rates(
        self, light: Array, name: str, tolerance: float = 0.0, *, beside: float = 0.0
    ) -> Array:
        """(..., q, p) -> (..., Y, X) derivative of the field by ``wave`` or
        ``distance`` per um, as an envelope.

        Less what turns places of the window by themselves, which no intensity sees.
        ``tolerance`` is shared among the
        parts by their size, and by that of what is added to them: ``beside`` times the
        field.
        """
        y, x = (way.moved(name) for way in (self.y, self.x))
        moved = self.moved(name)
        pairs = (y, self.y.to), (x, self.x.to)
        sizes = [
            *(float(np.linalg.norm(by) / np.linalg.norm(to)) for by, to in pairs),
            moved.size / self.rest.size,
        ]
        whole = tolerance * math.hypot(*sizes, beside) / math.sqrt(len(sizes))
        some = [min(whole / max(size, 1e-300), _COARSEST) for size in sizes]
        ways = (
            (y, self.x.to, self.rest),
            (self.y.to, x, self.rest),
            (self.y.to, self.x.to, moved),
        )
        return self.envelope(
            self._sum(
                light, tuple((*way, one) for way, one in zip(ways, some, strict=True))
            )
        )

    def _sum(
        self, light: Array, ways: tuple[tuple[Array, Array, CouplingTerms, float], ...]
    ) -> Array:
        """Sum over r, q, b, p of W_r(Y, X) Fy(Y, q) a_rb(q) L(q, p) g_b(p) Fx(p, X),
        for several (Fy, Fx, terms).
        """
        ny, nx, kind = len(self.y.to), len(self.x.to), self.y.to.dtype
        products = []
        for y, x, terms, tolerance in ways:
            across, amounts, window = terms.some(tolerance)
            products.append(
                (
                    y,
                    (across[:, None] * x).reshape(len(across) * nx, -1).T,
                    amounts,
                    window,
                )
            )
        light = light.astype(kind, copy=False)
        out = np.zeros((*light.shape[:-2], ny, nx), kind)
        flat = light.reshape(-1, *light.shape[-2:])
        result = out.reshape(-1, *out.shape[-2:])

        def some(first: int, last: int) -> None:
            frames = flat[first:last].reshape(-1, flat.shape[-1])
            for y, x, amounts, window in products:
                mixed = amounts @ (frames @ x).reshape(
                    last - first, len(amounts), -1, nx
                )
                for i, one in enumerate(
                    mixed.reshape(last - first, len(amounts), -1), first
                ):
                    seen = (y @ one).reshape(ny, -1, nx)
                    result[i] += np.multiply(seen, window, out=seen).sum(
                        1
                    )  # five times as quick as einsum

        with threads.one_blas_thread():
            threads.run_split(len(flat), some)
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
    """(coarse samples, the way there from nodes and from there to the window's samples)
    along one axis.

    Args:
        k: wave number, rad/um.
        tolerance: relative error of the field.
        by: path to a place of the window, :meth:`Kernel.by_x` or :meth:`Kernel.by_y`.
        nodes: (n,) direction cosines. at_um: (m,) even samples of the window. band: of
            the field, rad/um.
        step_um: of the distance, for derivatives. rim_um: at either end, where a
            tenfold error is allowed.
    """
    coarse, weights = _resampled(
        float(at_um[0]), float(at_um[-1]), len(at_um), band, tolerance, rim_um
    )
    middle = (nodes[0] + nodes[-1]) / 2
    turn = k * by(nodes, coarse[:, None])
    carrier = k * by(middle, coarse[:, None])
    value = np.exp(1j * (turn - carrier))

    def moved(name: str) -> Array:
        if (
            name == "wave"
        ):  # k dF/dk is k F, and dk is -k² / 2 pi of the wavelength's change
            return np.asarray(-1j * turn * k / (2 * np.pi) * value)
        ends = [by(nodes, coarse[:, None], off) for off in (step_um, -step_um)]
        return np.asarray(1j * k * (ends[0] - ends[1]) / (2 * step_um) * value)

    return coarse, AxisOperators(value, weights, moved)


def _nearby(
    at_um: Array, coarse_um: Array, band: float, taps: int
) -> tuple[Array, Array]:
    """(fine, taps) nearest coarse samples of every place, and what each of them tells
    of another: (taps, taps).
    """
    step = coarse_um[1] - coarse_um[0]
    first = np.clip(
        np.floor((at_um - coarse_um[0]) / step).astype(int) - taps // 2 + 1,
        0,
        len(coarse_um) - taps,
    )
    apart = np.sinc(band * step / np.pi * (np.arange(taps)[:, None] - np.arange(taps)))
    return first[:, None] + np.arange(taps), apart


@functools.lru_cache(maxsize=32)
def _resampled(
    first: float,
    last: float,
    count: int,
    band: float,
    tolerance: float,
    rim_um: float = 0.0,
) -> tuple[Array, Array]:
    """(coarse even samples, (fine, coarse) weights) for functions of up to ``band``
    rad/um; treat as read-only.

    The window's own samples where they are no finer than that needs. With the fewest
    taps that are close enough, found
    by halves: their error falls with their number. Taps reach beyond the window only
    where its rim is narrower.
    """
    at_um, step = np.linspace(first, last, count), np.pi / band / ROOM
    width, fine = last - first, (last - first) / (count - 1)
    inner = np.abs(at_um - (first + last) / 2) <= width / 2 - rim_um

    def of(taps: int) -> tuple[Array, Array, float]:
        least = int(np.ceil(width / step)) + 1
        coarse_count = max(
            least, taps, int(np.ceil((width - 2 * rim_um) / step)) + taps
        )
        coarse = (first + last) / 2 + (
            np.arange(coarse_count) - (coarse_count - 1) / 2
        ) * step
        weights, missed = _weights(at_um, coarse, band, taps)
        return coarse, weights, float(np.where(inner, missed, missed / 10).max())

    found = None
    low, high = (0, len(_TAPS)) if step > 1.1 * fine else (0, 0)
    while low < high:
        middle = (low + high) // 2
        one = of(_TAPS[middle])
        close = one[2] < _SHARE * tolerance
        found = one if close else found
        low, high = (low, middle) if close else (middle + 1, high)
    if found is None or len(found[0]) >= len(at_um):
        return at_um, np.eye(len(at_um))
    return found[0], found[1]


def _weights(
    at_um: Array, coarse_um: Array, band: float, taps: int
) -> tuple[Array, Array]:
    """(fine, coarse) weights of the nearest ``taps`` samples, least squares over an
    evenly filled band; (fine,) errors,
    rms over it."""
    index, apart = _nearby(at_um, coarse_um, band, taps)
    seen = np.sinc(band / np.pi * (at_um[:, None] - coarse_um[index]))
    found = np.linalg.solve(apart, seen.T).T
    missed = (
        1 - 2 * (found * seen).sum(1) + np.einsum("ni,ij,nj->n", found, apart, found)
    )
    out = np.zeros((len(at_um), len(coarse_um)))
    np.put_along_axis(out, index, found, 1)
    return out, np.sqrt(np.maximum(missed, 0.0))
