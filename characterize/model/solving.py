"""t of a lens's pillars by the modal solver: at every diameter that a bias can lead to, under large changes."""

import functools
from collections.abc import Sequence

import numpy as np
from numpy.polynomial import polynomial
from scipy.interpolate import CubicSpline

from metalens import modal
from metalens.cell import Cell
from metalens.ground.arrays import Array
from metalens.lens import Lens
from metalens.made import Answers, Cause, Solved, designed, of_kind

REACH_UM = 0.031  # of a bias beyond the designed diameters: that of the fit
TOLERANCE = 3e-3  # of t
_SAME, _JUDGED = 0.05, 7  # relative deviation from the proxy up to which it is of this cell, at so many diameters
_FIRST, _FINEST_UM, _MOST = 15, 1.2e-3, 80  # diameters at first, least step, most of them
_CURVED = 0.016  # miss of the cubic at the middle of a step that asks for halves: a 16th is left after it
_ROOM = 1.07  # of the amounts over the bounds of a fit
_AMOUNTS = {"height_um": (-1.0, -0.5, 0.0, 0.5, 1.0), "n": (-1.0, 0.0, 1.0)}


def solved(lens: Lens) -> Solved | None:
    """t by the modal solver; None where the lens's proxy is not of its cell (a measured one, say).

    Heights: polynomial through five over +-30 nm; indices: through three.

    Accuracy: 3e-3 of t by the solver's bar, 1e-3 more between diameters.

    Raises:
        CellError, MaterialError: cells that the solver does not take.
    """
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    least, most, pitch = float(d.min()), float(d.max()), lens.cell.pitch_um
    some = np.clip(np.linspace(least, most, _JUDGED), *lens.proxy.domain_um)
    exact = [modal.solve(lens.cell, one, lens.wavelength_um, tolerance=TOLERANCE).t for one in some.tolist()]
    ratio = np.array(exact) / designed(lens.proxy, some, lens.wavelength_um)
    if np.abs(ratio * np.exp(-1j * np.angle(ratio.mean())) - 1).max() > _SAME:
        return None
    low, high = max(least - REACH_UM, 0.03 * pitch), min(most + REACH_UM, 0.985 * pitch)
    return _solved(lens.cell, lens.wavelength_um, round(low, 6), round(high, 6))


@functools.lru_cache(maxsize=8)
def _solved(cell: Cell, wavelength_um: float, low_um: float, high_um: float) -> Solved:
    """Halved where the cubic misses, down to resonances."""
    changes = _changes()
    at = functools.partial(_column, cell, wavelength_um, changes)
    step = (high_um - low_um) / (_FIRST - 1)
    diameters = [low_um + i * step for i in range(_FIRST)]
    columns = [at(d) for d in diameters]
    open_ = list(range(_FIRST - 1))
    while open_ and len(diameters) < _MOST:
        middles = [(diameters[i] + diameters[i + 1]) / 2 for i in open_]
        guess = CubicSpline(diameters, np.array(columns))(middles)
        found = [at(d) for d in middles]
        missed = [float(np.abs(f - g).max()) for f, g in zip(found, guess, strict=True)]
        halves = {d for d, m in zip(middles, missed, strict=True) if m > _CURVED}
        merged = sorted(zip([*diameters, *middles], [*columns, *found], strict=True), key=lambda pair: pair[0])
        diameters, columns = [pair[0] for pair in merged], [pair[1] for pair in merged]
        beside = [i for i, d in enumerate(diameters) if d in halves]
        open_ = sorted({j for i in beside for j in (i - 1, i) if diameters[j + 1] - diameters[j] > _FINEST_UM})
    return Solved(wavelength_um, np.array(diameters), _powers(np.array(columns), changes))


def _changes() -> list[tuple[int, Cause, tuple[float, ...]]]:
    """(place, row, amounts in base units) of the causes that the solver knows."""
    rows = [row for _, row in of_kind(Answers)]
    return [
        (n, row, tuple(_ROOM * row.high * row.unit * share for share in _AMOUNTS[row.acts.exact]))
        for n, row in enumerate(rows)
        if isinstance(row.acts, Answers) and row.acts.exact
    ]


def _column(
    cell: Cell, wavelength_um: float, changes: Sequence[tuple[int, Cause, tuple[float, ...]]], diameter_um: float
) -> Array:
    """(amounts of all causes,) t at one diameter."""
    out, plain = [], modal.solve(cell, diameter_um, wavelength_um, tolerance=TOLERANCE).t
    for _, row, amounts in changes:
        for amount in amounts:
            if not isinstance(row.acts, Answers) or amount == 0:
                out.append(plain)
                continue
            changed = row.acts.changed(cell, amount, wavelength_um)
            out.append(modal.solve(changed, diameter_um, wavelength_um, tolerance=TOLERANCE).t)
    return np.array(out)


def _powers(columns: Array, changes: Sequence[tuple[int, Cause, tuple[float, ...]]]) -> Array:
    """(causes, orders, diameters) power series through the amounts of each cause."""
    orders = max(len(amounts) for *_, amounts in changes)
    out = np.zeros((len(list(of_kind(Answers))), orders, len(columns)), complex)
    first = 0
    for n, _, amounts in changes:
        values = columns[:, first : first + len(amounts)].T
        out[n, : len(amounts)] = np.linalg.solve(polynomial.polyvander(amounts, len(amounts) - 1), values)
        first += len(amounts)
    out[:, 0] = out[changes[0][0], 0]
    return out
