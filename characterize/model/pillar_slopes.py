"""What the answering causes do to the pillars, from the cell solvers: t itself where
they are quick, else slopes.
"""

import functools
from collections.abc import Container, Mapping, Sequence

import numpy as np
from numpy.polynomial import chebyshev

from characterize.model import kept, solving
from metalens import modal, rcwa
from metalens.cell import Cell, index
from metalens.ground.arrays import Array
from metalens.ground.errors import CellError, FitError, MaterialError
from metalens.lens import Lens
from metalens.made import (
    Answers,
    Cause,
    Kinds,
    PairSensitivities,
    Sensitivity,
    Solved,
    lacking,
    of_kind,
    pair_sensitivities,
    sensitivity,
)

_NODES, _MOST = 25, 14
_SOURCES = (
    *(
        "metalens.cell",
        "metalens.modal",
        "metalens.rcwa",
        "metalens.made",
        "metalens.pillars",
    ),
    *("characterize.model.solving", "characterize.model.pillar_slopes"),
)


def slopes(
    lens: Lens, *, tolerance: float = 0.02, wanted: Container[str] = ()
) -> Sensitivity:
    """d ln t by the answering causes of :mod:`metalens.made.causes` over the diameters
    of a lens, or t itself.

    Upright round pillars whose proxy is that of the cell: t by the modal method at
    every diameter that a bias can
    lead to and at five heights and seven indices within the bounds of the fit
    (:class:`metalens.made.Solved`), to 3e-3
    there and up to 0.03 between them where a resonance moves by. No slope is taken for
    a curve, and past the proxy's
    domain, where pillars begin to resonate, nothing is extrapolated.

    Other round ones: exact derivatives at 25 Chebyshev diameters (RCWA for films or
    tilted walls), as the
    polynomial of least degree whose error on diameters that it was not made from meets
    ``tolerance``, relative to
    the largest change of the slope across the lens; the best one below degree 15 where
    none does. The error reached
    is in ``error``. Cells that no solver takes get the effective-index slopes of
    :func:`metalens.made.sensitivity`, and
    pillars that are not round on a square lattice, those of their own shape that it
    has; pillars of two sizes those of
    up to 24 pairs of them, for the light of the lens.

    What was solved once is kept in the user's cache folder
    (:mod:`characterize.model.kept`).

    Args:
        wanted: names of causes whose slope no solver knows in closed form (the
            sidewall) and that are wanted all the
            same: by differences of the RCWA solver (half a degree of wall: 0.1 deg² of
                curvature); zero without.

    Raises:
        FitError: a cause is wanted that pillars of this shape cannot have. CellError,
            MaterialError: pillars that are
            not round, and that no solver takes.
    """
    for name in lacking(lens.cell):
        if name in wanted:
            raise FitError(f"{name}: a {lens.cell.described} has none; leave it out")
    if lens.pairs is not None:
        return _of_pairs(lens)
    if not lens.cell.round:
        about = _about(lens, tolerance, ["own shape"])
        return _unpacked(
            kept.kept("pillars", about, _SOURCES, lambda: _packed(sensitivity(lens)))
        )
    try:
        about = _about(
            lens, tolerance, [row.name for row in _unknown() if row.name in wanted]
        )
        return _unpacked(
            kept.kept(
                "pillars",
                about,
                _SOURCES,
                lambda: _packed(_solve(lens, tolerance, wanted)),
            )
        )
    except (CellError, MaterialError):
        return sensitivity(lens)


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

    def solve() -> dict[str, Array]:
        return _packed(Sensitivity.of_pairs(pair_sensitivities(lens)[lens.light]))

    return _unpacked(kept.kept("pillars", about, _SOURCES, solve))


def _about(lens: Lens, tolerance: float, wanted: Sequence[str]) -> str:
    """All that the slopes of a lens come from, as text."""
    d, cell = lens.diameters.diameter_um[lens.diameters.diameter_um > 0], lens.cell
    films = [film.material for film in (*cell.under, *cell.over)]
    sections = [
        one
        for layer in cell.layers
        for one in (layer.material, layer.between, layer.coat)
        if one is not None
    ]
    media = cell.pillar, cell.fill, cell.substrate, cell.cover, *films, *sections
    indices = [index(medium, lens.wavelength_um) for medium in media]
    proxy = {
        name: np.asarray(value).tolist()
        for name, value in lens.proxy.to_arrays().items()
    }
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


def _packed(found: Sensitivity) -> dict[str, Array]:
    """As named arrays."""
    numbers = np.array([found.center_um, found.error, found.low_um, found.high_um])
    out = {"coefficients": found.coefficients, "numbers": numbers}
    if found.solved is not None:
        table = found.solved
        out |= {
            "wavelength": np.array(table.wavelength_um),
            "diameter": table.diameter_um,
            "powers": table.powers,
        }
    if found.edges is not None:
        out["edges"] = found.edges
    if found.pairs is not None:
        out |= {
            "width": found.pairs.width_um,
            "length": found.pairs.length_um,
            "rates": found.pairs.rates,
        }
    return out


def _unpacked(arrays: Mapping[str, Array]) -> Sensitivity:
    """From named arrays."""
    center, error, low, high = arrays["numbers"].tolist()
    if "rates" in arrays:
        return Sensitivity.of_pairs(
            PairSensitivities(arrays["width"], arrays["length"], arrays["rates"], error)
        )
    table = None
    if "powers" in arrays:
        table = Solved(
            float(arrays["wavelength"]), arrays["diameter"], arrays["powers"]
        )
    return Sensitivity(
        arrays["coefficients"], center, error, low, high, table, arrays.get("edges")
    )


def _solve(lens: Lens, tolerance: float, wanted: Container[str]) -> Sensitivity:
    """:func:`slopes` by the solvers."""
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    low, high = float(d.min()), float(d.max())
    low, high = (low, high) if high > low else (low - 1e-3, high + 1e-3)
    unit = np.cos(np.pi * (np.arange(_NODES) + 0.5) / _NODES)
    diameters = (low + high) / 2 + (high - low) / 2 * unit
    found = solving.solved(lens) if _upright(lens.cell) else None
    rows = np.array(
        [
            _exact(lens.cell, float(one), lens.wavelength_um, wanted, found)
            for one in diameters
        ]
    ).T
    degree, error = _degree(unit, rows, tolerance)
    fits = [chebyshev.cheb2poly(chebyshev.chebfit(unit, row, degree)) for row in rows]
    scale = (2 / (high - low)) ** np.arange(degree + 1)
    padded = [np.pad(fit, (0, degree + 1 - len(fit))) for fit in fits]
    return Sensitivity(
        np.array(padded) * scale, (low + high) / 2, error, low, high, found
    )


def _unknown() -> list[Cause]:
    """Answering causes of which no solver knows the slope in closed form."""
    return [
        row
        for _, row in of_kind(Answers)
        if isinstance(row.acts, Answers) and not row.acts.exact
    ]


def _upright(cell: Cell) -> bool:
    return cell.round and not (cell.under or cell.over or cell.sidewall_rad)


def _exact(
    cell: Cell,
    diameter_um: float,
    wavelength_um: float,
    wanted: Container[str],
    table: Solved | None,
) -> list[complex]:
    """d ln t by each answering cause: the solver's own derivative, or its differences
    where that is wanted.
    """
    if table is not None:
        series = table.series(np.array(diameter_um))
        slope = dict(
            zip(
                (row.name for _, row in of_kind(Answers)),
                series[:, 1] / series[:, 0],
                strict=True,
            )
        )
    else:
        solve = (
            functools.partial(modal.gradient, tolerance=1e-2)
            if _upright(cell)
            else rcwa.derivatives
        )
        found = solve(cell, diameter_um, wavelength_um)

    def by(row: Cause) -> complex:
        if not isinstance(row.acts, Answers) or not (
            row.acts.exact or row.name in wanted
        ):
            return 0.0
        if row.acts.exact and table is not None:
            return complex(slope[row.name])
        if row.acts.exact:
            return complex(getattr(found, row.acts.exact) / found.t)
        if row.acts.changed is None:
            return 0.0
        step, changed = row.acts.step, row.acts.changed
        ends = (changed(cell, sign * step, wavelength_um) for sign in (1, -1))
        up, down = (rcwa.derivatives(end, diameter_um, wavelength_um).t for end in ends)
        return complex(np.log(up / down) / (2 * step))

    return [by(row) for _, row in of_kind(Answers)]


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
