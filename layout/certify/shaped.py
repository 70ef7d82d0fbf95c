"""Exposure of the edges of pillars of any shape by those beside them, through a
Gaussian too narrow for pixels.

Each shape has an image of what it exposes around itself, and places along its edges. A
pillar sees the images of its
neighbours there. Through a Gaussian wider than the shapes each counts as one more
Gaussian, of the same second moment.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.certify.raster import image, reach_um
from layout.files.squares import Squares, first_from
from layout.process import compiled
from layout.shapes.moments import Contours, along, moments
from metalens.ground.arrays import Array

WIDER = 3.0  # half sides: in a Gaussian beyond, a shape is its second moment
_SEEN = 32  # places along the edges
_RANGES = 4.5  # from the shape to where its image ends: exp(-20)
_PIXELS = 4  # along the range, of the images
_MOST = 1 << 27  # pixels of all images together
_REACH = 4.0  # ranges at which a Gaussian no longer counts: exp(-16)

Pillars = tuple[Array, Array, Array, Array]  # x, y, dose and shape, (n,) each


@dataclass(frozen=True, eq=False, slots=True)
class Shapes:
    """Shapes that differ. contours: of each, about its middle. area_um2: (shapes,).

    edge_um: (shapes, places, 2) along the edges. given_um2, seen_um2: (shapes,) mean
    squared distance from the middle,
    over the area and over the edges. half_um: of the square that holds the widest.
    """

    contours: Sequence[Contours]
    area_um2: Array
    edge_um: Array
    given_um2: Array
    seen_um2: Array
    half_um: float

    @classmethod
    def of(cls, contours: Sequence[Contours]) -> "Shapes":
        """Of contours about their middles."""
        edge = np.array([along(c, _SEEN) for c in contours])
        area, given = np.array([(m[0], m[2]) for m in map(moments, contours)]).T
        return cls(
            contours,
            area,
            edge,
            given / area,
            (edge**2).sum(-1).mean(1),
            max(map(reach_um, contours)),
        )


@dataclass(frozen=True, eq=False, slots=True)
class Beside:
    """What neighbours give through one Gaussian. images: (shapes, n, n), empty where
    shapes count as Gaussians.
    """

    shapes: Shapes
    range_um: float
    images: Array
    pixel_um: float
    itself: Array

    @classmethod
    def of(cls, shapes: Shapes, range_um: float) -> "Beside":
        """Images of all shapes, or none where the Gaussian is wider than they are."""
        if range_um > WIDER * shapes.half_um:
            square = range_um**2 + shapes.given_um2 + shapes.seen_um2
            return cls(
                shapes,
                range_um,
                np.empty((0, 0, 0), np.float32),
                1.0,
                shapes.area_um2 / np.pi / square,
            )
        half = shapes.half_um + _RANGES * range_um
        most = int(np.sqrt(_MOST / len(shapes.contours)))
        count = min(int(np.ceil(2 * half * _PIXELS / range_um)), most) | 1
        pixel = 2 * half / (count - 1)
        images = np.array(
            [_sampled(c, range_um, count, pixel) for c in shapes.contours], np.float32
        )
        itself = np.array(
            [
                _seen(edge, each, pixel)
                for edge, each in zip(shapes.edge_um, images, strict=True)
            ]
        )
        return cls(shapes, range_um, images, pixel, itself)

    @property
    def reach_um(self) -> float:
        """From middle to middle."""
        s = self.shapes
        if not self.images.size:
            return float(
                _REACH
                * np.sqrt(self.range_um**2 + s.given_um2.max() + s.seen_um2.max())
            )
        return (len(self.images[0]) // 2) * self.pixel_um + float(
            np.hypot(*np.moveaxis(s.edge_um, -1, 0)).max()
        )

    def __call__(self, at: Pillars, around: Pillars) -> Array:
        """(n,) mean exposure along the edges of those looked at by all near them, who
        hold these too.
        """
        squares = Squares.of(around[0], around[1], self.reach_um)
        x, y, dose, shape = (v[squares.order] for v in around)
        order, key = squares.seen_by(at[0], at[1])
        out = -at[2] * self.itself[at[3]]  # which is among them
        s = self.shapes
        moments = s.area_um2 / np.pi, s.given_um2, s.seen_um2
        steps = self.range_um**2, self.pixel_um
        near = x, y, dose, shape
        _sum(
            order,
            key,
            at,
            near,
            squares.key,
            squares.columns,
            self.images,
            s.edge_um,
            moments,
            steps,
            out,
        )
        return np.asarray(out)


def _sampled(contours: Contours, range_um: float, count: int, pixel_um: float) -> Array:
    """(count, count) of the image, 0 beyond."""
    from scipy.ndimage import map_coordinates

    found = image(contours, range_um)
    axis = (np.arange(count) - count // 2) * (pixel_um / found.pixel_um) + len(
        found.value
    ) // 2
    return np.asarray(
        map_coordinates(
            found.value, np.meshgrid(axis, axis, indexing="ij"), order=3, cval=0.0
        )
    )


@compiled
def _seen(
    edge: Array, image: Array, pixel: float, x: float = 0.0, y: float = 0.0
) -> float:
    """Mean of an image, its middle at (x, y), over places; straight between pixels,
    nothing beyond.
    """
    count, total = image.shape[0], 0.0
    for n in range(edge.shape[0]):
        u = (edge[n, 0] - x) / pixel + count // 2
        v = (edge[n, 1] - y) / pixel + count // 2
        if u < 0 or v < 0 or u >= count - 1 or v >= count - 1:
            continue
        i, j = int(u), int(v)
        a, b = u - i, v - j
        total += (1 - b) * ((1 - a) * image[j, i] + a * image[j, i + 1])
        total += b * ((1 - a) * image[j + 1, i] + a * image[j + 1, i + 1])
    return float(total / edge.shape[0])


@compiled
def _sum(
    order: Array,
    at_key: Array,
    at: Pillars,
    near: Pillars,
    key: Array,
    columns: int,
    images: Array,
    edges: Array,
    moments: tuple[Array, Array, Array],
    steps: tuple[float, float],
    out: Array,
) -> None:
    x, y, dose, shape = near
    at_x, at_y, _, at_shape = at
    mass, given, seen = moments
    square, pixel = steps
    wide, starts = images.shape[0] == 0, np.zeros(3, np.int64)
    for m in range(order.shape[0]):
        n = order[m]
        mine, total = at_shape[n], 0.0
        for r in range(3):
            middle = at_key[m] + (r - 1) * columns
            starts[r] = first_from(key, middle - 1, starts[r])
            k = starts[r]
            while k < key.shape[0] and key[k] <= middle + 1:
                dx, dy, other = x[k] - at_x[n], y[k] - at_y[n], shape[k]
                if wide:
                    s = square + given[other] + seen[mine]
                    total += (
                        dose[k] * mass[other] * np.exp(-(dx * dx + dy * dy) / s) / s
                    )
                else:
                    total += dose[k] * _seen(edges[mine], images[other], pixel, dx, dy)
                k += 1
        out[n] += total
