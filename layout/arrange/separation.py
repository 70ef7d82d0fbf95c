"""Room between what is placed on a die: the rule for gaps, and how far the scattered
electrons of a part reach.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from layout.arrange.assembly import PER_UM, PartPlacement
from layout.arrange.parts import APERTURE, DieComponent, box_around
from layout.drc.report import RuleViolation
from layout.formats.library import Orientation
from layout.pec import psf
from layout.process.process import Process
from layout.shapes.rectilinear import box_distance
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

MOST_PLACED = 4000  # parts on a die


@dataclass(frozen=True, eq=False)
class StandingPart:
    """One copy of a part: where, and the boxes of its exposures there."""

    part: DieComponent
    turn: Orientation
    x: int
    y: int

    @property
    def text(self) -> str:
        """Name and place."""
        return f"{self.part.name} at ({self.x / PER_UM:g}, {self.y / PER_UM:g}) um"

    def box(self) -> Array:
        """(4,) around all that is exposed."""
        every = np.concatenate(list(self.part.boxes.values()) or [np.zeros((0, 4))])
        return box_around(self.moved(every))

    def moved(self, boxes: Array) -> Array:
        """(n, 4) boxes around the turned boxes."""
        corners = boxes[:, [[0, 1], [2, 1], [2, 3], [0, 3]]]
        x, y = self.turn.apply(corners[..., 0], corners[..., 1])
        return np.column_stack(
            [x.min(1) + self.x, y.min(1) + self.y, x.max(1) + self.x, y.max(1) + self.y]
        )


def reach_um(process: Process) -> float:
    """Distance from a wide exposed area at which it adds less than the tolerance of the
    correction; 0 without one.

    The half-plane gives sum w/2 erfc(d / a) of the exposure of its own middle, and
    dose-to-size is half of that.

    Args:
        process: with the point exposure and its tolerance.
    """
    if not process.exposure.corrected:
        return 0.0
    point = psf.point_exposure(process.exposure)
    allowed = psf.THRESHOLD * min(process.exposure.tolerance, 0.999)

    def exposure_at(away_um: float) -> float:
        return sum(w / 2 * math.erfc(away_um / width) for width, w in point.terms)

    farthest = 8 * float(point.widths_um.max())
    from scipy.optimize import brentq

    return float(brentq(lambda away: exposure_at(away) - allowed, 0, farthest))


def check_separation(
    placed: Sequence[PartPlacement], process: Process
) -> list[RuleViolation]:
    """Pairs of parts closer than the gap rule, or in reach of scattered electrons.

    Rectilinear shapes are taken as they are. A lattice is taken as boxes of tiles (a
    64th of it each way), any other shape as boxes of slices (5 um high, or a 64th).

    Args:
        placed: parts on the die.
        process: rules and exposure.

    Raises:
        ProcessError: more than 4000 parts on the die.
    """
    standing = list(standing_parts(placed))
    if len(standing) > MOST_PLACED:
        raise ProcessError(
            f"{len(standing)} parts on a die, at most {MOST_PLACED} are checked; step dies on a wafer"
        )
    gap = process.rules.minimum_gap_nm * PER_UM / 1e3
    reach = reach_um(process) * PER_UM
    boxes = np.array([first.box() for first in standing])
    violations: list[RuleViolation] = []
    for i, first in enumerate(standing):
        for j in np.flatnonzero(
            box_distance(boxes[i + 1 :], boxes[i]) < max(gap, reach)
        ).tolist():
            second = standing[i + 1 + j]
            scattered = reach if first.part.corrected or second.part.corrected else 0.0
            violations += _between(first, second, gap, scattered, process)
    return violations


def extent_um(placed: Sequence[PartPlacement], *, exposed: bool = False) -> Array:
    """(4,) left, bottom, right, top around all copies.

    Args:
        placed: parts on the die.
        exposed: whether only exposed shapes count; else outlines count too.
    """
    boxes = []
    for copy in standing_parts(placed):
        boxes.append(copy.box() if exposed else copy.moved(copy.part.extent[None])[0])
    return box_around(np.array(boxes)) / PER_UM


def standing_parts(placed: Sequence[PartPlacement]) -> Iterator[StandingPart]:
    """Every copy of every part.

    Args:
        placed: parts on the die.
    """
    for placing in placed:
        for copies in placing.copies(placing.part.top):
            for x, y in zip(*map(np.ndarray.tolist, copies.places()), strict=True):
                yield StandingPart(placing.part, copies.turn, x, y)


def _between(
    part_1: StandingPart,
    part_2: StandingPart,
    gap: float,
    scattered: float,
    process: Process,
) -> Iterator[RuleViolation]:
    """Violations between two parts: the closest boxes of each common exposure.

    Args:
        part_1, part_2: copies on the die.
        gap: least distance by the rules, database units.
        scattered: distance at which scattered electrons matter, database units.
        process: rules, for the limit that is reported.

    Yields:
        At most one violation for each exposure.
    """
    for exposure in sorted(part_1.part.boxes.keys() & part_2.part.boxes.keys()):
        boxes_1 = part_1.moved(part_1.part.boxes[exposure])
        boxes_2 = part_2.moved(part_2.part.boxes[exposure])
        limit_units = gap if exposure == APERTURE else max(gap, scattered)
        if not (len(boxes_1) and len(boxes_2)):
            continue
        boxes_1 = boxes_1[box_distance(boxes_1, box_around(boxes_2)) < limit_units]
        boxes_2 = boxes_2[box_distance(boxes_2, box_around(boxes_1)) < limit_units]
        distances = np.array([box_distance(boxes_2, box) for box in boxes_1])
        smallest = float(distances.min(initial=math.inf))
        if smallest >= limit_units:
            continue
        i, j = np.argwhere(distances == smallest)[0]
        box = box_around(np.stack([boxes_1[i], boxes_2[j]]))
        left, bottom, right, top = (int(side) for side in box)
        distance_nm = smallest * 1e3 / PER_UM
        if smallest < gap:
            limit_nm = process.rules.minimum_gap_nm
            text = f"{part_1.text} to {part_2.text}, {exposure}"
        else:
            limit_nm = limit_units * 1e3 / PER_UM
            text = f"{part_1.text} to {part_2.text}: backscatter of one that the doses of the other do not know of"
        yield RuleViolation(
            "clearance", (left, bottom, right, top), distance_nm, limit_nm, text
        )
