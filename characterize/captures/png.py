"""The image of a PNG file, refused where it is damaged or claims more than it holds."""

import math
import struct
from pathlib import Path

from characterize.captures.colour import red_first
from characterize.captures.tiff import DENSEST
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

_HEAD_BYTES = 33  # bytes of a PNG's mark and head


def read_png(path: Path) -> Array:
    """(y, x) image of a file, or (1, y, x, red green blue [alpha]).

    Args:
        path: the file.

    Raises:
        CaptureError: truncated, no PNG file, or its head claims more than the file
            holds.
    """
    import cv2

    _check_blocks(path)
    try:
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise CaptureError(f"{path}: not a readable PNG file ({error.err})") from None
    if image is None:
        raise CaptureError(f"{path}: truncated or not a PNG file")
    image = red_first(image)
    return image[None] if image.ndim == 3 else image


def _check_blocks(path: Path) -> None:
    """Refuse a file whose head or blocks claim more bytes than it has.

    The PNG blocks are walked from the head to IEND by their lengths.
    """
    size = path.stat().st_size
    offset = 8
    block = b""
    with open(path, "rb") as file:
        while size >= _HEAD_BYTES and offset + 8 <= size and block != b"IEND":
            file.seek(offset)
            head = file.read(24 if not block else 8)
            length = int.from_bytes(head[:4], "big")
            name = head[4:8]
            if not block and (
                name != b"IHDR"
                or math.prod(struct.unpack(">2I", head[8:16])) > DENSEST * 8 * size
            ):
                raise CaptureError(
                    f"{path}: truncated or not a PNG file ({size} bytes, its head "
                    "claims more or fails)"
                )
            if block and name == b"IHDR":
                raise CaptureError(f"{path}: not a PNG file (a second head)")
            offset = offset + 12 + length
            block = name
    if block != b"IEND" or offset > size:
        raise CaptureError(
            f"{path}: truncated or not a PNG file (a block ends at byte {offset}, the "
            f"file at {size})"
        )
