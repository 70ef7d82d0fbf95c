"""Negative tone: what the mask of the standing structures leaves empty is drawn, and
nothing else.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np

from layout.mask.plan import UNDRAWN, FigureCell, MaskPlan, PillarArray, PillarClass
from layout.process.process import LayerNumber, Process
from layout.shapes import rectilinear, region
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

_WINDOW_UM = 5.0  # around marks and labels, on their own layer


def reverse_tone(plan: MaskPlan, process: Process) -> MaskPlan:
    """The mask that leaves standing what a plan draws: its gaps are drawn.

    The layers of a second step (aperture) stay as they are.

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
    figures = _surroundings(plan, process, boxes) or [
        _rim(boxes, plan.lattices[0].constant, process)
    ]
    if clear:
        figures.append(FigureCell("CLEAR", {process.layers.pillar: tuple(clear)}))
    unexposed = [
        figure for figure in plan.figures if set(figure.polygons) <= _unexposed(process)
    ]
    return plan.replace(classes=classes, figures=(*unexposed, *figures), standing=plan)


def lattice_box(lattice: PillarArray, grid: int) -> Array:
    """(4, 2) corners around all lattice squares together.

    On a centred lattice the half squares at the ends of every other row are included.

    Args:
        lattice: of pillars.
        grid: step of the coordinates.
    """
    return rectilinear.box_corners(np.add(lattice.box, _square(lattice, grid)))


def _unexposed(process: Process) -> set[LayerNumber]:
    """Layers that the exposure of the pillars does not see."""
    return {process.layers.aperture, process.layers.outline, process.layers.fields}


def _square(lattice: PillarArray, grid: int) -> tuple[int, int, int, int]:
    """Left, bottom, right, top of the lattice square about a site, on the grid; squares
    of neighbours abut.
    """
    left, bottom = (
        -(step // 2 // grid) * grid for step in (lattice.constant, lattice.down)
    )
    return left, bottom, left + lattice.constant, bottom + lattice.down


def _around(
    pillar: PillarClass, square: tuple[int, int, int, int], grid: int
) -> PillarClass:
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
        [rectilinear.box_corners(np.array(square))], pillar.contours
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


def _surroundings(
    plan: MaskPlan, process: Process, boxes: list[Array]
) -> list[FigureCell]:
    """Figures around the lattices of a negative tone: windows, and the die frame.

    The window of a figure is a box 5 um wider than each of its shapes, without the
    shapes, on the layer of the figure. The frame is the die without lattices, windows
    and shapes.

    Returns:
        Figures; none where the plan has no outline of a die.
    """
    die = [
        outline
        for figure in plan.figures
        if figure.name == "OUTLINE"
        for outline in figure.polygons[process.layers.outline]
    ]
    if not die:
        return []
    margin = round(_WINDOW_UM * 1e3 / plan.unit_nm / plan.grid) * plan.grid
    drawn = [
        f
        for f in plan.figures
        if f.name not in UNDRAWN and not set(f.polygons) <= _unexposed(process)
    ]
    standing = [
        shape
        for figure in drawn
        for shapes in figure.polygons.values()
        for shape in shapes
    ]
    covered = list(boxes)
    figures = []
    for figure in drawn:
        polygons = {}
        for layer, shapes in figure.polygons.items():
            window = region.overlap_contours(
                region.subtract_contours(
                    [_grown(shape, margin) for shape in shapes], covered
                ),
                die,
            )
            polygons[layer] = tuple(
                region.without_holes(
                    region.subtract_contours(window, standing), grid=plan.grid
                )
            )
            covered += [_grown(shape, margin) for shape in shapes]
        figures.append(FigureCell(figure.name, polygons))
    frame = region.without_holes(
        region.subtract_contours(die, [*covered, *standing]), grid=plan.grid
    )
    return [*figures, FigureCell("FRAME", {process.layers.pillar: tuple(frame)})]


def _rim(boxes: list[Array], width: int, process: Process) -> FigureCell:
    """A frame around lattices of their own, four rectangles each."""
    shapes: list[Array] = []
    for box in boxes:
        (left, bottom), (right, top) = box.min(0).tolist(), box.max(0).tolist()
        x0 = left - width
        y0 = bottom - width
        x1 = right + width
        y1 = top + width
        sides = (
            (x0, y0, x1, bottom),
            (x0, top, x1, y1),
            (x0, bottom, left, top),
            (right, bottom, x1, top),
        )
        shapes += [rectilinear.box_corners(np.array(side)) for side in sides]
    return FigureCell("RIM", {process.layers.pillar: tuple(shapes)})


def _grown(shape: Array, margin: int) -> Array:
    """Box around a shape, wider by a margin on all sides."""
    return rectilinear.box_corners(
        np.array([*(shape.min(0) - margin), *(shape.max(0) + margin)])
    )
