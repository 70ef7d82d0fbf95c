"""Marks and labels in pieces of one dose each, small where the backscatter changes
along their edges.
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
# of the tolerance, which backscatter may change along a piece: the rounding of doses
# takes three quarters of it both ways
_CHANGE = 0.4
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


def cut_marks(
    plan: MaskPlan,
    lattices: Sequence[PillarArray],
    area_um2: Array,
    close: PointExposure,
    far: PointExposure,
    tolerance: float,
) -> ExposedMarks:
    """Cut the exposed figures of a plan into pieces of one dose each.

    Rectangles of a figure are divided into cells of an eighth of the narrowest range.
    A cell is halved along its edge, down to a 64th, while the backscatter of the die at
    dose 1 changes there by more than two fifths of the tolerance.
    Neighbours in a row that bound no edge are one piece.

    Args:
        plan: with marks and labels of horizontal and vertical edges.
        lattices: of pillars, in um.
        area_um2: (classes + 1,) of the pillars.
        close: Gaussians that are summed over the shapes.
        far: Gaussians that are summed on nodes.
        tolerance: relative, of the exposure.

    Raises:
        ProcessError: more than 500 000 cells, or a slanted edge.
    """
    step_um = plan.grid * plan.unit_nm * nm
    narrowest_um = float(far.widths_um.min(initial=1e3))
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
    counts = np.maximum(np.ceil(8 * size * step_um / narrowest_um), 1).astype(np.int64)
    cells = counts.prod(1)
    if cells.sum() > MOST_PIECES:
        raise ProcessError(
            f"marks and labels need {cells.sum():,} cells of one dose each, at most "
            f"{MOST_PIECES:,}, for a backscatter range of {narrowest_um:.3g} um; draw "
            "smaller marks (die.mark_um), or set exposure.correct = false"
        )
    start = np.cumsum(cells) - cells
    box = np.repeat(np.arange(len(boxes)), cells)
    place = np.arange(len(box)) - start[box]
    cell = np.stack([place % counts[box, 0], place // counts[box, 0]], -1)
    low, high = (
        boxes[box, :2] + size[box] * edge // counts[box] for edge in (cell, cell + 1)
    )

    widest_um = float(close.widths_um.max(initial=0.0))
    samples = sample_edges(marks, widest_um, min(1.0, narrowest_um / 64))
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

    lattice_boxes = [lattice.box_um for lattice in lattices]
    around = np.array([*lattice_boxes, *(boxes * step_um)])
    die_box = (*around[:, :2].min(0).tolist(), *around[:, 2:].max(0).tolist())
    grid = NodeGrid.over(die_box, narrowest_um)
    middles, areas = (low + high) / 2 * step_um, (high - low).prod(1) * step_um**2
    mass = grid.deposit(*middles.T, areas)[None]
    for lattice in lattices:
        grid.gather(lattice, area_um2[None], mass)
    background = grid.sample(grid.convolution(far)(mass[0]), *samples.at_um.T)

    bounds = np.bincount(cell_of_sample, minlength=len(box)) > 0
    after_edge = np.r_[True, bounds][: len(box)] | (cell[:, 0] == 0)
    inner = np.flatnonzero(~bounds)
    run = np.cumsum(~bounds & after_edge)[inner] - 1
    first, last = (
        inner[np.searchsorted(run, np.unique(run), side=side) - (side == "right")]
        for side in ("left", "right")
    )
    edge_low, edge_high, edge_box = low[bounds], high[bounds], box[bounds]
    cell_of_sample = (np.cumsum(bounds) - 1)[cell_of_sample]
    allowed = _CHANGE * tolerance * THRESHOLD
    values = np.column_stack([background, samples.at_um])
    for _ in range(8):
        least = np.full((len(edge_low), 3), np.inf)
        most = -least
        np.minimum.at(least, cell_of_sample, values)
        np.maximum.at(most, cell_of_sample, values)
        change, along_x, along_y = (most - least).T
        axis = (along_y > along_x).astype(np.int64)  # of the edge in the cell
        each = np.arange(len(axis))
        middle = (edge_low + edge_high)[each, axis] // 2
        is_cut = (change > allowed) & (middle > edge_low[each, axis])
        if not is_cut.any():
            break
        cut, kept = each[is_cut], each[~is_cut]
        is_upper = inside[np.arange(len(inside)), axis[cell_of_sample]]
        is_upper = is_upper >= middle[cell_of_sample]
        new_number = np.empty(len(each), np.int64)
        new_number[np.r_[kept, cut]] = each
        new_cell = new_number[cell_of_sample]
        cell_of_sample = new_cell + len(cut) * (is_cut[cell_of_sample] & is_upper)
        upper_low, lower_high = edge_low[cut], edge_high[cut]
        upper_low[np.arange(len(cut)), axis[cut]] = middle[cut]
        lower_high[np.arange(len(cut)), axis[cut]] = middle[cut]
        edge_low = np.concatenate([edge_low[kept], edge_low[cut], upper_low])
        edge_high = np.concatenate([edge_high[kept], lower_high, edge_high[cut]])
        edge_box = np.concatenate([edge_box[kept], edge_box[cut], edge_box[cut]])

    pieces = np.concatenate(
        [np.hstack([edge_low, edge_high]), np.hstack([low[first], high[last]])]
    )
    piece_of_run = len(edge_low) + np.arange(len(first))
    no_edge = np.r_[
        np.setdiff1d(np.arange(len(edge_low)), cell_of_sample), piece_of_run
    ]
    centres = (pieces[:, :2] + pieces[:, 2:]) / 2 * step_um
    points = np.concatenate([samples.at_um, centres[no_edge]])
    piece = np.r_[cell_of_sample, no_edge]
    own = mean_by_piece(
        exposure_at_edges(points, marks, close.terms), piece, len(pieces)
    )
    own[no_edge] /= 2  # as an edge through their middle would have
    edge_areas = (edge_high - edge_low).prod(1) * step_um**2
    spots = (
        np.concatenate([centres[: len(edge_low)], middles[inner]]),
        np.concatenate([edge_areas, areas[inner]]),
        np.r_[np.arange(len(edge_low)), len(edge_low) + run],
    )
    figure = figure_of_box[np.r_[edge_box, box[first]]]
    figure_numbers = np.array(figures, np.int64).reshape(-1, 2)[figure]
    return ExposedMarks(
        grid, pieces * plan.grid, figure_numbers, own, points, piece, spots
    )
