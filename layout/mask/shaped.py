"""Pillars that are not round, or turned one by one: a class for every drawn size and
turn.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from layout.mask.cells import DrawnClasses, with_isolation
from layout.mask.held import hold_on_disk
from layout.mask.plan import MOST_CLASSES, PillarClass
from layout.process.process import Process
from layout.shapes import polygon, region
from metalens.cell import Cell
from metalens.cell.shapes import EllipseArc, Outline, PolygonLoop, rotate_corners
from metalens.core.arrays import Array
from metalens.core.errors import LensError, ProcessError
from metalens.core.units import nm
from metalens.lens import DiameterMap, Lens
from metalens.library.axes import cell_of_sizes

_LENGTHS = 1 << 20  # above any drawn size in nm


def shape_classes(
    source: Lens, process: Process, *, unit_nm: float
) -> tuple[DrawnClasses, tuple[PillarClass, ...]]:
    """The pillars of a lens as classes, and what is drawn for each.

    Args:
        source: lens of shaped or rotated pillars.
        process: rules and bias.
        unit_nm: database unit.

    Raises:
        ProcessError: too many classes, a pillar of less than a step, a hole that the
            grid or the bias closes.
        LensError: no pillar.
    """
    d = source.diameters
    cell = source.cell
    turns = _turns(cell, d, process)
    counts: dict[int, int] = {}
    for _, block in _keys(d, process, turns):
        for key, count in zip(*np.unique(block, return_counts=True), strict=True):
            counts[int(key)] = counts.get(int(key), 0) + int(count)
    used = np.array(sorted(key for key in counts if key), np.int64)
    if not len(used):
        raise LensError("empty lens: the map holds no pillar; check the aperture")
    if len(used) > MOST_CLASSES:
        raise ProcessError(
            f"{len(used)} classes of size and turn, at most {MOST_CLASSES}; raise angle_step_deg or diameter_step_nm"
        )
    kind: np.dtype[Any] = np.dtype(np.uint8 if len(used) <= 255 else np.uint16)
    every = np.r_[0, used]
    numbered = (
        (first, np.searchsorted(every, block).astype(kind))
        for first, block in _keys(d, process, turns)
    )
    sites = hold_on_disk(d.diameter_um.shape, kind, numbered)
    made = tuple(_class(source, int(key), process, turns, unit_nm) for key in used)
    across = np.array(
        [2 * float(np.hypot(*one.outline.T).max()) * unit_nm for one in made]
    )
    found = np.array([counts[int(key)] for key in used])
    return DrawnClasses(sites, across, found, process.rules.diameter_step_nm / 2), made


def _turns(cell: Cell, d: DiameterMap, process: Process) -> int:
    """Classes of turns; 1 where none is turned."""
    if d.angle_rad is None:
        return 1
    whole = 180.0 if cell.outline(cell.pitch_um / 2).repeats(math.pi) else 360.0
    return max(1, round(whole / process.rules.angle_step_deg))


def _keys(d: DiameterMap, process: Process, turns: int) -> Iterator[tuple[int, Array]]:
    """(first row, key) of blocks of rows; 0 for no pillar.

    key: drawn size in nm, plus ``_LENGTHS`` times the second number of the shape; times
    the turns, plus the turn. The
    second number is the drawn length of pillars of two sizes; of others the whole nm
    that the bias of the lone one
    differs by, less the least (0 where the process knows none): two pillars that are
    drawn as wide, one of them
    alone, are not of one design.
    """
    lone = process.bias.isolated_nm
    for first, block, alone in with_isolation(d, process):
        rows = slice(first, first + len(block))
        design = np.asarray(block, float) / nm
        beside = 0.0 if alone is None else alone
        drawn = _steps(design, design, process, beside)
        if d.length_um is not None:
            drawn += _LENGTHS * _steps(
                np.asarray(d.length_um[rows], float) / nm, design, process, beside
            )
        elif alone is not None:
            drawn += _LENGTHS * np.rint(alone * abs(lone)).astype(np.int64)
        turn = np.zeros(design.shape, np.int64)
        if d.angle_rad is not None:
            degrees = np.degrees(np.asarray(d.angle_rad[rows], float))
            turn = (
                np.rint(degrees / process.rules.angle_step_deg).astype(np.int64) % turns
            )
        yield first, np.where(design > 0, drawn * turns + turn, 0)


def _steps(
    size_nm: Array, design_nm: Array, process: Process, alone: Array | float
) -> Array:
    """Sizes as they are drawn, in whole steps; ``alone``: as
    :meth:`metalens.fabrication.Bias.drawn_nm` takes it.
    """
    step = process.rules.diameter_step_nm
    drawn = (
        np.rint(process.bias.drawn_nm(size_nm, alone) / step).astype(np.int64) * step
    )
    if ((drawn < step) & (design_nm > 0)).any():
        raise ProcessError(
            f"a pillar would be drawn below one step of {step} nm; check the bias"
        )
    return np.asarray(np.where(design_nm > 0, drawn, 0))


def _class(
    source: Lens, key: int, process: Process, turns: int, unit_nm: float
) -> PillarClass:
    """What is drawn for a key."""
    both, turn = divmod(key, turns)
    second, drawn = divmod(both, _LENGTHS)
    name = f"D{drawn:06}" if turns == 1 else f"D{drawn:05}R{turn:0{len(str(turns))}}"
    if source.diameters.length_um is not None:
        name = f"D{drawn:05}L{second:05}"
        made = cell_of_sizes(source.cell, float(drawn), float(second)).outline(
            drawn * nm
        )  # each axis by the bias of its size
    else:
        lone = process.bias.isolated_nm
        name += f"I{second}" if second else ""
        made = _biased(source.cell, drawn, process, second / abs(lone) if lone else 0.0)
    step_nm = process.rules.grid_nm * unit_nm
    turn_rad = math.radians(turn * process.rules.angle_step_deg)
    contours = [
        _gridded(part, turn_rad, step_nm, process, name) * process.rules.grid_nm
        for part in made.parts
    ]
    outline = contours[0]
    holes = tuple(hole[::-1] for hole in contours[1:])
    pieces = (
        tuple(region.without_holes([outline, *holes], grid=process.rules.grid_nm))
        if holes
        else ()
    )
    layer = process.layers.pillar
    units = round(drawn / unit_nm)
    return PillarClass(
        name, float(drawn), units, layer, outline, pieces, round=False, holes=holes
    )


def _gridded(
    part: EllipseArc | PolygonLoop,
    turn_rad: float,
    step_nm: float,
    process: Process,
    name: str,
) -> Array:
    """(n, 2) whole grid steps about the site, counter-clockwise: a circle of its area,
    any other part corner by corner.

    Raises:
        ProcessError: fewer than three corners are left, or a circle of less than four
            steps.
    """
    if isinstance(part, EllipseArc) and part.half_x_um == part.half_y_um:
        across = 2 * part.half_x_um / nm / step_nm
        if across < 4:
            raise ProcessError(
                f"class {name}: a circle of {across * step_nm:.3g} nm; need four steps of the grid"
            )
        return polygon.pillar_polygon(
            across, vertices=process.rules.vertices, shape=process.rules.shape
        ).points
    corners = (
        rotate_corners(part.vertices(process.rules.vertices), turn_rad) / nm / step_nm
    )
    points = np.asarray(np.rint(corners), np.int64)
    points = points[np.any(points != np.roll(points, 1, axis=0), axis=1)]
    if len(points) < 3 or polygon.twice_area(points) <= 0:
        raise ProcessError(
            f"class {name}: nothing is left on a grid of {step_nm:g} nm; take a finer grid_nm"
        )
    return points


def _biased(cell: Cell, drawn: int, process: Process, alone: float) -> Outline:
    """The outline of a drawn size: all edges moved alike by the bias of the process.

    Raises:
        ProcessError: the bias closes a hole.
    """
    made = float(process.bias.made_nm(np.array(float(drawn)), alone)) * nm
    outline = cell.outline(made, grow_um=drawn * nm - made)
    if len(outline.parts) != len(cell.outline(made).parts):
        raise ProcessError(
            f"a {cell.shape.name} drawn {drawn} nm wide would have no hole; need a larger size"
        )
    return outline
