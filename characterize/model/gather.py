"""Pillars onto even nodes: the functions of every one times its phasor, in a compiled
loop, and the nodes.
"""

import math

import numba
import numpy as np

from metalens.core import legendre
from metalens.core.arrays import Array
from metalens.lens import DiameterMap
from metalens.optics import Stop


def even_nodes(count: int, pull: float, low: float, high: float) -> Array:
    """(count,) nearly even places on [low, high]: arcsin(pull t) of Gauss-Legendre
    nodes t (Kosloff and Tal-Ezer 1993).

    A wave of n radians a half span needs n + O(n^(1/3)) Legendre nodes, which crowd at
    the ends; pulled apart, 0.7 n.
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
    """Of :func:`even_nodes`: how near its branch may come to the ends of the nodes, for
    a
    wave as steep as they hold.

    Args:
        count: of the nodes.
        tolerance: relative error that is allowed.
    """
    return 1 / math.cosh((math.log(1e5 / tolerance) + count / 60) / count)


def node_density(count: int, tolerance: float) -> float:
    """Of :func:`even_nodes` places in the middle over that of Gauss-Legendre nodes.

    Args:
        count: how many are asked for.
        tolerance: relative error that is allowed.
    """
    pulled = node_stretch(count, tolerance)
    return math.asin(pulled) / pulled


def is_mirror_symmetric(
    diameters: DiameterMap, tangents: tuple[float, float], stop: Stop | None = None
) -> bool:
    """Whether pillars, the path of a chief ray and the shadow of a stop are alike to
    both sides of both axes: a quarter
    of them tells all.

    Args:
        diameters: the pillars of the lens.
        tangents: (x, y) of the chief ray.
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
    """(n, m) weights of places of which those from ``first``, the middle one, on are
    asked for: each with its mirror
    image's. As they are where that is 0."""
    if not first:
        return weights
    out = weights.copy()
    out[first + len(weights) % 2 :] += weights[:first][::-1]
    return out


def gather_light(table: Array, place: Array, turns: Array) -> Array:
    """(columns, rows, 2 r) real parts, then imaginary parts, of table[:, place] times
    turns.

    All r numbers of a pillar lie together: one look-up each, where r arrays would be
    walked through. Columns come
    first, so that a sum along them is one product of matrices.

    Args:
        table: (entries, r) complex. place: (rows, columns) entries. turns: (rows,
            columns), of the table's kind.
    """
    out = np.empty((*place.shape[::-1], 2 * table.shape[1]), table.real.dtype)
    _lit(
        np.ascontiguousarray(table.real),
        np.ascontiguousarray(table.imag),
        place,
        turns,
        out,
    )
    return out


@numba.njit(nogil=True, error_model="numpy", cache=True)
def _lit(real: Array, imaginary: Array, place: Array, turns: Array, out: Array) -> None:
    r = real.shape[1]
    for j in range(place.shape[1]):
        for i in range(place.shape[0]):
            a = real[place[i, j]]
            b = imaginary[place[i, j]]
            c = turns[i, j].real
            s = turns[i, j].imag
            for k in range(r):
                out[j, i, k] = a[k] * c - b[k] * s
                out[j, i, r + k] = a[k] * s + b[k] * c
