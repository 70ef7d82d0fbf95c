"""Compiled loops over pillars: light gathered at the nodes of blocks, and gradients
given back to every pillar.
"""

from typing import Any

import numba
import numpy as np
from numba.extending import overload

from metalens.propagate.sincos import sincos_turns

EXACT = {
    "contract",
    "arcp",
    "nsz",
    "afn",
}  # order of sums is kept: the phase is reduced in two steps
_PER_RAD = 1 / (2 * np.pi)
_SCALE, _FIRST = (
    np.float32(_PER_RAD),
    np.float32(6.28125),
)  # few bits, so that its multiples are exact
_SECOND = np.float32(2 * np.pi - 6.28125)


def whole_turns_off(phase: Any, like: Any) -> Any:
    """Phase in turns less its whole turns, in the precision of ``like``; compiled loops
    choose while compiled.
    """
    return (_single if like.dtype == np.float32 else _double)(phase, like)  # type: ignore[no-untyped-call]


def _double(phase, like):  # type: ignore[no-untyped-def]
    t = phase * _PER_RAD
    return t - np.rint(t)


def _single(phase, like):  # type: ignore[no-untyped-def]
    r = np.rint(phase * _SCALE)
    return ((phase - r * _FIRST) - r * _SECOND) * _SCALE


@overload(whole_turns_off, inline="always")
def _whole_turns_off(phase, like):  # type: ignore[no-untyped-def]
    return _single if like.dtype == numba.float32 else _double


def reference_phase_at(table: Any, u: Any, j: Any, like: Any) -> Any:
    """Carrier of column j at row position u of a block; compiled loops choose while
    compiled.
    """
    return (_short if like.dtype == np.float32 else _long)(table, u, j, like)  # type: ignore[no-untyped-call]


def _short(table, u, j, like):  # type: ignore[no-untyped-def]
    return table[0, j] + u * (
        table[1, j] + u * (table[2, j] + u * (table[3, j] + u * table[4, j]))
    )


def _long(table, u, j, like):  # type: ignore[no-untyped-def]
    t = table[4, j] + u * (
        table[5, j] + u * (table[6, j] + u * (table[7, j] + u * table[8, j]))
    )
    return table[0, j] + u * (
        table[1, j] + u * (table[2, j] + u * (table[3, j] + u * t))
    )


@overload(reference_phase_at, inline="always")
def _carried(table, u, j, like):  # type: ignore[no-untyped-def]
    return _short if like.dtype == numba.float32 else _long


@numba.njit(fastmath=EXACT, nogil=True, error_model="numpy", cache=True)
def _phasors(phase, table, u, re, im):  # type: ignore[no-untyped-def]
    """Cosine and sine of phase plus carrier along a row."""
    for j in range(phase.size):
        t = whole_turns_off(phase[j], re) + reference_phase_at(table, u, j, re)
        re[j], im[j] = sincos_turns(t - np.rint(t), re)


@numba.njit(fastmath=EXACT, nogil=True, error_model="numpy", cache=True)
def _light(phase, level, table, u, re, im):  # type: ignore[no-untyped-def]
    """Transmission times the phasors along a row."""
    for j in range(phase.size):
        t = whole_turns_off(phase[j], re) + reference_phase_at(table, u, j, re)
        c, s = sincos_turns(t - np.rint(t), re)
        re[j], im[j] = level[j] * c, level[j] * s


@numba.njit(
    fastmath={"reassoc", "contract", "nsz"}, nogil=True, error_model="numpy", cache=True
)
def _power(level, first, last, start, stop):  # type: ignore[no-untyped-def]
    """(sum of squares, sum of magnitudes) of a tile, kept open to NaN."""
    total, size = 0.0, 0.0
    for i in range(first, last):
        row = level[i, start:stop]
        squares, magnitudes = row.dtype.type(0), row.dtype.type(0)
        for j in range(row.size):
            squares += row[j] * row[j]
            magnitudes += abs(row[j])
        total += squares
        size += magnitudes
    return total, size


@numba.njit(
    fastmath={"reassoc", "contract", "nsz"}, nogil=True, error_model="numpy", cache=True
)
def _taint(phase, first, last, start, stop):  # type: ignore[no-untyped-def]
    """0, or NaN where a phase of a tile is not finite."""
    total = phase.dtype.type(0)
    for i in range(first, last):
        row = phase[i, start:stop]
        for j in range(row.size):
            total += row[j] * row.dtype.type(0)
    return total


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _add_rows(rows, shares, first, sums):  # type: ignore[no-untyped-def]
    """Add four rows (row, re/im, column) to the row nodes: sums (node, re/im, column)."""
    for a in range(sums.shape[0]):
        s0, s1, s2, s3 = (
            shares[a, first],
            shares[a, first + 1],
            shares[a, first + 2],
            shares[a, first + 3],
        )
        for k in range(2):
            for j in range(sums.shape[2]):
                sums[a, k, j] += (
                    s0 * rows[0, k, j]
                    + s1 * rows[1, k, j]
                    + s2 * rows[2, k, j]
                    + s3 * rows[3, k, j]
                )


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _add_columns(sums, span, shares, bases, out):  # type: ignore[no-untyped-def]
    """Add the columns span[0] to span[1] of a tile to the column nodes: out (node,
    re/im, column node).
    """
    nodes, length = shares.shape
    for block in range(span[0] // length, (span[1] - 1) // length + 1):
        low, high = max(block * length, span[0]), min((block + 1) * length, span[1])
        for a in range(sums.shape[0]):
            for k in range(2):
                values = sums[a, k, low - span[0] : high - span[0]]
                for b in range(nodes):
                    share = shares[b, low - bases[block] : high - bases[block]]
                    total = sums.dtype.type(0)
                    for j in range(values.size):
                        total += values[j] * share[j]
                    out[a, k, block * nodes + b] += total


@numba.njit(nogil=True, error_model="numpy", cache=True)
def grid_pillars(phase, level, table, u, shares, bases, first, out):  # type: ignore[no-untyped-def]
    """Light of some block rows at their nodes, added to ``out`` (block row · node,
    re/im, column node).

    phase, level: (y, x). table: (block row, chunk, order, column) of those block rows,
    the first being ``first``.
    u: (length,) row positions. shares, bases: a pair each, for rows and columns.

    Returns the sum of squares of the transmission, NaN where a phase of a closed tile
    is not finite.
    """
    (ny, nx), (nodes, length), chunk = phase.shape, shares[0].shape, table.shape[3]
    rows = np.zeros((4, 2, chunk), out.dtype)
    sums = np.empty((nodes, 2, chunk), out.dtype)
    padded = np.zeros((nodes, length + 4), out.dtype)
    padded[:, :length] = shares[0]
    power = 0.0
    for block in range(table.shape[0]):
        start, stop = (first + block) * length, min((first + block + 1) * length, ny)
        base = bases[0][first + block]
        for c in range(table.shape[1]):
            x0, x1 = c * chunk, min((c + 1) * chunk, nx)
            light, size = _power(level, start, stop, x0, x1)
            power += light
            if size == 0:
                power += _taint(phase, start, stop, x0, x1)
                continue
            sums[:] = 0
            for i in range(start, stop, 4):
                for q in range(4):
                    if i + q < stop:
                        p, t = phase[i + q, x0:x1], level[i + q, x0:x1]
                        _light(
                            p,
                            t,
                            table[block, c],
                            u[i + q - base],
                            rows[q, 0],
                            rows[q, 1],
                        )
                    else:
                        rows[q] = 0
                _add_rows(rows, padded, i - base, sums)
            _add_columns(
                sums,
                (x0, x1),
                shares[1],
                bases[1],
                out[block * nodes : (block + 1) * nodes],
            )
    return power


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _spread_columns(grad, span, shares, bases, sums):  # type: ignore[no-untyped-def]
    """Adjoint of :func:`_add_columns`: column nodes to the columns of a tile."""
    nodes, length = shares.shape
    for block in range(span[0] // length, (span[1] - 1) // length + 1):
        low, high = max(block * length, span[0]), min((block + 1) * length, span[1])
        for a in range(grad.shape[0]):
            for k in range(2):
                values = sums[a, k, low - span[0] : high - span[0]]
                values[:] = 0
                for b in range(nodes):
                    share = shares[b, low - bases[block] : high - bases[block]]
                    for j in range(values.size):
                        values[j] += grad[a, k, block * nodes + b] * share[j]


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _spread_row(sums, shares, i, row):  # type: ignore[no-untyped-def]
    """Adjoint of :func:`_add_rows` for one row: row (re/im, column); nodes are taken
    four at a time.
    """
    row[:] = 0
    for a in range(0, sums.shape[0], 4):
        s0, s1, s2, s3 = (
            shares[a, i],
            shares[a + 1, i],
            shares[a + 2, i],
            shares[a + 3, i],
        )
        for k in range(2):
            for j in range(sums.shape[2]):
                row[k, j] += (
                    s0 * sums[a, k, j]
                    + s1 * sums[a + 1, k, j]
                    + s2 * sums[a + 2, k, j]
                    + s3 * sums[a + 3, k, j]
                )


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _turned(row, re, im, level, out):  # type: ignore[no-untyped-def]
    """Gradient in phase."""
    for j in range(out.size):
        out[j] = level[j] * (row[1, j] * re[j] - row[0, j] * im[j])


@numba.njit(fastmath=True, nogil=True, error_model="numpy", cache=True)
def _scaled(row, re, im, out):  # type: ignore[no-untyped-def]
    """Gradient in transmission."""
    for j in range(out.size):
        out[j] = row[0, j] * re[j] + row[1, j] * im[j]


@numba.njit(nogil=True, error_model="numpy", cache=True)
def interpolate_to_pillars(  # type: ignore[no-untyped-def]
    phase, level, table, u, shares, bases, first, grad, out_phase, out_level
):
    """Gradients at the nodes, as ``out`` of :func:`grid_pillars`, to those of phase and
    transmission; empty arrays: none.
    """
    (ny, nx), (nodes, length), chunk = phase.shape, shares[0].shape, table.shape[3]
    row = np.empty((2, chunk), grad.dtype)
    re, im = np.empty(chunk, grad.dtype), np.empty(chunk, grad.dtype)
    sums = np.zeros(((nodes + 3) // 4 * 4, 2, chunk), grad.dtype)
    padded = np.zeros((len(sums), length), grad.dtype)
    padded[:nodes] = shares[0]
    for block in range(table.shape[0]):
        start, stop = (first + block) * length, min((first + block + 1) * length, ny)
        base = bases[0][first + block]
        for c in range(table.shape[1]):
            x0, x1 = c * chunk, min((c + 1) * chunk, nx)
            if out_level.size == 0 and _power(level, start, stop, x0, x1)[1] == 0:
                for i in range(start, stop):
                    out_phase[i, x0:x1] = 0
                continue
            _spread_columns(
                grad[block * nodes : (block + 1) * nodes],
                (x0, x1),
                shares[1],
                bases[1],
                sums,
            )
            for i in range(start, stop):
                _spread_row(sums, padded, i - base, row)
                _phasors(phase[i, x0:x1], table[block, c], u[i - base], re, im)
                if out_phase.size:
                    _turned(row, re, im, level[i, x0:x1], out_phase[i, x0:x1])
                if out_level.size:
                    _scaled(row, re, im, out_level[i, x0:x1])
