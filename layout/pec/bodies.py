"""What is exposed: lattices of pillars in blocks of rows, rectangles, and the table of
what each pillar exposes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.plan import PillarArray
from layout.pec.nodes import NODES_PER_WIDTH
from layout.pec.pillar_exposure import DrawnKinds
from layout.pec.psf import PointExposure
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

_FAINT = 0.02  # least exposure of its own edge at which a pillar can be corrected
_NEGLIGIBLE = 5e-4  # exposure by the four nearest pillars that is left out


@dataclass(frozen=True, eq=False)
class ExposureTable:
    """What each entry exposes at unit dose; entry 0 is no pillar.

    area_um2: (entries,), 0 for those that do not occur. goal:
    (entries,) exposure of the edge that is sought, over the threshold. own: (entries,)
    exposure at the edge by the pillar itself, less what the far field counts for it.
    slope: (entries,) fall of the exposure per um that the edges move out. count:
    (entries,) pillars of each.
    """

    area_um2: Array
    goal: Array
    own: Array
    slope: Array
    count: Array

    @property
    def used(self) -> Array:
        """(entries,) which occur."""
        return np.asarray(self.count > 0)

    @property
    def per_own(self) -> Array:
        """(entries,) area over own; 0 for those that do not occur."""
        none = np.zeros_like(self.own)
        return np.divide(self.area_um2, self.own, out=none, where=self.used)


@dataclass(frozen=True, eq=False)
class ScatterRanges:
    """The point exposure split by how far its Gaussians reach.

    far: at least six times as wide as the distance of neighbours, summed on nodes over
    the whole die. middle: reach neighbours only, summed on the sites of each lattice.
    near: reach no neighbour.
    close: middle and near as they are, which are summed over the exact shapes.

    Widths of far and middle are widened by the mean pillar. A disc adds R^2 / 2 to the
    squared width of a Gaussian, and its edge, where the exposure is evaluated, R^2. Any
    other shape adds the mean squared distances of its area and of its edges from its
    centre.
    """

    far: PointExposure
    middle: PointExposure
    near: PointExposure
    close: PointExposure


def count_pillars(bodies: Sequence[PillarArray], entries: int) -> Array:
    """(entries,) pillars of each entry in all bodies."""
    none = np.zeros(entries, np.int64)
    total = sum((body.counts(entries - 1) for body in bodies), none)
    total[0] = 0
    return total


def split_ranges(
    point: PointExposure, kinds: DrawnKinds, number: Array, body: PillarArray
) -> ScatterRanges:
    """Split the Gaussians of a point exposure by how far they reach among the pillars.

    Far: at least six lattice steps wide, so that nodes may be as coarse as the lattice.
    Middle: others that neighbours receive. Near: others. Far and middle are widened by
    the mean size of the pillars.

    Args:
        point: exposure of a beam.
        kinds: kinds of pillars.
        number: (entries,) pillars of each.
        body: the densest lattice.
    """
    mass = number * kinds.area_um2
    total = float(mass.sum())
    wider = float((mass * kinds.wider_um2).sum() / total) if total else 0.0
    from_neighbours = np.array(
        [
            _neighbour_exposure(kinds, number > 0, body.steps_um, width)
            for width in point.widths_um
        ]
    )
    far = point.widths_um >= NODES_PER_WIDTH * body.nearest_um
    middle = ~far & (
        (from_neighbours * point.weights > _NEGLIGIBLE)
        | (point.widths_um > body.nearest_um)
    )

    def widened(chosen: Array, wider: float) -> PointExposure:
        return PointExposure(
            np.sqrt(point.widths_um[chosen] ** 2 + wider), point.weights[chosen]
        )

    return ScatterRanges(
        widened(far, wider),
        widened(middle, wider),
        widened(~far & ~middle, 0.0),
        widened(~far, 0.0),
    )


def _neighbour_exposure(
    kinds: DrawnKinds, used: Array, steps_um: Array, width_um: float
) -> float:
    """Mean exposure of the edges of a pillar by equal neighbours, at the largest.

    Args:
        kinds: kinds of pillars.
        used: (entries,) which occur.
        steps_um: (n, 2) positions of the neighbours.
        width_um: 1/e radius of one Gaussian of weight 1.
    """
    exposures = [0.0]
    for entry in kinds.widest(used, steps_um) if used.any() else []:
        positions = kinds.edge_points_um(entry)[:, None] - steps_um
        exposures.append(
            float(kinds.exposure_at(entry, positions, width_um).sum(1).mean())
        )
    return max(exposures)


def exposure_table(
    kinds: DrawnKinds,
    goal: Array,
    number: Array,
    *,
    point: PointExposure,
    ranges: ScatterRanges,
    body: PillarArray,
) -> ExposureTable:
    """What each entry of a mask exposes at its own edge, and what is sought there.

    Args:
        kinds: kinds of pillars.
        goal: (entries,) edge exposure sought, over the threshold.
        number: (entries,) pillars of each.
        point: exposure of a beam.
        ranges: the same by reach.
        body: the densest of the lattices.

    Raises:
        ProcessError: no pillar, or pillars so much finer than the point exposure that
            their own dose hardly changes their edge.
    """
    used = number > 0
    if not used.any():
        raise ProcessError("no pillar is drawn: there is nothing to expose")
    area = np.where(used, kinds.area_um2, 0.0)
    own_and_far, slope = kinds.edge_exposure(used, point)
    own = np.where(
        used, own_and_far - area * float(ranges.far.density(np.array(0.0))), 0.0
    )
    neighbours = area * _neighbour_bound(ranges.middle, body)
    if own[used].min() < _FAINT or (neighbours >= 0.9 * own)[used].any():
        thin = 1e3 * float(kinds.diameter_um[used][own[used].argmin()])
        raise ProcessError(
            f"a pillar of {thin:.0f} nm gives its own edge an exposure of {own[used].min():.3f} only, less than its "
            "neighbours do: the core of the point exposure (alpha_um) is too wide for these pillars"
        )
    return ExposureTable(area, goal, own, slope, number)


def _neighbour_bound(middle: PointExposure, body: PillarArray) -> float:
    """Bound of the eigenvalues of the middle convolution without its centre, per um^2.

    The smaller of two bounds: the sum of the kernel over all other sites, and its value
    at 0 (the whole kernel has no negative eigenvalues).

    Args:
        middle: Gaussians that reach neighbours only.
        body: lattice of pillars.
    """
    reach = 5 * float(middle.widths_um.max(initial=0.0))
    columns, rows = (
        np.arange(-n, n + 1)
        for n in (int(np.ceil(reach / step)) for step in (body.pitch_um, body.down_um))
    )
    distance = np.hypot(columns * body.pitch_um, (rows * body.down_um)[:, None])
    distances = (
        distance[(columns + rows[:, None]) % 2 == 0] if body.centred else distance
    )
    at_zero = float(middle.density(np.array(0.0)))
    return min(at_zero, float(middle.density(distances).sum()) - at_zero)
