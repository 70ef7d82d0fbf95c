"""Exact derivatives of the pillars by height, index and sidewall, from the cell solvers, as smooth functions of D."""

import dataclasses
import functools
import math

import numpy as np
from numpy.polynomial import chebyshev

from characterize.pillars import Sensitivity, sensitivity
from metalens import modal, rcwa
from metalens.cell import Cell
from metalens.errors import CellError, MaterialError
from metalens.lens import Lens
from metalens.store import Array

_NODES, _MOST, _WALL_RAD = 25, 14, math.radians(0.5)


def slopes(lens: Lens, *, tolerance: float = 0.02, sidewall: bool = False) -> Sensitivity:
    """d ln t / d(height, index, sidewall) over the diameters of a lens.

    Exact derivatives at 25 Chebyshev diameters (modal method; RCWA for cells with films or tilted walls), as the
    polynomial of least degree whose error on diameters that it was not made from meets ``tolerance``, relative to
    the largest change of the slope across the lens; the best one below degree 15 where none does. The error reached
    is in ``error``. Cells that no solver takes get the effective-index slopes of :func:`pillars.sensitivity`.

    Args:
        sidewall: also the slope by the sidewall (RCWA, differences of half a degree: 0.1 deg² of curvature);
            zero without it.
    """
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    low, high = float(d.min()), float(d.max())
    low, high = (low, high) if high > low else (low - 1e-3, high + 1e-3)
    unit = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    diameters = (low + high) / 2 + (high - low) / 2 * unit
    try:
        rows = np.array([_exact(lens.cell, float(one), lens.wavelength_um, sidewall) for one in diameters]).T
    except (CellError, MaterialError):
        return sensitivity(lens)
    degree, error = _degree(unit, rows, tolerance)
    fits = [chebyshev.cheb2poly(chebyshev.chebfit(unit, row, degree)) for row in rows]
    scale = (2 / (high - low)) ** np.arange(degree + 1)
    padded = [np.pad(fit, (0, degree + 1 - len(fit))) for fit in fits]
    return Sensitivity(np.array(padded) * scale, (low + high) / 2, error, low, high)


def _exact(cell: Cell, diameter_um: float, wavelength_um: float, sidewall: bool) -> tuple[complex, complex, complex]:
    plain = not (cell.under or cell.over or cell.sidewall_rad)
    solve = functools.partial(modal.gradient, tolerance=1e-2) if plain else rcwa.derivatives
    found = solve(cell, diameter_um, wavelength_um)
    wall = _by_sidewall(cell, diameter_um, wavelength_um) if sidewall else 0.0
    return found.height_um / found.t, found.n / found.t, wall


def _by_sidewall(cell: Cell, diameter_um: float, wavelength_um: float) -> complex:
    ends = [dataclasses.replace(cell, sidewall_rad=cell.sidewall_rad + sign * _WALL_RAD) for sign in (1, -1)]
    up, down = (rcwa.derivatives(end, diameter_um, wavelength_um).t for end in ends)
    return complex(np.log(up / down) / (2 * _WALL_RAD))


def _degree(unit: Array, rows: Array, tolerance: float) -> tuple[int, float]:
    """(degree, error): every third node is held out and judged."""
    judged = np.arange(len(unit)) % 3 == 1
    size = np.maximum(np.abs(rows - rows.mean(1, keepdims=True)).max(1), 1e-9 * np.abs(rows).max())
    errors = []
    for degree in range(1, _MOST + 1):
        guess = [
            chebyshev.chebval(unit[judged], chebyshev.chebfit(unit[~judged], row[~judged], degree)) for row in rows
        ]
        errors.append(float((np.abs(np.array(guess) - rows[:, judged]).max(1) / size).max()))
        if errors[-1] <= tolerance:
            break
    best = int(np.argmin(errors))
    return best + 1, errors[best]
