"""Coupling between the non-identical neighbours of a lens, solved for its own cell."""

import math
from dataclasses import dataclass

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.design.neighbours import estimate_neighbour_coupling
from metalens.design.profiles import lens_focus
from metalens.lens import CURVED, Lens, NeighbourRows
from metalens.psf import NEIGHBOURS

# pillars in a row; zones of fewer or more pillars take the row of that length (with
# two, rows of shifted phases separate the light to both sides)
FEWEST = 2
MOST = 12


@dataclass(frozen=True, slots=True)
class NeighbourCouplingLoss:
    """Focus power lost to coupling between non-identical neighbours, against the
    locally periodic approximation.

    share: of that power.
    error: estimate of its error.
    """

    share: float
    error: float


def solve_coupling_rows(lens: Lens) -> NeighbourRows:
    """Rows of the lens's own pillars with the zones of its rim and longer ones, for the
    lens to hold.

    Args:
        lens: the lens; rows that it holds are not solved again.

    Raises:
        CellError: the cell has films or tilted walls, or no round pillars on a square
            lattice.
    """
    if lens.pairs is not None:
        raise CellError(
            "own_cell: rows of pillars of two sizes are not solved; leave own_cell out"
        )
    if lens.neighbours is not None:
        return lens.neighbours
    steepest = float(_rings(lens)[0].max())
    rim = max(FEWEST, round(lens.wavelength_um / (lens.cell.pitch_um * steepest)))
    shortest = min(rim, MOST // 2)
    counts = shortest, math.ceil(1.5 * shortest), 2 * shortest
    return estimate_neighbour_coupling(lens, counts=counts)


def neighbour_coupling_loss(lens: Lens) -> NeighbourCouplingLoss:
    """Focus power with coupling over that without, from solved rows of the lens's
    pillars.

    share = |sum_r w_r c(s_r)|² over rings r of the aperture, of area w and deflection
    sine s, with the coupling factor c of the rows.

    Accuracy: the change by another truncation, plus that by leaving out any one row,
        plus a fifth of the loss for zones that shorten from one to the next, as in no
        row.

    Args:
        lens: the lens; rows that it holds are not solved again.

    Raises:
        CellError: as :func:`solve_coupling_rows`.
    """
    rows = solve_coupling_rows(lens)
    sine, weight = _rings(lens)
    share = rows.share(sine, weight)
    reduced = [other.share(sine, weight) for other in rows.others]
    truncation = abs(rows.coarser.share(sine, weight) - share)
    error = truncation + max(
        (abs(other_share - share) for other_share in reduced), default=0.0
    )
    return NeighbourCouplingLoss(share, error + CURVED * abs(1 - share))


def estimate_neighbour_coupling_loss(lens: Lens) -> NeighbourCouplingLoss:
    """Rough :func:`neighbour_coupling_loss` with the coupling factor of another cell.

    share = |sum_r w_r (1 + a s_r + b s_r²)|², a and b of
    :data:`metalens.psf.budget.NEIGHBOURS`. Only its size is meaningful: where that cell
    gains a little, these pillars may lose as much.

    Args:
        lens: the lens.
    """
    sine, weight = _rings(lens)
    a, b = NEIGHBOURS
    share = float(abs(weight @ (1 + a * sine + b * sine**2)) ** 2)
    return NeighbourCouplingLoss(share, abs(1 - share))


def power_error(lens: Lens) -> float:
    """Relative error of the power behind the pillars.

    Root sum square of twice the error of |t| by the proxy, and the error of the
    neighbour coupling (rough where no rows are solved).

    Args:
        lens: the lens.
    """
    t_error = (
        lens.proxy.error(lens.wavelength_um)
        if lens.pairs is None
        else lens.pairs.entry_error
    )
    coupling_loss = (
        estimate_neighbour_coupling_loss
        if lens.neighbours is None
        else neighbour_coupling_loss
    )
    return math.hypot(2 * t_error, coupling_loss(lens).error)


def _rings(lens: Lens, count: int = 48) -> tuple[Array, Array]:
    """(m,) sines by which rings of a lens turn light, and their shares of the area.

    Gauss-Legendre nodes in the squared radius; sine = NA towards the sensor plus
    r / hypot(r, source distance).

    Args:
        lens: the lens.
    """
    radius_um = lens.diameters.radius_um + lens.diameters.pitch_um / 2
    node, weight = np.polynomial.legendre.leggauss(count)
    radius = radius_um * np.sqrt((node + 1) / 2)
    focus = lens_focus(lens)
    sine = np.array(
        [
            focus.aperture(r) + r / math.hypot(r, lens.source_distance_um)
            for r in radius.tolist()
        ]
    )
    return sine, weight / 2
