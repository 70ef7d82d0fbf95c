"""Every number of a pillar by its name, as a cell file has it, and how sections,
permittivities and heights follow it.

Rims and permittivities follow by elementary functions, whose derivatives are
differences of sixth order: 1e-11.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from metalens.cell import Cell, Index, Material, materials
from metalens.cell.shapes.motion import sixth_order_difference
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.rcwa import made
from metalens.rcwa.rates.tables import section_parameters
from metalens.rcwa.rates.truncated import ParameterMotion, sampled_heights, slab_at

# of a number; of 1 where it is an angle or a coordinate, of the size where it is a
# change of width
_STEP = 1e-4
_FILM_UM = 0.1  # thickness of a film at least, about which its change is looked at


@dataclass(frozen=True, slots=True)
class ChangedPillar:
    """A pillar whose number has changed: the cell, its size, and what all widths have
    grown by.
    """

    cell: Cell
    size_um: float
    grow_um: float = 0.0


@dataclass(frozen=True, slots=True)
class PillarParameter:
    """A number of a pillar: what the pillar is when it changes by an amount, and a step
    for differences.
    """

    name: str
    moved: Callable[[float], ChangedPillar]
    step: float


def pillar_parameters(
    cell: Cell, size_um: float, wavelength_um: float
) -> dict[str, PillarParameter]:
    """All of them, by name."""
    found = [
        PillarParameter(
            "size_um", lambda x: ChangedPillar(cell, size_um + x), _STEP * size_um
        ),
        PillarParameter(
            "grow_um", lambda x: ChangedPillar(cell, size_um, x), _STEP * size_um
        ),
        PillarParameter("sidewall_rad", _of(cell, size_um, "sidewall_rad"), _STEP),
        *_of_shape(cell, size_um),
        *_of_heights(cell, size_um),
        *_of_indices(cell, size_um, wavelength_um),
    ]
    return {one.name: one for one in found}


def _with(record: Any, name: str, value: object) -> Any:
    """A record with one field changed."""
    return dataclasses.replace(record, **{name: value})


def _in_place(records: tuple[Any, ...], i: int, changed: object) -> tuple[Any, ...]:
    """Records with another one as their i-th."""
    return (*records[:i], changed, *records[i + 1 :])


def _of(cell: Cell, size_um: float, name: str) -> Callable[[float], ChangedPillar]:
    return lambda x: ChangedPillar(_with(cell, name, getattr(cell, name) + x), size_um)


def _of_indices(
    cell: Cell, size_um: float, wavelength_um: float
) -> list[PillarParameter]:
    """Real parts of the indices of pillar and surroundings, and of layers that have
    their own.
    """

    def beside(material: Material, x: float) -> Index:
        now = materials.index(material, wavelength_um)
        return Index(now.real + x, now.imag)

    def of_cell(name: str, x: float) -> ChangedPillar:
        now = cell.fill if name == "between" else cell.pillar
        return ChangedPillar(_with(cell, name, beside(now, x)), size_um)

    def of_layer(i: int, name: str, x: float) -> ChangedPillar:
        changed = _with(cell.layers[i], name, beside(getattr(cell.layers[i], name), x))
        return ChangedPillar(
            _with(cell, "layers", _in_place(cell.layers, i, changed)), size_um
        )

    found = [
        PillarParameter(f"{name}.n", functools.partial(of_cell, name), _STEP)
        for name in ("pillar", "between")
    ]
    for i, layer in enumerate(cell.layers):
        own = [
            name
            for name in ("material", "between", "coat")
            if getattr(layer, name) is not None
        ]
        found += [
            PillarParameter(
                f"layers.{i}.{name}.n", functools.partial(of_layer, i, name), _STEP
            )
            for name in own
        ]
    return found


def _of_shape(cell: Cell, size_um: float) -> list[PillarParameter]:
    """Ratios, the in-plane angle, corners: every number that the record of the shape
    has.
    """
    shape, found = cell.shape, []

    def changed(
        name: str, value: Callable[[float], Any]
    ) -> Callable[[float], ChangedPillar]:
        return lambda x: ChangedPillar(
            dataclasses.replace(cell, shape=_with(shape, name, value(x))), size_um
        )

    for part in dataclasses.fields(shape):
        name, now = part.name, getattr(shape, part.name)
        if part.type is float:  # a whole number too, but no count of sides
            step = _STEP if name.endswith("_rad") else _STEP * now
            found.append(
                PillarParameter(
                    f"shape.{name}",
                    changed(name, functools.partial(operator.add, now)),
                    step,
                )
            )
        elif isinstance(now, tuple):
            for i, axis in np.ndindex(len(now), 2):
                corner = changed(name, functools.partial(_shifted, now, i, axis))
                found.append(
                    PillarParameter(f"shape.{name}.{i}.{'xy'[axis]}", corner, _STEP)
                )
    return found


def _shifted(
    corners: tuple[tuple[float, float], ...], i: int, axis: int, x: float
) -> tuple[tuple[float, float], ...]:
    moved = np.array(corners, float)
    moved[i, axis] += x
    return tuple((float(a), float(b)) for a, b in moved)


def _of_heights(cell: Cell, size_um: float) -> list[PillarParameter]:
    """Heights of the pillar or of its layers, their growth and coats, thicknesses of
    films.
    """
    found = []
    if not cell.layers:
        found.append(
            PillarParameter(
                "height_um", _of(cell, size_um, "height_um"), _STEP * cell.height_um
            )
        )
    for i, layer in enumerate(cell.layers):
        for name in (
            "height_um",
            "grow_um",
            *(("coat_um",) if layer.coat is not None else ()),
        ):
            step = _STEP * (size_um if name == "grow_um" else getattr(layer, name))
            found.append(
                PillarParameter(
                    f"layers.{i}.{name}", _of_layer(cell, size_um, i, name), step
                )
            )
    for side in ("under", "over"):
        for i, film in enumerate(getattr(cell, side)):
            step = _STEP * max(film.thickness_um, _FILM_UM)
            found.append(
                PillarParameter(
                    f"{side}.{i}.thickness_um", _of_film(cell, size_um, side, i), step
                )
            )
    return found


def _of_layer(
    cell: Cell, size_um: float, i: int, name: str
) -> Callable[[float], ChangedPillar]:
    def moved(x: float) -> ChangedPillar:
        changed = _with(cell.layers[i], name, getattr(cell.layers[i], name) + x)
        layers = _in_place(cell.layers, i, changed)
        return ChangedPillar(
            dataclasses.replace(
                cell, layers=layers, height_um=sum(layer.height_um for layer in layers)
            ),
            size_um,
        )

    return moved


def _of_film(
    cell: Cell, size_um: float, side: str, i: int
) -> Callable[[float], ChangedPillar]:
    """Heights change alike at any thickness; a film of none cannot have less."""

    def moved(x: float) -> ChangedPillar:
        films = getattr(cell, side)
        changed = _with(
            films[i], "thickness_um", max(films[i].thickness_um, _FILM_UM) + x
        )
        return ChangedPillar(_with(cell, side, _in_place(films, i, changed)), size_um)

    return moved


def parameter_motion(this: PillarParameter, wavelength_um: float) -> ParameterMotion:
    """What it moves.

    Raises:
        CellError: a pillar that is at an end of where it may be, or just losing or
            gaining a part.
    """
    try:
        cell = this.moved(0.0).cell
        heights = sixth_order_difference(
            lambda x: _heights(this.moved(x).cell), this.step
        )
        by = tuple(
            np.stack(
                [
                    sixth_order_difference(
                        functools.partial(_numbers, this, wavelength_um, i, s),
                        this.step,
                    )
                    for s in sampled_heights(cell)
                ]
            )
            for i in range(len(cell.sections))
        )
    except CellError as error:
        raise CellError(
            f"no derivative by {this.name}: {error} (or ask for others alone, by = ...)"
        ) from None
    return ParameterMotion(heights, by)


def _numbers(
    this: PillarParameter, wavelength_um: float, i: int, share: float, x: float
) -> Array:
    """Of section i at a share of its height, where the number has changed by x."""
    now = this.moved(x)
    layer, grow = made.sections_with_growth(now.cell)[i]
    return section_parameters(
        slab_at(
            now.cell, (layer, grow + now.grow_um), now.size_um, wavelength_um, share
        )
    )


def _heights(cell: Cell) -> Array:
    """(regions,) um, foot first."""
    under, over = (
        [film.thickness_um for film in side] for side in (cell.under, cell.over)
    )
    return np.array([*under, *(layer.height_um for layer in cell.sections), *over])
