"""DXF of a window of the mask (ezdxf): closed polylines in micrometres, one DXF layer
for each mask layer.
"""

import io
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from layout.formats.library import MaskCell
from layout.mask.plan import MaskPlan
from layout.process.process import LayerNumber
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

MOST_PILLARS = 200_000
_UM = 13  # of $INSUNITS
_STAMPS = threading.Lock()
# of the colour index that have names: red, yellow, green, cyan, blue, magenta, white
_COLOURS = 7


@dataclass(frozen=True)
class DxfWindow:
    """A square window of the mask, +y up."""

    x_um: float = 0.0
    y_um: float = 0.0
    size_um: float = 20.0


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
    count = sum(len(number) for number, *_ in _sites(plan, window))
    if count > MOST_PILLARS:
        raise ProcessError(
            f"{count} pillars in a window of {window.size_um} um: DXF holds each as a polyline of its own; take "
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
    return count


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
    """No time stamps and no random identifiers while a drawing is built and written; the
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


def _sites(plan: MaskPlan, window: DxfWindow) -> Iterator[tuple[Array, Array, Array]]:
    """Class, x and y of the pillars of each lattice in a window."""
    scale = 1e3 / plan.unit_nm
    half = window.size_um / 2
    low_x, high_x = (window.x_um - half) * scale, (window.x_um + half) * scale
    low_y, high_y = (window.y_um - half) * scale, (window.y_um + half) * scale
    for lattice in plan.lattices:
        yield lattice.sites_in((low_x, low_y, high_x, high_y))


def _drawn(plan: MaskPlan, window: DxfWindow) -> MaskCell:
    """Everything that is written: the pillars of the window and all figures."""
    shapes: dict[LayerNumber, list[Array]] = {}
    for sites in _sites(plan, window):
        for number, x, y in zip(*(values.tolist() for values in sites), strict=True):
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
