"""Records of the GDSII stream format: numbers, kinds, and what data each kind carries."""

import enum
import struct

from metalens.core.arrays import Array

NO_DATA, BITS, INT2, INT4, REAL8, ASCII = 0, 1, 2, 3, 5, 6


class GdsiiRecord(enum.IntEnum):
    """Kinds of records, each with the type of its data."""

    data: int

    def __new__(cls, kind: int, data: int) -> "GdsiiRecord":
        """A kind with its number in the file, and the number of its data type."""
        record = int.__new__(cls, kind)
        record._value_ = kind
        record.data = data
        return record

    HEADER = 0x00, INT2
    BGNLIB = 0x01, INT2
    LIBNAME = 0x02, ASCII
    UNITS = 0x03, REAL8
    ENDLIB = 0x04, NO_DATA
    BGNSTR = 0x05, INT2
    STRNAME = 0x06, ASCII
    ENDSTR = 0x07, NO_DATA
    BOUNDARY = 0x08, NO_DATA
    PATH = 0x09, NO_DATA
    SREF = 0x0A, NO_DATA
    AREF = 0x0B, NO_DATA
    TEXT = 0x0C, NO_DATA
    LAYER = 0x0D, INT2
    DATATYPE = 0x0E, INT2
    WIDTH = 0x0F, INT4
    XY = 0x10, INT4
    ENDEL = 0x11, NO_DATA
    SNAME = 0x12, ASCII
    COLROW = 0x13, INT2
    NODE = 0x15, NO_DATA
    TEXTTYPE = 0x16, INT2
    PRESENTATION = 0x17, BITS
    STRING = 0x19, ASCII
    STRANS = 0x1A, BITS
    MAG = 0x1B, REAL8
    ANGLE = 0x1C, REAL8
    PATHTYPE = 0x21, INT2
    ELFLAGS = 0x26, BITS
    NODETYPE = 0x2A, INT2
    PROPATTR = 0x2B, INT2
    PROPVALUE = 0x2C, ASCII
    BOX = 0x2D, NO_DATA
    BOXTYPE = 0x2E, INT2
    PLEX = 0x2F, INT4
    BGNEXTN = 0x30, INT4
    ENDEXTN = 0x31, INT4
    STRCLASS = 0x34, BITS
    MBMSPATH = 0x56, NO_DATA


DATA: dict[int, int] = {record: record.data for record in GdsiiRecord}
NAMES: dict[int, str] = {record: record.name for record in GdsiiRecord}


def record_name(kind: int) -> str:
    """Name of a kind of record, or its number where the format has no such kind.

    Args:
        kind: number in the file.
    """
    return NAMES.get(kind, f"record 0x{kind:02x}")


TIMES = (
    1970,
    1,
    1,
    0,
    0,
    0,
) * 2  # last change, last access: the same bytes for the same mask
MOST_POINTS = 8190  # of one boundary, closing point included


def gdsii_real(value: float) -> bytes:
    """Excess-64 base-16 floating point: 1 sign bit, 7 bits of exponent, 56 bits of
    fraction.

    Args:
        value: any number.
    """
    if value == 0:
        return bytes(8)
    sign, value, exponent = 128 if value < 0 else 0, abs(value), 64
    while value >= 1:
        value, exponent = value / 16, exponent + 1
    while value < 1 / 16:
        value, exponent = value * 16, exponent - 1
    return bytes([sign | exponent]) + round(value * 2**56).to_bytes(7, "big")


def to_float(data: bytes) -> float:
    """Inverse of :func:`gdsii_real`.

    Args:
        data: 8 bytes.
    """
    fraction = int.from_bytes(data[1:8], "big") / 2**56
    return (-1.0 if data[0] & 128 else 1.0) * fraction * 16.0 ** ((data[0] & 127) - 64)


def gdsii_record(kind: int, data: bytes = b"") -> bytes:
    """One record: length, kind, data type, data."""
    return struct.pack(">HBB", 4 + len(data), kind, DATA[kind]) + data


def text_record(kind: int, value: str) -> bytes:
    """A record of text, filled to an even length with a zero.

    Args:
        kind: of the record.
        value: its text.
    """
    data = value.encode()
    return gdsii_record(kind, data + bytes(len(data) % 2))


def integer_record(kind: int, *values: int) -> bytes:
    """A record of 16-bit integers.

    Args:
        kind: of the record.
    """
    return gdsii_record(kind, struct.pack(f">{len(values)}h", *values))


def xy_record(xy: Array) -> bytes:
    """XY record of (n, 2) points.

    Args:
        xy: database units.
    """
    return gdsii_record(GdsiiRecord.XY, xy.astype(">i4").tobytes())


def library_head(name: str, unit_nm: float) -> bytes:
    """Everything before the first structure; user unit micrometre.

    Args:
        name: of the library.
        unit_nm: database unit.
    """
    head = (
        integer_record(GdsiiRecord.HEADER, 600)
        + integer_record(GdsiiRecord.BGNLIB, *TIMES)
        + text_record(GdsiiRecord.LIBNAME, name)
    )
    return head + gdsii_record(
        GdsiiRecord.UNITS, gdsii_real(unit_nm * 1e-3) + gdsii_real(unit_nm * 1e-9)
    )
