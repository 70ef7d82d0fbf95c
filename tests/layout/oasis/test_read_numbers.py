"""Compressed blocks of an OASIS file are unpacked as far as their limits go, and a byte
further they are refused.
"""

import zlib

import numpy as np
import pytest

from layout.oasis import bytes as oasis
from layout.oasis.read import parse
from metalens.ground.errors import MaskFileError

START = (
    bytes([oasis.START, 3]) + b"1.0" + b"\x00" + oasis.unsigned(1000) + bytes(1 + 12)
)


def refusal(size, packed, limit):
    """Of a file that is one compressed block, said to unpack to so many bytes, and then
    ends without END.
    """
    block = (
        bytes([oasis.CBLOCK, 0])
        + oasis.unsigned(size)
        + oasis.unsigned(len(packed))
        + packed
    )
    with pytest.raises(MaskFileError) as caught:
        parse(np.frombuffer(oasis.MAGIC + START + block, np.uint8), limit=limit)
    return str(caught.value)


def test_a_block_holds_sixteen_bytes_for_each_placement_that_may_be_read():
    """Of padding, one byte a record."""
    for size, words in (
        (160, "the file ends without END"),
        (161, "block of 161 bytes, at most 160 are unpacked"),
    ):
        packed = zlib.compress(bytes(size), 9, wbits=-15)
        assert words in refusal(size, packed, limit=10)


def test_no_block_is_said_to_be_denser_than_deflate_packs():
    """1100 bytes for each of three, and 64 beside."""
    assert "block of 0 bytes where 3364 are announced" in refusal(
        3364, b"abc", limit=10_000
    )
    assert "block of 3 bytes for 3365, with 3 left" in refusal(
        3365, b"abc", limit=10_000
    )
