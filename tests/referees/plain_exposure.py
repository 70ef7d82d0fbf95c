"""Exposure of a written mask by plain convolution and plain sums of what KLayout reads
and the dose table says.

Narrow Gaussians: polygons sampled on fine pixels around a place and blurred line by
line. Wide ones: a sum over all
shapes as points. Nothing of the toolchain is used.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.path import Path as Outline
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import convolve1d, map_coordinates

from metalens.core.arrays import Array

_WIDE_UM = 1.0  # ranges from there on are summed over points
_CUT = 4.2  # ranges: exp(-17.6)
_PER_RANGE = 4  # points of a wide shape along a range
_FINER = 4  # samples along a pixel; even, so that an edge through its middle halves it


@dataclass(frozen=True, eq=False, slots=True)
class Shape:
    """A polygon as it is written: (n, 2) corners and area in um, dose, layer number."""

    layer: int
    dose: float
    corners: Array
    area: float

    @property
    def middle(self) -> Array:
        """Of its box."""
        return np.asarray((self.corners.min(0) + self.corners.max(0)) / 2)

    @property
    def diameter_um(self) -> float:
        """Of the disc of its area."""
        return float(2 * np.sqrt(self.area / np.pi))


def shapes(mask: Path, table: Path, unexposed: Sequence[int]) -> list[Shape]:
    """All polygons that are exposed; KeyError: a layer without a dose."""
    import klayout.db as db

    with open(table, encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    dose = {
        (int(row["layer"]), int(row["datatype"])): float(row["relative_dose"])
        for row in rows
    }
    held, found = db.Layout(), []
    held.read(str(mask))
    for index in held.layer_indexes():
        info = held.get_info(index)
        region = db.Region(held.top_cell().begin_shapes_rec(index))
        region.merged_semantics = False
        if info.layer in unexposed or not region.count():
            continue
        given = dose[info.layer, info.datatype]
        for polygon in region.each():
            corners = (
                np.array([[p.x, p.y] for p in polygon.each_point_hull()]) * held.dbu
            )
            found.append(
                Shape(info.layer, given, corners, polygon.area() * held.dbu**2)
            )
    return found


class Resist:
    """The exposure by shapes, through Gaussians of (1/e radius in um, energy)."""

    def __init__(
        self, drawn: Sequence[Shape], terms: Sequence[tuple[float, float]]
    ) -> None:
        total = sum(energy for _, energy in terms)
        self._drawn = drawn
        self._near = [(a, e / total) for a, e in terms if a < _WIDE_UM]
        self._far = [(a, e / total) for a, e in terms if a >= _WIDE_UM]
        self._at = np.array([shape.middle for shape in drawn])
        self._spots = _spots(
            drawn, min((a for a, _ in self._far), default=np.inf) / _PER_RANGE
        )
        self._reach = np.array([np.ptp(shape.corners, axis=0).max() for shape in drawn])

    def pillar(self, number: int, pixel_um: float) -> tuple[float, float]:
        """Exposure of the drawn edge over dose-to-size, and diameter in the resist, of
        a round shape.
        """
        shape = self._drawn[number]
        radius = shape.diameter_um / 2
        image, first = self._image(shape.middle, radius + 0.03, pixel_um)
        angle = 2 * np.pi * np.arange(48) / 48
        radii = radius + np.linspace(-0.02, 0.02, 41)
        x, y = (
            ((f(angle) * radii[:, None]) - first) / pixel_um for f in (np.cos, np.sin)
        )
        value = map_coordinates(image, [y, x], order=3)
        cleared = np.clip((value > 0.5).sum(0), 1, 40)
        ray = np.arange(48)
        high, low = value[cleared - 1, ray], value[cleared, ray]
        edge = radii[cleared - 1] + (high - 0.5) / (high - low) * (radii[1] - radii[0])
        return float(value[20].mean() / 0.5), float(2 * np.sqrt((edge**2).mean()))

    def cleared_um2(self, site_um: Array, half_um: float, pixel_um: float) -> float:
        """Area within a square about a place where the exposure is above the threshold.

        Counted on sixths of the pixels, in which it is straight: shares of those along
        the edge by its slope.
        """
        image, _ = self._image(site_um, half_um, pixel_um)
        fine = np.arange(0, len(image) - 1 + 1e-9, 1 / 6)
        value = map_coordinates(image, np.meshgrid(fine, fine, indexing="ij"), order=3)
        slope = np.maximum(np.hypot(*np.gradient(value)), 1e-9)
        return float(
            np.clip(0.5 + (value - 0.5) / slope, 0, 1).sum() * (pixel_um / 6) ** 2
        )

    def edge(
        self, at_um: Array, outward: Array, pixel_um: float
    ) -> tuple[float, float]:
        """Exposure of a point on a straight edge over dose-to-size, and how far outside
        it, in um, the resist ends.

        outward: (2,) unit vector across the edge.
        """
        image, first = self._image(at_um, 0.03, pixel_um)
        aside = np.linspace(-0.02, 0.02, 41)
        value = map_coordinates(
            image, (outward[::-1, None] * aside - first) / pixel_um, order=3
        )
        cleared = min(max(int((value > 0.5).sum()), 1), 40)
        high, low = value[cleared - 1], value[cleared]
        return float(value[20] / 0.5), float(
            aside[cleared - 1] + (high - 0.5) / (high - low) * (aside[1] - aside[0])
        )

    def _image(
        self, middle: Array, half_um: float, pixel_um: float
    ) -> tuple[Array, float]:
        """Exposure on pixels around a place, and where the first of them lies from it."""
        keep = int(np.ceil(half_um / pixel_um))
        blur = [int(np.ceil(_CUT * a / pixel_um)) for a, _ in self._near]
        side = keep + max(blur)
        axis = np.arange(-side, side + 1) * pixel_um
        dose = np.zeros((len(axis), len(axis)))
        for n in np.flatnonzero(abs(self._at - middle).max(1) < axis[-1] + self._reach):
            self._draw(self._drawn[n], middle, pixel_um, dose)
        image = np.zeros_like(dose)
        for (a, energy), taps in zip(self._near, blur, strict=True):
            kernel = np.exp(-((np.arange(-taps, taps + 1) * pixel_um / a) ** 2))
            kernel /= kernel.sum()
            image += energy * convolve1d(
                convolve1d(dose, kernel, axis=0, mode="constant"),
                kernel,
                mode="constant",
            )
        some = slice(side - keep, side + keep + 1)
        nodes = np.linspace(-keep, keep, 5) * pixel_um
        points = np.stack(np.meshgrid(nodes, nodes), -1).reshape(-1, 2) + middle
        far = RectBivariateSpline(nodes, nodes, self._background(points).reshape(5, 5))
        return image[some, some] + far(axis[some], axis[some]), float(axis[some][0])

    def _draw(self, shape: Shape, middle: Array, pixel_um: float, dose: Array) -> None:
        """Add the dose on the pixels that a shape covers, in sixteenths; in sum its
        area where it lies on them.
        """
        side, at = len(dose) // 2, (shape.corners - middle) / pixel_um
        low = np.maximum(np.floor(at.min(0)).astype(int) + side, 0)
        high = np.minimum(np.ceil(at.max(0)).astype(int) + side, 2 * side) + 1
        if (low >= high).any():
            return
        inner = (np.arange(_FINER) + 0.5) / _FINER - 0.5
        x, y = (
            (np.arange(low[k], high[k])[:, None] - side + inner).ravel() for k in (0, 1)
        )
        covered = Outline(at).contains_points(
            np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        )
        share = covered.reshape(
            len(y) // _FINER, _FINER, len(x) // _FINER, _FINER
        ).mean((1, 3))
        if low.min() > 0 and high.max() < len(dose):
            share *= shape.area / pixel_um**2 / share.sum()
        dose[low[1] : high[1], low[0] : high[0]] += shape.dose * share

    def _background(self, points: Array) -> Array:
        at, mass, mean_square = self._spots
        apart = ((points[:, None] - at) ** 2).sum(-1)
        total = np.zeros(len(points))
        for a, energy in self._far:
            # a disc of diameter D adds D^2 / 8 to the square of the 1/e radius
            width = a**2 + mean_square
            total += energy / np.pi * (np.exp(-apart / width) @ (mass / width))
        return total


def _spots(drawn: Sequence[Shape], step_um: float) -> tuple[Array, Array, Array]:
    """(n, 2) points that stand for shapes, their area times dose, and their area / 2
    pi; of wide shapes a raster.
    """
    at, mass, mean_square = [], [], []
    for shape in drawn:
        low, high = shape.corners.min(0), shape.corners.max(0)
        counts = np.maximum(np.ceil((high - low) / step_um), 1).astype(int)
        middle = shape.middle[None]
        if counts.max() > 1:
            x, y = (
                low[k] + (np.arange(counts[k]) + 0.5) * (high - low)[k] / counts[k]
                for k in (0, 1)
            )
            raster = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
            inside = raster[Outline(shape.corners).contains_points(raster)]
            middle = inside if len(inside) else middle
        at.append(middle)
        mass.append(np.full(len(middle), shape.dose * shape.area / len(middle)))
        mean_square.append(np.full(len(middle), shape.area / len(middle) / (2 * np.pi)))
    return np.concatenate(at), np.concatenate(mass), np.concatenate(mean_square)
