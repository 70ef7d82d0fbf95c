"""Sine and cosine of whole turns as polynomials that a compiler turns into vector
instructions.
"""

from math import factorial, pi
from typing import Any

import numba
import numpy as np
from numba.extending import overload
from numpy.polynomial import Chebyshev, Polynomial

from metalens.core.arrays import Array


def _fit(series: Any, degree: int) -> Array:
    """Power coefficients in u = t² on [0, 1/4] of the Chebyshev interpolant of a
    function of u.
    """
    unit = Chebyshev.interpolate(series, degree, domain=[0, 0.25])
    return np.asarray(
        unit.convert(kind=Polynomial, domain=[-1, 1], window=[-1, 1]).coef
    )


def _taylor(odd: int, terms: int = 18) -> Any:
    """sin(πt)/t (odd = 1) or cos(πt) (odd = 0) as a power series in u = t²."""
    coefficients = [
        (-1) ** n * pi ** (2 * n + odd) / factorial(2 * n + odd) for n in range(terms)
    ]
    return Polynomial(coefficients)


SINE = {4: _fit(_taylor(1), 5).astype("f4"), 8: np.asarray(_taylor(1, 11).coef)}
COSINE = {4: _fit(_taylor(0), 6).astype("f4"), 8: np.asarray(_taylor(0, 12).coef)}
_S4, _C4 = tuple(SINE[4]), tuple(COSINE[4])
_S8, _C8 = tuple(float(v) for v in SINE[8]), tuple(float(v) for v in COSINE[8])


@numba.njit(inline="always")
def sincos_turns64(t):  # type: ignore[no-untyped-def]
    """(cos 2πt, sin 2πt) in float64 for t in [-1/2, 1/2]."""
    u = t * t
    s = _S8[5] + u * (_S8[6] + u * (_S8[7] + u * (_S8[8] + u * (_S8[9] + u * _S8[10]))))
    s = t * (_S8[0] + u * (_S8[1] + u * (_S8[2] + u * (_S8[3] + u * (_S8[4] + u * s)))))
    c = _C8[6] + u * (
        _C8[7] + u * (_C8[8] + u * (_C8[9] + u * (_C8[10] + u * _C8[11])))
    )
    c = _C8[0] + u * (
        _C8[1] + u * (_C8[2] + u * (_C8[3] + u * (_C8[4] + u * (_C8[5] + u * c))))
    )
    return c * c - s * s, 2.0 * s * c


@numba.njit(inline="always")
def sincos_turns32(t):  # type: ignore[no-untyped-def]
    """(cos 2πt, sin 2πt) in float32 for t in [-1/2, 1/2]."""
    x = np.float32(t)
    u = x * x
    s = x * (
        _S4[0] + u * (_S4[1] + u * (_S4[2] + u * (_S4[3] + u * (_S4[4] + u * _S4[5]))))
    )
    c = _C4[0] + u * (
        _C4[1] + u * (_C4[2] + u * (_C4[3] + u * (_C4[4] + u * (_C4[5] + u * _C4[6]))))
    )
    return c * c - s * s, np.float32(2) * s * c


def sincos_turns(t: Any, like: Any) -> Any:
    """(cos 2πt, sin 2πt) in the precision of the array ``like``; compiled loops choose
    while they are compiled.
    """
    return sincos_turns32(t) if like.dtype == np.float32 else sincos_turns64(t)


@overload(sincos_turns, inline="always")
def _turns(t, like):  # type: ignore[no-untyped-def]
    if like.dtype == numba.float32:
        return lambda t, like: sincos_turns32(t)
    return lambda t, like: sincos_turns64(t)
