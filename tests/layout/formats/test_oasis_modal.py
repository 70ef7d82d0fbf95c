"""Modal variables, elements and repetitions of OASIS from bytes written by hand after
SEMI P39; expected corners are worked out from its text, KLayout reads the same file.
"""

import numpy as np
import pytest

import layout
from metalens.core.errors import MaskFileError


def u(value):
    """Unsigned integer: 7 bits a byte, least significant first."""
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def s(value):
    """Signed integer: the sign in the lowest bit."""
    return u(abs(value) << 1 | (value < 0))


def text(data):
    return u(len(data)) + data


def g(dx, dy):
    """g-delta of the second form."""
    return u(abs(dx) << 2 | (dx < 0) << 1 | 1) + s(dy)


CELL_A = b"\x0e" + text(b"A")
START = b"%SEMI-OASIS\r\n\x01" + text(b"1.0") + b"\0" + u(1000) + u(0) + bytes(12)
END = b"\x02" + u(252) + bytes(252) + b"\0"


def oasis(*records):
    return START + b"".join(records) + END


def box(x, y, width, height):
    return [(x, y), (x + width, y), (x + width, y + height), (x, y + height)]


def moved(points, *places):
    return [[(x + dx, y + dy) for x, y in points] for dx, dy in places]


RECTANGLE = b"\x14\x7b" + u(1) + u(2) + u(500) + u(100) + s(10) + s(-20)
#            info: S 0, W H X Y, no R, D L
HERE = (10, -20)
WIDE = [(0, 0), (500, 0), (500, 100), (0, 100)]
AGAIN = b"\x14\x10" + s(1000)  # a rectangle at another x, all else modal
REPETITIONS = {
    1: (u(1) + u(1) + u(0) + u(600) + u(700), [(0, 0), (600, 0), (1200, 0),
        (0, 700), (600, 700), (1200, 700)]),
    2: (u(2) + u(1) + u(600), [(0, 0), (600, 0), (1200, 0)]),
    3: (u(3) + u(1) + u(700), [(0, 0), (0, 700), (0, 1400)]),
    4: (u(4) + u(1) + u(600) + u(650), [(0, 0), (600, 0), (1250, 0)]),
    5: (u(5) + u(1) + u(10) + u(60) + u(65), [(0, 0), (600, 0), (1250, 0)]),
    6: (u(6) + u(1) + u(200) + u(350), [(0, 0), (0, 200), (0, 550)]),
    7: (u(7) + u(1) + u(50) + u(4) + u(7), [(0, 0), (0, 200), (0, 550)]),
    8: (u(8) + u(0) + u(1) + g(600, 30) + g(-20, 200), [(0, 0), (600, 30),
        (-20, 200), (580, 230), (-40, 400), (560, 430)]),
    9: (u(9) + u(1) + g(600, -130), [(0, 0), (600, -130), (1200, -260)]),
    10: (u(10) + u(1) + g(600, 10) + u(300 << 4 | 1 << 1),  # then 300 to the north
         [(0, 0), (600, 10), (600, 310)]),
    11: (u(11) + u(1) + u(20) + g(30, 5) + u(15 << 4 | 5 << 1),  # then north-west
         [(0, 0), (600, 100), (300, 400)]),
}  # fmt: skip
PATH = b"\x16\xfb" + u(1) + u(2) + u(20) + b"\x0f" + s(7) + s(30)
#       info: E W P X Y, no R, D L; half width 20; both extensions stated: 7 and 30
STRAIGHT = u(4) + u(1) + g(400, 0)
CASES = {
    "rectangle, size and layer modal": (
        RECTANGLE + AGAIN,
        moved(WIDE, HERE, (1000, -20)),
    ),
    "square sets the height, too": (
        # S and W: 70 by 70; then W alone: 90 by the modal height
        RECTANGLE + b"\x14\xd0" + u(70) + s(1000) + b"\x14\x50" + u(90) + s(2000),
        [box(10, -20, 500, 100), box(1000, -20, 70, 70), box(2000, -20, 90, 70)],
    ),
    "relative places add to the last of the same kind": (
        RECTANGLE
        + b"\x10"  # XYRELATIVE
        + (b"\x14\x18" + s(600) + s(-5)) * 2
        + b"\x0f"  # XYABSOLUTE
        + b"\x14\x08"
        + s(900),
        moved(WIDE, HERE, (610, -25), (1210, -30), (1210, 900)),
    ),
    "polygon point list modal, shared with no path": (
        b"\x15\x3b" + u(1) + u(2) + u(4) + u(2) + g(300, 40) + g(-100, 200)
        + s(5) + s(6)
        + PATH + STRAIGHT + s(2000) + s(0)
        + b"\x15\x18" + s(1000) + s(1500),
        [
            *moved([(0, 0), (300, 40), (200, 240)], (5, 6), (1000, 1500)),
            box(1993, -20, 437, 40),
        ],
    ),
    "path extensions, width and points modal": (
        PATH + STRAIGHT + s(0) + s(0)
        + b"\x16\x58" + u(35) + s(0) + s(200)  # wider; extensions as they were
        + b"\x16\x98" + b"\x09" + s(0) + s(400)  # start: half width; end: none
        + b"\x16\x98" + b"\x01" + s(0) + s(600)  # start as before; end: none
        + b"\x16\x98" + b"\x06" + s(0) + s(800),  # start: none; end: half width
        [
            box(-7, -20, 437, 40),
            box(-7, 165, 437, 70),
            box(-35, 365, 435, 70),
            box(-35, 565, 435, 70),
            box(0, 765, 435, 70),
        ],
    ),
    "trapezoids of two slopes share the size": (
        b"\x17\x7b" + u(1) + u(2) + u(300) + u(100) + s(40) + s(-30) + s(0) + s(0)
        + b"\x18\x18" + s(-50) + s(500) + s(0)  # a alone
        + b"\x19\x98" + s(60) + s(1000) + s(0)  # b alone, upright
        + b"\x14\x10" + s(2000),
        [
            [(40, 100), (270, 100), (300, 0), (0, 0)],
            [(500, 100), (800, 100), (800, 0), (550, 0)],
            [(1000, 0), (1000, 100), (1300, 40), (1300, 0)],
            box(2000, 0, 300, 100),
        ],
    ),
    "circle radius modal": (
        b"\x1b\x3b" + u(1) + u(2) + u(250) + s(0) + s(0) + b"\x1b\x10" + s(900),
        None,
    ),
    "the last repetition serves every element": (
        b"\x14\x7f" + u(1) + u(2) + u(500) + u(100) + s(0) + s(0) + REPETITIONS[2][0]
        + b"\x15\x2c" + u(4) + u(2) + g(300, 40) + g(-100, 200) + s(900) + b"\0"
        + b"\x16\xec" + u(20) + b"\x05" + STRAIGHT + s(2000) + b"\0"
        + b"\x1b\x2c" + u(90) + s(4000) + b"\0"
        + b"\x1a\xcc" + u(16) + u(150) + s(5000) + b"\0"
        + b"\x17\x0c" + s(10) + s(10) + s(6000) + b"\0",
        None,
    ),
}  # fmt: skip
CASES |= {
    f"repetition of type {number}": (
        b"\x14\x7f" + u(1) + u(2) + u(50) + u(40) + s(10) + s(-20) + code
        + b"\x14\x14" + s(5000) + b"\0",  # type 0: again
        [
            box(x + dx, dy - 20, 50, 40)
            for x in (10, 5000)
            for dx, dy in places
        ],
    )
    for number, (code, places) in REPETITIONS.items()
}  # fmt: skip
TRIANGLES = {  # kind: corners of width or height 200, width, height after it
    16: ([(0, 0), (0, 200), (200, 0)], 200, 200),
    20: ([(0, 0), (200, 200), (400, 0)], 400, 200),
    22: ([(0, 0), (0, 400), (200, 200)], 200, 400),
    25: (box(0, 0, 200, 200), 200, 200),
}
CASES |= {
    f"compact trapezoid {kind} sets width and height": (
        RECTANGLE
        + (b"\x1a\xb8" if kind == 20 else b"\x1a\xd8")
        + u(kind) + u(200) + s(1000) + s(0)
        + b"\x14\x10" + s(3000),
        [box(10, -20, 500, 100), *moved(corners, (1000, 0)), box(3000, 0, *size)],
    )
    for kind, (corners, *size) in TRIANGLES.items()
}  # fmt: skip


def canonical(points):
    """Corners from the lowest on, counter-clockwise, as a tuple."""
    points = [tuple(map(int, p)) for p in points]
    after = points[1:] + points[:1]
    area = sum(a[0] * b[1] - b[0] * a[1] for a, b in zip(points, after, strict=True))
    points = points if area > 0 else points[::-1]
    n = points.index(min(points))
    return tuple(points[n:] + points[:n])


def klayout_region(db, path):
    made = db.Layout()
    made.read(str(path))
    top = made.top_cell()
    return db.Region(top.begin_shapes_rec(made.layer(1, 2))), made


@pytest.mark.parametrize("name", CASES)
def test_elements_are_read_as_the_standard_says(tmp_path, name):
    records, corners = CASES[name]
    path = tmp_path / "m.oas"
    path.write_bytes(oasis(CELL_A, records))
    cell = layout.read_oasis(path).cells["A"]
    assert set(cell.polygons) == {(1, 2)}
    drawn = cell.polygons[1, 2]
    if corners is not None:
        assert sorted(map(canonical, drawn)) == sorted(map(canonical, corners))
    db = pytest.importorskip("klayout.db")
    theirs, _ = klayout_region(db, path)
    own = db.Region()
    for points in drawn:
        own.insert(db.Polygon([db.Point(int(x), int(y)) for x, y in points]))
    assert len(drawn) == theirs.count()
    if max(map(len, drawn)) < 64:
        assert (own ^ theirs).is_empty()
    # circles of 30 to 100 units as polygons of other corners: a unit along the edge
    assert (own ^ theirs).area() <= own.perimeter()


def test_placements_keep_cell_place_and_repetition(tmp_path):
    """By name, by number, modal; magnified and rotated; each of them once more."""
    names = b"\x04" + text(b"A") + u(7) + b"\x04" + text(b"T") + u(3)
    records = [
        names,
        b"\x0d" + u(7),
        b"\x14\x7b" + u(1) + u(2) + u(50) + u(40) + s(0) + s(0),
        b"\x0d" + u(3),
        b"\x11\xf0" + u(7) + s(100) + s(200),  # number 7 at (100, 200)
        b"\x11\x23" + s(1000),  # the same cell, y as before, 90 degrees and flipped
        b"\x10",  # relative
        b"\x11\x34" + s(10) + s(20),  # 180 degrees
        b"\x12\x1e" + b"\0" + u(2) + b"\x07" + np.float64(30).tobytes()
        + s(3000) + u(9) + u(0) + g(600, -130),  # twice as large, 30 degrees, two
        b"\x0f",  # absolute
        b"\x11\xb8" + text(b"A") + s(-900) + s(-800) + b"\0",  # by name, repeated
        b"\x11\x08\0",  # modal cell, place and repetition
    ]  # fmt: skip
    path = tmp_path / "m.oas"
    path.write_bytes(oasis(*records))
    content = layout.read_oasis(path)
    found = sorted(
        (int(x), int(y), turn.angle_deg, turn.mirrored, turn.scale)
        for _, turn, xs, ys in content.cells["T"].instances()
        for x, y in zip(xs, ys, strict=True)
    )
    assert found == sorted(
        [
            (100, 200, 0, False, 1),
            (1000, 200, 90, True, 1),
            (1010, 220, 180, False, 1),
            (1010, 3220, 30, False, 2),
            (1610, 3090, 30, False, 2),
            (-900, -800, 0, False, 1),
            (-300, -930, 0, False, 1),
            (-900, -800, 0, False, 1),
            (-300, -930, 0, False, 1),
        ]
    )
    db = pytest.importorskip("klayout.db")
    theirs, made = klayout_region(db, path)
    assert sum(i.size() for i in made.top_cell().each_inst()) == len(found)
    box = content.cells["A"].polygons[1, 2][0]
    own = db.Region()
    for x, y, angle, flip, scale in found:
        turn = db.ICplxTrans(scale, angle, flip, x, y)
        points = [db.Point(int(a), int(b)) for a, b in box]
        own.insert(db.Polygon(points).transformed(turn))
    assert (own ^ theirs).is_empty()


def test_a_new_cell_forgets_what_was_modal(tmp_path):
    """Sizes, layer and mode go; places begin at 0 again."""
    other = b"\x0e" + text(b"B")
    whole = b"\x14\x63" + u(1) + u(2) + u(50) + u(40)
    path = tmp_path / "m.oas"
    path.write_bytes(oasis(CELL_A, RECTANGLE, b"\x10", other, whole))
    (points,) = layout.read_oasis(path).cells["B"].polygons[1, 2]
    assert points.min(0).tolist() == [0, 0]
    for left_out in (b"\x14\x62" + u(2) + u(50) + u(40), b"\x14\x43" + u(1) + u(2) + u(9),
                     b"\x1b\x03" + u(1) + u(2), b"\x15\x03" + u(1) + u(2),
                     b"\x16\x63" + u(1) + u(2) + u(9) + STRAIGHT,
                     b"\x1a\x63" + u(1) + u(2) + u(9) + u(8),
                     b"\x14\x67" + u(1) + u(2) + u(5) + u(4) + b"\0",
                     b"\x11\x30" + s(4) + s(5)):  # fmt: skip
        path.write_bytes(oasis(CELL_A, RECTANGLE, PATH, STRAIGHT, s(0), s(0), other,
                               left_out))  # fmt: skip
        with pytest.raises(MaskFileError, match="byte"):
            layout.read_oasis(path)


def test_what_draws_nothing_is_skipped_and_counted(tmp_path):
    """Sizes of 0, a path without width, texts, and elements of extensions."""
    records = [
        RECTANGLE,
        b"\x14\x50" + u(0) + s(900),
        b"\x1b\x30" + u(0) + s(900),
        b"\x16\xf0" + u(0) + b"\x05" + STRAIGHT + s(900),
        b"\x15\x30" + u(4) + u(2) + g(300, 30) + g(-100, -10) + s(900),
        b"\x13\x5b" + text(b"label") + u(5) + u(6) + s(1) + s(2),
        b"\x20" + u(9) + text(b"anything"),
        b"\x21\x1b" + u(4) + u(1) + u(2) + text(b"curve") + s(0) + s(0),
        RECTANGLE,
    ]
    path = tmp_path / "m.oas"
    path.write_bytes(oasis(CELL_A, *records))
    content = layout.read_oasis(path)
    assert len(content.cells["A"].polygons[1, 2]) == 2
    assert dict(content.skipped) == {
        "RECTANGLE without area": 1,
        "CIRCLE without area": 1,
        "PATH without area": 1,
        "POLYGON without area": 1,
        "text": 1,
        "XELEMENT": 1,
        "XGEOMETRY": 1,
    }


def test_names_and_tables_of_other_writers(tmp_path):
    """Blanks and umlauts in names, XNAME tables, layer names of intervals."""
    records = [
        b"\x1e" + u(3) + text(b"extension"),
        b"\x0b" + text(b"core layer") + u(3) + u(1) + u(3) + u(2),
        b"\x0b" + text(b"all") + u(0) + u(0),
        b"\x0e" + text("Gr\u00f6\u00dfe 1".encode()),
        RECTANGLE,
        b"\x0e" + text(b"B\xfchne"),  # Latin-1
        b"\x11\xb0" + text("Gr\u00f6\u00dfe 1".encode()) + s(0) + s(0),
    ]
    path = tmp_path / "m.oas"
    path.write_bytes(oasis(*records))
    content = layout.read_oasis(path)
    assert list(content.cells) == ["Gr\u00f6\u00dfe 1", "B\u00fchne"]
    assert content.tops == ["B\u00fchne"]
    assert content.layer_names == {(1, 2): "core layer"}
