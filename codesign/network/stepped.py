"""How steps of brightness are spread over blocks of a frame, compiled: for frames that
carry no derivatives.
"""

import math
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from metalens.ground.arrays import Array
from metalens.ground.threads import split

_LN2 = np.float32(math.log(2))
_THIRD, _FIFTH, _SEVENTH, _NINTH, _11TH, _13TH = (
    np.float32(1 / n) for n in (3, 5, 7, 9, 11, 13)
)
_MANTISSA, _PLACES, _OFFSET = (
    np.int32(0x7FFFFF),
    np.int32(23),
    np.float32(127),
)  # of a number in single precision
_ONE = np.int32(0x3F800000)  # 1.0


def moments(
    samples: list[Tensor],
    reaches: tuple[int, ...],
    taps: Array,
    blocks: int,
    floor: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """(batch, kinds, blocks, blocks) means over every block of l, l² and the fourth
    power of q; l = ln(1 + q / floor).

    q: square of a step. Kinds: those of the first samples, then of the next.

    Args:
        samples: (batch, 1, y, x) frames to take steps of, one a reach, sides multiples
            of ``blocks``.
        reaches: samples from neighbour to neighbour.
        taps: (kinds, 3, 3) weights of the neighbours (y, x) of a step, the middle one
            at (1, 1).

    Accuracy: 2e-7 of l from 1e-6 on.
    """
    count, kinds = len(samples[0]), len(taps)
    out = np.zeros((3, count, kinds * len(reaches), blocks, blocks), np.float32)
    for i, (frames, reach) in enumerate(zip(samples, reaches, strict=True)):
        light, part = (
            frames[:, 0].contiguous().numpy(),
            out[:, :, i * kinds : (i + 1) * kinds],
        )
        split(count, lambda a, b, light=light, reach=reach, part=part: _frames(  # type: ignore[misc]
            light, reach, taps.astype(np.float32), np.float32(1 / floor), a, b, part
        ))  # fmt: skip
    mean, second, steepest = torch.from_numpy(out)
    return mean, second, steepest


@numba.njit(cache=True, nogil=True)
def _frames(
    light: Array, reach: int, taps: Array, scale: Any, start: int, stop: int, out: Array
) -> None:
    rows, columns = light.shape[1:]
    wide = np.empty((rows + 2 * reach, columns + 2 * reach), np.float32)
    step, log = np.empty(columns, np.float32), np.empty(columns, np.float32)
    sums = np.empty((3, columns), np.float32)
    for n in range(start, stop):
        _bordered(light[n], reach, wide)
        for kind in range(taps.shape[0]):
            for block in range(out.shape[3]):
                sums[:] = 0
                for row in range(
                    rows * block // out.shape[3], rows * (block + 1) // out.shape[3]
                ):
                    _step(wide, row, reach, taps[kind], step)
                    _add(step, scale, log, sums)
                _told(sums, rows // out.shape[3], out[:, n, kind, block])


@numba.njit(cache=True, nogil=True)
def _bordered(light: Array, reach: int, wide: Array) -> None:
    """Samples that go on beyond their edges."""
    rows, columns = light.shape
    for row in range(wide.shape[0]):
        y = min(max(row - reach, 0), rows - 1)
        for column in range(wide.shape[1]):
            wide[row, column] = light[y, min(max(column - reach, 0), columns - 1)]


@numba.njit(cache=True, nogil=True)
def _step(wide: Array, row: int, reach: int, taps: Array, step: Array) -> None:
    """Steps of one row."""
    step[:] = 0
    for y in range(3):
        for x in range(3):
            weight = taps[y, x]
            if weight != 0:
                line = wide[
                    row + reach * y, reach * x :
                ]  # of its own, so that no place could be one from its end
                for k in range(len(step)):
                    step[k] += weight * line[k]


@numba.njit(cache=True, nogil=True, error_model="numpy")  # no look at every divisor
def _add(step: Array, scale: Any, log: Array, sums: Array) -> None:
    """sums += l, l², q⁴ of a row's steps.

    ln(2^e m) = e ln 2 + 2 artanh((m - 1) / (m + 1)), by its series to 1e-8 for m from 1
    to 2.
    """
    bits, one = log.view(np.int32), np.float32(1)
    first, second, third = sums[0], sums[1], sums[2]
    for k in range(len(step)):
        square = step[k] * step[k]
        log[k] = square * scale + one
        fourth = square * square
        third[k] += fourth * fourth
        step[k] = square * np.float32(0)  # what is no number has a mantissa that is one
    for k in range(len(step)):
        step[k] += (np.float32(np.int32(bits[k] >> _PLACES)) - _OFFSET) * _LN2
        bits[k] = np.int32((bits[k] & _MANTISSA) | _ONE)
    for k in range(len(step)):
        f = (log[k] - one) / (log[k] + one)
        g = f * f
        series = one + g * (
            _THIRD
            + g * (_FIFTH + g * (_SEVENTH + g * (_NINTH + g * (_11TH + g * _13TH))))
        )
        value = step[k] + np.float32(2) * f * series
        first[k] += value
        second[k] += value * value


@numba.njit(cache=True, nogil=True)
def _told(sums: Array, rows: int, out: Array) -> None:
    """(3, blocks) means of a line of blocks."""
    wide = sums.shape[1] // out.shape[1]
    for part in range(3):
        for block in range(out.shape[1]):
            total = np.float32(0)
            for k in range(block * wide, (block + 1) * wide):
                total += sums[part, k]
            out[part, block] = total / np.float32(rows * wide)
