"""Records of the GDSII stream format: numbers, kinds, and what data each kind carries."""

import struct

from metalens.core.arrays import Array

HEADER, BGNLIB, LIBNAME, UNITS, ENDLIB, BGNSTR, STRNAME, ENDSTR = range(8)
BOUNDARY, PATH, SREF, AREF, TEXT, LAYER, DATATYPE, WIDTH, XY, ENDEL, SNAME = range(
    8, 19
)
COLROW, NODE, TEXTTYPE, PRESENTATION, STRING, STRANS, MAG, ANGLE = (
    0x13,
    0x15,
    0x16,
    0x17,
    0x19,
    0x1A,
    0x1B,
    0x1C,
)
BGNEXTN, ENDEXTN, STRCLASS, MBMSPATH = 0x30, 0x31, 0x34, 0x56
PATHTYPE, ELFLAGS, NODETYPE, PROPATTR, PROPVALUE, BOX, BOXTYPE, PLEX = (
    0x21,
    0x26,
    0x2A,
    0x2B,
    0x2C,
    0x2D,
    0x2E,
    0x2F,
)

NO_DATA, BITS, INT2, INT4, REAL8, ASCII = 0, 1, 2, 3, 5, 6
# fmt: off
_KINDS = {
    NO_DATA: (ENDLIB, ENDSTR, BOUNDARY, PATH, SREF, AREF, TEXT, ENDEL, BOX, NODE,
              MBMSPATH),
    BITS: (PRESENTATION, STRANS, ELFLAGS, STRCLASS),
    INT2: (HEADER, BGNLIB, BGNSTR, LAYER, DATATYPE, COLROW, TEXTTYPE, PATHTYPE,
           PROPATTR, BOXTYPE, NODETYPE),
    INT4: (WIDTH, XY, BGNEXTN, ENDEXTN, PLEX),
    REAL8: (UNITS, MAG, ANGLE),
    ASCII: (LIBNAME, STRNAME, SNAME, STRING, PROPVALUE),
}
# fmt: on
DATA = {kind: data for data, kinds in _KINDS.items() for kind in kinds}
NAMES = {
    value: name
    for name, value in list(globals().items())
    if name.isupper() and isinstance(value, int)
}

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
    return gdsii_record(XY, xy.astype(">i4").tobytes())


def library_head(name: str, unit_nm: float) -> bytes:
    """Everything before the first structure; user unit micrometre.

    Args:
        name: of the library.
        unit_nm: database unit.
    """
    head = (
        integer_record(HEADER, 600)
        + integer_record(BGNLIB, *TIMES)
        + text_record(LIBNAME, name)
    )
    return head + gdsii_record(
        UNITS, gdsii_real(unit_nm * 1e-3) + gdsii_real(unit_nm * 1e-9)
    )
