"""Refractive indices with source and range; nothing is extrapolated."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.cell.materials import NAMES as NAMES
    from metalens.cell.materials import Material as Material
    from metalens.cell.materials import find_material as find_material
    from metalens.cell.materials import index as index
    from metalens.cell.materials import index_dispersion as index_dispersion
    from metalens.cell.materials import read_csv as read_csv

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Material": "metalens.cell.materials",
        "NAMES": "metalens.cell.materials",
        "index": "metalens.cell.materials",
        "find_material": "metalens.cell.materials",
        "read_csv": "metalens.cell.materials",
        "index_dispersion": "metalens.cell.materials",
    },
)
