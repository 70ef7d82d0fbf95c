"""Dose classes: equal steps of the logarithm, one for each pillar and piece, and how
even the edges then are.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.plan import PillarArray
from layout.pec.bodies import NONE, ExposedRectangles, ExposureTable, ScatterRanges
from layout.pec.nodes import NodeGrid, RadialConvolution, interpolate_from_nodes
from layout.pec.psf import THRESHOLD, PointExposure
from layout.pec.uniformity import DoseUniformity, ErrorTally
from layout.process.jit import compile_loop
from layout.process.process import ExposureSettings
from metalens.core.arrays import Array

_NOTHING = np.zeros((0, 0), np.float32)
_ROUNDED = 0.75  # of the tolerance, for doses rounded to classes
_SOFTEST_UM = 0.7e-3  # that rounded doses may change a width by


@dataclass(frozen=True, eq=False, slots=True)
class ExposedBodies:
    """Everything that is exposed, and its backgrounds.

    far: (y, x) on the nodes with the wanted doses; alone: with dose 1. near,
    near_alone: (rows, columns) for each
    body, the middle ranges; empty lists where there is none.
    own: (pieces,) as in :func:`layout.pec.rects.self_exposure`; points, piece: outer
    edges of
    the pieces and whose they are.
    spots: points, areas and pieces that stand for the rectangles on the nodes.
    """

    bodies: Sequence[PillarArray]
    table: ExposureTable
    ranges: ScatterRanges
    grid: NodeGrid
    reach: RadialConvolution
    middles: Sequence[RadialConvolution]
    far: Array
    alone: Array
    near: Sequence[Array]
    near_alone: Sequence[Array]
    rects: ExposedRectangles
    own: Array
    points: Array
    piece: Array
    spots: tuple[Array, Array, Array]

    def at(
        self, field: Array, number: int, first: int, count: int, near: Sequence[Array]
    ) -> Array:
        """(rows, columns) float32 background at the sites of rows of a body."""
        body = self.bodies[number]
        out = np.empty((count, body.columns), np.float32)
        interpolate_from_nodes(
            field,
            *self.grid.y.at(body.rows_um(first, count)),
            *self.grid.x.at(body.columns_um),
            out,
        )
        return (
            np.asarray(out + near[number][first : first + count]) if len(near) else out
        )

    def of_rects(self, field: Array) -> Array:
        """(pieces,) mean background at the outer edges."""
        if not len(self.own):
            return np.empty(0)
        value = self.grid.sample(field, *self.points.T)
        total = np.bincount(self.piece, value, minlength=len(self.own))
        return np.asarray(total / np.bincount(self.piece, minlength=len(self.own)))


@dataclass(frozen=True, eq=False, slots=True)
class DoseLadder:
    """(doses,) relative doses, rising, in equal steps of the logarithm."""

    factors: Array

    @property
    def per_log(self) -> float:
        """Steps for a factor e."""
        span = float(np.log(self.factors[-1] / self.factors[0]))
        return (len(self.factors) - 1) / span if span > 0 else 0.0

    def nearest(self, dose: Array) -> Array:
        """Class of the nearest dose."""
        level = np.rint(np.log(np.maximum(dose, 1e-9) / self.factors[0]) * self.per_log)
        return np.asarray(np.clip(level, 0, len(self.factors) - 1), np.uint8)


@dataclass(frozen=True, eq=False, slots=True)
class AssignedDoses:
    """Uniformity over the first body, worst error over everything, the far and middle
    fields of the rounded doses.
    """

    before: DoseUniformity
    after: DoseUniformity
    worst: float
    far: Array
    near: Sequence[Array]


@dataclass(frozen=True, slots=True)
class DoseRange:
    """What some shapes need of the doses.

    least, most: relative doses. share: the largest share of the edge's exposure that
    rounded doses change, over the relative error that is allowed there.
    """

    least: float
    most: float
    share: float


def dose_range(fields: ExposedBodies, settings: ExposureSettings) -> DoseRange:
    """The doses that pillars and pieces want, and how finely they must be met.

    Where the edge is so soft that the tolerance moves it by more than a nanometre of
    width, as much finer steps are needed.
    """
    span = np.array(
        [np.inf, 0.0, 0.0]
    )  # least and most dose, largest log step that is the other way round
    t, most = fields.table, settings.tolerance
    for number, body in enumerate(fields.bodies):
        for first, block in body.blocks():
            field = fields.at(fields.far, number, first, len(block), fields.near)
            _span(
                block,
                field,
                t.own,
                THRESHOLD * t.goal,
                _SOFTEST_UM * t.slope / 2,
                most,
                span,
            )
    if len(fields.own):
        goal = THRESHOLD * fields.rects.goal
        left = goal - fields.of_rects(fields.far)
        dose = left / fields.own
        rise = (
            fields.ranges.near
            if len(fields.ranges.near.widths_um)
            else fields.ranges.middle
        )
        allowed = np.minimum(most, straight_edge_error(rise) * dose / fields.rects.goal)
        span = np.array(
            [
                min(span[0], dose.min()),
                max(span[1], dose.max()),
                max(span[2], (left / goal / allowed).max()),
            ]
        )
    return DoseRange(*span.tolist())


def dose_ladder(
    ranges: Sequence[DoseRange], settings: ExposureSettings
) -> tuple[DoseLadder, int]:
    """The doses of a job (at most ``maximum_classes``), and how many its tolerance
    needs.

    A quarter of the tolerance is left for the background of rounded doses and for what
    changes across a piece of a mark.
    """
    least = min(one.least for one in ranges)
    span = max(one.most for one in ranges) / least
    step = 2 * np.log1p(_ROUNDED / max(one.share for one in ranges))
    needed = max(1, int(np.ceil(np.log(span) / step - 1e-9)))
    count = min(needed, settings.maximum_classes)
    return DoseLadder(least * span ** ((np.arange(count) + 0.5) / count)), needed


def straight_edge_error(point: PointExposure) -> float:
    """Relative error of the exposure that moves both edges of a line of dose 1 by what
    rounded doses may.
    """
    steep = float((point.weights / point.widths_um).sum()) / np.sqrt(np.pi)
    return float(_SOFTEST_UM * steep / 2 / THRESHOLD)


@compile_loop
def _span(
    block: Array,
    field: Array,
    own: Array,
    goal: Array,
    soft: Array,
    most: float,
    span: Array,
) -> None:
    for row in range(block.shape[0]):
        for column in range(block.shape[1]):
            k = block[row, column]
            if k:
                left = goal[k] - field[row, column]
                dose = left / own[k]
                span[0] = min(span[0], dose)
                span[1] = max(span[1], dose)
                span[2] = max(
                    span[2], left / goal[k] / min(most, soft[k] * dose / goal[k])
                )


def dose_class_map(
    fields: ExposedBodies, number: int, first: int, block: Array, steps: DoseLadder
) -> Array:
    """(rows, columns) uint8 dose class of the pillars of a block, 255 where there is
    none.
    """
    t, out = fields.table, np.empty(block.shape, np.uint8)
    field = fields.at(fields.far, number, first, len(block), fields.near)
    shift = np.log(np.where(t.used, t.own, 1.0) * steps.factors[0])
    _classes(
        block, field, shift, THRESHOLD * t.goal, steps.per_log, len(steps.factors), out
    )
    return out


@compile_loop
def _classes(
    block: Array,
    field: Array,
    shift: Array,
    goal: Array,
    per_log: float,
    count: int,
    out: Array,
) -> None:
    for row in range(block.shape[0]):
        for column in range(block.shape[1]):
            k = block[row, column]
            if k == 0:
                out[row, column] = 255
                continue
            left = max(goal[k] - field[row, column], 1e-9)
            level = np.rint((np.log(left) - shift[k]) * per_log)
            out[row, column] = min(max(level, 0.0), count - 1.0)


def assign_dose_classes(
    fields: ExposedBodies, steps: DoseLadder
) -> tuple[Array, Array, AssignedDoses]:
    """((entries, doses) pillars, (pieces,) class, outcome) of the nearest doses, over
    everything.
    """
    t, mass = fields.table, np.zeros(fields.grid.shape)
    pairs = np.zeros((len(t.own), NONE + 1), np.int64)
    dose = np.zeros(NONE + 1)
    dose[: len(steps.factors)] = steps.factors
    mean = _mean_edge(fields)
    tallies = [
        ErrorTally() for _ in range(3)
    ]  # first body with dose 1, first body, the others
    given: list[Array] = []
    for number, body in enumerate(fields.bodies):
        xn, xw = fields.grid.x.at(body.columns_um)
        given.append(
            np.zeros(
                (body.rows, body.columns) if len(fields.near) else (0, 0), np.float32
            )
        )
        for first, block in body.blocks():
            chosen = dose_class_map(fields, number, first, block, steps)
            field = fields.at(fields.far, number, first, len(block), fields.near)
            yn, yw = fields.grid.y.at(body.rows_um(first, len(block)))
            ends = np.zeros((2, 4))
            ends[:, 0], ends[:, 1] = np.inf, -np.inf
            alone = (
                fields.at(fields.alone, number, first, len(block), fields.near_alone)
                if not number
                else _NOTHING
            )
            tables = np.stack([t.own, t.area_um2, THRESHOLD * t.goal])
            _take(
                block,
                chosen,
                field,
                alone,
                tables,
                dose,
                mean,
                ends,
                pairs,
                yn,
                yw,
                xn,
                xw,
                mass,
            )
            if len(fields.near):
                given[number][first : first + len(block)] = t.area_um2.take(
                    block
                ) * dose.take(chosen)
            for tally, row in (
                (tallies[1 if not number else 2], ends[0]),
                (tallies[0], ends[1]),
            ):
                tally.merge(row)
    own_class = steps.nearest(
        (THRESHOLD * fields.rects.goal - fields.of_rects(fields.far)) / fields.own
    )
    worst_rect = _rect_error(fields, own_class, dose, mass)
    after = fields.reach(mass)
    inside = fields.alone > 1e-3 * fields.alone.max()
    shift = float(np.abs(after - fields.far)[inside].max(initial=0))
    near = [middle(own) for middle, own in zip(fields.middles, given, strict=False)]
    shift += max(
        (
            float(np.abs(a - b)[m > 0].max(initial=0))
            for a, b, m in zip(near, fields.near, given, strict=False)
        ),
        default=0,
    )
    shift /= THRESHOLD * float(t.goal[t.used].min())
    gentle = float(t.slope[t.used].min())
    before = tallies[0].result(gentle / mean, 0.0)
    found = tallies[1].result(gentle * float(steps.factors[0]) / THRESHOLD, shift)
    worst = max(found.worst, tallies[2].worst + shift, worst_rect + shift)
    return (
        pairs[:, : len(steps.factors)],
        own_class,
        AssignedDoses(before, found, worst, after, near),
    )


def _mean_edge(fields: ExposedBodies) -> float:
    """Mean exposure of the edges of the first body with dose 1, by area."""
    t, body = fields.table, fields.bodies[0]
    total = weight = 0.0
    for first, block in body.blocks():
        field = fields.at(fields.alone, 0, first, len(block), fields.near_alone)
        area = t.area_um2.take(block)
        total += float((area * (t.own.take(block) + field)).sum())
        weight += float(area.sum())
    return total / weight


@compile_loop
def _take(
    block: Array,
    chosen: Array,
    field: Array,
    alone: Array,
    tables: Array,
    dose: Array,
    mean: float,
    ends: Array,
    pairs: Array,
    yn: Array,
    yw: Array,
    xn: Array,
    xw: Array,
    out: Array,
) -> None:
    """Relative errors into ``ends`` (least, most, squares, count; with the doses and
    with dose 1), masses to nodes.
    """
    line, single = np.zeros(out.shape[1]), alone.shape[0] > 0
    for row in range(block.shape[0]):
        line[:] = 0
        for column in range(block.shape[1]):
            k = block[row, column]
            if k == 0:
                continue
            level = chosen[row, column]
            pairs[k, level] += 1
            given = dose[level]
            off = (given * tables[0, k] + field[row, column]) / tables[2, k] - 1
            ends[0, 0], ends[0, 1] = min(ends[0, 0], off), max(ends[0, 1], off)
            ends[0, 2] += off * off
            ends[0, 3] += 1
            if single:
                off = (tables[0, k] + alone[row, column]) / mean - 1
                ends[1, 0], ends[1, 1] = min(ends[1, 0], off), max(ends[1, 1], off)
                ends[1, 2] += off * off
                ends[1, 3] += 1
            for j in range(4):
                line[xn[column] + j] += given * tables[1, k] * xw[column, j]
        for i in range(4):
            for node in range(out.shape[1]):
                out[yn[row] + i, node] += yw[row, i] * line[node]


def _rect_error(
    fields: ExposedBodies, own_class: Array, dose: Array, mass: Array
) -> float:
    """Worst relative error over the outer edges of the pieces; their masses are added
    to the nodes.
    """
    if not len(own_class):
        return 0.0
    spots, area, of = fields.spots
    mass += fields.grid.deposit(spots[:, 0], spots[:, 1], area * dose[own_class[of]])
    background = fields.grid.sample(fields.far, *fields.points.T)
    edge = (dose[own_class] * fields.own)[fields.piece] + background
    return float(np.abs(edge / (THRESHOLD * fields.rects.goal[fields.piece]) - 1).max())
