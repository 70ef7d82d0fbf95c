"""Pillars that no map of discs on a square grid shows: drawn as they stand, whatever
their lattice, shape and turn.
"""

import dataclasses
import math

import numpy as np

from metalens.core.arrays import Array
from metalens.lens import DiameterMap, Lens
from metalens.library import axes
from metalens.view.panels import DrawingPanel, ImagePanel, OutlinePanel, SliderAxis

MOST_DRAWN = 3_000_000  # pillars of a page; of a larger lens its middle is drawn
BANDS = 6  # colours of sizes or turns
_PIXELS = 512  # along the longer side of the picture of the phase
_CORNERS = 24  # of a curved outline
_NM = 1e3


@dataclasses.dataclass(frozen=True, eq=False, slots=True)
class _Pillars:
    """Pillars one by one.

    x_um, y_um: (n,) positions in um, +y up, as on the mask.
    kind: (n, 3) size and length in whole nm (length 0: the shape has one size), turn in
    whole degrees.
    """

    x_um: Array
    y_um: Array
    kind: Array

    @property
    def kinds(self) -> tuple[Array, Array]:
        """(k, 3) distinct (size, length, turn), and which of them each pillar is."""
        distinct, index = np.unique(self.kind, axis=0, return_inverse=True)
        return distinct, index.reshape(-1)


def draw_pillars(lens: Lens) -> DrawingPanel:
    """Outline of every pillar at its position, coloured by size, or by turn where
    turned.

    Of a lens with more than 3 million pillars its middle is drawn.

    Args:
        lens: the lens.
    """
    pillars, complete = _drawn_pillars(lens)
    kinds, kind_of = pillars.kinds
    column, unit = (2, "deg") if lens.diameters.angle_rad is not None else (0, "nm")
    band_names = _bands(kinds[:, column], unit)
    positions = np.rint(_NM * np.stack([pillars.x_um, pillars.y_um], axis=1)).astype(
        np.int32
    )
    order = np.argsort(kind_of, kind="stable")
    parts = np.split(
        positions[order], np.cumsum(np.bincount(kind_of, minlength=len(kinds)))[:-1]
    )
    outlines = []
    for (size, length, turn), places, name in zip(
        kinds.tolist(), parts, band_names, strict=True
    ):
        notes = {"size / nm": size} | ({"length / nm": length} if length else {})
        corners = _NM * _corners(lens, size / _NM, length / _NM, math.radians(turn))
        outlines.append(
            OutlinePanel(
                name, corners, places, notes | ({"turn / deg": turn} if column else {})
            )
        )
    text = (
        f"{len(positions):,} pillars, each a {lens.cell.shape.name} where it stands, +y of the lens up, as on the mask"
        f"{'' if complete else ' (the middle of a larger lens)'}. Drag to move, wheel or + and - to zoom."
    )
    return DrawingPanel("Pillars", outlines, 1 / _NM, text)


def draw_phase(lens: Lens) -> ImagePanel:
    """Phase over the aperture on square pixels, each of its nearest site, in turns.

    Args:
        lens: the lens.
    """
    d = lens.diameters
    edge = max(d.x_um[-1] - d.x_um[0], d.y_um[-1] - d.y_um[0], d.pitch_um)
    step = max(edge / _PIXELS, min(d.steps_um))
    y, x = (
        np.arange(-math.ceil(end / step), math.ceil(end / step) + 1) * step
        for end in (d.y_um[-1], d.x_um[-1])
    )
    row, column = nearest_site(d, y[:, None], x[None])
    devices = [lens] if lens.pairs is None else [lens.seen("x"), lens.seen("y")]
    values = np.stack(
        [np.mod(device.phase_rad()[row, column] / (2 * np.pi), 1) for device in devices]
    )
    values = np.where(d.diameter_um[row, column] > 0, values, 0.0)
    names = [lens.hand or "any"] if lens.pairs is None else ["along x", "along y"]
    return ImagePanel(
        "Phase", values, [SliderAxis("light", names)], step, "turns, modulo one"
    )


def nearest_site(d: DiameterMap, y_um: Array, x_um: Array) -> tuple[Array, Array]:
    """(row, column) of the lattice site nearest to places.

    A hexagonal lattice is searched as two rectangular ones.

    Args:
        d: map of the pillars.
        y_um: places along y, um.
        x_um: places along x, um; they broadcast.
    """
    step = 2 if d.lattice.centred else 1
    candidates = [
        (_nearest_line(d, 0, y_um, start, step), _nearest_line(d, 1, x_um, start, step))
        for start in range(step)
    ]
    distances = [
        np.hypot(d.y_um[row] - y_um, d.x_um[column] - x_um)
        for row, column in candidates
    ]
    nearest = np.argmin(np.broadcast_arrays(*distances), axis=0)
    rows, columns = (
        np.choose(nearest, [pair[k] for pair in candidates]) for k in (0, 1)
    )
    return rows, columns


def _nearest_line(
    d: DiameterMap, axis: int, at_um: Array, start: int, step: int
) -> Array:
    """Index along an axis of the nearest of every ``step``-th lattice line from
    ``start``.

    Args:
        d: map of the pillars.
        axis: 0 for rows, 1 for columns.
        at_um: places along the axis, um.
        start: first line.
        step: between lines.
    """
    count, spacing = d.diameter_um.shape[axis], d.steps_um[1 - axis]
    exact = (at_um / spacing + (count - 1) / 2 - start) / step
    line = np.clip(np.rint(exact), 0, max(0, (count - 1 - start) // step)).astype(int)
    return np.asarray(line * step + start)


def _drawn_pillars(lens: Lens) -> tuple[_Pillars, bool]:
    """The pillars of the lens that are drawn, and whether they are all of them.

    Of a large lens these are the pillars of a central square.
    """
    d = lens.diameters
    rows, columns = np.nonzero(np.asarray(d.diameter_um))
    complete = len(rows) <= MOST_DRAWN
    if not complete:
        half = math.sqrt(MOST_DRAWN * d.site_um2) / 2
        central = (np.abs(d.y_um[rows]) <= half) & (np.abs(d.x_um[columns]) <= half)
        rows, columns = rows[central], columns[central]
    size = np.rint(_NM * np.asarray(d.diameter_um)[rows, columns].astype(float)).astype(
        int
    )
    turn, length = np.zeros((2, len(size)), int)
    if d.length_um is not None:
        length = np.rint(_NM * d.length_um[rows, columns].astype(float)).astype(int)
    if d.angle_rad is not None:
        turn = np.rint(np.degrees(d.angle_rad[rows, columns].astype(float))).astype(int)
    return _Pillars(
        d.x_um[columns], d.y_um[rows], np.stack([size, length, turn], axis=1)
    ), complete


def _corners(lens: Lens, size_um: float, length_um: float, turn_rad: float) -> Array:
    """(n, 2) corners in um of one pillar about its site.

    Args:
        lens: the lens.
        size_um: of the pillar.
        length_um: second size; 0 for none.
        turn_rad: rotation.
    """
    from metalens.cell.shapes import rotate_corners

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
    edges = np.unique(np.rint(np.linspace(low, high + 1, BANDS + 1)).astype(int))
    band = np.clip(
        np.searchsorted(edges, values, side="right") - 1, 0, max(0, len(edges) - 2)
    )
    digits = len(str(high))
    ends = [
        (int(edges[i]), max(int(edges[i + 1]) - 1, int(edges[i])))
        for i in range(max(1, len(edges) - 1))
    ]
    return [f"{ends[i][0]:0{digits}} to {ends[i][1]:0{digits}} {unit}" for i in band]
