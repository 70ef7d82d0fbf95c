"""Refractive indices with source and range; nothing is extrapolated."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.cell.materials import NAMES as NAMES
    from metalens.cell.materials import Material as Material
    from metalens.cell.materials import index as index
    from metalens.cell.materials import material as material
    from metalens.cell.materials import read_csv as read_csv
    from metalens.cell.materials import slope as slope

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Material": "metalens.cell.materials",
        "NAMES": "metalens.cell.materials",
        "index": "metalens.cell.materials",
        "material": "metalens.cell.materials",
        "read_csv": "metalens.cell.materials",
        "slope": "metalens.cell.materials",
    },
)
