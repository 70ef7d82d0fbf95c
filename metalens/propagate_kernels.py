"""Compiled loops over pillars: folded phasors, and gradients pulled back to phase and transmission.

The carrier comes as a polynomial for every row and segment of columns (:class:`Carrier`), so that no root or division
is left in the loop: c(u) = Σ_n coefficients[row, segment, n] uⁿ turns, u in [-1, 1] along the segment.
"""

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.polynomial import chebyshev

from metalens.errors import PropagationError
from metalens.propagate_case import Case, sensor_path, source_path
from metalens.propagate_sincos import turns
from metalens.store import Array

ORDER = 8
SEGMENTS = (128, 64, 32, 16, 8, 4)
ACCURACY = {4: 1e-8, 8: 1e-11}  # turns, beside 1e-16 of the path itself


@dataclass(frozen=True, slots=True)
class Carrier:
    """Source path plus sensor path in turns as polynomials along segments of ``width`` pillars."""

    case: Case
    reference: float
    width: int
    order: int = ORDER

    def table(self, start: int, stop: int) -> Array:
        """(row, segment, order) coefficients for pillar rows start to stop."""
        u = np.cos(np.pi * (np.arange(self.order) + 0.5) / self.order)
        y = self.case.pillars_um[0][start:stop, None, None]
        return np.asarray(carrier_turns(self.case, self.reference, self.along(u), y) @ _to_powers(u).T)

    def along(self, u: Array) -> Array:
        """(segment, u) columns in um of positions ``u`` in every segment."""
        x = self.case.pillars_um[1]
        return x[:: self.width, None] + (u + 1) / 2 * (self.width - 1) * self.case.pitch_um

    @property
    def positions(self) -> Array:
        """(width,) u of the pillars of a segment."""
        return np.linspace(-1, 1, self.width)


def carrier_turns(case: Case, reference: float, x: Any, y: Any) -> Any:
    """Source path (of the reference depth) plus sensor path (to the window centre), in wavelengths."""
    path = source_path(x, y, case.tangents, reference)
    return (path + sensor_path(x, y, case.centre_um, case.sensor_distance_um)) / case.wavelength_um


def _to_powers(u: Array) -> Array:
    """(power, node): power coefficients of the polynomial through values at the Chebyshev nodes ``u``."""
    n = len(u)
    coefficients = np.linalg.inv(chebyshev.chebvander(u, n - 1))
    columns = [np.pad(chebyshev.cheb2poly(c), (0, n))[:n] for c in coefficients.T]
    return np.array(columns).T


def carrier(case: Case, reference: float, itemsize: int) -> Carrier:
    """The widest segments whose polynomials are right to 1e-8 turns (float32) or 1e-11 turns (float64).

    Raises:
        PropagationError: the sensor or the source is closer than the pillars' pitch.
    """
    y = case.pillars_um[0]
    rows = sorted({0, len(y) // 4, len(y) // 2, len(y) - 1})
    for width in SEGMENTS:
        found = Carrier(case, reference, width)
        u, error, scale = found.positions, 0.0, 1.0
        powers = u[:, None] ** np.arange(found.order)
        for row in rows:
            want = carrier_turns(case, reference, found.along(u), y[row])
            got = found.table(row, row + 1)[0] @ powers.T
            error, scale = max(error, np.abs(got - want).max()), max(scale, np.abs(want).max())
        if error <= ACCURACY[itemsize] + 4e-16 * scale * (1 + found.order):
            return found
    raise PropagationError(
        f"sensor at {case.sensor_distance_um} um is too close to pillars of pitch {case.pitch_um} um for the windowed "
        "method; use propagate.exact"
    )


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _row(phase, table, u, first, cosine, sine):  # type: ignore[no-untyped-def]
    """Cosine and sine of phase plus carrier in the columns first to the end of the buffers."""
    last = first + cosine.size
    for s in range(first // u.size, (last - 1) // u.size + 1):
        low, high = max(s * u.size, first), min((s + 1) * u.size, last)
        a, b, c, d, e, f, g, h = table[s]
        at = u[low - s * u.size : high - s * u.size]
        p, re, im = phase[low:high], cosine[low - first : high - first], sine[low - first : high - first]
        for j in range(high - low):
            v = at[j]
            t = np.float64(p[j]) * (1 / (2 * np.pi))
            t += a + v * (b + v * (c + v * (d + v * (e + v * (f + v * (g + v * h))))))
            re[j], im[j] = turns(t - np.rint(t), cosine)


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def fill(phase, level, table, u, out):  # type: ignore[no-untyped-def]
    """Folded phasors of a block of rows: out (parity, row, re/im, column)."""
    rows, nx = phase.shape
    reach, half = out.shape[3], (nx + 1) // 2
    first = half - reach
    last = nx - first
    cosine, sine = np.empty(last - first, out.dtype), np.empty(last - first, out.dtype)
    for i in range(rows):
        _row(phase[i], table[i], u, first, cosine, sine)
        _fold(cosine, level[i, first:last], out[0, i, 0], out[1, i, 0], nx % 2)
        _fold(sine, level[i, first:last], out[0, i, 1], out[1, i, 1], nx % 2)


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _fold(values, level, even, odd, middle):  # type: ignore[no-untyped-def]
    """Sum and difference of the columns right and left of the axis; the axis column of an odd grid counts once."""
    reach = even.size
    right, left = values[values.size - reach :], values[:reach]
    right_level, left_level = level[values.size - reach :], level[:reach]
    for j in range(reach):
        a, b = right[j] * right_level[j], left[reach - 1 - j] * left_level[reach - 1 - j]
        even[j] = a + b
        odd[j] = a - b
    if middle:
        even[0] *= even.dtype.type(0.5)


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def pull(phase, level, out_phase, out_level, table, u, grad):  # type: ignore[no-untyped-def]
    """Gradients of the folded phasors to those of phase and transmission, where their arrays are not empty."""
    rows, nx = phase.shape
    reach, half = grad.shape[3], (nx + 1) // 2
    first = half - reach
    count = nx - 2 * first
    cosine, sine = np.empty(count, grad.dtype), np.empty(count, grad.dtype)
    re, im = np.empty(count, grad.dtype), np.empty(count, grad.dtype)
    for i in range(rows):
        _row(phase[i], table[i], u, first, cosine, sine)
        _unfold(grad[0, i, 0], grad[1, i, 0], re)
        _unfold(grad[0, i, 1], grad[1, i, 1], im)
        if out_phase.size:
            p, t = out_phase[i, first : first + count], level[i, first : first + count]
            for j in range(count):
                p[j] = t[j] * (im[j] * cosine[j] - re[j] * sine[j])
        if out_level.size:
            p = out_level[i, first : first + count]
            for j in range(count):
                p[j] = re[j] * cosine[j] + im[j] * sine[j]


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _unfold(even, odd, out):  # type: ignore[no-untyped-def]
    """Adjoint of :func:`_fold`; odd polynomials vanish on the axis column, so both sides agree there."""
    reach = even.size
    right, left = out[out.size - reach :], out[:reach]
    for j in range(reach):
        left[reach - 1 - j] = even[j] - odd[j]
    for j in range(reach):
        right[j] = even[j] + odd[j]


@numba.njit(nogil=True, cache=True)
def outermost(level, half):  # type: ignore[no-untyped-def]
    """Columns, at most ``half``, that are closed in every row at both ends of the map."""
    closed = half
    for i in range(level.shape[0]):
        j = 0
        while j < closed and level[i, j] == 0 and level[i, level.shape[1] - 1 - j] == 0:
            j += 1
        closed = j
    return closed
