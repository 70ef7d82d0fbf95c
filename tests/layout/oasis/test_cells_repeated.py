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
    made = SimpleNamespace(modal=SimpleNamespace(repetition=None), budget=SimpleNamespace(left=9))
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
    """Two names and one of them again, each with its place, beside a cell by number (SEMI P39: CNXYRAAF, x, y)."""
    rods, dots = (bytes([0xB0, 4]) + name for name in (b"rods", b"dots"))
    raw = rods + bytes([6, 10]) + dots + bytes([14, 3]) + bytes([0xF0, 6, 4, 18]) + rods + bytes([22, 26])
    cursor, reader = Cursor("FILE", np.frombuffer(raw, np.uint8)), cells.CellReader(cells.OpenCell(0), cells.Budget(9))
    for _ in range(4):
        assert reader.record(cursor, oasis.PLACEMENT)
    placed = reader.cell.close("TOP", {6: "rings"}).placed
    told = [(placed.children[i], int(x), int(y)) for i, x, y in zip(placed.child, placed.x, placed.y, strict=True)]
    assert sorted(told) == [("dots", 7, -1), ("rings", 2, 9), ("rods", 3, 5), ("rods", 11, 13)]
