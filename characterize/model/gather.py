"""Pillars onto even nodes: the basis functions of each pillar times its phasor, in a
compiled loop, and the nodes.
"""

import math

import numba
import numpy as np

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.lens import DiameterMap
from metalens.optics import Stop


def even_nodes(count: int, pull: float, low: float, high: float) -> Array:
    """(count,) nearly even places on [low, high].

    arcsin(pull t) / arcsin(pull) of Gauss-Legendre nodes t (Kosloff and Tal-Ezer
    1993). A wave of n radians a half span needs n + O(n^(1/3)) Legendre nodes, which
    crowd at the ends; of these about 0.7 n.
    """
    t = np.arcsin(pull * legendre.gauss_legendre_nodes(count)[0]) / math.asin(pull)
    return np.asarray((low + high) / 2 + (high - low) / 2 * t)


def even_interpolation(
    count: int, pull: float, span: tuple[float, float], values: Array
) -> Array:
    """(*values, count) interpolation from :func:`even_nodes` places.

    Args:
        pull: how far the nodes are drawn apart.
        span: (low, high) of the places.
    """
    low, high = span
    t = (2 * values - low - high) / (high - low)
    return np.asarray(
        legendre.interpolation_matrix(count, np.sin(math.asin(pull) * t) / pull)
    )


def node_stretch(count: int, tolerance: float) -> float:
    """Factor ``pull`` of :func:`even_nodes` for a wave as steep as they resolve.

    The nearer to 1, the more even the nodes, and the closer the branch of arcsin
    comes to their ends.

    Args:
        count: number of nodes.
        tolerance: relative error that is allowed.
    """
    return 1 / math.cosh((math.log(1e5 / tolerance) + count / 60) / count)


def node_density(count: int, tolerance: float) -> float:
    """Density of :func:`even_nodes` in the middle over that of Gauss-Legendre nodes.

    Args:
        count: number of nodes.
        tolerance: relative error that is allowed.
    """
    pulled = node_stretch(count, tolerance)
    return math.asin(pulled) / pulled


def is_mirror_symmetric(
    diameters: DiameterMap, tangents: tuple[float, float], stop: Stop | None = None
) -> bool:
    """Whether the light on the lens is symmetric about both axes.

    Then a quarter of the pillars is enough. Compared are the pillars, the direction
    of the chief ray and the shadow of the stop.

    Args:
        diameters: the pillars of the lens.
        tangents: (x, y) of the chief ray.
        stop: aperture stop in front of the lens; None for none.
    """
    d = diameters.diameter_um
    plain = (
        diameters.angle_rad is None
        and diameters.length_um is None
        and not any(tangents)
    )
    return (
        plain
        and (stop is None or stop.centred)
        and np.array_equal(d, d[::-1])
        and np.array_equal(d, d[:, ::-1])
    )


def fold_weights(weights: Array, first: int) -> Array:
    """Interpolation weights (n, m) of symmetric places, folded onto one half.

    Places from ``first``, the middle one, on remain in use. To each weight of these
    the weight of its mirror image is added. As they are where ``first`` is 0.
    """
    if not first:
        return weights
    out = weights.copy()
    out[first + len(weights) % 2 :] += weights[:first][::-1]
    return out


def gather_light(table: Array, place: Array, turns: Array) -> Array:
    """(columns, rows, 2 r) real, then imaginary parts of table[place] times turns.

    The r numbers of a pillar lie next to each other: one look-up each. Columns come
    first, so that a sum along them is one product of matrices.

    Args:
        table: (entries, r) complex.
        place: (rows, columns) entries of the table.
        turns: (rows, columns) phasors, of the table's type.
    """
    out = np.empty((*place.shape[::-1], 2 * table.shape[1]), table.real.dtype)
    _multiply_phasors(
        np.ascontiguousarray(table.real),
        np.ascontiguousarray(table.imag),
        place,
        turns,
        out,
    )
    return out


@numba.njit(nogil=True, error_model="numpy", cache=True)
def _multiply_phasors(
    real: Array, imaginary: Array, place: Array, turns: Array, out: Array
) -> None:
    """Fill out[j, i] with (Re, Im) of table[place[i, j]] times turns[i, j]."""
    count = real.shape[1]
    for j in range(place.shape[1]):
        for i in range(place.shape[0]):
            real_row = real[place[i, j]]
            imaginary_row = imaginary[place[i, j]]
            cosine = turns[i, j].real
            sine = turns[i, j].imag
            for k in range(count):
                out[j, i, k] = real_row[k] * cosine - imaginary_row[k] * sine
                out[j, i, count + k] = real_row[k] * sine + imaginary_row[k] * cosine
