"""Copies of an OASIS repetition lie within 32 bits on either side."""

from types import SimpleNamespace

import numpy as np
import pytest

from layout.oasis import cells


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
