"""A die as a microscope of the picture's resolution sees it: the share of each point
that is covered.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from layout.arrange.joined import PartPlacement
from layout.arrange.parts import APERTURE, PILLARS, DieComponent
from layout.formats import MaskContent, PillarSites, flatten
from layout.process import Process
from layout.shapes import polygon
from metalens.core.arrays import Array

_FINER = 3  # samples of a large shape along a point of the picture
_BLOCK = 1 << 22

Spots = tuple[Array, Array, Array]  # x, y and area of what stands for shapes


@dataclass(frozen=True, eq=False, slots=True)
class DensityView:
    """Points of a picture: (rows, columns), the first row lowest, squares of ``side``
    units from (left, bottom).
    """

    left: float
    bottom: float
    side: float
    rows: int
    columns: int

    @classmethod
    def over(cls, box: Array, most: int) -> "DensityView":
        """Around left, bottom, right, top: ``most`` points along the longer side, and
        one for what is left over.
        """
        wide, high = float(box[2] - box[0]), float(box[3] - box[1])
        side = max(wide, high, 1.0) / most
        return cls(
            float(box[0]),
            float(box[1]),
            side,
            int(high / side) + 1,
            int(wide / side) + 1,
        )

    def add(self, spots: Spots, image: Array) -> None:
        """Put areas on the four points around each place, in shares of a point's area."""
        x, y, area = spots
        u, v = (x - self.left) / self.side - 0.5, (y - self.bottom) / self.side - 0.5
        i, j = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        a, b = u - i, v - j
        for row, column, share in (
            (j, i, (1 - a) * (1 - b)),
            (j, i + 1, a * (1 - b)),
            (j + 1, i, (1 - a) * b),
            (j + 1, i + 1, a * b),
        ):
            held = np.clip(row, 0, self.rows - 1) * self.columns + np.clip(
                column, 0, self.columns - 1
            )
            image += np.bincount(held, share * area / self.side**2, image.size).reshape(
                image.shape
            )


def coverage_map(
    placed: Sequence[PartPlacement], process: Process, view: DensityView
) -> dict[str, Array]:
    """{exposure: (rows, columns) share of each point that is covered}: pillars,
    aperture, layers of other files.
    """
    found: dict[str, Array] = {}
    for one in placed:
        spots = _of_part(one.part, process, view.side)
        for copies in one.copies(one.part.top):
            for x, y in zip(*(v.tolist() for v in copies.places()), strict=True):
                for kind, (u, v, area) in spots.items():
                    image = found.setdefault(kind, np.zeros((view.rows, view.columns)))
                    p, q = copies.turn.apply(u, v)
                    view.add((p + x, q + y, area * copies.turn.scale**2), image)
    return found


def _of_part(part: DieComponent, process: Process, side: float) -> dict[str, Spots]:
    """Spots of all shapes by exposure, those in one third of a point together."""
    layers = process.layers
    undrawn, content = (
        {layers.outline[0], layers.fields[0]},
        MaskContent("cell", 1.0, dict(part.cells)),
    )
    ours = {
        n[0]: PILLARS
        for n in (
            layers.pillar,
            layers.marks,
            layers.labels,
            layers.dose,
            layers.witness,
        )
    }
    ours[layers.aperture[0]] = APERTURE
    found: dict[str, list[Spots]] = {}
    for shape in flatten.flatten_shapes(content, part.top):
        if shape.layer[0] not in undrawn:
            x, y, area = _sampled(np.asarray(shape.outline, float), side / _FINER)
            every = (
                (x[:, None] + shape.x).ravel(),
                (y[:, None] + shape.y).ravel(),
                np.repeat(area, len(shape.x)),
            )
            found.setdefault(
                ours.get(shape.layer[0], f"layer {shape.layer[0]}"), []
            ).append(_merged(every, side))
    for placed in content.leaves(part.top) if part.sites else ():
        for n in np.flatnonzero(
            [placed.children[k] in part.sites for k in placed.child]
        ).tolist():
            for x, y, area in _of_sites(
                part, part.sites[placed.children[placed.child[n]]], side
            ):
                u, v = placed.turns[placed.turn[n]].apply(x, y)
                found.setdefault(PILLARS, []).append(
                    (u + placed.x[n], v + placed.y[n], area)
                )
    return {kind: _merged(_together(some), side) for kind, some in found.items()}


def _together(some: Sequence[Spots]) -> Spots:
    x, y, area = (np.concatenate([each[k] for each in some]) for k in range(3))
    return x, y, area


def _of_sites(part: DieComponent, sites: PillarSites, side: float) -> Iterator[Spots]:
    """The pillars of a lattice, some rows together."""
    l = sites.lattice
    drawn = [
        part.cells[child].polygons.values() if child else () for child in sites.children
    ]
    area = np.array(
        [
            0.0,
            *(
                sum(abs(polygon.twice_area(p)) / 2 for ps in each for p in ps)
                for each in drawn
            ),
        ]
    )
    for first, block in l.blocks(max(1, _BLOCK // l.columns)):
        row, column = np.nonzero(block)
        y = l.y0 - (first + row) * float(l.down)
        yield _merged(
            (l.x0 + column * float(l.pitch), y, area[block[row, column]]), side
        )


def _sampled(outline: Array, step: float) -> Spots:
    """Points within an outline ``step`` apart, which share its area; the middle of its
    box where it is no larger.
    """
    area = abs(polygon.twice_area(np.rint(outline).astype(np.int64))) / 2
    low, high = outline.min(0), outline.max(0)
    if (high - low).max() > step:
        from matplotlib.path import Path

        x, y = (
            np.arange(a + step / 2, b, step)
            if b - a > step
            else np.array([(a + b) / 2])
            for a, b in zip(low, high, strict=True)
        )
        grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        inside = grid[Path(np.vstack([outline, outline[:1]])).contains_points(grid)]
        if len(inside):
            return inside[:, 0], inside[:, 1], np.full(len(inside), area / len(inside))
    middle = (low + high) / 2
    return middle[:1], middle[1:], np.array([area])


def _merged(spots: Spots, side: float) -> Spots:
    """Spots within one third of a point as one, in their middle of mass."""
    x, y, area = spots
    step = side / _FINER
    i, j = (
        np.floor((x - x.min()) / step).astype(np.int64),
        np.floor((y - y.min()) / step).astype(np.int64),
    )
    wide = int(i.max()) + 1
    key = j * wide + i
    total = np.bincount(key, area)
    kept = np.flatnonzero(total > 0)
    middle_x, middle_y = (
        np.bincount(key, area * v)[kept] / total[kept] for v in (x, y)
    )
    return middle_x, middle_y, total[kept]
