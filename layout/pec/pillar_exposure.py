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
    points_along_edges,
    polygon_moments,
    total_perimeter,
)
from metalens.core.arrays import Array

_RIM = 2 * np.pi * (np.arange(24) + 0.5) / 24
_EDGE_POINTS = 48  # points along the edges where exposure by neighbours is evaluated
_PANEL = 0.8  # of the narrowest Gaussian, between four Gauss points
_PIXEL = 1 / 6  # of it, of the raster on which the level is sought
_MOST_PIXELS = 1200  # along a side


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
        """R^2 / 2 of the disc, and R^2 of its edge, where the exposure is evaluated."""
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
        diameter = np.where(used, self.diameter_um, 0.0)
        terms = list(zip(point.widths_um, point.weights, strict=True))
        own, slope = (
            sum(weight * formula(diameter, width) for width, weight in terms)
            for formula in (rim_of_own_disc, slope_at_rim)
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
        own_and_slope = np.zeros((2, len(self.contours)))
        levels: dict[bytes, tuple[float, float]] = {}  # of equal contours once
        for entry in np.flatnonzero(used).tolist():
            contours = self.contours[entry]
            key = b"|".join(contour.tobytes() for contour in contours)
            if key not in levels:
                levels[key] = _level(contours, float(self.area_um2[entry]), point)
            own_and_slope[:, entry] = levels[key]
        return own_and_slope[0], own_and_slope[1]

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
        """Entries that reach farthest along each of the steps."""
        entries = np.flatnonzero(used).tolist()
        reach = np.array(
            [
                (np.concatenate(list(self.contours[entry])) @ steps_um.T).max(0)
                for entry in entries
            ]
        )
        return sorted({entries[entry] for entry in reach.argmax(0).tolist()})


DrawnKinds = DrawnDiscs | DrawnOutlines


def _wider(contours: Contours) -> float:
    """Mean squared distance from the centroid, over area plus over edges, um^2."""
    area, first, second = polygon_moments(contours)
    centre = first / area
    points = points_along_edges(contours, 4 * _EDGE_POINTS) - centre
    return float(second / area - centre @ centre + (points**2).sum(1).mean())


def _lines(contours: Contours, narrow_um: float) -> tuple[Array, Array, Array]:
    """Quadrature of a shape: crossings of horizontal lines with its edges.

    The integral over the shape of f(x) g(y) is the sum of weight g(y) F(x), F' = f.
    Lines are the four Gauss points of panels no higher than 0.8 ``narrow_um``.

    Args:
        contours: (n, 2) corners each, um.
        narrow_um: width of the narrowest Gaussian.

    Returns:
        (n,) y of each crossing, its weight (below 0 where the edge runs down), and its
        x.
    """
    start = np.concatenate(list(contours))
    end = np.concatenate([np.roll(c, -1, axis=0) for c in contours])
    levels = np.unique(start[:, 1])
    counts = np.maximum(np.ceil(np.diff(levels) / (_PANEL * narrow_um)).astype(int), 1)
    panel_bottom = np.concatenate(
        [
            bottom + (top - bottom) / count * np.arange(count)
            for bottom, top, count in zip(levels, levels[1:], counts, strict=False)
        ]
    )
    panel_height = np.repeat(np.diff(levels) / counts, counts)
    node, gauss_weight = np.polynomial.legendre.leggauss(4)
    y = (panel_bottom[:, None] + panel_height[:, None] * (node + 1) / 2).ravel()
    weight = (panel_height[:, None] * gauss_weight / 2).ravel()
    lowest = np.minimum(start[:, 1], end[:, 1])
    highest = np.maximum(start[:, 1], end[:, 1])
    edge, line = np.nonzero((lowest[:, None] < y) & (y < highest[:, None]))
    rise = (end - start)[edge]
    place = start[edge, 0] + (y[line] - start[edge, 1]) / rise[:, 1] * rise[:, 0]
    return y[line], weight[line] * np.sign(rise[:, 1]), place


def _level(
    contours: Contours, area_um2: float, point: PointExposure
) -> tuple[float, float]:
    """Exposure level whose contour encloses the area of the shape, and its slope.

    The exposure of the shape by itself at unit dose is drawn on pixels. The level is
    the root of the area above it less the area of the shape (Brent's method). slope =
    perimeter / (d area / d level): its fall per um that
    the edges move out.

    Args:
        contours: (n, 2) corners each, um.
        area_um2: of the shape.
        point: exposure of a beam.
    """
    from scipy.optimize import brentq

    corners = np.concatenate(list(contours))
    narrowest = float(point.widths_um.min())
    size = float(np.ptp(corners, axis=0).max())
    pixel = max(_PIXEL * narrowest, size / _MOST_PIXELS)
    margin = min(2 * narrowest, size)
    x, y = (
        np.arange(low - margin, high + margin + pixel, pixel)
        for low, high in zip(corners.min(0), corners.max(0), strict=True)
    )
    line_y, weight, crossing_x = _lines(contours, narrowest)
    image = np.zeros((len(y), len(x)))
    for width, fraction in zip(point.widths_um, point.weights, strict=True):
        bell = (
            weight
            * np.exp(-(((y[:, None] - line_y) / width) ** 2))
            / (np.sqrt(np.pi) * width)
        )
        image += fraction / 2 * (bell @ _erf((crossing_x[:, None] - x) / width))
    slope_y, slope_x = np.gradient(image)  # per pixel

    def area_above(level: float) -> float:
        return float(_above(image, slope_y, slope_x, level)) * pixel**2

    def excess_area(level: float) -> float:
        return area_above(level) - area_um2

    level = float(brentq(excess_area, 0.0, float(image.max())))
    difference = 0.15 * level  # a few pixels wide, so that their places do not matter
    return level, total_perimeter(contours) / max(
        (area_above(level - difference) - area_above(level + difference))
        / (2 * difference),
        1e-12,
    )


@compile_loop
def _above(image: Array, slope_y: Array, slope_x: Array, level: float) -> float:
    """Area, in pixels, on which an image is above a level.

    In each pixel the image is a plane of its gradient, and the share above the level is
    exact for it. So straight edges of any direction are cut exactly.

    Args:
        image: (y, x) values.
        slope_y, slope_x: (y, x) gradient per pixel.
        level: of the image.
    """
    total = 0.0
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            rise_y, rise_x = abs(slope_y[row, column]), abs(slope_x[row, column])
            larger = max(rise_y, rise_x)
            smaller = min(rise_y, rise_x)
            excess = image[row, column] - level
            overlap = (rise_y + rise_x) / 2 - abs(
                excess
            )  # of the corner that the edge comes to last
            if overlap <= 0:
                share = 0.0
            elif overlap >= smaller:
                share = 0.5 - abs(excess) / larger
            else:
                share = overlap**2 / (2 * larger * smaller)
            total += 1 - share if excess > 0 else share
    return total


def _erf(x: Array) -> Array:
    from scipy.special import erf

    return np.asarray(erf(x))
