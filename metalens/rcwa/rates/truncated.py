"""One truncation: the Jones matrices, and their derivatives by whatever moves heights,
rims and permittivities.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Layer
from metalens.core.arrays import Array
from metalens.rcwa import made, pattern
from metalens.rcwa.problem import CellProblem
from metalens.rcwa.rates import kernels, tables
from metalens.rcwa.rates.coupling import ClassCoupling
from metalens.rcwa.rates.solved import AdjointClass, solve_adjoint_class
from metalens.rcwa.rates.tables import Tables


@dataclass(frozen=True, eq=False, slots=True)
class ParameterMotion:
    """What a number of the pillar moves, per unit of it.

    heights: (regions,) um, films and sections, foot first.
    numbers: for every section (shares, k) rates of :func:`tables.numbers` at the
    :func:`sampled_heights` of its height.
    """

    heights: Array
    numbers: tuple[Array, ...]


@dataclass(frozen=True, eq=False, slots=True)
class TruncatedRates:
    """both: (2, 2, 2) t and r of :class:`metalens.rcwa.JonesResponse`; energy: (2,);
    by: (2, 2,
    2) derivatives of both.
    """

    both: Array
    energy: Array
    by: dict[str, Array]


def sampled_heights(cell: Cell) -> tuple[float, ...]:
    """Of the height of a section, at which a motion is told: foot and top, or the nodes
    of a tilted wall.
    """
    return tuple(made.height_nodes().tolist()) if cell.sidewall_rad else (0.0, 1.0)


def slab_at(
    cell: Cell,
    section: tuple[Layer, float],
    size_um: float,
    wavelength_um: float,
    share: float,
) -> pattern.PillarSection:
    """The cross-section of one of :func:`metalens.rcwa.made.sections_with_growth` at a
    share of its
    height.
    """
    layer, grow = section
    return pattern.pillar_section(
        cell,
        layer,
        size_um,
        wavelength_um,
        grow_um=grow + made.width_change_um(cell, layer, share),
    )


def solve_with_rates(
    this: CellProblem, reach: int, stages: int, motions: dict[str, ParameterMotion]
) -> TruncatedRates:
    """Everything at one truncation; stages: of the collocation of a tilted wall, 0 for
    an upright one.
    """
    classes = [
        solve_adjoint_class(this, operations, reach, stages)
        for operations in this.classes
    ]
    both, energy = np.zeros((2, 2, 2), complex), np.zeros(2)
    by = {name: np.zeros((2, 2, 2), complex) for name in motions}
    for one in classes:
        place = np.ix_((0, 1), one.columns, one.columns)
        both[place], energy[one.columns] = one.both, one.energy
        stretches = _stretches(one) * 2 * np.pi / this.light.wavelength_um
        for name, motion in motions.items():
            by[name][place] += np.tensordot(motion.heights, stretches, 1)
    for i, section in enumerate(made.sections_with_growth(this.cell)):
        wavelength_um = this.light.wavelength_um
        slabs = [
            slab_at(this.cell, section, this.size_um, wavelength_um, share)
            for share in sampled_heights(this.cell)
        ]
        changes = {
            name: _changes(this, slabs, move.numbers[i], classes[0])
            for name, move in motions.items()
        }
        for rows, columns in itertools.product(classes, repeat=2):
            pair = ClassCoupling(
                rows, columns, len(this.media.under) + i, this.cell, slabs
            )
            for name, change in changes.items():
                by[name][np.ix_((0, 1), rows.columns, columns.columns)] += pair.rate(
                    change
                )
    return TruncatedRates(both, energy, by)


def _stretches(one: AdjointClass) -> Array:
    """(regions, 2, k, k) derivatives of t and r by reduced heights, which couple no
    classes.
    """
    parts = zip(one.regions, one.sent, one.light, strict=True)
    k = len(one.columns)
    return np.array(
        [kernels.height_rates(*part).reshape(2, k, k) * one.scale for part in parts]
    )


def _changes(
    this: CellProblem,
    slabs: list[pattern.PillarSection],
    rates: Array,
    one: AdjointClass,
) -> list[Tables | None]:
    """Of the coefficients, as :meth:`Coupling.rate` takes them."""
    if not this.cell.sidewall_rad:
        rates = np.stack([(rates[0] + rates[1]) / 2, rates[1] - rates[0]])
    pairs = zip(slabs, rates, strict=True)
    return [
        tables.coefficient_rates(slab, this.cell, one.space.reach, v)
        if v.any()
        else None
        for slab, v in pairs
    ]
