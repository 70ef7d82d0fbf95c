"""DXF (R12) of a window of the mask: closed polylines in micrometres, one DXF layer for each mask layer."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from layout.mask import Lattice, MaskPlan
from metalens.ground import store
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError

MOST_PILLARS = 200_000


@dataclass(frozen=True, slots=True)
class Window:
    """A square window of the mask, +y up."""

    x_um: float = 0.0
    y_um: float = 0.0
    size_um: float = 20.0

    def __post_init__(self) -> None:
        if not (np.isfinite([self.x_um, self.y_um, self.size_um]).all() and self.size_um > 0):
            raise ProcessError(f"window {self}: need a finite place and a size above 0")


def write(plan: MaskPlan, path: str | Path, *, window: Window) -> int:
    """Write the pillars whose site lies in the window, and all figures; the number of pillars.

    Raises:
        ProcessError: more than 200 000 pillars in the window.
        OSError: the target cannot be written.
    """
    sites = [(k, x, y) for lattice in plan.lattices for k, x, y in sites_in(plan, lattice, window)]
    if len(sites) > MOST_PILLARS:
        raise ProcessError(
            f"{len(sites)} pillars in a window of {window.size_um} um: DXF holds each as a polyline of its own; take "
            f"at most {MOST_PILLARS}, or OASIS for the whole mask"
        )
    with store.replacing(path) as part, open(part, "w", encoding="ascii", newline="\r\n") as file:
        file.writelines(line + "\n" for line in _lines(plan, sites))
    return len(sites)


def sites_in(plan: MaskPlan, lattice: Lattice, window: Window) -> Iterator[tuple[int, int, int]]:
    """(class, x, y) of the pillars whose site lies in the window, database units."""
    scale = 1e3 / plan.unit_nm
    half = window.size_um / 2
    left = _ceil((window.x_um - half) * scale - lattice.x0, lattice.pitch, lattice.columns)
    right = _ceil((window.x_um + half) * scale - lattice.x0, lattice.pitch, lattice.columns)
    first = _ceil(lattice.y0 - (window.y_um + half) * scale, lattice.pitch, lattice.rows)
    end = _ceil(lattice.y0 - (window.y_um - half) * scale, lattice.pitch, lattice.rows)
    if left >= right or first >= end:
        return
    block = lattice.source(first, end)[:, left:right]
    for row, column in np.argwhere(block > 0).tolist():
        x, y = lattice.x0 + (left + column) * lattice.pitch, lattice.y0 - (first + row) * lattice.pitch
        yield int(block[row, column]), x, y


def _ceil(distance: float, pitch: int, count: int) -> int:
    return int(np.clip(np.ceil(distance / pitch), 0, count))


def _lines(plan: MaskPlan, sites: list[tuple[int, int, int]]) -> Iterator[str]:
    scale = plan.unit_nm * 1e-3
    yield from ("0", "SECTION", "2", "HEADER", "9", "$ACADVER", "1", "AC1009", "0", "ENDSEC", "0", "SECTION")
    yield from ("2", "ENTITIES")
    for k, x, y in sites:
        made = plan.classes[k - 1]
        for shape in made.polygons:
            yield from _polyline(_layer(plan, made.layer), shape + np.array([x, y]), scale)
    for figure in plan.figures:
        for layer, shapes in figure.polygons.items():
            for shape in shapes:
                yield from _polyline(_layer(plan, layer), shape, scale)
    yield from ("0", "ENDSEC", "0", "EOF")


def _layer(plan: MaskPlan, layer: tuple[int, int]) -> str:
    return plan.layer_names.get(layer, f"L{layer[0]}D{layer[1]}").upper().replace(".", "_")


def _polyline(layer: str, points: Array, scale: float) -> Iterator[str]:
    yield from ("0", "POLYLINE", "8", layer, "66", "1", "70", "1")
    for x, y in (points * scale).tolist():
        yield from ("0", "VERTEX", "8", layer, "10", f"{x:.6f}", "20", f"{y:.6f}")
    yield from ("0", "SEQEND", "8", layer)
