"""What is placed on a die: the mask of a lens or a cell of another file, its
doses, and boxes around its shapes.
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from layout.formats import job_files
from layout.formats.library import (
    CellPlacements,
    MaskCell,
    MaskLibrary,
    flatten_stacks,
    library_of,
)
from layout.mask.build import UNIT_NM
from layout.mask.plan import FARTHEST, MaskPlan, PillarArray
from layout.process.process import LayerNumber, Process
from layout.shapes import region
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

PILLARS, APERTURE = "pillars", "aperture"  # the two exposures


@dataclass(frozen=True, eq=False)
class DieComponent:
    """A cell with all below it, in nanometres.

    name: of the part.
    top: its cell.
    library: cells, layer names, and relative dose of each layer that is exposed.
    boxes: {exposure: (n, 4) left, bottom, right, top of its shapes}; of a lattice,
        boxes around some thousand squares of its pillars.
    extent: (4,) around everything, outline too.
    corrected: whether its doses make up for the scattered electrons of its own shapes,
        and of no others.
    uncorrected: {layer: shapes} exposed with the pillars at a dose that corrects
        nothing.
    """

    name: str
    top: str
    library: MaskLibrary
    boxes: Mapping[str, Array]
    extent: Array
    corrected: bool = False
    uncorrected: Mapping[LayerNumber, int] = field(default_factory=dict)


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
        new_names[cell.name]: moved_cell(cell, new_names, {})
        for cell in library.cells.values()
    }
    library = dataclasses.replace(library, cells=cells)
    bare = {key: dataclasses.replace(cell, pillars=None) for key, cell in cells.items()}
    figures = dataclasses.replace(library, cells=bare)
    boxes, _ = _shape_boxes(figures, name, process)
    for lattice in plan.lattices:
        boxes.setdefault(PILLARS, []).append(_lattice_boxes(plan, lattice))
    return _component(name, name, library, boxes, corrected=corrected)


def of_file(
    name: str,
    path: Path,
    content: MaskLibrary,
    process: Process,
    *,
    cell: str,
    relative_dose: float,
) -> DieComponent:
    """A cell of a file with all below it.

    Args:
        name: of the part.
        path: of the file; its doses are read from doses.csv in the same folder.
        content: of the file.
        process: layer numbers.
        cell: its name; empty: the only top cell.
        relative_dose: of layers without a dose in doses.csv.

    Raises:
        MaskFileError: no such cell, several top cells and none named, coordinates that
            are no whole nanometres.
    """
    if not cell and len(content.tops) != 1:
        raise MaskFileError(
            f"{path}: {len(content.tops)} top cells ({', '.join(content.tops[:8])}); "
            'say which one, as cell = "NAME"'
        )
    top = cell or content.tops[0]
    library = _in_unit(content.below(top), UNIT_NM, str(path))
    layers = process.layers
    table = path.with_name("doses.csv")
    table_doses = job_files.read_dose_table(table) if table.is_file() else {}
    used = sorted(library.layers - {layers.outline, layers.fields})
    doses = {layer: table_doses.get(layer, relative_dose) for layer in used}
    boxes, counts = _shape_boxes(library, top, process)
    return _component(
        name,
        top,
        dataclasses.replace(library, doses=doses),
        boxes,
        uncorrected={
            layer: counts[layer]
            for layer in used
            if layer not in table_doses and layer[0] != layers.aperture[0]
        },
    )


def _shape_boxes(
    library: MaskLibrary, top: str, process: Process
) -> tuple[dict[str, list[Array]], Counter[LayerNumber]]:
    """{exposure: (n, 4) boxes of its shapes} below a cell, and shapes of each layer."""
    boxes: dict[str, list[Array]] = {}
    counts: Counter[LayerNumber] = Counter()
    for stack in flatten_stacks(library, top):
        counts[stack.layer] += len(stack.outlines) * len(stack.x)
        pieces = [region.covering_rectangles(outline) for outline in stack.outlines]
        places = np.column_stack([stack.x, stack.y, stack.x, stack.y]).astype(np.int64)
        placed = (np.concatenate(pieces)[None] + places[:, None]).reshape(-1, 4)
        boxes.setdefault(_exposure(stack.layer, process), []).append(placed)
    return boxes, counts


def _component(
    name: str,
    top: str,
    library: MaskLibrary,
    boxes: dict[str, list[Array]],
    **more: Any,
) -> DieComponent:
    """A part with its boxes of both exposures, within those of all shapes."""
    joined = {key: np.concatenate(stacks) for key, stacks in boxes.items()}
    extent = box_around(np.concatenate([np.zeros((0, 4)), *joined.values()]))
    exposed = {key: joined[key] for key in (PILLARS, APERTURE) if key in joined}
    return DieComponent(name, top, library, exposed, extent, **more)


def _exposure(layer: LayerNumber, process: Process) -> str:
    """Exposure of a layer: pillars or aperture, or its number where it is of neither.

    Args:
        layer: number and datatype.
        process: layer numbers.
    """
    layers = process.layers
    if layer[0] == layers.aperture[0]:
        return APERTURE
    ours = layers.pillar, layers.marks, layers.labels, layers.dose, layers.witness
    return PILLARS if layer[0] in {n for n, _ in ours} else f"layer {layer[0]}"


def _in_unit(library: MaskLibrary, unit_nm: float, where: str) -> MaskLibrary:
    """The same mask in another database unit.

    Args:
        library: all its cells.
        unit_nm: new database unit.
        where: name of the file, for messages.

    Raises:
        MaskFileError: a coordinate that is no whole number of new units, or beyond 32
            bits.
    """
    ratio = library.unit_nm / unit_nm
    if abs(ratio - 1) < 1e-9:
        return library

    def scaled(values: Array) -> Array:
        in_new_unit = np.asarray(values, float) * ratio
        whole = np.rint(in_new_unit)
        rounding = np.abs(in_new_unit - whole).max(initial=0)
        largest = np.abs(whole).max(initial=0)
        if rounding > 1e-6 or largest > FARTHEST:
            raise MaskFileError(
                f"{where}: its database unit is {library.unit_nm:g} nm, and its "
                f"coordinates are no whole multiples of {unit_nm:g} nm within 32 bits; "
                f"bring the file to a unit of {unit_nm:g} nm"
            )
        return whole.astype(np.int64)

    def rescaled(old: MaskCell) -> MaskCell:
        return dataclasses.replace(
            old,
            polygons={
                k: [scaled(points) for points in shapes]
                for k, shapes in old.polygons.items()
            },
            references=tuple(
                dataclasses.replace(one, x=scaled(one.x), y=scaled(one.y))
                for one in old.references
                if isinstance(one, CellPlacements)
            ),
        )

    cells = {name: rescaled(cell) for name, cell in library.cells.items()}
    return dataclasses.replace(library, unit_nm=unit_nm, cells=cells)


def moved_cell(
    cell: MaskCell, names: Mapping[str, str], layers: Mapping[LayerNumber, LayerNumber]
) -> MaskCell:
    """A cell with other names and layer numbers.

    Args:
        cell: with all its placements.
        names: {old: new} of every cell.
        layers: {old: new} where they change; two that become one are put together.
    """
    polygons: dict[LayerNumber, list[Array]] = {}
    for layer, shapes in cell.polygons.items():
        polygons.setdefault(layers.get(layer, layer), []).extend(shapes)
    pillars = cell.pillars
    if pillars is not None:
        children = tuple(names.get(child, "") for child in pillars.children)
        pillars = dataclasses.replace(pillars, children=children)
    return dataclasses.replace(
        cell,
        name=names[cell.name],
        polygons=polygons,
        references=tuple(
            dataclasses.replace(one, child=names[one.child]) for one in cell.references
        ),
        pillars=pillars,
    )


def _lattice_boxes(plan: MaskPlan, lattice: PillarArray, tiles: int = 64) -> Array:
    """Boxes around the pillars of tiles of a lattice.

    Args:
        plan: outlines of the classes.
        lattice: of the plan.
        tiles: at most so many along each axis.

    Returns:
        (n, 4) left, bottom, right, top of each tile that holds pillars, database units.
    """
    reach = max(int(np.abs(pillar.outline).max()) for pillar in plan.classes)
    rows_per_tile = -(-lattice.rows // tiles)
    columns_per_tile = -(-lattice.columns // tiles)
    boxes = []
    for first, block in lattice.blocks(rows_per_tile):
        for left in range(0, lattice.columns, columns_per_tile):
            occupied = block[:, left : left + columns_per_tile] != 0
            if occupied.any():
                rows = np.flatnonzero(occupied.any(1))[[-1, 0]] + first
                columns = np.flatnonzero(occupied.any(0))[[0, -1]] + left
                corners = np.column_stack(lattice.positions(rows, columns))
                boxes.append(corners.ravel() + np.array([-1, -1, 1, 1]) * reach)
    return np.array(boxes, np.int64).reshape(-1, 4)


def box_around(boxes: Array) -> Array:
    """(4,) left, bottom, right, top around (n, 4) boxes; zeros for none."""
    if not len(boxes):
        return np.zeros(4)
    return np.concatenate([boxes[:, :2].min(0), boxes[:, 2:].max(0)])
