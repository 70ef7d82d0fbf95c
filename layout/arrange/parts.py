"""What is placed on a die: the mask of a lens or a cell of a file made elsewhere, its
doses, and boxes around its shapes.
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from layout.formats import job_files
from layout.formats.library import MaskCell, MaskLibrary, flatten_stacks, library_of
from layout.mask.plan import UNDRAWN, MaskPlan, PillarArray
from layout.process.process import LayerNumber, Process
from layout.shapes import polygon, rectilinear, region
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

UNIT_NM = 1.0
PILLARS, APERTURE = "pillars", "aperture"  # the two exposures
_TILES = 64  # squares of a lattice, each way


@dataclass(frozen=True, eq=False, slots=True)
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
    empty: shapes without area that were left out.
    """

    name: str
    top: str
    library: MaskLibrary
    boxes: Mapping[str, Array]
    extent: Array
    corrected: bool = False
    uncorrected: Mapping[LayerNumber, int] = field(default_factory=dict)
    empty: int = 0


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
                box
                for shape in shapes
                for box in rectilinear.covering_rectangles(shape)
            ]
            all_boxes += boxes_of_shapes
            if figure.name not in UNDRAWN:
                boxes[_exposure(layer, process)] += boxes_of_shapes
    boxes_of_exposure = {
        exposure: _stacked(listed) for exposure, listed in boxes.items()
    }
    library = dataclasses.replace(library, cells=cells)
    extent = box_around(_stacked(all_boxes))
    return DieComponent(name, name, library, boxes_of_exposure, extent, corrected)


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
    library, empty = _without_empty(library)
    layers = process.layers
    table = path.with_name("doses.csv")
    table_doses = job_files.read_dose_table(table) if table.is_file() else {}
    used = sorted(library.layers - {layers.outline, layers.fields})
    doses = {layer: table_doses.get(layer, relative_dose) for layer in used}
    boxes: dict[str, list[Array]] = {}
    counts: Counter[LayerNumber] = Counter()
    for stack in flatten_stacks(library, top):
        counts[stack.layer] += len(stack.outlines) * len(stack.x)
        pieces = [
            rectilinear.covering_rectangles(outline) for outline in stack.outlines
        ]
        places = np.column_stack([stack.x, stack.y, stack.x, stack.y]).astype(np.int64)
        placed = (np.concatenate(pieces)[None] + places[:, None]).reshape(-1, 4)
        boxes.setdefault(_exposure(stack.layer, process, other=True), []).append(placed)
    boxes_of_exposure = {key: np.concatenate(stacks) for key, stacks in boxes.items()}
    all_boxes = np.concatenate(
        [
            *boxes_of_exposure.values(),
            *([] if boxes_of_exposure else [np.zeros((1, 4))]),
        ]
    )
    return DieComponent(
        name,
        top,
        dataclasses.replace(library, doses=doses),
        {
            key: stacked
            for key, stacked in boxes_of_exposure.items()
            if key in (PILLARS, APERTURE)
        },
        box_around(all_boxes),
        uncorrected={
            layer: counts[layer]
            for layer in used
            if layer not in table_doses and layer[0] != layers.aperture[0]
        },
        empty=empty,
    )


def _without_empty(library: MaskLibrary) -> tuple[MaskLibrary, int]:
    """Cells without shapes that enclose no area, and how many of these there were."""
    count = sum(
        number
        for kind, number in library.skipped.items()
        if kind.endswith("without area")
    )
    cells = {}
    for name, cell in library.cells.items():
        polygons: dict[LayerNumber, list[Array]] = {}
        for layer, shapes in cell.polygons.items():
            for shape in shapes:
                if polygon.twice_area(shape) or region.union_contours([shape]):
                    polygons.setdefault(layer, []).append(shape)
                else:
                    count += 1
        cells[name] = dataclasses.replace(cell, polygons=polygons)
    return dataclasses.replace(library, cells=cells), count


def _exposure(layer: LayerNumber, process: Process, *, other: bool = False) -> str:
    """Exposure of a layer: pillars or aperture, or its number where it is of neither.

    Args:
        layer: number and datatype.
        process: layer numbers.
        other: whether there are layers of neither.
    """
    layers = process.layers
    if layer[0] == layers.aperture[0]:
        return APERTURE
    ours = layers.pillar, layers.marks, layers.labels, layers.dose, layers.witness
    if other and layer[0] not in {number for number, _ in ours}:
        return f"layer {layer[0]}"
    return PILLARS


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
        if rounding > 1e-6 or largest > 2**31 - 1:
            raise MaskFileError(
                f"{where}: its database unit is {library.unit_nm:g} nm, and its "
                f"coordinates are no whole multiples of {unit_nm:g} nm within 32 bits; "
                f"bring the file to a unit of {unit_nm:g} nm"
            )
        return whole.astype(np.int64)

    def rescaled(old: MaskCell) -> MaskCell:
        placed = old.kept()
        x, y = (scaled(places).astype(np.int32) for places in (placed.x, placed.y))
        return dataclasses.replace(
            old,
            polygons={
                k: [scaled(points) for points in shapes]
                for k, shapes in old.polygons.items()
            },
            placed=dataclasses.replace(placed, x=x, y=y),
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
    placed = cell.kept()
    pillars = cell.pillars
    if pillars is not None:
        children = tuple(names.get(child, "") for child in pillars.children)
        pillars = dataclasses.replace(pillars, children=children)
    return dataclasses.replace(
        cell,
        name=names[cell.name],
        polygons=polygons,
        placed=dataclasses.replace(
            placed, children=tuple(names[child] for child in placed.children)
        ),
        references=tuple(
            dataclasses.replace(one, child=names[one.child]) for one in cell.references
        ),
        pillars=pillars,
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
