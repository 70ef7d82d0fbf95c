"""Step and repeat: which dies of a raster lie whole on a wafer, and how few arrays hold
them.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from layout.arrange.parts import box_distance
from layout.arrange.record import MOST_DIES, WaferSettings
from layout.formats.library import CellReference
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

NOTCH_RADIUS_MM = 0.9  # of the bottom of a notch, SEMI M1
Box = tuple[float, float, float, float]  # left, bottom, right, top


@dataclass(frozen=True, eq=False, slots=True)
class WaferDies:
    """Dies on a wafer.

    index: (n, 2) column and row in the raster, row by row from the lowest. place_um:
    (n, 2) centres.
    """

    index: Array
    place_um: Array


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
    return WaferDies(index[usable], place[usable])


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
    spans: dict[int, list[tuple[int, int]]] = {}
    order = np.lexsort((dies.index[:, 0], dies.index[:, 1]))
    columns, rows = dies.index[order].T.tolist()
    for row, members in itertools.groupby(
        zip(rows, columns, strict=True), key=lambda pair: pair[0]
    ):
        row_columns = [column for _, column in members]
        breaks = [
            0,
            *(
                n
                for n in range(1, len(row_columns))
                if row_columns[n] != row_columns[n - 1] + 1
            ),
            len(row_columns),
        ]
        spans[row] = [
            (row_columns[start], row_columns[stop - 1] + 1)
            for start, stop in itertools.pairwise(breaks)
        ]
    die_number = {(int(i), int(j)): n for n, (i, j) in enumerate(dies.index.tolist())}
    open_runs: dict[tuple[int, int], int] = {}
    blocks: list[tuple[tuple[int, int], int, int]] = []
    for row in range(min(spans), max(spans) + 2):
        runs = set(spans.get(row, ()))
        blocks += [
            (run, open_runs.pop(run), row) for run in sorted(open_runs.keys() - runs)
        ]
        open_runs.update(dict.fromkeys(runs - open_runs.keys(), row))
    step = _steps(dies, units_per_um)
    copies = []
    for (first, end), low, high in blocks:
        x, y = (
            round(v * units_per_um)
            for v in dies.place_um[die_number[first, low]].tolist()
        )
        copies.append(
            CellReference(
                child,
                x,
                y,
                columns=end - first,
                rows=high - low,
                across=(step[0], 0),
                up=(0, step[1]),
            )
        )
    return tuple(copies)


def _steps(dies: WaferDies, units_per_um: float) -> tuple[int, int]:
    """From die to die in units, along x and y; 0 where there is one column or row."""
    steps = []
    for axis in (0, 1):
        index = dies.index[:, axis]
        place = dies.place_um[:, axis]
        low, high = int(index.argmin()), int(index.argmax())
        count = int(index[high] - index[low])
        steps.append(
            round(float(place[high] - place[low]) / count * units_per_um)
            if count
            else 0
        )
    return steps[0], steps[1]
