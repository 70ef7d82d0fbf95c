"""GDSII reader: every record is checked; what is wrong is named with its byte offset."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from layout.formats import gdsii_records as gds
from layout.formats import paths
from layout.formats.files import (
    CONTEXT_CELL,
    MOST_PLACEMENTS,
    decode_name,
    map_bytes,
    release_bytes,
)
from layout.formats.gdsii_records import GdsiiRecord
from layout.formats.library import MaskCell, MaskLibrary, Orientation
from layout.formats.open_cell import OpenCell, has_area
from layout.formats.read_loops import sref_run
from layout.mask.plan import BLOCK_SITES, FARTHEST
from layout.process.process import LayerNumber
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

# records that libraries may have before UNITS
_HEADS = {0x00, 0x05, 0x1F, 0x20, 0x22, 0x23, 0x36, 0x37, 0x38, 0x39, 0x3A, 0x3B}
_PATHS = (GdsiiRecord.PATH, GdsiiRecord.MBMSPATH)
_SHAPES = {
    GdsiiRecord.BOUNDARY,
    GdsiiRecord.BOX,
    GdsiiRecord.TEXT,
    GdsiiRecord.NODE,
    GdsiiRecord.SREF,
    GdsiiRecord.AREF,
    *_PATHS,
}


def read_gdsii(
    path: str | Path, *, limit: int = MOST_PLACEMENTS, keep: int | None = None
) -> MaskLibrary:
    """Read a GDSII file.

    Args:
        limit: most placements, arrays of references expanded, that are read.
        keep: most placements of one structure that are kept; of more only the sums are
            (:mod:`layout.formats.digest`),
            in bounded memory. None: all are kept.
        path: of the file.

    Raises:
        MaskFileError: not GDSII, cut, or broken anywhere; the message gives the byte
            offset.
        OSError: the file cannot be opened.
    """
    return parse_gdsii(map_bytes(path), limit=limit, keep=keep, where=str(path))


def parse_gdsii(
    data: Array,
    *,
    limit: int = MOST_PLACEMENTS,
    keep: int | None = None,
    where: str = "data",
) -> MaskLibrary:
    """Read a GDSII stream from its bytes, as :func:`read_gdsii`.

    Args:
        data: bytes, uint8.
        limit: most placements that are read.
        keep: most placements of one structure that are kept; None: all.
        where: name of the bytes in errors.
    """
    return _GdsiiReader(where, data, limit, keep).library()


class _GdsiiReader:
    """A cursor over the records."""

    def __init__(self, path: str, data: Array, limit: int, keep: int | None) -> None:
        self.path = path
        self.data = data
        self.at = 0
        self.limit = limit
        self.keep = keep
        self.begin = 0  # of the latest record
        self.placed = 0
        self.number_of: dict[str, int] = {}  # structures by first reference
        self.names: list[str] = []

    def fail(self, text: str, at: int | None = None) -> MaskFileError:
        """An error that names the file and the byte."""
        return MaskFileError(
            f"{self.path}: byte {self.begin if at is None else at}: {text}"
        )

    def next(self, *wanted: int) -> tuple[int, bytes]:
        """Kind and data of the next record, which must be one of ``wanted`` (any, if
        none is named).
        """
        self.begin = self.at
        left = len(self.data) - self.at
        if left < 4:
            raise self.fail(
                f"the file ends within a record ({left} bytes left); it is cut"
            )
        high, low, kind, data_type = (int(v) for v in self.data[self.at : self.at + 4])
        length = high << 8 | low
        if length < 4 or length % 2 or length > left:
            raise self.fail(
                f"record of {length} bytes, {left} left in the file; need an even length from 4 on"
            )
        expected = gds.DATA.get(kind, data_type)
        if data_type != expected:
            raise self.fail(
                f"{gds.record_name(kind)} with data type {data_type}, need {expected}"
            )
        if wanted and kind not in wanted:
            needed = " or ".join(map(gds.record_name, wanted))
            raise self.fail(f"found {gds.record_name(kind)}, need {needed}")
        self.at += length
        return kind, self.data[self.begin + 4 : self.at].tobytes()

    def library(self) -> MaskLibrary:
        """Read the whole stream, from HEADER to ENDLIB."""
        self.next(GdsiiRecord.HEADER)
        self.next(GdsiiRecord.BGNLIB)
        while self.next()[0] != GdsiiRecord.LIBNAME:
            if int(self.data[self.begin + 2]) not in _HEADS:
                raise self.fail("LIBNAME is missing")
        kind, data = self.next()
        while kind in _HEADS and kind != GdsiiRecord.BGNSTR:
            kind, data = self.next()
        if kind != GdsiiRecord.UNITS or len(data) != 16:
            raise self.fail("UNITS of two numbers is missing")
        user = gds.to_float(data[:8])
        meters = gds.to_float(data[8:])
        if not (1e-15 < meters < 1 and user > 0):
            raise self.fail(f"database unit of {meters} m")
        cells: dict[str, MaskCell] = {}
        while (
            self.next(GdsiiRecord.BGNSTR, GdsiiRecord.ENDLIB)[0] == GdsiiRecord.BGNSTR
        ):
            cell = self.structure()
            if cell.name in cells:
                raise self.fail(f"structure {cell.name!r} comes twice")
            cells[cell.name] = cell
        if self.data[self.at :].any():
            raise self.fail("data after ENDLIB", self.at)
        cells.pop(CONTEXT_CELL, None)
        return MaskLibrary("", cells, meters * 1e9, kind="GDSII")

    def name(self, data: bytes) -> str:
        """Name of a structure; refuse an empty name."""
        text = decode_name(data)
        if not text:
            raise self.fail("a structure or reference without a name")
        return text

    def number(self, name: str) -> int:
        """Number of a structure, in the order of first reference."""
        if name not in self.number_of:
            self.number_of[name] = len(self.names)
            self.names.append(name)
        return self.number_of[name]

    def structure(self) -> MaskCell:
        """Read a structure, from STRNAME to ENDSTR."""
        name = self.name(self.next(GdsiiRecord.STRNAME)[1])
        cell = OpenCell(name, self.keep)
        while True:
            self.references(cell)
            kind, _ = self.next(*_SHAPES, GdsiiRecord.ENDSTR, GdsiiRecord.STRCLASS)
            if kind == GdsiiRecord.ENDSTR:
                return cell.close(name, self.names)
            if kind in (GdsiiRecord.SREF, GdsiiRecord.AREF):
                self.reference(cell, kind)
            elif kind in (GdsiiRecord.BOUNDARY, GdsiiRecord.BOX, *_PATHS):
                layer, points = self.line() if kind in _PATHS else self.boundary(kind)
                if has_area(points):
                    cell.polygons.setdefault(layer, []).append(points)
                else:
                    cell.skipped[f"{gds.record_name(kind)} without area"] += 1
            elif kind != GdsiiRecord.STRCLASS:  # TEXT, NODE
                cell.skipped[
                    "text" if kind == GdsiiRecord.TEXT else gds.record_name(kind)
                ] += 1
                while self.next()[0] != GdsiiRecord.ENDEL:
                    self.refuse_outside_element()

    def refuse_outside_element(self) -> None:
        """Refuse a record that cannot be within an element."""
        kind = int(self.data[self.begin + 2])
        if kind in _SHAPES or kind in (
            GdsiiRecord.BGNSTR,
            GdsiiRecord.ENDSTR,
            GdsiiRecord.ENDLIB,
            GdsiiRecord.HEADER,
        ):
            raise self.fail(
                f"{gds.record_name(kind)} within an element; ENDEL is missing"
            )

    def references(self, cell: OpenCell) -> None:
        """Plain references in a row, by the compiled loop."""
        while True:
            names, child, x, y, end = sref_run(self.data, self.at)
            if not len(child):
                return
            numbers = np.array([self.number(self.name(n)) for n in names], np.int32)
            cell.place(numbers[child], x, y)
            self.at = end
            release_bytes(self.data, end)
            self.count(len(child))

    def count(self, more: int) -> None:
        """Add to the placements of the file; refuse more than the limit."""
        self.placed += more
        if self.placed > self.limit:
            raise self.fail(
                f"{self.placed:,} placements up to here, at most {self.limit:,} are read (metalens check --max-shapes "
                "sets another limit)"
            )

    def fields(self) -> dict[int, bytes]:
        """{kind: data} up to ENDEL."""
        records: dict[int, bytes] = {}
        while True:
            kind, data = self.next()
            if kind == GdsiiRecord.ENDEL:
                return records
            self.refuse_outside_element()
            if (
                kind == GdsiiRecord.XY
            ):  # writers split long outlines over several records
                records[kind] = records.get(kind, b"") + data
                continue
            if kind in records and kind not in (
                GdsiiRecord.PROPATTR,
                GdsiiRecord.PROPVALUE,
            ):
                raise self.fail(f"element with {gds.record_name(kind)} twice")
            records[kind] = data

    def numbers(self, records: dict[int, bytes], kind: int, count: int | None) -> Array:
        """Integers of a record that an element needs."""
        size = 4 if kind == GdsiiRecord.XY else 2
        data = records.get(kind)
        if (
            data is None
            or len(data) % size
            or (count is not None and len(data) != count * size)
        ):
            raise self.fail(f"element with a wrong or missing {gds.record_name(kind)}")
        return np.frombuffer(data, f">i{size}").astype(np.int64)

    def layer(self, records: dict[int, bytes], kind: int) -> LayerNumber:
        """Layer and datatype of an element, unsigned 16 bits each."""
        number, datatype = (
            int(self.numbers(records, k, 1)[0]) & 0xFFFF
            for k in (GdsiiRecord.LAYER, kind)
        )
        return number, datatype

    def boundary(self, kind: int) -> tuple[LayerNumber, Array]:
        """Layer and corners of an outline, closed where the file leaves it open."""
        records = self.fields()
        layer = self.layer(
            records,
            GdsiiRecord.DATATYPE
            if kind == GdsiiRecord.BOUNDARY
            else GdsiiRecord.BOXTYPE,
        )
        points = self.points(records)
        closed = len(points) > 1 and (points[0] == points[-1]).all()
        return layer, points[:-1] if closed else points

    def points(self, records: dict[int, bytes]) -> Array:
        """(n, 2) points of an element, n >= 1."""
        numbers = self.numbers(records, GdsiiRecord.XY, None)
        if len(numbers) % 2 or not len(numbers):
            raise self.fail(f"element with {len(numbers)} coordinates, need pairs")
        return numbers.reshape(-1, 2)

    def reference(self, cell: OpenCell, kind: int) -> None:
        """Read SREF or AREF, and place its copies in the cell."""
        start = self.begin
        records = self.fields()
        number = self.number(self.name(records.get(GdsiiRecord.SNAME, b"")))
        turn = self.turn(records, start)
        xy = self.numbers(records, GdsiiRecord.XY, 2 if kind == GdsiiRecord.SREF else 6)
        if kind == GdsiiRecord.SREF:
            cell.place(number, xy[:1], xy[1:], turn)
            return
        for x, y in self.array(records, xy, start):
            cell.place(number, x, y, turn)

    def array(
        self, records: dict[int, bytes], xy: Array, start: int
    ) -> Iterator[tuple[Array, Array]]:
        """Places of an array of references, some rows at a time.

        The file states three corners; steps are the sides over columns and rows. Where
        they are no whole units, each copy stands on the unit nearest to its place.

        Args:
            records: {kind: data} of the element.
            xy: (6,) corners.
            start: byte of the element, for messages.

        Yields:
            (n,) x and (n,) y.
        """
        columns, rows = (
            int(size) for size in self.numbers(records, GdsiiRecord.COLROW, 2)
        )
        if columns < 1 or rows < 1:
            raise self.fail(f"array of {columns} x {rows}", start)
        self.count(columns * rows)
        across, up = xy[2:4] - xy[:2], xy[4:] - xy[:2]
        ends = [
            xy[:2] + across * i + up * j
            for i in (0, 1 - 1 / columns)
            for j in (0, 1 - 1 / rows)
        ]
        if np.abs(ends).max() > FARTHEST:
            raise self.fail("array that reaches beyond 32 bits", start)
        i = np.arange(columns)
        for part_rows in np.array_split(
            np.arange(rows), -(-columns * rows // BLOCK_SITES)
        ):
            offsets = (
                part_rows[:, None] * up[axis] / rows + i * across[axis] / columns
                for axis in (0, 1)
            )
            x, y = (
                xy[axis] + np.floor(offset + 0.5).astype(np.int64).ravel()
                for axis, offset in enumerate(offsets)
            )
            yield x, y

    def turn(self, records: dict[int, bytes], start: int) -> Orientation:
        """Orientation of a reference: mirror, scale and angle."""
        flags = records.get(GdsiiRecord.STRANS, b"\0\0")
        angle = self.real(records, GdsiiRecord.ANGLE, 0.0)
        scale = self.real(records, GdsiiRecord.MAG, 1.0)
        if len(flags) != 2 or not 0 < scale < 1e9:
            raise self.fail(
                f"reference scaled by {scale}, or with broken STRANS; need a scale above 0",
                start,
            )
        # absolute angle and size (bits 13, 14) are ignored, as other readers do
        return Orientation(angle % 360, bool(flags[0] & 128), scale)

    def real(self, records: dict[int, bytes], kind: int, default: float) -> float:
        """Number of a record; the default where it is missing or of another length."""
        data = records.get(kind, b"")
        return gds.to_float(data) if len(data) == 8 else default

    def line(self) -> tuple[LayerNumber, Array]:
        """Layer and outline of a path; a negative width does not scale with references,
        which is ignored.
        """
        records = self.fields()
        layer = self.layer(records, GdsiiRecord.DATATYPE)
        points = self.points(records)
        width, begin, end = (
            self.whole(records, kind)
            for kind in (GdsiiRecord.WIDTH, GdsiiRecord.BGNEXTN, GdsiiRecord.ENDEXTN)
        )
        path_type = 0
        if GdsiiRecord.PATHTYPE in records:
            path_type = int(self.numbers(records, GdsiiRecord.PATHTYPE, 1)[0])
        half = abs(width) / 2
        if not half:
            return layer, points[:1]
        extensions = {1: (half, half), 2: (half, half), 4: (float(begin), float(end))}
        begin_extension, end_extension = extensions.get(path_type, (0.0, 0.0))
        outline = paths.path_outline(
            points,
            half,
            begin=begin_extension,
            end=end_extension,
            rounded=path_type == 1,
        )
        return layer, outline

    def whole(self, records: dict[int, bytes], kind: int) -> int:
        """A 32-bit number that an element may have; 0 without."""
        data = records.get(kind, bytes(4))
        if len(data) != 4:
            raise self.fail(f"element with a wrong {gds.record_name(kind)}")
        return int.from_bytes(data, "big", signed=True)
