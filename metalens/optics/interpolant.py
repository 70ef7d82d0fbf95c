"""Chebyshev interpolants of ray functions of the squared reach u.

They are analytic away from u = -(Σ t / n)², so coefficients fall as a power.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.polynomial import chebyshev

DEGREES = (8, 16, 24)
LEFT = 4e-15  # of the largest coefficient: those of the last two degrees
FEW = 1000  # places below which the function itself is quicker


def chebyshev_interpolant(function: Callable[[Any], Any], u: Any) -> Any:
    """function(u), elementwise, by a Chebyshev interpolant.

    The error is 1e-14 of the largest value. Degrees 8, 16 and 24 are tried over the
    range of u. The function itself is called for few places, or where the coefficients
    do not fall to rounding.

    Args:
        function: smooth, of an array or tensor.
        u: float64 array or tensor.
    """
    count = u.size if isinstance(u, np.ndarray) else u.numel()
    low, high = (float(u.min()), float(u.max())) if count >= FEW else (0.0, 0.0)
    middle = (low + high) / 2
    reach = (high - low) / 2
    for degree in DEGREES if reach > 0 else ():
        series = chebyshev.chebinterpolate(
            lambda unit: function(middle + reach * unit), degree
        )
        if np.abs(series[-2:]).max() <= LEFT * np.abs(series).max():
            return sum_powers(chebyshev.cheb2poly(series), (u - middle) / reach)
    return function(u)


def sum_powers(powers: np.ndarray, unit: Any) -> Any:
    """Polynomial Σ powers[n] unitⁿ, elementwise.

    Args:
        powers: (n,) coefficients, lowest first.
        unit: array or tensor.
    """
    total = unit * 0 + powers[-1]
    for power in powers[-2::-1]:
        total = total * unit + power
    return total
