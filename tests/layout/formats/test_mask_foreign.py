"""Masks of other programs: every element is read as KLayout reads it, or refused by its
name.
"""

import math

import numpy as np
import pytest

import layout
from layout.formats import gdsii_read
from layout.formats import gdsii_records as gds
from layout.formats import oasis_records as oasis
from layout.formats.gdsii_records import GdsiiRecord
from layout.formats.library import CellReference, MaskCell, flatten_stacks
from layout.formats.oasis_records import OasisRecord
from metalens.core.errors import MaskFileError
from tests.referees.mask_places import places

db = pytest.importorskip("klayout.db")


def region_of(content, layer):
    """Everything on a layer, flat, as a region of KLayout."""
    found = db.Region()
    for shape in flatten_stacks(content, content.tops[0]):
        if shape.layer == layer:
            for x, y in zip(shape.x.tolist(), shape.y.tolist(), strict=True):
                for outline in shape.outlines.tolist():
                    corners = [db.Point(px + x, py + y) for px, py in outline]
                    found.insert(db.Polygon(corners))
    return found


def agrees(path, layer=(7, 3), *, slack=0):
    """Whether KLayout and this reader see the same; ``slack``: units by which round or
    turned corners may differ.
    """
    read = db.Layout()
    read.read(str(path))
    theirs = db.Region(read.top_cell().begin_shapes_rec(read.layer(*layer)))
    own = region_of(
        (layout.read_gdsii if path.suffix == ".gds" else layout.read_oasis)(path), layer
    )
    assert not own.is_empty()
    return (own ^ theirs).sized(-slack).is_empty()


@pytest.mark.parametrize("suffix", ["gds", "oas"])
@pytest.mark.parametrize("ends", [(0, 0), (35, 35), (90, 20)])
def test_paths(tmp_path, suffix, ends):
    made = db.Layout()
    top, layer = made.create_cell("TOP"), made.layer(7, 3)
    line = [
        db.Point(*p)
        for p in ((0, 0), (900, 0), (900, -700), (1500, -1400), (2600, -1400))
    ]
    top.shapes(layer).insert(db.Path(line, 70, *ends))
    top.shapes(layer).insert(
        db.Path([db.Point(-500, 40), db.Point(-500, 900)], 130, 0, 0)
    )
    path = tmp_path / f"p.{suffix}"
    made.write(str(path))
    assert agrees(path, slack=1)


@pytest.mark.parametrize("ends", [(0, 0, False), (31, -2, False), (90, 90, True)])
def test_paths_of_sharp_bends_and_short_arms(tmp_path, ends):
    rng, made = np.random.default_rng(7), db.Layout()
    top = made.create_cell("TOP")
    for n in range(60):  # arms shorter than the width, and turns up to a way back
        steps = rng.integers(-1, 2, (5, 2)) * rng.integers(
            20, (90, 500, 3000)[n % 3], (5, 2)
        )
        steps[0] += 7
        line = np.cumsum(np.vstack([[0, 0], steps]), axis=0)
        shape = db.Path([db.Point(*p) for p in line.tolist()], 180, *ends)
        top.shapes(made.layer(n + 1, 0)).insert(shape)
    path = tmp_path / "bent.gds"
    made.write(str(path))
    for n in range(60):
        assert agrees(path, (n + 1, 0), slack=1), n


def test_round_paths_of_gdsii(tmp_path):
    made = db.Layout()
    top, layer = made.create_cell("TOP"), made.layer(7, 3)
    top.shapes(layer).insert(
        db.Path([db.Point(0, 0), db.Point(3000, 1000)], 400, 200, 200, True)
    )
    path = tmp_path / "r.gds"
    made.write(str(path))
    area = region_of(layout.read_gdsii(path), (7, 3)).area()
    assert area == pytest.approx(
        400 * math.hypot(3000, 1000) + math.pi * 200**2, rel=2e-3
    )  # of 32 corners: 0.06 % of it


@pytest.mark.parametrize("suffix", ["gds", "oas"])
def test_any_turn_and_magnification_nested_and_in_arrays(tmp_path, suffix):
    made = db.Layout()
    top, inner, leaf = (made.create_cell(name) for name in ("TOP", "INNER", "LEAF"))
    layer = made.layer(7, 3)
    leaf.shapes(layer).insert(
        db.Polygon([db.Point(0, 0), db.Point(900, 100), db.Point(300, 700)])
    )
    inner.shapes(layer).insert(db.Box(-2000, -2300, -1500, -1900))
    turned = db.ICplxTrans(1.5, 33.0, True, 4000, -700)
    inner.insert(
        db.CellInstArray(
            leaf.cell_index(), turned, db.Vector(2100, 0), db.Vector(0, 2500), 3, 2
        )
    )
    top.insert(
        db.CellInstArray(
            inner.cell_index(), db.ICplxTrans(0.5, 90.0, False, 11000, 400)
        )
    )
    top.insert(db.CellInstArray(inner.cell_index(), db.Trans(5, -9000, 300)))
    path = tmp_path / f"t.{suffix}"
    made.write(str(path))
    assert agrees(path, slack=2)  # turned corners are rounded at each level


def gdsii(*elements):
    head = (
        gds.integer_record(GdsiiRecord.HEADER, 600)
        + gds.integer_record(GdsiiRecord.BGNLIB, *[0] * 12)
        + gds.text_record(GdsiiRecord.LIBNAME, "L")
    )
    head += gds.gdsii_record(
        GdsiiRecord.UNITS, gds.gdsii_real(1e-3) + gds.gdsii_real(1e-9)
    )
    leaf = (
        gds.integer_record(GdsiiRecord.BGNSTR, *[0] * 12)
        + gds.text_record(GdsiiRecord.STRNAME, "A")
        + gds.gdsii_record(GdsiiRecord.BOUNDARY)
    )
    leaf += gds.integer_record(GdsiiRecord.LAYER, 7) + gds.integer_record(
        GdsiiRecord.DATATYPE, 3
    )
    leaf += (
        gds.xy_record(np.array([[0, 0], [50, 0], [0, 60], [0, 0]]))
        + gds.gdsii_record(GdsiiRecord.ENDEL)
        + gds.gdsii_record(GdsiiRecord.ENDSTR)
    )
    top = (
        gds.integer_record(GdsiiRecord.BGNSTR, *[0] * 12)
        + gds.text_record(GdsiiRecord.STRNAME, "TOP")
        + b"".join(elements)
    )
    return np.frombuffer(
        head
        + leaf
        + top
        + gds.gdsii_record(GdsiiRecord.ENDSTR)
        + gds.gdsii_record(GdsiiRecord.ENDLIB),
        np.uint8,
    )


def aref(columns, rows, *corners):
    body = (
        gds.gdsii_record(GdsiiRecord.AREF)
        + gds.text_record(GdsiiRecord.SNAME, "A")
        + gds.integer_record(GdsiiRecord.COLROW, columns, rows)
    )
    return body + gds.xy_record(np.array(corners)) + gds.gdsii_record(GdsiiRecord.ENDEL)


def test_arrays_off_the_grid_stand_next_to_their_places():
    x, _ = places(
        gdsii_read.parse_gdsii(gdsii(aref(3, 1, (0, 0), (1000, 0), (0, 100)))), "TOP"
    )["A"]
    assert x.tolist() == [0, 333, 667]
    x, y = places(
        gdsii_read.parse_gdsii(
            gdsii(aref(2, 3, (7, 9), (7 + 41, 9 - 13), (7 + 20, 9 + 100)))
        ),
        "TOP",
    )["A"]
    exact = {
        (7 + 20.5 * i + 20 / 3 * j, 9 - 6.5 * i + 100 / 3 * j)
        for i in range(2)
        for j in range(3)
    }
    found = set(zip(x.tolist(), y.tolist(), strict=True))
    assert len(found) == 6
    assert all(
        min(max(abs(u - p), abs(v - q)) for p, q in found) <= 0.5 for u, v in exact
    )
    x, _ = places(
        gdsii_read.parse_gdsii(gdsii(aref(3, 1, (5, 0), (1004, 0), (5, 100)))), "TOP"
    )["A"]
    assert x.tolist() == [5, 338, 671]


def test_places_that_leave_32_bits_are_refused_and_not_wrapped():
    far = (
        gds.gdsii_record(GdsiiRecord.SREF)
        + gds.text_record(GdsiiRecord.SNAME, "A")
        + gds.xy_record(np.array([[2**31 - 20, 0]]))
    )
    content = gdsii_read.parse_gdsii(gdsii(far + gds.gdsii_record(GdsiiRecord.ENDEL)))
    nested = CellReference("TOP", 100, 0)
    content.cells["OUTER"] = MaskCell("OUTER", references=(nested,))
    with pytest.raises(MaskFileError, match="32 bits"):
        places(content, "OUTER")
    with pytest.raises(MaskFileError, match="32 bits"):
        list(flatten_stacks(content, "OUTER"))


def oasis_file(*records):
    name = bytes([OasisRecord.CELLNAME]) + oasis.oasis_string("TOP")
    body = (
        oasis.start_record(1.0)
        + name
        + bytes([OasisRecord.CELL_REF, 0])
        + b"".join(records)
    )
    return body + oasis.end_record((0,) * 6, __import__("zlib").crc32(body))


def compact(kind, w, h):
    size = oasis.unsigned_integer(w) + oasis.unsigned_integer(h)
    return (
        bytes([OasisRecord.CTRAPEZOID, 0xFB, 7, 3, kind])
        + size
        + oasis.signed_integer(11)
        + oasis.signed_integer(-5)
    )


@pytest.mark.parametrize("kind", range(26))
def test_compact_trapezoids(tmp_path, kind):
    w, h = (900, 400) if kind < 8 else (300, 800)
    path = tmp_path / "c.oas"
    path.write_bytes(oasis_file(compact(kind, w, h)))
    assert agrees(path)


@pytest.mark.parametrize("upright", [0, 1])
@pytest.mark.parametrize(
    ("kind", "slopes"), [(23, (120, -60)), (23, (-90, 70)), (24, (150,)), (25, (-80,))]
)
def test_trapezoids(tmp_path, upright, kind, slopes):
    info = (
        bytes([kind, 0x7B | upright << 7, 7, 3])
        + oasis.unsigned_integer(700)
        + oasis.unsigned_integer(500)
    )
    path = tmp_path / "t.oas"
    path.write_bytes(
        oasis_file(
            info
            + b"".join(map(oasis.signed_integer, slopes))
            + oasis.signed_integer(-40)
            + oasis.signed_integer(9)
        )
    )
    assert agrees(path)
