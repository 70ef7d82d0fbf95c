"""Elements of OASIS byte by byte, as SEMI P39 defines them: integers, reals, deltas,
point lists, repetitions.
"""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from layout.formats import oasis_records as oasis
from layout.formats import oasis_write
from layout.formats.oasis_cursor import ByteCursor
from layout.formats.oasis_write import g_delta
from metalens.core.errors import MaskFileError


def cursor(data):
    """At the first of some bytes, given as hexadecimal text or as they are."""
    raw = bytes.fromhex(data) if isinstance(data, str) else data
    return ByteCursor("FILE", np.frombuffer(raw, np.uint8))


@pytest.mark.parametrize(
    ("value", "data"),
    [
        (0, "00"),
        (1, "02"),
        (-1, "03"),
        (63, "7e"),
        (-63, "7f"),
        (64, "80 01"),
        (-64, "81 01"),
    ],
)
def test_signed_integers_have_their_sign_in_the_lowest_bit(value, data):
    assert oasis.signed_integer(value) == bytes.fromhex(data)
    assert cursor(data).signed() == value


@given(st.integers(-(2**31) + 1, 2**31 - 1))
def test_integers_come_back(value):
    assert cursor(oasis.signed_integer(value)).coordinate() == value
    assert cursor(oasis.unsigned_integer(abs(value))).unsigned() == abs(value)


@pytest.mark.parametrize(
    ("data", "value"),
    [
        ("00 03", 3.0),
        ("01 03", -3.0),
        ("02 08", 1 / 8),
        ("03 05", -1 / 5),
        ("04 05 0d", 5 / 13),
        ("05 05 0d", -5 / 13),
        ("06 00 00 20 c1", -10.0),  # IEEE single, little end first
        ("07 00 00 00 00 00 00 f4 3f", 1.25),  # IEEE double
    ],
)
def test_reals_of_all_eight_forms(data, value):
    assert cursor(data).real() == value


@pytest.mark.parametrize(
    ("value", "data"),
    [
        (1000.0, "00 e8 07"),
        (0.25, "02 04"),
        (0.3, None),
        (1.3, None),
        (2.5, None),
        (1e3 / 3, None),
        (-2.5, None),
    ],
)
def test_reals_are_written_in_their_shortest_exact_form(value, data):
    want = b"\7" + struct.pack("<d", value) if data is None else bytes.fromhex(data)
    assert oasis.oasis_real(value) == want
    assert cursor(want).real() == value


@pytest.mark.parametrize(
    ("data", "step"),
    [
        ("b0 02", (19, 0)),  # form 1: length 19 << 4 | direction << 1
        ("b2 02", (0, 19)),
        ("b4 02", (-19, 0)),
        ("b6 02", (0, -19)),
        ("b8 02", (19, 19)),
        ("ba 02", (-19, 19)),
        ("bc 02", (-19, -19)),
        ("be 02", (19, -19)),
        ("1d 16", (7, 11)),  # form 2: x << 2 | sign << 1 | 1, then y signed
        ("1f 17", (-7, -11)),
        ("1f 16", (-7, 11)),
    ],
)
def test_g_deltas_of_both_forms(data, step):
    assert cursor(data).delta() == step
    assert cursor(g_delta(*step)).delta() == step


@pytest.mark.parametrize(
    ("data", "corners"),
    [
        (
            "00 04 0e 0a 05 04",
            [(0, 0), (7, 0), (7, 5), (5, 5), (5, 7), (0, 7)],
        ),  # horizontal first, the last implied
        ("01 04 0a 0e 06 05", [(0, 0), (0, 5), (7, 5), (7, 8), (5, 8), (5, 0)]),
        (
            "02 03 1c 15 1e",
            [(0, 0), (7, 0), (7, 5), (0, 5)],
        ),  # 2-deltas: length << 2 | E N W S
        ("03 02 38 3c", [(0, 0), (7, 0), (14, 7)]),  # 3-deltas: also the diagonals
        ("04 02 1d 16 1f 16", [(0, 0), (7, 11), (0, 22)]),
        ("05 03 1d 16 01 03 01 03", [(0, 0), (7, 11), (14, 21), (21, 30)]),
    ],
)
def test_point_lists_of_all_types(data, corners):
    found = cursor(data).points()
    assert found.tolist() == [list(p) for p in corners]


def places(data, last=None, limit=1000):
    x, y = cursor(data).repetition(last, limit)
    return list(zip(x.tolist(), y.tolist(), strict=True))


@pytest.mark.parametrize(
    ("data", "read", "said"),
    [
        (
            "80 80 80 80 80 80 80 80 80 80 01",
            "unsigned",
            "integer of more than 9 bytes",
        ),
        ("80 80 80 80 40", "coordinate", "beyond 32 bits"),
        ("04 05 00", "real", "denominator 0"),
        ("08", "real", "form 8, need 0 to 7"),
        ("06 00 00", "real", "4 bytes are announced, 2 are left"),
        ("06 01 02 02", "points", "point list of type 6"),
        ("02 09 1c", "points", "point list of 9 points with 1 bytes left"),
        ("80", "byte_pair", "the file ends within a record"),
    ],
)
def test_what_the_format_does_not_allow_is_refused_by_name(data, read, said):
    at = cursor(data)
    with pytest.raises(MaskFileError, match=said):
        getattr(at, "unsigned" if read == "byte_pair" else read)()


def test_repetitions_beyond_a_limit_or_32_bits_are_refused():
    with pytest.raises(
        MaskFileError, match="12 x 7 = 84 copies, at most 83 more are read"
    ):
        places("01 0a 05 01 01", limit=83)
    assert len(places("01 0a 05 01 01", limit=84)) == 84
    with pytest.raises(MaskFileError, match="beyond 32 bits"):
        places("02 01 ff ff ff ff 07")


def test_placements_are_listed_from_each_to_the_next():
    out = np.zeros(200, np.uint8)
    child = np.array([5, 300, 5])
    x = np.array([-100, -93, -93])
    y = np.array([40, 40, 29])
    used = oasis_write.encode_list(child, x, y, np.array([0, 6, 3]), out)
    want = "11 f0 05 c9 01 50 10"  # (-100, 40), then relative
    # 7 to the right; turned by two quarters after a mirror; the same y is left out
    want += "11 e5 ac 02 0e"
    want += "11 d6 05 17 0f"  # 11 down; turned by three quarters; absolute
    assert out[:used].tobytes() == bytes.fromhex(want)


def test_bytes_are_packed_only_where_that_makes_them_fewer():
    """Noise, then runs of one letter: packed they are one byte more than as they are,
    as many, and fewer.
    """
    noise, more = np.random.default_rng(4).bytes(30), set()
    for run in range(30):
        raw = b"a" + noise + b"a" * run
        made = oasis.compressed_block(raw, 9)
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)
        size = 4 + len(
            packer.compress(raw) + packer.flush()
        )  # CBLOCK, type 0, and the two lengths
        more.add(size - len(raw))
        if made == raw:
            assert size >= len(raw)
            continue
        assert made[:4] == bytes([34, 0, len(raw), len(made) - 4])
        assert len(made) == size < len(raw)
        assert zlib.decompress(made[4:], -15) == raw
    assert {-1, 0, 1} < more


def test_the_end_record_has_256_bytes_and_the_checksum_of_all_before():
    before = b"anything"
    data = oasis.end_record((300, 0, 0, 0, 17, 0), zlib.crc32(before))
    assert len(data) == oasis.END_SIZE == 256
    assert data[:12] == bytes.fromhex("02 01 ac 02 01 00 01 00 01 00 01 11")
    assert data[-5] == 1  # CRC-32
    assert struct.unpack("<I", data[-4:])[0] == zlib.crc32(before + data[:-4])
