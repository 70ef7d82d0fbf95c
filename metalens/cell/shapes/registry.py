"""Every shape that a cell file may name by its ``kind``; a further one is added here."""

from metalens.cell.shapes.round import Circle, Ellipse, Ring
from metalens.cell.shapes.straight import (
    Cross,
    Polygon,
    Rectangle,
    RegularPolygon,
    Square,
)

Shape = Circle | Ellipse | Ring | Square | Rectangle | Cross | RegularPolygon | Polygon
