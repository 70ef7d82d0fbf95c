"""Marks and labels in pieces of one dose each: cells so short that the backscatter
hardly changes along them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.plan import EXPOSED, MaskPlan, PillarArray
from layout.pec.nodes import NodeGrid
from layout.pec.polygon_edges import ExposedPolygons, exposure_at_edges, sample_edges
from layout.pec.psf import THRESHOLD, PointExposure
from layout.shapes import rectilinear
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm

MOST_PIECES = 500_000
_INWARD = 0.1  # grid steps, from an edge to a place in the cell that it bounds


@dataclass(frozen=True, eq=False, slots=True)
class ExposedMarks:
    """Marks and labels in pieces of one dose each, as masses on the nodes of a die.

    grid: nodes over lattices and marks.
    boxes: (pieces, 4) left, bottom, right, top, database units.
    figure: (pieces, 2) number of the figure, and of the layer in it.
    own: (pieces,) exposure of the edges by the close Gaussians of all marks of dose 1.
    points: (n, 2) points on the edges, um; piece: (n,) piece of each.
    spots: (m, 2) points that represent the pieces on the nodes, um, their areas (m,) in
        um^2, and the piece of each (m,).
    """

    grid: NodeGrid
    boxes: Array
    figure: Array
    own: Array
    points: Array
    piece: Array
    spots: tuple[Array, Array, Array]

    def deposited(self, dose: Array) -> Array:
        """(y, x) masses of doses (pieces,)."""
        points, area, piece = self.spots
        return self.grid.deposit(*points.T, area * dose[piece])

    def doses(self, field: Array) -> Array:
        """(pieces,) doses that give the edges their exposure on a background.

        dose = (THRESHOLD - mean background over the points of the piece) / own.

        Args:
            field: (y, x) background on the nodes.
        """
        background = self.grid.sample(field, *self.points.T)
        mean = mean_by_piece(background, self.piece, len(self.own))
        return np.asarray((THRESHOLD - mean) / self.own)


def mean_by_piece(values: Array, piece: Array, count: int) -> Array:
    """(count,) mean of the values (n,) of each piece, whose numbers are ``piece``."""
    total = np.bincount(piece, values, minlength=count)
    return np.asarray(total / np.bincount(piece, minlength=count))


def cell_side_um(far: PointExposure, tolerance: float) -> float:
    """Length along which the backscatter of wide shapes changes by the tolerance.

    At the corner of a quadrant the exposure along the edge changes by the sum of
    weights / (2 sqrt(pi) widths) per um, more than along any other edge.

    Args:
        far: Gaussians that are summed on nodes.
        tolerance: relative, of the exposure.
    """
    steepest = float((far.weights / far.widths_um).sum()) / (2 * np.sqrt(np.pi))
    change = tolerance * THRESHOLD / max(steepest, 1e-12)
    return min(change, float(far.widths_um.min(initial=np.inf)) / 8)


def cut_marks(
    plan: MaskPlan,
    lattices: Sequence[PillarArray],
    close: PointExposure,
    far: PointExposure,
    tolerance: float,
) -> ExposedMarks:
    """Cut the exposed figures of a plan into pieces of one dose each.

    Rectangles of a figure are divided into equal cells of at most
    :func:`cell_side_um`. Neighbours in a row that bound no edge are one piece.

    Args:
        plan: with marks and labels of horizontal and vertical edges.
        lattices: of pillars, in um.
        close: Gaussians that are summed over the shapes.
        far: Gaussians that are summed on nodes.
        tolerance: relative, of the exposure.

    Raises:
        ProcessError: more than 500 000 cells, or a slanted edge.
    """
    step_um = plan.grid * plan.unit_nm * nm
    side_um = cell_side_um(far, tolerance)
    drawn = [
        ((number, layer), polygon)
        for number, figure in enumerate(plan.figures)
        for layer, polygons in enumerate(figure.polygons.values())
        for polygon in polygons
        if figure.name in EXPOSED
    ]
    figures = sorted({figure for figure, _ in drawn})
    rectangles = [rectilinear.split_rectilinear(polygon) for _, polygon in drawn]
    boxes = np.concatenate([np.empty((0, 4), np.int64), *rectangles]) // plan.grid
    index = np.array([figures.index(figure) for figure, _ in drawn], np.int64)
    figure_of_box = np.repeat(index, [len(each) for each in rectangles])
    corners_um = [polygon * plan.unit_nm * nm for _, polygon in drawn]
    marks = ExposedPolygons(corners_um, np.ones(len(drawn)), index)

    size = boxes[:, 2:] - boxes[:, :2]
    counts = np.maximum(np.ceil(size * step_um / side_um), 1).astype(np.int64)
    cells = counts.prod(1)
    if cells.sum() > MOST_PIECES:
        raise ProcessError(
            f"marks and labels need {cells.sum():,} cells of one dose each, at most "
            f"{MOST_PIECES:,}, for backscatter that changes within {side_um:.3g} um; "
            "draw smaller marks (die.mark_um), or set exposure.correct = false"
        )
    start = np.cumsum(cells) - cells
    box = np.repeat(np.arange(len(boxes)), cells)
    place = np.arange(len(box)) - start[box]
    cell = np.stack([place % counts[box, 0], place // counts[box, 0]], -1)
    low, high = (
        boxes[box, :2] + size[box] * edge // counts[box] for edge in (cell, cell + 1)
    )

    samples = sample_edges(
        marks, float(close.widths_um.max(initial=0.0)), min(1.0, side_um / 2)
    )
    inside = samples.at_um / step_um - _INWARD * samples.normal
    box_of_sample = np.empty(len(inside), np.int64)
    for number in range(len(figures)):
        of_figure = samples.layer == number
        members = np.flatnonzero(figure_of_box == number)
        at = inside[of_figure, None]
        holds = ((boxes[members, :2] <= at) & (at < boxes[members, 2:])).all(2)
        box_of_sample[of_figure] = members[holds.argmax(1)]
    steps = np.floor(inside).astype(np.int64) - boxes[box_of_sample, :2]
    column, row = ((counts[box_of_sample] * (steps + 1) - 1) // size[box_of_sample]).T
    cell_of_sample = start[box_of_sample] + row * counts[box_of_sample, 0] + column

    bounds = np.bincount(cell_of_sample, minlength=len(box)) > 0
    begins = bounds | np.r_[True, bounds][: len(box)] | (cell[:, 0] == 0)
    piece = np.cumsum(begins) - 1
    first = np.flatnonzero(begins)
    last = np.r_[first[1:], len(box)][: len(first)] - 1
    pieces = np.hstack([low[first], high[last]])
    inner = np.flatnonzero(~bounds[first])
    points = np.concatenate(
        [samples.at_um, (pieces[inner, :2] + pieces[inner, 2:]) / 2 * step_um]
    )
    piece_of_point = np.r_[piece[cell_of_sample], inner]
    own = mean_by_piece(
        exposure_at_edges(points, marks, close.terms), piece_of_point, len(pieces)
    )
    own[inner] /= 2  # as an edge through their middle would have

    lattice_boxes = [lattice.box_um for lattice in lattices]
    around = np.array([*lattice_boxes, *(boxes * step_um)])
    die_box = (*around[:, :2].min(0).tolist(), *around[:, 2:].max(0).tolist())
    spots = (low + high) / 2 * step_um, (high - low).prod(1) * step_um**2, piece
    return ExposedMarks(
        NodeGrid.over(die_box, float(far.widths_um.min(initial=1e3))),
        pieces * plan.grid,
        np.array(figures, np.int64).reshape(-1, 2)[figure_of_box[box[first]]],
        own,
        points,
        piece_of_point,
        spots,
    )
