"""Round pillars with a tilted wall or films: coupled waves, put right by the modal
method.

What a truncation of coupled waves gets wrong is the pillar, not what is done with it:
at N orders a disc acts as one a
nanometre or less wider or thinner would, by an amount that changes slowly with its
diameter. The upright pillar
without films is known from the modal method, so

    D -> D + s_N(D)   with   |t_N(D + s) - t(D)|² + |r_N(D + s) - r(D)|²  least over s                         (1)

is solved at a few diameters between foot and top, and every cross-section of the wall
is taken as wide as (1) says. The
answers of four truncations then lie closer together by one order of magnitude, on both
sides of the limit; their mean
is the answer. Its error estimate: the farthest of the four from it, half of what (1)
leaves unexplained, the error
of the modal solves, and that of the collocation along the wall.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Incidence, Response
from metalens.core.arrays import Array
from metalens.rcwa.conditions import DiscCase, check_diameter, disc_case
from metalens.rcwa.solver import largest_error, solve_truncated, wall_stages

REACHES = (4, 5, 6, 7, 8, 9)  # truncations; any four neighbours are compared
COMPARED = 4
NODES = 4  # diameters between foot and top at which (1) is solved
STEPS = 3  # of Gauss and Newton for (1)
STEP_UM = 1e-4
MOST_UM = 0.01  # of a shift: a truncation that wants more knows nothing of this pillar
UNEXPLAINED = 0.5
SHARE = 0.2  # of the tolerance, for the modal solves


@dataclass(frozen=True, eq=False, slots=True)
class ReferencePillars:
    """Upright pillars without films: diameters (k,), (k, 2) t and r, and the largest
    error of them.
    """

    diameter_um: Array
    amplitudes: Array
    error: float


@dataclass(frozen=True, eq=False, slots=True)
class DiameterShift:
    """Solution of (1) at one truncation: polynomial over the nodes, and what it leaves
    unexplained
    of t, root mean square."""

    at: np.polynomial.Polynomial
    left: float

    def __call__(self, diameter_um: Array) -> Array:
        return np.asarray(diameter_um + self.at(diameter_um))


def solve_anchored(
    cell: Cell,
    diameter_um: float,
    light: Incidence,
    upright: list[Response],
    *,
    tolerance: float,
    reaches: tuple[int, ...] = REACHES,
) -> Response:
    """Response of a round pillar with a tilted wall or films.

    upright: of the pillars of :func:`node_diameters`, without films, from the modal
    method.
    reaches: truncations to try, at least four; it ends with the first four neighbours
    that meet the tolerance.

    Raises:
        CellError, MaterialError: as :func:`metalens.rcwa.solve`.
    """
    this, bare = (disc_case(made, light) for made in (cell, upright_cell(cell)))
    nodes = node_diameters(cell, diameter_um)
    anchors = ReferencePillars(
        np.array(nodes),
        np.array([(found.t, found.r) for found in upright]),
        max(found.t_error for found in upright),
    )
    stages, cut = wall_stages(this, np.array([diameter_um]), tolerance)
    found, left = [], []
    for reach in reaches:
        shift = fit_diameter_shift(bare, anchors, reach)
        one = solve_truncated(this, np.array([diameter_um]), reach, stages, moved=shift)
        found.append((one.t[0], one.r[0], one.energy[0]))
        left.append(shift.left)
        if len(found) < COMPARED:
            continue
        last = np.array(found[-COMPARED:])
        t, r, energy = last.mean(axis=0)
        apart = np.abs(last[:, 0] - t).max()
        error = float(
            apart + UNEXPLAINED * np.mean(left[-COMPARED:]) + anchors.error + cut
        )
        if error <= tolerance:
            break
    met = error <= tolerance
    reason = f"orders within {reach}, anchored: estimate {'meets' if met else 'above'} the tolerance {tolerance:.3g}"
    count = int(
        np.count_nonzero(
            np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) <= reach
        )
    )
    error = min(error, float(largest_error(np.array([t, r]))))
    return Response(
        complex(t),
        complex(r),
        error,
        count,
        float(energy.real),
        "anchored",
        met,
        reason,
    )


def upright_cell(cell: Cell) -> Cell:
    """The cell with an upright wall, without films."""
    return dataclasses.replace(cell, sidewall_rad=0.0, under=(), over=())


def node_diameters(cell: Cell, diameter_um: float) -> tuple[float, ...]:
    """Where (1) is solved: Chebyshev points between foot and top, the diameter itself
    where the wall is upright.

    Raises:
        CellError: pillars that overlap, or whose wall closes them.
    """
    check_diameter(cell, diameter_um)
    half = abs(math.tan(cell.sidewall_rad)) * cell.height_um
    if not half:
        return (diameter_um,)
    places = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    return tuple((diameter_um + half * places).tolist())


def fit_diameter_shift(
    bare: DiscCase, anchors: ReferencePillars, reach: int
) -> DiameterShift:
    """(1) at every node."""
    shift = np.zeros_like(anchors.diameter_um)
    for _ in range(STEPS):
        here, there = (
            _amplitudes(bare, anchors.diameter_um + shift + more, reach)
            for more in (0.0, STEP_UM)
        )
        slope, missing = (there - here) / STEP_UM, anchors.amplitudes - here
        move = (slope.conj() * missing).sum(axis=1).real / (np.abs(slope) ** 2).sum(
            axis=1
        )
        shift = np.clip(shift + move, -MOST_UM, MOST_UM)
    left = np.abs(
        anchors.amplitudes - _amplitudes(bare, anchors.diameter_um + shift, reach)
    )[:, 0]
    degree = len(shift) - 1
    at = (
        np.polynomial.Polynomial.fit(anchors.diameter_um, shift, degree)
        if degree
        else np.polynomial.Polynomial(shift)
    )
    return DiameterShift(at, float(np.sqrt((left**2).mean())))


def _amplitudes(bare: DiscCase, diameter_um: Array, reach: int) -> Array:
    found = solve_truncated(bare, diameter_um, reach)
    return np.stack([found.t, found.r], axis=1)
