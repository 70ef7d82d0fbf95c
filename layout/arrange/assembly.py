"""Parts put together: one table of doses, names that differ, a die of placed parts, a
wafer of dies.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from layout.arrange.parts import DieComponent, moved_cell
from layout.arrange.record import PartInstances
from layout.formats import gdsii_write, job_files
from layout.formats.library import CellReference, MaskCell, MaskLibrary, Orientation
from layout.mask.build import UNIT_NM
from layout.mask.fields import FieldPlan
from layout.process.process import LayerNumber
from metalens.core.errors import ProcessError

PER_UM = 1000 / UNIT_NM
_SAME = 5e-7  # difference of doses that are written as the same number


@dataclass(frozen=True, eq=False)
class PartPlacement:
    """A part and where it stands on the die."""

    part: DieComponent
    at: tuple[PartInstances, ...]

    def copies(self, top: str) -> tuple[CellReference, ...]:
        """As arrays of its cell ``top``, in database units."""
        references = []
        for at in self.at:
            step_x, step_y = (round(v * PER_UM) for v in at.step_um or (0, 0))
            references.append(
                CellReference(
                    top,
                    round(at.x_um * PER_UM),
                    round(at.y_um * PER_UM),
                    Orientation(at.turn_deg % 360, at.mirrored),
                    at.columns,
                    at.rows,
                    (step_x, 0),
                    (0, step_y),
                )
            )
        return tuple(references)


@dataclass(eq=False)
class JobLayers:
    """(layer, datatype) of all parts together: one dose each.

    doses: of those that are exposed. names: shown by viewers. kept: undosed layers,
    whose numbers no dose may take.
    """

    kept: frozenset[LayerNumber]
    doses: dict[LayerNumber, float] = field(default_factory=dict)
    names: dict[LayerNumber, str] = field(default_factory=dict)

    def take(self, part: MaskLibrary) -> dict[LayerNumber, LayerNumber]:
        """New numbers of a part's layers: its own where these are free or mean the same
        dose, else a free datatype.
        """
        new: dict[LayerNumber, LayerNumber] = {}
        for layer, dose in sorted(part.doses.items()):
            new[layer] = self._number(layer, dose)
            self.doses[new[layer]] = dose
        for layer, name in sorted(part.layer_names.items()):
            self.names.setdefault(new.get(layer, layer), name)
        return new

    def _number(self, layer: LayerNumber, dose: float) -> LayerNumber:
        """Number of a layer of a given dose, free or with an equal dose.

        The own number first, then any with that dose, then the first free datatype.

        Raises:
            ProcessError: no datatype is free.
        """
        if layer not in self.kept and abs(self.doses.get(layer, dose) - dose) < _SAME:
            return layer
        for other, other_dose in sorted(self.doses.items()):
            if other[0] == layer[0] and abs(other_dose - dose) < _SAME:
                return other
        for datatype in range(gdsii_write.MAX_NUMBER + 1):
            if (layer[0], datatype) not in self.doses and (
                layer[0],
                datatype,
            ) not in self.kept:
                return layer[0], datatype
        raise ProcessError(f"layer {layer[0]}: all datatypes hold doses")


def die_cell(
    name: str, placed: Sequence[PartPlacement], *, kept: frozenset[LayerNumber]
) -> MaskLibrary:
    """All parts in one cell.

    Args:
        name: of the cell, and of the library.
        placed: parts and their places.
        kept: layers that mean something undosed.

    Raises:
        ProcessError: a part with a cell of that name.
    """
    layers = JobLayers(kept)
    cells: dict[str, MaskCell] = {}
    references: list[CellReference] = []
    for part_placement in placed:
        references += _take(part_placement, layers, cells)
    return _joined(name, cells, references, layers)


def wafer_cell(
    name: str,
    one: MaskLibrary,
    steps: tuple[CellReference, ...],
    marks: PartPlacement | None,
) -> MaskLibrary:
    """Dies, and the wafer's marks, in one cell.

    Args:
        name: of the cell, and of the library.
        one: the die.
        steps: places of the die.
        marks: alignment marks of the wafer.

    Raises:
        ProcessError: a part with a cell of that name.
    """
    layers = JobLayers(frozenset(), dict(one.doses), dict(one.layer_names))
    cells = dict(one.cells)
    references = list(steps)
    if marks is not None:
        references += _take(marks, layers, cells)
    return _joined(name, cells, references, layers)


def _joined(
    name: str,
    cells: dict[str, MaskCell],
    references: Sequence[CellReference],
    layers: JobLayers,
) -> MaskLibrary:
    """Mask of a top cell with references, and the cells of all parts.

    Raises:
        ProcessError: a part with a cell of the name of the top cell.
    """
    if name in cells:
        raise ProcessError(
            f"a part holds a cell {name!r}, the name of the arrangement; give the "
            "arrangement another"
        )
    top = MaskCell(name, references=tuple(references))
    return MaskLibrary(name, {**cells, name: top}, UNIT_NM, layers.names, layers.doses)


def _take(
    placed: PartPlacement, layers: JobLayers, cells: dict[str, MaskCell]
) -> tuple[CellReference, ...]:
    """Copy the cells of a part into the mask, renamed where a name is in use.

    Args:
        placed: the part and its places.
        layers: of the whole mask; receives those of the part.
        cells: of the whole mask; receives those of the part.

    Returns:
        References to the top cell of the part.
    """
    part = placed.part
    numbers = layers.take(part.library)
    new_names: dict[str, str] = {}
    for name in part.library.cells:
        taken = {*cells, *new_names.values()}
        candidates = (f"{name}_{n}" for n in itertools.count(2))
        new_names[name] = (
            name
            if name not in taken
            else next(candidate for candidate in candidates if candidate not in taken)
        )
    for cell in part.library.cells.values():
        cells[new_names[cell.name]] = moved_cell(cell, new_names, numbers)
    return placed.copies(new_names[part.top])


# write fields


def place_fields(
    placed: Sequence[PartPlacement], splits: Mapping[str, FieldPlan]
) -> Iterator[job_files.WriteStep]:
    """Write fields of all lenses on the die, part by part in their order of writing.

    A field has sides along x and y: copies that are turned by no quarter have none
    (:func:`without_fields`).

    Args:
        splits: fields of each lens about its axis, by the name of its part.
        placed: parts on the die.
    """
    for part_placement in placed:
        if part_placement.part.name not in splits:
            continue
        steps = job_files.field_sequence(splits[part_placement.part.name])
        centres = np.array([(step.x_um, step.y_um) for step in steps])
        for copies in part_placement.copies(part_placement.part.top):
            if not copies.turn.quarter:
                continue
            is_level = copies.turn.angle_deg % 180 == 0
            x, y = copies.turn.apply(centres[:, 0], centres[:, 1])
            for copy_x, copy_y in zip(
                *(values.tolist() for values in copies.places()), strict=True
            ):
                for n, step in enumerate(steps):
                    sides = step.width_um, step.height_um
                    width, height = sides if is_level else sides[::-1]
                    yield job_files.WriteStep(
                        float(x[n]) + copy_x / PER_UM,
                        float(y[n]) + copy_y / PER_UM,
                        width,
                        height,
                        step.pillars,
                        part_placement.part.name,
                    )


def without_fields(
    placed: Sequence[PartPlacement], splits: Mapping[str, FieldPlan]
) -> list[str]:
    """Lenses with copies whose write fields would not lie along x and y, by name.

    Args:
        placed: parts on the die.
        splits: fields of each lens, by the name of its part.
    """
    return [
        one.part.name
        for one in placed
        if one.part.name in splits
        and not all(copies.turn.quarter for copies in one.copies(one.part.top))
    ]
