"""t of a lens's pillars by the modal solver: at every diameter that a bias can lead to,
under large changes.
"""

import functools
import math
from collections.abc import Sequence

import numpy as np
from numpy.polynomial import polynomial

from characterize.model.pillars import largest_amount
from metalens import modal
from metalens.cell import Cell, Incidence
from metalens.core import threads
from metalens.core.arrays import Array
from metalens.fabrication import (
    ResponseError,
    SolvedResponse,
    changed_pillar,
    designed_transmission,
    response_errors,
    wavelength_scale,
)
from metalens.lens import Lens
from metalens.library import curve, workers

# of a bias beyond the designed diameters: that of the fit, for 0.85 um and shorter
# waves
REACH_UM = 0.031
TOLERANCE = 3e-3  # of t
# largest relative deviation of a cell's own proxy; number of diameters compared
_SAME, _JUDGED = 0.05, 7
_FINE_UM = 5e-4  # step of the sampled diameters, for 0.85 um and shorter waves
_FIT_SHARE = 0.4  # share of the tolerance for the rational functions
_AMOUNTS = {
    "height_um": (-1.0, -0.5, 0.0, 0.5, 1.0),
    "n": (-1.0, -0.67, -0.33, 0.0, 0.33, 0.67, 1.0),
}


def solved_transmission(lens: Lens) -> SolvedResponse | None:
    """Table of t by the modal solver over diameter, height and index of the pillars.

    Polynomials through five heights over +-30 nm, scaled for longer waves
    (:func:`wavelength_scale`), and through seven indices. None where the lens's proxy
    is not of its cell, as a measured one.

    Accuracy: 3e-3 of t by the solver's tolerance, half of it on average, at these
    amounts. Between them polynomials miss resonances that move. Of random pillars and
    amounts (two cells of silicon, over all bounds) t was off by 0.025 at most in the
    height and 6e-3 in the index. Next to the resonance of the default cell at 0.23 um
    it was off by up to 0.03 in the index (through three indices by 0.29).

    Raises:
        CellError, MaterialError: cells that the solver does not take.
    """
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    least = float(d.min())
    most = float(d.max())
    pitch = lens.cell.pitch_um
    diameters = np.clip(np.linspace(least, most, _JUDGED), *lens.proxy.domain_um)
    exact = [
        modal.solve(lens.cell, diameter, lens.wavelength_um, tolerance=TOLERANCE).t
        for diameter in diameters.tolist()
    ]
    proxy = designed_transmission(lens.proxy, diameters, lens.wavelength_um)
    ratio = np.array(exact) / proxy
    # up to a common phase
    if np.abs(ratio * np.exp(-1j * np.angle(ratio.mean())) - 1).max() > _SAME:
        return None
    reach = REACH_UM * wavelength_scale(lens.wavelength_um)
    low = max(least - reach, 0.03 * pitch)
    high = min(most + reach, 0.985 * pitch)
    return _solved(lens.cell, lens.wavelength_um, round(low, 6), round(high, 6))


@functools.lru_cache(maxsize=8)
def _solved(
    cell: Cell, wavelength_um: float, low_um: float, high_um: float
) -> SolvedResponse:
    """:func:`solved_transmission` of a cell on an even grid of diameters, cached.

    One rational curve over the diameter for every amount of every cause; cells that
    occur twice are solved once.
    """
    step_um = _FINE_UM * wavelength_scale(wavelength_um)
    diameters = np.linspace(
        low_um, high_um, math.ceil((high_um - low_um) / step_um) + 1
    )
    changes = _changes(wavelength_um)
    cells = [
        changed_pillar(cell, 0.0, acts.numbers(cell, 0.0), amount, wavelength_um)[0]
        if amount
        else cell
        for _, acts, amounts in changes
        for amount in amounts
    ]
    distinct = list(dict.fromkeys(cells))
    curves: dict[Cell, Array] = {}

    def solve_cells(start: int, stop: int) -> None:
        for changed in distinct[start:stop]:
            curves[changed] = _along(changed, wavelength_um, diameters)

    with threads.one_blas_thread():
        threads.run_split(len(distinct), solve_cells)
    columns = np.array([curves[changed] for changed in cells]).T
    return SolvedResponse(wavelength_um, diameters, _powers(columns, changes))


def _along(cell: Cell, wavelength_um: float, diameters: Array) -> Array:
    """(diameters,) t of a cell: a rational function through a few dozen modal solves.

    All solves share one mesh, so that the curve is smooth.
    """
    span = float(diameters[0]), float(diameters[-1])
    solve = workers.solver_at_common_discretization(
        cell, Incidence(wavelength_um), span, tolerance=TOLERANCE / 2, engine="modal"
    )
    nodes = curve.sample_adaptively(solve, *span, tolerance=_FIT_SHARE * TOLERANCE)
    fit = curve.fit_response_curve(nodes, tolerance=_FIT_SHARE * TOLERANCE)
    return np.asarray(fit.best(diameters)[:, 0])


_Change = tuple[int, ResponseError, tuple[float, ...]]


def _changes(wavelength_um: float) -> list[_Change]:
    """(place, response error, amounts in base units) of those that the solver knows."""
    out = []
    for n, (row, acts) in enumerate(response_errors()):
        if acts.exact:
            most = largest_amount(row, wavelength_um)
            out.append((n, acts, tuple(most * part for part in _AMOUNTS[acts.exact])))
    return out


def _powers(columns: Array, changes: Sequence[_Change]) -> Array:
    """(causes, orders, diameters) power series through the amounts of each cause.

    Args:
        columns: (diameters, amounts of all causes) t.
    """
    orders = max(len(amounts) for *_, amounts in changes)
    out = np.zeros((len(response_errors()), orders, len(columns)), complex)
    start = 0
    for n, _, amounts in changes:
        values = columns[:, start : start + len(amounts)].T
        out[n, : len(amounts)] = np.linalg.solve(
            polynomial.polyvander(amounts, len(amounts) - 1), values
        )
        start += len(amounts)
    out[:, 0] = out[changes[0][0], 0]
    return out
