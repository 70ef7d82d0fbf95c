"""Refractive indices with source and range; nothing is extrapolated."""

from metalens.cell.materials import NAMES as NAMES
from metalens.cell.materials import Material as Material
from metalens.cell.materials import find_material as find_material
from metalens.cell.materials import index as index
