"""How many bits a converter has, and where they lie in the words of a file."""

from collections.abc import Sequence

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

_DEPTHS = (8, 10, 12, 14, 16)
_WRAPPED = -(1 << 14)  # below what is left of counts that a dark frame was taken off
_ROUNDING = 0.01  # counts: float32 keeps a share of 65535 to 0.004


def right_align(
    images: Array, bits: int | None, where: str, *, beside: Sequence[Array] = ()
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
        beside: dark and flat. All tell of their shift together and are shifted alike: a
            dark frame by itself fits into the bits that its shift takes.

    Returns:
        (counts, bits, note in words, counts of those beside).

    Raises:
        CaptureError: the counts lie neither in the lowest of the stated bits nor in the
            highest of 16, or are real and above the stated bits; shares of full scale
            of which no counts can be made; unsigned words saved as signed ones.
    """
    stacks = [images, *beside]
    _check_signs(stacks, where)
    note = ""
    if bits is not None and _is_fraction(images):
        scale = _full_scale(images, bits, where)
        stacks = [stack * scale if _is_fraction(stack) else stack for stack in stacks]
        note = f"shares of full scale multiplied by {scale}; "
    counts = [_as_integers(stack) for stack in stacks]
    integers = [
        stack for stack in counts if stack.dtype.kind != "f" and stack.min() >= 0
    ]
    if not integers or integers[0] is not counts[0]:
        if bits is not None and images.max() >= 1 << bits:
            raise CaptureError(
                f"{where}: counts are real numbers up to {images.max():.6g}, the "
                f"capture states {bits} bits (at most {(1 << bits) - 1}); correct "
                "bits, "
                "or divide by the shift"
            )
        note += "counts are real numbers: taken as they are"
        return counts[0], bits or 16, note, tuple(counts[1:])
    factor, depth, text = _stretch(integers, bits)
    if not text:
        shift, depth, text = _alignment(integers, bits, where)
        factor = 0.5**shift
    if factor < 1:
        counts = [
            np.rint(stack * factor).astype(stack.dtype)
            if stack.dtype.kind != "f" and stack.min() >= 0
            else stack * factor
            for stack in counts
        ]
    return counts[0], depth, note + text, tuple(counts[1:])


def _alignment(
    whole: Sequence[Array], bits: int | None, where: str
) -> tuple[int, int, str]:
    """(shift to undo, bits of the converter, note in words) of whole counts."""
    used = 0
    for stack in whole:
        used |= int(np.bitwise_or.reduce(stack.astype(np.int64), axis=None))
    shift = (used & -used).bit_length() - 1  # -1 where all is dark
    used_bits = used.bit_length()
    word_bytes = whole[0].dtype.itemsize
    if bits is not None and used_bits <= bits:
        return 0, bits, f"{bits} bits as stated"
    if bits is not None and not 16 - bits <= shift < used_bits <= 16:
        raise CaptureError(
            f"{where}: counts use {used_bits - shift} bits above the lowest {shift}, "
            f"the capture states {bits}; correct bits, or the bit shift"
        )
    if bits is not None:
        text = f"{bits}-bit counts were shifted left by {16 - bits} bits: shifted back"
        return 16 - bits, bits, text
    if shift > 0 and used_bits > 12 and word_bytes == 2:
        text = f"lowest {shift} bits never used: {16 - shift}-bit counts shifted back"
        return shift, 16 - shift, text
    depth = (
        next(
            (
                depth_candidate
                for depth_candidate in _DEPTHS
                if used_bits <= depth_candidate
            ),
            16,
        )
        if word_bytes > 1
        else 8
    )
    return 0, depth, f"counts of {used_bits} bits: taken as a {depth}-bit converter"


def _stretch(whole: Sequence[Array], bits: int | None) -> tuple[float, int, str]:
    """(factor, bits, note) that undo a stretch of counts from ``bits`` over 16 bits.

    A stretch repeats the highest bits in the lowest, or multiplies by
    65535 / (2**bits - 1). The note is empty where there is none.
    """
    if bits is None or bits >= 16 or any(stack.dtype.itemsize != 2 for stack in whole):
        return 1.0, 0, ""
    levels = np.unique(np.concatenate([np.unique(stack) for stack in whole]))
    stretch = 65_535 / ((1 << bits) - 1)
    top_bits = levels >> (16 - bits)
    repeated = (top_bits << (16 - bits)) | (top_bits >> max(2 * bits - 16, 0))
    scaled = np.rint(np.rint(levels / stretch) * stretch)
    exceeds = levels[-1] >= 1 << bits
    if not exceeds or not (
        np.array_equal(levels, repeated) or np.array_equal(levels, scaled)
    ):
        return 1.0, 0, ""
    return (
        1 / stretch,
        bits,
        f"{bits}-bit counts were stretched over 16 bits: taken back",
    )


def _check_signs(stacks: Sequence[Array], where: str) -> None:
    """Refuse 16-bit counts that lie in signed words: their brighter half is below 0, or
    all are moved by 32768.
    """
    smallest = min(
        (
            int(stack.min())
            for stack in stacks
            if stack.dtype.kind == "i" and stack.dtype.itemsize == 2
        ),
        default=0,
    )
    if smallest < _WRAPPED:
        raise CaptureError(
            f"{where}: signed counts down to {smallest}: words of 16 bits without a "
            "sign that were saved as signed, or with 32768 taken off; save them as "
            "unsigned "
            "(uint16)"
        )


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
    shares = np.asarray(images, float)
    for scale in ((1 << bits) - 1, 1 << bits):
        if np.abs(shares * scale - np.rint(shares * scale)).max() < _ROUNDING:
            return scale
    raise CaptureError(
        f"{where}: real numbers up to {images.max():.3g}, no counts over the full "
        "scale "
        f"of {bits} bits; save counts as they come from the camera, or multiply "
        "frames, "
        "dark and flat by the full scale in counts"
    )
