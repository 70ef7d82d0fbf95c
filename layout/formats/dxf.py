"""DXF of a window of the mask (ezdxf): closed polylines in micrometres, one DXF layer
for each mask layer; read back.
"""

import io
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from layout.formats.compare import shape_differences
from layout.formats.library import MaskCell
from layout.mask.plan import MaskPlan, PillarArray
from layout.process.process import LayerNumber
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError, ProcessError
from metalens.core.units import nm

MOST_PILLARS = 200_000
_UM = 13  # of $INSUNITS
_STAMPS = threading.Lock()
# of the colour index that have names: red, yellow, green, cyan, blue, magenta, white
_COLOURS = 7


@dataclass(frozen=True, slots=True)
class DxfWindow:
    """A square window of the mask, +y up."""

    x_um: float = 0.0
    y_um: float = 0.0
    size_um: float = 20.0

    def __post_init__(self) -> None:
        if not (
            np.isfinite([self.x_um, self.y_um, self.size_um]).all() and self.size_um > 0
        ):
            raise ProcessError(f"window {self}: need a finite place and a size above 0")


def write_dxf(plan: MaskPlan, path: str | Path, *, window: DxfWindow) -> int:
    """Write the pillars whose site lies in a window, and all figures, as DXF.

    Args:
        plan: of a die.
        path: of the file.
        window: of the mask.

    Returns:
        Number of pillars.

    Raises:
        ProcessError: more than 200 000 pillars in the window, or ezdxf is not
            installed.
        OSError: the target cannot be written.
    """
    sites = [
        site for lattice in plan.lattices for site in sites_in(plan, lattice, window)
    ]
    if len(sites) > MOST_PILLARS:
        raise ProcessError(
            f"{len(sites)} pillars in a window of {window.size_um} um: DXF holds each as a polyline of its own; take "
            f"at most {MOST_PILLARS}, or OASIS for the whole mask"
        )
    names = _names(plan)
    with _fixed_stamps():
        drawing = _ezdxf().new("R2000", units=_UM)
        for n, (layer, name) in enumerate(names.items()):
            dxf_layer = drawing.layers.add(name, color=1 + n % _COLOURS)
            dxf_layer.description = f"{layer[0]}/{layer[1]}"
        space = drawing.modelspace()
        scale = plan.unit_nm * 1e-3
        for layer, shapes in _drawn(plan, window).polygons.items():
            for points in shapes:
                space.add_lwpolyline(
                    (points * scale).tolist(),
                    format="xy",
                    close=True,
                    dxfattribs={"layer": names[layer]},
                )
        text = io.StringIO()
        drawing.write(text)
    store.write_text(path, text.getvalue())
    return len(sites)


def dxf_differences(
    plan: MaskPlan, path: str | Path, *, window: DxfWindow
) -> tuple[str, ...]:
    """What a DXF file, read by ezdxf, holds that the window of the plan does not, and
    the other way, in words.

    Args:
        plan: of a die.
        path: of the file.
        window: that was written.

    Raises:
        MaskFileError: the file cannot be read as DXF.
    """
    ezdxf = _ezdxf()
    try:
        drawing = ezdxf.readfile(path)
    except (OSError, ezdxf.DXFError) as error:
        raise MaskFileError(f"{path}: cannot be read as DXF ({error})") from None
    layers = {name: layer for layer, name in _names(plan).items()}
    read: dict[LayerNumber, list[Array]] = {}
    for line in drawing.modelspace().query("LWPOLYLINE"):
        points = np.array(line.get_points("xy")) / (plan.unit_nm * nm)
        layer = layers.get(line.dxf.layer, (-1, -1))
        read.setdefault(layer, []).append(np.rint(points).astype(np.int64))
    unit = (
        () if drawing.units == _UM else (f"unit {drawing.units}, planned {_UM} (um)",)
    )
    shapes = shape_differences(_drawn(plan, window), MaskCell("window", read))
    return (*unit, *shapes)


def _ezdxf() -> Any:
    """The module ezdxf, which is an optional dependency."""
    try:
        import ezdxf
    except ImportError:
        raise ProcessError(
            "DXF needs ezdxf: pip install 'metalens-toolchain[cad]'"
        ) from None
    return ezdxf


@contextmanager
def _fixed_stamps() -> Iterator[None]:
    """No time stamps and no random identifiers while a drawing is made and written; the
    option of ezdxf, which all its users share, is as before afterwards.
    """
    options = vars(_ezdxf())["options"]  # exported, and not said to be
    with _STAMPS:
        before = options.write_fixed_meta_data_for_testing
        options.write_fixed_meta_data_for_testing = True
        try:
            yield
        finally:
            options.write_fixed_meta_data_for_testing = before


def sites_in(
    plan: MaskPlan, lattice: PillarArray, window: DxfWindow
) -> Iterator[tuple[int, int, int]]:
    """(class, x, y) of the pillars whose site lies in a window, database units.

    Args:
        plan: of a die.
        lattice: one of its lattices.
        window: of the mask.
    """
    scale = 1e3 / plan.unit_nm
    half = window.size_um / 2
    left = _ceil(
        (window.x_um - half) * scale - lattice.x0, lattice.pitch, lattice.columns
    )
    right = _ceil(
        (window.x_um + half) * scale - lattice.x0, lattice.pitch, lattice.columns
    )
    first = _ceil(lattice.y0 - (window.y_um + half) * scale, lattice.down, lattice.rows)
    end = _ceil(lattice.y0 - (window.y_um - half) * scale, lattice.down, lattice.rows)
    if left >= right or first >= end:
        return
    block = lattice.source(first, end)[:, left:right]
    for row, column in np.argwhere(block > 0).tolist():
        x = lattice.x0 + (left + column) * lattice.pitch
        y = lattice.y0 - (first + row) * lattice.down
        yield int(block[row, column]), x, y


def _ceil(distance: float, pitch: int, count: int) -> int:
    """Number of sites before a distance, from 0 to ``count``."""
    return int(np.clip(np.ceil(distance / pitch), 0, count))


def _drawn(plan: MaskPlan, window: DxfWindow) -> MaskCell:
    """Everything that is written: the pillars of the window and all figures."""
    shapes: dict[LayerNumber, list[Array]] = {}
    for lattice in plan.lattices:
        for number, x, y in sites_in(plan, lattice, window):
            pillar = plan.classes[number - 1]
            moved = [points + np.array([x, y]) for points in pillar.polygons]
            shapes.setdefault(pillar.layer, []).extend(moved)
    for figure in plan.figures:
        for layer, polygons in figure.polygons.items():
            shapes.setdefault(layer, []).extend(polygons)
    return MaskCell("window", shapes)


def _names(plan: MaskPlan) -> dict[LayerNumber, str]:
    """{(layer, datatype): DXF layer}, each its own."""
    used = {pillar.layer for pillar in plan.classes} | {
        layer for figure in plan.figures for layer in figure.polygons
    }
    names: dict[LayerNumber, str] = {}
    for layer in sorted(used):
        name = (
            plan.layer_names.get(layer, f"L{layer[0]}D{layer[1]}")
            .upper()
            .replace(".", "_")
        )
        names[layer] = (
            name if name not in names.values() else f"{name}_L{layer[0]}D{layer[1]}"
        )
    return names
