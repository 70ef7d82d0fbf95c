"""What stands in the cells of an OASIS file: placements, rectangles, polygons, circles,
texts, with modal values.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from layout.formats import oasis_records as oasis
from layout.formats import oasis_trapezoids as trapezoids
from layout.formats import paths
from layout.formats.library import QUARTERS, Orientation
from layout.formats.oasis_cursor import ByteCursor, RepetitionOffsets
from layout.formats.open_cell import Child, OpenCell, has_area
from layout.formats.read_loops import scan_placements
from metalens.core.arrays import Array

Value = TypeVar("Value")
_BATCH = 1 << 18
_DRAWN = 8  # placements that take as much memory as a polygon without its corners


@dataclass(slots=True)
class ReadBudget:
    """Placements and copies of a whole file: at most ``limit``, ``used`` so far."""

    limit: int
    used: int = 0

    @property
    def left(self) -> int:
        """How many more may come."""
        return self.limit - self.used


@dataclass(eq=False, slots=True)
class ModalState:
    """Values that a record may leave out because an earlier one gave them; forgotten at
    each cell.
    """

    relative: bool = False
    placement_x: int = 0
    placement_y: int = 0
    child: Child | None = None
    x: int = 0
    y: int = 0
    text_x: int = 0
    text_y: int = 0
    layer: int | None = None
    datatype: int | None = None
    width: int | None = None
    height: int | None = None
    radius: int | None = None
    points: Array | None = None
    half_width: int | None = None
    path_points: Array | None = None
    path_begin: int | None = None
    path_end: int | None = None
    kind: int | None = None
    repetition: RepetitionOffsets | None = None


class CellReader:
    """Reads the records of one cell."""

    def __init__(self, cell: OpenCell, budget: ReadBudget) -> None:
        self.cell = cell
        self.budget = budget
        self.modal = ModalState()

    def record(self, c: ByteCursor, kind: int) -> bool:
        """Read the record of this kind that stands at the cursor; False where cells
        hold no such record.
        """
        if kind in (oasis.XYABSOLUTE, oasis.XYRELATIVE):
            self.modal.relative = kind == oasis.XYRELATIVE
        elif kind in (oasis.PLACEMENT, oasis.PLACEMENT_ANY):
            self._placement(c, kind)
        elif kind == oasis.TEXT:
            self._text(c)
        elif kind == oasis.RECTANGLE:
            self._rectangle(c)
        elif kind == oasis.POLYGON:
            self._polygon(c)
        elif kind == oasis.CIRCLE:
            self._circle(c)
        elif kind == oasis.PATH:
            self._path(c)
        elif kind in (oasis.TRAPEZOID, oasis.TRAPEZOID_A, oasis.TRAPEZOID_B):
            self._trapezoid(c, kind)
        elif kind == oasis.CTRAPEZOID:
            self._compact(c)
        elif kind == oasis.XELEMENT:
            c.unsigned()
            c.string()
            self.cell.skipped["XELEMENT"] += 1
        elif kind == oasis.XGEOMETRY:
            self._extension(c)
        else:
            return False
        return True

    def plain_placements(self, c: ByteCursor) -> None:
        """Placements in a row, by the compiled loop; stops before anything that it does
        not know.
        """
        m = self.modal
        state = np.array(
            [
                m.placement_x,
                m.placement_y,
                m.relative,
                m.child if isinstance(m.child, int) else -1,
            ]
        )
        while True:
            room = min(_BATCH, c.left // 2 + 1)
            out = np.empty((4, room), np.int32)
            at, count = scan_placements(c.data, c.at, c.end, state, out)
            has_moved, c.at = at > c.at, int(at)
            if count:
                child, x, y, turn = (row.copy() for row in out[:, :count])
                self._count(c, count)
                self.cell.held.add(child, x, y, turn.astype(np.uint8))
                m.placement_x = int(state[0])
                m.placement_y = int(state[1])
                m.child = int(state[3])
            m.relative = bool(state[2])
            if not has_moved:
                return

    def _count(self, c: ByteCursor, more: int) -> None:
        """Add to the placements and copies of the file; refuse more than the limit."""
        self.budget.used += more
        if self.budget.used > self.budget.limit:
            raise c.fail(
                f"{self.budget.used:,} placements and copies up to here (a drawn copy counts as {_DRAWN} and its "
                f"corners), at most {self.budget.limit:,} are read (metalens check --max-shapes sets another limit)"
            )

    def _need(self, c: ByteCursor, value: Value | None, what: str) -> Value:
        """A modal value; refuse a record that lacks it."""
        if value is None:
            raise c.fail(f"record without {what}, and none before it in this cell")
        return value

    def _position(
        self, c: ByteCursor, info: int, bits: tuple[int, int], previous: tuple[int, int]
    ) -> tuple[int, int]:
        """(x, y) of an element: stated, relative to the previous one, or equal to it.

        Args:
            c: cursor at the coordinates.
            info: byte of the record that says which coordinates follow.
            bits: bits of x and of y in ``info``.
            previous: modal x and y.
        """
        position = []
        for bit, old in zip(bits, previous, strict=True):
            new = c.coordinate() if info & bit else None
            if new is not None and self.modal.relative:
                new = c.within(old + new)
            position.append(old if new is None else new)
        return position[0], position[1]

    def _repeated(
        self, c: ByteCursor, info: int, bit: int, x: int, y: int
    ) -> tuple[Array, Array]:
        """(n,) x and (n,) y of an element and its repetition, if the record has one."""
        if not info & bit:
            return np.array([x]), np.array([y])
        self.modal.repetition = c.repetition(self.modal.repetition, self.budget.left)
        copies = self.modal.repetition
        for offsets, start in ((copies.x, x), (copies.y, y)):
            c.within(int(offsets.max()) + start)
            c.within(int(offsets.min()) + start)
        return copies.x + copies.x.dtype.type(x), copies.y + copies.y.dtype.type(y)

    def _placement(self, c: ByteCursor, kind: int) -> None:
        """Read PLACEMENT, with quarter turns, or with any angle and scale."""
        info = c.byte()
        m = self.modal
        if info & 0x80:
            m.child = c.within(c.unsigned()) if info & 0x40 else c.string(name=True)
        child = m.child
        if child is None:
            raise c.fail("placement without a cell, and none before it in this cell")
        turn = QUARTERS[info >> 1 & 3 | (info & 1) << 2]
        if kind == oasis.PLACEMENT_ANY:
            size = c.real() if info & 4 else 1.0
            angle = c.real() if info & 2 else 0.0
            if not 0 < size < 1e9 or not abs(angle) < 1e9:
                raise c.fail(
                    f"placement turned by {angle} degrees and scaled by {size}; need a scale above 0"
                )
            turn = Orientation(angle % 360, bool(info & 1), size)
        m.placement_x, m.placement_y = self._position(
            c, info, (0x20, 0x10), (m.placement_x, m.placement_y)
        )
        x, y = self._repeated(c, info, 8, m.placement_x, m.placement_y)
        number = self.cell.number(child) if isinstance(child, str) else child
        self._count(c, len(x))
        self.cell.place(number, x, y, turn)

    def _layer(self, c: ByteCursor, info: int) -> None:
        """Read layer and datatype where the record states them."""
        if info & 1:
            self.modal.layer = c.unsigned()
        if info & 2:
            self.modal.datatype = c.unsigned()

    def _place(
        self, c: ByteCursor, info: int, corners: int
    ) -> tuple[tuple[int, int], Array, Array]:
        """Layer and positions of a shape, from the end of its record."""
        m = self.modal
        m.x, m.y = self._position(c, info, (0x10, 8), (m.x, m.y))
        x, y = self._repeated(c, info, 4, m.x, m.y)
        self._count(c, len(x) * (_DRAWN + corners))
        return (
            (self._need(c, m.layer, "layer"), self._need(c, m.datatype, "datatype")),
            x,
            y,
        )

    def _polygons(self, c: ByteCursor, info: int, points: Array, what: str) -> None:
        """Copies of a polygon; ``what`` names its kind where it draws nothing."""
        layer, x, y = self._place(c, info, len(points))
        if not has_area(points):
            self.cell.skipped[f"{what} without area"] += len(x)
            return
        c.within(int(np.abs(points).max()) + max(abs(self.modal.x), abs(self.modal.y)))
        shapes = self.cell.polygons.setdefault(layer, [])
        shapes.extend(
            points + np.array(place)
            for place in zip(x.tolist(), y.tolist(), strict=True)
        )

    def _rectangle(self, c: ByteCursor) -> None:
        """Read RECTANGLE."""
        info = c.byte()
        m = self.modal
        self._layer(c, info)
        if info & 0x40:
            m.width = c.within(c.unsigned())
        if info & 0x80:  # a square has no height of its own
            m.height = m.width
        elif info & 0x20:
            m.height = c.within(c.unsigned())
        width = self._need(c, m.width, "width")
        height = self._need(c, m.height, "height")
        self._polygons(
            c,
            info,
            np.array([[0, 0], [width, 0], [width, height], [0, height]]),
            "RECTANGLE",
        )

    def _polygon(self, c: ByteCursor) -> None:
        """Read POLYGON."""
        info = c.byte()
        m = self.modal
        self._layer(c, info)
        if info & 0x20:
            m.points = c.points()
        self._polygons(c, info, self._need(c, m.points, "point list"), "POLYGON")

    def _path(self, c: ByteCursor) -> None:
        """Read PATH as its outline; a path of width 0 draws nothing."""
        info = c.byte()
        m = self.modal
        self._layer(c, info)
        if info & 0x40:
            m.half_width = c.within(c.unsigned())
        if info & 0x80:
            scheme = c.unsigned()
            m.path_begin = self._extent(c, scheme >> 2 & 3, m.path_begin)
            m.path_end = self._extent(c, scheme & 3, m.path_end)
        if info & 0x20:
            m.path_points = c.points(closed=False)
        points = self._need(c, m.path_points, "point list")
        half = self._need(c, m.half_width, "width")
        begin = self._need(c, m.path_begin, "extension at its start")
        end = self._need(c, m.path_end, "extension at its end")
        outline = paths.path_outline(points, half, begin=begin, end=end)
        self._polygons(c, info, outline if half else points[:1], "PATH")

    def _extent(self, c: ByteCursor, form: int, last: int | None) -> int | None:
        """Extension of a path: as before (0), none, its half width, or stated (3)."""
        if form < 2:
            return 0 if form else last
        if form == 2:
            return self._need(c, self.modal.half_width, "width")
        return c.coordinate()

    def _trapezoid(self, c: ByteCursor, kind: int) -> None:
        """Read TRAPEZOID: a w by h box, two sides slanted by a and b."""
        info = c.byte()
        m = self.modal
        self._layer(c, info)
        self._size(c, info)
        a = c.coordinate() if kind != oasis.TRAPEZOID_B else 0
        b = c.coordinate() if kind != oasis.TRAPEZOID_A else 0
        w = self._need(c, m.width, "width")
        h = self._need(c, m.height, "height")
        if max(abs(a), abs(b), abs(a - b)) > (h if info & 0x80 else w):
            raise c.fail(
                f"trapezoid of {w} x {h} whose sides lean by {a} and {b} and cross"
            )
        self._polygons(
            c,
            info,
            trapezoids.slanted_trapezoid(w, h, a, b, upright=bool(info & 0x80)),
            "TRAPEZOID",
        )

    def _size(self, c: ByteCursor, info: int) -> None:
        """Read width and height where the record states them."""
        if info & 0x40:
            self.modal.width = c.within(c.unsigned())
        if info & 0x20:
            self.modal.height = c.within(c.unsigned())

    def _compact(self, c: ByteCursor) -> None:
        """Read CTRAPEZOID, one of the types of a table."""
        info = c.byte()
        m = self.modal
        self._layer(c, info)
        if info & 0x80:
            m.kind = c.unsigned()
        self._size(c, info)
        kind = self._need(c, m.kind, "type")
        if kind >= trapezoids.KINDS:
            raise c.fail(
                f"compact trapezoid of type {kind}, need 0 to {trapezoids.KINDS - 1}"
            )
        needs_width, needs_height = trapezoids.required_sides(kind)
        width = self._need(c, m.width, "width") if needs_width else 0
        height = self._need(c, m.height, "height") if needs_height else 0
        size = trapezoids.dependent_size(kind, width, height)
        m.width, m.height = size
        self._polygons(
            c, info, trapezoids.compact_trapezoid(kind, width, height), "CTRAPEZOID"
        )

    def _circle(self, c: ByteCursor) -> None:
        """Read CIRCLE; a circle of radius 0 draws nothing."""
        info = c.byte()
        m = self.modal
        self._layer(c, info)
        if info & 0x20:
            m.radius = c.within(c.unsigned())
        radius = self._need(c, m.radius, "radius")
        layer, x, y = self._place(c, info, 1)
        if not radius:
            self.cell.skipped["CIRCLE without area"] += len(x)
            return
        shapes = self.cell.circles.setdefault(layer, [])
        shapes.extend(
            (px, py, radius) for px, py in zip(x.tolist(), y.tolist(), strict=True)
        )

    def _extension(self, c: ByteCursor) -> None:
        """XGEOMETRY, geometry of an extension of the format, is counted, no more."""
        info = c.byte()
        c.unsigned()
        self._layer(c, info)
        c.string()
        _, x, _ = self._place(c, info, 1)
        self.cell.skipped["XGEOMETRY"] += len(x)

    def _text(self, c: ByteCursor) -> None:
        """Texts are counted, no more."""
        info = c.byte()
        m = self.modal
        if info & 0x40:
            _ = c.unsigned() if info & 0x20 else c.string()
        for bit in (1, 2):
            if info & bit:
                c.unsigned()
        m.text_x, m.text_y = self._position(c, info, (0x10, 8), (m.text_x, m.text_y))
        x, _ = self._repeated(c, info, 4, m.text_x, m.text_y)
        self._count(c, len(x))
        self.cell.texts += len(x)
