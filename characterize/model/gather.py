"""Compiled loop: the functions of every pillar times its phasor, one pillar after another, as matrices take them."""

import numba
import numpy as np

from metalens.ground.arrays import Array


def lit(table: Array, place: Array, turns: Array) -> Array:
    """(columns, rows, 2 r) real parts, then imaginary parts, of table[:, place] times turns.

    All r numbers of a pillar lie together: one look-up each, where r arrays would be walked through. Columns come
    first, so that a sum along them is one product of matrices.

    Args:
        table: (entries, r) complex. place: (rows, columns) entries. turns: (rows, columns), of the table's kind.
    """
    out = np.empty((*place.shape[::-1], 2 * table.shape[1]), table.real.dtype)
    _lit(np.ascontiguousarray(table.real), np.ascontiguousarray(table.imag), place, turns, out)
    return out


@numba.njit(nogil=True, error_model="numpy", cache=True)
def _lit(real: Array, imaginary: Array, place: Array, turns: Array, out: Array) -> None:
    r = real.shape[1]
    for j in range(place.shape[1]):
        for i in range(place.shape[0]):
            a, b, c, s = real[place[i, j]], imaginary[place[i, j]], turns[i, j].real, turns[i, j].imag
            for k in range(r):
                out[j, i, k] = a[k] * c - b[k] * s
                out[j, i, r + k] = a[k] * s + b[k] * c
