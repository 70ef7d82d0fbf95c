"""Pillars that no map of discs on a square grid shows: drawn as they stand, whatever
their lattice, shape and turn.
"""

import math

import numpy as np

from metalens.cell.shapes import rotate_corners
from metalens.core.arrays import Array
from metalens.lens import Lens
from metalens.library import axes
from metalens.view.panels import DrawingPanel, OutlinePanel

MOST_DRAWN = 3_000_000  # pillars of a page; of a larger lens its middle is drawn
BANDS = 6  # colours of sizes or turns
_CORNERS = 24  # of a curved outline
_NM = 1e3


def draw_pillars(lens: Lens) -> DrawingPanel:
    """Outline of every pillar at its position, coloured by size, or by turn where
    turned.

    Positions are in nm, +y up, as on the mask. Of a lens with more than 3 million
    pillars its middle is drawn.

    Args:
        lens: the lens.
    """
    d = lens.diameters
    size = np.asarray(d.diameter_um)
    pillars = size > 0
    complete = np.count_nonzero(pillars) <= MOST_DRAWN
    if not complete:
        half = math.sqrt(MOST_DRAWN * d.site_um2) / 2
        pillars &= (np.abs(d.y_um[:, None]) <= half) & (np.abs(d.x_um) <= half)
    rows, columns = np.nonzero(pillars)
    blank = np.zeros_like(size)
    angle = blank if d.angle_rad is None else np.degrees(d.angle_rad)
    length = blank if d.length_um is None else d.length_um
    # size and length in whole nm (length 0: the shape has one size), whole degrees
    values = np.stack([_NM * size, _NM * length, angle])[:, rows, columns]
    kinds, kind_of = np.unique(np.rint(values).astype(int), axis=1, return_inverse=True)
    column, unit = (0, "nm") if d.angle_rad is None else (2, "deg")
    places = np.rint(_NM * np.stack([d.x_um[columns], d.y_um[rows]], axis=1))
    sorted_places = places.astype(np.int32)[np.argsort(kind_of.ravel(), kind="stable")]
    ends = np.cumsum(np.bincount(kind_of.ravel()))
    outlines = []
    for kind, layer, of_kind in zip(
        kinds.T.tolist(),
        _bands(kinds[column], unit),
        np.split(sorted_places, ends[:-1]),
        strict=True,
    ):
        named = zip(("size / nm", "length / nm", "turn / deg"), kind, strict=True)
        notes = {name: value for name, value in named if value}
        corners = _corners(lens, kind[0] / _NM, kind[1] / _NM, math.radians(kind[2]))
        outlines.append(OutlinePanel(layer, _NM * corners, of_kind, notes))
    text = (
        f"{len(places):,} pillars, each a {lens.cell.shape.name} where it stands, +y of "
        f"the lens up, as on the mask{'' if complete else ' (the middle of a larger lens)'}"
        ". Drag to move, wheel or + and - to zoom."
    )
    return DrawingPanel("Pillars", outlines, 1 / _NM, text)


def _corners(lens: Lens, size_um: float, length_um: float, turn_rad: float) -> Array:
    """(n, 2) corners in um of one pillar about its site.

    Args:
        lens: the lens.
        size_um: of the pillar.
        length_um: second size; 0 for none.
        turn_rad: rotation.
    """
    cell = axes.cell_of_sizes(lens.cell, size_um, length_um) if length_um else lens.cell
    corners = cell.outline(size_um).line(_CORNERS)
    return np.asarray(rotate_corners(corners, turn_rad))


def _bands(values: Array, unit: str) -> list[str]:
    """Name of the band of each value, of 6 even bands, zero-padded to sort as numbers.

    Args:
        values: (n,) whole numbers.
        unit: in the names.
    """
    low, high = int(values.min()), int(values.max())
    width = -(-(high + 1 - low) // BANDS)
    digits = len(str(high))
    starts = (low + (values - low) // width * width).tolist()
    return [
        f"{start:0{digits}} to {min(start + width - 1, high):0{digits}} {unit}"
        for start in starts
    ]
