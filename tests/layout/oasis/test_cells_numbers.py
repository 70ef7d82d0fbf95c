"""Records of an OASIS cell field by field: every bit of the info byte reads its own
field and leaves the others.
"""

import numpy as np
import pytest

from layout.oasis import Cursor, cells
from layout.oasis import bytes as oasis
from layout.oasis.cursor import Repetition

TWICE = bytes(
    [4, 0, 70]
)  # a repetition of two copies, 70 apart along x: one step, count less 2
BEFORE = {
    "layer": 3, "datatype": 4, "width": 50, "height": 20, "radius": 31, "half_width": 6, "kind": 25, "child": 9,
    "x": 1000, "y": -2000, "text_x": 300, "text_y": 400, "placement_x": -500, "placement_y": 600, "path_ends": (2, 1),
}  # fmt: skip
SHAPE = {
    0x01: (b"\x11", {"layer": 17}),
    0x02: (b"\x12", {"datatype": 18}),
    0x04: (TWICE, {"repetition": [[0, 0], [70, 0]]}),
    0x08: (b"\x0e", {"y": 7}),
    0x10: (b"\x0b", {"x": -5}),
}
SIZE = {0x40: (b"\x29", {"width": 41}), 0x20: (b"\x1f", {"height": 31})}
RECTANGLE = SHAPE | SIZE | {0x80: (b"", {"height": 50})}
POLYGON = SHAPE | {
    0x20: (bytes([0, 2, 10, 6]), {"points": [[0, 0], [5, 0], [5, 3], [0, 3]]})
}
PATH = SHAPE | {
    0x20: (bytes([0, 2, 18, 8]), {"path_points": [[0, 0], [9, 0], [9, 4]]}),
    0x40: (b"\x0d", {"half_width": 13}),
    0x80: (b"\x0a", {"path_ends": (6, 6)}),
}
LEANING = SHAPE | SIZE | {0x80: (b"", {})}
COMPACT = SHAPE | SIZE | {0x80: (b"\x18", {"kind": 24})}
CIRCLE = SHAPE | {0x20: (b"\x2b", {"radius": 43})}
TEXT = {
    0x01: (b"\x05", {}),
    0x02: (b"\x06", {}),
    0x04: (TWICE, {"repetition": [[0, 0], [70, 0]]}),
    0x08: (b"\x0e", {"text_y": 7}),
    0x10: (b"\x0b", {"text_x": -5}),
    0x40: (b"\x02ab", {}),
    0x60: (b"\x09", {}),
}
PLACED = {
    0x08: (TWICE, {"repetition": [[0, 0], [70, 0]]}),
    0x10: (b"\x0e", {"placement_y": 7}),
    0x20: (b"\x0b", {"placement_x": -5}),
    0x80: (b"\x02ab", {"child": "ab"}),
    0xC0: (b"\x0c", {"child": 12}),
}
PLAIN = PLACED | {bit: (b"", {}) for bit in (1, 2, 4, 6)}
ANY = PLACED | {1: (b"", {}), 2: (b"\x00\x1e", {}), 4: (b"\x00\x03", {})}
RECORDS = (
    (oasis.RECTANGLE, RECTANGLE, b""), (oasis.POLYGON, POLYGON, b""), (oasis.PATH, PATH, b""),
    (oasis.TRAPEZOID, LEANING, b"\x04\x05"), (oasis.TRAPEZOID_A, LEANING, b"\x04"),
    (oasis.TRAPEZOID_B, LEANING, b"\x05"), (oasis.CTRAPEZOID, COMPACT, b""), (oasis.CIRCLE, CIRCLE, b""),
    (oasis.TEXT, TEXT, b""), (oasis.PLACEMENT, PLAIN, b""), (oasis.PLACEMENT_ANY, ANY, b""),
)  # fmt: skip


def reader():
    made = cells.CellReader(cells.OpenCell(0), cells.Budget(1000))
    for name, value in BEFORE.items():
        setattr(made.modal, name, value)
    made.modal.points = np.array([[0, 0], [8, 0], [8, 2], [0, 2]])
    made.modal.path_points = np.array([[0, 0], [30, 0]])
    made.modal.repetition = Repetition(np.array([0, 3]), np.array([0, 4]))
    return made


def state(made):
    """Values of the modal record, arrays as lists."""
    names = (*BEFORE, "points", "path_points")
    found = {name: getattr(made.modal, name) for name in names}
    found = {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in found.items()
    }
    again = made.modal.repetition
    return found | {"repetition": np.column_stack([again.x, again.y]).tolist()}


@pytest.mark.parametrize(
    ("kind", "bit", "field", "always", "changed"),
    [
        (kind, bit, *fields[:1], always, fields[1])
        for kind, table, always in RECORDS
        for bit, fields in table.items()
    ],
)
def test_a_bit_reads_its_own_field_and_no_other(kind, bit, field, always, changed):
    """Fields come in one order: layer and sizes, then what a trapezoid always holds,
    then place and repetition.
    """
    raw = always + field if bit in (0x04, 0x08, 0x10) else field + always
    made = reader()
    cursor = Cursor("FILE", np.frombuffer(bytes([bit]) + raw, np.uint8))
    before = state(made)
    assert made.record(cursor, kind)
    assert cursor.left == 0
    assert state(made) == before | changed
    drawn = 2 if field == TWICE else 1
    shapes = [shape for held in made.cell.polygons.values() for shape in held]
    circles = [shape for held in made.cell.circles.values() for shape in held]
    assert len(shapes) + len(circles) + made.cell.texts + made.cell.held.count == drawn
    if shapes or circles:
        after = made.modal
        assert {*made.cell.polygons, *made.cell.circles} == {
            (after.layer, after.datatype)
        }


@pytest.mark.parametrize(
    ("scheme", "more", "ends"),
    [
        (0b0000, b"", (2, 1)), (0b0101, b"", (0, 0)), (0b1010, b"", (6, 6)), (0b1111, b"\x08\x0b", (4, -5)),
        (0b0110, b"", (0, 6)), (0b1001, b"", (6, 0)), (0b1101, b"\x0b", (-5, 0)), (0b0011, b"\x08", (2, 4)),
        (0b0001, b"", (2, 0)), (0b0100, b"", (0, 1)),
    ],
)  # fmt: skip
def test_ends_of_a_path_are_as_before_flush_half_its_width_or_told(scheme, more, ends):
    cursor = Cursor("FILE", np.frombuffer(more, np.uint8))
    assert reader()._ends(cursor, scheme) == ends
    assert cursor.left == 0
    fresh = cells.CellReader(cells.OpenCell(0), cells.Budget(9))
    assert fresh._ends(Cursor("FILE", np.frombuffer(more, np.uint8)), 0b0010) == (0, 0)


def test_trapezoids_lean_along_x_or_along_y():
    """Of 50 x 20: sides moved by 2 below and by -3 above (the bytes 4 and 7), or on the
    left and the right.
    """
    raw = (
        bytes([0])
        + b"\x04\x07"
        + bytes([0x80])
        + b"\x04\x07"
        + bytes([0])
        + b"\x04"
        + bytes([0])
        + b"\x07"
    )
    made, cursor = reader(), Cursor("FILE", np.frombuffer(raw, np.uint8))
    for kind in (
        oasis.TRAPEZOID,
        oasis.TRAPEZOID,
        oasis.TRAPEZOID_A,
        oasis.TRAPEZOID_B,
    ):
        made.record(cursor, kind)
    areas = []
    for shape in made.cell.polygons[3, 4]:
        x, y = (shape - [1000, -2000]).T.astype(float)
        areas.append(abs(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2)
    assert areas == pytest.approx(
        [20 * (50 - 2.5), 50 * (20 - 2.5), 20 * (50 - 1), 20 * (50 - 1.5)]
    )


def test_placements_are_turned_mirrored_and_scaled_as_told():
    """Quarters by AAF of a plain one; of any other a scale of 3 and 30 degrees, then a
    scale alone.
    """
    raw = (
        bytes([0x03])
        + bytes([0x06])
        + bytes([0x07, 0, 3, 0, 30])
        + bytes([0x04, 0, 2])
        + bytes([0x02, 1, 30])
    )
    made, cursor = reader(), Cursor("FILE", np.frombuffer(raw, np.uint8))
    for kind in (oasis.PLACEMENT, oasis.PLACEMENT, *[oasis.PLACEMENT_ANY] * 3):
        made.record(cursor, kind)
    assert cursor.left == 0
    placed = made.cell.close("TOP", {9: "child"}).placed
    turns = [placed.turns[int(k)] for k in placed.turn]
    told = [(turn.angle_deg, turn.mirrored, turn.scale) for turn in turns]
    assert told == [
        (90, True, 1),
        (270, False, 1),
        (30, True, 3),
        (0, False, 2),
        (330, False, 1),
    ]
