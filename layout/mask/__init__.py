"""Diameter map -> classes, sites, die, write fields = MaskPlan."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.mask import build as build
    from layout.mask import fields as fields
    from layout.mask import symmetry as symmetry
    from layout.mask import tone as tone
    from layout.mask.field_figure import with_fields as with_fields
    from layout.mask.fields import FieldPlan as FieldPlan
    from layout.mask.plan import EXPOSED as EXPOSED
    from layout.mask.plan import UNDRAWN as UNDRAWN
    from layout.mask.plan import Figure as Figure
    from layout.mask.plan import Lattice as Lattice
    from layout.mask.plan import MaskPlan as MaskPlan
    from layout.mask.plan import PillarClass as PillarClass

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "EXPOSED": "plan",
        "FieldPlan": "fields",
        "Figure": "plan",
        "Lattice": "plan",
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
