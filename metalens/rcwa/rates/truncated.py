"""One truncation: the Jones matrices, and their derivatives by heights, rims and permittivities of every section."""

import functools
import itertools
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Layer
from metalens.ground.arrays import Array
from metalens.rcwa import layer as modes
from metalens.rcwa import made, pattern
from metalens.rcwa.derivative import film_layer
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import Operation, Orders
from metalens.rcwa.orders.waves import Waves, half_space
from metalens.rcwa.problem import Problem, waves_of
from metalens.rcwa.rates import kernels, tables
from metalens.rcwa.rates.regions import Fields, Region, match, of_modes, of_wall
from metalens.rcwa.stack import flux, outgoing


@dataclass(frozen=True, eq=False, slots=True)
class Rates:
    """both: (2, 2, 2) t and r of :class:`metalens.rcwa.Jones`. energy: (2,).

    by_height: (regions, 2, 2, 2) their derivatives per um of height of every film and section, foot first.
    by_numbers: for every section, share of its height -> (2, 2, 2, k) derivatives by :func:`tables.numbers` there.
    """

    both: Array
    energy: Array
    by_height: Array
    by_numbers: tuple[dict[float, Array], ...]


def slab_at(cell: Cell, section: tuple[Layer, float], size_um: float, wavelength_um: float, share: float) -> pattern.Slab:
    """The cross-section of one of :func:`metalens.rcwa.made.spread` at a share of its height."""
    layer, grow = section
    return pattern.slab(cell, layer, size_um, wavelength_um, grow_um=grow + made.lift(cell, layer, share))


@dataclass(frozen=True, eq=False, slots=True)
class _Class:
    """One symmetry class: regions, and the fields of the light and of what is sent back from below and from above.

    places, signs: (k,) of its zero orders, columns: which polarisation each is. light, below, above: by region.
    t, r, energy: (k, k), (k, k), (k,) amplitudes; from_below, from_above: (k,) what is sent back there.
    """

    space: Orders
    ways: Waves
    operations: tuple[Operation, ...]
    columns: list[int]
    regions: list[Region]
    light: list[Fields]
    sent: tuple[list[Fields], list[Fields]]
    both: Array
    energy: Array
    scale: Array


def truncated(this: Problem, reach: int, stages: int, *, sloped: bool) -> Rates:
    """Everything at one truncation; stages: of the collocation of a tilted wall, 0 for an upright one.

    sloped: whether changes of foot and top of upright sections are asked for, too.
    """
    classes = [_solved(this, operations, reach, stages) for operations in this.classes]
    count, under = len(classes[0].regions), len(this.media.under)
    sections = made.spread(this.cell)
    both, energy = np.zeros((2, 2, 2), complex), np.zeros(2)
    by_height = np.zeros((count, 2, 2, 2), complex)
    for one in classes:
        energy[one.columns] = one.energy
        both[np.ix_((0, 1), one.columns, one.columns)] = one.both
        for i in range(count):
            by_height[i][np.ix_((0, 1), one.columns, one.columns)] = _heights(one, i) * 2 * np.pi / this.light.wavelength_um
    numbers = tuple(_section_rates(this, classes, under + i, part, sloped) for i, part in enumerate(sections))
    return Rates(both, energy, by_height, numbers)


def _solved(this: Problem, operations: tuple[Operation, ...], reach: int, stages: int) -> _Class:
    cell, media = this.cell, this.media
    space = mirrors.orders(reach, pattern.frame(cell, operations))
    ways, places = waves_of(space, cell, this.light)
    symmetric = cell.outline(this.size_um).keeps(-1, -1)
    operators = functools.partial(pattern.operators, space, ways, cell=cell)
    walls = made.walls(cell, this.size_um, this.light.wavelength_um, operators)
    if stages:
        middle = [of_wall(wall, stages, symmetric=symmetric) for wall in walls]
    else:
        upright = [(modes.layer(*wall.sample(0.5), symmetric=symmetric), wall.reduced_height) for wall in walls]
        middle = [of_modes(part, height) for part, height in upright]
    under, over = ([of_modes(film_layer(ways, n), h) for n, h in films] for films in (media.under, media.over))
    regions = [*under, *middle, *over]
    below, above = half_space(ways, media.substrate), half_space(ways, media.cover)
    at, sign = np.array([place for place, _ in places.values()]), np.array([s for _, s in places.values()])
    unit = np.zeros((len(ways.kappa), len(at)))
    unit[at, np.arange(len(at))] = sign
    shares = np.sqrt(flux(below)), np.sqrt(flux(above))
    light, foot, top = match(
        [region.plain for region in regions], above, below, 2 * (below[0] * below[1])[:, None] * unit
    )
    n = len(unit)
    scale = 1 / shares[0][at]
    out = outgoing((above[0][:, None], above[1][:, None]), top[:n], top[n:]) * shares[1][:, None] * scale
    incident = (below[0][:, None] * unit, below[1][:, None] * unit)
    back = outgoing((below[0][:, None], below[1][:, None]), foot[:n] - incident[0], incident[1] - foot[n:])
    back = back * shares[0][:, None] * scale
    from_below = match([r.transposed for r in regions], above, below, shares[0][:, None] * unit)[0]
    from_above = match([r.reverse for r in regions[::-1]], below, above, shares[1][:, None] * unit)[0]
    turned = [fields.upside_down for fields in from_above[::-1]]
    both = np.stack([unit.T @ out, unit.T @ back])
    energy = (np.abs(out) ** 2 + np.abs(back) ** 2).sum(axis=0)
    return _Class(
        space, ways, operations, list(places), regions, light, (turned, from_below), both, energy, scale
    )


def _heights(one: _Class, i: int) -> Array:
    """(2, k, k) derivatives by the reduced height of a region: a change of it couples no classes."""
    count = range(len(one.columns))
    found = [
        [[kernels.stretch(one.regions[i], side[i].one(row), one.light[i].one(k)) * one.scale[k] for k in count] for row in count]
        for side in one.sent
    ]
    return np.array(found)


def _section_rates(
    this: Problem, classes: list[_Class], i: int, part: tuple[Layer, float], sloped: bool
) -> dict[float, Array]:
    """Of region i, the pillar's section ``part``: for every share of its height, (2, 2, 2, k)."""

    @functools.cache
    def slab(share: float) -> pattern.Slab:
        return slab_at(this.cell, part, this.size_um, this.light.wavelength_um, share)

    @functools.cache
    def section(share: float, which: int) -> tables.Section:
        one = classes[which]
        return tables.section(one.space, one.ways, one.operations, slab(share), this.cell)

    found: dict[float, Array] = {}
    for (a, rows), (b, columns) in itertools.product(enumerate(classes), repeat=2):
        pair = kernels.between(rows.regions[i], columns.regions[i], sloped=sloped)
        for side, (j, row), (k, column) in itertools.product(
            (0, 1), enumerate(rows.columns), enumerate(columns.columns)
        ):
            for weight in pair.weights(rows.sent[side][i].one(j), columns.light[i].one(k)):
                share = weight.share
                tabled = tables.pulled(section(share, a), section(share, b), weight)
                rate = tables.gradient(slab(share), this.cell, tabled) * columns.scale[k]
                found.setdefault(share, np.zeros((2, 2, 2, len(rate)), complex))[side, row, column] = rate
    return found
