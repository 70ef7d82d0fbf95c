"""Proximity effect correction of plans, and of any polygons in pieces of one dose."""

from pathlib import Path

import numpy as np

from layout.formats.library import MaskCell, MaskLibrary, flatten_polygons
from layout.formats.reading import read_mask
from layout.mask.plan import MaskPlan
from layout.pec import psf
from layout.pec.correct import (
    correct_plans,
    dose_ladder,
    layer_title,
    solve_background,
    straight_edge_error,
)
from layout.pec.marks import CHANGE, MOST_CELLS, expose_pieces
from layout.pec.nodes import NodeGrid
from layout.pec.polygon_edges import (
    EdgeSamples,
    ExposedPolygons,
    enclosed_points,
    equivalent_spots,
    sample_edges,
)
from layout.pec.psf import THRESHOLD, PointExposure
from layout.process.process import ExposureSettings, LayerNumber
from layout.shapes import region
from layout.shapes.moments import points_along_edges, polygon_moments
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.core.units import nm

_FAR_UM = 2.0  # Gaussians from this range on are summed on nodes, others exactly
SPOTS = 8  # along the narrowest Gaussian on nodes, of a polygon


def correct(
    mask: MaskPlan | MaskLibrary | str | Path,
    exposure: ExposureSettings,
    *,
    layer: int | None = None,
    thousandths: bool = False,
) -> MaskPlan | MaskLibrary:
    """Proximity effect correction: a mask with a dose for every shape.

    Args:
        mask: plan of a die, every dose 1; or a file of any polygons, or its cells.
        exposure: point exposure, tolerance and number of doses.
        layer: number of the layer of a file that is exposed; None: its only one.
        thousandths: datatypes of a file are 1000 times the dose, not its class.

    Raises:
        ProcessError: as :func:`layout.pec.correct.correct_plans`; several layers in a
            file, or more than 500,000 shapes.

    Accuracy:
        Edges of all shapes are at dose to size within the tolerance, as
        :mod:`layout.verify` finds from the written files.
    """
    if isinstance(mask, MaskPlan):
        return correct_plans([mask], exposure)[0][0]
    library = mask if isinstance(mask, MaskLibrary) else read_mask(Path(mask))
    numbers = sorted({number for number, _ in library.layers})
    if layer not in numbers and (layer is not None or len(numbers) != 1):
        raise ProcessError(f"layers {numbers}: say which one is exposed (--layer)")
    number = numbers[0] if layer is None else layer
    return _correct_polygons(library, exposure, number, thousandths)


def _correct_polygons(
    library: MaskLibrary, exposure: ExposureSettings, layer: int, thousandths: bool
) -> MaskLibrary:
    """The shapes of a layer number in one cell, the datatype the class of their dose.

    An edge of a piece gets dose x (its exposure by near shapes at dose 1) + backscatter
    = half of what a wide area receives; a piece inside, as an edge through its middle.
    """
    library.refuse_beyond(MOST_CELLS)
    unit = library.unit_nm * nm
    drawn = [
        points for (number, _), points in flatten_polygons(library) if number == layer
    ]
    parts = region.separate_areas(drawn)
    contours = [contour * unit for part in parts for contour in part]
    shapes = _at_dose_1(contours)
    near, far, grid, field = near_and_far(shapes, exposure)
    range_um = float(near.widths_um.max())
    narrowest_um = float(far.widths_um.min(initial=1e3))
    side = narrowest_um / SPOTS / unit
    step_um = min(1.0, narrowest_um / SPOTS**2)
    tolerance = min(exposure.tolerance, straight_edge_error(near))
    pieces: list[list[Array]] = []
    points = []
    for part in parts:
        own = [contour * unit for contour in part]
        samples = sample_edges(_at_dose_1(own), range_um, step_um, unit)
        backscatter = grid.sample(field, *samples.at_um.T)
        allowed = CHANGE * tolerance * THRESHOLD
        for piece, members in _divided(part, samples, backscatter, side, allowed, unit):
            edge = samples.at_um[members]
            if not len(edge) and piece is part:
                edge = points_along_edges(own)
            pieces.append(piece)
            points.append(edge)
    piece_of_point = np.repeat(np.arange(len(pieces)), list(map(len, points)))
    at = np.concatenate(points)
    moments = [polygon_moments([c * unit for c in piece])[:2] for piece in pieces]
    area = np.array([each for each, _ in moments])
    middle = np.array([first / each for each, first in moments])
    marks = expose_pieces(grid, middle, area, (at, piece_of_point), shapes, near)
    none = np.zeros(grid.shape)
    dose = marks.doses(solve_background(grid.convolution(far), none, none, marks=marks))
    change = np.minimum(exposure.tolerance, straight_edge_error(near) * dose)
    finest = float((dose * marks.own / THRESHOLD / change).max())
    ladder = dose_ladder([(float(dose.min()), float(dose.max()), finest)], exposure)
    polygons: dict[LayerNumber, list[Array]] = {}
    doses: dict[LayerNumber, float] = {}
    for piece, level in zip(pieces, ladder.nearest(dose).tolist(), strict=True):
        factor = float(ladder.factors[level])
        key = layer, round(1000 * factor) if thousandths else level
        drawn = piece if len(piece) == 1 else region.without_holes(piece)
        polygons.setdefault(key, []).extend(drawn)
        doses[key] = factor
    name = library.tops[0]
    titles = {key: layer_title("shape", value) for key, value in doses.items()}
    cells = {name: MaskCell(name, polygons)}
    return MaskLibrary(name, cells, library.unit_nm, titles, doses)


def _at_dose_1(contours: list[Array]) -> ExposedPolygons:
    """Contours, um, at dose 1; holes run clockwise and are taken off."""
    return ExposedPolygons(contours, np.ones(len(contours)), np.zeros(len(contours)))


def near_and_far(
    shapes: ExposedPolygons, exposure: ExposureSettings
) -> tuple[PointExposure, PointExposure, NodeGrid, Array]:
    """Point exposure below and from 2 um on, nodes, and exposure of them by the second.

    Args:
        shapes: that are exposed, with their doses.
        exposure: point exposure.

    Raises:
        ProcessError: no shape, or no range below 2 um.
    """
    point = psf.point_exposure(exposure)
    is_far = point.widths_um >= _FAR_UM
    near, far = (
        PointExposure(point.widths_um[chosen], point.weights[chosen])
        for chosen in (~is_far, is_far)
    )
    if not len(shapes.corners) or not len(near.widths_um):
        raise ProcessError("nothing to expose, or no range below 2 um to expose it by")
    narrowest_um = float(far.widths_um.min(initial=1e3))
    corners = np.concatenate(list(shapes.corners))
    box_um = (*corners.min(0).tolist(), *corners.max(0).tolist())
    grid = NodeGrid.over(box_um, narrowest_um)
    mass = grid.deposit(*equivalent_spots(shapes, narrowest_um / SPOTS))
    return near, far, grid, grid.convolution(far)(mass)


def _divided(
    part: list[Array],
    samples: EdgeSamples,
    values: Array,
    side: float,
    allowed: float,
    unit_um: float,
) -> list[tuple[list[Array], Array]]:
    """Pieces of an area with the edge samples that each of them bounds.

    Args:
        part: outline and holes, database units.
        samples: on its edges.
        values: (n,) backscatter at the samples.
        side: longest side of a piece, database units.
        allowed: change of the backscatter along the edges of a piece.
        unit_um: database unit.
    """
    inside = samples.at_um / unit_um - 0.1 * samples.normal
    waiting = [(part, np.arange(len(inside)))]
    pieces = []
    while waiting:
        area, members = waiting.pop()
        size = np.ptp(np.concatenate(area), axis=0)
        halves: list[list[Array]] = []
        if size.max() > side:
            halves = region.halve_area(area, int(size[1] > size[0]))
        elif len(members) and np.ptp(values[members]) > allowed:
            spread = np.ptp(inside[members], axis=0)
            halves = region.halve_area(area, int(spread[1] > spread[0]))
        for half in halves:
            in_half = (
                enclosed_points(half, inside[members]) if len(members) else members
            )
            waiting.append((half, members[in_half]))
        if not halves:
            pieces.append((area, members))
    return pieces
