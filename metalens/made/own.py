"""Pillars by their own shape: exact derivatives of their Jones matrices by the answering causes, and by their edges."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from metalens.cell import Cell
from metalens.ground import executor
from metalens.ground.arrays import Array
from metalens.ground.errors import LensError
from metalens.made.causes import Answers, Cause, of_kind

if TYPE_CHECKING:
    from metalens.lens import Lens
    from metalens.rcwa import JonesDerivatives

_UPRIGHT, _TILTED = (6, 8), (5, 6)  # harmonics of the coarser and the finer truncation
_HANDS = {"left": -1.0, "right": 1.0}


@dataclass(frozen=True, eq=False, slots=True)
class OwnRates:
    """Logarithmic derivatives of t at some sizes.

    rates: (answering causes, n) complex, by the base unit of each (um, rad, 1); 0 of what such pillars cannot have.
    edges: (n,) by a bias of all edges, less that by the size, which is what a proxy knows: 0 where a shape keeps its
    form as its edges move (circles, squares), per um.
    error: largest relative change (rms over the sizes) of one of them from a coarser truncation.
    """

    rates: Array
    edges: Array
    error: float


def own_rates(lens: "Lens", size_um: Array) -> OwnRates:
    """Exact derivatives of RCWA at a fixed truncation, for the light that the lens's proxy is of.

    Accuracy: ``error``, the change from a coarser truncation: a few percent.

    Raises:
        CellError, MaterialError: from the solver. LensError: pillars of two sizes, which no single size tells.
    """
    if lens.pairs is not None:
        raise LensError("pillars of two sizes: their derivatives are no function of one size")
    reach = _TILTED if lens.cell.sidewall_rad else _UPRIGHT
    tasks = [(float(d), harmonics) for harmonics in reach for d in size_um]
    some = list(executor.gather(_derived, (lens.cell, lens.wavelength_um, seen(lens)), tasks))
    coarse, fine = np.array(some).reshape(len(reach), len(size_um), -1).transpose(0, 2, 1)
    off = np.linalg.norm(fine - coarse, axis=1) / np.maximum(np.linalg.norm(fine, axis=1), 1e-9)
    known = np.abs(fine).max(1) > 1e-6 * np.abs(fine).max()  # a turn that a mirror of the cell forbids is rounding
    return OwnRates(fine[:-1], fine[-1], float((off * known).max()))


def seen(lens: "Lens") -> Array:
    """(2, 2) weights of the Jones matrix that add up to the t that the proxy is of, its geometric phase aside."""
    if lens.hand:
        come = np.array([1.0, 1j * _HANDS[lens.hand]]) / np.sqrt(2)
        return np.outer(come, come)
    one = lens.one_light and lens.proxy.max_angle_rad == 0
    return np.diag([1.0, 0.0] if one else [0.5, 0.5])


def _derived(about: tuple[Cell, float, Array], task: tuple[float, int]) -> list[complex]:
    """Derivatives of ln t by every answering cause, and by the edges less by the size."""
    from metalens.rcwa import jones_derivatives

    (cell, wavelength_um, weight), (size_um, harmonics) = about, task
    causes = [row for _, row in of_kind(Answers)]
    wanted = [_numbers(row, cell, size_um) for row in causes]
    edges = {} if cell.shape.kind == "circle" else {"grow_um": 1.0, "size_um": -1.0}
    names = dict.fromkeys(name for some in (*wanted, edges) for name in some or {})
    found = jones_derivatives(cell, size_um, wavelength_um, harmonics=harmonics, by=names)

    def by(numbers: dict[str, float]) -> complex:
        return sum((share * _of(found, name, weight) for name, share in numbers.items()), 0j)

    differ = [
        by(some) if some is not None else _difference(row, about, task)
        for row, some in zip(causes, wanted, strict=True)
    ]
    return [*differ, by(edges)]


def _numbers(row: Cause, cell: Cell, size_um: float) -> dict[str, float] | None:
    acts = row.acts
    return acts.numbers(cell, size_um) if isinstance(acts, Answers) and acts.numbers else None


def _of(found: "JonesDerivatives", name: str, weight: Array) -> complex:
    return complex((weight * found.by[name].t).sum() / (weight * found.jones.t).sum())


def _difference(row: Cause, about: tuple[Cell, float, Array], task: tuple[float, int]) -> complex:
    """Central difference of ln t by a cause of which no number of the cell tells."""
    from metalens.rcwa import jones

    (cell, wavelength_um, weight), (size_um, harmonics), acts = about, task, row.acts
    if not isinstance(acts, Answers) or acts.changed is None:
        return 0j
    ends = (acts.changed(cell, sign * acts.step, wavelength_um) for sign in (-1, 1))
    less, more = ((weight * jones(end, size_um, wavelength_um, harmonics=harmonics).t).sum() for end in ends)
    return complex(np.log(more / less) / (2 * acts.step))
