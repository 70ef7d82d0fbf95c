"""Frames through the patches of a field by compiled loops and matrix products: what
``forming`` does by FFT, quicker.

A patch is less than half as wide as its transform, which therefore is products with
cosines and sines that never touch
the zeros beside it. Samples are counted from the middle of what they are of, so that
the sum of a sample and its mirror
image meets the cosines and their difference the sines: products of half the size. As
many kernels are taken at once as
a processor's cache holds, and sheets that hold nothing in a patch are left out. Frames
and patches are grouped the same
way on any number of threads: so are the sums. What the loop calls is put into it
(``forceinline``), or it would round
otherwise where it comes from numba's cache.
"""

import functools
import itertools
import operator
from typing import NamedTuple

import numba
import numpy as np

from metalens.field.compiled import weigh
from metalens.field.patches import Patch
from metalens.ground.arrays import Array
from metalens.ground.threads import one_blas_thread, split

# frames whose products are taken at once; a patch's tables are read once for all frames
# of a call
TOGETHER = 4
SETS = 2  # of patches, summed apart
LANES = 16  # what the frequencies along a row are filled up to a multiple of
HELD = 48  # weighted sheets that are transformed at once: 1 MB of them
NOTHING = 1e-7  # of the most light or coverage: below the rounding of the rest


class Bases(NamedTuple):
    """Of an axis of n samples and its transform at N points, F = N // 2 + 1 frequencies
    of angles θ; float32.

    G: F filled up to lanes. m: samples of the patch's image, n and all but one of a
    PSF's. h(n): samples of a half with
    the middle one, (n + 1) // 2. u, v: places of the first halves of samples and image
    from their middles.

    cos, sin: (h(n), G) cos θ u, then -sin, along a row; zero beyond F.
    back_cos, back_sin: (G, h(m)) cos θ v, then -sin, with 1/N, and 2 for frequencies
    that stand for their opposites.
    across_cos, across_sin: (F, h(n)), down a column.
    up_cos, up_sin: (h(m), F), back, with 1/N, and 1/2 for frequencies that are their
    own opposites.
    turn: (F,) complex64 exp(iθ (m - n) / 2), by which a transform moves that is counted
    from the middles.
    """

    cos: Array
    sin: Array
    back_cos: Array
    back_sin: Array
    across_cos: Array
    across_sin: Array
    up_cos: Array
    up_sin: Array
    turn: Array


@functools.lru_cache(maxsize=64)
def bases(count: int, size: int, window: int) -> Bases:
    """See :class:`Bases`; m = count + window - 1 <= size."""
    frequency = np.arange(size // 2 + 1)
    angle = 2 * np.pi / size * frequency
    u, v = (
        angle * ((np.arange((n + 1) // 2) - (n - 1) / 2)[:, None])
        for n in (count, count + window - 1)
    )
    once = np.ones((len(u), 1))
    once[count // 2 :] = (
        0.5  # the middle sample is its own mirror image, and added to itself
    )
    alone = (frequency == 0) | (
        2 * frequency == size
    )  # without a partner of the opposite sign
    twice, half = np.where(alone, 1, 2) / size, np.where(alone, 0.5, 1) / size
    spare = [(0, 0), (0, -len(frequency) % LANES)]
    along = [np.pad(part, spare) for part in (once * np.cos(u), -np.sin(u))]
    back = [np.pad(part * twice, spare).T for part in (np.cos(v), -np.sin(v))]
    across = (once * np.cos(u)).T, np.sin(u).T
    made = *along, *back, *across, np.cos(v) * half, np.sin(v) * half
    turn = np.exp(1j * angle * (window - 1) / 2).astype(np.complex64)
    return Bases(*[*(np.ascontiguousarray(part, np.float32) for part in made), turn])


def through(
    frames: tuple[Array, Array, Array],
    patches: list[Patch],
    transfer: list[Array],
    sizes: list[tuple[int, int]],
    out: Array,
) -> None:
    """Add the light (and coverage, where ``out`` has two kinds) of frames through every
    patch.

    Args:
        frames: (frames, sheets, y, x) radiance, coverage, and depth in units of the
            depth nodes, float32.
        transfer: of each patch, (rank, Y, X // 2 + 1) complex64, with its (Y, X) in
            ``sizes``.
        out: (frames, kinds, sheets, y, x) float32; half a window larger at each side
            than the frames.
    """
    sets = [out, *(np.zeros_like(out) for _ in range(SETS - 1))]
    tasks = list(itertools.product(range(SETS), range(0, len(out), TOGETHER)))
    least = tuple(NOTHING * _largest(part) for part in frames[: out.shape[1]])
    jobs = list(zip(patches, transfer, sizes, strict=True))

    def work(start: int, stop: int) -> None:
        room = _room(sizes)
        for which, mine in itertools.groupby(
            tasks[start:stop], key=operator.itemgetter(0)
        ):
            first = [task[1] for task in mine]
            few = slice(first[0], first[-1] + TOGETHER)
            given = [part[few] for part in frames]
            for patch, kernels, size in jobs[which::SETS]:
                _add(given, patch, (kernels, size), least, room, sets[which][few])

    with one_blas_thread():
        split(len(tasks), work)
    for other in sets[1:]:
        out += other


def _largest(content: Array) -> float:
    return max(float(content.max(initial=0)), -float(content.min(initial=0)))


def _room(sizes: list[tuple[int, int]]) -> tuple[Array, ...]:
    """Flat arrays for the largest patch: samples and transforms, what is folded,
    kernels, sums, the way back.
    """
    y, x = (max(size[axis] for size in sizes) + 2 * LANES + 2 for axis in (0, 1))
    counts = HELD, HELD, HELD, 2 * TOGETHER, 2 * TOGETHER, 2 * TOGETHER
    return tuple(np.empty(count * y * x, np.float32) for count in counts)


def _add(
    frames: list[Array],
    patch: Patch,
    given: tuple[Array, tuple[int, int]],
    least: tuple[float, ...],
    room: tuple[Array, ...],
    out: Array,
) -> None:
    """One patch of some frames."""
    (top, below), (left, right) = patch.rows, patch.columns
    kernels, size = given
    weights, energy = patch.weights.numpy().transpose(1, 2, 0), patch.energy.numpy().T
    tables = (
        np.ascontiguousarray(weights),
        np.ascontiguousarray(energy),
    )  # as they lie: see patches.depths_first
    window = out.shape[-1] - frames[0].shape[-1] + 1
    axes = bases(below - top, size[0], window), bases(right - left, size[1], window)
    for kind, content in enumerate(frames[: out.shape[1]]):
        held = _held(content, (patch.rows, patch.columns), least[kind])
        if len(held):
            some = kernels[: patch.coverage] if kind else kernels
            _convolved(
                content,
                frames[2],
                held,
                tables,
                kind,
                some,
                axes,
                room,
                out,
                (patch.rows, patch.columns),
            )


@numba.njit(cache=True, nogil=True)
def _held(content, window, least):  # type: ignore[no-untyped-def]
    """(held, [frame, sheet]) of the sheets that have more than ``least`` anywhere in a
    window.
    """
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
    """Add what the sheets ``held`` (frame, sheet) give, those of TOGETHER frames at
    once: weighted, transformed, mixed,
    led back.

    Whole frames and the window of the patch in them: parts of arrays and whole ones
    would be compiled one by one.
    """
    (top, below), (left, right) = window
    beyond = out.shape[3] - content.shape[2]  # the window of a PSF less one
    part, depth = (
        content[:, :, top:below, left:right],
        place[:, :, top:below, left:right],
    )
    seen = out[:, kind, :, top : below + beyond, left : right + beyond]
    begin, ready = 0, 0
    while begin < len(held):
        end, last = begin, held[begin, 0] // TOGETHER
        while end < len(held) and held[end, 0] // TOGETHER == last:
            end += 1
        few = held[begin:end], kind == 0, ready
        ready = _together(part, depth, few, tables, kernels, axes, room, seen)
        begin = end


@numba.njit(cache=True, fastmath=True, nogil=True, forceinline=True)
def _together(part, depth, given, tables, kernels, axes, room, seen):  # type: ignore[no-untyped-def]
    """:func:`_convolved` of a few sheets of a patch. Returns of how many kernels the
    halves are at hand.

    given: the sheets, whether the relative illumination weighs too, kernels whose
    halves are at hand already.
    """
    held, lit, ready = given
    high, wide = part.shape[2:]
    y, x = axes
    count, lanes, frequencies = len(held), x.cos.shape[1], len(y.across_cos)
    mixed = room[3][: 4 * frequencies * count * lanes].reshape(
        2, frequencies, count, 2, lanes
    )
    mixed[:] = 0
    step = max(1, HELD // count)
    for first in range(0, len(kernels), step):
        few = min(step, len(kernels) - first)
        source = room[0][: high * few * count * wide].reshape(high, few, count, wide)
        weigh(part, depth, held, tables, lit, first, source)
        cosines, sines = _transformed(
            source.reshape(high, few * count, wide), axes, room
        )
        halves = room[2][: 4 * few * frequencies * lanes].reshape(
            few, frequencies, 4, lanes
        )
        if first > 0 or few != ready:
            _halve(kernels[first : first + few], y.turn, x.turn, halves)
            ready = few if first == 0 else 0
        shape = frequencies, 2, few, count, lanes
        _mix(cosines.reshape(shape), sines.reshape(shape), halves, mixed)
    image = _led_back(mixed, axes, seen.shape[2:], room)
    for job in range(count):
        _add_folded(image, job, seen[held[job, 0], held[job, 1]])
    return ready


@numba.njit(cache=True, fastmath=True, nogil=True, forceinline=True)
def _transformed(source, axes, room):  # type: ignore[no-untyped-def]
    """Of sources (y, sheets, x): (F, [real, imaginary], sheets G) times cosines along
    y, and times sines.
    """
    high, sheets, wide = source.shape
    y, x = axes
    count, lanes, half = high * sheets, x.cos.shape[1], (wide + 1) // 2
    given, folded = (
        source.reshape(count, wide),
        room[1][: 2 * count * half].reshape(2, count, half),
    )
    last = np.uint64(wide - 1)  # unsigned: no place counts from the end
    for row in range(count):
        seen, even, odd = given[row], folded[0, row], folded[1, row]
        for i in range(half):
            one, other = seen[i], seen[last - np.uint64(i)]
            even[i], odd[i] = one + other, one - other
    parts = room[0][: 2 * count * lanes].reshape(2, count, lanes)
    np.dot(folded[0], x.cos, parts[0])
    np.dot(folded[1], x.sin, parts[1])
    half, rows = (high + 1) // 2, parts.reshape(2, high, sheets * lanes)
    pairs = room[1][: 4 * half * sheets * lanes].reshape(2, half, 2, sheets * lanes)
    for i in range(half):
        for part in range(2):
            for column in range(sheets * lanes):
                one, other = rows[part, i, column], rows[part, high - 1 - i, column]
                pairs[0, i, part, column], pairs[1, i, part, column] = (
                    one + other,
                    one - other,
                )
    folds = pairs.reshape(2, half, 2 * sheets * lanes)
    frequencies = len(y.across_cos)
    whole = room[0][: 4 * frequencies * sheets * lanes].reshape(
        2, frequencies, 2 * sheets * lanes
    )
    np.dot(y.across_cos, folds[0], whole[0])
    np.dot(y.across_sin, folds[1], whole[1])
    return whole[0], whole[1]


@numba.njit(cache=True, fastmath=True, nogil=True, forceinline=True)
def _led_back(mixed, axes, size, room):  # type: ignore[no-untyped-def]
    """([sum, difference], sheets, rows, columns of a half) images of spectra (2, F,
    sheets, [real, imaginary], G).
    """
    y, x = axes
    high, wide = size
    _, frequencies, count, _, lanes = mixed.shape
    half, columns = (high + 1) // 2, count * 2 * lanes
    spectra = mixed.reshape(2, frequencies, columns)
    folded = room[4][: 2 * half * columns].reshape(2, half, columns)
    np.dot(y.up_cos, spectra[0], folded[0])
    np.dot(y.up_sin, spectra[1], folded[1])
    pairs = folded.reshape(2, half, count, 2, lanes)
    parts = room[5][: 2 * count * high * lanes].reshape(2, count, high, lanes)
    for i in range(half):
        for job in range(count):
            for part in range(2):
                for g in range(lanes):
                    one, other = pairs[0, i, job, part, g], pairs[1, i, job, part, g]
                    parts[part, job, i, g] = one + other
                    parts[part, job, high - 1 - i, g] = one - other
    half = (wide + 1) // 2
    image = room[4][: 2 * count * high * half].reshape(2, count * high, half)
    rows = parts.reshape(2, count * high, lanes)
    np.dot(rows[0], x.back_cos, image[0])
    np.dot(rows[1], x.back_sin, image[1])
    return image.reshape(2, count, high, half)


@numba.njit(cache=True, fastmath=True, nogil=True, forceinline=True)
def _add_folded(image, job, seen):  # type: ignore[no-untyped-def]
    """Add a sheet's image to where it is seen; a middle column is its own mirror image."""
    high, wide = seen.shape
    for row in range(high):
        for i in range(wide // 2):
            one, other = image[0, job, row, i], image[1, job, row, i]
            seen[row, i] += one + other
            seen[row, wide - 1 - i] += one - other
        if wide % 2:
            seen[row, wide // 2] += image[0, job, row, wide // 2]


@numba.njit(cache=True, fastmath=True, nogil=True, forceinline=True)
def _halve(kernels, down, along, out):  # type: ignore[no-untyped-def]
    """Of spectra T (kernels, Y, X // 2 + 1), counted from the middle by their turns:
    (kernels, F, 4, G) real and
    imaginary parts of E = T(f) + T(-f) and of D = i (T(f) - T(-f))."""
    out[:] = 0
    for k in range(out.shape[0]):
        for f in range(out.shape[1]):
            for g in range(kernels.shape[2]):
                plus, minus = (
                    kernels[k, f, g] * (along[g] * down[f]),
                    kernels[k, -f, g] * (along[g] * np.conj(down[f])),
                )
                out[k, f, 0, g], out[k, f, 1, g] = (
                    plus.real + minus.real,
                    plus.imag + minus.imag,
                )
                out[k, f, 2, g], out[k, f, 3, g] = (
                    minus.imag - plus.imag,
                    plus.real - minus.real,
                )


@numba.njit(cache=True, fastmath=True, nogil=True, forceinline=True)
def _mix(cosines, sines, halves, mixed):  # type: ignore[no-untyped-def]
    """Add sheets times kernels: what multiplies the cosines along y is C E - S D, and
    the sines C D + S E.

    From (C - iS) T(f) exp(iθ) + (C + iS) T(-f) exp(-iθ), the transform at f and -f led
    back.

    cosines, sines: (F, [real, imaginary], kernels, sheets, G) products with the cosines
    along y, C, and the sines, S.
    halves: see :func:`_halve`. mixed: ([cosines, sines], F, sheets, [real, imaginary],
    G).
    """
    _, frequencies, count, _, lanes = mixed.shape
    for f in range(frequencies):
        for job in range(count):
            a, b, m, n = (
                mixed[0, f, job, 0],
                mixed[0, f, job, 1],
                mixed[1, f, job, 0],
                mixed[1, f, job, 1],
            )
            for k in range(len(halves)):
                c, d, s, t = (
                    cosines[f, 0, k, job],
                    cosines[f, 1, k, job],
                    sines[f, 0, k, job],
                    sines[f, 1, k, job],
                )
                p, q, u, v = (
                    halves[k, f, 0],
                    halves[k, f, 1],
                    halves[k, f, 2],
                    halves[k, f, 3],
                )
                for g in range(
                    lanes
                ):  # a loop a sum: with more arrays in one, numbers would be taken one by one
                    a[g] += c[g] * p[g] - d[g] * q[g] - s[g] * u[g] + t[g] * v[g]
                for g in range(lanes):
                    b[g] += c[g] * q[g] + d[g] * p[g] - s[g] * v[g] - t[g] * u[g]
                for g in range(lanes):
                    m[g] += c[g] * u[g] - d[g] * v[g] + s[g] * p[g] - t[g] * q[g]
                for g in range(lanes):
                    n[g] += c[g] * v[g] + d[g] * u[g] + s[g] * q[g] + t[g] * p[g]
