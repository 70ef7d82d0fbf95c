"""What stands in the cells of an OASIS file: placements, rectangles, polygons, circles,
texts, with modal values.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from layout.formats import oasis_trapezoids as trapezoids
from layout.formats import paths
from layout.formats.library import QUARTERS, Orientation
from layout.formats.oasis_cursor import ByteCursor
from layout.formats.oasis_records import OasisRecord
from layout.formats.open_cell import OpenCell, has_area
from layout.formats.read_loops import scan_placements
from layout.mask.plan import BLOCK_SITES
from layout.process.process import LayerNumber
from layout.shapes import polygon
from metalens.core.arrays import Array

_DRAWN = 8  # placements that take as much memory as a polygon without its corners
_POSITIONS = ("placement_x", "placement_y", "x", "y", "text_x", "text_y")


@dataclass
class ReadBudget:
    """Placements and copies of a whole file: at most ``limit``, ``used`` so far."""

    limit: int
    used: int = 0


class CellReader:
    """Reads the records of one cell.

    ``modal`` holds the values that a record may leave out because an earlier record of
    the cell gave them (SEMI P39, modal variables).
    """

    def __init__(self, cell: OpenCell, budget: ReadBudget) -> None:
        self.cell = cell
        self.budget = budget
        self.relative = False
        self.modal: dict[str, Any] = dict.fromkeys(_POSITIONS, 0)

    def read_record(self, c: ByteCursor, kind: int) -> bool:
        """Read the record of this kind that stands at the cursor; False where cells
        hold no such record.
        """
        reader = _READERS.get(kind)
        if reader is not None:
            reader(self, c, kind)
        return reader is not None

    def plain_placements(self, c: ByteCursor) -> None:
        """Placements in a row, by the compiled loop; stops before anything that it does
        not read: a name, a repetition, another record.
        """
        m = self.modal
        child = m.get("child")
        number = child if isinstance(child, int) else -1
        state = np.array([m["placement_x"], m["placement_y"], self.relative, number])
        while True:
            room = min(BLOCK_SITES, c.left // 2 + 1)
            out = np.empty((4, room), np.int32)
            at, count = scan_placements(c.data, c.at, c.end, state, out)
            has_moved, c.at = at > c.at, int(at)
            if count:
                numbers, x, y, turn = (row.copy() for row in out[:, :count])
                self._count(c, count)
                self.cell.add(numbers, x, y, turn.astype(np.uint8))
                m["placement_x"], m["placement_y"], _, m["child"] = state.tolist()
            self.relative = bool(state[2])
            if not has_moved:
                return

    def _count(self, c: ByteCursor, more: int) -> None:
        """Add to the placements and copies of the file; refuse more than the limit."""
        self.budget.used += more
        if self.budget.used > self.budget.limit:
            raise c.fail(
                f"{self.budget.used:,} placements and copies up to here (a drawn copy "
                f"counts as {_DRAWN} and its corners), at most {self.budget.limit:,} "
                "are read (metalens check --max-shapes sets another limit)"
            )

    def _value(
        self,
        c: ByteCursor,
        name: str,
        is_stated: int = 0,
        read: Callable[[], Any] | None = None,
    ) -> Any:
        """A modal value, read where the record states it.

        Raises:
            MaskFileError: the record lacks it, and so do those before it.
        """
        if is_stated and read is not None:
            self.modal[name] = read()
        if name not in self.modal:
            raise c.fail(f"record without {name}, and none before it in this cell")
        return self.modal[name]

    def _xy_mode(self, c: ByteCursor, kind: int) -> None:
        """Read XYABSOLUTE or XYRELATIVE."""
        self.relative = kind == OasisRecord.XYRELATIVE

    def _places(
        self, c: ByteCursor, info: int, bits: tuple[int, int, int], kind: str = ""
    ) -> tuple[Array, Array]:
        """(n,) x and (n,) y of an element and of its repetition.

        Args:
            c: cursor.
            info: first byte of the record.
            bits: of it that announce x, y and a repetition.
            kind: prefix of the modal position.
        """
        m = self.modal
        for axis, bit in zip("xy", bits, strict=False):
            if info & bit:
                before = m[kind + axis] if self.relative else 0
                m[kind + axis] = c.within(before + c.coordinate())
        x, y = m[kind + "x"], m[kind + "y"]
        if not info & bits[2]:
            return np.array([x]), np.array([y])
        left = self.budget.limit - self.budget.used
        copies = m["repetition"] = c.repetition(m.get("repetition"), left)
        for offsets, start in zip(copies, (x, y), strict=True):
            c.within(int(offsets.max()) + start)
            c.within(int(offsets.min()) + start)
        offset_x, offset_y = copies
        return offset_x + offset_x.dtype.type(x), offset_y + offset_y.dtype.type(y)

    def _placement(self, c: ByteCursor, kind: int) -> None:
        """Read PLACEMENT, with quarter turns, or with any angle and scale."""
        info = c.byte()
        child = self._value(
            c,
            "child",
            info & 0x80,
            c.extent if info & 0x40 else lambda: c.string(name=True),
        )
        turn = QUARTERS[info >> 1 & 3 | (info & 1) << 2]
        if kind == OasisRecord.PLACEMENT_ANY:
            size = c.real() if info & 4 else 1.0
            angle = c.real() if info & 2 else 0.0
            if not 0 < size < 1e9 or not abs(angle) < 1e9:
                raise c.fail(
                    f"placement turned by {angle} degrees and scaled by {size}; need a scale above 0"
                )
            turn = Orientation(angle % 360, bool(info & 1), size)
        x, y = self._places(c, info, (0x20, 0x10, 8), "placement_")
        self._count(c, len(x))
        number = self.cell.number(child) if isinstance(child, str) else child
        self.cell.place(number, x, y, turn)

    def _layer(self, c: ByteCursor, info: int) -> LayerNumber:
        """Layer and datatype of a shape."""
        layer = self._value(c, "layer", info & 1, c.unsigned)
        return layer, self._value(c, "datatype", info & 2, c.unsigned)

    def _size(self, c: ByteCursor, info: int) -> tuple[int, int]:
        """Width and height of a shape."""
        width = self._value(c, "width", info & 0x40, c.extent)
        return width, self._value(c, "height", info & 0x20, c.extent)

    def _draw(
        self, c: ByteCursor, info: int, layer: LayerNumber, points: Array, kind: int
    ) -> None:
        """Copies of a polygon, placed by the end of its record."""
        x, y = self._places(c, info, (0x10, 8, 4))
        self._count(c, len(x) * (_DRAWN + len(points)))
        if not has_area(points):
            reason = "" if kind == OasisRecord.XGEOMETRY else " without area"
            self.cell.skipped[OasisRecord(kind).name + reason] += len(x)
            return
        farthest = max(abs(self.modal["x"]), abs(self.modal["y"]))
        c.within(int(np.abs(points).max()) + farthest)
        self.cell.polygons.setdefault(layer, []).extend(
            points + np.array(place)
            for place in zip(x.tolist(), y.tolist(), strict=True)
        )

    def _rectangle(self, c: ByteCursor, kind: int) -> None:
        """Read RECTANGLE; a square has no height of its own."""
        info = c.byte()
        layer = self._layer(c, info)
        if info & 0x80:
            width = self._value(c, "width", info & 0x40, c.extent)
            height = self.modal["height"] = width
        else:
            width, height = self._size(c, info)
        points = np.array([[0, 0], [width, 0], [width, height], [0, height]])
        self._draw(c, info, layer, points, kind)

    def _polygon(self, c: ByteCursor, kind: int) -> None:
        """Read POLYGON."""
        info = c.byte()
        layer = self._layer(c, info)
        points = self._value(c, "point list", info & 0x20, c.points)
        self._draw(c, info, layer, points, kind)

    def _path(self, c: ByteCursor, kind: int) -> None:
        """Read PATH as its outline; a path of width 0 draws nothing."""
        info = c.byte()
        layer = self._layer(c, info)
        half = self._value(c, "half width", info & 0x40, c.extent)
        scheme = c.unsigned() if info & 0x80 else 0
        begin, end = (
            self._value(
                c,
                f"extension at its {which}",
                form,
                (lambda: 0, lambda: half, c.coordinate)[form - 1],
            )
            for which, form in (("start", scheme >> 2 & 3), ("end", scheme & 3))
        )
        points = self._value(
            c, "path points", info & 0x20, lambda: c.points(closed=False)
        )
        outline = paths.path_outline(points, half, begin=begin, end=end)
        self._draw(c, info, layer, outline if half else points[:1], kind)

    def _trapezoid(self, c: ByteCursor, kind: int) -> None:
        """Read TRAPEZOID: a w by h box, two sides slanted by a and b."""
        info = c.byte()
        layer = self._layer(c, info)
        w, h = self._size(c, info)
        a = c.coordinate() if kind != OasisRecord.TRAPEZOID_B else 0
        b = c.coordinate() if kind != OasisRecord.TRAPEZOID_A else 0
        is_upright = bool(info & 0x80)
        if max(abs(a), abs(b), abs(a - b)) > (h if is_upright else w):
            raise c.fail(
                f"trapezoid of {w} x {h} whose sides lean by {a} and {b} and cross"
            )
        points = trapezoids.slanted_trapezoid(w, h, a, b, upright=is_upright)
        self._draw(c, info, layer, points, kind)

    def _compact(self, c: ByteCursor, kind: int) -> None:
        """Read CTRAPEZOID, one of the types of a table."""
        info = c.byte()
        m = self.modal
        layer = self._layer(c, info)
        form = self._value(c, "type", info & 0x80, c.unsigned)
        if form >= trapezoids.KINDS:
            raise c.fail(
                f"compact trapezoid of type {form}, need 0 to {trapezoids.KINDS - 1}"
            )
        needs = trapezoids.required_sides(form)
        sides = [
            self._value(c, name, info & bit, c.extent) if info & bit or need else 0
            for name, bit, need in zip(
                ("width", "height"), (64, 32), needs, strict=True
            )
        ]
        m["width"], m["height"] = trapezoids.dependent_size(form, *sides)
        points = trapezoids.compact_trapezoid(form, *sides)
        self._draw(c, info, layer, points, kind)

    def _circle(self, c: ByteCursor, kind: int) -> None:
        """Read CIRCLE as a polygon of its area; radius 0 draws nothing."""
        info = c.byte()
        layer = self._layer(c, info)
        radius = self._value(c, "radius", info & 0x20, c.extent)
        points = polygon.disc_polygon(radius, (0, 0))
        self._draw(c, info, layer, points, kind)

    def _element(self, c: ByteCursor, kind: int) -> None:
        """XELEMENT, an element of an extension of the format, is counted, no more."""
        c.unsigned()
        c.string()
        self.cell.skipped["XELEMENT"] += 1

    def _geometry(self, c: ByteCursor, kind: int) -> None:
        """XGEOMETRY, geometry of an extension of the format, is counted, no more."""
        info = c.byte()
        c.unsigned()
        layer = self._layer(c, info)
        c.string()
        self._draw(c, info, layer, np.zeros((1, 2), np.int64), kind)

    def _text(self, c: ByteCursor, kind: int) -> None:
        """Texts are counted, no more."""
        info = c.byte()
        if info & 0x40:
            _ = c.unsigned() if info & 0x20 else c.string()
        for bit in (1, 2):
            if info & bit:
                c.unsigned()
        copies = len(self._places(c, info, (0x10, 8, 4), "text_")[0])
        self._count(c, copies)
        self.cell.skipped["text"] += copies


_READERS: dict[int, Callable[[CellReader, ByteCursor, int], None]] = {
    OasisRecord.XYABSOLUTE: CellReader._xy_mode,
    OasisRecord.XYRELATIVE: CellReader._xy_mode,
    OasisRecord.PLACEMENT: CellReader._placement,
    OasisRecord.PLACEMENT_ANY: CellReader._placement,
    OasisRecord.TEXT: CellReader._text,
    OasisRecord.RECTANGLE: CellReader._rectangle,
    OasisRecord.POLYGON: CellReader._polygon,
    OasisRecord.PATH: CellReader._path,
    OasisRecord.TRAPEZOID: CellReader._trapezoid,
    OasisRecord.TRAPEZOID_A: CellReader._trapezoid,
    OasisRecord.TRAPEZOID_B: CellReader._trapezoid,
    OasisRecord.CTRAPEZOID: CellReader._compact,
    OasisRecord.CIRCLE: CellReader._circle,
    OasisRecord.XELEMENT: CellReader._element,
    OasisRecord.XGEOMETRY: CellReader._geometry,
}
