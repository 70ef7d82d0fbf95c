"""What stands in the cells of an OASIS file: placements, rectangles, polygons, circles, texts, with modal values."""

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from layout import oasis_bytes as oasis
from layout.content import NOTHING, CellContent, Placed
from layout.oasis_cursor import Cursor, Repetition
from layout.read_loops import placements
from metalens.store import Array

Child = int | str  # reference number, or name
Value = TypeVar("Value")
_BATCH = 1 << 18


@dataclass(eq=False, slots=True)
class Modal:
    """Values that a record may leave out because an earlier one gave them; forgotten at each cell."""

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
    repetition: Repetition | None = None


@dataclass(eq=False, slots=True)
class OpenCell:
    """A cell while it is read. names: of children that are placed by name, numbered from -2 down."""

    key: Child
    polygons: dict[tuple[int, int], list[Array]] = field(default_factory=dict)
    circles: dict[tuple[int, int], list[tuple[int, int, int]]] = field(default_factory=dict)
    parts: list[tuple[Array, Array, Array, Array]] = field(default_factory=list)
    names: dict[str, int] = field(default_factory=dict)
    texts: int = 0

    def close(self, name: str, table: dict[int, str]) -> CellContent:
        """The finished cell; KeyError names a reference number without a name."""
        return CellContent(name, self.polygons, self.circles, self._placed(table), self.texts)

    def _placed(self, table: dict[int, str]) -> Placed:
        if not self.parts:
            return NOTHING
        child, x, y, turn = (np.concatenate(part) for part in zip(*self.parts, strict=True))
        low, high = int(child.min()), int(child.max())
        if high - low < 1 << 22:
            used = np.flatnonzero(np.bincount(child - low)) + low
            lookup = np.zeros(high - low + 1, np.int32)
            lookup[used - low] = np.arange(len(used))
            index = lookup[child - low]
        else:
            used, index = np.unique(child, return_inverse=True)
        own = {number: name for name, number in self.names.items()}
        names = tuple(own[k] if k < 0 else table[k] for k in used.tolist())
        return Placed(names, index.astype(np.int32), x, y, turn)


class CellReader:
    """Reads the records of one cell."""

    def __init__(self, cell: OpenCell, limit: int) -> None:
        self.cell, self.limit, self.modal = cell, limit, Modal()

    def record(self, c: Cursor, kind: int) -> bool:
        """Read the record of this kind that stands at the cursor; False where cells hold no such record."""
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
        else:
            return False
        return True

    def plain_placements(self, c: Cursor) -> None:
        """Placements in a row, by the compiled loop; stops before anything that it does not know."""
        m = self.modal
        state = np.array([m.placement_x, m.placement_y, m.relative, m.child if isinstance(m.child, int) else -1])
        while True:
            size = min(_BATCH, c.left // 2 + 1)
            out = np.empty((4, size), np.int32)
            at, count = placements(c.data, c.at, c.end, state, out)
            moved, c.at = at > c.at, int(at)
            if count:
                child, x, y, turn = (row.copy() for row in out[:, :count])
                self._add(c, child, x, y, turn.astype(np.uint8))
                m.placement_x, m.placement_y, m.child = int(state[0]), int(state[1]), int(state[3])
            m.relative = bool(state[2])
            if not moved:
                return

    def _add(self, c: Cursor, *part: Array) -> None:
        self._count(c, len(part[0]))
        self.cell.parts.append(part)  # type: ignore[arg-type]

    def _count(self, c: Cursor, more: int) -> None:
        self.limit -= more
        if self.limit < 0:
            raise c.fail("more placements and copies than the limit that was set")

    def _need(self, c: Cursor, value: Value | None, what: str) -> Value:
        if value is None:
            raise c.fail(f"record without {what}, and none before it in this cell")
        return value

    def _position(self, c: Cursor, info: int, bits: tuple[int, int], now: tuple[int, int]) -> tuple[int, int]:
        place = []
        for bit, old in zip(bits, now, strict=True):
            new = c.coordinate() if info & bit else None
            relative = self.modal.relative
            place.append(old if new is None else c.within(old + new) if relative else new)
        return place[0], place[1]

    def _repeated(self, c: Cursor, info: int, bit: int, x: int, y: int) -> tuple[Array, Array]:
        if not info & bit:
            return np.array([x]), np.array([y])
        self.modal.repetition = c.repetition(self.modal.repetition, self.limit)
        at_x, at_y = self.modal.repetition.x + x, self.modal.repetition.y + y
        c.within(int(np.abs(at_x).max()))
        c.within(int(np.abs(at_y).max()))
        return at_x, at_y

    def _placement(self, c: Cursor, kind: int) -> None:
        info, m = c.byte(), self.modal
        if info & 0x80:
            m.child = c.within(c.unsigned()) if info & 0x40 else c.string(name=True)
        child = m.child
        if child is None:
            raise c.fail("placement without a cell, and none before it in this cell")
        turn = info >> 1 & 3 | (info & 1) << 2
        if kind == oasis.PLACEMENT_ANY:
            size = c.real() if info & 4 else 1.0
            angle = c.real() if info & 2 else 0.0
            if size != 1 or angle % 90 != 0:
                raise c.fail(f"placement turned by {angle} degrees and scaled by {size}; need quarter turns only")
            turn = int(angle // 90) & 3 | (info & 1) << 2
        m.placement_x, m.placement_y = self._position(c, info, (0x20, 0x10), (m.placement_x, m.placement_y))
        x, y = self._repeated(c, info, 8, m.placement_x, m.placement_y)
        number = self.cell.names.setdefault(child, -2 - len(self.cell.names)) if isinstance(child, str) else child
        small = (np.full(len(x), number, np.int32), x.astype(np.int32), y.astype(np.int32))
        self._add(c, *small, np.full(len(x), turn, np.uint8))

    def _layer(self, c: Cursor, info: int) -> None:
        if info & 1:
            self.modal.layer = c.unsigned()
        if info & 2:
            self.modal.datatype = c.unsigned()

    def _place(self, c: Cursor, info: int) -> tuple[tuple[int, int], Array, Array]:
        """Layer and positions of a shape, from the end of its record."""
        m = self.modal
        m.x, m.y = self._position(c, info, (0x10, 8), (m.x, m.y))
        x, y = self._repeated(c, info, 4, m.x, m.y)
        self._count(c, len(x))
        return (self._need(c, m.layer, "layer"), self._need(c, m.datatype, "datatype")), x, y

    def _polygons(self, c: Cursor, info: int, points: Array) -> None:
        layer, x, y = self._place(c, info)
        c.within(int(np.abs(points).max()) + max(abs(self.modal.x), abs(self.modal.y)))
        shapes = self.cell.polygons.setdefault(layer, [])
        shapes.extend(points + np.array(place) for place in zip(x.tolist(), y.tolist(), strict=True))

    def _rectangle(self, c: Cursor) -> None:
        info, m = c.byte(), self.modal
        self._layer(c, info)
        if info & 0x40:
            m.width = c.within(c.unsigned())
        if info & 0x80:  # a square has no height of its own
            m.height = m.width
        elif info & 0x20:
            m.height = c.within(c.unsigned())
        w, h = self._need(c, m.width, "width"), self._need(c, m.height, "height")
        self._polygons(c, info, np.array([[0, 0], [w, 0], [w, h], [0, h]]))

    def _polygon(self, c: Cursor) -> None:
        info, m = c.byte(), self.modal
        self._layer(c, info)
        if info & 0x20:
            m.points = c.points()
            if len(m.points) < 3:
                raise c.fail(f"polygon of {len(m.points)} vertices, need 3")
        self._polygons(c, info, self._need(c, m.points, "point list"))

    def _circle(self, c: Cursor) -> None:
        info, m = c.byte(), self.modal
        self._layer(c, info)
        if info & 0x20:
            m.radius = c.within(c.unsigned())
        radius = self._need(c, m.radius, "radius")
        layer, x, y = self._place(c, info)
        shapes = self.cell.circles.setdefault(layer, [])
        shapes.extend((px, py, radius) for px, py in zip(x.tolist(), y.tolist(), strict=True))

    def _text(self, c: Cursor) -> None:
        """Texts are counted, no more."""
        info, m = c.byte(), self.modal
        if info & 0x40:
            _ = c.unsigned() if info & 0x20 else c.string()
        for bit in (1, 2):
            if info & bit:
                c.unsigned()
        m.text_x, m.text_y = self._position(c, info, (0x10, 8), (m.text_x, m.text_y))
        x, _ = self._repeated(c, info, 4, m.text_x, m.text_y)
        self._count(c, len(x))
        self.cell.texts += len(x)
