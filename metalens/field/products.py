"""Frames through the patches of a field by compiled loops and matrix products: what ``forming`` does by FFT, quicker.

A patch is less than half as wide as its transform, which therefore is two products with cosines and sines that never
touch the zeros beside it. As many kernels are taken at once as a processor's cache holds, and sheets that hold nothing
in a patch are left out. Frames and patches are grouped the same way on any number of threads: so are the sums. What the
loop calls is put into it (``forceinline``), or it would round otherwise where it comes from numba's cache.
"""

import functools
import itertools
from typing import NamedTuple

import numba
import numpy as np

from metalens.field.compiled import weigh
from metalens.field.patches import Patch
from metalens.ground.arrays import Array
from metalens.ground.threads import one_blas_thread, split

TOGETHER = 2  # frames that share a reading of the tables
SETS = 2  # of patches, summed apart
LANES = 20  # frequencies of a block: 37 are those of most transforms
HELD = 48  # weighted sheets that are transformed at once: 1 MB of them
NOTHING = 1e-7  # of the most light or coverage: below the rounding of the rest


class Bases(NamedTuple):
    """Of an axis of n samples and its transform at N points, F = N // 2 + 1 frequencies of angles θ; float32.

    along: (n, 2 G) by blocks of ``LANES`` frequencies: cos θ, then -sin θ; zero beyond F. across: (2 F, n) cos, sin.
    back_along: (2 G, N) and back_across: (N, 2 F), of the inverse.
    """

    along: Array
    across: Array
    back_along: Array
    back_across: Array


@functools.lru_cache(maxsize=64)
def bases(count: int, size: int) -> Bases:
    """See :class:`Bases`."""
    frequency = np.arange(size // 2 + 1)
    angle = 2 * np.pi / size * (np.arange(size)[:, None] * frequency % size)
    cos, sin = np.cos(angle), np.sin(angle)
    alone = (frequency == 0) | (2 * frequency == size)  # without a partner of the opposite sign
    twice = np.where(alone, 1, 2) / size
    made = (
        _in_blocks(cos[:count], -sin[:count]),
        np.concatenate([cos, sin], 1)[:count].T,
        _in_blocks(cos * twice, -sin * twice).T,
        np.tile(np.where(alone, 0.5, 1), 2) / size * np.concatenate([cos, sin], 1),
    )
    return Bases(*(np.ascontiguousarray(part, np.float32) for part in made))


def _in_blocks(real: Array, imaginary: Array) -> Array:
    """(n, 2 G) of two (n, F): blocks of the one and of the other in turn."""
    spare = [(0, 0), (0, -real.shape[1] % LANES)]
    blocks = [np.pad(part, spare).reshape(len(part), -1, LANES) for part in (real, imaginary)]
    return np.stack(blocks, 2).reshape(len(real), -1)


def through(
    frames: tuple[Array, Array, Array],
    patches: list[Patch],
    transfer: list[Array],
    sizes: list[tuple[int, int]],
    out: Array,
) -> None:
    """Add the light (and coverage, where ``out`` has two kinds) of frames through every patch.

    Args:
        frames: (frames, sheets, y, x) radiance, coverage, and depth in units of the depth nodes, float32.
        transfer: of each patch, (rank, Y, X // 2 + 1) complex64, with its (Y, X) in ``sizes``.
        out: (frames, kinds, sheets, y, x) float32; half a window larger at each side than the frames.
    """
    sets = [out, *(np.zeros_like(out) for _ in range(SETS - 1))]
    tasks = list(itertools.product(range(0, len(out), TOGETHER), range(SETS)))
    least = tuple(NOTHING * _largest(part) for part in frames[:2])
    jobs = list(zip(patches, transfer, sizes, strict=True))

    def work(start: int, stop: int) -> None:
        room = _room(sizes)
        for first, which in tasks[start:stop]:
            few = slice(first, first + TOGETHER)
            for patch, kernels, size in jobs[which::SETS]:
                _add([part[few] for part in frames], patch, (kernels, size), least, room, sets[which][few])

    with one_blas_thread():
        split(len(tasks), work)
    for other in sets[1:]:
        out += other


def _largest(content: Array) -> float:
    return max(float(content.max(initial=0)), -float(content.min(initial=0)))


def _room(sizes: list[tuple[int, int]]) -> tuple[Array, ...]:
    """Flat arrays for the largest patch: sources, half and whole transforms, kernels, sums, the way back."""
    y, x = (max(size[axis] for size in sizes) + 2 * LANES + 2 for axis in (0, 1))
    counts = HELD, HELD, HELD, 2 * HELD, 2 * TOGETHER, 1, 1
    return tuple(np.empty(count * y * x, np.float32) for count in counts)


def _add(
    frames: list[Array],
    patch: Patch,
    given: tuple[Array, tuple[int, int]],
    least: tuple[float, ...],
    room: tuple[Array, ...],
    out: Array,
) -> None:
    """One patch of a few frames."""
    (top, below), (left, right) = patch.rows, patch.columns
    kernels, size = given
    tables = patch.weights.numpy(), patch.energy.numpy()
    axes = bases(below - top, size[0]), bases(right - left, size[1])
    for kind, content in enumerate(frames[: out.shape[1]]):
        window = patch.rows, patch.columns
        held = _held(content, window, least[kind])
        if len(held):
            some = kernels[: patch.coverage] if kind else kernels
            _convolved(content, frames[2], held, tables, kind, some, axes, room, out, window)


@numba.njit(cache=True, nogil=True)
def _held(content, window, least):  # type: ignore[no-untyped-def]
    """(held, [frame, sheet]) of the sheets that have more than ``least`` anywhere in a window."""
    (top, below), (left, right) = window
    found, count = np.empty((content.shape[0] * content.shape[1], 2), np.int64), 0
    for frame in range(content.shape[0]):
        for sheet in range(content.shape[1]):
            if _any_above(content[frame, sheet, top:below, left:right], least):
                found[count] = frame, sheet
                count += 1
    return found[:count]


@numba.njit(cache=True, nogil=True)
def _any_above(content, least):  # type: ignore[no-untyped-def]
    for row in content:
        for value in row:
            if abs(value) > least:
                return True
    return False


@numba.njit(cache=True, fastmath=True, nogil=True)
def _convolved(content, place, held, tables, kind, kernels, axes, room, out, window):  # type: ignore[no-untyped-def]
    """Add what the sheets ``held`` (frame, sheet) give: weighted, transformed, mixed, led back.

    Whole frames and the window of the patch in them: parts of arrays and whole ones would be compiled one by one.
    """
    (top, below), (left, right) = window
    high, wide = below - top, right - left
    part, depth = content[:, :, top:below, left:right], place[:, :, top:below, left:right]
    beyond = out.shape[3] - content.shape[2]  # the window of a PSF less one
    y, x = axes
    count, rows, columns = len(held), y.across.shape[0], x.along.shape[1]
    mixed = room[4][: count * rows * columns].reshape(count, rows, columns)
    mixed[:] = 0
    step = max(1, HELD // count)
    for first in range(0, len(kernels), step):
        few = min(step, len(kernels) - first)
        source = room[0][: high * few * count * wide].reshape(high, few, count, wide)
        weigh(part, depth, held, tables, kind == 0, first, source)
        half = room[1][: high * few * count * columns].reshape(high * few * count, columns)
        np.dot(source.reshape(high * few * count, wide), x.along, half)
        whole = room[2][: rows * few * count * columns].reshape(rows, few * count * columns)
        np.dot(y.across, half.reshape(high, few * count * columns), whole)
        halves = room[3][: few * rows * columns].reshape(few, rows // 2, 2, columns)
        _halve(kernels[first : first + few], halves)
        _mix(whole.reshape(rows, few, count, columns), halves, mixed)
    back = room[5][: len(y.back_across) * columns].reshape(len(y.back_across), columns)
    image = room[6][: len(y.back_across) * x.back_along.shape[1]].reshape(len(y.back_across), x.back_along.shape[1])
    for job in range(count):
        np.dot(y.back_across, mixed[job], back)
        np.dot(back, x.back_along, image)
        seen = out[held[job, 0], kind, held[job, 1], top : below + beyond, left : right + beyond]
        for row in range(high + beyond):
            for column in range(wide + beyond):
                seen[row, column] += image[row, column]


@numba.njit(cache=True, fastmath=True, nogil=True, forceinline=True)
def _halve(kernels, out):  # type: ignore[no-untyped-def]
    """Of spectra T (kernels, Y, X // 2 + 1): (kernels, F, [E, D], 2 G) of E = T(f) + T(-f) and D = i (T(f) - T(-f))."""
    out[:] = 0
    for k in range(out.shape[0]):
        for f in range(out.shape[1]):
            for g in range(kernels.shape[2]):
                plus, minus = kernels[k, f, g], kernels[k, -f, g]
                real = g + g // LANES * LANES
                imaginary = real + LANES
                out[k, f, 0, real], out[k, f, 0, imaginary] = plus.real + minus.real, plus.imag + minus.imag
                out[k, f, 1, real], out[k, f, 1, imaginary] = minus.imag - plus.imag, plus.real - minus.real


@numba.njit(cache=True, fastmath=True, nogil=True, forceinline=True)
def _mix(whole, halves, mixed):  # type: ignore[no-untyped-def]
    """Add sheets times kernels: what multiplies the cosines along y is C E - S D, and the sines C D + S E.

    From (C - iS) T(f) exp(iθ) + (C + iS) T(-f) exp(-iθ), the transform at f and -f led back.

    whole: (2 F, kernels, sheets, 2 G) products with the cosines along y, C, then with the sines, S.
    halves: see :func:`_halve`. mixed: (sheets, 2 F, 2 G). The last axis of all is in blocks, as of :class:`Bases`.
    """
    part = np.empty((4, LANES), np.float32)
    frequencies = halves.shape[1]
    for f in range(frequencies):
        for job in range(len(mixed)):
            for start in range(0, mixed.shape[2], 2 * LANES):
                block = slice(start, start + 2 * LANES)
                part[:] = 0
                for k in range(len(halves)):
                    c, s = whole[f, k, job, block], whole[frequencies + f, k, job, block]
                    e, d = halves[k, f, 0, block], halves[k, f, 1, block]
                    for g in range(LANES):
                        i = g + LANES
                        part[0, g] += c[g] * e[g] - c[i] * e[i] - s[g] * d[g] + s[i] * d[i]
                        part[1, g] += c[g] * e[i] + c[i] * e[g] - s[g] * d[i] - s[i] * d[g]
                        part[2, g] += c[g] * d[g] - c[i] * d[i] + s[g] * e[g] - s[i] * e[i]
                        part[3, g] += c[g] * d[i] + c[i] * d[g] + s[g] * e[i] + s[i] * e[g]
                even, odd = mixed[job, f, block], mixed[job, frequencies + f, block]
                even[:LANES] += part[0]
                even[LANES:] += part[1]
                odd[:LANES] += part[2]
                odd[LANES:] += part[3]
