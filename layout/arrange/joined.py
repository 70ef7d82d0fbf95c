"""Parts put together: one table of doses, names that differ, a die of placed parts, a
wafer of dies.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from layout.arrange.parts import UNIT_NM, DieComponent, compact_arrays, relayer_cell
from layout.arrange.record import Placement
from layout.formats import (
    CellContent,
    CellCopies,
    MaskAssembly,
    Orientation,
    PillarSites,
)
from layout.process import LayerNumber
from metalens.core.errors import ProcessError

PER_UM = 1000 / UNIT_NM
MARGIN_UM = 10.0  # around the marks of a wafer
_SAME = 5e-7  # doses that are written alike
_MOST_DATATYPE = 32767


@dataclass(frozen=True, eq=False, slots=True)
class PartPlacement:
    """A part and where it stands on the die."""

    part: DieComponent
    at: tuple[Placement, ...]

    def copies(self, top: str) -> tuple[CellCopies, ...]:
        """As arrays of its cell ``top``, in database units."""
        return tuple(_copies(top, at) for at in self.at)


def _copies(child: str, at: Placement) -> CellCopies:
    x, y = round(at.x_um * PER_UM), round(at.y_um * PER_UM)
    step = (
        (0, 0) if at.step_um is None else tuple(round(s * PER_UM) for s in at.step_um)
    )
    turn = Orientation(at.turn_deg % 360, at.mirrored)
    return CellCopies(
        child, x, y, turn, at.columns, at.rows, (step[0], 0), (0, step[1])
    )


@dataclass(eq=False, slots=True)
class JobLayers:
    """(layer, datatype) of all parts together: one dose each.

    doses: of those that are exposed. names: shown by viewers. kept: numbers that mean
    something undosed.
    """

    kept: frozenset[LayerNumber]
    doses: dict[LayerNumber, float] = field(default_factory=dict)
    names: dict[LayerNumber, str] = field(default_factory=dict)

    def take(self, part: DieComponent) -> dict[LayerNumber, LayerNumber]:
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
        if layer not in self.kept and abs(self.doses.get(layer, dose) - dose) < _SAME:
            return layer
        for other, known in sorted(self.doses.items()):
            if other[0] == layer[0] and abs(known - dose) < _SAME:
                return other
        for datatype in range(_MOST_DATATYPE + 1):
            if (layer[0], datatype) not in self.doses and (
                layer[0],
                datatype,
            ) not in self.kept:
                return layer[0], datatype
        raise ProcessError(f"layer {layer[0]}: all datatypes hold doses")


def die_cell(
    name: str, placed: Sequence[PartPlacement], *, kept: frozenset[LayerNumber]
) -> MaskAssembly:
    """All parts in one cell ``name``."""
    layers = JobLayers(kept)
    cells: dict[str, CellContent] = {}
    copies: dict[str, tuple[CellCopies, ...]] = {}
    sites: dict[str, PillarSites] = {}
    here: list[CellCopies] = []
    for one in placed:
        new = _take(one.part, layers, cells, copies, sites)
        here += one.copies(new[one.part.top])
    if name in cells:
        raise ProcessError(
            f"a part holds a cell {name!r}, the name of the arrangement; give the arrangement another"
        )
    cells[name] = CellContent(name)
    copies[name] = tuple(here)
    return MaskAssembly(name, cells, copies, UNIT_NM, layers.names, layers.doses, sites)


def _take(
    part: DieComponent,
    layers: JobLayers,
    cells: dict[str, CellContent],
    copies: dict[str, tuple[CellCopies, ...]],
    sites: dict[str, PillarSites],
) -> dict[str, str]:
    """The cells of a part with numbers and names of their own; {old: new name}."""
    numbers = layers.take(part)
    new: dict[str, str] = {}
    for name in part.cells:
        new[name] = _free(name, cells, new)
    for name, cell in part.cells.items():
        left, found = compact_arrays(relayer_cell(cell, numbers))
        children = tuple(new[child] for child in left.placed.children)
        cells[new[name]] = dataclasses.replace(
            left,
            name=new[name],
            placed=dataclasses.replace(left.placed, children=children),
        )
        if found:
            copies[new[name]] = tuple(
                dataclasses.replace(one, child=new[one.child]) for one in found
            )
        if name in part.sites:
            sites[new[name]] = part.sites[name].renamed(new)
    return new


def _free(name: str, cells: Mapping[str, CellContent], new: Mapping[str, str]) -> str:
    taken, made, number = {*cells, *new.values()}, name, 1
    while made in taken:
        number += 1
        made = f"{name}_{number}"
    return made


def wafer_cell(
    name: str,
    one: MaskAssembly,
    steps: tuple[CellCopies, ...],
    marks: PartPlacement | None,
) -> MaskAssembly:
    """Dies, and the wafer's marks beside them, in one cell ``name``."""
    layers = JobLayers(frozenset(), dict(one.doses), dict(one.layer_names))
    cells, copies, sites = dict(one.cells), dict(one.copies), dict(one.sites)
    here = list(steps)
    if marks is not None:
        new = _take(marks.part, layers, cells, copies, sites)
        here += marks.copies(new[marks.part.top])
    if name in cells:
        raise ProcessError(
            f"a part holds a cell {name!r}, the name of the arrangement; give the arrangement another"
        )
    cells[name] = CellContent(name)
    copies[name] = tuple(here)
    return dataclasses.replace(
        one,
        name=name,
        cells=cells,
        copies=copies,
        sites=sites,
        doses=layers.doses,
        layer_names=layers.names,
    )
