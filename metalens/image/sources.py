"""Sheets weighted for every kernel of a PSF basis, compiled: what image formation
transforms.
"""

from typing import Any

import numba
import numpy as np

from metalens.core import threads
from metalens.core.arrays import Array


def weigh_sources(
    light: Array,
    cover: Array,
    depth_um: Array,
    table: Array,
    *,
    ends_um: tuple[float, float],
    shape: tuple[int, int],
) -> Array:
    """(rank, n, 2 kinds, 2 sheets, Y, X) light and coverage times the weight of every
    kernel at their depths.

    Args:
        light, cover, depth_um: (n, 2, y, x) float32. What has no coverage has no light.
        table: (rank, codes) weights at equal steps of 1/z from the first to the second
            of ``ends_um``.
        shape: (Y, X); spare rows and columns continue the border, half of them the far
            one.
    """
    out = np.empty((len(table), len(light), 2, 2, *shape), np.float32)
    near, far = (np.float32(1 / end) for end in ends_um)

    def part(start: int, stop: int) -> None:
        _weigh(light, cover, depth_um, table, near, far, start, stop, out)

    threads.run_split(len(light), part)
    return out


@numba.njit(cache=True, fastmath=True, nogil=True)
def _weigh(
    light: Array,
    cover: Array,
    depth: Array,
    table: Array,
    near: Any,
    far: Any,
    start: int,
    stop: int,
    out: Array,
) -> None:
    rows, columns = out.shape[4], out.shape[5]
    height, width = light.shape[2], light.shape[3]
    top = np.float32(table.shape[1] - 1)
    unit = top / max(near - far, np.float32(1e-30))
    code = np.empty(columns, np.int32)
    value, share = np.empty(columns, np.float32), np.empty(columns, np.float32)
    for job in range(2 * start, 2 * stop):
        n, sheet = job // 2, job % 2
        for row in range(rows):
            y = _inside(row, height, rows)
            for column in range(columns):
                x = _inside(column, width, columns)
                vergence = np.float32(1) / max(depth[n, sheet, y, x], np.float32(1))
                code[column] = np.int32(
                    min(
                        max((near - vergence) * unit + np.float32(0.5), np.float32(0)),
                        top,
                    )
                )
                value[column], share[column] = (
                    light[n, sheet, y, x],
                    cover[n, sheet, y, x],
                )
            for k in range(len(table)):
                for column in range(columns):
                    weight = table[k, np.uint32(code[column])]
                    out[k, n, 0, sheet, row, column] = weight * value[column]
                    out[k, n, 1, sheet, row, column] = weight * share[column]


@numba.njit(inline="always")
def _inside(place: int, count: int, padded: int) -> int:
    """The pixel that a place of the padded frame repeats."""
    if place < count:
        return place
    return count - 1 if place < count + (padded - count + 1) // 2 else 0
