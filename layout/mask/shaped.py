"""Pillars that are not round, or turned one by one: a class for every drawn size and
turn.
"""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np

from layout.mask.cells import DrawnClasses, classify_keys, with_isolation
from layout.mask.plan import PillarClass
from layout.process.process import Process
from layout.shapes import polygon, region
from metalens.cell import Cell
from metalens.cell.shapes import EllipseArc, Outline, PolygonLoop, rotate_corners
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm
from metalens.lens import DiameterMap, Lens
from metalens.library.axes import cell_of_sizes

_LENGTHS = 1 << 20  # above any drawn size in nm


def shape_classes(
    source: Lens, process: Process, *, unit_nm: float
) -> tuple[DrawnClasses, tuple[PillarClass, ...]]:
    """The pillars of a lens as classes, with the polygons of each.

    Args:
        source: lens of shaped or rotated pillars.
        process: rules and bias.
        unit_nm: database unit.

    Raises:
        ProcessError: too many classes, a pillar of less than a step, a hole that the
            grid or the bias closes.
        LensError: no pillar.
    """
    diameters = source.diameters
    cell = source.cell
    turns = _turns(cell, diameters, process)
    drawn = classify_keys(diameters, lambda: _keys(diameters, process, turns))
    classes = tuple(
        _class(source, int(key), process, turns, unit_nm) for key in drawn.diameters_nm
    )
    widths_nm = np.array(
        [2 * float(np.hypot(*pillar.outline.T).max()) * unit_nm for pillar in classes]
    )
    return dataclasses.replace(drawn, diameters_nm=widths_nm), classes


def _turns(cell: Cell, diameters: DiameterMap, process: Process) -> int:
    """Number of distinct drawn rotations; 1 where no pillar is rotated."""
    if diameters.angle_rad is None:
        return 1
    period_deg = 180.0 if cell.outline(cell.pitch_um / 2).repeats(math.pi) else 360.0
    return max(1, round(period_deg / process.rules.angle_step_deg))


def _keys(
    diameters: DiameterMap, process: Process, turns: int
) -> Iterator[tuple[int, Array]]:
    """Integer key of each pillar's drawn shape, in blocks of rows.

    key = (drawn + 2^20 second) turns + turn, with the drawn size in nm. ``second`` is
    the drawn length of pillars of two sizes. For others it is isolation times |isolated
    bias|, in nm: pillars of equal drawn size and different isolation have other
    designs.

    Args:
        diameters: sizes, lengths and rotations.
        process: bias and steps.
        turns: number of distinct rotations.

    Yields:
        (first row, (rows, columns) keys); 0 for no pillar.
    """
    isolated_nm = process.bias.isolated_nm
    for first, block, isolation_block in with_isolation(diameters, process):
        rows = slice(first, first + len(block))
        design = np.asarray(block, float) / nm
        isolation = 0.0 if isolation_block is None else isolation_block
        drawn = _steps(design, design, process, isolation)
        if diameters.length_um is not None:
            drawn += _LENGTHS * _steps(
                np.asarray(diameters.length_um[rows], float) / nm,
                design,
                process,
                isolation,
            )
        elif isolation_block is not None:
            drawn += _LENGTHS * np.rint(isolation_block * abs(isolated_nm)).astype(
                np.int64
            )
        turn = np.zeros(design.shape, np.int64)
        if diameters.angle_rad is not None:
            degrees = np.degrees(np.asarray(diameters.angle_rad[rows], float))
            turn = (
                np.rint(degrees / process.rules.angle_step_deg).astype(np.int64) % turns
            )
        yield first, np.where(design > 0, drawn * turns + turn, 0)


def _steps(
    size_nm: Array, design_nm: Array, process: Process, alone: Array | float
) -> Array:
    """Drawn sizes in nm, whole steps of the process; 0 for no pillar.

    Args:
        size_nm: designed sizes.
        design_nm: above 0 where a pillar stands.
        process: bias and step.
        alone: as :meth:`metalens.fabrication.Bias.drawn_nm` takes it.

    Raises:
        ProcessError: a pillar below one step.
    """
    step = process.rules.diameter_step_nm
    drawn = (
        np.rint(process.bias.drawn_nm(size_nm, alone) / step).astype(np.int64) * step
    )
    if ((drawn < step) & (design_nm > 0)).any():
        raise ProcessError(
            f"a pillar would be drawn below one step of {step} nm; check the bias"
        )
    return np.where(design_nm > 0, drawn, 0)


def _class(
    source: Lens, key: int, process: Process, turns: int, unit_nm: float
) -> PillarClass:
    """Pillar class of a key of :func:`_keys`: outline, holes and name.

    Args:
        source: lens of shaped or rotated pillars.
        key: drawn size, second number and rotation.
        process: rules and bias.
        turns: number of distinct rotations.
        unit_nm: database unit.
    """
    shape_key, turn = divmod(key, turns)
    second, drawn = divmod(shape_key, _LENGTHS)
    name = f"D{drawn:06}" if turns == 1 else f"D{drawn:05}R{turn:0{len(str(turns))}}"
    if source.diameters.length_um is not None:
        name = f"D{drawn:05}L{second:05}"
        shape = cell_of_sizes(source.cell, float(drawn), float(second)).outline(
            drawn * nm
        )  # each axis by the bias of its size
    else:
        isolated_nm = process.bias.isolated_nm
        name += f"I{second}" if second else ""
        shape = _biased(
            source.cell,
            drawn,
            process,
            second / abs(isolated_nm) if isolated_nm else 0.0,
        )
    step_nm = process.rules.grid_nm * unit_nm
    turn_rad = math.radians(turn * process.rules.angle_step_deg)
    contours = [
        _gridded(part, turn_rad, step_nm, process, name) * process.rules.grid_nm
        for part in shape.parts
    ]
    outline = contours[0]
    holes = tuple(hole[::-1] for hole in contours[1:])
    pieces = (
        tuple(region.without_holes([outline, *holes], grid=process.rules.grid_nm))
        if holes
        else ()
    )
    layer = process.layers.pillar
    drawn_units = round(drawn / unit_nm)
    return PillarClass(
        name,
        float(drawn),
        drawn_units,
        layer,
        outline,
        pieces,
        round=False,
        holes=holes,
    )


def _gridded(
    part: EllipseArc | PolygonLoop,
    turn_rad: float,
    step_nm: float,
    process: Process,
    name: str,
) -> Array:
    """(n, 2) corners of a part on the grid, in grid steps about the site.

    A circle is a polygon of equal area; any other part is rounded corner by corner.

    Args:
        part: of an outline, um.
        turn_rad: rotation of the pillar.
        step_nm: grid.
        process: number of vertices.
        name: of the class, for messages.

    Raises:
        ProcessError: fewer than three corners are left, or a circle of less than four
            steps.
    """
    if isinstance(part, EllipseArc) and part.half_x_um == part.half_y_um:
        diameter_steps = 2 * part.half_x_um / nm / step_nm
        if diameter_steps < 4:
            raise ProcessError(
                f"class {name}: a circle of {diameter_steps * step_nm:.3g} nm; need four steps of the grid"
            )
        return polygon.pillar_polygon(diameter_steps, vertices=process.rules.vertices)
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
    """Outline of a drawn size: the bias of the process moves all edges equally.

    Args:
        cell: with the shape of the pillars.
        drawn: size, nm.
        process: bias.
        alone: isolation of the pillar, 0 to 1.

    Raises:
        ProcessError: the bias closes a hole.
    """
    made_um = float(process.bias.fabricated_nm(np.array(float(drawn)), alone)) * nm
    outline = cell.outline(made_um, grow_um=drawn * nm - made_um)
    if len(outline.parts) != len(cell.outline(made_um).parts):
        raise ProcessError(
            f"a {cell.shape.name} drawn {drawn} nm wide would have no hole; need a larger size"
        )
    return outline
