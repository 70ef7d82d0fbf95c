"""GDSII reader: every record is checked; what is wrong is named with its byte offset."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from layout import gdsii_bytes as gds
from layout.content import CellContent, MaskContent, Placed, mapped
from layout.read_loops import sref_run
from metalens.errors import MaskFileError
from metalens.store import Array

_SKIPPED = {gds.ELFLAGS, gds.PLEX, gds.PROPATTR, gds.PROPVALUE, gds.PRESENTATION, gds.PATHTYPE, gds.WIDTH}
_HEADS = {0x00, 0x05} | {0x1F, 0x20, 0x22, 0x36, 0x23, 0x39}  # header records that libraries may add
_SHAPES = {gds.BOUNDARY, gds.BOX, gds.PATH, gds.TEXT, gds.NODE, gds.SREF, gds.AREF}
LIMIT = 2**29


@dataclass(eq=False, slots=True)
class _Batch:
    """Placements of the structure that is being read."""

    names: dict[bytes, int] = field(default_factory=dict)
    child: list[Array] = field(default_factory=list)
    x: list[Array] = field(default_factory=list)
    y: list[Array] = field(default_factory=list)
    turn: list[Array] = field(default_factory=list)

    def add(self, child: Array, x: Array, y: Array, turn: int) -> None:
        self.child.append(child.astype(np.int32))
        self.x.append(x.astype(np.int32))
        self.y.append(y.astype(np.int32))
        self.turn.append(np.full(len(child), turn, np.uint8))

    def number(self, name: bytes) -> int:
        return self.names.setdefault(name, len(self.names))

    def placed(self) -> Placed:
        if not self.child:
            return Placed((), *(np.empty(0, t) for t in (np.int32, np.int32, np.int32, np.uint8)))
        arrays = (np.concatenate(part) for part in (self.child, self.x, self.y, self.turn))
        return Placed(tuple(name.decode("ascii") for name in self.names), *arrays)


def read(path: str | Path, *, limit: int = LIMIT) -> MaskContent:
    """Read a GDSII file.

    Args:
        limit: most placements, arrays of references taken apart, that are read.

    Raises:
        MaskFileError: not GDSII, cut, or broken anywhere; the message gives the byte offset.
        OSError: the file cannot be opened.
    """
    return parse(mapped(path), limit=limit, where=str(path))


def parse(data: Array, *, limit: int = LIMIT, where: str = "data") -> MaskContent:
    """As :func:`read`, from the bytes of a GDSII stream as uint8; ``where`` names them in errors."""
    return _Reader(where, data, limit).library()


class _Reader:
    """A cursor over the records."""

    def __init__(self, path: str, data: Array, limit: int) -> None:
        self.path, self.data, self.at, self.limit = path, data, 0, limit
        self.begin = 0  # of the latest record

    def fail(self, text: str, at: int | None = None) -> MaskFileError:
        return MaskFileError(f"{self.path}: byte {self.begin if at is None else at}: {text}")

    def next(self, *wanted: int) -> tuple[int, bytes]:
        """Kind and data of the next record, which must be one of ``wanted`` (any, if none is named)."""
        self.begin, left = self.at, len(self.data) - self.at
        if left < 4:
            raise self.fail(f"the file ends within a record ({left} bytes left); it is cut")
        high, low, kind, data_type = (int(v) for v in self.data[self.at : self.at + 4])
        length = high << 8 | low
        if length < 4 or length % 2 or length > left:
            raise self.fail(f"record of {length} bytes, {left} left in the file; need an even length from 4 on")
        if kind in gds.DATA and gds.DATA[kind] != data_type:
            raise self.fail(f"{gds.NAMES[kind]} with data type {data_type}, need {gds.DATA[kind]}")
        if wanted and kind not in wanted:
            needed = " or ".join(gds.NAMES[k] for k in wanted)
            raise self.fail(f"found {gds.NAMES.get(kind, f'record 0x{kind:02x}')}, need {needed}")
        self.at += length
        return kind, self.data[self.begin + 4 : self.at].tobytes()

    def library(self) -> MaskContent:
        self.next(gds.HEADER)
        self.next(gds.BGNLIB)
        while self.next()[0] != gds.LIBNAME:
            if int(self.data[self.begin + 2]) not in _HEADS:
                raise self.fail("LIBNAME is missing")
        kind, data = self.next()
        while kind in _HEADS and kind != gds.BGNSTR:
            kind, data = self.next()
        if kind != gds.UNITS or len(data) != 16:
            raise self.fail("UNITS of two numbers is missing")
        user, meters = gds.to_float(data[:8]), gds.to_float(data[8:])
        if not (1e-15 < meters < 1 and user > 0):
            raise self.fail(f"database unit of {meters} m")
        cells: dict[str, CellContent] = {}
        while self.next(gds.BGNSTR, gds.ENDLIB)[0] == gds.BGNSTR:
            cell = self.structure()
            if cell.name in cells:
                raise self.fail(f"structure {cell.name!r} comes twice")
            cells[cell.name] = cell
        if self.data[self.at :].any():
            raise self.fail("data after ENDLIB", self.at)
        return MaskContent("GDSII", meters * 1e9, cells)

    def name(self, data: bytes) -> bytes:
        text = data[:-1] if data.endswith(b"\0") else data
        if not text or any(c <= 32 or c > 126 for c in text):
            raise self.fail(f"name {text[:40]!r}, need printable characters")
        return text

    def structure(self) -> CellContent:
        name = self.name(self.next(gds.STRNAME)[1]).decode("ascii")
        batch, texts = _Batch(), 0
        polygons: dict[tuple[int, int], list[Array]] = {}
        while True:
            self.references(batch)
            kind, _ = self.next(*_SHAPES, gds.ENDSTR)
            if kind == gds.ENDSTR:
                return CellContent(name, polygons, {}, batch.placed(), texts)
            if kind in (gds.SREF, gds.AREF):
                self.reference(batch, kind)
            elif kind in (gds.BOUNDARY, gds.BOX):
                layer, points = self.boundary(kind)
                polygons.setdefault(layer, []).append(points)
            else:
                texts += 1
                while self.next()[0] != gds.ENDEL:
                    self.refuse_outside_element()

    def refuse_outside_element(self) -> None:
        kind = int(self.data[self.begin + 2])
        if kind in _SHAPES or kind in (gds.BGNSTR, gds.ENDSTR, gds.ENDLIB, gds.HEADER):
            raise self.fail(f"{gds.NAMES[kind]} within an element; ENDEL is missing")

    def references(self, batch: _Batch) -> None:
        """Plain references in a row, by the compiled loop."""
        while True:
            names, child, x, y, end = sref_run(self.data, self.at)
            if not len(child):
                return
            numbers = np.array([batch.number(self.name(n)) for n in names], np.int32)
            batch.add(numbers[child], x, y, 0)
            self.at = end
            self.count(len(child))

    def count(self, more: int) -> None:
        self.limit -= more
        if self.limit < 0:
            raise self.fail("more placements than the limit that was set")

    def fields(self) -> dict[int, bytes]:
        """{kind: data} up to ENDEL."""
        found: dict[int, bytes] = {}
        while True:
            kind, data = self.next()
            if kind == gds.ENDEL:
                return found
            self.refuse_outside_element()
            found[kind] = data

    def numbers(self, found: dict[int, bytes], kind: int, count: int | None) -> Array:
        """Integers of a record that an element needs."""
        size = 4 if kind == gds.XY else 2
        data = found.get(kind)
        if data is None or len(data) % size or (count is not None and len(data) != count * size):
            raise self.fail(f"element with a wrong or missing {gds.NAMES[kind]}")
        return np.frombuffer(data, f">i{size}").astype(np.int64)

    def boundary(self, kind: int) -> tuple[tuple[int, int], Array]:
        start = self.begin
        found = self.fields()
        layer = int(self.numbers(found, gds.LAYER, 1)[0])
        datatype = int(self.numbers(found, gds.DATATYPE if kind == gds.BOUNDARY else gds.BOXTYPE, 1)[0])
        points = self.numbers(found, gds.XY, None)
        if len(points) % 2 or len(points) < 8:
            raise self.fail(f"boundary of {len(points) // 2} points, need at least 4 (first and last alike)", start)
        points = points.reshape(-1, 2)
        if (points[0] != points[-1]).any():
            raise self.fail("boundary that is not closed", start)
        return (layer & 0xFFFF, datatype & 0xFFFF), points[:-1]

    def reference(self, batch: _Batch, kind: int) -> None:
        start = self.begin
        found = self.fields()
        number = batch.number(self.name(found.get(gds.SNAME, b"")))
        turn = self.turn(found, start)
        xy = self.numbers(found, gds.XY, 2 if kind == gds.SREF else 6)
        if kind == gds.SREF:
            x, y = xy[:1], xy[1:]
        else:
            columns, rows = (int(v) for v in self.numbers(found, gds.COLROW, 2))
            if columns < 1 or rows < 1:
                raise self.fail(f"array of {columns} x {rows}", start)
            self.count(columns * rows)
            i, j = np.meshgrid(np.arange(columns), np.arange(rows))
            x = (xy[0] + i * ((xy[2] - xy[0]) / columns) + j * ((xy[4] - xy[0]) / rows)).ravel()
            y = (xy[1] + i * ((xy[3] - xy[1]) / columns) + j * ((xy[5] - xy[1]) / rows)).ravel()
        batch.add(np.full(len(x), number), x, y, turn)

    def turn(self, found: dict[int, bytes], start: int) -> int:
        flags = found.get(gds.STRANS, b"\0\0")
        angle, size = (gds.to_float(found[k]) if len(found.get(k, b"")) == 8 else d for k, d in _DEFAULTS)
        if angle % 90 or size != 1 or len(flags) != 2:
            raise self.fail(f"reference turned by {angle} degrees and scaled by {size}; need quarter turns only", start)
        return int(angle // 90) & 3 | (4 if flags[0] & 128 else 0)


_DEFAULTS = ((gds.ANGLE, 0.0), (gds.MAG, 1.0))
