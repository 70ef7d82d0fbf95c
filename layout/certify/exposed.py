"""Exposure and etch of everything on a mask, strip by strip: background, edge in the
resist, what the etch makes of it.

Threshold model: the edge of a shape comes out where the exposure is half of what a wide
area of dose 1 receives. The
diameter of a pillar in the resist follows from the exposure across the edge of its own
disc and its background; the
etch adds the bias of the process, for how alone the pillar stands, and its tilted
walls. Of any other shape the area
follows in the same way from the areas on which its own exposure exceeds a level, and
all edges are taken to move alike.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from layout.certify import neighbours, outlines
from layout.certify.background import Raster
from layout.certify.gathered import Exposed, Kinds
from layout.certify.places import OnLattices, strip_of
from layout.certify.raster import own_levels
from layout.certify.shaped import Beside, Pillars, Shapes
from layout.process import Process, compiled
from layout.shapes.moments import Contours
from metalens.ground.arrays import Array
from metalens.ground.units import nm

THRESHOLD = 0.5
WIDE_UM = 2.0  # Gaussians from here on are summed on pixels
_LEVELS = 256  # of the table of edges for each shape
_MOST_PIXELS = (
    1 << 25
)  # that are kept of the whole mask; wider ones are made band by band
_BAND = 1 << 20  # sites at once
_SAMPLED = 16  # strips, for the densest place
_SPOTS = 8  # along the range, of a polygon on pixels
_THREADS = 2

Terms = list[tuple[float, float]]  # (range, weight) of Gaussians


@dataclass(eq=False, slots=True)
class Wide:
    """One wide Gaussian over the whole mask. mass: (kinds,) that each pillar carries;
    spots: x, y and mass of the rest.

    whole: its pixels, where they are few enough to keep.
    """

    raster: Raster
    mass: Array
    spots: tuple[Array, Array, Array]
    whole: Array | None = None

    def between(self, places: OnLattices, first: int, end: int) -> tuple[Raster, Array]:
        """Pixels with the exposure in some strips."""
        if self.whole is not None:
            return self.raster, self.whole
        bottom, height = places.box_um[1], places.height_um
        low = self.raster.bottom_um if first <= 0 else bottom + first * height
        high = (
            self.raster.bottom_um + self.raster.rows * self.raster.pixel_um
            if end >= places.strips
            else bottom + end * height
        )
        some = self.raster.between(low, high)
        more = int(np.ceil(self.raster.halo_um / height)) + 1
        image = np.zeros((some.rows, some.columns), np.float32)
        x, y, kind = places.part(first - more, end + more)
        some.put(x, y, self.mass[kind], image)
        some.put(*self.spots, image)
        return some, some.blurred(image)


@dataclass(frozen=True, eq=False, slots=True)
class Band:
    """What comes out in some strips: places, kinds, (n,) float32 exposure, resist and
    made diameters (nm).

    Of shapes the places are those of their middles, the diameters the sizes that they
    go by, all edges moved alike.
    """

    first: int
    x_um: Array
    y_um: Array
    kind: Array
    exposure: Array
    resist_nm: Array
    made_nm: Array


@dataclass(eq=False, slots=True)
class Simulation:
    """All strips of a mask. terms: Gaussians; at_um: (m, 2) points of other edges, and
    what they receive from afar.
    """

    scene: Exposed
    process: Process
    terms: Terms
    at_um: Array
    far_of_points: Array = field(init=False)
    _wide: list[tuple[float, Wide]] = field(init=False)
    _alone: Wide | None = field(init=False, default=None)
    _full: float = field(init=False, default=0.0)
    _edges: "_EdgeTable" = field(init=False)
    _pairs: dict[float, neighbours.Pairs] = field(init=False, default_factory=dict)
    _shaped: dict[float, Beside] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        kinds, box = self.scene.kinds, self._box()
        self._edges = _EdgeTable.of(kinds, self.terms)
        carried = kinds.area_um2 * kinds.dose
        self._wide = [
            (
                w,
                Wide(
                    Raster.over(box, a),
                    carried,
                    outlines.spots(self.scene.others, a / _SPOTS),
                ),
            )
            for a, w in self.terms
            if a >= WIDE_UM
        ]
        if self.process.bias.isolated_nm:
            none = (np.empty(0), np.empty(0), np.empty(0))
            raster = Raster.over(self.scene.places.box_um, self.process.bias.range_um)
            self._alone = Wide(raster, np.ones(len(carried)), none)
        self._keep_small(
            [wide for _, wide in self._wide]
            + ([] if self._alone is None else [self._alone])
        )
        self.far_of_points = np.zeros(len(self.at_um))
        if self._alone is not None:
            self._full = self._densest(self._alone)

    def _box(self) -> tuple[float, float, float, float]:
        """Around all places, points and polygons."""
        left, bottom, right, top = self.scene.places.box_um
        corners = [
            np.array([[left, bottom], [right, top]]),
            self.at_um.reshape(-1, 2),
            *self.scene.others.corners,
        ]
        low, high = (
            np.min([c.min(0) for c in corners if len(c)], 0),
            np.max([c.max(0) for c in corners if len(c)], 0),
        )
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def _keep_small(self, every: Sequence[Wide]) -> None:
        """One pass over all pillars for those fields that fit into memory."""
        small = [
            wide
            for wide in every
            if wide.raster.rows * wide.raster.columns <= _MOST_PIXELS
        ]
        images = [
            np.zeros((w.raster.rows, w.raster.columns), np.float32) for w in small
        ]
        for first, end in self._bands() if small else ():
            x, y, kind = self.scene.places.part(first, end)
            for wide, image in zip(small, images, strict=True):
                wide.raster.put(x, y, wide.mass[kind], image)
        for wide, image in zip(small, images, strict=True):
            wide.raster.put(*wide.spots, image)
            wide.whole = wide.raster.blurred(image)

    def _bands(self) -> list[tuple[int, int]]:
        """(first, end) strips of bands."""
        places = self.scene.places
        step = max(1, round(_BAND * places.strips / max(places.count, 1)))
        return [
            (first, min(first + step, places.strips))
            for first in range(0, places.strips, step)
        ]

    def bands(self) -> Iterator[Band]:
        """What comes out, band by band from the bottom; two are worked on at once."""
        bands = self._bands()
        with ThreadPoolExecutor(_THREADS) as pool:
            waiting = [pool.submit(self._band, *some) for some in bands[:_THREADS]]
            for number in range(len(bands)):
                done = waiting.pop(0).result()
                if number + _THREADS < len(bands):
                    waiting.append(pool.submit(self._band, *bands[number + _THREADS]))
                yield done

    def _band(self, first: int, end: int) -> Band:
        x, y, kind = self.scene.places.part(first, end)
        far = self._far((first, end), (x, y, kind))
        exposure, resist = np.empty(len(x), np.float32), np.empty(len(x), np.float32)
        e = self._edges
        _develop(
            kind,
            e.row,
            self.scene.kinds.dose,
            far,
            e.radius_um,
            e.own,
            THRESHOLD,
            exposure,
            resist,
        )
        kinds, alone = (
            self.scene.kinds,
            self._isolation(self._alone, (first, end), (x, y)),
        )
        if kinds.shapes is not None:
            drawn = kinds.drawn_um[kind] / nm
            resist = (
                drawn + (resist - kinds.size_um[kind] / nm) / kinds.share[kind]
            ).astype(np.float32)
            etched = self.process.bias.made_nm(resist, alone).astype(np.float32)
            return Band(first, x, y, kind, exposure, resist, etched)
        made = self.process.made_diameter_nm(resist, alone).astype(np.float32)
        return Band(first, x, y, kind, exposure, resist, made)

    def _far(
        self, strips: tuple[int, int], pillars: tuple[Array, Array, Array]
    ) -> Array:
        """(n,) exposure of each rim by everything else; of the points in these strips
        by the wide Gaussians of all.
        """
        (x, y, kind), kinds, places = pillars, self.scene.kinds, self.scene.places
        far, mass = np.zeros(len(x)), (kinds.area_um2 * kinds.dose)[kind]
        here = np.flatnonzero(
            (strips[0] <= strip_of(places, self.at_um[:, 1]))
            & (strip_of(places, self.at_um[:, 1]) < strips[1])
        )
        for weight, wide in self._wide:
            raster, image = wide.between(places, *strips)
            far += weight * (
                raster.take(x, y, image) - mass / (np.pi * raster.range_um**2)
            )
            points = self.at_um[here]
            self.far_of_points[here] += weight * raster.take(
                points[:, 0], points[:, 1], image
            )
        for range_um, weight in self.terms:
            if kinds.shapes is not None and range_um < WIDE_UM:
                far += weight * self._beside_shapes(
                    strips, pillars, range_um, kinds.shapes
                )
            elif 0.05 * float(kinds.size_um.max()) < range_um < WIDE_UM:
                far += weight * self._beside(strips, pillars, range_um)
        return far

    def _beside(
        self,
        strips: tuple[int, int],
        pillars: tuple[Array, Array, Array],
        range_um: float,
    ) -> Array:
        """(n,) exposure of each rim by its neighbours through a narrow Gaussian."""
        places, size = self.scene.places, self.scene.kinds.size_um
        reach = neighbours.reach_um(range_um, float(size.max()))
        more = int(np.ceil(reach / places.height_um))
        around = places.part(strips[0] - more, strips[1] + more)
        if range_um not in self._pairs:
            self._pairs[range_um] = neighbours.Pairs.of(size / 2, range_um)
        return self._pairs[range_um](self._discs(pillars), self._discs(around))

    def _beside_shapes(
        self,
        strips: tuple[int, int],
        pillars: tuple[Array, Array, Array],
        range_um: float,
        shapes: Shapes,
    ) -> Array:
        """(n,) exposure of the edges of each pillar by its neighbours through a narrow
        Gaussian.
        """
        if range_um not in self._shaped:
            self._shaped[range_um] = Beside.of(shapes, range_um)
        beside, places = self._shaped[range_um], self.scene.places
        more = int(np.ceil(beside.reach_um / places.height_um))
        return beside(
            self._dosed(pillars),
            self._dosed(places.part(strips[0] - more, strips[1] + more)),
        )

    def _dosed(self, pillars: tuple[Array, Array, Array]) -> Pillars:
        (x, y, kind), kinds = pillars, self.scene.kinds
        return x, y, kinds.dose[kind], np.asarray(kinds.shape)[kind]

    def _discs(
        self, pillars: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Array, Array]:
        x, y, kind = pillars
        kinds = self.scene.kinds
        return x, y, (kinds.area_um2 * kinds.dose)[kind], (kinds.size_um / 2)[kind]

    def _near(
        self, alone: Wide, strips: tuple[int, int], place: tuple[Array, Array]
    ) -> Array:
        """(n,) neighbours of each pillar, weighed by exp(-r^2 / range^2)."""
        raster, image = alone.between(self.scene.places, *strips)
        return np.asarray(
            np.pi * raster.range_um**2 * raster.take(*place, image) - 1
        )  # less itself

    def _densest(self, alone: Wide) -> float:
        """Neighbours at the densest place: of the pillars of some strips, one in a
        thousand has more.
        """
        places = self.scene.places
        some = np.unique(
            np.linspace(0, places.strips - 1, _SAMPLED).round().astype(int)
        ).tolist()
        near = [self._near(alone, (k, k + 1), places.part(k, k + 1)[:2]) for k in some]
        return float(np.quantile(np.concatenate(near), 0.999))

    def _isolation(
        self, alone: Wide | None, strips: tuple[int, int], place: tuple[Array, Array]
    ) -> Array | float:
        """How alone each pillar stands: what its neighbours lack of the densest
        place's.
        """
        if alone is None:
            return 0.0
        if self._full <= 0:
            return 1.0
        return np.clip(1 - self._near(alone, strips, place) / self._full, 0, 1)


@dataclass(frozen=True, eq=False, slots=True)
class _EdgeTable:
    """Exposure across the edge of a pillar of unit dose: row (kinds,) in radius_um, own
    (rows, levels).

    radius_um: of the circle of the area on which the pillar by itself exposes more than
    ``own``.
    """

    row: Array
    radius_um: Array
    own: Array

    @classmethod
    def of(cls, kinds: Kinds, terms: Terms) -> "_EdgeTable":
        if kinds.shapes is not None:
            tables = [
                _shape_profile(contours, 2 * np.sqrt(area / np.pi), terms)
                for contours, area in zip(
                    kinds.shapes.contours, kinds.shapes.area_um2.tolist(), strict=True
                )
            ]
            return cls(
                np.asarray(kinds.shape, np.int64),
                *(np.array([t[k] for t in tables]) for k in (0, 1)),
            )
        sizes, row = np.unique(kinds.size_um, return_inverse=True)
        tables = [_profile(size, terms) for size in sizes.tolist()]
        return cls(
            row.astype(np.int64),
            *(np.array([table[k] for table in tables]) for k in (0, 1)),
        )


@compiled
def _develop(
    kind: Array,
    size: Array,
    dose: Array,
    far: Array,
    radius: Array,
    own: Array,
    threshold: float,
    exposure: Array,
    made_nm: Array,
) -> None:
    """Exposure of the drawn edge relative to the threshold, and diameter at which it is
    the threshold.

    Interpolates in the falling ``own`` (sizes, levels), from its middle level, the
    drawn edge, outwards or inwards.
    """
    last = own.shape[1] - 1
    for n in range(kind.shape[0]):
        s, given = size[kind[n]], dose[kind[n]]
        exposure[n] = (given * own[s, last // 2] + far[n]) / threshold
        wanted = (threshold - far[n]) / given
        low = last // 2
        while low < last - 1 and own[s, low + 1] > wanted:
            low += 1
        while low > 0 and own[s, low] <= wanted:
            low -= 1
        fall = own[s, low] - own[s, low + 1]
        share = min(max((own[s, low] - wanted) / fall, 0.0), 1.0) if fall > 0 else 0.0
        made_nm[n] = 2e3 * (
            radius[s, low] + share * (radius[s, low + 1] - radius[s, low])
        )


def _radii(size_um: float, terms: Terms) -> Array:
    """About the edge, which is the middle one."""
    span = min(size_um / 2 * 0.9, 4 * min(a for a, _ in terms))
    return np.linspace(size_um / 2 - span, size_um / 2 + span, 2 * _LEVELS + 1)


def _shape_profile(
    contours: Contours, size_um: float, terms: Terms
) -> tuple[Array, Array]:
    """As :func:`_profile`, of any shape with the area of a disc of that size."""
    radius = _radii(size_um, terms)
    return radius, own_levels(contours, terms, radius)


def _profile(size_um: float, terms: Terms) -> tuple[Array, Array]:
    """(radii, exposure) of a disc of unit dose about its edge: the non-central
    chi-square of two degrees.
    """
    from scipy.special import chndtr

    radius = _radii(size_um, terms)
    own = sum(
        w * chndtr(2 * (size_um / 2 / a) ** 2, 2.0, 2 * (radius / a) ** 2)
        for a, w in terms
    )
    return radius, np.asarray(own)
