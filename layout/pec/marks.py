"""Marks and labels in pieces of one dose each, small where the backscatter changes
along their edges.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.plan import EXPOSED, MaskPlan, PillarArray
from layout.pec.bodies import ScatterRanges
from layout.pec.nodes import NodeGrid
from layout.pec.polygon_edges import ExposedPolygons, exposure_at_edges, sample_edges
from layout.pec.psf import THRESHOLD, PointExposure
from layout.shapes import rectilinear
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm

MOST_CELLS = 500_000
# of the tolerance, which backscatter may change along a piece: the rounding of doses
# takes three quarters of it both ways
CHANGE = 0.4
_INWARD = 0.1  # grid steps, from an edge to a place in the cell that it bounds


@dataclass(frozen=True, eq=False)
class ExposedMarks:
    """Marks and labels in pieces of one dose each, as masses on the nodes of a die.

    grid: nodes over lattices and marks.
    boxes: (pieces, 4) left, bottom, right, top, database units.
    figure: (pieces, 2) number of the figure, and of the layer in it.
    own: (pieces,) exposure of the edges by the close Gaussians of all marks of dose 1.
    points: (n, 2) points on the edges, um; piece: (n,) piece of each.
    middles, areas: (pieces, 2) um and (pieces,) um^2, which represent the pieces on the
        nodes.
    """

    grid: NodeGrid
    boxes: Array
    figure: Array
    own: Array
    points: Array
    piece: Array
    middles: Array
    areas: Array

    def deposited(self, dose: Array) -> Array:
        """(y, x) masses of doses (pieces,)."""
        x, y = self.middles.T
        return self.grid.deposit(x, y, self.areas * dose)

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
    """(count,) mean of the values (n,) of each piece; 0 for a piece without values."""
    total = np.bincount(piece, values, minlength=count)
    return np.asarray(total / np.maximum(np.bincount(piece, minlength=count), 1))


def cut_marks(
    plan: MaskPlan,
    lattices: Sequence[PillarArray],
    area_um2: Array,
    ranges: ScatterRanges,
    tolerance: float,
) -> ExposedMarks:
    """Cut the exposed figures of a plan into pieces of one dose each.

    Rectangles of a figure are divided into cells of an eighth of the narrowest range.
    A cell is halved along its edge, down to a 64th, while the backscatter of the die at
    dose 1 changes there by more than two fifths of the tolerance.

    Args:
        plan: with marks and labels of horizontal and vertical edges.
        lattices: of pillars, in um.
        area_um2: (classes + 1,) of the pillars.
        ranges: Gaussians that are summed over the shapes, and those on nodes.
        tolerance: relative, of the exposure.

    Raises:
        ProcessError: more than 500 000 cells, or a slanted edge.
    """
    step_um = plan.grid * plan.unit_nm * nm
    close, far = ranges.close, ranges.far
    narrowest_um = float(far.widths_um.min(initial=1e3))
    drawn = [
        ((number, layer), polygon)
        for number, figure in enumerate(plan.figures)
        for layer, polygons in enumerate(figure.polygons.values())
        for polygon in polygons
        if figure.name in EXPOSED
    ]
    figures = sorted({figure for figure, _ in drawn})
    figure_of_polygon = np.array([figures.index(figure) for figure, _ in drawn], int)
    corners_um = [polygon * plan.unit_nm * nm for _, polygon in drawn]
    marks = ExposedPolygons(corners_um, np.ones(len(drawn)), figure_of_polygon)
    split = [rectilinear.split_rectilinear(polygon) for _, polygon in drawn]
    boxes = np.concatenate([np.empty((0, 4), np.int64), *split]) // plan.grid
    figure_of_box = np.repeat(figure_of_polygon, [len(each) for each in split])
    lattice_boxes = [lattice.box_um for lattice in lattices]
    around = np.array([*lattice_boxes, *(boxes * step_um)])
    die_box = (*around[:, :2].min(0).tolist(), *around[:, 2:].max(0).tolist())
    grid = NodeGrid.over(die_box, narrowest_um)

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
    cells, box, cell_of_sample = _divide(
        boxes, narrowest_um / 8 / step_um, inside, box_of_sample
    )
    middles, areas = _middles(cells, step_um)
    mass = grid.deposit(middles[:, 0], middles[:, 1], areas)[None]
    for lattice in lattices:
        grid.gather(lattice, area_um2[None], mass)
    background = grid.sample(grid.convolution(far)(mass[0]), *samples.at_um.T)
    cells, parent, cell_of_sample = _halve(
        cells, cell_of_sample, inside, background, CHANGE * tolerance * THRESHOLD
    )

    exposed = expose_pieces(
        grid, *_middles(cells, step_um), (samples.at_um, cell_of_sample), marks, close
    )
    boxes = cells * plan.grid
    figure = np.array(figures, int).reshape(-1, 2)[figure_of_box[box[parent]]]
    return dataclasses.replace(exposed, boxes=boxes, figure=figure)


def expose_pieces(
    grid: NodeGrid,
    middles: Array,
    areas: Array,
    edges: tuple[Array, Array],
    shapes: ExposedPolygons,
    close: PointExposure,
) -> ExposedMarks:
    """Pieces with what their edges receive; one without points on an edge receives as
    an edge through its middle.

    Args:
        grid: nodes.
        middles: (pieces, 2) um.
        areas: (pieces,) um^2.
        edges: (n, 2) points on the edges, um, and (n,) piece of each.
        shapes: all, at dose 1.
        close: Gaussians that are summed over the shapes.
    """
    at_edges, piece_of_point = edges
    count = len(areas)
    exposure = exposure_at_edges(at_edges, shapes, close.terms)
    own = mean_by_piece(exposure, piece_of_point, count)
    inner = np.setdiff1d(np.arange(count), piece_of_point)
    own[inner] = close.weights.sum() / 2
    points = np.concatenate([at_edges, middles[inner]])
    none = np.empty((0, 4), np.int64)
    return ExposedMarks(
        grid, none, none, own, points, np.r_[piece_of_point, inner], middles, areas
    )


def _middles(cells: Array, step_um: float) -> tuple[Array, Array]:
    """(n, 2) middles of cells, um, and (n,) their areas, um^2."""
    low, high = cells[:, :2], cells[:, 2:]
    return (low + high) / 2 * step_um, (high - low).prod(1) * step_um**2


def _divide(
    boxes: Array, side: float, inside: Array, box_of_sample: Array
) -> tuple[Array, Array, Array]:
    """Divide boxes into equal cells, each to at most a length along both axes.

    Args:
        boxes: (n, 4) left, bottom, right, top, grid steps.
        side: longest side of a cell.
        inside: (m, 2) points in the boxes.
        box_of_sample: (m,) box of each point.

    Returns:
        (cells, 4) cells, (cells,) the box of each, and (m,) the cell of each point.

    Raises:
        ProcessError: more than 500 000 cells.
    """
    size = boxes[:, 2:] - boxes[:, :2]
    counts = np.maximum(np.ceil(size / side), 1).astype(np.int64)
    cells = counts.prod(1)
    if cells.sum() > MOST_CELLS:
        raise ProcessError(
            f"marks and labels need {cells.sum():,} cells of one dose each, at most "
            f"{MOST_CELLS:,}, for so short a backscatter range; draw smaller marks "
            "(die.mark_um), or set exposure.correct = false"
        )
    start = np.cumsum(cells) - cells
    box = np.repeat(np.arange(len(boxes)), cells)
    place = np.arange(len(box)) - start[box]
    cell = np.stack([place % counts[box, 0], place // counts[box, 0]], -1)
    low, high = (
        boxes[box, :2] + size[box] * edge // counts[box] for edge in (cell, cell + 1)
    )
    steps = np.floor(inside).astype(np.int64) - boxes[box_of_sample, :2]
    column, row = ((counts[box_of_sample] * (steps + 1) - 1) // size[box_of_sample]).T
    cell_of_sample = start[box_of_sample] + row * counts[box_of_sample, 0] + column
    return np.hstack([low, high]), box, cell_of_sample


def _halve(
    cells: Array, cell_of_sample: Array, inside: Array, values: Array, allowed: float
) -> tuple[Array, Array, Array]:
    """Halve cells, along the edge that they bound, while values on it differ too much.

    Args:
        cells: (n, 4) left, bottom, right, top, grid steps.
        cell_of_sample: (m,) cell of each point.
        inside: (m, 2) points in the cells.
        values: (m,) value at each point.
        allowed: difference of values in a cell.

    Returns:
        (k, 4) cells, (k,) the first cell that each was cut from, and (m,) the cell of
        each point.
    """
    parent = np.arange(len(cells))
    table = np.column_stack([values, inside])
    while True:
        least = np.full((len(cells), 3), np.inf)
        most = -least
        np.minimum.at(least, cell_of_sample, table)
        np.maximum.at(most, cell_of_sample, table)
        change, along_x, along_y = (most - least).T
        axis = (along_y > along_x).astype(np.int64)
        rows = np.arange(len(cells))
        middle = (cells[rows, axis] + cells[rows, axis + 2]) // 2
        cut = np.flatnonzero((change > allowed) & (middle > cells[rows, axis]))
        if not len(cut):
            return cells, parent, cell_of_sample
        upper = cells[cut]
        upper[np.arange(len(cut)), axis[cut]] = middle[cut]
        cells[cut, axis[cut] + 2] = middle[cut]
        number_of_upper = rows.copy()
        number_of_upper[cut] = len(cells) + np.arange(len(cut))
        at = inside[np.arange(len(inside)), axis[cell_of_sample]]
        is_upper = at >= middle[cell_of_sample]
        cell_of_sample = np.where(
            is_upper, number_of_upper[cell_of_sample], cell_of_sample
        )
        cells = np.concatenate([cells, upper])
        parent = np.r_[parent, parent[cut]]
