"""Strict conformance of a mask file: what readers let pass, and a mask shop might not."""

from collections.abc import Iterator
from pathlib import Path

from layout.formats import gdsii_records as gdsii_bytes
from layout.formats import oasis_records as oasis_bytes
from layout.formats.files import map_bytes
from layout.formats.library import MaskCell, MaskLibrary
from layout.formats.oasis_cursor import ByteCursor
from layout.process import names
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError, ProcessError

_TABLES = (
    ("cell names", (oasis_bytes.CELLNAME, oasis_bytes.CELLNAME_REF)),
    ("text strings", (oasis_bytes.TEXTSTRING, oasis_bytes.TEXTSTRING_REF)),
    ("property names", (oasis_bytes.PROPNAME, oasis_bytes.PROPNAME_REF)),
    ("property strings", (oasis_bytes.PROPSTRING, oasis_bytes.PROPSTRING_REF)),
    ("layer names", (oasis_bytes.LAYERNAME, oasis_bytes.LAYERNAME_TEXT)),
    ("extension names", (oasis_bytes.XNAME, oasis_bytes.XNAME_REF)),
)


def validate_mask(path: str | Path, content: MaskLibrary) -> list[str]:
    """What breaks the format of a mask file or its good practice; empty for nothing.

    The first bytes of the file tell its format.

    Args:
        path: of the file.
        content: what was read of it.
    """
    data = map_bytes(path)
    is_oasis = data[: len(oasis_bytes.MAGIC)].tobytes() == oasis_bytes.MAGIC
    of_format = _oasis(path, data) if is_oasis else _gdsii(content, data)
    return [*_any(content), *of_format]


def _any(content: MaskLibrary) -> Iterator[str]:
    """What holds for both formats."""
    if len(content.tops) != 1:
        yield (
            f"{len(content.tops)} top cells ({', '.join(content.tops[:5])}), need one"
        )
    for cell in content.cells.values():
        try:
            names.check_cell_name(cell.name)
        except ProcessError as error:
            yield str(error)
        for child in cell.placed.children:
            if child not in content.cells:
                yield (
                    f"cell {cell.name!r} places {child!r}, which the file does not hold"
                )
        yield from _shapes(cell)
    try:
        content.topological_order()
    except MaskFileError as error:
        yield str(error)


def _shapes(cell: MaskCell) -> Iterator[str]:
    """Polygons with a repeated vertex, and circles of radius 0, of a cell."""
    for layer, polygons in cell.polygons.items():
        for points in polygons:
            if len({(int(x), int(y)) for x, y in points}) != len(points):
                yield (
                    f"cell {cell.name!r}, layer {layer}: a polygon with a vertex twice"
                )
    for layer, circles in cell.circles.items():
        if any(radius == 0 for _, _, radius in circles):
            yield f"cell {cell.name!r}, layer {layer}: a circle of radius 0"


def _gdsii(content: MaskLibrary, data: Array) -> Iterator[str]:
    """What GDSII forbids: odd length, large layer numbers, long boundaries."""
    if len(data) % 2:
        yield f"{len(data)} bytes, need an even number"
    for cell in content.cells.values():
        for layer, polygons in cell.polygons.items():
            if max(layer) > 32767:
                yield (
                    f"cell {cell.name!r}: layer {layer} is negative as a signed number"
                )
            longest = max(map(len, polygons)) + 1
            if longest > gdsii_bytes.MOST_POINTS:
                yield (
                    f"cell {cell.name!r}: boundary of {longest} points, at most {gdsii_bytes.MOST_POINTS}"
                )


def _oasis(path: str | Path, data: Array) -> Iterator[str]:
    """The END record: tables where it says, and a checksum."""
    end_at = len(data) - oasis_bytes.END_SIZE
    start = ByteCursor(str(path), data, at=len(oasis_bytes.MAGIC) + 1)
    start.string()
    start.real()
    end = start if start.unsigned() == 0 else ByteCursor(str(path), data, at=end_at + 1)
    for table, kinds in _TABLES:
        strict = end.unsigned()
        offset = end.unsigned()
        if (
            strict
            and offset
            and (
                offset >= end_at
                or int(data[offset]) not in (*kinds, oasis_bytes.CBLOCK)
            )
        ):
            yield (
                f"the table of {table} is said to start at byte {offset}, where it does not"
            )
        if not strict:
            yield f"{table} may stand anywhere; strict tables are wanted"
    if int(data[-5]) != 1:
        yield "no CRC-32 of the file"
