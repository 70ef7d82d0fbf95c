"""What the operator of the writer gets beside the mask of a die or wafer: write fields
and areas.
"""

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from layout.arrange.joined import PER_UM, PartPlacement
from layout.formats import CellContent, MaskAssembly, handover
from layout.mask import FieldPlan, PillarLattice
from layout.process import LayerNumber
from layout.shapes import polygon
from metalens.core import store
from metalens.core.units import nm

HEAD = (*handover.FIELD_HEAD, "part")


@dataclass(frozen=True, slots=True)
class PlacedField:
    """A write field of a lens on the die: middle and sides, pillars in it."""

    part: str
    x_um: float
    y_um: float
    width_um: float
    height_um: float
    pillars: int


def place_fields(
    placed: Sequence[PartPlacement], splits: Mapping[str, FieldPlan]
) -> Iterator[PlacedField]:
    """Write fields of all lenses on the die, part by part in their order of writing.

    A field has sides along x and y: copies that are turned by no quarter have none
    (:func:`without_fields`).

    Args:
        splits: fields of each lens about its axis, by the name of its part.
    """
    for one in placed:
        if one.part.name not in splits:
            continue
        steps = handover.field_sequence(splits[one.part.name])
        middle = np.array([(step.x_um, step.y_um) for step in steps])
        for copies in one.copies(one.part.top):
            if not copies.turn.quarter:
                continue
            level = copies.turn.angle_deg % 180 == 0
            x, y = copies.turn.apply(middle[:, 0], middle[:, 1])
            for left, up in zip(*(v.tolist() for v in copies.places()), strict=True):
                for n, step in enumerate(steps):
                    sides = step.width_um, step.height_um
                    wide, high = sides if level else sides[::-1]
                    yield PlacedField(
                        one.part.name,
                        float(x[n]) + left / PER_UM,
                        float(y[n]) + up / PER_UM,
                        wide,
                        high,
                        step.pillars,
                    )


def without_fields(
    placed: Sequence[PartPlacement], splits: Mapping[str, FieldPlan]
) -> list[str]:
    """Lenses with copies whose write fields would not lie along x and y, by name."""
    return [
        one.part.name
        for one in placed
        if one.part.name in splits
        and not all(copies.turn.quarter for copies in one.copies(one.part.top))
    ]


def write_fields(fields: Sequence[PlacedField], path: str | Path) -> None:
    """The fields of a die in their order, as CSV."""
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(HEAD)
    for number, step in enumerate(fields, 1):
        sizes = (step.x_um, step.y_um, step.width_um, step.height_um)
        out.writerow([number, *(f"{v:.4f}" for v in sizes), step.pillars, step.part])
    store.write_text(path, text.getvalue())


def areas_um2(made: MaskAssembly) -> dict[LayerNumber, float]:
    """{layer: area of all that is written on it}, over the whole hierarchy."""
    found: dict[str, dict[LayerNumber, float]] = {}

    def area_of(name: str) -> dict[LayerNumber, float]:
        if name not in found:
            cell = made.cells[name]
            total = _own_areas(cell)
            for child, weight in _children(made, name):
                for layer, area in area_of(child).items():
                    total[layer] = total.get(layer, 0.0) + weight * area
            found[name] = total
        return found[name]

    unit = (made.unit_nm * nm) ** 2
    return {layer: area * unit for layer, area in area_of(made.name).items()}


def _own_areas(cell: CellContent) -> dict[LayerNumber, float]:
    """Squared database units of a cell's own shapes."""
    total = {
        layer: sum(abs(polygon.twice_area(np.asarray(p))) / 2 for p in shapes)
        for layer, shapes in cell.polygons.items()
    }
    for layer, circles in cell.circles.items():
        round_area = sum(np.pi * radius**2 for _, _, radius in circles)
        total[layer] = total.get(layer, 0.0) + float(round_area)
    return total


def _children(made: MaskAssembly, name: str) -> Iterator[tuple[str, float]]:
    """(child, copies times their squared scale) of a cell's placements."""
    placed = made.cells[name].kept()
    scales = np.array([turn.scale**2 for turn in placed.turns])
    for child, weight in zip(placed.children, placed.counts() @ scales, strict=True):
        yield child, float(weight)
    for copies in made.copies.get(name, ()):
        yield copies.child, copies.count * copies.turn.scale**2
    if name in made.sites:
        sites = made.sites[name]
        number = np.zeros(len(sites.children) + 1, np.int64)
        for _, block in sites.lattice.blocks(_rows_at_once(sites.lattice)):
            number += np.bincount(block.ravel(), minlength=len(number))
        for child, count in zip(sites.children, number[1:].tolist(), strict=True):
            if count:
                yield child, float(count)


def _rows_at_once(lattice: PillarLattice) -> int:
    return max(1, (1 << 20) // max(1, lattice.columns))
