"""From nodes to a sensor window: products with two factors and few terms, on samples as coarse as the band allows.

Along each axis the field less its carrier, the turns of the middle direction, holds no frequency above k times half the
span of direction cosines. It is computed on an even grid ``ROOM`` times as fine as that asks, and interpolated to the
window's samples by the weights of least error over the band: as in any prolate problem, that falls geometrically with
their number (Slepian and Pollak 1961; Knab 1979).
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from metalens.ground import threads
from metalens.ground.arrays import Array

MIXED = 0.1  # of the tolerance, for functions of p in the terms
ROOM = 1.3  # samples over those of the sampling theorem
_SHARE = 0.1  # of the tolerance, for the interpolation
_TAPS = range(6, 42, 2)
_STEP_UM = 0.5  # of the distance: paths bend over hundreds of um


@dataclass(frozen=True, eq=False, slots=True)
class Ways:
    """Along one axis: nodes to coarse samples, ``to`` (coarse, nodes); coarse to fine samples, ``fine`` (fine, coarse).

    by_wave, by_distance: derivatives of ``to`` by the wavelength and the distance, per um.
    """

    to: Array
    fine: Array
    by_wave: Array
    by_distance: Array


@dataclass(frozen=True, eq=False, slots=True)
class Operators:
    """From nodes to window for one wavelength and distance.

    Both axes, and the few terms of what is no product of them: functions of p (b, p), their amounts in every term
    (q, r, b), and every term on coarse samples (Y, r, X).

    remainder, mixed: (r,), (b,) relative size of what is left out before each term, each function of p.
    """

    y: Ways
    x: Ways
    across: Array
    amounts: Array
    window_terms: Array
    remainder: Array
    mixed: Array

    def terms(self, tolerance: float) -> tuple[int, int]:
        """How many terms, and functions of p in them, leave a relative ``tolerance`` out."""
        return max(1, int((self.remainder > tolerance).sum())), max(1, int((self.mixed > MIXED * tolerance).sum()))

    def field(self, light: Array, *, terms: tuple[int, int] | None = None) -> Array:
        """(..., q, p) -> (..., Y, X) in the precision of the operators, by all terms or some."""
        return self._sum(light, ((self.y.to, self.x.to),), terms)

    def rates(self, light: Array, name: str, *, terms: tuple[int, int] | None = None) -> Array:
        """(..., q, p) -> (..., Y, X) derivative of :meth:`field` by ``wave`` or ``distance`` per um, of unit level.

        That of both factors: what the low-rank terms, the level and the window's own turns change is a hundredth of it,
        or is not seen in an intensity.
        """
        moved = [getattr(way, f"by_{name}") for way in (self.y, self.x)]
        return self._sum(light, ((moved[0], self.x.to), (self.y.to, moved[1])), terms)

    def _sum(self, light: Array, pairs: tuple[tuple[Array, Array], ...], terms: tuple[int, int] | None) -> Array:
        """Sum over r, q, b, p of W_r(Y, X) Fy(Y, q) a_rb(q) L(q, p) g_b(p) Fx(p, X)."""
        r, b = terms or (len(self.remainder), len(self.mixed))
        ny, nx, kind = len(self.y.to), len(self.x.to), self.y.to.dtype
        amounts, window = self.amounts[:, :r, :b], self.window_terms[:, :r]
        ways = [(y, (self.across[:b, None] * x).reshape(b * nx, -1).T) for y, x in pairs]
        light = light.astype(kind, copy=False)
        out = np.empty((*light.shape[:-2], len(self.y.fine), len(self.x.fine)), kind)
        flat, result = light.reshape(-1, *light.shape[-2:]), out.reshape(-1, *out.shape[-2:])

        def some(first: int, last: int) -> None:
            for i in range(first, last):
                coarse = np.zeros((ny, nx), kind)
                for y, x in ways:
                    mixed = amounts @ (flat[i] @ x).reshape(-1, b, nx)
                    coarse += np.einsum("YrX,YrX->YX", (y @ mixed.reshape(-1, r * nx)).reshape(ny, r, nx), window)
                np.matmul(self.y.fine @ coarse, self.x.fine.T, out=result[i])

        with threads.one_blas_thread():
            threads.split(len(flat), some)
        return out


def ways(
    by: Callable[..., Array], nodes: Array, at_um: Array, band: float, *, k: float, tolerance: float
) -> tuple[Array, Ways]:
    """(coarse samples, the way there from nodes and from there to the window's samples) along one axis.

    Args:
        by: path to a place of the window, :meth:`Kernel.by_x` or :meth:`Kernel.by_y`.
        nodes: (n,) direction cosines. at_um: (m,) even samples of the window. band: of the field, rad/um.
    """
    coarse, weights = _resampled(at_um, band, tolerance)
    middle = (nodes[0] + nodes[-1]) / 2
    turn = k * by(nodes, coarse[:, None])
    value = np.exp(1j * turn)
    ends = [by(nodes, coarse[:, None], off) for off in (_STEP_UM, -_STEP_UM)]
    by_distance = 1j * k * (ends[0] - ends[1]) / (2 * _STEP_UM) * value
    by_wave = -1j * turn * k / (2 * np.pi) * value  # k dF/dk is k F, and dk is -k² / 2 pi of the wavelength's change
    carrier = [np.exp(1j * k * by(middle, places)) for places in (at_um, coarse)]
    return coarse, Ways(value, carrier[0][:, None] * weights * carrier[1].conj(), by_wave, by_distance)


def _resampled(at_um: Array, band: float, tolerance: float) -> tuple[Array, Array]:
    """(coarse even samples, (fine, coarse) weights) for functions of up to ``band`` rad/um.

    The window's own samples where they are no finer than that needs.
    """
    step = np.pi / band / ROOM
    fine = float(np.ptp(at_um)) / (len(at_um) - 1)
    if step > 1.1 * fine:
        for taps in _TAPS:
            count = int(np.ceil(np.ptp(at_um) / step)) + taps
            coarse = (at_um[0] + at_um[-1]) / 2 + (np.arange(count) - (count - 1) / 2) * step
            weights, missed = _weights(at_um, coarse, band, taps)
            if count < len(at_um) and missed < _SHARE * tolerance:
                return coarse, weights
    return at_um, np.eye(len(at_um))


def _weights(at_um: Array, coarse_um: Array, band: float, taps: int) -> tuple[Array, float]:
    """(fine, coarse) weights of the nearest ``taps`` samples, least squares over an evenly filled band; rms error."""
    step = coarse_um[1] - coarse_um[0]
    first = np.clip(np.floor((at_um - coarse_um[0]) / step).astype(int) - taps // 2 + 1, 0, len(coarse_um) - taps)
    index = first[:, None] + np.arange(taps)
    apart = np.sinc(band * step / np.pi * (np.arange(taps)[:, None] - np.arange(taps)))
    seen = np.sinc(band / np.pi * (at_um[:, None] - coarse_um[index]))
    found = np.linalg.solve(apart + 1e-14 * np.eye(taps), seen.T).T
    missed = 1 - 2 * (found * seen).sum(1) + np.einsum("ni,ij,nj->n", found, apart, found)
    out = np.zeros((len(at_um), len(coarse_um)))
    np.put_along_axis(out, index, found, 1)
    return out, float(np.sqrt(max(float(missed.max()), 0.0)))
