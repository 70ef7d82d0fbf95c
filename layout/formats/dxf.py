"""DXF of a window of the mask (ezdxf): closed polylines in micrometres, one DXF layer
for each mask layer; read back.
"""

import io
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from layout.formats.compare import canonical_corners
from layout.mask.plan import MaskPlan, PillarArray
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError, ProcessError

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
    """Write the pillars whose site lies in the window, and all figures; the number of
    pillars.

    Args:
        plan: of a die.
        path: of the file.

    Raises:
        ProcessError: more than 200 000 pillars in the window, or ezdxf is not
            installed.
        OSError: the target cannot be written.
    """
    sites = _sites(plan, window)
    if len(sites) > MOST_PILLARS:
        raise ProcessError(
            f"{len(sites)} pillars in a window of {window.size_um} um: DXF holds each as a polyline of its own; take "
            f"at most {MOST_PILLARS}, or OASIS for the whole mask"
        )
    with _fixed_stamps():
        drawing = _ezdxf().new("R2000", units=_UM)
        for n, (layer, name) in enumerate(_names(plan).items()):
            made = drawing.layers.add(name, color=1 + n % _COLOURS)
            made.description = f"{layer[0]}/{layer[1]}"
        space, scale = drawing.modelspace(), plan.unit_nm * 1e-3
        for name, points in _drawn(plan, sites):
            space.add_lwpolyline(
                (points * scale).tolist(),
                format="xy",
                close=True,
                dxfattribs={"layer": name},
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
        path: of the file.

    Raises:
        MaskFileError: the file cannot be read as DXF.
    """
    ezdxf = _ezdxf()
    try:
        drawing = ezdxf.readfile(path)
    except (OSError, ezdxf.DXFError) as error:
        raise MaskFileError(f"{path}: cannot be read as DXF ({error})") from None
    found = (
        [] if drawing.units == _UM else [f"unit {drawing.units}, planned {_UM} (um)"]
    )
    scale = plan.unit_nm * 1e-3
    read = Counter(
        (
            line.dxf.layer,
            canonical_corners(np.rint(np.array(line.get_points("xy")) / scale)),
        )
        for line in drawing.modelspace().query("LWPOLYLINE")
    )
    planned = Counter(
        (name, canonical_corners(points))
        for name, points in _drawn(plan, _sites(plan, window))
    )
    for text, unlike in (("missing", planned - read), ("not planned", read - planned)):
        for layer, number in sorted(
            Counter(name for name, _ in unlike.elements()).items()
        ):
            found.append(f"layer {layer}: {number} polygons {text}")
    return tuple(found)


def _ezdxf() -> Any:
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


def _sites(plan: MaskPlan, window: DxfWindow) -> list[tuple[int, int, int]]:
    return [
        site for lattice in plan.lattices for site in sites_in(plan, lattice, window)
    ]


def sites_in(
    plan: MaskPlan, lattice: PillarArray, window: DxfWindow
) -> Iterator[tuple[int, int, int]]:
    """(class, x, y) of the pillars whose site lies in the window, database units.

    Args:
        plan: of a die.
        lattice: one of its lattices.
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
        x, y = (
            lattice.x0 + (left + column) * lattice.pitch,
            lattice.y0 - (first + row) * lattice.down,
        )
        yield int(block[row, column]), x, y


def _ceil(distance: float, pitch: int, count: int) -> int:
    return int(np.clip(np.ceil(distance / pitch), 0, count))


def _drawn(
    plan: MaskPlan, sites: list[tuple[int, int, int]]
) -> Iterator[tuple[str, Array]]:
    """(DXF layer, polygon) of everything that is written."""
    names = _names(plan)
    for k, x, y in sites:
        made = plan.classes[k - 1]
        for shape in made.polygons:
            yield names[made.layer], shape + np.array([x, y])
    for figure in plan.figures:
        for layer, shapes in figure.polygons.items():
            for shape in shapes:
                yield names[layer], shape


def _names(plan: MaskPlan) -> dict[tuple[int, int], str]:
    """{(layer, datatype): DXF layer}, each its own."""
    used = {made.layer for made in plan.classes} | {
        layer for figure in plan.figures for layer in figure.polygons
    }
    found: dict[tuple[int, int], str] = {}
    for layer in sorted(used):
        name = (
            plan.layer_names.get(layer, f"L{layer[0]}D{layer[1]}")
            .upper()
            .replace(".", "_")
        )
        found[layer] = (
            name if name not in found.values() else f"{name}_L{layer[0]}D{layer[1]}"
        )
    return found
