"""What a written mask exposes: pillars by kind and place, every other shape as a
polygon with its dose.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from layout.certify.places import OnLattices
from layout.certify.shaped import Shapes
from layout.files import NOTHING, MaskContent, flat
from layout.mask import MaskPlan
from layout.process import LayerNumber
from layout.shapes import region
from layout.shapes.moments import Contours, moments, perimeter
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm

_ROUND = 0.85  # 4 pi area / perimeter^2 above this is a round pillar


@dataclass(frozen=True, eq=False, slots=True)
class Kinds:
    """Pillars that differ. size_um, area_um2, dose, layer: (kinds,) equal-area
    diameter, area, relative dose,
    layer number.

    shapes: those that differ; shape: (kinds,) number of each. None where all pillars
    are round.
    drawn_um: (kinds,) the size that a shape goes by (of a round one its equal-area
    diameter). share: (kinds,) how much
    the equal-area diameter grows where all edges move so far out that this size grows
    by 1.
    """

    size_um: Array
    area_um2: Array
    dose: Array
    layer: Array
    drawn_um: Array
    share: Array
    shapes: Shapes | None = None
    shape: Array | None = None


@dataclass(frozen=True, eq=False, slots=True)
class Polygons:
    """All other shapes: corners (counter-clockwise, um), relative doses and layer
    numbers, one each.
    """

    corners: Sequence[Array]
    dose: Array
    layer: Array


@dataclass(frozen=True, eq=False, slots=True)
class Exposed:
    """Everything that is exposed: kinds of pillars and their places, other shapes,
    layers without a dose.
    """

    kinds: Kinds
    places: OnLattices
    others: Polygons
    undosed: tuple[LayerNumber, ...]


def on_lattices(
    content: MaskContent,
    plan: MaskPlan,
    doses: Mapping[LayerNumber, float],
    fixed: Sequence[int],
) -> Exposed:
    """Everything below the top cell but the layer numbers ``fixed``, of a file whose
    lattices hold exactly the places
    of ``plan`` (their sums agree).

    Shapes, layers and figures come from the file, doses from the table; of the plan the
    places are taken, and of each
    class whether it stands for a circle, or the size that it goes by.

    Raises:
        ProcessError: no pillar has a dose; a class that is not one outline, with or
            without holes.
    """
    found = _Found(content.unit_nm * nm, doses, fixed)
    empty = {
        l.name: dataclasses.replace(content.cells[l.name], placed=NOTHING, sums=None)
        for l in plan.lattices
    }
    bare = dataclasses.replace(content, cells={**content.cells, **empty})
    for stack in flat.stacks(bare, plan.name):
        found.take(stack)
    if found.x:
        raise ProcessError(
            f"{len(found.x)} round shapes beside the lattices of the plan; read all places of the file"
        )
    counts, kinds = plan.counts(), np.full(len(plan.classes) + 1, -1, np.int32)
    for number in np.flatnonzero(counts[1:] > 0) + 1:
        made = plan.classes[number - 1]
        kinds[number] = found.single(
            list(flat.stacks(content, made.name)),
            0.0 if made.round else made.diameter_nm,
        )
    if not found.x:
        raise ProcessError(
            "the mask holds no pillar with a dose; nothing can be certified"
        )
    centres = np.column_stack([np.concatenate(found.x), np.concatenate(found.y)])
    count = int(counts[1:][kinds[1:] >= 0].sum())
    places = OnLattices.of(
        plan.lattices, kinds, centres, unit_nm=content.unit_nm, count=count
    )
    return Exposed(found.kinds, places, found.others, tuple(sorted(found.missing)))


class _Found:
    """Shapes while they are gathered: (x, y) places of each kind of pillar, and
    polygons.
    """

    def __init__(
        self, unit_um: float, doses: Mapping[LayerNumber, float], fixed: Sequence[int]
    ) -> None:
        self.x: list[Array] = []
        self.y: list[Array] = []
        self.missing: set[LayerNumber] = set()
        self._unit, self._doses, self._fixed = unit_um, doses, fixed
        self._pillars: list[
            tuple[float, float, int, float, float]
        ] = []  # area, dose, layer, drawn size, share
        self._contours: list[Contours] = []
        self._shaped = False
        self._corners: list[Array] = []
        self._others: list[tuple[float, int]] = []

    def take(self, stack: flat.Stack) -> None:
        """Take in copies of some polygons."""
        if stack.layer[0] in self._fixed:
            return
        if stack.layer not in self._doses:
            self.missing.add(stack.layer)
            return
        outlines, dose = stack.outlines * self._unit, self._doses[stack.layer]
        area, centre, roundness = _measured(outlines)
        is_round = roundness > _ROUND
        for k in np.flatnonzero(is_round).tolist():
            self.x.append(stack.x * self._unit + centre[k, 0])
            self.y.append(stack.y * self._unit + centre[k, 1])
            self._keep(float(area[k]), dose, stack.layer[0], [outlines[k] - centre[k]])
        some = outlines[~is_round]
        if len(some):
            places = np.stack([stack.x, stack.y], -1)[:, None, None] * self._unit
            self._corners += list((some[None] + places).reshape(-1, *some.shape[1:]))
            self._others += [(dose, stack.layer[0])] * (len(some) * len(stack.x))

    def _keep(
        self,
        area: float,
        dose: float,
        layer: int,
        contours: Contours,
        size_um: float = 0.0,
    ) -> None:
        """A kind of pillar, its contours about its middle; without a size it is a disc."""
        disc = 2 * math.sqrt(area / math.pi)
        share = perimeter(contours) / (math.pi * disc) if size_um else 1.0
        self._pillars.append((area, dose, layer, size_um or disc, share))
        self._contours.append(contours)
        self._shaped |= size_um > 0

    def single(self, stacks: Sequence[flat.Stack], size_nm: float) -> int:
        """Take in what one class of pillars draws; its kind, -1 where it has no dose.

        size_nm: that a shape goes by; 0 for a circle.

        Raises:
            ProcessError: it is not one round polygon, or not one outline.
        """
        before, others = len(self.x), len(self._others)
        if size_nm:
            self._take_shape(stacks, size_nm * nm)
        else:
            for stack in stacks:
                self.take(stack)
        if len(self.x) > before + 1 or len(self._others) > others:
            raise ProcessError(
                "a class of pillars draws more than one round polygon; it is not certified as one"
            )
        return before if len(self.x) > before else -1

    def _take_shape(self, stacks: Sequence[flat.Stack], size_um: float) -> None:
        drawn = [stack for stack in stacks if stack.layer[0] not in self._fixed]
        self.missing |= {
            stack.layer for stack in drawn if stack.layer not in self._doses
        }
        if not drawn or any(stack.layer not in self._doses for stack in drawn):
            return
        every = [
            c + np.array(at)
            for s in drawn
            for c in s.outlines
            for at in zip(s.x, s.y, strict=True)
        ]
        contours = [np.asarray(c) * self._unit for c in region.union(every)]
        outer = sum(moments([c])[0] > 0 for c in contours)
        if outer != 1 or len({stack.layer for stack in drawn}) > 1:
            raise ProcessError(
                f"a class of pillars draws {outer} outlines; it is not certified as one"
            )
        area, first, _ = moments(contours)
        centre = first / area
        self.x.append(centre[:1])
        self.y.append(centre[1:])
        self._keep(
            area,
            self._doses[drawn[0].layer],
            drawn[0].layer[0],
            [c - centre for c in contours],
            size_um,
        )

    @property
    def kinds(self) -> Kinds:
        """Of the pillars."""
        area, dose, layer, drawn, share = (
            np.array([each[k] for each in self._pillars]) for k in range(5)
        )
        shapes, shape = self._different() if self._shaped else (None, None)
        return Kinds(
            2 * np.sqrt(area / np.pi), area, dose, layer, drawn, share, shapes, shape
        )

    def _different(self) -> tuple[Shapes, Array]:
        """Shapes that differ by more than a thousandth of a unit, and which each kind
        has.
        """
        seen: dict[bytes, int] = {}
        keys = [
            b"|".join(
                np.rint(c / self._unit * 1e3).astype(np.int64).tobytes() for c in cs
            )
            for cs in self._contours
        ]
        shape = np.array([seen.setdefault(key, len(seen)) for key in keys], np.int64)
        first = [keys.index(key) for key in seen]
        return Shapes.of([self._contours[k] for k in first]), shape

    @property
    def others(self) -> Polygons:
        """All other shapes."""
        table = np.array(self._others, float).reshape(-1, 2)
        return Polygons(self._corners, table[:, 0], table[:, 1].astype(np.int64))


def _measured(outlines: Array) -> tuple[Array, Array, Array]:
    """(k,) areas, (k, 2) centroids and (k,) roundness of (k, n, 2) polygons."""
    after = np.roll(outlines, -1, axis=1)
    cross = outlines[..., 0] * after[..., 1] - after[..., 0] * outlines[..., 1]
    area = cross.sum(1) / 2
    centre = ((outlines + after) * cross[..., None]).sum(1) / (6 * area[:, None])
    around = np.hypot(*np.moveaxis(after - outlines, -1, 0)).sum(1)
    return area, centre, 4 * np.pi * area / around**2
