"""Solids that ``metalens layout`` writes beside the mask: pillars of a window, and the module that holds the lens."""

from pathlib import Path

from layout import solid
from layout.dxf import Window
from layout.process import Process
from metalens.lens import Lens
from metalens.units import mm


def write_stl(lens: Lens, process: Process, target: Path, window: Window) -> list[Path]:
    """``pillars.stl``: the tapered pillars of the window, watertight."""
    path = target / "pillars.stl"
    solid.write_stl(path, _tile(lens, process, window))
    return [path]


def write_step(lens: Lens, process: Process, target: Path, window: Window, *, radius_um: float) -> list[Path]:
    """``pillars.step`` of the window, and ``module.step``: filter, mount, die with aperture, sensor, flex.

    The module has the standard sizes; what surrounds the aperture grows with a lens of more than 1 mm.
    """
    pillars, whole = target / "pillars.step", target / "module.step"
    solid.write_step(pillars, _tile(lens, process, window))
    solid.write_module(whole, module(lens, radius_um))
    return [pillars, whole]


def module(lens: Lens, radius_um: float) -> solid.Module:
    """The standard module around this aperture."""
    plain = solid.Module()
    aperture = 2 * radius_um / mm
    more = max(0.0, aperture - plain.aperture_mm)
    return solid.Module(
        aperture_mm=aperture,
        side_mm=plain.side_mm + more,
        filter_side_mm=plain.filter_side_mm + more,
        die_side_mm=plain.die_side_mm + more,
        sensor_side_mm=plain.sensor_side_mm + more,
        height_mm=lens.cell.height_um / mm,
    )


def _tile(lens: Lens, process: Process, window: Window) -> solid.Tile:
    return solid.tile(lens, process, side_um=window.size_um, centre_um=(window.x_um, -window.y_um))
