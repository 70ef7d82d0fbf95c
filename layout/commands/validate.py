"""Strict conformance of a mask file: what readers let pass, and a mask shop might not."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from layout.formats import (
    CellContent,
    MaskContent,
    gdsii_read,
    hierarchy,
    mapped,
    oasis_read,
)
from layout.formats import gdsii_records as gdsii_bytes
from layout.formats import oasis_records as oasis_bytes
from layout.formats.oasis_cursor import Cursor
from layout.process import names
from metalens.ground.arrays import Array
from metalens.ground.errors import MaskFileError, ProcessError

_TABLES = (
    ("cell names", (oasis_bytes.CELLNAME, oasis_bytes.CELLNAME_REF)),
    ("text strings", (oasis_bytes.TEXTSTRING, oasis_bytes.TEXTSTRING_REF)),
    ("property names", (oasis_bytes.PROPNAME, oasis_bytes.PROPNAME_REF)),
    ("property strings", (oasis_bytes.PROPSTRING, oasis_bytes.PROPSTRING_REF)),
    ("layer names", (oasis_bytes.LAYERNAME, oasis_bytes.LAYERNAME_TEXT)),
    ("extension names", (oasis_bytes.XNAME, oasis_bytes.XNAME_REF)),
)


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that breaks the format or its good practice. byte: where, -1 where it
    has no single place.
    """

    byte: int
    text: str


def validate(path: str | Path, content: MaskContent | None = None) -> list[Finding]:
    """All findings about a GDSII or OASIS file, told apart by its first bytes; an empty
    list is a clean file.

    content: what was read of it, where it was read already.

    Raises:
        MaskFileError: an empty file.
        OSError: it cannot be opened.
    """
    data = mapped(path)
    oasis = data[: len(oasis_bytes.MAGIC)].tobytes() == oasis_bytes.MAGIC
    try:
        if content is None:
            content = oasis_read.read(path) if oasis else gdsii_read.read(path)
    except MaskFileError as error:
        return [Finding(_offset(error), str(error))]
    own = _oasis(path, data) if oasis else _gdsii(content, data)
    return [*_any(content), *own]


def _offset(error: MaskFileError) -> int:
    words = str(error).split("byte ", 1)[-1].split(":", 1)[0].split(" ", 1)[0]
    return int(words) if words.isdigit() else -1


def _any(content: MaskContent) -> Iterator[Finding]:
    """What holds for both formats."""
    if len(content.tops) != 1:
        yield Finding(
            -1,
            f"{len(content.tops)} top cells ({', '.join(content.tops[:5])}), need one",
        )
    for cell in content.cells.values():
        try:
            names.check(cell.name)
        except ProcessError as error:
            yield Finding(-1, str(error))
        for child in cell.placed.children:
            if child not in content.cells:
                yield Finding(
                    -1,
                    f"cell {cell.name!r} places {child!r}, which the file does not hold",
                )
        yield from _shapes(cell)
    try:
        hierarchy.ordered(content)
    except MaskFileError as error:
        yield Finding(-1, str(error))


def _shapes(cell: CellContent) -> Iterator[Finding]:
    for layer, polygons in cell.polygons.items():
        for points in polygons:
            if len({(int(x), int(y)) for x, y in points}) != len(points):
                yield Finding(
                    -1,
                    f"cell {cell.name!r}, layer {layer}: a polygon with a vertex twice",
                )
    for layer, circles in cell.circles.items():
        if any(radius == 0 for _, _, radius in circles):
            yield Finding(
                -1, f"cell {cell.name!r}, layer {layer}: a circle of radius 0"
            )


def _gdsii(content: MaskContent, data: Array) -> Iterator[Finding]:
    if len(data) % 2:
        yield Finding(len(data), f"{len(data)} bytes, need an even number")
    for cell in content.cells.values():
        for layer, polygons in cell.polygons.items():
            if max(layer) > 32767:
                yield Finding(
                    -1,
                    f"cell {cell.name!r}: layer {layer} is negative as a signed number",
                )
            longest = max(map(len, polygons)) + 1
            if longest > gdsii_bytes.MOST_POINTS:
                yield Finding(
                    -1,
                    f"cell {cell.name!r}: boundary of {longest} points, at most {gdsii_bytes.MOST_POINTS}",
                )


def _oasis(path: str | Path, data: Array) -> Iterator[Finding]:
    """The END record: tables where it says, and a checksum."""
    at = len(data) - oasis_bytes.END_SIZE
    start = Cursor(str(path), data, at=len(oasis_bytes.MAGIC) + 1)
    start.string()
    start.real()
    end = start if start.unsigned() == 0 else Cursor(str(path), data, at=at + 1)
    for table, kinds in _TABLES:
        strict, offset = end.unsigned(), end.unsigned()
        if (
            strict
            and offset
            and (offset >= at or int(data[offset]) not in (*kinds, oasis_bytes.CBLOCK))
        ):
            yield Finding(
                at,
                f"the table of {table} is said to start at byte {offset}, where it does not",
            )
        if not strict:
            yield Finding(at, f"{table} may stand anywhere; strict tables are wanted")
    if int(data[-5]) != 1:
        yield Finding(len(data) - 5, "no CRC-32 of the file")
