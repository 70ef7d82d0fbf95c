"""Aberrations over the field: chief rays, distortion, field curvature, vignetting,
illumination, MTF.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.aberrations.angles import OverField as OverField
    from metalens.aberrations.angles import frequencies_per_mm as frequencies_per_mm
    from metalens.aberrations.angles import over_field as over_field
    from metalens.aberrations.chief import ChiefRay as ChiefRay
    from metalens.aberrations.chief import chief_ray as chief_ray

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "ChiefRay": "chief",
        "OverField": "angles",
        "chief_ray": "chief",
        "frequencies_per_mm": "angles",
        "over_field": "angles",
    },
)
