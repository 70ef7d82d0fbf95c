"""Tilted walls as layers: a commutator-free Magnus method of fourth order.

Over a step dz of u' = i P w, w' = i Q u two layers of half the height stand for the cone, each with operators mixed
from those at the Gauss points 1/2 -+ sqrt(3)/6 of the step: (b, a) in the lower and (a, b) in the upper one, with
a, b = 1/2 -+ sqrt(3)/3 (Blanes and Moan, Appl. Numer. Math. 56, 1519 (2006)). Mixed P and Q stay symmetric, so that
power and reciprocity hold to rounding for any number of steps. (Plain slices are of second order: ten times as many
for 1e-3 of a 2 degree wall.)
"""

import math
from dataclasses import dataclass

from metalens.cell import Cell


@dataclass(frozen=True, slots=True)
class Section:
    """One layer: its share of the height, and the (weight, lift) of the cross-sections that it mixes.

    lift: height of the cross-section above the middle of the pillar, over the height of the pillar.
    """

    share: float
    nodes: tuple[tuple[float, float], ...]


def sections(steps: int) -> tuple[Section, ...]:
    """Layers of a tilted wall in this many steps, foot first; 0 steps: an upright wall."""
    if not steps:
        return (Section(1.0, ((1.0, 0.0),)),)
    small, large = 0.5 - math.sqrt(3) / 3, 0.5 + math.sqrt(3) / 3
    found = []
    for i in range(steps):
        low, high = ((i + 0.5 + sign * math.sqrt(3) / 6) / steps - 0.5 for sign in (-1, 1))
        found.append(Section(0.5 / steps, ((large, low), (small, high))))
        found.append(Section(0.5 / steps, ((small, low), (large, high))))
    return tuple(found)


def widening(cell: Cell) -> float:
    """Change of the diameter in micrometres for each unit of lift."""
    return -2 * math.tan(cell.sidewall_rad) * cell.height_um
