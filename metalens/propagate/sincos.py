"""Sine and cosine of whole turns as polynomials that a compiler turns into vector
instructions.
"""

from math import factorial, pi
from typing import Any

import numba
import numpy as np
from numba.extending import overload
from numpy.polynomial import Chebyshev, Polynomial


def _taylor(odd: int, terms: int) -> tuple[float, ...]:
    """sin(πt)/t (odd = 1) or cos(πt) (odd = 0) as a power series in u = t²."""
    return tuple(
        (-1) ** n * pi ** (2 * n + odd) / factorial(2 * n + odd) for n in range(terms)
    )


def _economised(odd: int, degree: int) -> tuple[np.float32, ...]:
    """The same by the Chebyshev interpolant on [0, 1/4], in float32."""
    series = Polynomial(_taylor(odd, 18))
    unit = Chebyshev.interpolate(series, degree, domain=[0, 0.25])
    power = unit.convert(kind=Polynomial, domain=[-1, 1], window=[-1, 1])
    return tuple(power.coef.astype("f4"))


_S4, _C4 = _economised(1, 5), _economised(0, 6)
_S8, _C8 = _taylor(1, 11), _taylor(0, 12)


@numba.njit(inline="always")
def _horner(u, powers):  # type: ignore[no-untyped-def]
    """Polynomial of constant coefficients, lowest first; the loop is unrolled."""
    total = powers[len(powers) - 1]
    for n in range(len(powers) - 2, -1, -1):
        total = powers[n] + u * total
    return total


@numba.njit(inline="always")
def sincos_turns64(t):  # type: ignore[no-untyped-def]
    """(cos 2πt, sin 2πt) in float64 for t in [-1/2, 1/2]."""
    s, c = t * _horner(t * t, _S8), _horner(t * t, _C8)
    return c * c - s * s, (s + s) * c


@numba.njit(inline="always")
def sincos_turns32(t):  # type: ignore[no-untyped-def]
    """(cos 2πt, sin 2πt) in float32 for t in [-1/2, 1/2]."""
    x = np.float32(t)
    s, c = x * _horner(x * x, _S4), _horner(x * x, _C4)
    return c * c - s * s, (s + s) * c


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
