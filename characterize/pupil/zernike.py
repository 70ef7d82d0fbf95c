"""Zernike polynomials on the unit disc, orthonormal (Noll 1976), by radial order."""

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
    """Usual name of the aberration where there is one, else ``Z(n, m)``.

    Args:
        index: (n, m) radial and azimuthal order.
    """
    return _NAMES.get(index, f"Z({index[0]}, {index[1]})")


def zernike_polynomial(index: Index, rho: Array, theta: Array) -> Array:
    """Z_n^m on the unit disc: N R_n^|m|(rho) cos(m theta), or sin(|m| theta) for m < 0;
    N = sqrt(n + 1), times sqrt(2) for m other than 0.

    Args:
        index: (n, m) radial and azimuthal order.
        rho: (*shape) radius. theta: (*shape) azimuth, rad.
    """
    n, m = index
    q = (n - abs(m)) // 2
    radial = np.zeros_like(rho)
    for s in range(q + 1):
        term = (-1) ** s * math.comb(n - s, s) * math.comb(n - 2 * s, q - s)
        radial = radial + term * rho ** (n - 2 * s)
    angular = np.cos(m * theta) if m >= 0 else np.sin(-m * theta)
    return np.asarray(math.sqrt((n + 1) * (2 if m else 1)) * radial * angular)


def zernike_basis(which: list[Index], x: Array, y: Array) -> Array:
    """(len(which), *shape) polynomials at Cartesian coordinates of the unit disc.

    Args:
        which: (n, m) of each.
        x: (*shape) x in the pupil over its radius.
        y: (*shape) y in the pupil over its radius.
    """
    rho, theta = np.hypot(x, y), np.arctan2(y, x)
    basis = [zernike_polynomial(index, rho, theta) for index in which]
    return np.array(basis).reshape(len(which), *x.shape)
