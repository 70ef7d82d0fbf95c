"""One section of the pillar between two symmetry classes: that of the waves sent back
(rows) and that of the light.
"""

import functools

import numpy as np

from metalens.cell import Cell
from metalens.core.arrays import Array
from metalens.rcwa.pattern import PillarSection
from metalens.rcwa.rates import kernels, tables
from metalens.rcwa.rates.regions import RegionModes
from metalens.rcwa.rates.solved import AdjointClass
from metalens.rcwa.rates.tables import Change, SectionMatrices, Tables


class ClassCoupling:
    """What all numbers of the pillar share in it, worked out when first asked.

    rows, columns: the classes; i: the region. slabs: the cross-sections at the shares
    of the height where motions are
    told; those of an upright section are alike.
    """

    def __init__(
        self,
        rows: AdjointClass,
        columns: AdjointClass,
        i: int,
        cell: Cell,
        slabs: list[PillarSection],
    ) -> None:
        self._rows, self._columns, self._i, self._cell, self._slabs = (
            rows,
            columns,
            i,
            cell,
            slabs,
        )
        self._z = rows.uprights, columns.uprights

    def rate(self, changes: list[Tables | None]) -> Array:
        """(2, b, k) derivatives of t and r, from those of the coefficients: of every
        cross-section of a tilted wall, or
        of an upright one those that are alike at every height, and those of the top
        less those of the foot."""
        rows, columns = (
            self._rows.regions[self._i].transposed,
            self._columns.regions[self._i].plain,
        )
        count = len(self._columns.columns)
        total = np.zeros((2 * len(self._rows.columns), count), complex)
        if not (isinstance(rows, RegionModes) and isinstance(columns, RegionModes)):
            total += kernels.tilted_rates(
                self._stages,
                self._z,
                [self._changed(k, table) for k, table in enumerate(changes)],
            )
        else:
            back, light = self._rows.sent[self._i], self._columns.light[self._i]
            for table, sign in zip(changes, (1, -1), strict=True):
                change = self._changed(0, table)
                if change is not None:
                    turned = kernels.in_modes(rows, columns, self._z, change)
                    integrals = self._plain if sign > 0 else self._sloped
                    total += kernels.upright_rates(turned, integrals, sign, back, light)
        return total.reshape(2, -1, count) * self._columns.scale

    def _changed(self, k: int, table: Tables | None) -> Change | None:
        return (
            None if table is None else tables.operator_rates(*self._sections(k), table)
        )

    @functools.cached_property
    def _held(self) -> dict[int, tuple[SectionMatrices, SectionMatrices]]:
        return {}

    def _sections(self, k: int) -> tuple[SectionMatrices, SectionMatrices]:
        if k not in self._held:
            first, second = (
                tables.section_matrices(
                    one.space, one.ways, one.operations, self._slabs[k], self._cell
                )
                for one in (self._rows, self._columns)
            )
            self._held[k] = first, second
        return self._held[k]

    @functools.cached_property
    def _stages(self) -> kernels.GaussStages:
        rows, columns, i = self._rows, self._columns, self._i
        return kernels.gauss_stages(
            rows.regions[i], columns.regions[i], rows.sent[i], columns.light[i]
        )

    @functools.cached_property
    def _plain(self) -> kernels.Integrals:
        return kernels.mode_integrals(*self._modes)

    @functools.cached_property
    def _sloped(self) -> kernels.Integrals:
        return kernels.weighted_mode_integrals(*self._modes)

    @property
    def _modes(self) -> tuple[RegionModes, RegionModes]:
        rows, columns = (
            self._rows.regions[self._i].transposed,
            self._columns.regions[self._i].plain,
        )
        if not (isinstance(rows, RegionModes) and isinstance(columns, RegionModes)):
            raise TypeError("a tilted wall has no modes")
        return rows, columns
