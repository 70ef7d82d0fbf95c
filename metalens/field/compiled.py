"""Compiled loops: sheets weighted for the kernels of a patch (``forming.at_depth``
times the frames in one pass), the
light on the nodes of a pupil, and pillars gathered over cells."""

import numba
import numpy as np

from metalens.ground.arrays import Array
from metalens.ground.threads import split
from metalens.image.scene import fixed as fixed
from metalens.image.scene import plain as plain
from metalens.image.scene import values as values
from metalens.lens import answers
from metalens.propagate import turns32

PART, put = (
    answers.PART,
    answers.answers,
)  # compiled loops know names of their own module


@numba.njit(cache=True, fastmath=True, nogil=True, forceinline=True)
def weigh(content, place, held, tables, lit, first, out):  # type: ignore[no-untyped-def]
    """Sheets weighted for kernels: ``patches.lagrange`` between the depths, one depth
    node after the other, so that all
    pixels of a patch are one loop.

    Args:
        content, place: (frames, sheets, y, x) light or coverage, and depth in units of
            the depth nodes, float32.
        held: (few, 2) frame and sheet that are wanted. lit: whether the relative
            illumination weighs too.
        tables: (depths, rank, y * x) weights and (depths, y * x) illumination, float32.
            first: of the kernels.
        out: (y, kernels, few, x).
    """
    high, few, _, wide = out.shape
    weights, energy = tables
    depths = len(energy)
    value, at, start, a, b, c, d, share, level = np.empty((9, high * wide), np.float32)
    total = np.empty((few, high * wide), np.float32)
    for job in range(len(held)):
        f, s = held[job]
        _reached(content[f, s], place[f, s], depths, value, (at, start, a, b, c, d))
        total[:], level[:] = 0, 0
        for z in range(int(start.min()), int(start.max()) + min(4, depths)):
            for x in range(len(share)):
                k = np.float32(z) - start[x]
                near = np.float32(k == 0) * a[x] + np.float32(k == 1) * b[x]
                share[x] = near + np.float32(k == 2) * c[x] + np.float32(k == 3) * d[x]
            if lit:
                table = energy[z]
                for x in range(len(share)):
                    level[x] += share[x] * table[x]
            for r in range(few):
                table, sums = weights[z, first + r], total[r]
                for x in range(len(share)):
                    sums[x] += share[x] * table[x]
        if lit:
            for x in range(len(value)):
                value[x] *= level[x]
        for r in range(few):
            given = total[r]
            for y in range(high):
                row = out[y, r, job]
                for x in range(wide):
                    row[x] = value[y * wide + x] * given[y * wide + x]


@numba.njit(cache=True, fastmath=True, nogil=True, forceinline=True)
def _reached(content, place, depths, value, between):  # type: ignore[no-untyped-def]
    """Content of a sheet; of every pixel the depth, the first node that it reaches, and
    :func:`_taps` from there.
    """
    at, start, a, b, c, d = between
    wide, n = content.shape[1], min(4, depths)
    for y in range(len(content)):
        row, deep = content[y], place[y]
        for x in range(wide):
            value[y * wide + x] = row[x]
            at[y * wide + x] = deep[x] if row[x] != 0 else np.float32(0)
    before, top = np.float32(n // 2 - 1), np.float32(depths - n)
    for x in range(len(at)):
        start[x] = min(max(np.floor(at[x]) - before, np.float32(0)), top)
    if n == 4:  # known when compiled: several pixels at once
        for x in range(len(at)):
            a[x], b[x], c[x], d[x] = _taps(at[x] - start[x], 4)
    else:
        for x in range(len(at)):
            a[x], b[x], c[x], d[x] = _taps(at[x] - start[x], n)


@numba.njit(inline="always")
def _taps(t, n):  # type: ignore[no-untyped-def]
    """Weights of ``patches.lagrange`` at t from the first of n nodes; nodes that are
    not there have 0.
    """
    one, half, none = np.float32(1), np.float32(0.5), np.float32(0)
    u, v, w = t - one, t - np.float32(2), t - np.float32(3)
    if n == 4:
        sixth = np.float32(1 / 6)
        return (
            -u * v * w * sixth,
            t * v * w * half,
            -t * u * w * half,
            t * u * v * sixth,
        )
    if n == 3:
        return u * v * half, -t * v, t * u * half, none
    if n == 2:
        return -u, t, none, none
    return one, none, none, none


def phasors(weight: Array, turns: Array, paths: Array, mix: Array) -> Array:
    """(depths, y, x) complex64 weight exp(2πi (turns + Σ mix paths)).

    Args:
        weight, turns: (y, x) float64. paths: (few, y, x) float64 in turns; mix:
            (depths, few).
    """
    out = np.empty((len(mix), *turns.shape, 2), np.float32)
    light = weight.astype(np.float32)
    split(
        turns.shape[0],
        lambda a, b: _phasors(light[a:b], turns[a:b], paths[:, a:b], mix, out[:, a:b]),
    )
    return out.view(np.complex64)[..., 0]


@numba.njit(cache=True, fastmath=True, nogil=True)
def _phasors(weight, turns, paths, mix, out):  # type: ignore[no-untyped-def]
    """Row by row, so that the sum of a depth stays in the nearest cache; of a row what
    the aperture lets through.
    """
    depths, few = mix.shape
    line = np.empty(turns.shape[1])
    for y in range(turns.shape[0]):
        open_ = np.nonzero(weight[y])[0]
        start, stop = (open_[0], open_[-1] + 1) if len(open_) else (0, 0)
        out[:, y, :start] = 0
        out[:, y, stop:] = 0
        for d in range(depths):
            if few == 5:  # of many depths: one pass
                m0, m1, m2, m3, m4 = (
                    mix[d, 0],
                    mix[d, 1],
                    mix[d, 2],
                    mix[d, 3],
                    mix[d, 4],
                )
                for x in range(start, stop):
                    part = (
                        m0 * paths[0, y, x] + m1 * paths[1, y, x] + m2 * paths[2, y, x]
                    )
                    line[x] = (
                        turns[y, x] + part + m3 * paths[3, y, x] + m4 * paths[4, y, x]
                    )
            else:
                line[start:stop] = turns[y, start:stop]
                for v in range(few):
                    for x in range(start, stop):
                        line[x] += mix[d, v] * paths[v, y, x]
            for x in range(start, stop):
                c, s = turns32(line[x] - np.rint(line[x]))
                out[d, y, x, 0], out[d, y, x, 1] = weight[y, x] * c, weight[y, x] * s


def power(field: Array) -> Array:
    """|U|² of complex64."""
    out = np.empty(field.shape, np.float32)
    _power(np.ascontiguousarray(field).reshape(-1), out.reshape(-1))
    return out


@numba.njit(cache=True, fastmath=True, nogil=True)
def _power(field, out):  # type: ignore[no-untyped-def]
    for i in range(len(out)):
        out[i] = field[i].real * field[i].real + field[i].imag * field[i].imag


def cells(
    diameter_um: Array,
    ideal_rad: Array,
    polynomials: answers.Polynomials,
    block: tuple[int, int, int],
) -> Array:
    """(3, cells y, cells x) float32 means over square cells of |T| cos(φ - ideal), |T| sin(φ - ideal), and of pillars.

    Args:
        ideal_rad: (y, x) float32. polynomials: of the diameters, by
            :func:`metalens.lens.answers.polynomials`.
        block: pillars along a cell, and rows and columns of the first one that lie
            before the map.
    """
    side, *before = block
    shape = [
        -(-(n + b) // side) for n, b in zip(diameter_um.shape, before, strict=True)
    ]
    out = np.zeros((3, *shape), np.float32)
    split(
        shape[0],
        lambda a, b: _cells(diameter_um, ideal_rad, polynomials, block, out[:, a:b], a),
    )
    return out


@numba.njit(cache=True, fastmath=answers.FASTMATH, nogil=True, error_model="numpy")
def _cells(d, ideal, polynomials, block, out, first):  # type: ignore[no-untyped-def]
    """Some rows of cells; sums of a row of them are held in float64."""
    side, top, left = block
    x, phase, level = np.empty(PART), np.empty(PART), np.empty(PART)
    for row in range(out.shape[1]):
        sums = np.zeros((3, out.shape[2]))
        for i in range(
            max((first + row) * side - top, 0),
            min((first + row + 1) * side - top, d.shape[0]),
        ):
            for start in range(0, d.shape[1], PART):
                some = d[i, start : start + PART]
                n = some.size
                put(some, polynomials, x[:n], phase[:n], level[:n])
                for j in range(n):
                    t = (phase[j] - ideal[i, start + j]) / (2 * np.pi)
                    c, s = turns32(t - np.rint(t))
                    x[j], phase[j] = level[j] * c, level[j] * s
                for j in range(n):
                    if some[j] > 0:
                        cell = (start + j + left) // side
                        sums[0, cell] += x[j]
                        sums[1, cell] += phase[j]
                        sums[2, cell] += 1
        out[:, row] = sums / (side * side)
