"""Light behind the edge of a round hole, compiled: shares of places a few nanoseconds
each.

    E(w) = e^(-iπ/4) / √2 ∫_-∞^w e^(iπv²/2) dv = [w > 0] + e^(iπ(w²/2 - 1/4)) / √2 A(w),    w >= 0, E(-w) = 1 - E(w)
    A(w) = -e^(iπ/4) ∫_0^∞ e^(-πt²/2 + iπ e^(iπ/4) w t) dt,    A' = 1 - iπw A

(Born and Wolf, Principles of Optics, 8.7.3, the contour turned by 45 degrees). A has no
oscillation: a table of cubics
up to ``LONGEST``, 1e-7, and 1 / (iπw) Σ (2n - 1)!! / (iπw²)^n beyond, 1e-7.
"""

import numba
import numpy as np

from metalens.core.arrays import Array
from metalens.core.threads import run_split

LONGEST, STEPS = 5, 32  # of the table, and in a unit of w


def _table() -> Array:
    """(w, 4) A and A' / STEPS, real and imaginary, by Gauss's rule."""
    node, weight = np.polynomial.legendre.leggauss(80)
    t, turn = 2.5 * (node + 1), np.exp(0.25j * np.pi)
    w = np.arange(LONGEST * STEPS + 2) / STEPS
    value = (
        -turn
        * np.exp(-np.pi / 2 * t * t + 1j * np.pi * turn * np.outer(w, t))
        @ (2.5 * weight)
    )
    slope = (1 - 1j * np.pi * w * value) / STEPS
    return np.stack([value.real, value.imag, slope.real, slope.imag], -1)


TABLE = _table()


@numba.njit(cache=True, inline="always")
def _wave(w, table):  # type: ignore[no-untyped-def]
    """E(w) and its integral w E(w) + i/π e^(-iπ/4)/√2 e^(iπw²/2)."""
    a = abs(w)
    turns = a * a / 4 - 0.125
    angle = 2 * np.pi * (turns - np.rint(turns))
    wave = complex(np.cos(angle), np.sin(angle)) * np.sqrt(0.5)
    if a < LONGEST:
        i = int(a * STEPS)
        u = a * STEPS - i
        low, high = table[i], table[i + 1]
        p, q, r = u * u * (3 - 2 * u), u * (1 - u) * (1 - u), u * u * (u - 1)
        re = low[0] + p * (high[0] - low[0]) + q * low[2] + r * high[2]
        im = low[1] + p * (high[1] - low[1]) + q * low[3] + r * high[3]
        bent = complex(re, im)
    else:
        part = complex(0.0, -1 / (np.pi * a * a))  # 1 / (iπw²)
        bent = a * part * (1 + part * (1 + 3 * part * (1 + 5 * part)))
    found = 1 + wave * bent if w >= 0 else -wave * bent
    return found, w * found + complex(0.0, 1 / np.pi) * wave


@numba.njit(cache=True, nogil=True)
def _fill(x, y, width, ray, lengths, hole, table, out):  # type: ignore[no-untyped-def]
    along, across = lengths
    radius, wavelength = hole
    for i in range(len(out)):
        far = max(np.hypot(x[i], y[i]), 1e-12)
        cosine = (x[i] * ray[0] + y[i] * ray[1]) / far
        normal = across + (along - across) * cosine * cosine
        scale = np.sqrt(2 / (wavelength * normal))
        middle, half = (radius - far) * scale, width[i] * scale / 2
        one, other = _wave(middle + half, table), _wave(middle - half, table)
        bent = complex(
            0.0, wavelength * along * across / (normal * 4 * np.pi * radius * width[i])
        )
        out[i] = (one[1] - other[1]) / (2 * half) - bent * (one[0] - other[0])


def edge_diffraction_factor(
    at_um: tuple[Array, Array],
    width_um: float | Array,
    ray: tuple[float, float],
    lengths_um: tuple[float, float],
    radius_um: float,
    wavelength_um: float,
) -> Array:
    """Complex amplitude S of :mod:`metalens.lens.stop` where rays cross the stop at (x,
    y), mean over a width.

    Args:
        at_um: of one shape. ray: unit vector of the plane of incidence. lengths_um:
            Fresnel lengths in it, across it.
    """
    shape = np.shape(at_um[0])
    x, y, width = (
        np.ascontiguousarray(np.broadcast_to(a, shape), float).ravel()
        for a in (*at_um, width_um)
    )
    out = np.empty(len(x), complex)

    def work(a: int, b: int) -> None:
        _fill(
            x[a:b],
            y[a:b],
            width[a:b],
            ray,
            lengths_um,
            (radius_um, wavelength_um),
            TABLE,
            out[a:b],
        )

    run_split(len(x), work)
    return out.reshape(shape)
