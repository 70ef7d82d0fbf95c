"""How the transmission of a pillar answers to height, index, wall and every other cause
of the table, by a solver.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell
from metalens.core import executor
from metalens.core.arrays import Array
from metalens.fabrication import ResponseError, of_kind, own_rates, with_missing
from metalens.lens import Lens

Solver = Callable[[Cell, Array, float, bool], Array]
_Solve = tuple[Cell, Array, bool]  # cell, diameters, whether at the finer truncation


@dataclass(frozen=True, eq=False, slots=True)
class LogSensitivities:
    """Logarithmic derivatives of t: the real part changes |t|, the imaginary part is a
    phase in rad.

    diameter_um: (n,) rising. rates: (answering causes, n) complex, by the base unit of
    each (um, rad, 1); rows that are
        not there are 0.
    error: largest relative change (rms over the diameters) of one of them from a
    coarser truncation.
    edges: (n,) by a bias of all edges less that by the size, per um; None where that is
    nothing.
    """

    diameter_um: Array
    rates: Array
    error: float
    edges: Array | None = None

    def at(self, diameter_um: Array) -> Array:
        """(answering causes, *shape) derivatives of ln t; beyond the ends the end value
        holds.
        """
        return with_missing(
            [np.interp(diameter_um, self.diameter_um, row) for row in self.rates]
        )

    def by_edges(self, diameter_um: Array) -> Array | None:
        """(*shape) what a bias of all edges changes ln t by beyond the same change of
        the size; None for nothing.
        """
        if self.edges is None or not self.edges.any():
            return None
        return np.asarray(np.interp(diameter_um, self.diameter_um, self.edges))


def compute_sensitivities(
    lens: Lens, *, count: int = 15, solver: Solver | None = None
) -> LogSensitivities:
    """Derivatives of ln t at ``count`` diameters (of shapes: sizes) over the proxy's
    domain, by every answering cause.

    Exact ones of RCWA at a fixed truncation, for the light that the proxy is of;
    central differences of a solver where
    one is given.

    Args:
        solver: (cell, diameters, wavelength, finer) to t of each.

    Accuracy: ``error`` of the result, the change from a coarser truncation: a few
    percent.

    Raises:
        CellError, MaterialError: from the solver.
    """
    diameters = np.linspace(*lens.proxy.domain_um, count)
    if solver is None:
        return _exact(lens, diameters[:: 2 if lens.cell.sidewall_rad else 1])
    return _differences(lens, diameters, solver)


def _exact(lens: Lens, diameter_um: Array) -> LogSensitivities:
    """From the derivatives of the Jones matrices."""
    found = own_rates(lens, diameter_um)
    return LogSensitivities(diameter_um, found.rates, found.error, found.edges)


def _differences(lens: Lens, diameters: Array, solver: Solver) -> LogSensitivities:
    """Central differences through a solver."""
    tasks = list(_tasks(lens, diameters))
    solved = iter(
        executor.gather_parallel(_solved, (solver, lens.wavelength_um), tasks)
    )
    found, worst = [], 0.0
    for acts in _answering():
        if acts.changed is None:
            found.append(np.zeros(len(diameters), complex))
            continue
        rates = []
        for _ in (False, True):  # coarser, finer
            less, more = next(solved), next(solved)
            rates.append(np.log(more / less) / (2 * acts.step))
        scale = max(float(np.linalg.norm(rates[1])), 1e-9)
        worst = max(worst, float(np.linalg.norm(rates[1] - rates[0])) / scale)
        found.append(np.interp(diameters, _some(lens, acts, diameters), rates[1]))
    return LogSensitivities(diameters, np.array(found), worst)


def _answering() -> list[ResponseError]:
    return [
        row.acts
        for _, row in of_kind(ResponseError)
        if isinstance(row.acts, ResponseError)
    ]


def _tasks(lens: Lens, diameter_um: Array) -> Iterator[_Solve]:
    """Solves of one cause after the other: the coarser and the finer, each below and
    above.
    """
    for acts in _answering():
        if acts.changed is None:
            continue
        ends = [
            acts.changed(lens.cell, sign * acts.step, lens.wavelength_um)
            for sign in (-1, 1)
        ]
        some = _some(lens, acts, diameter_um)
        yield from ((end, some, finer) for finer in (False, True) for end in ends)


def _some(lens: Lens, acts: ResponseError, diameter_um: Array) -> Array:
    """Diameters that a cause is solved at: every other one where walls tilt."""
    tilted = (
        acts.changed
        and acts.changed(lens.cell, acts.step, lens.wavelength_um).sidewall_rad
    )
    return np.asarray(diameter_um[:: 2 if tilted else 1])


def _solved(about: tuple[Solver, float], task: _Solve) -> Array:
    (solve, wavelength_um), (cell, diameter_um, finer) = about, task
    return solve(cell, diameter_um, wavelength_um, finer)
