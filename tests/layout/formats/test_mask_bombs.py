"""Tiny files that claim millions of shapes: counted before memory is taken, refused
with the number.
"""

import re
import tracemalloc
import zlib

import numpy as np
import pytest

from layout.drc.library import check_library
from layout.formats import gdsii_read, oasis_read
from layout.formats import gdsii_records as gds
from layout.formats import oasis_records as oasis
from layout.formats.gdsii_records import GdsiiRecord
from layout.formats.oasis_records import OasisRecord
from layout.process.process import DesignRules
from metalens import cli
from metalens.core.errors import MaskFileError

MOST_BYTES = 60e6  # of Python and numpy; the limits of the test itself are small


LEAF = (
    gds.gdsii_record(GdsiiRecord.BOUNDARY)
    + gds.integer_record(GdsiiRecord.LAYER, 9)
    + gds.integer_record(GdsiiRecord.DATATYPE, 3)
)
LEAF += gds.xy_record(
    np.array([[0, 0], [500, 0], [0, 600], [0, 0]])
) + gds.gdsii_record(GdsiiRecord.ENDEL)


def structure(name, *elements):
    return (
        gds.integer_record(GdsiiRecord.BGNSTR, *[0] * 12)
        + gds.text_record(GdsiiRecord.STRNAME, name)
        + b"".join(elements)
        + gds.gdsii_record(GdsiiRecord.ENDSTR)
    )


def array(child, columns, rows, step=(1000, 900)):
    corners = np.array([[0, 0], [columns * step[0], 0], [0, rows * step[1]]])
    body = (
        gds.gdsii_record(GdsiiRecord.AREF)
        + gds.text_record(GdsiiRecord.SNAME, child)
        + gds.integer_record(GdsiiRecord.COLROW, columns, rows)
    )
    return body + gds.xy_record(corners) + gds.gdsii_record(GdsiiRecord.ENDEL)


def gdsii(*structures):
    head = (
        gds.integer_record(GdsiiRecord.HEADER, 600)
        + gds.integer_record(GdsiiRecord.BGNLIB, *[0] * 12)
        + gds.text_record(GdsiiRecord.LIBNAME, "L")
    )
    head += gds.gdsii_record(
        GdsiiRecord.UNITS, gds.gdsii_real(1e-3) + gds.gdsii_real(1e-9)
    )
    return (
        head
        + structure("A", LEAF)
        + b"".join(structures)
        + gds.gdsii_record(GdsiiRecord.ENDLIB)
    )


def grid(columns, rows, step):
    return b"".join(map(oasis.unsigned_integer, (1, columns - 2, rows - 2, step, step)))


def placement(child, repetition):
    return bytes([OasisRecord.PLACEMENT, 0xC8, child]) + repetition


def rectangle(repetition):
    return (
        bytes([OasisRecord.RECTANGLE, 0x67, 7, 3])
        + oasis.unsigned_integer(60)
        + oasis.unsigned_integer(50)
        + repetition
    )


def oasis_file(*cells):
    body = oasis.start_record(1.0) + b"".join(
        bytes([OasisRecord.CELLNAME]) + oasis.oasis_string(f"C{n}")
        for n in range(len(cells))
    )
    body += b"".join(
        bytes([OasisRecord.CELL_REF, n]) + records for n, records in enumerate(cells)
    )
    return body + oasis.end_record((0,) * 6, zlib.crc32(body))


def block(records):
    engine = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = engine.compress(records) + engine.flush()
    return (
        bytes([34, 0])
        + oasis.unsigned_integer(len(records))
        + oasis.unsigned_integer(len(packed))
        + packed
    )


BOMBS = {
    "one.gds": (
        gdsii(structure("TOP", array("A", 23000, 23000))),
        r"529,000,000 placements.*at most 4,0",
    ),
    "many.gds": (
        gdsii(structure("TOP", *[array("A", 1250, 1000)] * 4)),
        r"5,000,000 placements.*--max-shapes sets",
    ),
    "nested.gds": (
        gdsii(
            structure("B", array("A", 900, 800)), structure("TOP", array("B", 7, 30))
        ),
        "'B'.*expanding.*more than 4,0.* elements",
    ),
    "circle.gds": (
        gdsii(structure("B", array("C", 2, 2)), structure("C", array("B", 3, 2))),
        "places itself through",
    ),
    "grid.oas": (
        oasis_file(b"", placement(0, grid(20000, 20000, 100))),
        r"20000 x 20000 = 400,000,000 copies",
    ),
    "cells.oas": (
        oasis_file(b"", *[placement(0, grid(1250, 1000, 100))] * 4),
        r"1,250,000 copies, at most 25\d,\d+ more",
    ),
    "again.oas": (
        oasis_file(b"", placement(0, grid(2500, 1500, 9)) + placement(0, b"\0") * 5),
        r"7,500,000 placements and copies.*--max-shapes sets",
    ),
    "boxes.oas": (
        oasis_file(rectangle(grid(2000, 1000, 70))),
        r"24,000,000 placements and copies",
    ),
    "packed.oas": (
        oasis_file(block(bytes(200_000_000))),
        r"block of 200,000,000 bytes",
    ),
}


@pytest.mark.parametrize("name", BOMBS)
def test_tiny_files_of_millions_are_refused_with_the_number(name, tmp_path, capsys):
    data, match = BOMBS[name]
    path = tmp_path / name
    path.write_bytes(data)
    assert len(data) < 300_000
    assert cli.main(["check", str(path)]) == 2
    said = capsys.readouterr().err
    assert re.search(match, said), said


def test_memory_is_not_taken_before_the_count(tmp_path):
    tracemalloc.start()
    try:
        for name, (data, _) in BOMBS.items():
            if name in ("packed.oas", "circle.gds", "nested.gds"):
                continue
            read = (
                gdsii_read.parse_gdsii
                if name.endswith("gds")
                else oasis_read.parse_oasis
            )
            with pytest.raises(MaskFileError, match="at most"):
                read(np.frombuffer(data, np.uint8), limit=100_000)
        assert tracemalloc.get_traced_memory()[1] < MOST_BYTES
    finally:
        tracemalloc.stop()


def test_arrays_are_summed_in_bounded_memory():
    data = np.frombuffer(
        gdsii(structure("TOP", array("A", 4000, 3000, (7, -5)))), np.uint8
    )
    tracemalloc.start()
    try:
        sums = gdsii_read.parse_gdsii(data, keep=1000).cells["TOP"].sums
        assert (
            tracemalloc.get_traced_memory()[1] < 150e6
        )  # a twelfth of the copies at once, 13 to 60 bytes each
    finally:
        tracemalloc.stop()
    ((count, x, y, _, _),) = sums.values()
    assert count == 12_000_000
    assert x == 7 * 3000 * (4000 * 3999 // 2)
    assert y == -5 * 4000 * (3000 * 2999 // 2)


def test_the_number_of_shapes_is_the_product_of_the_arrays():
    content = gdsii_read.parse_gdsii(
        np.frombuffer(
            gdsii(structure("B", array("A", 9, 8)), structure("TOP", array("B", 7, 3))),
            np.uint8,
        )
    )
    assert dict(content.count_shapes()) == {(9, 3): 9 * 8 * 7 * 3}
    content.refuse_beyond(9 * 8 * 7 * 3)
    with pytest.raises(MaskFileError, match=r"1,512 shapes.*at most 1,511"):
        content.refuse_beyond(9 * 8 * 7 * 3 - 1)


def test_shapes_on_each_other_are_refused_before_they_are_paired():
    data = gdsii(structure("TOP", array("A", 1000, 10, (0, 0))))
    with pytest.raises(MaskFileError, match=r"pairs of shapes.*lie on"):
        check_library(
            gdsii_read.parse_gdsii(np.frombuffer(data, np.uint8)), DesignRules()
        )
