"""Diameter map -> classes, sites, die, write fields = MaskPlan."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from layout.mask import build as build
    from layout.mask import fields as fields
    from layout.mask import symmetry as symmetry
    from layout.mask import tone as tone
    from layout.mask.field_figure import with_fields as with_fields
    from layout.mask.fields import FieldPlan as FieldPlan
    from layout.mask.plan import EXPOSED as EXPOSED
    from layout.mask.plan import UNDRAWN as UNDRAWN
    from layout.mask.plan import FigureCell as FigureCell
    from layout.mask.plan import MaskPlan as MaskPlan
    from layout.mask.plan import PillarClass as PillarClass
    from layout.mask.plan import PillarLattice as PillarLattice

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "EXPOSED": "plan",
        "FieldPlan": "fields",
        "FigureCell": "plan",
        "PillarLattice": "plan",
        "MaskPlan": "plan",
        "PillarClass": "plan",
        "UNDRAWN": "plan",
        "build": "",
        "fields": "",
        "symmetry": "",
        "tone": "",
        "with_fields": "field_figure",
    },
)
