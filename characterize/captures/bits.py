"""How many bits a converter has, and where they lie in the words of a file."""

from collections.abc import Sequence

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
    note = ""
    if bits is not None and _is_fraction(images):
        scale = _full_scale(images, bits, where)
        stacks = [stack * scale if _is_fraction(stack) else stack for stack in stacks]
        note = f"shares of full scale multiplied by {scale}; "
    counts = [_as_integers(stack) for stack in stacks]
    whole = [stack for stack in counts if _is_whole(stack)]
    if not _is_whole(counts[0]):
        if bits is not None and images.max() >= 1 << bits:
            raise CaptureError(
                f"{where}: counts are real numbers up to {images.max():.6g}, the "
                f"capture states {bits} bits (at most {(1 << bits) - 1}); correct "
                "bits, or divide by the shift"
            )
        note += "counts are real numbers: taken as they are"
        return counts[0], bits or 16, note, tuple(counts[1:])
    step, depth, text = _step_of_counts(whole, bits, where)
    if step > 1:
        counts = [
            np.rint(stack / step).astype(stack.dtype)
            if _is_whole(stack)
            else stack / step
            for stack in counts
        ]
    return counts[0], depth, note + text, tuple(counts[1:])


def _step_of_counts(
    whole: Sequence[Array], bits: int | None, where: str
) -> tuple[float, int, str]:
    """(values a count, bits of the converter, note in words) of whole numbers.

    A stretch over 16 bits multiplies by 65535 / (2**bits - 1), or repeats the highest
    bits in the lowest.
    """
    levels = np.unique(np.concatenate([np.unique(stack) for stack in whole]))
    levels = levels.astype(np.int64)
    used = int(np.bitwise_or.reduce(levels))
    shift = (used & -used).bit_length() - 1  # -1 where all is dark
    used_bits = used.bit_length()
    word_bytes = whole[0].dtype.itemsize
    if bits is None and shift > 0 and used_bits > 12 and word_bytes == 2:
        text = f"lowest {shift} bits never used: {16 - shift}-bit counts shifted back"
        return 1 << shift, 16 - shift, text
    if bits is None:
        deep_enough = (depth for depth in _DEPTHS if used_bits <= depth)
        depth = 8 if word_bytes == 1 else next(deep_enough, 16)
        return 1, depth, f"counts of {used_bits} bits: taken as a {depth}-bit converter"
    if used_bits <= bits:
        return 1, bits, f"{bits} bits as stated"
    left = 16 - bits
    if left > 0 and used_bits <= 16:
        if shift >= left:
            text = f"{bits}-bit counts were shifted left by {left} bits: shifted back"
            return 1 << left, bits, text
        stretch = 65_535 / ((1 << bits) - 1)
        count = np.rint(levels / stretch).astype(np.int64)
        repeated = (count << left) | (count >> max(2 * bits - 16, 0))
        if any(
            np.array_equal(levels, stretched)
            for stretched in (np.rint(count * stretch), repeated)
        ):
            text = f"{bits}-bit counts were stretched over 16 bits: taken back"
            return stretch, bits, text
    raise CaptureError(
        f"{where}: counts use {used_bits - shift} bits above the lowest {shift}, the "
        f"capture states {bits}; correct bits, or the bit shift"
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


def _is_fraction(image: Array) -> bool:
    """Whether real numbers are shares of full scale: up to 1, and not all 0 or 1."""
    return bool(
        image.dtype.kind == "f"
        and 0 < image.max() <= 1
        and not np.array_equal(image, np.rint(image))
    )


def _full_scale(images: Array, bits: int, where: str) -> int:
    """Factor from shares of full scale to counts: 2**bits - 1 or 2**bits."""
    for scale in ((1 << bits) - 1, 1 << bits):
        counts = images.astype(float) * scale
        if np.abs(counts - np.rint(counts)).max() < _ROUNDING:
            return scale
    raise CaptureError(
        f"{where}: real numbers up to {images.max():.3g}, no counts over the full "
        f"scale of {bits} bits; save counts as they come from the camera, or multiply "
        "frames, dark and flat by the full scale in counts"
    )
