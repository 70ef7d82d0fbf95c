"""Comparison of a file that is read back: cells, shapes, every instance at its place."""

import dataclasses
from collections import Counter
from dataclasses import dataclass

import numpy as np

from layout.formats.digest import RunningDigest
from layout.formats.library import (
    QUARTERS,
    UPRIGHT,
    MaskCell,
    MaskLibrary,
    Orientation,
    library_of,
)
from layout.mask.plan import MaskPlan
from layout.shapes import polygon
from metalens.core.arrays import Array
from metalens.core.errors import MaskFileError

Who = tuple[str, Orientation | None]  # a child and its orientation, None: all together
Sum = tuple[int, ...]  # count, sums of x and y, number turned, hash of all places


@dataclass(frozen=True)
class ReadbackComparison:
    """Outcome of reading a mask back.

    pillars: placements of the pillar classes below the top cell.
    differences: what does not agree with the plan, in words.
    """

    pillars: int
    differences: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether file and plan are the same."""
        return not self.differences


def compare(plan: MaskPlan, content: MaskLibrary) -> ReadbackComparison:
    """Whether a file holds exactly a plan.

    Args:
        plan: that was written.
        content: of the file; of cells with many placements the sums are enough.
    """
    differences = mask_differences(library_of(plan), content)
    try:
        times = content.drawn_counts()
    except MaskFileError as error:
        return ReadbackComparison(0, (*differences, str(error)))
    pillars = sum(times.get(pillar.name, 0) for pillar in plan.classes)
    return ReadbackComparison(pillars, tuple(differences))


def mask_differences(library: MaskLibrary, content: MaskLibrary) -> list[str]:
    """What a file does not hold as it was planned, in words; empty where it holds all.

    Circles count as the polygons of 64 corners that GDSII has in their place.

    Args:
        library: that was written.
        content: of the file.
    """
    differences = []
    if abs(content.unit_nm / library.unit_nm - 1) > 1e-12:
        differences.append(
            f"database unit {content.unit_nm} nm, planned {library.unit_nm}"
        )
    missing = sorted(library.cells.keys() - content.cells.keys())
    extra = sorted(content.cells.keys() - library.cells.keys())
    if missing or extra:
        names = ", ".join([*missing, *extra][:5])
        return [
            *differences,
            f"{len(missing)} cells are missing, {len(extra)} too many: {names}",
        ]
    for name, cell in library.cells.items():
        read = content.cells[name]
        differences += _shape_differences(cell, read)
        merged = bool(read.sums)
        planned_sums = _sums(cell, merged=merged)
        read_sums = _sums(read, merged=merged)
        for child in sorted(planned_sums.keys() | read_sums.keys(), key=str):
            expected = planned_sums.get(child, (0,) * 5)
            actual = read_sums.get(child, (0,) * 5)
            if expected != actual:
                differences.append(
                    f"cell {name}: {child[0]}: {_difference(expected, actual)}"
                )
    return differences


def _difference(planned: Sum, read: Sum) -> str:
    """What differs between the sums of a child, in words."""
    (count, x, y, turned, _), (read_count, read_x, read_y, read_turned, _) = (
        planned,
        read,
    )
    if turned != read_turned:
        return f"{read_turned} copies are turned, planned {turned}"
    missing = count - read_count
    if abs(missing) == 1:
        text = "one is missing" if missing > 0 else "one too many"
        return f"{text}, at ({missing * (x - read_x)}, {missing * (y - read_y)})"
    if missing:
        return f"{read_count} copies, planned {count}"
    return f"{count} copies, not all at their places"


def _shape_differences(planned: MaskCell, read: MaskCell) -> list[str]:
    """Polygons of a cell that are missing, or that were not planned, by layer in words.

    Args:
        planned: that was written.
        read: of the file.
    """
    expected, actual = (
        Counter(
            (layer, _canonical_corners(points))
            for layer, shapes in cell.polygons.items()
            for points in shapes
        )
        for cell in (planned, read)
    )
    differences = []
    for remainder, text in (
        (expected - actual, "missing"),
        (actual - expected, "not planned"),
    ):
        layers = Counter(layer for layer, _ in remainder.elements())
        differences += [
            f"cell {planned.name}, layer {layer}/{datatype}: {count} polygons {text}"
            for (layer, datatype), count in sorted(layers.items())
        ]
    return differences


def _canonical_corners(points: Array) -> bytes:
    """Corners from the smallest on, counter-clockwise."""
    corners = np.asarray(points, np.int64)
    if polygon.twice_area(corners) < 0:
        corners = corners[::-1]
    first = int(np.lexsort((corners[:, 1], corners[:, 0]))[0])
    return np.roll(corners, -first, axis=0).tobytes()


def _sums(cell: MaskCell, *, merged: bool) -> dict[Who, Sum]:
    """Sums over the instances of each child and orientation.

    Args:
        cell: as planned, or as read.
        merged: all orientations of a child together, as sums are kept while reading.
    """
    if cell.sums:
        return {(child, None): sums for child, sums in cell.sums.items()}
    digests: dict[Who, RunningDigest] = {}
    for child, turn, x, y in dataclasses.replace(cell, pillars=None).instances():
        who = _rounded(turn)
        digest = digests.setdefault((child, None if merged else who), RunningDigest())
        index = QUARTERS.index(who) if who in QUARTERS else len(QUARTERS)
        turned = np.full(len(x), index if merged else 0, np.uint8)
        digest.take(np.zeros(len(x), np.int64), x, y, turned)
    zero = np.zeros(1, np.int64)
    sums = {who: tuple(digest.of(zero)[0].tolist()) for who, digest in digests.items()}
    if cell.pillars is not None:
        key = None if merged else UPRIGHT
        sums |= {(child, key): v for child, v in cell.pillars.sums().items()}
    return sums


def _rounded(turn: Orientation) -> Orientation:
    """As both formats hold it: GDSII has 56 bits of a fraction to the base 16."""
    angle = round(turn.angle_deg % 360, 9) % 360
    return Orientation(angle, turn.mirrored, float(f"{turn.scale:.12g}"))
