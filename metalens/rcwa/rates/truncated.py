"""One truncation: the Jones matrices, and their derivatives by whatever moves heights,
rims and permittivities.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Layer
from metalens.ground.arrays import Array
from metalens.rcwa import made, pattern
from metalens.rcwa.problem import Problem
from metalens.rcwa.rates import kernels, tables
from metalens.rcwa.rates.coupling import Coupling
from metalens.rcwa.rates.solved import Solved, solved
from metalens.rcwa.rates.tables import Tables


@dataclass(frozen=True, eq=False, slots=True)
class Motion:
    """What a number of the pillar moves, per unit of it.

    heights: (regions,) um, films and sections, foot first.
    numbers: for every section (shares, k) rates of :func:`tables.numbers` at the
    :func:`shares` of its height.
    """

    heights: Array
    numbers: tuple[Array, ...]


@dataclass(frozen=True, eq=False, slots=True)
class Rates:
    """both: (2, 2, 2) t and r of :class:`metalens.rcwa.Jones`; energy: (2,); by: (2, 2,
    2) derivatives of both.
    """

    both: Array
    energy: Array
    by: dict[str, Array]


def shares(cell: Cell) -> tuple[float, ...]:
    """Of the height of a section, at which a motion is told: foot and top, or the nodes
    of a tilted wall.
    """
    return tuple(made.nodes().tolist()) if cell.sidewall_rad else (0.0, 1.0)


def slab_at(
    cell: Cell,
    section: tuple[Layer, float],
    size_um: float,
    wavelength_um: float,
    share: float,
) -> pattern.Slab:
    """The cross-section of one of :func:`metalens.rcwa.made.spread` at a share of its
    height.
    """
    layer, grow = section
    return pattern.slab(
        cell,
        layer,
        size_um,
        wavelength_um,
        grow_um=grow + made.lift(cell, layer, share),
    )


def truncated(
    this: Problem, reach: int, stages: int, motions: dict[str, Motion]
) -> Rates:
    """Everything at one truncation; stages: of the collocation of a tilted wall, 0 for
    an upright one.
    """
    classes = [solved(this, operations, reach, stages) for operations in this.classes]
    both, energy = np.zeros((2, 2, 2), complex), np.zeros(2)
    by = {name: np.zeros((2, 2, 2), complex) for name in motions}
    for one in classes:
        place = np.ix_((0, 1), one.columns, one.columns)
        both[place], energy[one.columns] = one.both, one.energy
        stretches = _stretches(one) * 2 * np.pi / this.light.wavelength_um
        for name, motion in motions.items():
            by[name][place] += np.tensordot(motion.heights, stretches, 1)
    for i, section in enumerate(made.spread(this.cell)):
        wavelength_um = this.light.wavelength_um
        slabs = [
            slab_at(this.cell, section, this.size_um, wavelength_um, share)
            for share in shares(this.cell)
        ]
        changes = {
            name: _changes(this, slabs, move.numbers[i], classes[0])
            for name, move in motions.items()
        }
        for rows, columns in itertools.product(classes, repeat=2):
            pair = Coupling(rows, columns, len(this.media.under) + i, this.cell, slabs)
            for name, change in changes.items():
                by[name][np.ix_((0, 1), rows.columns, columns.columns)] += pair.rate(
                    change
                )
    return Rates(both, energy, by)


def _stretches(one: Solved) -> Array:
    """(regions, 2, k, k) derivatives of t and r by reduced heights, which couple no
    classes.
    """
    parts = zip(one.regions, one.sent, one.light, strict=True)
    k = len(one.columns)
    return np.array(
        [kernels.stretch(*part).reshape(2, k, k) * one.scale for part in parts]
    )


def _changes(
    this: Problem, slabs: list[pattern.Slab], rates: Array, one: Solved
) -> list[Tables | None]:
    """Of the coefficients, as :meth:`Coupling.rate` takes them."""
    if not this.cell.sidewall_rad:
        rates = np.stack([(rates[0] + rates[1]) / 2, rates[1] - rates[0]])
    pairs = zip(slabs, rates, strict=True)
    return [
        tables.coefficients(slab, this.cell, one.space.reach, v) if v.any() else None
        for slab, v in pairs
    ]
