"""The section of a pillar as one record: outline, area, Fourier factors, boundary, mask
polygon, name.
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.cell.shapes import motion as motion
    from metalens.cell.shapes.every import Shape as Shape
    from metalens.cell.shapes.outline import Conic as Conic
    from metalens.cell.shapes.outline import Loop as Loop
    from metalens.cell.shapes.outline import Outline as Outline
    from metalens.cell.shapes.outline import turned as turned
    from metalens.cell.shapes.round import Circle as Circle
    from metalens.cell.shapes.round import Ellipse as Ellipse
    from metalens.cell.shapes.round import Ring as Ring
    from metalens.cell.shapes.straight import Cross as Cross
    from metalens.cell.shapes.straight import Polygon as Polygon
    from metalens.cell.shapes.straight import Rectangle as Rectangle
    from metalens.cell.shapes.straight import RegularPolygon as RegularPolygon
    from metalens.cell.shapes.straight import Square as Square

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Circle": "round",
        "Conic": "outline",
        "Cross": "straight",
        "Ellipse": "round",
        "Loop": "outline",
        "Outline": "outline",
        "Polygon": "straight",
        "Rectangle": "straight",
        "RegularPolygon": "straight",
        "Ring": "round",
        "Shape": "every",
        "Square": "straight",
        "motion": "",
        "turned": "outline",
    },
)
