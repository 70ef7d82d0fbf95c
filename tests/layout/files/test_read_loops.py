"""The compiled readers of placements beside bytes put together as the two formats'
manuals print them.
"""

import struct

import numpy as np
import pytest

from layout.files import read_loops

FARTHEST = 2**31 - 1
STEPS = [
    (1, 0),
    (0, 1),
    (-1, 0),
    (0, -1),
    (1, 1),
    (-1, 1),
    (-1, -1),
    (1, -1),
]  # east, north, west, south, ne, nw, ..


def data(*parts):
    return np.frombuffer(b"".join(parts), np.uint8)


def unsigned(n):
    """Seven bits a byte, the lowest first; all but the last have the eighth."""
    low, n = [n & 127], n >> 7
    while n:
        low[-1] |= 128
        low, n = [*low, n & 127], n >> 7
    return bytes(low)


def signed(n):
    return unsigned(abs(n) << 1 | (n < 0))


@pytest.mark.parametrize("n", [0, 5, 127, 128, 300, 2**31 - 1, 2**35 + 77, 2**42 - 1])
def test_integers_of_seven_bits_a_byte(n):
    code = unsigned(n)
    whole = data(b"\xff\x81", code, b"\x03")
    assert read_loops.unsigned_at(whole, 2, len(whole)) == (n, 2 + len(code))
    assert read_loops.unsigned_at(whole, 2, 2 + len(code)) == (n, 2 + len(code))
    assert read_loops.unsigned_at(whole, 2, 1 + len(code)) == (0, -1)  # cut


def test_an_integer_of_seven_bytes_is_none():
    assert read_loops.unsigned_at(data(unsigned(2**42)), 0, 7) == (0, -1)


def placement(number=None, x=None, y=None, quarters=0, flip=False):
    """PLACEMENT by reference number: the info byte CNXYRAAF, then what it says is
    there.
    """
    info = (
        0xC0 * (number is not None)
        | 0x20 * (x is not None)
        | 0x10 * (y is not None)
        | quarters << 1
        | flip
    )
    some = [
        b"" if number is None else unsigned(number),
        *(b"" if v is None else signed(v) for v in (x, y)),
    ]
    return bytes([17, info]) + b"".join(some)


def placed(*records, state=(0, 0, 0, -1), most=9):
    whole, now, out = (
        data(b"\x11", *records),
        np.array(state, np.int64),
        np.full((4, most), -9, np.int64),
    )
    at, count = read_loops.placements(whole, 1, len(whole), now, out)
    return (
        at - 1,
        [tuple(row) for row in out[:, :count].T.tolist()],
        tuple(now.tolist()),
    )


RUN = (
    placement(300, 100, -7, 1, flip=True),
    placement(x=-50),
    b"\x10",  # XYRELATIVE
    placement(y=9, quarters=3),
    placement(2, -1, 1000, flip=True),
    b"\x0f",  # XYABSOLUTE
    placement(x=320, quarters=2),
)
WANT = [
    (300, 100, -7, 5),
    (300, -50, -7, 0),
    (300, -50, 2, 3),
    (2, -51, 1002, 4),
    (2, 320, 1002, 2),
]


def test_placements_in_both_modes_of_coordinates():
    other = b"\x14\x00"
    assert placed(*RUN, other) == (sum(map(len, RUN)), WANT, (320, 1002, 0, 2))
    assert placed(*RUN[:4], state=(8, 6, 1, 5)) == (
        sum(map(len, RUN[:4])),
        [(300, 108, -1, 5), (300, 58, -1, 0), (300, 58, 8, 3)],
        (58, 8, 1, 300),
    )
    assert placed(*RUN, most=2)[:2] == (sum(map(len, RUN[:2])), WANT[:2])  # full


@pytest.mark.parametrize(
    "last",
    [
        b"\x11\x28\x02",  # with a repetition
        b"\x11\x80\x01A",  # by name
        placement(FARTHEST + 1, 3, 4),
        placement(1, FARTHEST - 99, 4),  # 100 + FARTHEST - 99, relative
        placement(1, 3, -FARTHEST + 6),  # -7 - FARTHEST + 6
        placement(1, 3, 400)[:-1],  # cut
        placement(1, 300, 4)[:-2],
        placement(300)[:-1],
        b"\x11",
    ],
)
def test_a_placement_of_another_kind_or_a_broken_one_is_left(last):
    before = placement(3, 100, -7), b"\x10"
    assert placed(*before, last) == (
        sum(map(len, before)),
        [(3, 100, -7, 0)],
        (100, -7, 1, 3),
    )


def test_places_as_far_as_32_bits_go_and_none_before_a_cell():
    assert placed(placement(FARTHEST, FARTHEST, -FARTHEST))[1] == [
        (FARTHEST, FARTHEST, -FARTHEST, 0)
    ]
    assert placed(placement(x=3, y=4)) == (
        0,
        [],
        (0, 0, 0, -1),
    )  # no cell was placed before


def deltas(*codes, grid=1, start=(0, 0), ends=0):
    whole, n = data(b"\xff", *codes), len(codes) + 1
    x, y = np.zeros(n, np.int64), np.zeros(n, np.int64)
    x[0], y[0] = start
    return (
        read_loops.deltas(whole, 1, len(whole) - ends, grid, x, y) - 1,
        x.tolist(),
        y.tolist(),
    )


def along(direction, size):
    return unsigned(size << 4 | direction << 1)


def across(dx, dy):
    return unsigned(abs(dx) << 2 | (dx < 0) << 1 | 1) + signed(dy)


def test_deltas_of_a_repetition_add_up():
    """Eight directions, and any step; times the grid of the repetition."""
    sizes = [3, 5, 70, 11, 130, 17, 19, 2300]
    free = [(-6, 50), (7, -800), (0, 3), (90, 0)]
    codes = [along(k, size) for k, size in enumerate(sizes)] + [
        across(*step) for step in free
    ]
    steps = np.array(
        [np.multiply(STEPS[k], size) for k, size in enumerate(sizes)] + free
    )
    at, x, y = deltas(*codes, grid=3, start=(40, -9))
    assert at == sum(map(len, codes))
    assert x == [40, *(40 + 3 * steps[:, 0].cumsum()).tolist()]
    assert y == [-9, *(-9 + 3 * steps[:, 1].cumsum()).tolist()]


@pytest.mark.parametrize(
    ("code", "dx", "dy"),
    [
        (along(0, 9), 9, 0),
        (along(3, 9), 0, -9),
        (across(9, 0), 9, 0),
        (across(0, -9), 0, -9),
    ],
)
def test_deltas_end_where_32_bits_end(code, dx, dy):
    """Two times 9 lead to the last place there is, and from one nearer to it beyond."""
    x, y = (FARTHEST - 18) * (dx > 0), (18 - FARTHEST) * (dy < 0)
    assert deltas(code, grid=2, start=(x, y)) == (
        len(code),
        [x, x + 2 * dx],
        [y, y + 2 * dy],
    )
    assert deltas(code, grid=2, start=(x + (dx > 0), y - (dy < 0)))[0] == -2


def test_cut_deltas_and_steps_beyond_32_bits_are_refused():
    assert deltas(across(3, 400), ends=1)[0] == -2
    assert deltas(along(2, 400), ends=1)[0] == -2
    assert deltas(across(300, 4), ends=2)[0] == -2
    assert deltas(along(0, FARTHEST + 1), start=(-9, 0))[0] == -2
    assert deltas(across(0, -FARTHEST - 1), start=(0, 9))[0] == -2


def sref(name, x, y):
    """SREF, SNAME, XY and ENDEL, big end first."""
    head = struct.pack(">HHHH", 4, 0x0A00, 4 + len(name), 0x1206)
    return head + name + struct.pack(">HHiiHH", 12, 0x1003, x, y, 4, 0x1100)


END = struct.pack(">HH", 4, 0x0700)


def run(*records, before=b"\0\4"):
    whole = data(before, *records)
    names, child, x, y, at = read_loops.sref_run(whole, len(before))
    found = [
        (names[k], a, b)
        for k, a, b in zip(child.tolist(), x.tolist(), y.tolist(), strict=True)
    ]
    return found, at - len(before), names


def test_references_of_one_length_of_name():
    want = [
        (b"ABCD", 3, -70000),
        (b"XY\0\0", -(2**31), 2**31 - 1),
        (b"ABCD", 256, -1),
        (b"ABCE", -256, 65535),
    ]
    records = [sref(*one) for one in want]
    for rest in (
        END,
        sref(b"LONGER", 1, 2),
        sref(b"", 5, 6),
        b"\0\4\x0b\0\0\x08\x12\6ABCD",
        records[0][:-1],
    ):
        assert run(*records, rest) == (
            want,
            sum(map(len, records)),
            [b"ABCD", b"XY\0\0", b"ABCE"],
        )


def test_names_share_slots_of_the_table():
    """Some 3000 names in a table of 16384 slots: a quarter of them find theirs taken."""
    rng = np.random.default_rng(3)
    want = [
        (b"%04X" % k, int(x), int(y))
        for k, (x, y) in zip(
            rng.permutation(3000), rng.integers(-99, 99, (3000, 2)), strict=True
        )
    ]
    want += want[1::7]
    found, at, names = run(*(sref(*one) for one in want), END)
    assert found == want
    assert at == 28 * len(want)
    assert len(names) == len(set(names)) == 3000


@pytest.mark.parametrize("place", [*range(0, 8), *range(12, 16), *range(24, 28)])
def test_any_other_byte_of_the_records_ends_the_run(place):
    """But those of name and coordinates: a turned reference, one with properties, an
    array.
    """
    good = sref(b"ABCD", 3, -70000)
    bad = bytearray(good)
    bad[place] ^= 32
    assert run(good, bytes(bad), good, END)[:2] == ([(b"ABCD", 3, -70000)], len(good))


def test_no_reference_no_run():
    for rest in (END * 9, b"\0\4\x0a\0\0", sref(b"", 5, 6) + END, b""):
        assert run(rest)[:2] == ([], 0)
