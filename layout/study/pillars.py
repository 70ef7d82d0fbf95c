"""What t of the pillars of a lens follows from, each kind of them once, under any local
bias and pillar-response error.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from metalens.core.arrays import Array
from metalens.fabrication import (
    PairTable,
    PillarKinds,
    ResponseRates,
    State,
    perturbed_transmission,
)
from metalens.lens import Lens
from metalens.library import Proxy


class PillarKindsOfLens(Protocol):
    """Kinds of pillars, of one size or of two."""

    def curve(self, bias_um: Array, state: State) -> Array:
        """(bias, kinds) complex t for local biases and one made lens."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class OneSize:
    """t by the proxy of the lens at its wavelength, and solved sensitivities;
    diameter_um: (kinds,).
    """

    proxy: Proxy
    wavelength_um: float
    sens: ResponseRates
    diameter_um: Array

    def curve(self, bias_um: Array, state: State) -> Array:
        """(bias, kinds) complex t for local biases and one made lens."""
        bias = np.reshape(bias_um, (-1, 1))
        d = self.diameter_um + bias
        return perturbed_transmission(
            self.proxy,
            self.sens,
            d,
            self.wavelength_um,
            state.response_amounts(),
            bias_um=bias,
        )


@dataclass(frozen=True, eq=False, slots=True)
class TwoSizes:
    """t from a table over both sizes with solved sensitivities; a bias moves all edges,
    and so both sizes.

    width_um, length_um: (kinds,). rates: (causes, kinds) of ln t.
    """

    table: PairTable
    width_um: Array
    length_um: Array
    rates: Array

    def curve(self, bias_um: Array, state: State) -> Array:
        """(bias, kinds) complex t for local biases and one made lens."""
        bias = np.reshape(bias_um, (-1, 1))
        change = np.exp(np.tensordot(state.response_amounts(), self.rates, 1))
        return np.asarray(
            self.table.t(self.width_um + bias, self.length_um + bias) * change
        )


def classify_pillars(
    lens: Lens, sens: ResponseRates
) -> tuple[Array, Array, PillarKindsOfLens]:
    """Distinct kinds of the pillars of a lens.

    Args:
        lens: as designed.
        sens: sensitivities of its pillars.

    Returns:
        (y, x) kind of each site, from 1 on, 0 for none; (kinds,) number of pillars of
        each; and the kinds, which give their transmission.
    """
    kinds = PillarKinds.of(lens.diameters)
    index = (kinds.index(lens.diameters) + 1) % (len(kinds.count) + 1)
    if sens.sizes_um.shape[1] == 1:
        return (
            index,
            kinds.count,
            OneSize(lens.proxy, lens.wavelength_um, sens, kinds.width_um),
        )
    rates = sens.at(kinds.width_um, kinds.length_um)
    return (
        index,
        kinds.count,
        TwoSizes(PairTable.of(lens), kinds.width_um, kinds.length_um, rates),
    )
