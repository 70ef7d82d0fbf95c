"""Parts put together: one table of doses, names that differ, a die of placed parts, a
wafer of dies.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from layout.arrange.parts import UNIT_NM, Part, compact, relayered
from layout.arrange.record import At
from layout.formats import Assembly, CellContent, Copies, Sites, Turn
from layout.process import LayerNumber
from metalens.ground.errors import ProcessError

PER_UM = 1000 / UNIT_NM
MARGIN_UM = 10.0  # around the marks of a wafer
_SAME = 5e-7  # doses that are written alike
_MOST_DATATYPE = 32767


@dataclass(frozen=True, eq=False, slots=True)
class Placing:
    """A part and where it stands on the die."""

    part: Part
    at: tuple[At, ...]

    def copies(self, top: str) -> tuple[Copies, ...]:
        """As arrays of its cell ``top``, in database units."""
        return tuple(_copies(top, at) for at in self.at)


def _copies(child: str, at: At) -> Copies:
    x, y = round(at.x_um * PER_UM), round(at.y_um * PER_UM)
    step = (
        (0, 0) if at.step_um is None else tuple(round(s * PER_UM) for s in at.step_um)
    )
    turn = Turn(at.turn_deg % 360, at.mirrored)
    return Copies(child, x, y, turn, at.columns, at.rows, (step[0], 0), (0, step[1]))


@dataclass(eq=False, slots=True)
class Layers:
    """(layer, datatype) of all parts together: one dose each.

    doses: of those that are exposed. names: shown by viewers. kept: numbers that mean
    something undosed.
    """

    kept: frozenset[LayerNumber]
    doses: dict[LayerNumber, float] = field(default_factory=dict)
    names: dict[LayerNumber, str] = field(default_factory=dict)

    def take(self, part: Part) -> dict[LayerNumber, LayerNumber]:
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


def die(
    name: str, placed: Sequence[Placing], *, kept: frozenset[LayerNumber]
) -> Assembly:
    """All parts in one cell ``name``."""
    layers = Layers(kept)
    cells: dict[str, CellContent] = {}
    copies: dict[str, tuple[Copies, ...]] = {}
    sites: dict[str, Sites] = {}
    here: list[Copies] = []
    for one in placed:
        new = _take(one.part, layers, cells, copies, sites)
        here += one.copies(new[one.part.top])
    if name in cells:
        raise ProcessError(
            f"a part holds a cell {name!r}, the name of the arrangement; give the arrangement another"
        )
    cells[name] = CellContent(name)
    copies[name] = tuple(here)
    return Assembly(name, cells, copies, UNIT_NM, layers.names, layers.doses, sites)


def _take(
    part: Part,
    layers: Layers,
    cells: dict[str, CellContent],
    copies: dict[str, tuple[Copies, ...]],
    sites: dict[str, Sites],
) -> dict[str, str]:
    """The cells of a part with numbers and names of their own; {old: new name}."""
    numbers = layers.take(part)
    new: dict[str, str] = {}
    for name in part.cells:
        new[name] = _free(name, cells, new)
    for name, cell in part.cells.items():
        left, found = compact(relayered(cell, numbers))
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


def wafer(
    name: str, one: Assembly, steps: tuple[Copies, ...], marks: Placing | None
) -> Assembly:
    """Dies, and the wafer's marks beside them, in one cell ``name``."""
    layers = Layers(frozenset(), dict(one.doses), dict(one.layer_names))
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
