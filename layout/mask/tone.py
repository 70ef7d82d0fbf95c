"""Negative tone: what the mask of the standing structures leaves empty is drawn, and
nothing else.
"""

import dataclasses
import itertools
from collections.abc import Iterator

import numpy as np

from layout.mask.plan import UNDRAWN, FigureCell, MaskPlan, PillarArray, PillarClass
from layout.process.process import Process
from layout.shapes import rectilinear, region
from layout.shapes.rectilinear import IntBox
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError


def reverse_tone(plan: MaskPlan, process: Process) -> MaskPlan:
    """The mask that leaves standing what a plan draws: its gaps are drawn.

    Between the lattices, and up to the outline of the die (a lattice constant without
    one), a frame on the layer of the pillars leaves out marks and labels. The layers of
    a second step (aperture) stay as they are.

    Args:
        plan: of the standing pillars.
        process: layers.

    Raises:
        ProcessError: a pillar wider than its lattice square, lattices of different
            pitches.
    """
    pitches = {
        (lattice.pitch, lattice.down, lattice.centred) for lattice in plan.lattices
    }
    if len(pitches) > 1:
        raise ProcessError(
            f"tone 'negative' with lattices of pitches {sorted({pitch[0] for pitch in pitches})}: put them on masks of "
            "their own"
        )
    square = _square(plan.lattices[0], plan.grid)
    classes = tuple(_around(pillar, square, plan.grid) for pillar in plan.classes)
    boxes = [lattice_box(lattice, plan.grid) for lattice in plan.lattices]
    clear = [
        box
        for lattice in plan.lattices
        for box in _empty(lattice, square[0], square[3])
    ]
    layers = process.layers  # those that the exposure of the pillars does not see
    others = {layers.aperture, layers.outline, layers.fields}
    unexposed = [figure for figure in plan.figures if set(figure.polygons) <= others]
    margin = plan.lattices[0].constant
    outlines = [
        f.polygons[process.layers.outline] for f in unexposed if f.name == "OUTLINE"
    ]
    die = [*itertools.chain(*outlines)] or [
        rectilinear.box_corners([*(box.min(0) - margin), *(box.max(0) + margin)])
        for box in boxes
    ]
    standing = [
        shape
        for figure in plan.figures
        if figure.name not in UNDRAWN and figure not in unexposed
        for shapes in figure.polygons.values()
        for shape in shapes
    ]
    frame = region.without_holes(
        region.subtract_contours(die, [*boxes, *standing]), grid=plan.grid
    )
    figures = [*unexposed, FigureCell("FRAME", {process.layers.pillar: tuple(frame)})]
    if clear:
        figures.append(FigureCell("CLEAR", {process.layers.pillar: tuple(clear)}))
    return plan.replace(classes=classes, figures=tuple(figures), standing=plan)


def lattice_box(lattice: PillarArray, grid: int) -> Array:
    """(4, 2) corners around all lattice squares together.

    On a centred lattice the half squares at the ends of every other row are included.

    Args:
        lattice: of pillars.
        grid: step of the coordinates.
    """
    return rectilinear.box_corners(np.add(lattice.box, _square(lattice, grid)))


def _square(lattice: PillarArray, grid: int) -> IntBox:
    """Left, bottom, right, top of the lattice square about a site, on the grid; squares
    of neighbours abut.
    """
    left, bottom = (
        -(step // 2 // grid) * grid for step in (lattice.constant, lattice.down)
    )
    return left, bottom, left + lattice.constant, bottom + lattice.down


def _around(pillar: PillarClass, square: IntBox, grid: int) -> PillarClass:
    """A pillar class that draws its lattice square without the pillar.

    Args:
        pillar: class of the standing pillars.
        square: left, bottom, right, top about the site.
        grid: step of the coordinates.

    Raises:
        ProcessError: the pillar is wider than the square.
    """
    (left, bottom), (right, top) = pillar.outline.min(0), pillar.outline.max(0)
    if left < square[0] or bottom < square[1] or right > square[2] or top > square[3]:
        raise ProcessError(
            f"class {pillar.name}: {right - left} by {top - bottom} units, wider than the lattice square of "
            f"{square[2] - square[0]} by {square[3] - square[1]}: tone 'negative' draws what is left of the square; "
            "widen the pitch"
        )
    remainder = region.subtract_contours(
        [rectilinear.box_corners(square)], pillar.contours
    )
    return dataclasses.replace(
        pillar, drawn=tuple(region.without_holes(remainder, grid=grid))
    )


def _empty(lattice: PillarArray, left_of: int, top_of: int) -> list[Array]:
    """Rectangles over the squares of sites without pillar.

    Equal runs of empty columns in neighbouring rows are one rectangle. On a centred
    lattice a square covers two columns.

    Args:
        lattice: of pillars.
        left_of: left edge of a square about its site.
        top_of: top edge.
    """

    def free_rows() -> Iterator[Array]:
        for _, block in lattice.blocks():
            free = block == 0
            if lattice.centred:
                free = np.pad(free, ((0, 0), (0, 1)), constant_values=True)
                free[:, 1:] &= block == 0
            yield from free

    runs = rectilinear.merge_runs(free_rows())
    x = lattice.x0 + runs[:, [0, 2]] * lattice.pitch + left_of
    y = lattice.y0 - runs[:, [3, 1]] * lattice.down + top_of
    boxes = np.column_stack([x[:, 0], y[:, 0], x[:, 1], y[:, 1]])
    return [rectilinear.box_corners(box) for box in boxes]
