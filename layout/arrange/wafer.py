"""Step and repeat: which dies of a raster lie whole on a wafer, and how few arrays hold
them.
"""

import math
from dataclasses import dataclass

import numpy as np

from layout.arrange.record import MOST_DIES, WaferSettings
from layout.formats.library import CellReference
from layout.shapes import rectilinear
from layout.shapes.rectilinear import box_distance
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

NOTCH_RADIUS_MM = 0.9  # of the bottom of a notch, SEMI M1
Box = tuple[float, float, float, float]  # left, bottom, right, top


@dataclass(frozen=True, eq=False)
class WaferDies:
    """Dies on a wafer.

    index: (n, 2) column and row in the raster, row by row from the lowest. place_um:
    (n, 2) centres. pitch_um: along x and y.
    """

    index: Array
    place_um: Array
    pitch_um: tuple[float, float]


def usable_dies(
    wafer: WaferSettings, die_um: Box, *, around_marks_um: float = 0.0
) -> WaferDies:
    """Dies that lie whole within the usable part of the wafer and clear of its marks.

    A point is usable where it is at least ``edge_exclusion_mm`` from the edge of the
    wafer: its circle, the chord of the flat, the notch (:func:`notch_distance_um`).

    Args:
        wafer: diameter, raster, marks and exclusion.
        die_um: left, bottom, right, top of all that a die draws, about its middle.
        around_marks_um: distance from the marks that stays free.

    Raises:
        ProcessError: dies that overlap, or none that fits.
    """
    left, bottom, right, top = die_um
    for size, pitch, axis in (
        (right - left, wafer.pitch_um[0], "x"),
        (top - bottom, wafer.pitch_um[1], "y"),
    ):
        if size > pitch + 1e-9:
            raise ProcessError(
                f"wafer.pitch_um is {pitch:g} along {axis}, but a die is {size:.3f} um long; raise it"
            )
    radius = 500 * wafer.diameter_mm
    reach = [
        int((radius + abs(off)) / pitch) + 2
        for pitch, off in zip(wafer.pitch_um, wafer.offset_um, strict=True)
    ]
    if (2 * reach[0] + 1) * (2 * reach[1] + 1) > 2 * MOST_DIES:
        raise ProcessError(
            f"wafer.pitch_um = {list(wafer.pitch_um)}: more than {MOST_DIES} dies; raise it"
        )
    rows, columns = np.mgrid[
        -reach[1] : reach[1] + 1, -reach[0] : reach[0] + 1
    ].reshape(2, -1)
    index = np.column_stack([columns, rows])
    place = index * wafer.pitch_um + wafer.offset_um
    boxes = place[:, [0, 1, 0, 1]] + die_um
    usable = _usable(wafer, boxes)
    for mark in wafer.marks:
        half = wafer.mark_um / 2 + around_marks_um
        x, y = 1e3 * mark.x_mm, 1e3 * mark.y_mm
        usable &= (
            box_distance(boxes, np.array([x - half, y - half, x + half, y + half])) > 0
        )
    if not usable.any():
        raise ProcessError(
            f"no die of {right - left:.0f} x {top - bottom:.0f} um fits on the wafer; change wafer.offset_um, "
            "wafer.edge_exclusion_mm or wafer.diameter_mm"
        )
    return WaferDies(index[usable], place[usable], wafer.pitch_um)


def refuse_marks_off(wafer: WaferSettings) -> None:
    """Raises: ProcessError: a mark that reaches beyond the usable part of the wafer."""
    half = wafer.mark_um / 2
    for mark in wafer.marks:
        x, y = 1e3 * mark.x_mm, 1e3 * mark.y_mm
        if not _usable(wafer, np.array([[x - half, y - half, x + half, y + half]]))[0]:
            raise ProcessError(
                f"wafer.marks: the mark at ({mark.x_mm:g}, {mark.y_mm:g}) mm is off the usable wafer"
            )


def chord_um(wafer: WaferSettings) -> float:
    """Distance of the flat from the middle of the wafer; the radius where there is
    none.
    """
    radius = 500 * wafer.diameter_mm
    half = 500 * wafer.flat_mm
    return math.sqrt(radius**2 - half**2)


def _usable(wafer: WaferSettings, boxes: Array) -> Array:
    """(n,) whether a box lies whole on the usable part of the wafer.

    Usable is what is ``edge_exclusion_mm`` from the circle, the flat and the notch.

    Args:
        wafer: diameter, flat, notch and exclusion.
        boxes: (n, 4) left, bottom, right, top, um.
    """
    radius = 500 * wafer.diameter_mm
    exclusion = 1e3 * wafer.edge_exclusion_mm
    farthest = np.hypot(
        np.abs(boxes[:, [0, 2]]).max(1), np.abs(boxes[:, [1, 3]]).max(1)
    )
    inside = (farthest <= radius - exclusion + 1e-6) & (
        boxes[:, 1] >= -chord_um(wafer) + exclusion - 1e-6
    )
    if wafer.notch_mm:
        inside &= notch_distance_um(wafer, boxes) >= exclusion - 1e-6
    return np.asarray(inside)


def notch_distance_um(wafer: WaferSettings, boxes: Array) -> Array:
    """(n,) distance of boxes from the notch, um; 0 or less where they overlap.

    SEMI M1: a V of 90 degrees with a bottom of radius 0.9 mm, ``notch_mm`` in depth.
    That is a sharp V, with its corner at the centre of the bottom's circle, widened by
    the radius. A box is nearest to it at a corner or an edge of either.

    Args:
        wafer: with its notch.
        boxes: (n, 4) left, bottom, right, top, um.
    """
    radius = 1e3 * NOTCH_RADIUS_MM
    corner = -500 * wafer.diameter_mm + 1e3 * wafer.notch_mm - radius
    left, bottom, right, _ = boxes.T
    x = np.maximum(np.maximum(left, -right), 0.0)  # of the point nearest to the axis
    height = bottom - corner
    from_wall = (x + height) / math.sqrt(2)  # from the line of a wall, above 0 outside
    down_wall = (x - height) / math.sqrt(2)  # down the wall from the corner
    distance = np.where(
        down_wall >= 0, np.maximum(from_wall, 0.0), np.hypot(x, np.maximum(height, 0))
    )
    return np.asarray(distance - radius)


def step_and_repeat(
    child: str, dies: WaferDies, *, units_per_um: float
) -> tuple[CellReference, ...]:
    """The dies as few arrays: runs of neighbours in a row, equal runs of rows together.

    Args:
        child: cell of the die.
        dies: dies that the wafer holds.
        units_per_um: database units in a micrometre.
    """
    column, row = (dies.index - dies.index.min(0)).T
    filled = np.zeros((row.max() + 1, column.max() + 1), bool)
    filled[row, column] = True
    pitch = np.array(dies.pitch_um) * units_per_um
    origin = dies.place_um[0] * units_per_um - (column[0], row[0]) * pitch
    step_x, step_y = np.rint(pitch).astype(int).tolist()
    copies = []
    for left, low, right, high in rectilinear.merge_runs(filled).tolist():
        x, y = np.rint(origin + (left, low) * pitch).astype(int).tolist()
        copies.append(
            CellReference(
                child,
                x,
                y,
                columns=right - left,
                rows=high - low,
                across=(step_x, 0),
                up=(0, step_y),
            )
        )
    return tuple(copies)
