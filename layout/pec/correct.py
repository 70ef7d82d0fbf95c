"""Proximity correction: a dose for each shape, so that all edges receive the exposure
that clears the resist.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.plan import PillarArray
from layout.pec import assign, bodies, psf, rects
from layout.pec.assign import DoseLadder
from layout.pec.bodies import ExposedRectangles, ExposureTable, ScatterRanges
from layout.pec.drawn import DrawnKinds
from layout.pec.fracture import fracture_boxes
from layout.pec.nodes import (
    NodeGrid,
    RadialConvolution,
    gather_to_nodes,
    gaussian_convolution,
    interpolate_from_nodes,
)
from layout.pec.psf import THRESHOLD, PointExposure
from layout.process.process import ExposureSettings
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

_MOST_SITES = 40_000_000  # of a lattice with a middle range
_SPOTS = 10  # of a piece on the nodes, along the same


@dataclass(frozen=True, eq=False, slots=True)
class DoseSolution:
    """Doses of everything on a die.

    ladder: the doses.
    needed: number of doses that the tolerance needs; the writer may hold fewer.
    pairs: (entries, doses) pillars of each, over all bodies.
    rect_class: (n,) dose class of each piece of a mark.
    point: point exposure that was used.
    """

    ladder: DoseLadder
    needed: int
    pairs: Array
    rect_class: Array
    point: PointExposure
    _fields: assign.ExposedBodies

    def classes(self, number: int, first: int, block: Array) -> Array:
        """(rows, columns) uint8 dose class of the pillars of a block of body
        ``number``, 255 where there is none.
        """
        return assign.dose_class_map(self._fields, number, first, block, self.ladder)


@dataclass(frozen=True, eq=False, slots=True)
class WantedDoses:
    """Doses that give every edge its exposure, before they are rounded to classes.

    fields: backgrounds that belong to them. range: what they need of a ladder.
    """

    fields: assign.ExposedBodies
    range: assign.DoseRange
    point: PointExposure


def solve_doses(
    parts: Sequence[PillarArray],
    kinds: DrawnKinds,
    goal: Array,
    settings: ExposureSettings,
    *,
    cut: ExposedRectangles | None = None,
) -> WantedDoses:
    """The wanted doses of pillars and rectangles that are exposed together.

    Args:
        parts: lattices; the first is the lens, over which uniformity is told.
        kinds, goal: (entries,) of the table, entry 0 for none.
        cut: rectangles along whose outer sides the background hardly changes
            (:func:`fracture_boxes`).
        settings: point exposure and tolerance.

    Raises:
        ProcessError: no pillar; no or an unreadable point exposure; pillars finer than
            its core; a lens too large for a middle range of the point exposure.
    """
    point = psf.point_exposure(settings)
    number = bodies.count_pillars(parts, len(goal))
    densest = min(parts, key=lambda body: body.nearest_um)
    ranges = bodies.split_ranges(point, kinds, number, densest)
    drawn = bodies.exposure_table(
        kinds, goal, number, point=point, ranges=ranges, body=densest
    )
    fields = _fields(parts, drawn, ranges, cut or ExposedRectangles.none())
    return WantedDoses(fields, assign.dose_range(fields, settings), point)


def round_doses(wanted: WantedDoses, ladder: DoseLadder, needed: int) -> DoseSolution:
    """Every wanted dose rounded to the nearest of a ladder.

    Args:
        wanted: of one die.
        ladder: of :func:`layout.pec.assign.dose_ladder`, for all that is written in one
            job.
        needed: number of doses that its tolerance needs.
    """
    pairs, rect_class = assign.assign_dose_classes(wanted.fields, ladder)
    return DoseSolution(ladder, needed, pairs, rect_class, wanted.point, wanted.fields)


def fracture_by_surroundings(
    boxes: Array,
    parts: Sequence[PillarArray],
    settings: ExposureSettings,
    *,
    step_um: float,
) -> tuple[Array, Array]:
    """Boxes (n, 4) in steps of ``step_um`` cut to pieces of one dose each: (m, 4) and
    (m,) the box of each.

    Args:
        boxes: whole grid steps.
        parts: lattices of pillars.
        settings: point exposure and tolerance.

    Raises:
        ProcessError: too many pieces.
    """
    around = np.array([body.box_um for body in parts])
    point = psf.point_exposure(settings)
    most = min(settings.tolerance, assign.straight_edge_error(point))
    return fracture_boxes(boxes, around, step_um=step_um, point=point, tolerance=most)


def _box(
    parts: Sequence[PillarArray], cut: ExposedRectangles
) -> tuple[float, float, float, float]:
    boxes = np.array([*(body.box_um for body in parts), *cut.box_um])
    return *boxes[:, :2].min(0).tolist(), *boxes[:, 2:].max(0).tolist()


def _fields(
    parts: Sequence[PillarArray],
    drawn: ExposureTable,
    ranges: ScatterRanges,
    cut: ExposedRectangles,
) -> assign.ExposedBodies:
    """Backgrounds that belong to the wanted doses."""
    width = float(ranges.far.widths_um.min()) if len(ranges.far.widths_um) else 1e3
    grid = NodeGrid.over(_box(parts, cut), width)
    beside = PointExposure(
        np.r_[ranges.near.widths_um, ranges.middle.widths_um],
        np.r_[ranges.near.weights, ranges.middle.weights],
    )
    own, points, piece = rects.self_exposure(cut, beside)
    pads = _Pads(
        cut, own, (points, piece), rects.rectangle_samples(cut, width / _SPOTS), grid
    )
    masses = _masses(parts, drawn, grid)
    spacing = grid.y.spacing_um, grid.x.spacing_um
    reach = gaussian_convolution(grid.shape, spacing, point=ranges.far, hollow=False)
    middles = (
        [middle_convolution(body, ranges) for body in parts]
        if len(ranges.middle.widths_um)
        else []
    )
    field, near = _backgrounds(parts, drawn, grid, reach, masses, middles, pads)
    return assign.ExposedBodies(
        parts, drawn, ranges, grid, field, near, cut, own, points, piece
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Pads:
    """Pieces of marks as masses on the nodes; the dose of each is the one that its
    outer edges need.

    own: (pieces,) exposure by its shape at unit dose; edges: points (n, 2), and the
    piece of each; spots: points,
    areas and pieces that stand for them.
    """

    rects: ExposedRectangles
    own: Array
    edges: tuple[Array, Array]
    spots: tuple[Array, Array, Array]
    grid: NodeGrid

    def deposited(self, dose: Array) -> Array:
        """(y, x) masses of doses (pieces,)."""
        points, area, of = self.spots
        return self.grid.deposit(points[:, 0], points[:, 1], area * dose[of])

    def wanted(self, field: Array) -> Array:
        """(y, x) masses of the doses that a background (y, x) asks for."""
        if not len(self.own):
            return np.zeros(self.grid.shape)
        points, piece = self.edges
        number = np.bincount(piece, minlength=len(self.own))
        around = (
            np.bincount(
                piece, self.grid.sample(field, *points.T), minlength=len(self.own)
            )
            / number
        )
        return self.deposited((THRESHOLD * self.rects.goal - around) / self.own)


def _masses(
    parts: Sequence[PillarArray], drawn: ExposureTable, grid: NodeGrid
) -> tuple[Array, Array]:
    """Node sums of area / own, and goal area / own."""
    value = np.stack([drawn.per_own, drawn.per_own * drawn.goal])
    out = np.zeros((2, *grid.shape))
    for body in parts:
        xn, xw = grid.x.at(body.columns_um)
        for first, block in body.blocks():
            yn, yw = grid.y.at(body.rows_um(first, len(block)))
            gather_to_nodes(block, value, yn, yw, xn, xw, out)
    return out[0], out[1]


def middle_convolution(body: PillarArray, ranges: ScatterRanges) -> RadialConvolution:
    """Convolution on the sites of a lattice with the Gaussians that reach neighbours
    only.

    Args:
        body: lattice of pillars.
        ranges: point exposure by reach.
    """
    if body.rows * body.columns > _MOST_SITES:
        raise ProcessError(
            f"a lens of {body.rows} x {body.columns} sites with a point exposure that holds Gaussians of "
            f"{np.array2string(ranges.middle.widths_um, precision=3)} um: such middle ranges are corrected on at most "
            f"{_MOST_SITES:,} sites; give a point exposure of core and backscatter alone"
        )
    return gaussian_convolution(
        (body.rows, body.columns),
        (body.down_um, body.pitch_um),
        point=ranges.middle,
        hollow=True,
    )


def _backgrounds(
    parts: Sequence[PillarArray],
    drawn: ExposureTable,
    grid: NodeGrid,
    reach: RadialConvolution,
    masses: tuple[Array, Array],
    middles: Sequence[RadialConvolution],
    pads: _Pads,
) -> tuple[Array, list[Array]]:
    """Far field on the nodes and middle field on the sites that belong to the wanted
    doses, in turn until they rest.
    """
    wanted, goal = masses
    field = _relaxed(reach, wanted, THRESHOLD * goal, pads=pads)
    near: list[Array] = []
    for _ in range(12 if middles else 0):
        near, taken = [], np.zeros(grid.shape)
        for body, middle in zip(parts, middles, strict=True):
            index = np.concatenate([block for _, block in body.blocks()])
            xn, xw = grid.x.at(body.columns_um)
            yn, yw = grid.y.at(body.rows_um(0, body.rows))
            far = np.empty(index.shape, np.float32)
            interpolate_from_nodes(field, yn, yw, xn, xw, far)
            mass = drawn.per_own.take(index)
            own = _relaxed(
                middle,
                mass,
                (THRESHOLD * drawn.goal.take(index) - far) * mass,
                bound_below=0.9,
            )
            near.append(own.astype(np.float32))
            rows, columns = np.nonzero(index)
            x, y = body.columns_um[columns], body.rows_um(0, body.rows)[rows]
            taken += grid.deposit(x, y, (own * mass)[rows, columns])
        before, field = (
            field,
            _relaxed(reach, wanted, THRESHOLD * goal - taken, pads=pads),
        )
        if np.abs(field - before).max() < 1e-7:
            break
    return field, near


def _relaxed(
    reach: RadialConvolution,
    mass: Array,
    drive: Array,
    *,
    bound_below: float = 0.0,
    pads: _Pads | None = None,
) -> Array:
    """B = K * [drive - B mass + pads(B)], to 1e-8; eigenvalues of K * mass lie between
    -bound_below and the largest
    row sum.
    """
    all_mass = mass if pads is None else mass + pads.deposited(1 / pads.own)
    bound = float(reach(all_mass).max())
    step = 2 / (2 + bound - bound_below)
    rate = max(1 - step * (1 - bound_below), step * (1 + bound) - 1, 1e-3)
    field = np.zeros_like(mass)
    for _ in range(int(np.ceil(np.log(1e-8) / np.log(rate)))):
        given = drive - field * mass
        change = reach(given if pads is None else given + pads.wanted(field)) - field
        field += step * change
        if np.abs(change).max() < 1e-9:
            break
    return field
