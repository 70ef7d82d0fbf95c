"""The section of a pillar as one record: outline, area, Fourier factors, boundary, mask
polygon, name.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.cell.shapes import motion as motion
    from metalens.cell.shapes.every import Shape as Shape
    from metalens.cell.shapes.outline import EllipseArc as EllipseArc
    from metalens.cell.shapes.outline import Outline as Outline
    from metalens.cell.shapes.outline import PolygonLoop as PolygonLoop
    from metalens.cell.shapes.outline import rotate_corners as rotate_corners
    from metalens.cell.shapes.round import Circle as Circle
    from metalens.cell.shapes.round import Ellipse as Ellipse
    from metalens.cell.shapes.round import Ring as Ring
    from metalens.cell.shapes.straight import Cross as Cross
    from metalens.cell.shapes.straight import Polygon as Polygon
    from metalens.cell.shapes.straight import Rectangle as Rectangle
    from metalens.cell.shapes.straight import RegularPolygon as RegularPolygon
    from metalens.cell.shapes.straight import Square as Square

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Circle": "round",
        "EllipseArc": "outline",
        "Cross": "straight",
        "Ellipse": "round",
        "PolygonLoop": "outline",
        "Outline": "outline",
        "Polygon": "straight",
        "Rectangle": "straight",
        "RegularPolygon": "straight",
        "Ring": "round",
        "Shape": "every",
        "Square": "straight",
        "motion": "",
        "rotate_corners": "outline",
    },
)
