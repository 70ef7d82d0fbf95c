"""Solids of a lens and its module: STEP, STL, 3MF, glTF. Heavy kernels load inside the functions that need them."""

from pathlib import Path

from layout.module import Module, around, assemble, clearances, picture, write_module
from layout.process import Process
from layout.solid_mesh import write_3mf, write_gltf, write_stl
from layout.solid_step import write_step
from layout.solid_tile import LIMITS, Tile, check_count, tile
from metalens.lens import Lens

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
    "write_meshes",
    "write_module",
    "write_step",
    "write_steps",
    "write_stl",
]


def write_steps(
    folder: Path, lens: Lens, process: Process, *, side_um: float, centre_um: tuple[float, float]
) -> list[Path]:
    """``module.step`` (all around the lens, down to the flex) and ``tile.step`` (pillars of a square of the mask).

    Raises:
        ProcessError: too many pillars in the square, none, or a module that cannot be built around the lens.
    """
    pillars = tile(lens, process, side_um=side_um, centre_um=centre_um)
    check_count(pillars, "STEP")
    write_module(folder / "module.step", around(lens, process))
    write_step(folder / "tile.step", pillars)
    return [folder / "module.step", folder / "tile.step"]


def write_meshes(
    folder: Path, lens: Lens, process: Process, *, side_um: float, centre_um: tuple[float, float]
) -> list[Path]:
    """``tile.stl``, ``tile.3mf`` and ``tile.glb`` of the tapered pillars of a square of the mask.

    Raises:
        ProcessError: too many pillars in the square, or none.
    """
    pillars = tile(lens, process, side_um=side_um, centre_um=centre_um)
    check_count(pillars, "glTF")
    write_stl(folder / "tile.stl", pillars)
    write_3mf(folder / "tile.3mf", pillars)
    write_gltf(folder / "tile.glb", pillars)
    return [folder / f"tile.{end}" for end in ("stl", "3mf", "glb")]
