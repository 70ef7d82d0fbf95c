"""How evenly the edges of all pillars are exposed, and how far the fast sum is from exact discs."""

from dataclasses import dataclass

import numpy as np

from layout.exposure import CLEARS, PointExposure, disc, rim_of_own_disc
from layout.pattern import NONE, Pattern
from metalens.store import Array

_NEIGHBOURS = 5  # sites on each side whose discs are taken exactly
_RIM = 2 * np.pi * (np.arange(24) + 0.5) / 24


@dataclass(frozen=True, slots=True)
class Uniformity:
    """Relative error of the exposure at the pillar edges, over all pillars.

    worst, rms: of exposure / wanted - 1.
    diameter_nm: the largest change of a made diameter that follows from it, through the slope of the exposure.
    """

    worst: float
    rms: float
    diameter_nm: float


class Tally:
    """Running extremes and squares of exposures about the wanted one."""

    def __init__(self, wanted: float) -> None:
        self._wanted, self._square, self._low, self._high = wanted, 0.0, wanted, wanted

    def add(self, edge: Array, none: Array) -> None:
        """Take in exposures (changed in place); those at ``none`` do not count."""
        np.copyto(edge, self._wanted, where=none)
        self._low, self._high = min(self._low, float(edge.min())), max(self._high, float(edge.max()))
        edge -= np.float32(self._wanted)
        self._square += float(np.vdot(edge, edge))

    def result(self, count: int, slope: float, shift: float = 0.0) -> Uniformity:
        """Over ``count`` pillars whose edges fall by ``slope`` per um at least.

        shift: largest error of the background that was taken in; it is added to all numbers.
        """
        worst = max(self._high - self._wanted, self._wanted - self._low) + shift
        rms = (self._square / count) ** 0.5 + shift
        return Uniformity(worst / self._wanted, rms / self._wanted, 2e3 * worst / slope)


def sampled_error(
    drawn: Pattern, field: Array, classes: Array, factors: Array, *, point: PointExposure, samples: int
) -> float:
    """Largest |fast - exact| / wanted exposure at evenly drawn pillars.

    Exact: whole discs of all pillars within 5 sites, seen round the rim, and the direct sum over every other
    pillar of Gaussians whose second moment is that of its disc.
    """
    rows, columns = np.nonzero(drawn.index) if samples * 8 > drawn.index.size else _some(drawn.index, samples)
    pick = np.unique(np.linspace(0, len(rows) - 1, samples).astype(int))
    rows, columns = rows[pick], columns[pick]
    dose = np.zeros(NONE + 1)
    dose[: len(factors)] = factors
    distant = _distant(drawn, classes, dose, rows, columns)
    worst = 0.0
    for n, (row, column) in enumerate(zip(rows, columns, strict=True)):
        entry = drawn.index[row, column]
        fast = dose[classes[row, column]] * drawn.own[entry] + _at(drawn, field, int(row), int(column))
        exact = distant[n] + _around(drawn, classes, dose, (int(row), int(column)), point)
        worst = max(worst, abs(fast - exact) / CLEARS)
    return float(worst)


def _some(index: Array, samples: int) -> tuple[Array, Array]:
    """Pillars of ``samples`` rows spread over the lens, so that no list of all pillars is made."""
    rows, columns = [], []
    for row in np.unique(np.linspace(0, index.shape[0] - 1, 4 * samples).astype(int)):
        found = np.nonzero(index[row])[0]
        pick = found[np.unique(np.linspace(0, len(found) - 1, samples).astype(int))] if len(found) else found
        rows.append(np.full(len(pick), row))
        columns.append(pick)
    return np.concatenate(rows), np.concatenate(columns)


def _at(drawn: Pattern, field: Array, row: int, column: int) -> float:
    y, x = drawn.axes
    return float(x.spread(y.spread(field.T)[:, row])[column])


def _distant(drawn: Pattern, classes: Array, dose: Array, rows: Array, columns: Array) -> Array:
    """(samples,) background from the pillars more than 5 sites away, by the direct sum of Gaussians."""
    (ny, nx), p = drawn.index.shape, drawn.pitch_um
    total = np.zeros(len(rows))
    area, given = drawn.area_um2.astype(np.float32), dose.astype(np.float32)
    for width, weight in zip(drawn.far.widths_um, drawn.far.weights, strict=True):
        wy, wx = (
            np.exp(-(((np.arange(n)[:, None] - centre) * p / width) ** 2)).astype(np.float32)
            for n, centre in ((ny, rows), (nx, columns))
        )
        share = weight / (np.pi * width**2)
        for band, index in drawn.bands():
            mass = area.take(index, mode="clip") * given.take(classes[band], mode="clip")
            total += share * ((mass @ wx) * wy[band]).sum(0, dtype=float)
        for n, (row, column) in enumerate(zip(rows, columns, strict=True)):
            near = _block(drawn, int(row), int(column))
            mass = drawn.area_um2[drawn.index[near]] * dose[classes[near]]
            total[n] -= share * (wy[near[0], n] @ mass @ wx[near[1], n])
    return total


def _block(drawn: Pattern, row: int, column: int) -> tuple[slice, slice]:
    """Sites within 5 of one, inside the lens."""
    k = _NEIGHBOURS
    return slice(max(row - k, 0), row + k + 1), slice(max(column - k, 0), column + k + 1)


def _around(drawn: Pattern, classes: Array, dose: Array, site: tuple[int, int], point: PointExposure) -> float:
    """Exposure at the rim of one pillar by itself and by the discs within 5 sites, exact."""
    (row, column), p = site, drawn.pitch_um
    rows, columns = _block(drawn, row, column)
    index, level = drawn.index[rows, columns], dose[classes[rows, columns]]
    y = (np.arange(index.shape[0]) + rows.start - row)[:, None] * p
    x = (np.arange(index.shape[1]) + columns.start - column) * p
    others = (index > 0) & ((y != 0) | (x != 0))
    own = drawn.diameter_um[drawn.index[row, column]]
    ring_y, ring_x = own / 2 * np.sin(_RIM)[:, None, None], own / 2 * np.cos(_RIM)[:, None, None]
    distance = np.hypot(y - ring_y, x - ring_x)[:, others]
    diameters, doses = drawn.diameter_um[index[others]], level[others]
    total = 0.0
    for width, weight in zip(point.widths_um, point.weights, strict=True):
        total += weight * float((disc(distance, diameters, width) * doses).sum(-1).mean())
        total += weight * float(dose[classes[site]] * rim_of_own_disc(own, width))
    return total
