"""Pillars by their own shape: exact derivatives of their Jones matrices by the
pillar-response errors, and by their edges.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from metalens.cell import Cell
from metalens.core import executor
from metalens.core.arrays import Array
from metalens.core.errors import LensError
from metalens.fabrication.perturbations import Perturbation, ResponseError, of_kind
from metalens.library.axes import cell_of_sizes

if TYPE_CHECKING:
    from metalens.lens import Lens
    from metalens.rcwa import JonesDerivatives

_UPRIGHT, _TILTED = (6, 8), (5, 6)  # harmonics of the coarser and the finer truncation
_HANDS = {"left": -1.0, "right": 1.0}
_ALONG_X, _ALONG_Y = np.diag([1.0, 0.0]), np.diag([0.0, 1.0])


@dataclass(frozen=True, eq=False, slots=True)
class OwnRates:
    """Logarithmic derivatives of t at some sizes.

    rates: (pillar-response errors, n) complex, by the base unit of each (um, rad, 1); 0
    of
    what such pillars cannot have.
    edges: (n,) by a bias of all edges, less that by the size, which is what a proxy
    knows: 0 where a shape keeps its
    form as its edges move (circles, squares), per um.
    error: largest relative change (rms over the sizes) of one of them from a coarser
    truncation.
    """

    rates: Array
    edges: Array
    error: float


def own_rates(lens: "Lens", size_um: Array) -> OwnRates:
    """Exact derivatives of RCWA at a fixed truncation, for the light that the lens's
    proxy is of.

    Accuracy: ``error``, the change from a coarser truncation: a few percent.

    Raises:
        CellError, MaterialError: from the solver. LensError: pillars of two sizes
            (:func:`pair_rates`).
    """
    if lens.pairs is not None:
        raise LensError(
            "pillars of two sizes: their derivatives are no function of one size"
        )
    edges = (
        {} if lens.cell.shape.kind == "circle" else {"grow_um": 1.0, "size_um": -1.0}
    )
    (found,) = _rates(
        lens,
        [(lens.cell, float(d)) for d in size_um],
        edges,
        (polarization_weights(lens),),
    )
    return found


def pair_rates(lens: "Lens", width_um: Array, length_um: Array) -> dict[str, OwnRates]:
    """As :func:`own_rates`, of pillars of two sizes, for light along "x" and along "y".

    Their table knows both sizes, so that nothing is left of a bias of all edges:
    ``edges`` are 0.
    """
    cells = [
        (cell_of_sizes(lens.cell, float(w), float(d)), float(w))
        for w, d in zip(width_um, length_um, strict=True)
    ]
    return dict(zip("xy", _rates(lens, cells, {}, (_ALONG_X, _ALONG_Y)), strict=True))


def _rates(
    lens: "Lens",
    cells: list[tuple[Cell, float]],
    edges: dict[str, float],
    weights: tuple[Array, ...],
) -> list[OwnRates]:
    """Of pillars of these cells and sizes, for each weighting of the Jones matrix."""
    reach = _TILTED if lens.cell.sidewall_rad else _UPRIGHT
    tasks = [(cell, size, harmonics) for harmonics in reach for cell, size in cells]
    some = list(
        executor.gather_parallel(_derived, (lens.wavelength_um, edges, weights), tasks)
    )
    every = (
        np.array(some)
        .reshape(len(reach), len(cells), len(weights), -1)
        .transpose(2, 0, 3, 1)
    )
    return [_judged(coarse, fine) for coarse, fine in every]


def _judged(coarse: Array, fine: Array) -> OwnRates:
    off = np.linalg.norm(fine - coarse, axis=1) / np.maximum(
        np.linalg.norm(fine, axis=1), 1e-9
    )
    known = (
        np.abs(fine).max(1) > 1e-6 * np.abs(fine).max()
    )  # a turn that a mirror of the cell forbids is rounding
    return OwnRates(fine[:-1], fine[-1], float((off * known).max()))


def polarization_weights(lens: "Lens") -> Array:
    """(2, 2) weights of the Jones matrix that add up to the t that the proxy is of, its
    geometric phase aside.
    """
    if lens.hand:
        come = np.array([1.0, 1j * _HANDS[lens.hand]]) / np.sqrt(2)
        return np.outer(come, come)
    one = lens.one_light and lens.proxy.max_angle_rad == 0
    return _ALONG_X if one else (_ALONG_X + _ALONG_Y) / 2


def _derived(
    about: tuple[float, dict[str, float], tuple[Array, ...]],
    task: tuple[Cell, float, int],
) -> list[list[complex]]:
    """For each weighting: derivatives of ln t by every pillar-response error, and by
    the
    edges less by the size.
    """
    from metalens.rcwa import jones_derivatives

    (wavelength_um, edges, weights), (cell, size_um, harmonics) = about, task
    causes = [row for _, row in of_kind(ResponseError)]
    wanted = [_numbers(row, cell, size_um) for row in causes]
    names = dict.fromkeys(name for some in (*wanted, edges) for name in some or {})
    found = jones_derivatives(
        cell, size_um, wavelength_um, harmonics=harmonics, by=names
    )

    def by(numbers: dict[str, float], weight: Array) -> complex:
        return sum(
            (share * _of(found, name, weight) for name, share in numbers.items()), 0j
        )

    differ = [
        [by(some, weight) for weight in weights]
        if some is not None
        else _difference(row, wavelength_um, weights, task)
        for row, some in zip(causes, wanted, strict=True)
    ]
    differ.append([by(edges, weight) for weight in weights])
    return [list(each) for each in zip(*differ, strict=True)]


def _numbers(row: Perturbation, cell: Cell, size_um: float) -> dict[str, float] | None:
    acts = row.acts
    return (
        acts.numbers(cell, size_um)
        if isinstance(acts, ResponseError) and acts.numbers
        else None
    )


def _of(found: "JonesDerivatives", name: str, weight: Array) -> complex:
    return complex((weight * found.by[name].t).sum() / (weight * found.jones.t).sum())


def _difference(
    row: Perturbation,
    wavelength_um: float,
    weights: tuple[Array, ...],
    task: tuple[Cell, float, int],
) -> list[complex]:
    """Central differences of ln t by a cause of which no number of the cell tells, for
    each weighting.
    """
    from metalens.rcwa import jones

    (cell, size_um, harmonics), acts = task, row.acts
    if not isinstance(acts, ResponseError) or acts.changed is None:
        return [0j] * len(weights)
    ends = (acts.changed(cell, sign * acts.step, wavelength_um) for sign in (-1, 1))
    less, more = (
        jones(end, size_um, wavelength_um, harmonics=harmonics).t for end in ends
    )
    return [
        complex(np.log((w * more).sum() / (w * less).sum()) / (2 * acts.step))
        for w in weights
    ]
