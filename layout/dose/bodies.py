"""What is exposed: lattices of pillars in blocks of rows, rectangles, and the table of what each pillar exposes."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from layout.dose.exposure import PointExposure, disc, rim_of_own_disc, slope_at_rim
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError

NONE = 255  # dose class of a site without pillar
_BLOCK_SITES = 1 << 20
_FAINT = 0.02  # least exposure of its own edge at which a pillar can be corrected
_NEGLIGIBLE = 5e-4  # exposure by the four nearest pillars that is left out
_COARSE = 6  # pitches: a Gaussian that wide needs no node at each site


@dataclass(frozen=True, eq=False, slots=True)
class Body:
    """A lattice of pillars.

    source: (first row, end row) -> (rows, columns) entries of the table, 0 for none.
    x_um: of the first column; y_um: of the first row; rows run towards -y.
    """

    rows: int
    columns: int
    pitch_um: float
    x_um: float
    y_um: float
    source: Callable[[int, int], Array]

    @classmethod
    def of(cls, index: Array, pitch_um: float) -> "Body":
        """A lattice in memory, its first site at (0, 0)."""
        return cls(index.shape[0], index.shape[1], pitch_um, 0.0, 0.0, lambda first, end: index[first:end])

    def blocks(self) -> Iterator[tuple[int, Array]]:
        """(first row, entries) of blocks of rows."""
        size = max(1, _BLOCK_SITES // max(1, self.columns))
        for first in range(0, self.rows, size):
            yield first, np.ascontiguousarray(self.source(first, min(first + size, self.rows)))

    @property
    def columns_um(self) -> Array:
        """(columns,) x of the sites."""
        return self.x_um + np.arange(self.columns) * self.pitch_um

    def rows_um(self, first: int, count: int) -> Array:
        """(count,) y of rows from ``first`` on."""
        return self.y_um - np.arange(first, first + count) * self.pitch_um

    @property
    def box_um(self) -> tuple[float, float, float, float]:
        """Left, bottom, right, top."""
        right, bottom = self.x_um + (self.columns - 1) * self.pitch_um, self.y_um - (self.rows - 1) * self.pitch_um
        return self.x_um, bottom, right, self.y_um


@dataclass(frozen=True, eq=False, slots=True)
class Rects:
    """Rectangles that are written in the same exposure, a dose each.

    box_um: (n, 4) left, bottom, right, top. group: (n,) which shape each is a piece of. goal: (n,) as in Table.
    """

    box_um: Array
    group: Array
    goal: Array

    @classmethod
    def none(cls) -> "Rects":
        """No rectangle."""
        return cls(np.empty((0, 4)), np.empty(0, np.int64), np.empty(0))

    @property
    def area_um2(self) -> Array:
        """(n,) areas."""
        return np.asarray((self.box_um[:, 2] - self.box_um[:, 0]) * (self.box_um[:, 3] - self.box_um[:, 1]))


@dataclass(frozen=True, eq=False, slots=True)
class Table:
    """What each entry exposes at unit dose; entry 0 is no pillar.

    diameter_um, area_um2: (entries,). goal: (entries,) wanted exposure of the edge, in units of what clears.
    own: (entries,) exposure at the edge by the pillar itself, less what the far field counts for it.
    slope: (entries,) its fall per um of radius. count: (entries,) pillars of each.
    """

    diameter_um: Array
    area_um2: Array
    goal: Array
    own: Array
    slope: Array
    count: Array

    @property
    def used(self) -> Array:
        """(entries,) which occur."""
        return np.asarray(self.count > 0)


@dataclass(frozen=True, eq=False, slots=True)
class Ranges:
    """The point exposure split by how far its Gaussians reach.

    far: at least six pitches wide, summed on nodes over the whole die. middle: reach neighbours only, summed on the
    sites of each lattice. near: reach no neighbour. Widths of far and middle are widened by the mean pillar: a disc
    adds R^2 / 2 to the squared width of a Gaussian, the ring on which it is seen R^2.
    """

    far: PointExposure
    middle: PointExposure
    near: PointExposure


def count(bodies: Sequence[Body], entries: int) -> Array:
    """(entries,) pillars of each entry in all bodies."""
    total = np.zeros(entries, np.int64)
    for body in bodies:
        for _, block in body.blocks():
            total += np.bincount(block.ravel(), minlength=entries)
    total[0] = 0
    return total


def split(point: PointExposure, diameter_um: Array, number: Array, pitch_um: float) -> Ranges:
    """Which Gaussians reach how far, for pillars of these diameters."""
    area = np.pi / 4 * diameter_um**2
    total = float((number * area).sum())
    mean_square = float((number * area * diameter_um**2).sum() / total) if total else 0.0
    widest = float(diameter_um[number > 0].max(initial=0.0))
    angle = 2 * np.pi * (np.arange(24) + 0.5) / 24
    distance = np.hypot(pitch_um - widest / 2 * np.cos(angle), widest / 2 * np.sin(angle))
    reach = np.array([4 * disc(distance, widest, width).mean() for width in point.widths_um])
    far = point.widths_um >= _COARSE * pitch_um
    middle = ~far & ((reach * point.weights > _NEGLIGIBLE) | (point.widths_um > pitch_um))

    def some(chosen: Array, wider: float) -> PointExposure:
        return PointExposure(np.sqrt(point.widths_um[chosen] ** 2 + wider), point.weights[chosen])

    return Ranges(some(far, 1.5 * mean_square / 4), some(middle, 1.5 * mean_square / 4), some(~far & ~middle, 0.0))


def table(
    diameter_um: Array, goal: Array, number: Array, *, point: PointExposure, ranges: Ranges, pitch_um: float
) -> Table:
    """The table of a mask.

    Args:
        pitch_um: the least of the lattices.

    Raises:
        ProcessError: no pillar, or pillars so much finer than the point exposure that their own dose hardly tells.
    """
    used = number > 0
    if not used.any():
        raise ProcessError("no pillar is drawn: there is nothing to expose")
    diameter = np.where(used, diameter_um, 0.0)
    area = np.pi / 4 * diameter**2
    whole = sum(w * rim_of_own_disc(diameter, a) for a, w in zip(point.widths_um, point.weights, strict=True))
    own = np.where(used, whole - area * float(ranges.far.density(np.array(0.0))), 0.0)
    beside = area * _beside(ranges.middle, pitch_um)
    if own[used].min() < _FAINT or (beside >= 0.9 * own)[used].any():
        thin = 1e3 * float(diameter[used][own[used].argmin()])
        raise ProcessError(
            f"a pillar of {thin:.0f} nm gives its own edge an exposure of {own[used].min():.3f} only, less than its "
            "neighbours do: the core of the point exposure (alpha_um) is too wide for these pillars"
        )
    slope = sum(w * slope_at_rim(diameter, a) for a, w in zip(point.widths_um, point.weights, strict=True))
    return Table(diameter, area, goal, own, np.where(used, slope, 0), number)


def _beside(middle: PointExposure, pitch_um: float) -> float:
    """Bound of the eigenvalues of what the sites of a square lattice, unit masses, give to each other, per um^2.

    The sum over all other sites; or, as the whole kernel has no negative ones, what a site would give to itself.
    """
    far = int(np.ceil(5 * float(middle.widths_um.max(initial=0.0)) / pitch_um))
    apart = np.arange(-far, far + 1) * pitch_um
    itself = float(middle.density(np.array(0.0)))
    return min(itself, float(middle.density(np.hypot(apart[:, None], apart)).sum()) - itself)
