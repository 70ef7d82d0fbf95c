"""References to pillars by the bytes of the format's book: SREF, SNAME, XY, ENDEL,
whatever fits a buffer.
"""

import dataclasses
import struct

import numpy as np
import pytest

from layout.gdsii import write
from layout.mask import Lattice

NAMES = {"words of two bytes": ("D1", "D2", "D3"), "of four": ("D007", "D019", "D123")}
SITES = np.array(
    [[0, 2, 0, 1, 3], [1, 0, 0, 0, 0], [0, 0, 0, 0, 0], [3, 3, 2, 1, 1]], np.uint8
)
LATTICE = dataclasses.replace(
    Lattice.of("LENS", SITES, pitch=331, x0=-70_000, y0=2_100), row_pitch=287
)


def reference(name, x, y):
    """Records as length, type and kind of the data, big-endian, lengths with these four
    bytes.
    """
    named = name.encode() + b"\0" * (len(name) % 2)
    text = struct.pack(">HH", 4 + len(named), 0x1206) + named
    return (
        struct.pack(">HH", 4, 0x0A00)
        + text
        + struct.pack(">HHii", 12, 0x1003, x, y)
        + struct.pack(">HH", 4, 0x1100)
    )


def test_a_buffer_is_filled_to_its_end_and_tells_where_it_left_off():
    """Head of a class, x of the column, y of the row, tail of the class; three of the
    nine, then the other six.
    """
    templates = np.array(
        [[10, 11, 0, 0, 14], [20, 21, 0, 0, 24], [30, 31, 0, 0, 34]], np.uint32
    )
    xs, ys = (
        np.arange(100, 105, dtype=np.uint32)[:, None],
        np.arange(200, 204, dtype=np.uint32)[:, None],
    )
    want = [
        (10 * SITES[r, c], 10 * SITES[r, c] + 1, 100 + c, 200 + r, 10 * SITES[r, c] + 4)
        for r, c in np.argwhere(SITES)
    ]
    few, rest = np.zeros((3, 5), np.uint32), np.zeros((8, 5), np.uint32)
    assert write._fill(few, SITES, 0, 0, templates, xs, ys) == (
        1,
        0,
        3,
    )  # the next that finds no room
    assert few.tolist() == [list(row) for row in want[:3]]
    assert write._fill(rest, SITES, 1, 0, templates, xs, ys) == (4, 0, 6)
    assert rest.tolist() == [list(row) for row in want[3:]] + [[0] * 5] * 2


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize("fit", [1, 3, 4, 9, 40])
def test_every_site_is_one_reference_row_by_row_however_few_a_buffer_holds(
    monkeypatch, names, fit
):
    """Nine sites; a buffer that is full in the middle of a row goes on there, and the
    last piece is what is left.
    """
    length = len(reference(names[0], 0, 0))
    monkeypatch.setattr(write, "_BLOCK", fit * length)
    counts = np.zeros(4, np.int64)
    pieces = [bytes(piece) for piece in write.references(names, LATTICE, counts)]
    want = [
        reference(
            names[SITES[row, column] - 1], -70_000 + 331 * column, 2_100 - 287 * row
        )
        for row, column in np.argwhere(SITES).tolist()
    ]
    assert b"".join(pieces) == b"".join(want)
    assert [len(piece) // length for piece in pieces] == [fit] * (9 // fit) + [
        9 % fit
    ] * (9 % fit > 0)
    assert counts.tolist() == [11, 4, 2, 3]


def test_a_piece_stays_until_the_next_but_one_is_asked_for(monkeypatch):
    """It is being written while the next is made."""
    monkeypatch.setattr(write, "_BLOCK", 2 * len(reference("D1", 0, 0)))
    made = write.references(("D1", "D2", "D3"), LATTICE, np.zeros(4, np.int64))
    first = next(made)
    kept = bytes(first)
    second = bytes(next(made))
    assert bytes(first) == kept != second
