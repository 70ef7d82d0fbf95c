"""Batch normalisation and the activation behind it as one step, compiled: what a
training on a processor affords.

    y = act(a x + b),   a = w / sqrt(v + e),   b = bias - a m          m, v: mean and variance of a channel in the batch
    dx = a (g - mean(g) - (x - m) mean(g (x - m)) / (v + e))           g = dy act'(a x + b)     (Ioffe and Szegedy 2015)

Both ways take the frames twice, and keep x alone. One after the other the steps of
PyTorch take them four to six times,
and two threads add up their sums into the same lines of the cache. Values and slopes
are PyTorch's to rounding.
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from codesign.network.architecture import Activation
from metalens.ground.arrays import Array
from metalens.ground.threads import split

EPSILON = 1e-5
_KINDS: tuple[Activation | None, ...] = (None, "relu", "hardswish")
_PARTS = 16  # that are summed apart, whatever the number of threads: the same bytes
_WIDE = 256  # values that are worked on together: several places of few channels
_LEAST = (
    1 << 19
)  # values from which on this is faster: fewer lie in the cache until the next step takes them
_RUN = 64  # rows that are added up in single precision


def activated(x: Tensor, kind: Activation | None) -> Tensor:
    """The activation alone."""
    return x if kind is None else F.relu(x) if kind == "relu" else F.hardswish(x)


def batch_norm(
    x: Tensor, weight: Tensor, bias: Tensor, kind: Activation | None
) -> Tensor:
    """act(normalised x) over batch, rows and columns of (batch, channels, y, x);
    differentiable once.

    Compiled for many values in single precision on a processor, else PyTorch's own
    steps.

    Raises:
        ValueError: a channel has one value alone (PyTorch's).
    """
    if x.device.type == "cpu" and x.dtype == torch.float32 and x.numel() >= _LEAST:
        made: Tensor = _Normed.apply(x, weight, bias, kind)  # type: ignore[no-untyped-call]
        return made
    return activated(
        F.batch_norm(x, None, None, weight, bias, training=True, eps=EPSILON), kind
    )


class _Normed(torch.autograd.Function):
    """:func:`batch_norm` with its derivative."""

    @staticmethod
    def forward(
        context: Any, x: Tensor, weight: Tensor, bias: Tensor, kind: Activation | None
    ) -> Tensor:
        x, count = _last(x), x.numel() // x.shape[1]
        rows = _rows(x)
        first = rows[0].reshape(-1, x.shape[1])[0].copy()
        middle = _wide(first, rows)
        one, two = _summed(
            rows, x.shape[1], lambda a, b, out: _moments(rows, middle, a, b, out)
        )
        shift = one / count
        mean, variance = first + shift, np.maximum(two / count - shift**2, 0.0)
        inverse = 1 / np.sqrt(variance + EPSILON)
        gain = inverse * weight.detach().numpy()
        turn = np.stack([gain, bias.detach().numpy() - gain * mean]).astype(np.float32)
        out, act = torch.empty_like(x), _KINDS.index(kind)
        made, (a, b) = _rows(out), (_wide(part, rows) for part in turn)
        split(
            len(rows),
            lambda low, high: _turned(rows[low:high], a, b, act, made[low:high]),
        )
        context.save_for_backward(x)
        context.about = mean, inverse, gain, turn, act
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        context: Any, *gradients: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, None]:
        (x,) = context.saved_tensors
        mean, inverse, gain, turn, act = context.about
        rows, slope, count = (
            _rows(x),
            _rows(_last(gradients[0])),
            x.numel() // x.shape[1],
        )
        a, b, middle = (_wide(part, rows) for part in (*turn, mean))
        one, two = _summed(
            rows,
            x.shape[1],
            lambda low, high, out: _slopes(
                rows, slope, a, b, middle, act, low, high, out
            ),
        )
        along = -gain * inverse**2 * two / count
        scale, level = (
            _wide(gain, rows),
            _wide(-gain * one / count - along * mean, rows),
        )
        tilt, out = _wide(along, rows), torch.empty_like(x)
        made = _rows(out)
        split(
            len(rows),
            lambda low, high: _back(
                rows[low:high],
                slope[low:high],
                a,
                b,
                act,
                scale,
                tilt,
                level,
                made[low:high],
            ),
        )
        to_weight, to_bias = (
            torch.from_numpy(part.astype(np.float32)) for part in (inverse * two, one)
        )
        return out, to_weight, to_bias, None


def _last(x: Tensor) -> Tensor:
    return x.detach().contiguous(memory_format=torch.channels_last)


def _rows(x: Tensor) -> Array:
    """(rows, places channels) of channels that lie side by side, so many places in a
    row that it is worth a loop.
    """
    channels, places = x.shape[1], 1
    count = x.numel() // channels
    while 2 * places * channels <= _WIDE and count % (2 * places) == 0:
        places *= 2
    rows: Array = x.permute(0, 2, 3, 1).numpy().reshape(-1, places * channels)
    return rows


def _wide(values: Array, rows: Array) -> Array:
    """A number a channel, again for every place of a row, in single precision."""
    return np.tile(np.asarray(values, np.float32), rows.shape[1] // len(values))


def _summed(rows: Array, channels: int, work: Any) -> Array:
    """(2, channels) sums over all rows, which ``work(start, stop, out)`` puts into out
    (parts, 2, width) by part.
    """
    out = np.zeros((_PARTS, 2, rows.shape[1]))
    split(_PARTS, lambda start, stop: work(start, stop, out))
    whole: Array = out.sum(0).reshape(2, -1, channels).sum(1)
    return whole


@numba.njit(cache=True, nogil=True)
def _moments(rows: Array, first: Array, start: int, stop: int, out: Array) -> None:
    """out (parts, 2, width) += sums of x - first and of its square, of some parts of
    the rows.
    """
    count, width = rows.shape
    one, two = np.empty(width, np.float32), np.empty(width, np.float32)
    for part in range(start, stop):
        end = count * (part + 1) // _PARTS
        for low in range(count * part // _PARTS, end, _RUN):
            one[:], two[:] = 0, 0
            for row in range(low, min(low + _RUN, end)):
                for k in range(width):
                    off = rows[row, k] - first[k]
                    one[k] += off
                    two[k] += off * off
            for k in range(width):
                out[part, 0, k] += one[k]
                out[part, 1, k] += two[k]


@numba.njit(cache=True, nogil=True)
def _turned(rows: Array, a: Array, b: Array, act: int, out: Array) -> None:
    """act(a x + b)."""
    for row in range(rows.shape[0]):
        if act == 0:
            for k in range(rows.shape[1]):
                out[row, k] = a[k] * rows[row, k] + b[k]
        elif act == 1:
            for k in range(rows.shape[1]):
                at = a[k] * rows[row, k] + b[k]
                out[row, k] = (
                    np.float32(0) if at <= 0 else at
                )  # what is no number stays none
        else:
            for k in range(rows.shape[1]):
                at = a[k] * rows[row, k] + b[k]
                out[row, k] = (
                    at
                    * min(max(at + np.float32(3), np.float32(0)), np.float32(6))
                    * np.float32(1 / 6)
                )


@numba.njit(inline="always")
def _passed(slope: Any, at: Any, act: int) -> Any:
    """dy act'(at)."""
    if act == 0:
        return slope
    if act == 1:
        return np.float32(0) if at <= 0 else slope
    inner = slope * (at * np.float32(1 / 3) + np.float32(0.5))
    return np.float32(0) if at <= -3 else (slope if at >= 3 else inner)


@numba.njit(cache=True, nogil=True)
def _slopes(
    rows: Array,
    slope: Array,
    a: Array,
    b: Array,
    mean: Array,
    act: int,
    start: int,
    stop: int,
    out: Array,
) -> None:
    """out (parts, 2, width) += sums of g and of g (x - m), of some parts of the rows."""
    count, width = rows.shape
    one, two = np.empty(width, np.float32), np.empty(width, np.float32)
    for part in range(start, stop):
        end = count * (part + 1) // _PARTS
        for low in range(count * part // _PARTS, end, _RUN):
            one[:], two[:] = 0, 0
            for row in range(low, min(low + _RUN, end)):
                for k in range(width):
                    g = _passed(slope[row, k], a[k] * rows[row, k] + b[k], act)
                    one[k] += g
                    two[k] += g * (rows[row, k] - mean[k])
            for k in range(width):
                out[part, 0, k] += one[k]
                out[part, 1, k] += two[k]


@numba.njit(cache=True, nogil=True)
def _back(
    rows: Array,
    slope: Array,
    a: Array,
    b: Array,
    act: int,
    gain: Array,
    along: Array,
    level: Array,
    out: Array,
) -> None:
    """gain g + along x + level."""
    for row in range(rows.shape[0]):
        for k in range(rows.shape[1]):
            g = _passed(slope[row, k], a[k] * rows[row, k] + b[k], act)
            out[row, k] = gain[k] * g + along[k] * rows[row, k] + level[k]
