"""Compiled loops: sources of one patch weighted for every kernel (``forming.at_depth`` times the frames in one pass),
and the light on the nodes of a pupil."""

import numba
import numpy as np

from metalens.ground.arrays import Array
from metalens.ground.threads import split
from metalens.propagate import turns32


def weighted(
    frames: tuple[Array, Array, Array], tables: tuple[Array, Array], shape: tuple[int, int], few: int
) -> tuple[Array, Array]:
    """(rank, frames, sheets, Y, X) light and (few, frames, sheets, Y, X) coverage, float32, zero beyond the patch.

    Args:
        frames: (frames, sheets, y, x) radiance, coverage, and depth in units of the depth nodes, float32.
        tables: (y * x, depths, rank) weights and (y * x, depths) illumination, float32.
    """
    count, sheets = frames[0].shape[:2]
    light = np.zeros((tables[0].shape[2], count, sheets, *shape), np.float32)
    cover = np.zeros((few, count, sheets, *shape), np.float32)
    _weigh(*frames, *tables, light, cover)
    return light, cover


@numba.njit(cache=True, fastmath=True, nogil=True)
def _weigh(radiance, coverage, place, table, energy, light, cover):  # type: ignore[no-untyped-def]
    """The 4-point interpolation of ``patches.lagrange`` between the depths, row by row."""
    count, sheets, high, wide = radiance.shape
    depths, rank = table.shape[1:]
    few = cover.shape[0]
    n = min(4, depths)
    taps = np.empty(n, np.float32)
    lines = np.empty((wide, rank), np.float32)
    bright = np.empty(wide, np.float32)
    for f in range(count):
        for s in range(sheets):
            for y in range(high):
                for x in range(wide):
                    bright[x] = 0
                    if coverage[f, s, y, x] == 0 and radiance[f, s, y, x] == 0:
                        lines[x] = 0
                        continue
                    p = place[f, s, y, x]
                    first = min(max(int(p) - (n // 2 - 1), 0), depths - n)
                    for i in range(n):
                        w = np.float32(1)
                        for j in range(n):
                            if j != i:
                                w *= (p - first - j) / (i - j)
                        taps[i] = w
                    pixel, level = y * wide + x, np.float32(0)
                    for r in range(rank):
                        lines[x, r] = taps[0] * table[pixel, first, r]
                    for i in range(n):
                        level += taps[i] * energy[pixel, first + i]
                        if i > 0:
                            for r in range(rank):
                                lines[x, r] += taps[i] * table[pixel, first + i, r]
                    bright[x] = level * radiance[f, s, y, x]
                for r in range(rank):
                    for x in range(wide):
                        light[r, f, s, y, x] = lines[x, r] * bright[x]
                for r in range(few):
                    for x in range(wide):
                        cover[r, f, s, y, x] = lines[x, r] * coverage[f, s, y, x]


def phasors(weight: Array, turns: Array, paths: Array, mix: Array) -> Array:
    """(depths, y, x) complex64 weight exp(2πi (turns + Σ mix paths)).

    Args:
        weight, turns: (y, x) float64. paths: (few, y, x) float64 in turns; mix: (depths, few).
    """
    out = np.empty((len(mix), *turns.shape, 2), np.float32)
    light = weight.astype(np.float32)
    split(turns.shape[0], lambda a, b: _phasors(light[a:b], turns[a:b], paths[:, a:b], mix, out[:, a:b]))
    return out.view(np.complex64)[..., 0]


@numba.njit(cache=True, fastmath=True, nogil=True)
def _phasors(weight, turns, paths, mix, out):  # type: ignore[no-untyped-def]
    """Row by row, so that the sum of a depth stays in the nearest cache."""
    depths, few = mix.shape
    line = np.empty(turns.shape[1])
    for y in range(turns.shape[0]):
        for d in range(depths):
            line[:] = turns[y]
            for v in range(few):
                share = mix[d, v]
                for x in range(line.size):
                    line[x] += share * paths[v, y, x]
            for x in range(line.size):
                c, s = turns32(line[x] - np.rint(line[x]))
                out[d, y, x, 0], out[d, y, x, 1] = weight[y, x] * c, weight[y, x] * s
