"""Zernike polynomials on the unit disc, normalised to unit variance (Noll 1976), by
radial order.
"""

import math

import numpy as np

from metalens.core.arrays import Array

Index = tuple[int, int]
_NAMES = {
    (2, -2): "oblique astigmatism",
    (2, 0): "defocus",
    (2, 2): "astigmatism",
    (3, -3): "oblique trefoil",
    (3, -1): "coma y",
    (3, 1): "coma x",
    (3, 3): "trefoil",
    (4, 0): "spherical",
}


def zernike_indices(lowest: int, highest: int) -> list[Index]:
    """(n, m) of all polynomials of radial order ``lowest`` to ``highest``, m from -n to
    n in steps of 2.
    """
    return [(n, m) for n in range(lowest, highest + 1) for m in range(-n, n + 1, 2)]


def zernike_name(index: Index) -> str:
    """Usual name where there is one, else ``Z(n, m)``.

    Args:
        index: (n, m) radial and azimuthal order.
    """
    return _NAMES.get(index, f"Z({index[0]}, {index[1]})")


def zernike_polynomial(index: Index, rho: Array, theta: Array) -> Array:
    """Z_n^m at polar coordinates of the unit disc: sqrt(n + 1) (sqrt 2 if m) R(rho)
    cos(m theta), or sin for m < 0.

    Args:
        index: (n, m) radial and azimuthal order.
    """
    n, m = index
    k = abs(m)
    radial = np.zeros_like(rho)
    for s in range((n - k) // 2 + 1):
        term = math.factorial(n - s) / (
            math.factorial(s)
            * math.factorial((n + k) // 2 - s)
            * math.factorial((n - k) // 2 - s)
        )
        radial = radial + (-1) ** s * term * rho ** (n - 2 * s)
    angular = np.cos(k * theta) if m >= 0 else np.sin(k * theta)
    return np.asarray(math.sqrt((n + 1) * (2 if m else 1)) * radial * angular)


def zernike_basis(which: list[Index], x: Array, y: Array) -> Array:
    """(len(which), *shape) polynomials at Cartesian coordinates of the unit disc.

    Args:
        x: x in the pupil over its radius.
        y: y in the pupil over its radius.
    """
    rho, theta = np.hypot(x, y), np.arctan2(y, x)
    return (
        np.stack([zernike_polynomial(index, rho, theta) for index in which])
        if which
        else np.empty((0, *x.shape))
    )
