"""GDSII bytes against the Stream Format Manual 6.0: kinds of records, excess-64
numbers, both units.
"""

import struct
from dataclasses import replace

import pytest

from layout.gdsii import bytes as gds
from layout.gdsii import write as gdsii_write

# first byte the kind, second the kind of its data, as the manual prints them
MANUAL = """
HEADER 0002 BGNLIB 0102 LIBNAME 0206 UNITS 0305 ENDLIB 0400 BGNSTR 0502 STRNAME 0606 ENDSTR 0700 BOUNDARY 0800 PATH 0900
SREF 0A00 AREF 0B00 TEXT 0C00 LAYER 0D02 DATATYPE 0E02 WIDTH 0F03 XY 1003 ENDEL 1100 SNAME 1206 COLROW 1302 NODE 1500
TEXTTYPE 1602 PRESENTATION 1701 STRING 1906 STRANS 1A01 MAG 1B05 ANGLE 1C05 PATHTYPE 2102 ELFLAGS 2601 NODETYPE 2A02
PROPATTR 2B02 PROPVALUE 2C06 BOX 2D00 BOXTYPE 2E02 PLEX 2F03 BGNEXTN 3003 ENDEXTN 3103
"""
RECORDS = MANUAL.split()
REALS = [
    (0.0, "0000000000000000"),
    (1.0, "4110000000000000"),
    (-2.5, "C128000000000000"),
    (16.0, "4210000000000000"),
    (1 / 16, "4010000000000000"),
    (-1 / 256, "BF10000000000000"),
    (1e-3, "3E4189374BC6A7F0"),
    (1e-9, "3944B82FA09B5A54"),
    (90.0, "425A000000000000"),
]


@pytest.mark.parametrize(
    ("name", "code"), list(zip(RECORDS[::2], RECORDS[1::2], strict=True))
)
def test_records_are_those_of_the_manual(name, code):
    kind = getattr(gds, name)
    assert f"{kind:02X}{gds.DATA[kind]:02X}" == code
    assert gds.record(kind, b"ab") == bytes([0, 6, kind, gds.DATA[kind]]) + b"ab"


@pytest.mark.parametrize(("value", "code"), REALS)
def test_numbers_are_those_of_the_manual(value, code):
    """A sign, an exponent of 16 with excess 64, a fraction of 56 bits from 1/16 to 1."""
    made = gds.real(value)
    assert made[:7].hex().upper() == code[:14]
    assert abs(made[7] - int(code[14:], 16)) <= 8  # floats hold 53 bits of the 56
    assert gds.to_float(bytes.fromhex(code)) == pytest.approx(value, rel=2e-16)
    assert gds.to_float(made) == value


def test_shorts_points_and_text_lie_big_end_first():
    assert gds.shorts(gds.COLROW, 3, -2) == bytes.fromhex("0008 1302 0003 FFFE")
    assert gds.text(gds.SNAME, "abc") == bytes.fromhex("0008 1206 616263 00")
    assert gds.text(gds.SNAME, "ab") == bytes.fromhex("0006 1206 6162")


@pytest.mark.parametrize("unit_nm", [1.0, 0.5])
def test_a_unit_is_told_in_micrometres_and_in_metres(plan, tmp_path, unit_nm):
    gdsii_write.write(replace(plan, unit_nm=unit_nm), tmp_path / "m.gds")
    data = (tmp_path / "m.gds").read_bytes()
    at = data.index(bytes.fromhex("0014 0305"))
    user, metres = (gds.to_float(data[at + k : at + k + 8]) for k in (4, 12))
    assert user == pytest.approx(
        unit_nm * 1e-3, rel=1e-15
    )  # user units are micrometres
    assert metres == pytest.approx(unit_nm * 1e-9, rel=1e-15)
    assert struct.unpack(">h", data[4:6]) == (600,)
