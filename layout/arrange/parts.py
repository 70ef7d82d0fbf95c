"""What is placed: the content of a lens's mask or of a file made elsewhere, its doses,
and boxes around its shapes.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from layout.formats import (
    NOTHING,
    CellContent,
    CellCopies,
    MaskContent,
    PillarSites,
    doses,
    find_arrays,
    flatten,
)
from layout.mask import UNDRAWN, MaskPlan, PillarLattice
from layout.process import LayerNumber, Process
from layout.shapes import polygon, rectilinear, region
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

UNIT_NM = 1.0
PILLARS, APERTURE = "pillars", "aperture"  # the two exposures
_WHOLE = 1e-6
_TILES = 64  # squares of a lattice, each way


@dataclass(frozen=True, eq=False, slots=True)
class DieComponent:
    """A cell with all below it, in nanometres.

    name: of the part. top: its cell. cells: by name, as they will be written.
    doses: relative dose of each layer that is exposed. layer_names: shown by viewers.
    boxes: {exposure: (n, 4) left, bottom, right, top of its shapes}; of a lattice, of
    some thousand squares of its pillars. extent: (4,) around everything, outline too.
    corrected: whether its doses make up for the scattered electrons of its own shapes,
    and of no others.
    uncorrected: {layer: shapes} beside pillars whose one dose corrects nothing.
    texts, empty: texts and shapes without area that are left out: they draw nothing.
    sites: of cells, beside what their content places.
    """

    name: str
    top: str
    cells: Mapping[str, CellContent]
    doses: Mapping[LayerNumber, float]
    layer_names: Mapping[LayerNumber, str]
    boxes: Mapping[str, Array]
    extent: Array
    corrected: bool = False
    uncorrected: Mapping[LayerNumber, int] = field(default_factory=dict)
    texts: int = 0
    empty: int = 0
    sites: Mapping[str, PillarSites] = field(default_factory=dict)


def plan_extents(name: str, plan: MaskPlan, process: Process) -> DieComponent:
    """Where the shapes of a plan lie, without its cells."""
    boxes, extent = _plan_boxes(plan, process)
    return DieComponent(name, name, {}, plan.doses, plan.layer_names, boxes, extent)


def of_plan(
    name: str,
    plan: MaskPlan,
    content: MaskContent,
    process: Process,
    *,
    corrected: bool,
    lattices: Mapping[str, PillarLattice] | None = None,
) -> DieComponent:
    """The mask of a plan, as it was read back; its cells are named after the part.

    lattices: of cells of which only the sums were kept, which agree with them.
    """
    new = {
        cell: name if cell == plan.name else f"{name}_{cell}" for cell in content.cells
    }
    cells = {new[cell.name]: _renamed(cell, new) for cell in content.cells.values()}
    classes = tuple(new.get(made.name, "") for made in plan.classes)
    known = lattices or {}
    sites = {
        new[c.name]: PillarSites(known[c.name], classes)
        for c in content.cells.values()
        if c.sums is not None
    }
    return DieComponent(
        name,
        name,
        cells,
        plan.doses,
        plan.layer_names,
        *_plan_boxes(plan, process),
        corrected,
        sites=sites,
    )


def _plan_boxes(plan: MaskPlan, process: Process) -> tuple[dict[str, Array], Array]:
    """{exposure: (n, 4) boxes}, and (4,) around everything."""
    boxes = {
        PILLARS: [box for l in plan.lattices for box in _lattice_boxes(plan, l)],
        APERTURE: [],
    }
    every = list(boxes[PILLARS])
    for figure in plan.figures:
        for layer, shapes in figure.polygons.items():
            some = [
                box
                for shape in shapes
                for box in rectilinear.covering_rectangles(np.asarray(shape, np.int64))
            ]
            every += some
            if figure.name not in UNDRAWN:
                boxes[
                    APERTURE if layer[0] == process.layers.aperture[0] else PILLARS
                ] += some
    return {k: _stacked(v) for k, v in boxes.items()}, _around(np.array(every))


def of_file(
    name: str,
    path: Path,
    content: MaskContent,
    process: Process,
    *,
    cell: str,
    relative_dose: float,
) -> DieComponent:
    """A cell of a file with all below it; shapes without area are left out.

    Args:
        cell: its name; empty: the only top cell. relative_dose: of its layers, where
            the file has no doses.csv.

    Raises:
        MaskFileError: no such cell, several top cells and none named, coordinates that
            are no whole nanometres.
    """
    top = _chosen(path, content, cell)
    whole = scale_part(content, UNIT_NM, str(path))
    wanted = _below(content, top)
    cells = {key: _drawing(each) for key, each in whole.cells.items() if key in wanted}
    empty = sum(
        len(shapes) - len(cells[key].polygons.get(layer, ()))
        for key in cells
        for layer, shapes in whole.cells[key].polygons.items()
    )
    empty += sum(  # those that the reader left out
        count
        for cell in cells.values()
        for kind, count in cell.skipped.items()
        if kind.endswith("without area")
    )
    layers = process.layers
    undrawn = {layers.outline, layers.fields}
    table = path.with_name("doses.csv")
    known = doses.read_dose_table(table) if table.is_file() else {}
    used = {
        layer for each in cells.values() for layer in (*each.polygons, *each.circles)
    }
    dosed = {layer: known.get(layer, relative_dose) for layer in sorted(used - undrawn)}
    found, counts = _file_boxes(dataclasses.replace(whole, cells=cells), top, process)
    every = np.concatenate(
        [box for box in found.values() if len(box)] or [np.zeros((1, 4))]
    )
    exposed = {key: box for key, box in found.items() if key in (PILLARS, APERTURE)}
    names = {
        layer: text for layer, text in content.layer_names.items() if layer in used
    }
    return DieComponent(
        name,
        top,
        cells,
        dosed,
        names,
        exposed,
        _around(every),
        uncorrected={
            layer: count
            for layer, count in sorted(counts.items())
            if layer in dosed and layer not in known and layer[0] != layers.aperture[0]
        },
        texts=sum(each.texts for each in cells.values()),
        empty=empty,
    )


def _drawing(cell: CellContent) -> CellContent:
    """A cell without its shapes that have no area, doubled corners taken out."""
    kept: dict[LayerNumber, list[Array]] = {}
    for layer, shapes in cell.polygons.items():
        for shape in shapes:
            corners = shape[(shape != np.roll(shape, 1, axis=0)).any(1)]
            if len(corners) > 2 and (
                polygon.twice_area(corners) or region.union_contours([corners])
            ):
                kept.setdefault(layer, []).append(corners)
    return dataclasses.replace(cell, polygons=kept)


def _chosen(path: Path, content: MaskContent, cell: str) -> str:
    if cell:
        if cell not in content.cells:
            raise MaskFileError(
                f"{path}: no cell {cell!r}; the file holds {', '.join(list(content.cells)[:8])}"
            )
        return cell
    if len(content.tops) != 1:
        raise MaskFileError(
            f'{path}: {len(content.tops)} top cells ({", ".join(content.tops[:8])}); say which one, as cell = "NAME"'
        )
    return content.tops[0]


def _below(content: MaskContent, top: str) -> set[str]:
    """``top`` and all cells that it places, through others too."""
    found, waiting = {top}, [top]
    while waiting:
        for child in content.cells[waiting.pop()].placed.children:
            if child not in content.cells:
                raise MaskFileError(
                    f"cell {child!r} is placed, but the file does not hold it"
                )
            if child not in found:
                found.add(child)
                waiting.append(child)
    return found


def scale_part(content: MaskContent, unit_nm: float, where: str) -> MaskContent:
    """The same mask in another database unit.

    Raises:
        MaskFileError: a coordinate that is no whole number of new units, or beyond 32
            bits.
    """
    ratio = content.unit_nm / unit_nm
    if abs(ratio - 1) < 1e-9:
        return content

    def made(values: Array, kind: type[np.int64 | np.int32] = np.int64) -> Array:
        new = np.asarray(values, float) * ratio
        whole = np.rint(new)
        if (
            np.abs(new - whole).max(initial=0.0) > _WHOLE
            or np.abs(whole).max(initial=0.0) > 2**31 - 1
        ):
            raise MaskFileError(
                f"{where}: its database unit is {content.unit_nm:g} nm, and its coordinates are no whole multiples of "
                f"{unit_nm:g} nm within 32 bits; bring the file to a unit of {unit_nm:g} nm"
            )
        return whole.astype(kind)

    def cell(old: CellContent) -> CellContent:
        placed = old.kept()
        moved = dataclasses.replace(
            placed, x=made(placed.x, np.int32), y=made(placed.y, np.int32)
        )
        polygons = {
            layer: [made(p) for p in shapes] for layer, shapes in old.polygons.items()
        }
        circles = {
            layer: [
                (int(x), int(y), int(r))
                for x, y, r in made(np.array(some).reshape(-1, 3)).tolist()
            ]
            for layer, some in old.circles.items()
        }
        return dataclasses.replace(
            old, polygons=polygons, circles=circles, placed=moved
        )

    return dataclasses.replace(
        content,
        unit_nm=unit_nm,
        cells={name: cell(c) for name, c in content.cells.items()},
    )


def _renamed(cell: CellContent, new: Mapping[str, str]) -> CellContent:
    """With other names of cells; placements of which only sums were kept are left out."""
    placed = cell.placed if cell.sums is None else NOTHING
    children = tuple(new[child] for child in placed.children)
    return dataclasses.replace(
        cell,
        name=new[cell.name],
        placed=dataclasses.replace(placed, children=children),
        sums=None,
    )


def relayer_cell(
    cell: CellContent, new: Mapping[LayerNumber, LayerNumber]
) -> CellContent:
    """A cell with other layer numbers; two that become one are put together."""
    polygons: dict[LayerNumber, list[Array]] = {}
    circles: dict[LayerNumber, list[tuple[int, int, int]]] = {}
    for layer, shapes in cell.polygons.items():
        polygons.setdefault(new.get(layer, layer), []).extend(shapes)
    for layer, some in cell.circles.items():
        circles.setdefault(new.get(layer, layer), []).extend(some)
    return dataclasses.replace(cell, polygons=polygons, circles=circles)


def compact_arrays(cell: CellContent) -> tuple[CellContent, tuple[CellCopies, ...]]:
    """The cell with what its arrays hold taken out, and the arrays."""
    made, left = find_arrays(cell.kept())
    return dataclasses.replace(cell, placed=left), made


def _lattice_boxes(plan: MaskPlan, lattice: PillarLattice) -> list[Array]:
    """Boxes around the pillars of squares of sites, at most 64 each way: single pillars
    where there are few.
    """
    reach = max(int(np.abs(made.outline).max()) for made in plan.classes)
    high, wide = -(-lattice.rows // _TILES), -(-lattice.columns // _TILES)
    found = []
    for first, block in lattice.blocks(high):
        for left in range(0, lattice.columns, wide):
            held = block[:, left : left + wide] != 0
            if held.any():
                rows, columns = (
                    np.flatnonzero(held.any(1)) + first,
                    np.flatnonzero(held.any(0)) + left,
                )
                x = lattice.x0 + columns[[0, -1]] * lattice.pitch
                y = lattice.y0 - rows[[-1, 0]] * lattice.down
                found.append(
                    np.array([x[0] - reach, y[0] - reach, x[1] + reach, y[1] + reach])
                )
    return found


def _file_boxes(
    content: MaskContent, top: str, process: Process
) -> tuple[dict[str, Array], dict[LayerNumber, int]]:
    """Boxes of all shapes below ``top`` by exposure (layers that no exposure of ours
    knows by their number), and the shapes of each layer.
    """
    layers = process.layers
    ours = {layers.aperture[0]: APERTURE}
    ours |= {
        n[0]: PILLARS
        for n in (
            layers.pillar,
            layers.marks,
            layers.labels,
            layers.dose,
            layers.witness,
        )
    }
    found: dict[str, list[Array]] = {}
    counts: dict[LayerNumber, int] = {}
    for stack in flatten.flatten_stacks(content, top):
        number = len(stack.outlines) * len(stack.x)
        counts[stack.layer] = counts.get(stack.layer, 0) + number
        pieces = np.concatenate(
            [rectilinear.covering_rectangles(outline) for outline in stack.outlines]
        )
        places = np.column_stack([stack.x, stack.y, stack.x, stack.y]).astype(np.int64)
        every = (pieces[None] + places[:, None]).reshape(-1, 4)
        found.setdefault(
            ours.get(stack.layer[0], f"layer {stack.layer[0]}"), []
        ).append(every)
    return {key: np.concatenate(some) for key, some in found.items()}, counts


def _stacked(boxes: Sequence[Array]) -> Array:
    return np.array(boxes, np.int64).reshape(-1, 4)


def _around(boxes: Array) -> Array:
    return np.concatenate([boxes[:, :2].min(0), boxes[:, 2:].max(0)])
