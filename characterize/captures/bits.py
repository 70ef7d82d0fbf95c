"""How many bits a converter has, and where they lie in the words of a file."""

from collections.abc import Sequence

import numpy as np

from metalens.ground.arrays import Array
from metalens.ground.errors import CaptureError

_DEPTHS = (8, 10, 12, 14, 16)


def right_align(
    images: Array, bits: int | None, where: str, *, beside: Sequence[Array] = ()
) -> tuple[Array, int, str, tuple[Array, ...]]:
    """Undo a left shift of 10 to 14-bit counts in 16-bit words and find the depth of the converter.

    Args:
        bits: as stated with the capture; None finds it from the counts.
        beside: other images of the same camera (dark, flat). All tell of both together and are shifted alike: a dark
            frame by itself fits into the bits that its shift takes. Averages (real numbers) are divided.

    Returns:
        (counts, bits, note in words, counts of those beside).

    Raises:
        CaptureError: the counts lie neither in the lowest of the stated bits nor in the highest of 16.
    """
    every = (images, *beside)
    whole = [a for a in every if a.dtype.kind != "f" and a.min() >= 0]
    if not whole or whole[0] is not images:
        return images, bits or 16, "counts are real numbers: taken as they are", tuple(beside)
    used = int(np.bitwise_or.reduce([np.bitwise_or.reduce(a.astype(np.int64), axis=None) for a in whole]))
    back, depth, note = _alignment(used, bits, images.dtype.itemsize, where)
    if not back:
        return images, depth, note, tuple(beside)
    rest = tuple(a >> back if any(a is w for w in whole) else a / 2**back for a in beside)
    return images >> back, depth, note, rest


def _alignment(used: int, bits: int | None, item_bytes: int, where: str) -> tuple[int, int, str]:
    """(shift to undo, bits of the converter, note in words) of counts whose bits together are ``used``."""
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
        return 16 - bits, bits, f"{bits}-bit counts were shifted left by {16 - bits} bits: shifted back"
    if shift and width > 12 and item_bytes == 2:
        return shift, 16 - shift, f"lowest {shift} bits never used: {16 - shift}-bit counts shifted back"
    depth = next((d for d in _DEPTHS if width <= d), 16) if item_bytes > 1 else 8
    return 0, depth, f"counts of {width} bits: taken as a {depth}-bit converter"
