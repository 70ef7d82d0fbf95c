"""OASIS reader for mask files: names, cells, compressed blocks, checksum; what is wrong
is named with its byte.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

from layout.formats import oasis_records as oasis
from layout.formats.files import CONTEXT_CELL, MOST_PLACEMENTS, map_bytes
from layout.formats.library import MaskCell, MaskLibrary
from layout.formats.oasis_cells import CellReader, ReadBudget
from layout.formats.oasis_cursor import ByteCursor
from layout.formats.oasis_records import OasisRecord
from layout.formats.open_cell import OpenCell
from metalens.core.arrays import Array

_NUMBERED_NAMES = (
    OasisRecord.TEXTSTRING_REF,
    OasisRecord.PROPNAME_REF,
    OasisRecord.PROPSTRING_REF,
    OasisRecord.XNAME_REF,
)
_BYTES_EACH = 16  # of a compressed block, for each placement that may be read


def read_oasis(
    path: str | Path, *, limit: int = MOST_PLACEMENTS, keep: int | None = None
) -> MaskLibrary:
    """Read an OASIS file.

    Args:
        limit: most placements and copies that are read.
        keep: most placements of one cell that are kept; of more only the sums are
            (:mod:`layout.formats.digest`), in
            bounded memory. None: all are kept.
        path: of the file.

    Raises:
        MaskFileError: not OASIS, cut, broken anywhere, of a wrong checksum, or with
            records that no mask of
            pillars holds; the message gives the byte offset.
        OSError: the file cannot be opened.
    """
    return parse_oasis(map_bytes(path), limit=limit, keep=keep, where=str(path))


def parse_oasis(
    data: Array,
    *,
    limit: int = MOST_PLACEMENTS,
    keep: int | None = None,
    where: str = "data",
) -> MaskLibrary:
    """Read an OASIS file from its bytes, as :func:`read_oasis`.

    Args:
        data: bytes, uint8.
        limit: most placements and copies that are read.
        keep: most placements of one cell that are kept; None: all.
        where: name of the bytes in errors.
    """
    return _OasisReader(ByteCursor(where, data), limit, keep).whole_file()


class _OasisReader:
    """The file level; ``cell`` reads what stands in the open cell."""

    def __init__(self, cursor: ByteCursor, limit: int, keep: int | None) -> None:
        self.file = cursor
        self.budget = ReadBudget(limit)
        self.keep = keep
        self.cell: CellReader | None = None
        self.cells: list[OpenCell] = []
        self.names: dict[int, str] = {}
        self.explicit: set[bool] = set()
        self.layer_names: dict[tuple[int, int], str] = {}
        self.end_at: int | None = None

    def whole_file(self) -> MaskLibrary:
        """Everything, from the magic bytes to the checksum."""
        c = self.file
        if c.left < len(oasis.MAGIC) or c.take(len(oasis.MAGIC)) != oasis.MAGIC:
            raise c.fail("no OASIS file: the magic bytes are missing")
        unit_nm, offsets_here = self._start()
        self._records(c)
        if self.end_at is None:
            raise c.fail("the file ends without END; it is cut")
        self._check_end(offsets_here)
        cells = self._contents()
        names = self.layer_names
        return MaskLibrary("", cells, unit_nm, names, kind="OASIS")

    def _start(self) -> tuple[float, bool]:
        """Read START: database unit, and whether the table offsets are in it."""
        c = self.file
        c.begin = c.at
        if c.byte() != OasisRecord.START:
            raise c.fail("START is missing")
        version = c.string()
        if version != "1.0":
            raise c.fail(f"OASIS version {version[:20]!r}, need '1.0'")
        steps = c.real()
        if not 1e-6 < steps < 1e9:
            raise c.fail(f"{steps} grid steps in a micrometre")
        offsets_here = c.unsigned() == 0
        if offsets_here:
            self._offsets(c)
        return 1e3 / steps, offsets_here

    def _offsets(self, c: ByteCursor) -> None:
        """Read and ignore the six table offsets."""
        for _ in range(6):
            if c.unsigned() > 1:
                raise c.fail("table offset with a flag beyond 1")
            c.unsigned()

    def _records(self, c: ByteCursor) -> None:
        """All records at the cursor, up to its end or END."""
        while c.left and self.end_at is None:
            if self.cell is not None:
                self.cell.plain_placements(c)
                if not c.left:
                    break
            c.begin = c.at
            self._record(c, c.byte())

    def _record(self, c: ByteCursor, kind: int) -> None:
        """Read one record of the file level, or pass it to the open cell."""
        if kind in (OasisRecord.CELL_REF, OasisRecord.CELL):
            is_named = kind == OasisRecord.CELL
            key = c.string(name=True) if is_named else c.within(c.unsigned())
            self.cells.append(OpenCell(key, self.keep))
            self.cell = CellReader(self.cells[-1], self.budget)
        elif kind == OasisRecord.CBLOCK:
            self._block(c)
        elif kind in (OasisRecord.PROPERTY, OasisRecord.PROPERTY_REPEAT):
            self._property(c, kind)
        elif self.cell is not None and self.cell.read_record(c, kind):
            return
        elif kind in (OasisRecord.CELLNAME, OasisRecord.CELLNAME_REF):
            self._cell_name(c, kind == OasisRecord.CELLNAME_REF)
        elif kind in (OasisRecord.LAYERNAME, OasisRecord.LAYERNAME_TEXT):
            self._layer_name(c, kind)
        elif OasisRecord.TEXTSTRING <= kind <= OasisRecord.PROPSTRING_REF:
            self._other_name(c, kind)
        elif kind in (OasisRecord.XNAME, OasisRecord.XNAME_REF):
            c.unsigned()
            self._other_name(c, kind)
        elif kind == OasisRecord.XELEMENT and self.cell is None:
            c.unsigned()
            c.string()
        elif kind == OasisRecord.END and c is self.file:
            self.end_at = c.begin
        elif kind != OasisRecord.PAD:
            raise c.fail(f"record of kind {kind}, which no pillar mask holds here")

    def _block(self, c: ByteCursor) -> None:
        """Unpack a CBLOCK and read its records; sizes are checked first."""
        if c is not self.file:
            raise c.fail("a compressed block within another")
        if c.unsigned() != 0:
            raise c.fail("a compressed block of an unknown method, need deflate")
        size = c.unsigned()
        packed = c.unsigned()
        if packed > c.left:
            raise c.fail(
                f"compressed block of {packed} bytes for {size}, with {c.left} left in the file"
            )
        if size > _BYTES_EACH * self.budget.limit:
            most = _BYTES_EACH * self.budget.limit
            raise c.fail(
                f"compressed block of {size:,} bytes, at most {most:,} are unpacked"
            )
        try:
            engine = zlib.decompressobj(-15)
            raw = engine.decompress(c.take(packed), size + 1)
        except zlib.error as error:
            raise c.fail(
                f"compressed block that cannot be unpacked ({error})"
            ) from None
        if len(raw) != size or not engine.eof or engine.unused_data:
            raise c.fail(
                f"compressed block of {len(raw)} bytes where {size} are announced"
            )
        self._records(ByteCursor(c.path, np.frombuffer(raw, np.uint8), block=c.begin))

    def _cell_name(self, c: ByteCursor, explicit: bool) -> None:
        """Read CELLNAME, numbered in order or explicitly."""
        name = c.string(name=True)
        self.explicit.add(explicit)
        number = c.within(c.unsigned()) if explicit else len(self.names)
        if len(self.explicit) > 1 or number in self.names:
            raise c.fail(
                f"cell name {name!r}: number {number} is taken, or two ways of numbering are mixed"
            )
        self.names[number] = name
        self.cell = None

    def _layer_name(self, c: ByteCursor, kind: int) -> None:
        """Read LAYERNAME; kept for a single layer and datatype."""
        name = c.string(name=True)
        first = [self._interval(c) for _ in range(2)]
        if kind == OasisRecord.LAYERNAME and None not in first:
            self.layer_names[first[0] or 0, first[1] or 0] = name
        self.cell = None

    def _interval(self, c: ByteCursor) -> int | None:
        """The single number of an interval; None for any other interval."""
        form = c.unsigned()
        if form > 4:
            raise c.fail(f"interval of type {form}, need 0 to 4")
        numbers = [c.unsigned() for _ in range((0, 1, 1, 1, 2)[form])]
        return numbers[0] if form == 3 else None

    def _other_name(self, c: ByteCursor, kind: int) -> None:
        """Read and ignore a name of another table."""
        c.string()
        if kind in _NUMBERED_NAMES:
            c.unsigned()
        self.cell = None

    def _property(self, c: ByteCursor, kind: int) -> None:
        """Properties are passed over."""
        if kind == OasisRecord.PROPERTY_REPEAT:
            return
        info = c.byte()
        if info & 4:
            _ = c.unsigned() if info & 2 else c.string()
        if info & 8:
            return
        count = info >> 4 if info >> 4 < 15 else c.unsigned()
        for _ in range(count):
            self._property_value(c)

    def _property_value(self, c: ByteCursor) -> None:
        """Read and ignore a value of a property."""
        form = c.byte()
        if form <= 7:
            c.at -= 1
            c.real()
        elif form in (8, 13, 14, 15):
            c.unsigned()
        elif form == 9:
            c.signed()
        elif form in (10, 11, 12):
            c.string()
        else:
            raise c.fail(f"property value of type {form}, need 0 to 15")

    def _check_end(self, offsets_before: bool) -> None:
        """Check the size of END, its offsets, and the CRC-32 where there is one."""
        c = self.file
        c.begin = self.end_at or 0
        if c.end - c.begin != oasis.END_SIZE:
            raise c.fail(
                f"END of {c.end - c.begin} bytes to the end of the file, need {oasis.END_SIZE}"
            )
        if not offsets_before:
            self._offsets(c)
        c.string()
        scheme = c.unsigned()
        if scheme not in (0, 1, 2) or c.left != (4 if scheme else 0):
            raise c.fail(f"validation scheme {scheme} with {c.left} bytes left")
        if scheme == 1:
            computed = zlib.crc32(c.data[: c.at].data)
            stated = struct.unpack("<I", c.take(4))[0]
            if computed != stated:
                raise c.fail(
                    f"checksum {computed:08x}, the file says {stated:08x}; the file is damaged"
                )

    def _contents(self) -> dict[str, MaskCell]:
        """{name: cell}, once all names are known."""
        cells: dict[str, MaskCell] = {}
        for cell in self.cells:
            try:
                name = cell.key if isinstance(cell.key, str) else self.names[cell.key]
                content = cell.close(name, self.names)
            except KeyError as error:
                raise self.file.fail(f"cell number {error} has no name") from None
            if name in cells:
                raise self.file.fail(f"cell {name!r} comes twice")
            cells[name] = content
        cells.pop(CONTEXT_CELL, None)
        return cells
