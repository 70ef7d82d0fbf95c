"""What the answering causes do to the pillars, from the cell solvers: t itself where
they are quick, else slopes.
"""

import functools
import hashlib
import os
from collections.abc import Callable, Container, Sequence
from importlib import import_module
from pathlib import Path

import joblib
import numpy as np
import scipy
from numpy.polynomial import chebyshev

from characterize.model import solving
from metalens.cell import Cell, index
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import CellError, FitError, MaterialError
from metalens.fabrication import (
    Kinds,
    Perturbation,
    Sensitivity,
    Solved,
    inapplicable_names,
    own_rates,
    pair_sensitivities,
    proxy_sensitivity,
    response_errors,
)
from metalens.lens import Lens

_NODES, _MOST = 25, 14
_SOURCES = (
    "metalens.cell",
    "metalens.modal",
    "metalens.rcwa",
    "metalens.fabrication",
    "metalens.library",
    "characterize.model.solving",
    "characterize.model.pillar_slopes",
)
_KEPT = 64  # lenses whose slopes are kept on disk


def log_response_slopes(
    lens: Lens, *, tolerance: float = 0.02, wanted: Container[str] = ()
) -> Sensitivity:
    """d ln t by the answering causes of :mod:`metalens.fabrication.perturbations` over
    the diameters
    of a lens, or t itself.

    Upright round pillars whose proxy is that of the cell: t by the modal method at
    every diameter that a bias can lead to and at five heights and seven indices within
    the bounds of the fit (:class:`metalens.fabrication.Solved`), to 3e-3 there and up
    to 0.03
    between them where a resonance moves by. The slopes beside the table are polynomials
    of the least degree below 15 that meets ``tolerance`` at held-out diameters.

    Other round ones: derivatives by RCWA at a fixed truncation
    (:func:`metalens.fabrication.own_rates`) as such polynomials; ``error`` adds what
    the
    truncation leaves. Cells that no solver takes get the effective-index slopes of
    :func:`metalens.fabrication.proxy_sensitivity`, pillars that are not round those of their
    own
    shape. Pillars of two sizes: those of up to 24 pairs of them, for the light of the
    lens.

    What was solved once is kept in the user's cache folder, ``metalens`` in
    $XDG_CACHE_HOME or ~/.cache.

    Args:
        lens: its cell, its diameters and its light. tolerance: of the slopes, relative.
        wanted: names of causes that a table lacks (the sidewall) and that are wanted
            all the same; zero without.

    Raises:
        FitError: a cause is wanted that pillars of this shape cannot have. CellError,
            MaterialError: pillars that are not round, and that no solver takes.
    """
    for name in inapplicable_names(lens.cell):
        if name in wanted:
            raise FitError(f"{name}: a {lens.cell.described} has none; leave it out")
    if lens.pairs is not None:
        return _of_pairs(lens)
    about = _about(
        lens, tolerance, [row.name for row in _unknown() if row.name in wanted]
    )
    try:
        return _cached(about, lambda: _solve(lens, tolerance, wanted))
    except (CellError, MaterialError):
        if not lens.cell.round:
            raise
        return proxy_sensitivity(lens)


def _of_pairs(lens: Lens) -> Sensitivity:
    """Of pillars of two sizes, for the light of the lens."""
    kinds = Kinds.of(lens.diameters)
    about = _about(
        lens,
        0.0,
        [
            "two sizes",
            lens.light,
            repr(kinds.width_um.tolist()),
            repr(kinds.length_um.tolist()),
        ],
    )
    return _cached(
        about, lambda: Sensitivity.of_pairs(pair_sensitivities(lens)[lens.light])
    )


def _cached(about: str, make: Callable[[], Sensitivity]) -> Sensitivity:
    """What ``make`` returns, from disk where it was made before of the same ``about``,
    the same sources and the same libraries; a folder that cannot be written costs time
    alone.
    """
    base = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    try:
        memory = joblib.Memory(Path(base) / "metalens", verbose=0)
    except OSError:
        return make()
    call = memory.cache(_call, ignore=["make"])
    key = f"{about} {_source_digest()} {np.__version__} {scipy.__version__}"
    known = call.check_call_in_cache(key, make)
    found: Sensitivity = call(key, make)
    if not known:
        memory.reduce_size(items_limit=_KEPT)
    return found


def _call(key: str, make: Callable[[], Sensitivity]) -> Sensitivity:
    return make()


@functools.cache
def _source_digest() -> str:
    """SHA-256 of every source file that the slopes come from."""
    digest = hashlib.sha256()
    for name in _SOURCES:
        home = Path(str(import_module(name).__file__))
        package = home.name == "__init__.py"
        for file in sorted(home.parent.rglob("*.py")) if package else [home]:
            digest.update(file.read_bytes())
    return digest.hexdigest()


def _about(lens: Lens, tolerance: float, wanted: Sequence[str]) -> str:
    """All that the slopes of a lens come from, as text."""
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    cell = lens.cell
    films = [film.material for film in (*cell.under, *cell.over)]
    sections = [
        one
        for layer in cell.layers
        for one in (layer.material, layer.between, layer.coat)
        if one is not None
    ]
    media = cell.pillar, cell.fill, cell.substrate, cell.cover, *films, *sections
    indices = [index(medium, lens.wavelength_um) for medium in media]
    arrays, numbers = store.flatten_record(lens.proxy)
    proxy = numbers | {name: array.tolist() for name, array in arrays.items()}
    return repr(
        (
            cell,
            indices,
            lens.wavelength_um,
            float(d.min()),
            float(d.max()),
            proxy,
            tolerance,
            wanted,
        )
    )


def _solve(lens: Lens, tolerance: float, wanted: Container[str]) -> Sensitivity:
    """:func:`log_response_slopes` by the solvers."""
    if not lens.cell.round:
        return proxy_sensitivity(lens)
    table = solving.solved_transmission(lens) if _upright(lens.cell) else None
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    low, high = float(d.min()), float(d.max())
    low, high = (low, high) if high > low else (low - 1e-3, high + 1e-3)
    unit = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    diameters = (low + high) / 2 + (high - low) / 2 * unit
    truncation = 0.0
    if table is None:
        found = own_rates(lens, diameters)
        rows, truncation = found.rates, found.error
    else:
        rows = _table_slopes(lens, table, diameters, wanted)
    degree, error = _degree(unit, rows, tolerance)
    fits = [chebyshev.cheb2poly(chebyshev.chebfit(unit, row, degree)) for row in rows]
    scale = (2 / (high - low)) ** np.arange(degree + 1)
    padded = [np.pad(fit, (0, degree + 1 - len(fit))) for fit in fits]
    error += truncation
    return Sensitivity(
        np.array(padded) * scale, (low + high) / 2, error, low, high, table
    )


def _table_slopes(
    lens: Lens, table: Solved, diameter_um: Array, wanted: Container[str]
) -> Array:
    """(answering causes, n) d ln t at design by a table, by RCWA where it has none and
    the cause is wanted.
    """
    series = table.series(diameter_um)
    rows = np.zeros((len(series), len(diameter_um)), complex)
    unknown = [row.name for row in _unknown() if row.name in wanted]
    rates = own_rates(lens, diameter_um).rates if unknown else rows
    for n, (row, acts) in enumerate(response_errors()):
        if acts.exact:
            rows[n] = series[n, 1] / series[n, 0]
        elif row.name in unknown:
            rows[n] = rates[n]
    return rows


def _unknown() -> list[Perturbation]:
    """Answering causes that a table of the modal method lacks."""
    return [row for row, acts in response_errors() if not acts.exact]


def _upright(cell: Cell) -> bool:
    return cell.round and not (cell.under or cell.over or cell.sidewall_rad)


def _degree(unit: Array, rows: Array, tolerance: float) -> tuple[int, float]:
    """(degree, error): every third node is held out and judged."""
    judged = np.arange(len(unit)) % 3 == 1
    size = np.maximum(
        np.abs(rows - rows.mean(1, keepdims=True)).max(1), 1e-9 * np.abs(rows).max()
    )
    errors = []
    for degree in range(1, _MOST + 1):
        guess = [
            chebyshev.chebval(
                unit[judged], chebyshev.chebfit(unit[~judged], row[~judged], degree)
            )
            for row in rows
        ]
        errors.append(
            float((np.abs(np.array(guess) - rows[:, judged]).max(1) / size).max())
        )
        if errors[-1] <= tolerance:
            break
    best = int(np.argmin(errors))
    return best + 1, errors[best]
