"""Dose classes: equal steps of the logarithm, one for each pillar and piece, and how
even the edges then are.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.plan import PillarArray
from layout.pec.bodies import NONE, ExposedRectangles, ExposureTable, ScatterRanges
from layout.pec.nodes import NodeGrid, interpolate_from_nodes
from layout.pec.psf import THRESHOLD, PointExposure
from layout.process.jit import compile_loop
from layout.process.process import ExposureSettings
from metalens.core.arrays import Array

_ROUNDED = 0.75  # of the tolerance, for doses rounded to classes
_SOFTEST_UM = 0.7e-3  # that rounded doses may change a width by


@dataclass(frozen=True, eq=False, slots=True)
class ExposedBodies:
    """Everything that is exposed, and the backgrounds of the wanted doses.

    bodies: lattices of pillars.
    table: what each kind of pillar exposes.
    ranges: of the point exposure.
    grid: nodes over the die.
    far: (y, x) background on the nodes.
    near: (rows, columns) of each body, of the middle ranges; empty where there is none.
    rects: pieces of marks.
    own: (pieces,) as in :func:`layout.pec.rects.self_exposure`.
    points, piece: outer edges of the pieces, and whose they are.
    """

    bodies: Sequence[PillarArray]
    table: ExposureTable
    ranges: ScatterRanges
    grid: NodeGrid
    far: Array
    near: Sequence[Array]
    rects: ExposedRectangles
    own: Array
    points: Array
    piece: Array

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

    Args:
        fields: backgrounds of the wanted doses.
        settings: tolerance.
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

    Args:
        ranges: of all dies of a job.
        settings: tolerance, and number of doses.
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

    Args:
        point: narrow terms of the point exposure.
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

    Args:
        fields: backgrounds of the wanted doses.
        number: of the body.
        first: row of the block.
        steps: doses of the job.
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
    fields: ExposedBodies, ladder: DoseLadder
) -> tuple[Array, Array]:
    """The nearest doses of all pillars and pieces.

    Args:
        fields: backgrounds that belong to the wanted doses.
        ladder: doses of the job.

    Returns:
        (entries, doses) number of pillars of each, and (pieces,) dose class of each
        piece of a mark.
    """
    total = np.zeros(len(fields.table.own) * (NONE + 1), np.int64)
    for number, body in enumerate(fields.bodies):
        for first, block in body.blocks():
            chosen = dose_class_map(fields, number, first, block, ladder)
            pairs = block.astype(np.int64) * (NONE + 1) + chosen
            total += np.bincount(pairs.ravel(), minlength=len(total))
    pairs = total.reshape(-1, NONE + 1)[:, : len(ladder.factors)]
    pairs[0] = 0
    return pairs, ladder.nearest(wanted_piece_doses(fields))


def wanted_piece_doses(fields: ExposedBodies) -> Array:
    """(pieces,) doses that give the outer edges of the pieces their exposure.

    Args:
        fields: backgrounds that belong to the wanted doses.
    """
    goal = THRESHOLD * fields.rects.goal
    return np.asarray((goal - fields.of_rects(fields.far)) / fields.own)
