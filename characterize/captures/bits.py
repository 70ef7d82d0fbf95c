"""How many bits a converter has, and where they lie in the words of a file."""

from collections.abc import Sequence

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

_DEPTHS = (8, 10, 12, 14, 16)
# different counts that all lie as stretched ones do: by chance one of 14 bits in 4**32
_LEAST_KINDS = 32
_WRAPPED = -(1 << 14)  # below what is left of counts that a dark frame was taken off
_ROUNDING = 0.01  # counts: float32 keeps a share of 65535 to 0.004


def right_align(
    images: Array, bits: int | None, where: str, *, beside: Sequence[Array] = ()
) -> tuple[Array, int, str, tuple[Array, ...]]:
    """Undo a left shift or a stretch of 8 to 14-bit counts in 16-bit words and find the
    depth of the converter.

    Args:
        bits: as stated with the capture; None finds it from the counts.
        beside: other images of the same camera (dark, flat). All tell of both together
            and are shifted alike: a dark
            frame by itself fits into the bits that its shift takes. Averages (real
            numbers) are divided.

    Counts are stretched where their highest bits are repeated in the lowest, or where
    they are multiplied by
    65535 / (2**b - 1) and rounded, as image programs save them: gaps between levels are
    then no noise of the camera.

    Frames of real numbers that are whole are counts. Real numbers up to 1, where bits
    are stated or
    other images lie beside, are shares of full scale: multiplied by the least of 2**b -
    1 and 2**b that makes counts of
    them.

    Returns:
        (counts, bits, note in words, counts of those beside).

    Raises:
        CaptureError: the counts lie neither in the lowest of the stated bits nor in the
            highest of 16, or are real and
            above the stated bits; shares of full scale of which no counts can be made;
            unsigned words of 16 bits that
            were written as signed ones.
    """
    _check_signs((images, *beside), where)
    scale = _full_scale(images, where) if bits is not None or beside else 1
    images = _whole(images * scale if scale > 1 else images)
    others = [
        a * scale if scale > 1 and a.dtype.kind == "f" and a.max() <= 1 else a
        for a in beside
    ]
    images, depth, note, rest = _aligned(images, bits, where, others)
    return (
        images,
        depth,
        f"shares of full scale multiplied by {scale}; {note}" if scale > 1 else note,
        rest,
    )


def _aligned(
    images: Array, bits: int | None, where: str, beside: Sequence[Array]
) -> tuple[Array, int, str, tuple[Array, ...]]:
    """As :func:`right_align`, of counts."""
    every = (images, *beside)
    whole = [a for a in every if a.dtype.kind != "f" and a.min() >= 0]
    if not whole or whole[0] is not images:
        if bits is not None and images.max() >= 1 << bits:
            raise CaptureError(
                f"{where}: counts are real numbers up to {images.max():.6g}, the capture states {bits} bits (at most "
                f"{(1 << bits) - 1}); correct bits, or divide by the shift"
            )
        return (
            images,
            bits or 16,
            "counts are real numbers: taken as they are",
            tuple(beside),
        )
    if depth := _stretched(whole, bits):
        share = ((1 << depth) - 1) / 65_535
        back = [
            np.rint(a * share).astype(a.dtype)
            if any(a is w for w in whole)
            else a * share
            for a in every
        ]
        return (
            back[0],
            depth,
            f"{depth}-bit counts were stretched over 16 bits: taken back",
            tuple(back[1:]),
        )
    used = int(
        np.bitwise_or.reduce(
            [np.bitwise_or.reduce(a.astype(np.int64), axis=None) for a in whole]
        )
    )
    shift, depth, note = _alignment(used, bits, images.dtype.itemsize, where)
    if not shift:
        return images, depth, note, tuple(beside)
    rest = tuple(
        a >> shift if any(a is w for w in whole) else a / 2**shift for a in beside
    )
    return images >> shift, depth, note, rest


def _alignment(
    used: int, bits: int | None, item_bytes: int, where: str
) -> tuple[int, int, str]:
    """(shift to undo, bits of the converter, note in words) of counts whose bits
    together are ``used``.
    """
    shift = (used & -used).bit_length() - 1  # -1 where all is dark
    width = used.bit_length()
    if bits is not None and width <= bits:
        return 0, bits, f"{bits} bits as stated"
    if bits is not None and not 16 - bits <= shift < width <= 16:
        raise CaptureError(
            f"{where}: counts use {width - shift} bits above the lowest {shift}, the capture states {bits}; correct "
            "bits, or the bit shift"
        )
    if bits is not None:
        return (
            16 - bits,
            bits,
            f"{bits}-bit counts were shifted left by {16 - bits} bits: shifted back",
        )
    if shift and width > 12 and item_bytes == 2:
        return (
            shift,
            16 - shift,
            f"lowest {shift} bits never used: {16 - shift}-bit counts shifted back",
        )
    depth = next((d for d in _DEPTHS if width <= d), 16) if item_bytes > 1 else 8
    return 0, depth, f"counts of {width} bits: taken as a {depth}-bit converter"


def _stretched(whole: Sequence[Array], bits: int | None) -> int:
    """Depth of counts that are stretched over words of 16 bits; 0 where they are not."""
    if any(a.dtype.itemsize != 2 for a in whole):
        return 0
    met = np.zeros(1 << 16, bool)
    for a in whole:
        met[a] = True
    found = np.flatnonzero(met)
    if len(found) < _LEAST_KINDS or found[-1] < 1 << (bits or 12):
        return 0
    for depth in _DEPTHS[:-1] if bits is None else (min(bits, 16),):
        free, full = 16 - depth, (1 << depth) - 1
        count = found >> free
        repeated = (count << free) | (count >> max(depth - free, 0))
        scaled = np.rint(np.rint(found * (full / 65_535)) * (65_535 / full))
        if free and (np.array_equal(found, repeated) or np.array_equal(found, scaled)):
            return depth
    return 0


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
            f"{where}: signed counts down to {least}: words of 16 bits without a sign that were saved as signed, or "
            "with 32768 taken off; save them as unsigned (uint16)"
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
    return (
        counts.astype(np.uint16) if np.abs(image - counts).max() < _ROUNDING else image
    )


def _full_scale(images: Array, where: str) -> int:
    """What shares of full scale are to be multiplied by; 1 for counts."""
    if (
        images.dtype.kind != "f"
        or not 0 < images.max() <= 1
        or np.array_equal(images, np.rint(images))
    ):
        return 1
    shares = np.asarray(images, float)
    full = (scale for depth in _DEPTHS for scale in ((1 << depth) - 1, 1 << depth))
    found = next(
        (s for s in full if np.abs(shares * s - np.rint(shares * s)).max() < _ROUNDING),
        None,
    )
    if found is None:
        raise CaptureError(
            f"{where}: real numbers up to {images.max():.3g}, no counts over the full scale of a converter; save "
            "counts as they come from the camera, or multiply frames, dark and flat by the full scale in counts"
        )
    return found
