"""What a lens's own pillars leave out of its PSF: non-identical neighbours and the angle of
the light, solved for its cell.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from metalens import rcwa
from metalens.core.arrays import Array
from metalens.core.errors import CellError
from metalens.design.neighbours import drawn_diameter_range, estimate_neighbour_coupling
from metalens.design.profiles import lens_focus
from metalens.lens import CURVED, Lens, NeighbourRows
from metalens.psf import NEIGHBOURS, LeftOut

RINGS = 48  # of a lens, over which light is summed
# pillars in a row; zones of fewer or more pillars take the row of that length (with
# two, rows of shifted phases separate the light to both sides)
FEWEST = 2
MOST = 12
DIAMETERS = 5  # at which t is compared over the angle
TOLERANCE = 1e-2  # of t


def left_out(lens: Lens, *, aperture: float, incidence_rad: float) -> LeftOut:
    """The terms of the error budget that belong to the lens's own cell.

    Args:
        aperture: sine of the largest angle by which the lens turns light.
        incidence_rad: of the light on the pillars; 0 leaves the term of the angle at 0.

    Raises:
        CellError: the cell has films or tilted walls, whose rows no solver here knows.

    Accuracy: the factor c(s) = 1 + a s + b s² goes through the rows; a few 1e-2 of it
    are truncation.
    """
    if lens.pairs is not None:
        raise CellError(
            "own_cell: rows of pillars of two sizes are not solved here; leave own_cell out"
        )
    rows = lens.neighbours or estimate_neighbour_coupling(
        lens, counts=_counts(lens, aperture)
    )
    angle = (
        angle_change(lens, incidence_rad) / math.sin(incidence_rad) ** 2
        if incidence_rad
        else 0.0
    )
    return LeftOut(rows, angle, "the lens's own cell")


def _counts(lens: Lens, aperture: float) -> tuple[int, ...]:
    """Pillars in rows from the zone of the rim on, where light is turned by the sine
    ``aperture``.
    """
    rim = max(FEWEST, round(lens.wavelength_um / (lens.cell.pitch_um * aperture)))
    shortest = min(rim, MOST // 2)
    return shortest, math.ceil(1.5 * shortest), 2 * shortest


@dataclass(frozen=True, slots=True)
class NeighbourCouplingLoss:
    """Focus power lost to coupling between non-identical neighbours, against the
    locally periodic approximation.

    share: of that power. error: estimate of its error. pillars: in the rows along the
    lattice that were solved; none:
    rough.
    """

    share: float
    error: float
    pillars: tuple[int, ...] = ()


def solve_coupling_rows(lens: Lens, *, radius_um: float) -> NeighbourRows:
    """Rows of the lens's own pillars with the zones of its rim and longer ones, for the
    lens to hold.

    Args:
        radius_um: radius of the aperture, um.

    Raises:
        CellError: the cell has films or tilted walls, or no round pillars on a square
            lattice.
    """
    return estimate_neighbour_coupling(
        lens, counts=_counts(lens, float(_rings(lens, radius_um)[0].max()))
    )


def neighbour_coupling_loss(lens: Lens, *, radius_um: float) -> NeighbourCouplingLoss:
    """Focus power with coupling over that without, from solved rows of the lens's
    pillars.

    share = |sum_r w_r c(s_r)|² over rings r of the aperture, of area w and deflection
    sine s, with the coupling factor c of the rows.

    Accuracy: the change by another truncation, plus that by leaving out any one row,
    plus
        a fifth of the loss for zones that shorten from one to the next, as in no row.

    Args:
        lens: the lens; rows that it holds are not solved again.
        radius_um: radius of the aperture, um.

    Raises:
        CellError: as :func:`solve_coupling_rows`.
    """
    rows = lens.neighbours or solve_coupling_rows(lens, radius_um=radius_um)
    sine, weight = _rings(lens, radius_um)
    share = rows.share(sine, weight)
    reduced = [other.share(sine, weight) for other in rows.others]
    truncation = abs(rows.coarser.share(sine, weight) - share)
    error = truncation + max(
        (abs(other_share - share) for other_share in reduced), default=0.0
    )
    pitches = lens.wavelength_um / (rows.sine[~rows.diagonal] * lens.cell.pitch_um)
    return NeighbourCouplingLoss(
        share,
        error + CURVED * abs(1 - share),
        tuple(np.rint(pitches).astype(int).tolist()),
    )


def estimate_neighbour_coupling_loss(
    lens: Lens, *, radius_um: float
) -> NeighbourCouplingLoss:
    """Rough :func:`neighbour_coupling_loss` with the coupling factor of another cell.

    share = |sum_r w_r (1 + a s_r + b s_r²)|², a and b of
    :data:`metalens.psf.budget.NEIGHBOURS`. Only its size is meaningful: where that cell
    gains a little, these pillars may lose as much.

    Args:
        lens: the lens.
        radius_um: radius of the aperture, um.
    """
    sine, weight = _rings(lens, radius_um)
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
    radius_um = lens.diameters.radius_um + lens.diameters.pitch_um / 2
    coupling_loss = (
        estimate_neighbour_coupling_loss
        if lens.neighbours is None
        else neighbour_coupling_loss
    )
    return math.hypot(2 * t_error, coupling_loss(lens, radius_um=radius_um).error)


def _rings(lens: Lens, radius_um: float) -> tuple[Array, Array]:
    """(m,) sines by which rings of a lens turn light, and their shares of the area.

    Gauss-Legendre nodes in the squared radius; sine = NA towards the sensor plus
    r / hypot(r, source distance).

    Args:
        lens: the lens.
        radius_um: radius of the aperture, um.
    """
    node, weight = np.polynomial.legendre.leggauss(RINGS)
    radius = radius_um * np.sqrt((node + 1) / 2)
    focus = lens_focus(lens)
    sine = np.array(
        [
            focus.aperture(r) + r / math.hypot(r, lens.source_distance_um)
            for r in radius.tolist()
        ]
    )
    return sine, weight / 2


def angle_change(lens: Lens, incidence_rad: float) -> float:
    """Root mean square relative change of t at an angle, over diameters and
    polarisations.

    |t(angle) - c t(0)|² / |t(angle)|² with the best common factor c: a factor that all
    pillars share changes no PSF of sum 1.

    Args:
        lens: the lens.
        incidence_rad: angle of incidence in air, rad.
    """
    low, high = drawn_diameter_range(lens)
    diameters = np.linspace(low, high, DIAMETERS)
    changes = []
    both: tuple[Literal["s", "p"], ...] = ("s", "p")
    for polarization in both:
        flat, tilted = (
            _transmissions(lens, diameters, angle, polarization)
            for angle in (0.0, incidence_rad)
        )
        common = np.vdot(flat, tilted) / np.vdot(flat, flat)
        residual = np.linalg.norm(tilted - common * flat) ** 2
        changes.append(residual / np.linalg.norm(tilted) ** 2)
    return float(np.sqrt(np.mean(changes)))


def _transmissions(
    lens: Lens, diameters_um: Array, angle_rad: float, polarization: Literal["s", "p"]
) -> Array:
    """(n,) complex t of pillars of the lens's cell by RCWA.

    Args:
        lens: the lens.
        diameters_um: (n,) diameters.
        angle_rad: angle of incidence in air.
        polarization: s or p.
    """
    return np.array(
        [
            rcwa.solve(
                lens.cell,
                diameter_um,
                lens.wavelength_um,
                angle_rad=angle_rad,
                polarization=polarization,
                tolerance=TOLERANCE,
            ).t
            for diameter_um in diameters_um.tolist()
        ]
    )
