"""What t of the pillars of a lens follows from, each kind of them once, under any local
bias and pillar-response error.
"""

from collections.abc import Callable
from functools import partial

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

Curve = Callable[[Array, State], Array]  # (bias, kinds) complex t for local biases


def classify_pillars(lens: Lens, sens: ResponseRates) -> tuple[Array, Array, Curve]:
    """Distinct kinds of the pillars of a lens.

    Args:
        lens: as designed.
        sens: sensitivities of its pillars.

    Returns:
        (y, x) kind of each site, from 1 on, 0 for none; (kinds,) number of pillars of
        each; and their transmission for local biases (bias,) in um and one process state.
    """
    kinds = PillarKinds.of(lens.diameters)
    index = (kinds.index(lens.diameters) + 1) % (len(kinds.count) + 1)
    if sens.sizes_um.shape[1] == 1:
        about = lens.proxy, lens.wavelength_um, sens, kinds.width_um
        return index, kinds.count, partial(_one_size, *about)
    rates = sens.at(kinds.width_um, kinds.length_um)
    table = PairTable.of(lens)
    return index, kinds.count, partial(_two_sizes, table, kinds, rates)


def _one_size(
    proxy: Proxy,
    wavelength_um: float,
    sens: ResponseRates,
    diameter_um: Array,
    bias_um: Array,
    state: State,
) -> Array:
    """t by the proxy of the lens at its wavelength, and solved sensitivities."""
    bias = np.reshape(bias_um, (-1, 1))
    return perturbed_transmission(
        proxy,
        sens,
        diameter_um + bias,
        wavelength_um,
        state.response_amounts(),
        bias_um=bias,
    )


def _two_sizes(
    table: PairTable, kinds: PillarKinds, rates: Array, bias_um: Array, state: State
) -> Array:
    """t from a table over both sizes with solved (causes, kinds) rates of ln t; a bias
    moves all edges, and so both sizes.
    """
    bias = np.reshape(bias_um, (-1, 1))
    change = np.exp(np.tensordot(state.response_amounts(), rates, 1))
    return np.asarray(table.t(kinds.width_um + bias, kinds.length_um + bias) * change)
