"""What each kind of pillar exposes at unit dose: discs in closed form, any other shape
by its polygons.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from layout.pec.psf import PointExposure, disc_exposure, rim_of_own_disc, slope_at_rim
from layout.process.jit import compile_loop
from layout.shapes.moments import (
    Contours,
    perimeter,
    points_along_edges,
    polygon_moments,
)
from metalens.core.arrays import Array

_RIM = 2 * np.pi * (np.arange(24) + 0.5) / 24
_EDGE_POINTS = 48  # points along the edges that neighbours are seen from
_PANEL = 0.8  # of the narrowest Gaussian, between four Gauss points
_PIXEL = 1 / 6  # of it, of the raster on which the level is found
_MOST_PIXELS = 1200  # along a side
_HALVINGS = 34


@dataclass(frozen=True, eq=False)
class DrawnDiscs:
    """Round pillars. diameter_um: (entries,)."""

    diameter_um: Array

    @property
    def area_um2(self) -> Array:
        """pi D^2 / 4."""
        return np.asarray(np.pi / 4 * self.diameter_um**2)

    @property
    def wider_um2(self) -> Array:
        """R^2 / 2 of the disc and R^2 of the ring on which it is seen."""
        return np.asarray(1.5 * self.diameter_um**2 / 4)

    def edge_exposure(self, used: Array, point: PointExposure) -> tuple[Array, Array]:
        """Exposure of the edge by the pillar itself, and its fall; exact.

        Args:
            used: (entries,) which occur.
            point: exposure of a beam.

        Returns:
            (entries,) ``own`` at unit dose, and its fall per um that all edges move
            out; 0 where not used.
        """
        d = np.where(used, self.diameter_um, 0.0)
        terms = list(zip(point.widths_um, point.weights, strict=True))
        own, slope = (
            sum(w * f(d, a) for a, w in terms) for f in (rim_of_own_disc, slope_at_rim)
        )
        return np.asarray(own), np.where(used, slope, 0)

    def edge_points_um(self, entry: int) -> Array:
        """(n, 2) places along the edges, from the site."""
        return np.asarray(
            self.diameter_um[entry] / 2 * np.stack([np.cos(_RIM), np.sin(_RIM)], -1)
        )

    def exposure_at(self, entry: int, at_um: Array, width_um: float) -> Array:
        """Exposure by one Gaussian at unit dose, exact.

        Args:
            entry: kind of the pillar.
            at_um: (..., 2) places from its site.
            width_um: 1/e radius.
        """
        return disc_exposure(
            np.hypot(at_um[..., 0], at_um[..., 1]), self.diameter_um[entry], width_um
        )

    def widest(self, used: Array, steps_um: Array) -> list[int]:
        """The thickest."""
        return [int(np.where(used, self.diameter_um, 0.0).argmax())]


@dataclass(frozen=True, eq=False)
class DrawnOutlines:
    """Pillars of any shape. contours: of each entry, those of entry 0 empty."""

    contours: Sequence[Contours]

    @cached_property
    def area_um2(self) -> Array:
        """By Green's theorem."""
        return np.array([polygon_moments(each)[0] for each in self.contours])

    @property
    def diameter_um(self) -> Array:
        """Of the circle of equal area."""
        return np.asarray(2 * np.sqrt(self.area_um2 / np.pi))

    @cached_property
    def wider_um2(self) -> Array:
        """Mean squared distance from the centroid, over the area and over the edges."""
        return np.array([_wider(each) if each else 0.0 for each in self.contours])

    def edge_exposure(self, used: Array, point: PointExposure) -> tuple[Array, Array]:
        """As of :class:`DrawnDiscs`; to 5e-4 of itself (pixels of a sixth of the
        narrowest
        Gaussian).
        """
        found = np.zeros((2, len(self.contours)))
        for k in np.flatnonzero(used).tolist():
            found[:, k] = _level(self.contours[k], float(self.area_um2[k]), point)
        return found[0], found[1]

    def edge_points_um(self, entry: int) -> Array:
        """As of :class:`DrawnDiscs`, evenly spaced."""
        return points_along_edges(self.contours[entry], _EDGE_POINTS)

    def exposure_at(self, entry: int, at_um: Array, width_um: float) -> Array:
        """As of :class:`DrawnDiscs`; four Gauss points to 0.8 widths, 1e-6."""
        places = at_um.reshape(-1, 2)
        y, weight, crossing = _lines(self.contours[entry], width_um)
        bell = (
            weight
            * np.exp(-(((places[:, 1:] - y) / width_um) ** 2))
            / (np.sqrt(np.pi) * width_um)
        )
        return np.asarray(
            (bell * _erf((crossing - places[:, :1]) / width_um)).sum(1) / 2
        ).reshape(at_um.shape[:-1])

    def widest(self, used: Array, steps_um: Array) -> list[int]:
        """The one that reaches farthest along each of the steps."""
        some = np.flatnonzero(used).tolist()
        far = np.array(
            [(np.concatenate(list(self.contours[k])) @ steps_um.T).max(0) for k in some]
        )
        return sorted({some[k] for k in far.argmax(0).tolist()})


DrawnKinds = DrawnDiscs | DrawnOutlines


def _wider(contours: Contours) -> float:
    area, first, second = polygon_moments(contours)
    centre = first / area
    points = points_along_edges(contours, 4 * _EDGE_POINTS) - centre
    return float(second / area - centre @ centre + (points**2).sum(1).mean())


def _lines(contours: Contours, narrow_um: float) -> tuple[Array, Array, Array]:
    """Crossings of level lines with edges: (n,) heights, Gauss weights (below 0 where
    the edge runs down), and places.

    The integral over the shape of f(x) g(y) is the sum of weight g(y) F(place), F' = f.
    """
    start = np.concatenate(list(contours))
    end = np.concatenate([np.roll(c, -1, axis=0) for c in contours])
    stops = np.unique(start[:, 1])
    counts = np.maximum(np.ceil(np.diff(stops) / (_PANEL * narrow_um)).astype(int), 1)
    left = np.concatenate(
        [
            a + (b - a) / n * np.arange(n)
            for a, b, n in zip(stops, stops[1:], counts, strict=False)
        ]
    )
    wide = np.repeat(np.diff(stops) / counts, counts)
    node, share = np.polynomial.legendre.leggauss(4)
    y = (left[:, None] + wide[:, None] * (node + 1) / 2).ravel()
    weight = (wide[:, None] * share / 2).ravel()
    low = np.minimum(start[:, 1], end[:, 1])
    high = np.maximum(start[:, 1], end[:, 1])
    edge, line = np.nonzero((low[:, None] < y) & (y < high[:, None]))
    rise = (end - start)[edge]
    place = start[edge, 0] + (y[line] - start[edge, 1]) / rise[:, 1] * rise[:, 0]
    return y[line], weight[line] * np.sign(rise[:, 1]), place


def _level(
    contours: Contours, area_um2: float, point: PointExposure
) -> tuple[float, float]:
    """Level that the exposure of a shape by itself exceeds on its own area, and its
    fall per um that edges move out.
    """
    corners = np.concatenate(list(contours))
    core = float(point.widths_um.min())
    size = float(np.ptp(corners, axis=0).max())
    pixel = max(_PIXEL * core, size / _MOST_PIXELS)
    margin = min(2 * core, size)
    x, y = (
        np.arange(low - margin, high + margin + pixel, pixel)
        for low, high in zip(*_box(corners), strict=True)
    )
    height, weight, place = _lines(contours, core)
    image = np.zeros((len(y), len(x)))
    for width, share in zip(point.widths_um, point.weights, strict=True):
        bell = (
            weight
            * np.exp(-(((y[:, None] - height) / width) ** 2))
            / (np.sqrt(np.pi) * width)
        )
        image += share / 2 * (bell @ _erf((place[:, None] - x) / width))
    down, across = np.gradient(image)  # per pixel

    def larger(level: float) -> float:
        return float(_above(image, down, across, level)) * pixel**2

    low, high = 0.0, float(image.max())
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if larger(middle) > area_um2 else (low, middle)
    level = (low + high) / 2
    off = 0.15 * level  # a few pixels, so that their places do not tell
    return level, perimeter(contours) / max(
        (larger(level - off) - larger(level + off)) / (2 * off), 1e-12
    )


@compile_loop
def _above(image: Array, down: Array, across: Array, level: float) -> float:
    """Pixels on which a picture is above a level: of each the share of the half plane
    by its slope.

    Straight edges of any turn are cut exactly: along one at 45 degrees all pixels are
    cut alike, and what is off in
    one is off in all.
    """
    total = 0.0
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            p, q = abs(down[row, column]), abs(across[row, column])
            steep = max(p, q)
            flat = min(p, q)
            over = image[row, column] - level
            beyond = (p + q) / 2 - abs(
                over
            )  # of the corner that the edge comes to last
            if beyond <= 0:
                share = 0.0
            elif beyond >= flat:
                share = 0.5 - abs(over) / steep
            else:
                share = beyond**2 / (2 * steep * flat)
            total += 1 - share if over > 0 else share
    return total


def _box(corners: Array) -> tuple[Array, Array]:
    return corners.min(0), corners.max(0)


def _erf(x: Array) -> Array:
    from scipy.special import erf

    return np.asarray(erf(x))
