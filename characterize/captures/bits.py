"""How many bits a converter has, and where they lie in the words of a file."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

_DEPTHS = (8, 10, 12, 14, 16)
_WRAPPED = -(1 << 14)  # below what is left of counts that a dark frame was taken off
_ROUNDING = 0.01  # counts: float32 keeps a share of 65535 to 0.004


def right_align(
    images: Array, bits: int | None, where: str, *, companions: Sequence[Array] = ()
) -> tuple[Array, int, str, tuple[Array, ...]]:
    """Undo a left shift of counts in 16-bit words, and what is stated as ``bits``: a
    stretch over them, or shares of full scale.

    Counts are stretched where they are multiplied by 65535 / (2**bits - 1) and rounded,
    as image programs save them. Real numbers that are whole are counts; real numbers up
    to 1 are shares of full scale, 2**bits - 1 or 2**bits, where bits are stated.

    Args:
        images: (n, y, x) frames.
        bits: of the converter, as stated; None: enough for the counts.
        where: file or folder, for messages.
        companions: dark and flat. All stacks have one shift: a dark frame by itself
            fits into the bits that its shift takes.

    Returns:
        (counts, bits, note in words, counts of the companions).

    Raises:
        CaptureError: the counts lie neither in the lowest of the stated bits nor in the
            highest of 16, or are real and above the stated bits; shares of full scale
            of which no counts can be made; unsigned words saved as signed ones.
    """
    stacks = [images, *companions]
    if any(stack.dtype == np.int16 and stack.min() < _WRAPPED for stack in stacks):
        raise CaptureError(
            f"{where}: signed counts far below 0: words of 16 bits without a sign that "
            "were saved as signed, or with 32768 taken off; save them as unsigned "
            "(uint16)"
        )
    stacks = [_as_integers(stack) for stack in stacks]
    chosen = [stack for stack in stacks if _is_whole(stack)]
    if not _is_whole(stacks[0]):
        chosen = stacks[:1]
    levels = np.unique(np.concatenate([np.unique(stack) for stack in chosen]))
    if chosen[0].dtype.kind == "f" or levels[0] < 0:
        unit, note = _unit_of_reals(levels, bits, where)
        depth = bits or 16
    elif bits is None:
        unit, depth, note = _used_bits(levels.astype(np.int64), stacks[0].dtype)
    else:
        unit, note = _unit_of_counts(levels.astype(np.int64), bits, where)
        depth = bits
    scaled = []
    for stack in stacks:
        if unit < 1 < stack.max():  # counts, where the frames are shares of full scale
            scaled.append(stack)
        elif _is_whole(stack):
            scaled.append(np.rint(stack / unit).astype(stack.dtype))
        else:
            scaled.append(_as_integers(stack / unit))
    return scaled[0], depth, note, tuple(scaled[1:])


def _used_bits(levels: Array, word: np.dtype[Any]) -> tuple[float, int, str]:
    """(values a count, bits of the converter, note) by the bits that counts use."""
    used = int(np.bitwise_or.reduce(levels))
    shift = (used & -used).bit_length() - 1  # -1 where all is dark
    if shift > 0 and used.bit_length() > 12 and word.itemsize == 2:
        text = f"lowest {shift} bits never used: {16 - shift}-bit counts shifted back"
        return 1 << shift, 16 - shift, text
    least = 8 if word.itemsize == 1 else used.bit_length()
    depth = next((depth for depth in _DEPTHS if least <= depth), 16)
    text = f"counts of {used.bit_length()} bits: taken as a {depth}-bit converter"
    return 1, depth, text


def _unit_of_counts(levels: Array, bits: int, where: str) -> tuple[float, str]:
    """(values a count, note) of whole numbers of a converter of stated bits.

    A stretch over 16 bits multiplies by 65535 / (2**bits - 1), or repeats the highest
    bits in the lowest: both within 1 of the multiple.
    """
    top = (1 << bits) - 1
    shift = 1 << max(16 - bits, 0)
    for unit, rest, words in (
        (1, 0.0, f"{bits} bits as stated"),
        (shift, 0.0, f"{bits}-bit counts were shifted left: shifted back"),
        (65_535 / top, min(1.0, shift / 5), f"{bits}-bit counts were stretched"),
    ):
        count = np.rint(levels / unit)
        if count[-1] <= top and np.abs(levels - count * unit).max() <= rest:
            return unit, words
    used = int(np.bitwise_or.reduce(levels))
    low = (used & -used).bit_length() - 1
    raise CaptureError(
        f"{where}: counts use {used.bit_length() - low} bits above the lowest {low}, "
        f"the capture states {bits}; correct bits, or the bit shift"
    )


def _unit_of_reals(levels: Array, bits: int | None, where: str) -> tuple[float, str]:
    """(value of a count, note) of real numbers: counts, or shares of full scale."""
    if bits is None or 1 < levels[-1] < 1 << bits:
        return 1.0, "counts are real numbers: taken as they are"
    for scale in ((1 << bits) - 1, 1 << bits):
        counts = levels.astype(float) * scale
        if levels[-1] <= 1 and np.abs(counts - np.rint(counts)).max() < _ROUNDING:
            return 1 / scale, f"shares of full scale multiplied by {scale}"
    raise CaptureError(
        f"{where}: real numbers up to {levels[-1]:.6g}, neither counts of the stated "
        f"{bits} bits nor counts over their full scale; save counts as they come from "
        "the camera, or correct bits"
    )


def _is_whole(stack: Array) -> bool:
    """Whether values are integers from 0 on."""
    return bool(stack.dtype.kind != "f" and stack.min() >= 0)


def _as_integers(image: Array) -> Array:
    """Real numbers that are integers of up to 16 bits, to the digits of float32, as
    uint16; others unchanged.
    """
    if (
        image.dtype.kind != "f"
        or image.min() < -_ROUNDING
        or image.max() > 65_535 + _ROUNDING
    ):
        return image
    counts = np.rint(image)
    is_integer = np.abs(image - counts).max() < _ROUNDING
    return counts.astype(np.uint16) if is_integer else image
