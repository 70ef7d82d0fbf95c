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
    every = [images, *beside]
    _check_signs(every, where)
    note = ""
    if bits is not None and _is_share(images):
        scale = _full_scale(images, bits, where)
        every = [a * scale if _is_share(a) else a for a in every]
        note = f"shares of full scale multiplied by {scale}; "
    counts = [_whole(a) for a in every]
    whole = [a for a in counts if a.dtype.kind != "f" and a.min() >= 0]
    if not whole or whole[0] is not counts[0]:
        if bits is not None and images.max() >= 1 << bits:
            raise CaptureError(
                f"{where}: counts are real numbers up to {images.max():.6g}, the "
                f"capture states {bits} bits (at most {(1 << bits) - 1}); correct bits, "
                "or divide by the shift"
            )
        note += "counts are real numbers: taken as they are"
        return counts[0], bits or 16, note, tuple(counts[1:])
    factor, depth, said = _stretch(whole, bits)
    if not said:
        shift, depth, said = _alignment(whole, bits, where)
        factor = 0.5**shift
    if factor < 1:
        counts = [
            np.rint(a * factor).astype(a.dtype)
            if a.dtype.kind != "f" and a.min() >= 0
            else a * factor
            for a in counts
        ]
    return counts[0], depth, note + said, tuple(counts[1:])


def _alignment(
    whole: Sequence[Array], bits: int | None, where: str
) -> tuple[int, int, str]:
    """(shift to undo, bits of the converter, note in words) of whole counts."""
    used = 0
    for a in whole:
        used |= int(np.bitwise_or.reduce(a.astype(np.int64), axis=None))
    shift = (used & -used).bit_length() - 1  # -1 where all is dark
    width, item_bytes = used.bit_length(), whole[0].dtype.itemsize
    if bits is not None and width <= bits:
        return 0, bits, f"{bits} bits as stated"
    if bits is not None and not 16 - bits <= shift < width <= 16:
        raise CaptureError(
            f"{where}: counts use {width - shift} bits above the lowest {shift}, the "
            f"capture states {bits}; correct bits, or the bit shift"
        )
    if bits is not None:
        said = f"{bits}-bit counts were shifted left by {16 - bits} bits: shifted back"
        return 16 - bits, bits, said
    if shift > 0 and width > 12 and item_bytes == 2:
        said = f"lowest {shift} bits never used: {16 - shift}-bit counts shifted back"
        return shift, 16 - shift, said
    depth = next((d for d in _DEPTHS if width <= d), 16) if item_bytes > 1 else 8
    return 0, depth, f"counts of {width} bits: taken as a {depth}-bit converter"


def _stretch(whole: Sequence[Array], bits: int | None) -> tuple[float, int, str]:
    """(factor that undoes it, bits, note in words) of counts that are stretched from
    the stated bits over words of 16; no note where they are not.
    """
    if bits is None or bits >= 16 or any(a.dtype.itemsize != 2 for a in whole):
        return 1.0, 0, ""
    levels = np.unique(np.concatenate([np.unique(a) for a in whole]))
    step = 65_535 / ((1 << bits) - 1)
    count = levels >> (16 - bits)
    repeated = (count << (16 - bits)) | (count >> max(2 * bits - 16, 0))
    scaled = np.rint(np.rint(levels / step) * step)
    over = levels[-1] >= 1 << bits
    if not over or not (
        np.array_equal(levels, repeated) or np.array_equal(levels, scaled)
    ):
        return 1.0, 0, ""
    return 1 / step, bits, f"{bits}-bit counts were stretched over 16 bits: taken back"


def _check_signs(every: Sequence[Array], where: str) -> None:
    """Refuse 16-bit counts that lie in signed words: their brighter half is below 0, or
    all are moved by 32768.
    """
    least = min(
        (int(a.min()) for a in every if a.dtype.kind == "i" and a.dtype.itemsize == 2),
        default=0,
    )
    if least < _WRAPPED:
        raise CaptureError(
            f"{where}: signed counts down to {least}: words of 16 bits without a sign "
            "that were saved as signed, or with 32768 taken off; save them as unsigned "
            "(uint16)"
        )


def _whole(image: Array) -> Array:
    """Real numbers as the whole counts of up to 16 bits that they are, to the digits of
    float32; else as they are.
    """
    if (
        image.dtype.kind != "f"
        or image.min() < -_ROUNDING
        or image.max() > 65_535 + _ROUNDING
    ):
        return image
    counts = np.rint(image)
    near = np.abs(image - counts).max() < _ROUNDING
    return counts.astype(np.uint16) if near else image


def _is_share(image: Array) -> bool:
    """Whether real numbers are shares of full scale: up to 1, and not all 0 or 1."""
    return bool(
        image.dtype.kind == "f"
        and 0 < image.max() <= 1
        and not np.array_equal(image, np.rint(image))
    )


def _full_scale(images: Array, bits: int, where: str) -> int:
    """What shares of full scale are to be multiplied by."""
    shares = np.asarray(images, float)
    for scale in ((1 << bits) - 1, 1 << bits):
        if np.abs(shares * scale - np.rint(shares * scale)).max() < _ROUNDING:
            return scale
    raise CaptureError(
        f"{where}: real numbers up to {images.max():.3g}, no counts over the full scale "
        f"of {bits} bits; save counts as they come from the camera, or multiply frames, "
        "dark and flat by the full scale in counts"
    )
