"""What drawn pillars expose: a table by diameter, looked up band by band of rows."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from layout.exposure import PointExposure, disc, rim_of_own_disc, slope_at_rim
from layout.nodes import Axis
from metalens.errors import ProcessError
from metalens.store import Array

NONE = 255  # dose class of a site without pillar
_BAND = 64  # rows worked on at a time, so that they stay in the cache
_FAINT = 0.02  # least exposure of its own edge at which a pillar can be corrected
_NEGLIGIBLE = 5e-4  # exposure by the four nearest pillars that is left out


@dataclass(frozen=True, eq=False, slots=True)
class Pattern:
    """Pillars as an index into a table, and what each entry of the table exposes at unit dose.

    index: (y, x) entry, 0 where there is no pillar, filled up with 0 to whole cells of the axes.
    axes: nodes along y and x.
    diameter_um, area_um2: (entries,); entry 0 has no area.
    own: (entries,) exposure at the edge by the pillar itself, less what the background counts for it, if it does.
    slope: (entries,) its fall per um of radius.
    count: (entries,) pillars of each.
    far: the part of the point exposure that reaches other pillars, each width widened by the mean pillar.
    hollow: whether the background leaves each pillar's own part out (nodes that are sites).
    self_weight: largest share of the own exposure that the background's Gaussians would count for it, if hollow.
    """

    index: Array
    axes: tuple[Axis, Axis]
    diameter_um: Array
    area_um2: Array
    own: Array
    slope: Array
    count: Array
    far: PointExposure
    hollow: bool
    self_weight: float
    pitch_um: float

    def bands(self) -> Iterator[tuple[slice, Array]]:
        """(rows, index) of bands of rows."""
        for start in range(0, self.index.shape[0], _BAND):
            rows = slice(start, min(start + _BAND, self.index.shape[0]))
            yield rows, self.index[rows]

    def gather(self, *tables: Array) -> tuple[Array, ...]:
        """(nodes y, nodes x) sums of each table's entries over the pillars, by node."""
        y, x = self.axes
        rows = [np.zeros((y.sites, x.nodes), np.float32) for _ in tables]
        narrow = [table.astype(np.float32) for table in tables]
        for band, index in self.bands():
            for target, table in zip(rows, narrow, strict=True):
                target[band] = x.gather(np.take(table, index, mode="clip"))
        return tuple(y.gather(target.T.astype(float)).T for target in rows)


def pattern(index: Array, diameter_um: Array, pitch_um: float, *, point: PointExposure) -> Pattern:
    """The table of a mask; widths of the point exposure that reach no neighbour are kept out of the background.

    Raises:
        ProcessError: no pillar, or pillars so much finer than the point exposure that their own dose hardly
            tells at their edge.
    """
    count = np.zeros(len(diameter_um), int)
    for rows in np.array_split(index, 1 + len(index) // _BAND):
        count += np.bincount(rows.ravel(), minlength=len(diameter_um))
    count[0] = 0
    used = count > 0
    if not used.any():
        raise ProcessError("no pillar is drawn: there is nothing to expose")
    diameter = np.where(used, diameter_um, 0.0)
    area = np.pi / 4 * diameter**2
    mean_square = float((count * area * diameter**2).sum() / (count * area).sum())
    far = _far(point, diameter.max(), mean_square, pitch_um)
    step = max(1, int(float(far.widths_um.min()) / 6 / pitch_um))
    own = sum(w * rim_of_own_disc(diameter, a) for a, w in zip(point.widths_um, point.weights, strict=True))
    counted = area * float(far.density(np.array(0.0)))
    if step > 1:
        own, counted = own - counted, np.zeros_like(area)
    _check_own(own[used], counted[used], diameter[used])
    slope = sum(w * slope_at_rim(diameter, a) for a, w in zip(point.widths_um, point.weights, strict=True))
    axes = (Axis(-(-index.shape[0] // step), step), Axis(-(-index.shape[1] // step), step))
    short = [(0, axis.sites - n) for axis, n in zip(axes, index.shape, strict=True)]
    return Pattern(
        index=np.pad(index, short),
        axes=axes,
        diameter_um=diameter,
        area_um2=area,
        own=np.where(used, own, 0),
        slope=np.where(used, slope, 0),
        count=count,
        far=far,
        hollow=step == 1,
        self_weight=float((counted[used] / own[used]).max()),
        pitch_um=pitch_um,
    )


def _check_own(own: Array, counted: Array, diameter: Array) -> None:
    if own.min() < _FAINT or (counted >= 0.9 * own).any():
        thin = 1e3 * float(diameter[own.argmin()])
        raise ProcessError(
            f"a pillar of {thin:.0f} nm gives its own edge an exposure of {own.min():.3f} only, less than its "
            "neighbours do: the core of the point exposure (alpha_um) is too wide for these pillars"
        )


def _far(point: PointExposure, widest: float, mean_square: float, pitch_um: float) -> PointExposure:
    """The terms that reach a neighbour, widened by the size of the pillars.

    A disc adds R^2 / 2 to the squared width of a Gaussian, the ring on which it is seen R^2.
    """
    angle = 2 * np.pi * (np.arange(24) + 0.5) / 24
    distance = np.hypot(pitch_um - widest / 2 * np.cos(angle), widest / 2 * np.sin(angle))
    reach = np.array([4 * disc(distance, widest, width).mean() for width in point.widths_um])
    reaches = (reach * point.weights > _NEGLIGIBLE) | (point.widths_um > pitch_um)
    if not reaches.any():
        return PointExposure(np.array([6 * pitch_um]), np.array([0.0]))
    return PointExposure(np.sqrt(point.widths_um[reaches] ** 2 + 1.5 * mean_square / 4), point.weights[reaches])
