"""PNG files put together block by block: colours in their order, and where a file ends
or claims too much.
"""

import struct
import zlib

import numpy as np
import pytest

from characterize.captures import png
from metalens.core.errors import CaptureError

MARK = b"\x89PNG\r\n\x1a\n"
KINDS = {1: 0, 3: 2, 4: 6}  # values of a pixel: kind of colours in the head


def block(name, data=b""):
    return (
        struct.pack(">I", len(data))
        + name
        + data
        + struct.pack(">I", zlib.crc32(name + data))
    )


def head(width, height, bits=8, kind=0):
    return block(b"IHDR", struct.pack(">2I5B", width, height, bits, kind, 0, 0, 0))


def written(path, *blocks):
    path.write_bytes(MARK + b"".join(blocks))
    return path


def image(values, bits):
    """(y, x, colours) as a file's blocks: every row behind a byte that says no filter."""
    height, width, colours = values.shape
    rows = values.astype(f">u{bits // 8}").tobytes()
    size = len(rows) // height
    lines = b"".join(b"\0" + rows[size * k : size * (k + 1)] for k in range(height))
    return (
        head(width, height, bits, KINDS[colours]),
        block(b"IDAT", zlib.compress(lines)),
        block(b"IEND"),
    )


@pytest.mark.parametrize("bits", [8, 16])
def test_grey_is_an_image_and_red_stands_before_green_blue_and_alpha(tmp_path, bits):
    values = np.arange(2 * 3 * 4).reshape(2, 3, 4) * (1 if bits == 8 else 1013) + 7
    grey = png.read_png(written(tmp_path / "a.png", *image(values[..., :1], bits)))
    assert grey.tolist() == values[..., 0].tolist()
    assert grey.dtype == f"u{bits // 8}"
    for colours in (3, 4):
        found = png.read_png(
            written(tmp_path / "a.png", *image(values[..., :colours], bits))
        )
        assert found.tolist() == [values[..., :colours].tolist()]


def test_blocks_of_any_length_may_stand_between_and_bytes_behind_the_last(tmp_path):
    first, data, last = image(np.arange(6).reshape(2, 3, 1), 8)
    path = written(
        tmp_path / "a.png",
        first,
        block(b"tEXt", b"made\0by hand, 19 bytes"),
        data,
        last,
        b"beyond",
    )
    assert png.read_png(path).tolist() == [[0, 1, 2], [3, 4, 5]]


def test_a_block_that_reaches_one_byte_beyond_the_file_is_refused_with_both_ends(
    tmp_path,
):
    """8 of the mark, 25 of the head, 12 and 5 of a block, 12 of the last: 62 bytes."""
    blocks = head(3, 2), block(b"tEXt", b"a\0bcd"), block(b"IEND")
    png._check(written(tmp_path / "a.png", *blocks))
    path = written(tmp_path / "a.png", *blocks[:2], blocks[2][:-1])
    with pytest.raises(CaptureError, match=r"a block ends at byte 62, the file at 61"):
        png.read_png(path)
    with pytest.raises(
        CaptureError, match=r"a block ends at byte 50, the file at 50"
    ):  # of which none is the last
        png.read_png(written(tmp_path / "a.png", *blocks[:2]))
    longer = struct.pack(">I", 6) + blocks[1][4:]
    with pytest.raises(CaptureError, match=r"a block ends at byte"):
        png.read_png(written(tmp_path / "a.png", blocks[0], longer, blocks[2]))


def test_a_head_claims_at_most_what_the_densest_file_could_hold(tmp_path):
    """Eight pixels of one bit in a byte, of which a byte of the file makes 1040: 8320 a
    byte of 8 + 25 + 12 bytes.
    """
    png._check(written(tmp_path / "a.png", head(8320, 45), block(b"IEND")))
    for width, height in ((8320, 46), (8321, 45)):
        with pytest.raises(
            CaptureError, match=r"45 bytes, its head claims more or fails"
        ):
            png.read_png(
                written(tmp_path / "a.png", head(width, height), block(b"IEND"))
            )


def test_the_head_comes_first_and_once(tmp_path):
    first, data, last = image(np.arange(6).reshape(2, 3, 1), 8)
    with pytest.raises(CaptureError, match="a second head"):
        png.read_png(written(tmp_path / "a.png", first, first, data, last))
    with pytest.raises(CaptureError, match="its head claims more or fails"):
        png.read_png(written(tmp_path / "a.png", data, first, last))
    for short in (b"", MARK, MARK + first[:-2]):
        (tmp_path / "a.png").write_bytes(short)
        with pytest.raises(CaptureError, match="truncated or not a PNG file"):
            png.read_png(tmp_path / "a.png")
