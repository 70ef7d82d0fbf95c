"""Solids of a lens and its module: STEP, STL, 3MF, glTF. Heavy kernels load inside the
functions that need them.
"""

from layout.solid.mesh import write_3mf, write_gltf, write_stl
from layout.solid.module import (
    Module,
    around,
    assemble,
    clearances,
    picture,
    write_module,
)
from layout.solid.step import write_step
from layout.solid.tile import LIMITS, Tile, check_count, tile

__all__ = [
    "LIMITS",
    "Module",
    "Tile",
    "around",
    "assemble",
    "check_count",
    "clearances",
    "picture",
    "tile",
    "write_3mf",
    "write_gltf",
    "write_module",
    "write_step",
    "write_stl",
]
