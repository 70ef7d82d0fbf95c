"""Room between what is placed on a die: the rule for gaps, and how far the scattered
electrons of a part reach.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from layout.arrange.joined import PER_UM, PartPlacement
from layout.arrange.parts import APERTURE, DieComponent, box_around, box_distance
from layout.drc.report import Violation
from layout.formats.library import CellReference, Orientation
from layout.pec import psf
from layout.process.process import Process
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

MOST_PLACED = 4000  # parts on a die


@dataclass(frozen=True, eq=False, slots=True)
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
    most = psf.THRESHOLD * process.exposure.tolerance

    def added(away_um: float) -> float:
        pairs = zip(point.weights.tolist(), point.widths_um.tolist(), strict=True)
        return float(sum(w / 2 * math.erfc(away_um / a) for w, a in pairs))

    low, high = 0.0, 8 * float(point.widths_um.max())
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if added(middle) > most else (low, middle)
    return high


def check_separation(
    placed: Sequence[PartPlacement], process: Process
) -> list[Violation]:
    """Pairs of parts that are nearer than the least gap, or than one's backscatter lets
    the other's doses hold.

    Rectilinear shapes are taken as they are, lattices as boxes of some of their pillars
    (squares of a 64th of the
    lattice), any other shape as boxes around slices of it (5 um high, or a 64th).

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
    far = reach_um(process) * PER_UM
    around = np.array([one.box() for one in standing])
    found: list[Violation] = []
    for n, one in enumerate(standing):
        for m in np.flatnonzero(
            box_distance(around[n + 1 :], around[n]) < max(gap, far)
        ).tolist():
            two = standing[n + 1 + m]
            scattered = far if one.part.corrected or two.part.corrected else 0.0
            found += _between(one, two, gap, scattered, process)
    return found


def extent_of_copies(
    placed: Sequence[PartPlacement], *, exposed: bool = False
) -> Array:
    """(4,) left, bottom, right, top of all copies in units, outlines too; ``exposed``:
    of what is exposed alone.

    Args:
        placed: parts on the die.
    """
    made = []
    for one in standing_parts(placed):
        made.append(one.box() if exposed else one.moved(one.part.extent[None])[0])
    return box_around(np.array(made))


def standing_parts(placed: Sequence[PartPlacement]) -> Iterator[StandingPart]:
    """Every copy of every part.

    Args:
        placed: parts on the die.

    Raises:
        ProcessError: more than 4000 copies of a part.
    """
    for placing in placed:
        for copies in placing.copies(placing.part.top):
            yield from _each(placing.part, copies)


def _each(part: DieComponent, copies: CellReference) -> Iterator[StandingPart]:
    if copies.count > MOST_PLACED:
        raise ProcessError(
            f"{copies.count} copies of {part.name} on a die, at most {MOST_PLACED} are checked"
        )
    for x, y in zip(*(v.tolist() for v in copies.places()), strict=True):
        yield StandingPart(part, copies.turn, x, y)


def _between(
    one: StandingPart, two: StandingPart, gap: float, scattered: float, process: Process
) -> Iterator[Violation]:
    """At most one finding for each exposure that both have shapes of."""
    for kind in sorted(one.part.boxes.keys() & two.part.boxes.keys()):
        first = one.moved(one.part.boxes[kind])
        second = two.moved(two.part.boxes[kind])
        need = gap if kind == APERTURE else max(gap, scattered)
        first = (
            first[box_distance(first, box_around(second)) < need]
            if len(first) and len(second)
            else first[:0]
        )
        second = (
            second[box_distance(second, box_around(first)) < need]
            if len(first)
            else second[:0]
        )
        least = math.inf
        box = np.zeros(4)
        for each in second if len(first) else ():
            distance = box_distance(first, each)
            n = int(distance.argmin())
            if distance[n] < least:
                least = float(distance[n])
                box = box_around(np.stack([first[n], each]))
        if least >= need:
            continue
        left, bottom, right, top = (int(v) for v in box)
        nm = least * 1e3 / PER_UM
        if least < gap:
            limit = process.rules.minimum_gap_nm
            text = f"{one.text} to {two.text}, {kind}"
        else:
            limit = need * 1e3 / PER_UM
            text = f"{one.text} to {two.text}: backscatter of one that the doses of the other do not know of"
        yield Violation("clearance", (left, bottom, right, top), nm, limit, text)
