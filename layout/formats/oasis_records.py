"""Bytes of the OASIS format (SEMI P39): integers, reals, strings, compressed blocks,
start and end.
"""

import enum
import struct
import zlib

MAGIC = b"%SEMI-OASIS\r\n"
END_SIZE = 256


class OasisRecord(enum.IntEnum):
    """Kinds of records (SEMI P39)."""

    PAD = 0
    START = 1
    END = 2
    CELLNAME = 3
    CELLNAME_REF = 4
    TEXTSTRING = 5
    TEXTSTRING_REF = 6
    PROPNAME = 7
    PROPNAME_REF = 8
    PROPSTRING = 9
    PROPSTRING_REF = 10
    LAYERNAME = 11
    LAYERNAME_TEXT = 12
    CELL_REF = 13
    CELL = 14
    XYABSOLUTE = 15
    XYRELATIVE = 16
    PLACEMENT = 17
    PLACEMENT_ANY = 18
    TEXT = 19
    RECTANGLE = 20
    POLYGON = 21
    PATH = 22
    TRAPEZOID = 23
    TRAPEZOID_A = 24
    TRAPEZOID_B = 25
    CTRAPEZOID = 26
    CIRCLE = 27
    PROPERTY = 28
    PROPERTY_REPEAT = 29
    XNAME = 30
    XNAME_REF = 31
    XELEMENT = 32
    XGEOMETRY = 33
    CBLOCK = 34


def unsigned_integer(value: int) -> bytes:
    """7 bits a byte, least significant first; the top bit says that more follow.

    Args:
        value: 0 or above.
    """
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)


def signed_integer(value: int) -> bytes:
    """Magnitude shifted left by the sign bit.

    Args:
        value: any integer.
    """
    return unsigned_integer(abs(value) << 1 | (value < 0))


def oasis_string(text: str) -> bytes:
    """Length and characters.

    Args:
        text: UTF-8.
    """
    data = text.encode()
    return unsigned_integer(len(data)) + data


def oasis_real(value: float) -> bytes:
    """Whole numbers as such, their reciprocals as such, all others as IEEE double.

    Args:
        value: any number.
    """
    if value > 0 and value == round(value):
        return b"\0" + unsigned_integer(round(value))
    if 0 < value < 1 and 1 / round(1 / value) == value:
        return b"\x02" + unsigned_integer(round(1 / value))
    return b"\x07" + struct.pack("<d", value)


def compressed_block(raw: bytes | memoryview, level: int) -> bytes:
    """A CBLOCK record, or the bytes themselves where compression gains nothing.

    Args:
        raw: bytes of whole records.
        level: of deflate, 1 to 9.
    """
    packer = zlib.compressobj(level, zlib.DEFLATED, -15)
    packed = packer.compress(raw) + packer.flush()
    block = (
        bytes([OasisRecord.CBLOCK, 0])
        + unsigned_integer(len(raw))
        + unsigned_integer(len(packed))
        + packed
    )
    return block if len(block) < len(raw) else bytes(raw)


def start_record(unit_nm: float) -> bytes:
    """Magic and START: version 1.0, grid steps in a micrometre, table offsets in the
    END record.

    Args:
        unit_nm: database unit.
    """
    return (
        MAGIC
        + bytes([OasisRecord.START])
        + oasis_string("1.0")
        + oasis_real(1e3 / unit_nm)
        + unsigned_integer(1)
    )


def end_record(offsets: tuple[int, int, int, int, int, int], checksum: int) -> bytes:
    """The 256 bytes of END: strict name tables (0 where there is none), padding, CRC-32
    of all before the CRC.

    offsets: of the tables of cell names, text strings, property names, property
    strings, layer names, XNAMEs.
    checksum: CRC-32 of the file so far.
    """
    head = bytes([OasisRecord.END]) + b"".join(
        unsigned_integer(1) + unsigned_integer(offset) for offset in offsets
    )
    fill = END_SIZE - len(head) - 5
    length = (
        unsigned_integer(fill - 2) if fill - 2 > 127 else b"\x80" + bytes([fill - 1])
    )
    body = head + length + bytes(fill - len(length)) + b"\x01"
    return body + struct.pack("<I", zlib.crc32(body, checksum))
