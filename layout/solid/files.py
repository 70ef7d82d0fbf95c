"""Solids that ``metalens layout`` writes beside the mask: pillars of a window, and the
module that holds the lens.
"""

from pathlib import Path

from layout.files import Window
from layout.process import Process
from layout.solid import readback, readback_meshes
from layout.solid import verbs as solid
from layout.solid.module import COLOURS
from metalens.lens import Lens


def differences(
    lens: Lens, process: Process, target: Path, window: Window
) -> dict[str, tuple[int, tuple[str, ...]]]:
    """{file: solids in it, what it lacks of what was asked for} of those in ``target``,
    read back.
    """
    pillars, found = _tile(lens, process, window), {}
    count = len(pillars.kind)
    if (path := target / "pillars.stl").is_file():
        found[path.name] = count, readback.stl_differences(path, pillars)
    for name, read in (
        ("3mf", readback_meshes.differences_3mf),
        ("glb", readback_meshes.differences_gltf),
    ):
        if (path := target / f"pillars.{name}").is_file():
            found[path.name] = count, read(path, pillars)
    if (path := target / "pillars.step").is_file():
        found[path.name] = count, readback.step_differences(path, pillars)
    if (path := target / "module.step").is_file():
        whole = solid.around(lens, process)
        found[path.name] = len(COLOURS), readback.module_differences(path, whole)
    return found


def write_stl(lens: Lens, process: Process, target: Path, window: Window) -> list[Path]:
    """``pillars.stl``: the tapered pillars of the window, watertight.

    And ``pillars.3mf`` and ``pillars.glb`` where they may hold as many
    (:data:`layout.solid.verbs.LIMITS`).
    """
    pillars = _tile(lens, process, window)
    made = [target / "pillars.stl"]
    solid.write_stl(made[0], pillars)
    for form, write, name in (
        ("3MF", solid.write_3mf, "pillars.3mf"),
        ("glTF", solid.write_gltf, "pillars.glb"),
    ):
        if len(pillars.kind) <= solid.LIMITS[form]:
            write(target / name, pillars)
            made.append(target / name)
    return made


def write_step(
    lens: Lens, process: Process, target: Path, window: Window
) -> list[Path]:
    """``pillars.step`` of the window, and ``module.step``: filter, mount, die with
    aperture, sensor, flex.
    """
    pillars, whole = target / "pillars.step", target / "module.step"
    solid.write_step(pillars, _tile(lens, process, window))
    solid.write_module(whole, solid.around(lens, process))
    return [pillars, whole]


def _tile(lens: Lens, process: Process, window: Window) -> solid.Tile:
    return solid.tile(
        lens, process, side_um=window.size_um, centre_um=(window.x_um, window.y_um)
    )
