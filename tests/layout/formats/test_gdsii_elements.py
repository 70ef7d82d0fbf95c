"""GDSII from bytes written by hand after the stream format manual, beside KLayout."""

import struct

import numpy as np
import pytest

import layout
from layout.formats.library import flatten_stacks
from layout.formats.reading import read_mask
from tests.command_line import call

SQUARE = [(0, 0), (500, 0), (500, 300), (0, 300), (0, 0)]


def record(kind, data_type=0, data=b""):
    return struct.pack(">HBB", 4 + len(data), kind, data_type) + data


def shorts(kind, *values):
    return record(kind, 2, struct.pack(f">{len(values)}h", *values))


def longs(kind, *values):
    return record(kind, 3, struct.pack(f">{len(values)}i", *values))


def text(kind, data):
    return record(kind, 6, data + bytes(len(data) % 2))


def real(fraction, exponent):
    """Excess-64: ``fraction`` / 2^56 times 16^exponent."""
    return bytes([64 + exponent]) + int(fraction * 2**56).to_bytes(7, "big")


ENDEL = record(0x11)
NANOMETRE = record(3, 5, bytes.fromhex("3e4189374bc6a7f03944b82fa09b5a54"))


def library(*structures):
    head = shorts(0, 600) + shorts(1, *[0] * 12) + text(2, b"LIB") + NANOMETRE
    return head + b"".join(structures) + record(4)


def structure(name, *elements):
    """``name`` as bytes of an even length, as it stands in the file."""
    return shorts(5, *[0] * 12) + record(6, 6, name) + b"".join(elements) + record(7)


def points(*xy):
    return longs(0x10, *(c for p in xy for c in p))


def boundary(*parts):
    return record(8) + shorts(0xD, 1) + shorts(0xE, 2) + b"".join(parts) + ENDEL


def path(*xy, width=None, ends=None, extension=None, kind=9):
    parts = [record(kind), shorts(0xD, 1), shorts(0xE, 2)]
    parts += [] if ends is None else [shorts(0x21, ends)]
    parts += [] if width is None else [longs(0xF, width)]
    if extension:
        parts += [longs(0x30, extension[0]), longs(0x31, extension[1])]
    return b"".join(parts) + points(*xy) + ENDEL


def reference(name, x, y, *transform):
    return record(0xA) + text(0x12, name) + b"".join(transform) + points((x, y)) + ENDEL


def region_of(db, file):
    own = db.Region()
    content = layout.read_gdsii(file)
    for shape in (s for top in content.tops for s in flatten_stacks(content, top)):
        for x, y in zip(shape.x.tolist(), shape.y.tolist(), strict=True):
            for outline in shape.outlines.tolist():
                corners = [db.Point(a + x, b + y) for a, b in outline]
                own.insert(db.Polygon(corners))
    return own, content


def klayout_region(db, file):
    made = db.Layout()
    made.read(str(file))
    theirs = db.Region()
    for top in made.top_cells():
        theirs.insert(top.begin_shapes_rec(made.layer(1, 2)))
    return theirs.merged(), made


TURNED = (
    record(0x1A, 1, b"\x80\x06"),
    record(0x1B, 5, real(2 / 16, 1)),
    record(0x1C, 5, real(90 / 256, 2)),
)  # flipped, twice as large, 90 degrees, both "absolute"
DRAWN = {
    "open outlines are closed": [structure(b"AA", boundary(points(*SQUARE[:-1])))],
    "a negative width": [structure(b"AA", path((0, 0), (300, 0), width=-41))],
    "a path of an unknown type": [
        structure(b"AA", path((0, 0), (300, 70), width=40, ends=3))
    ],
    "a point with square ends": [structure(b"AA", path((7, 5), width=40, ends=2))],
    "a point with round ends": [
        structure(b"AA", path((7, 5), (7, 5), width=40, ends=1))
    ],
    "a point with stated ends": [
        structure(b"AA", path((7, 5), width=40, ends=4, extension=(10, 30)))
    ],
    "absolute angle and size": [
        structure(b"AA", boundary(points(*SQUARE))),
        structure(b"TT", reference(b"AA", 5, 6, *TURNED)),
    ],
    "names with two and three NULs": [
        structure(b"ABC\0\0\0", boundary(points(*SQUARE))),
        structure(b"TT\0\0", reference(b"ABC", 5, 6), reference(b"ABC\0\0", 900, 6)),
    ],
    "names with blanks": [
        structure(b"A B ", boundary(points(*SQUARE))),
        structure(b"TT", reference(b"A B ", 5, 6)),
    ],
    "names with umlauts": [
        structure("L\u00f6ffel \u00df".encode(), boundary(points(*SQUARE))),
        structure(b"TT", reference("L\u00f6ffel \u00df".encode(), 5, 6)),
    ],
    "a box": [
        structure(
            b"AA",
            record(0x2D) + shorts(0xD, 1) + shorts(0x2E, 2) + points(*SQUARE) + ENDEL,
        )
    ],
    "properties, flags and plex": [
        structure(
            b"AA",
            record(8) + record(0x26, 1, b"\0\1") + longs(0x2F, 3) + shorts(0xD, 1)
            + shorts(0xE, 2) + points(*SQUARE) + shorts(0x2B, 1) + text(0x2C, b"v")
            + shorts(0x2B, 2) + text(0x2C, b"w") + ENDEL,
        )
    ],
}  # fmt: skip


@pytest.mark.parametrize("case", DRAWN)
def test_elements_are_drawn_as_klayout_draws_them(tmp_path, case):
    db = pytest.importorskip("klayout.db")
    file = tmp_path / "m.gds"
    file.write_bytes(library(*DRAWN[case]))
    own, content = region_of(db, file)
    theirs, made = klayout_region(db, file)
    assert (own ^ theirs).is_empty()
    assert not theirs.is_empty()
    if "round" not in case:
        assert sorted(content.cells) == sorted(cell.name for cell in made.each_cell())


EMPTY = {
    "PATH without area": path((0, 0), (300, 0), (300, 200), width=0),
    "BOUNDARY without area": boundary(points((0, 0), (100, 0), (200, 0), (0, 0))),
    "NODE": record(0x15) + shorts(0xD, 1) + shorts(0x2A, 0) + points((0, 0)) + ENDEL,
    "text": record(0xC) + shorts(0xD, 1) + shorts(0x16, 0) + points((0, 0))
    + text(0x19, b"label") + ENDEL,
    "MBMSPATH without area": path((0, 0), (300, 0), kind=0x56),
}  # fmt: skip


@pytest.mark.parametrize("kind", EMPTY)
def test_elements_that_draw_nothing_are_skipped_and_counted(tmp_path, capsys, kind):
    db = pytest.importorskip("klayout.db")
    square = boundary(points(*SQUARE))
    file = tmp_path / "m.gds"
    file.write_bytes(library(structure(b"AA", EMPTY[kind], square, EMPTY[kind])))
    own, content = region_of(db, file)
    assert dict(content.skipped) == {kind: 2}
    assert own.count() == 1
    if "MBMS" not in kind:  # KLayout refuses it
        assert klayout_region(db, file)[0].count() == 1
    assert call(f"check {file}") == 0
    assert f"draw nothing: 2 {kind}" in capsys.readouterr().out
    assert call(f"info {file}") == 0
    assert f"draw nothing: 2 {kind}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("element", "kind"),
    [
        (path((0, 0), (300, 0)), "PATH without area"),
        (path((0, 0), width=40), "PATH without area"),
        (path((4, 4), (4, 4), width=40, ends=0), "PATH without area"),
        (boundary(points((0, 0), (100, 0), (0, 0))), "BOUNDARY without area"),
        (boundary(points((0, 0))), "BOUNDARY without area"),
    ],
)
def test_dots_and_lines_draw_nothing(tmp_path, element, kind):
    file = tmp_path / "m.gds"
    file.write_bytes(library(structure(b"AA", element)))
    content = layout.read_gdsii(file)
    assert (dict(content.skipped), content.cells["AA"].polygons) == ({kind: 1}, {})
    assert call(f"check {file}") == 1


def test_a_path_of_a_moving_stage_is_read_with_its_width(tmp_path):
    """MBMS paths of Raith writers: a path record of their own, with data of theirs."""
    element = (
        record(0x56) + shorts(0xD, 1) + shorts(0xE, 2) + longs(0xF, 60)
        + record(0x62, 6, bytes(48)) + points((0, 0), (300, 0)) + ENDEL
    )  # fmt: skip
    file = tmp_path / "raith.gds"
    file.write_bytes(library(structure(b"AA", element)))
    (outline,) = read_mask(file).cells["AA"].polygons[1, 2]
    assert np.ptp(outline, axis=0).tolist() == [300, 60]
    assert call(f"check {file}") == 1  # 60 nm wide, the default needs 80


def test_an_outline_of_several_records_is_one(tmp_path):
    """As writers split outlines beyond 8191 points; a class of the structure before."""
    parts = points(*SQUARE[:2]), points(SQUARE[2]), points(*SQUARE[3:])
    file = tmp_path / "m.gds"
    before = record(0x34, 1, b"\0\1")
    file.write_bytes(library(structure(b"AA", before, boundary(*parts))))
    (outline,) = layout.read_gdsii(file).cells["AA"].polygons[1, 2]
    assert outline.tolist() == [list(p) for p in SQUARE[:-1]]


def test_latin_names_are_told_from_utf_8(tmp_path):
    file = tmp_path / "m.gds"
    name = b"K\xfcche"
    file.write_bytes(library(structure(name + b"\0", boundary(points(*SQUARE)))))
    assert list(layout.read_gdsii(file).cells) == ["K\u00fcche"]
