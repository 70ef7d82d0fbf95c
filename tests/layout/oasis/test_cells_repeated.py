"""Copies of an OASIS repetition lie within 32 bits on either side."""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.oasis import Cursor, cells
from layout.oasis import bytes as oasis


class Bytes:
    """A cursor at a repetition that has been read already."""

    def __init__(self, x, y):
        self.moved = SimpleNamespace(x=np.array(x, np.int64), y=np.array(y, np.int64))

    def repetition(self, before, left):
        return self.moved

    def within(self, value):
        if abs(value) > 2**31 - 1:
            raise ValueError(f"{value} is beyond")
        return value


def places(x, y, at):
    made = SimpleNamespace(
        modal=SimpleNamespace(repetition=None), budget=SimpleNamespace(left=9)
    )
    return cells.CellReader._repeated(made, Bytes(x, y), 0x08, 0x08, *at)


def test_copies_are_moved_from_their_start():
    x, y = places([0, 40, -70], [0, -5, 9], (100, -200))
    assert x.tolist() == [100, 140, 30]
    assert y.tolist() == [-200, -205, -191]


@pytest.mark.parametrize(
    ("x", "y", "at"),
    [
        ([0, -50, -9], [0, 0, 0], (-(2**31) + 20, 0)),
        ([0, 50, 9], [0, 0, 0], (2**31 - 20, 0)),
        ([0, 0, 0], [0, -50, -9], (0, -(2**31) + 20)),
        ([0, 0, 0], [0, 50, 9], (0, 2**31 - 20)),
    ],
)
def test_a_copy_beyond_32_bits_is_refused_on_every_side(x, y, at):
    with pytest.raises(ValueError, match="beyond"):
        places(x, y, at)


def test_cells_placed_by_name_are_told_apart():
    """Two names and one of them again, each with its place, beside a cell by number
    (SEMI P39: CNXYRAAF, x, y).
    """
    rods, dots = (bytes([0xB0, 4]) + name for name in (b"rods", b"dots"))
    raw = (
        rods
        + bytes([6, 10])
        + dots
        + bytes([14, 3])
        + bytes([0xF0, 6, 4, 18])
        + rods
        + bytes([22, 26])
    )
    cursor, reader = (
        Cursor("FILE", np.frombuffer(raw, np.uint8)),
        cells.CellReader(cells.OpenCell(0), cells.Budget(9)),
    )
    for _ in range(4):
        assert reader.record(cursor, oasis.PLACEMENT)
    placed = reader.cell.close("TOP", {6: "rings"}).placed
    told = [
        (placed.children[i], int(x), int(y))
        for i, x, y in zip(placed.child, placed.x, placed.y, strict=True)
    ]
    assert sorted(told) == [
        ("dots", 7, -1),
        ("rings", 2, 9),
        ("rods", 3, 5),
        ("rods", 11, 13),
    ]


def signed(value):
    """As SEMI P39 7.2.2 has it: the sign in the lowest bit, seven bits a byte."""
    number, raw = abs(value) << 1 | (value < 0), []
    while number > 0x7F:
        raw.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*raw, number])


def test_relative_places_add_to_those_before_of_shapes_placements_and_texts_each_their_own():
    """Rectangles SWHXYRDL, circles 00rXYRDL, placements CNXYRAAF, texts 0CNXYRTL (SEMI
    P39 22 to 33).

    A rectangle takes as much room as 8 placements and its 4 corners, a circle as 8 and
    its middle.
    """
    records = (
        (oasis.RECTANGLE, bytes([0x7B, 5, 2, 30, 11]) + signed(100) + signed(-20)),
        (oasis.PLACEMENT, bytes([0xF0, 6]) + signed(1000) + signed(-70)),
        (oasis.XYRELATIVE, b""),
        (oasis.RECTANGLE, b"\x10" + signed(7)),
        (oasis.RECTANGLE, b"\x08" + signed(-3)),
        (oasis.CIRCLE, bytes([0x38, 9]) + signed(-50) + signed(4)),
        (oasis.PLACEMENT, b"\x30" + signed(3) + signed(5)),
        (oasis.PLACEMENT, b"\x20" + signed(-13)),
        (oasis.TEXT, bytes([0x7B, 0, 1, 1]) + signed(9) + signed(2)),
        (oasis.TEXT, b"\x18" + signed(4) + signed(6)),
        (oasis.XYABSOLUTE, b""),
        (oasis.RECTANGLE, b"\x10" + signed(1)),
    )
    cursor = Cursor(
        "FILE", np.frombuffer(b"".join(raw for _, raw in records), np.uint8)
    )
    reader = cells.CellReader(cells.OpenCell(0), cells.Budget(90))
    assert all(reader.record(cursor, kind) for kind, _ in records)
    found = reader.cell.close("TOP", {6: "rings"})
    corners = [shape[0].tolist() for shape in found.polygons[5, 2]]
    assert corners == [[100, -20], [107, -20], [107, -23], [1, -19]]
    assert all(
        np.ptp(shape, axis=0).tolist() == [30, 11] for shape in found.polygons[5, 2]
    )
    assert found.circles == {(5, 2): [(57, -19, 9)]}
    placed = found.placed
    assert list(zip(placed.x.tolist(), placed.y.tolist(), strict=True)) == [
        (1000, -70),
        (1003, -65),
        (990, -65),
    ]
    assert (reader.modal.text_x, reader.modal.text_y) == (13, 8)
    assert found.texts == 2
    assert reader.budget.used == 4 * (8 + 4) + (8 + 1) + 3 + 2
    assert reader.budget.left == 90 - reader.budget.used
