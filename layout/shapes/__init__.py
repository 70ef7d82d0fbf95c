"""Polygons, no process."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from layout.shapes import convex as convex
    from layout.shapes import moments as moments
    from layout.shapes import polygon as polygon
    from layout.shapes import rectilinear as rectilinear
    from layout.shapes import region as region

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {"convex": "", "moments": "", "rectilinear": "", "region": "", "polygon": ""},
)
