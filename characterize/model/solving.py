"""t of a lens's pillars by the modal solver: at every diameter that a bias can lead to,
under large changes.
"""

import functools
import math
from collections.abc import Sequence

import numpy as np
from numpy.polynomial import polynomial

from metalens import modal
from metalens.cell import Cell, Incidence
from metalens.core import threads
from metalens.core.arrays import Array
from metalens.fabrication import (
    ResponseError,
    Solved,
    changed_pillar,
    designed_transmission,
    prior_scale,
    response_errors,
    wavelength_scale,
)
from metalens.lens import Lens
from metalens.library import curve, engines

# of a bias beyond the designed diameters: that of the fit, for 0.85 um and shorter
# waves
REACH_UM = 0.031
TOLERANCE = 3e-3  # of t
_SAME, _JUDGED = (
    0.05,
    7,
)  # relative deviation from the proxy up to which it is of this cell, at so many diameters
_FINE_UM = 5e-4  # between the diameters at which the curves are sampled, likewise
_FIT_SHARE = 0.4  # of the tolerance, for the rational functions
_ROOM = 1.07  # of the amounts over the bounds of a fit
_AMOUNTS = {
    "height_um": (-1.0, -0.5, 0.0, 0.5, 1.0),
    "n": (-1.0, -0.67, -0.33, 0.0, 0.33, 0.67, 1.0),
}


def solved_transmission(lens: Lens) -> Solved | None:
    """t by the modal solver; None where the lens's proxy is not of its cell (a measured
    one, say).

    Polynomials through five heights over +-30 nm (more of longer waves,
    ``made.coarser``), and through seven indices.

    Accuracy: 3e-3 of t by the solver's bar, half of it on average, at these amounts.
    Between them polynomials miss
    resonances that move: of random pillars and amounts (two cells of silicon, all that
    the bounds allow) t was off by
    0.025 at most in the height and 6e-3 in the index, and beside the resonance of the
    default cell at 0.23 um by up to
    0.03 in the index (through three indices by 0.29).

    Raises:
        CellError, MaterialError: cells that the solver does not take.
    """
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    least = float(d.min())
    most = float(d.max())
    pitch = lens.cell.pitch_um
    some = np.clip(np.linspace(least, most, _JUDGED), *lens.proxy.domain_um)
    exact = [
        modal.solve(lens.cell, one, lens.wavelength_um, tolerance=TOLERANCE).t
        for one in some.tolist()
    ]
    ratio = np.array(exact) / designed_transmission(
        lens.proxy, some, lens.wavelength_um
    )
    if np.abs(ratio * np.exp(-1j * np.angle(ratio.mean())) - 1).max() > _SAME:
        return None
    reach = REACH_UM * wavelength_scale(lens.wavelength_um)
    low = max(least - reach, 0.03 * pitch)
    high = min(most + reach, 0.985 * pitch)
    return _solved(lens.cell, lens.wavelength_um, round(low, 6), round(high, 6))


@functools.lru_cache(maxsize=8)
def _solved(cell: Cell, wavelength_um: float, low_um: float, high_um: float) -> Solved:
    """One rational curve over the diameter for every amount of every cause, sampled
    finely.
    """
    fine = _FINE_UM * wavelength_scale(wavelength_um)
    diameters = np.linspace(low_um, high_um, math.ceil((high_um - low_um) / fine) + 1)
    changes = _changes(wavelength_um)
    cells = [
        changed_pillar(cell, 0.0, acts.numbers(cell, 0.0), amount, wavelength_um)[0]
        if amount
        else cell
        for _, acts, amounts in changes
        for amount in amounts
    ]
    apart = list(dict.fromkeys(cells))
    found: dict[Cell, Array] = {}

    def some(start: int, stop: int) -> None:
        for one in apart[start:stop]:
            found[one] = _along(one, wavelength_um, diameters)

    with threads.one_blas_thread():
        threads.run_split(len(apart), some)
    return Solved(
        wavelength_um,
        diameters,
        _powers(np.array([found[one] for one in cells]).T, changes),
    )


def _along(cell: Cell, wavelength_um: float, diameters: Array) -> Array:
    """(diameters,) t of a cell: a few dozen solves on one mesh, and the rational
    function through them.
    """
    span = float(diameters[0]), float(diameters[-1])
    solve = engines.solver_at_fixed_discretization(
        cell, Incidence(wavelength_um), span, tolerance=TOLERANCE / 2, engine="modal"
    )
    nodes = curve.sample_adaptively(solve, *span, tolerance=_FIT_SHARE * TOLERANCE)
    return np.asarray(
        curve.fit_response_curve(nodes, tolerance=_FIT_SHARE * TOLERANCE).best(
            diameters
        )[:, 0]
    )


_Change = tuple[int, ResponseError, tuple[float, ...]]


def _changes(wavelength_um: float) -> list[_Change]:
    """(place, response error, amounts in base units) of those that the solver knows."""
    out = []
    for n, (row, acts) in enumerate(response_errors()):
        if acts.exact:
            most = _ROOM * row.high * row.unit * prior_scale(row.name, wavelength_um)
            out.append((n, acts, tuple(most * part for part in _AMOUNTS[acts.exact])))
    return out


def _powers(columns: Array, changes: Sequence[_Change]) -> Array:
    """(causes, orders, diameters) power series through the amounts of each cause."""
    orders = max(len(amounts) for *_, amounts in changes)
    out = np.zeros((len(response_errors()), orders, len(columns)), complex)
    first = 0
    for n, _, amounts in changes:
        values = columns[:, first : first + len(amounts)].T
        out[n, : len(amounts)] = np.linalg.solve(
            polynomial.polyvander(amounts, len(amounts) - 1), values
        )
        first += len(amounts)
    out[:, 0] = out[changes[0][0], 0]
    return out
