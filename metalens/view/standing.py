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
class _Standing:
    """Pillars one by one: (n,) positions in um (+y up, as on the mask), size, length
    (0: the shape says it)
    in whole nm, turn in whole degrees."""

    x_um: Array
    y_um: Array
    kind: Array

    @property
    def kinds(self) -> tuple[Array, Array]:
        """(k, 3) distinct (size, length, turn), and which of them each pillar is."""
        found, place = np.unique(self.kind, axis=0, return_inverse=True)
        return found, place.reshape(-1)


def draw_pillars(lens: Lens) -> DrawingPanel:
    """Every pillar's outline where it stands, coloured by its size, or by its turn
    where pillars are turned.

    Args:
        lens: the lens.
    """
    this, whole = _standing(lens)
    kinds, place = this.kinds
    what, unit = (2, "deg") if lens.diameters.angle_rad is not None else (0, "nm")
    named = _bands(kinds[:, what], unit)
    at = np.rint(_NM * np.stack([this.x_um, this.y_um], axis=1)).astype(np.int32)
    order = np.argsort(place, kind="stable")
    parts = np.split(
        at[order], np.cumsum(np.bincount(place, minlength=len(kinds)))[:-1]
    )
    outlines = []
    for (size, length, turn), places, name in zip(
        kinds.tolist(), parts, named, strict=True
    ):
        notes = {"size / nm": size} | ({"length / nm": length} if length else {})
        corners = _NM * _corners(lens, size / _NM, length / _NM, math.radians(turn))
        outlines.append(
            OutlinePanel(
                name, corners, places, notes | ({"turn / deg": turn} if what else {})
            )
        )
    text = (
        f"{len(at):,} pillars, each a {lens.cell.shape.name} where it stands, +y of the lens up, as on the mask"
        f"{'' if whole else ' (the middle of a larger lens)'}. Drag to move, wheel or + and - to zoom."
    )
    return DrawingPanel("Pillars", outlines, 1 / _NM, text)


def draw_phase(lens: Lens) -> ImagePanel:
    """Phase over the aperture on square pixels, each that of the site nearest to it.

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
    seen = [lens] if lens.pairs is None else [lens.seen("x"), lens.seen("y")]
    values = np.stack(
        [np.mod(one.phase_rad()[row, column] / (2 * np.pi), 1) for one in seen]
    )
    values = np.where(d.diameter_um[row, column] > 0, values, 0.0)
    names = [lens.hand or "any"] if lens.pairs is None else ["along x", "along y"]
    return ImagePanel(
        "Phase", values, [SliderAxis("light", names)], step, "turns, modulo one"
    )


def nearest_site(d: DiameterMap, y_um: Array, x_um: Array) -> tuple[Array, Array]:
    """(row, column) of the site of the lattice nearest to places; a hexagonal one is
    two rectangular ones.

    Args:
        y_um: places along y, um.
        x_um: places along x, um.
    """
    step = 2 if d.lattice.centred else 1
    found = [
        (_place(d, 0, y_um, start, step), _place(d, 1, x_um, start, step))
        for start in range(step)
    ]
    away = [
        np.hypot(d.y_um[row] - y_um, d.x_um[column] - x_um) for row, column in found
    ]
    best = np.argmin(np.broadcast_arrays(*away), axis=0)
    rows, columns = (np.choose(best, [pair[k] for pair in found]) for k in (0, 1))
    return rows, columns


def _place(d: DiameterMap, axis: int, at_um: Array, start: int, step: int) -> Array:
    """Index along an axis of the nearest of every ``step``-th line from ``start`` on."""
    count, width = d.diameter_um.shape[axis], d.steps_um[1 - axis]
    exact = (at_um / width + (count - 1) / 2 - start) / step
    place = np.clip(np.rint(exact), 0, max(0, (count - 1 - start) // step)).astype(int)
    return np.asarray(place * step + start)


def _standing(lens: Lens) -> tuple[_Standing, bool]:
    """The pillars of the lens, and whether they are all of them."""
    d = lens.diameters
    rows, columns = np.nonzero(np.asarray(d.diameter_um))
    whole = len(rows) <= MOST_DRAWN
    if not whole:
        reach = math.sqrt(MOST_DRAWN * d.site_um2) / 2
        kept = (np.abs(d.y_um[rows]) <= reach) & (np.abs(d.x_um[columns]) <= reach)
        rows, columns = rows[kept], columns[kept]
    size = np.rint(_NM * np.asarray(d.diameter_um)[rows, columns].astype(float)).astype(
        int
    )
    turn, length = np.zeros((2, len(size)), int)
    if d.length_um is not None:
        length = np.rint(_NM * d.length_um[rows, columns].astype(float)).astype(int)
    if d.angle_rad is not None:
        turn = np.rint(np.degrees(d.angle_rad[rows, columns].astype(float))).astype(int)
    return _Standing(
        d.x_um[columns], d.y_um[rows], np.stack([size, length, turn], axis=1)
    ), whole


def _corners(lens: Lens, size_um: float, length_um: float, turn_rad: float) -> Array:
    """(n, 2) of one pillar about its site."""
    from metalens.cell.shapes import rotate_corners

    cell = axes.cell_of_sizes(lens.cell, size_um, length_um) if length_um else lens.cell
    corners = cell.outline(size_um).line(_CORNERS)
    return np.asarray(rotate_corners(corners, turn_rad))


def _bands(values: Array, unit: str) -> list[str]:
    """The band of each value, by name, padded so that names sort as numbers."""
    low, high = int(values.min()), int(values.max())
    edges = np.unique(np.rint(np.linspace(low, high + 1, BANDS + 1)).astype(int))
    place = np.clip(
        np.searchsorted(edges, values, side="right") - 1, 0, max(0, len(edges) - 2)
    )
    digits = len(str(high))
    ends = [
        (int(edges[i]), max(int(edges[i + 1]) - 1, int(edges[i])))
        for i in range(max(1, len(edges) - 1))
    ]
    return [f"{ends[i][0]:0{digits}} to {ends[i][1]:0{digits}} {unit}" for i in place]
