"""What is placed on a die: the mask of a lens or of its surroundings, its doses, and
boxes around its shapes.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from layout.formats.library import MaskCell, MaskLibrary, library_of
from layout.mask.plan import UNDRAWN, MaskPlan, PillarArray
from layout.process.process import LayerNumber, Process
from layout.shapes import rectilinear, region
from metalens.core.arrays import Array

UNIT_NM = 1.0
PILLARS, APERTURE = "pillars", "aperture"  # the two exposures
_TILES = 64  # squares of a lattice, each way, and slices of a slanted polygon


@dataclass(frozen=True, eq=False, slots=True)
class DieComponent:
    """A cell with all below it, in nanometres.

    name: of the part and of its cell.
    library: cells, layer names, and relative dose of each layer that is exposed.
    boxes: {exposure: (n, 4) left, bottom, right, top of its shapes}; of a lattice,
        boxes around some thousand squares of its pillars.
    extent: (4,) around everything, outline too.
    corrected: whether its doses make up for the scattered electrons of its own shapes,
        and of no others.
    """

    name: str
    library: MaskLibrary
    boxes: Mapping[str, Array]
    extent: Array
    corrected: bool = False


def of_plan(
    name: str, plan: MaskPlan, process: Process, *, corrected: bool
) -> DieComponent:
    """The mask of a plan; its cells are named after the part.

    Args:
        name: of the part.
        plan: of the lens or frame.
        process: layer numbers.
        corrected: whether the plan has corrected doses.
    """
    library = library_of(plan)
    new_names = {
        cell: name if cell == plan.name else f"{name}_{cell}" for cell in library.cells
    }
    cells = {
        new_names[cell.name]: _renamed(cell, new_names)
        for cell in library.cells.values()
    }
    boxes = {
        PILLARS: [
            box for lattice in plan.lattices for box in _lattice_boxes(plan, lattice)
        ],
        APERTURE: [],
    }
    all_boxes = list(boxes[PILLARS])
    for figure in plan.figures:
        for layer, shapes in figure.polygons.items():
            boxes_of_shapes = [
                box for shape in shapes for box in _covering_rectangles(shape)
            ]
            all_boxes += boxes_of_shapes
            if figure.name not in UNDRAWN:
                boxes[_exposure(layer, process)] += boxes_of_shapes
    boxes_of_exposure = {
        exposure: _stacked(listed) for exposure, listed in boxes.items()
    }
    library = dataclasses.replace(library, cells=cells)
    extent = box_around(_stacked(all_boxes))
    return DieComponent(name, library, boxes_of_exposure, extent, corrected)


def _exposure(layer: LayerNumber, process: Process) -> str:
    """Exposure of a layer that a resist sees: pillars or aperture."""
    return APERTURE if layer[0] == process.layers.aperture[0] else PILLARS


def _renamed(cell: MaskCell, names: Mapping[str, str]) -> MaskCell:
    """A cell of a plan with other names."""
    pillars = cell.pillars
    if pillars is not None:
        children = tuple(names.get(child, "") for child in pillars.children)
        pillars = dataclasses.replace(pillars, children=children)
    references = tuple(
        dataclasses.replace(one, child=names[one.child]) for one in cell.references
    )
    return dataclasses.replace(
        cell, name=names[cell.name], references=references, pillars=pillars
    )


def _lattice_boxes(plan: MaskPlan, lattice: PillarArray) -> list[Array]:
    """Boxes around the pillars of tiles of a lattice, at most 64 by 64 tiles.

    Args:
        plan: outlines of the classes.
        lattice: of the plan.

    Returns:
        (4,) left, bottom, right, top of each tile that holds pillars, database units.
    """
    reach = max(int(np.abs(pillar.outline).max()) for pillar in plan.classes)
    rows_per_tile = -(-lattice.rows // _TILES)
    columns_per_tile = -(-lattice.columns // _TILES)
    boxes = []
    for first, block in lattice.blocks(rows_per_tile):
        for left in range(0, lattice.columns, columns_per_tile):
            occupied = block[:, left : left + columns_per_tile] != 0
            if occupied.any():
                rows = np.flatnonzero(occupied.any(1))[[-1, 0]] + first
                columns = np.flatnonzero(occupied.any(0))[[0, -1]] + left
                x = lattice.x0 + columns * lattice.pitch
                y = lattice.y0 - rows * lattice.down
                low, high_corner = (x[0], y[0]), (x[1], y[1])
                boxes.append(
                    np.add([*low, *high_corner], np.array([-1, -1, 1, 1]) * reach)
                )
    return boxes


def _stacked(boxes: Sequence[Array]) -> Array:
    """(n, 4) boxes."""
    return np.array(boxes, np.int64).reshape(-1, 4)


def box_around(boxes: Array) -> Array:
    """(4,) left, bottom, right, top around (n, 4) boxes; zeros for none."""
    if not len(boxes):
        return np.zeros(4)
    return np.concatenate([boxes[:, :2].min(0), boxes[:, 2:].max(0)])


def _covering_rectangles(shape: Array) -> Array:
    """(n, 4) rectangles of a rectilinear polygon, or boxes around 64 slices of another.

    Args:
        shape: (n, 2) corners, database units.
    """
    if not (shape != np.roll(shape, 1, axis=0)).all(1).any():
        return rectilinear.split_rectilinear(shape)
    (left, low), (right, high) = shape.min(0), shape.max(0)
    boxes = []
    for bottom, top in itertools.pairwise(np.linspace(low, high, _TILES + 1)):
        slab = rectilinear.box_corners(np.array([left, bottom, right, top]))
        corners = np.concatenate(region.overlap_contours([shape], [slab]))
        boxes.append([*corners.min(0), *corners.max(0)])
    return np.array(boxes, np.int64)
