"""What the pillar-response errors do to the pillars, from the cell solvers: t itself where
they are quick, else slopes.
"""

import functools
import os
from collections.abc import Container, Sequence
from pathlib import Path

import joblib
import numpy as np
import scipy
from numpy.polynomial import polynomial

import metalens
from characterize.model import solving
from metalens.cell import index
from metalens.core.arrays import Array
from metalens.core.errors import CellError, FitError, MaterialError
from metalens.fabrication import (
    PillarKinds,
    Sensitivity,
    inapplicable_names,
    own_rates,
    pair_sensitivities,
    proxy_sensitivity,
    response_errors,
)
from metalens.lens import Lens

_NODES, _MOST, _TOLERANCE = 25, 14, 0.02
_KEPT = 64  # lenses whose slopes are kept on disk


def log_response_slopes(lens: Lens, *, names: Container[str] = ()) -> Sensitivity:
    """d ln t by the pillar-response errors over the diameters of a lens, or a table of t.

    The causes are those of :mod:`metalens.fabrication.perturbations`.

    Upright round pillars whose proxy is that of the cell: a table of t by the modal
    method (:class:`metalens.fabrication.SolvedResponse`) at every diameter that a bias can
    reach, five heights and seven indices within the bounds of the fit. Its error is
    3e-3 there, and up to 0.03 between them where a resonance moves by.

    Other round pillars, and causes in ``names`` that a table lacks: derivatives by RCWA
    at a fixed truncation (:func:`metalens.fabrication.own_rates`), as polynomials of
    the least degree below 15 that meets 2 % at held-out diameters; ``error`` includes
    the truncation. Cells that no solver takes: effective-index slopes of
    :func:`metalens.fabrication.proxy_sensitivity`; pillars that are not round: those
    of their own shape. Pillars of two sizes: slopes of up to 24 pairs of sizes, for
    the light of the lens.

    Results are cached on disk, in ``metalens`` in $XDG_CACHE_HOME or ~/.cache.

    Args:
        lens: its cell, its diameters and its light.
        names: names of causes to include although a table lacks them (the sidewall);
            their slopes are zero otherwise.

    Raises:
        FitError: a cause in ``names`` does not exist for pillars of this shape.
        CellError, MaterialError: pillars that are not round, and that no solver takes.
    """
    for name in inapplicable_names(lens.cell):
        if name in names:
            raise FitError(f"{name}: a {lens.cell.described} has none; leave it out")
    extra = tuple(
        row.name
        for row, acts in response_errors()
        if row.name in names and not acts.exact and lens.pairs is None
    )
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    try:
        memory = joblib.Memory(Path(base) / "metalens", verbose=0)
    except OSError:  # a folder that cannot be written
        return _solve(lens, extra, "")
    kept = memory.cache(_solve, ignore=["lens", "extra"])
    key = _key(lens, extra)
    stored = kept.check_call_in_cache(lens, extra, key)
    slopes: Sensitivity = kept(lens, extra, key)
    if not stored:
        memory.reduce_size(items_limit=_KEPT)
    return slopes


def _key(lens: Lens, extra: Sequence[str]) -> str:
    """Hash of everything that the slopes of a lens depend on, sources and libraries
    included.
    """
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    about: list[object] = [lens.cell, lens.wavelength_um, lens.proxy, extra]
    about += [index(medium, lens.wavelength_um) for medium in lens.cell.materials]
    about += [float(d.min()), float(d.max()), np.__version__, scipy.__version__]
    if lens.pairs is not None:
        kinds = PillarKinds.of(lens.diameters)
        about += [lens.light, kinds.width_um, kinds.length_um]
    return str(joblib.hash([_source_digest(), *about]))


@functools.cache
def _source_digest() -> str:
    """Hash of the sources that the slopes come from: solvers, and this folder."""
    folders = Path(str(metalens.__file__)).parent, Path(__file__).parent
    files = [file for folder in folders for file in sorted(folder.rglob("*.py"))]
    return str(joblib.hash([file.read_bytes() for file in files]))


def _solve(lens: Lens, extra: tuple[str, ...], key: str) -> Sensitivity:
    """:func:`log_response_slopes` by the solvers, kept on disk by ``key``.

    Slopes are sampled at Chebyshev nodes of the diameters and fitted by polynomials.
    """
    if lens.pairs is not None:
        return Sensitivity.of_pairs(pair_sensitivities(lens)[lens.light])
    if not lens.cell.round:
        return proxy_sensitivity(lens)
    try:
        return _solve_round(lens, extra)
    except (CellError, MaterialError):
        return proxy_sensitivity(lens)


def _solve_round(lens: Lens, extra: tuple[str, ...]) -> Sensitivity:
    """Slopes of round pillars of one size.

    Raises:
        CellError, MaterialError: pillars that no solver takes.
    """
    cell = lens.cell
    upright = not (cell.under or cell.over or cell.sidewall_rad)
    table = solving.solved_transmission(lens) if upright else None
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    low, high = float(d.min()), float(d.max())
    low, high = (low, high) if high > low else (low - 1e-3, high + 1e-3)
    center = (low + high) / 2
    if table is not None and not extra:
        error = solving.TOLERANCE
        return Sensitivity(np.zeros((1, 1)), center, error, low, high, table)
    unit = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    rates = own_rates(lens, center + (high - low) / 2 * unit)
    rows = rates.rates
    if table is not None:
        asked = [row.name in extra for row, _ in response_errors()]
        rows = rows * np.array(asked)[:, None]
    degree, error = _degree(unit, rows)
    scale = (2 / (high - low)) ** np.arange(degree + 1)
    series = polynomial.polyfit(unit, rows.T, degree).T * scale
    return Sensitivity(series, center, error + rates.error, low, high, table)


def _degree(unit: Array, rows: Array) -> tuple[int, float]:
    """(degree, error) of the polynomial fit of ``rows`` (causes, n) over ``unit`` (n,).

    The least degree whose error at held-out nodes, every third, is below
    ``_TOLERANCE``; else that of the least error. Errors are relative to the largest
    deviation from the mean.
    """
    held_out = np.arange(len(unit)) % 3 == 1
    size = np.maximum(
        np.abs(rows - rows.mean(1, keepdims=True)).max(1), 1e-9 * np.abs(rows).max()
    )
    errors = []
    for degree in range(1, _MOST + 1):
        series = polynomial.polyfit(unit[~held_out], rows[:, ~held_out].T, degree)
        predictions = polynomial.polyval(unit[held_out], series)
        difference = np.abs(predictions - rows[:, held_out]).max(1)
        errors.append(float((difference / size).max()))
        if errors[-1] <= _TOLERANCE:
            break
    best = int(np.argmin(errors))
    return best + 1, errors[best]
