"""What a written mask exposes: round pillars by kind and place, every other shape as a polygon with its dose."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from layout.files import MaskContent, flat
from layout.process import LayerNumber
from metalens.ground.arrays import Array
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm

_ROUND = 0.85  # 4 pi area / perimeter^2 above this is a round pillar


@dataclass(frozen=True, eq=False, slots=True)
class Pillars:
    """Round pillars.

    x_um, y_um: (n,) centres. kind: (n,) index into what follows. size_um, area_um2, dose, layer: (kinds,) equal-area
    diameter, area, relative dose, layer number.
    """

    x_um: Array
    y_um: Array
    kind: Array
    size_um: Array
    area_um2: Array
    dose: Array
    layer: Array


@dataclass(frozen=True, eq=False, slots=True)
class Polygons:
    """All other shapes: corners (counter-clockwise, um), relative doses and layer numbers, one each."""

    corners: Sequence[Array]
    dose: Array
    layer: Array


def gathered(
    content: MaskContent, doses: Mapping[LayerNumber, float], fixed: Sequence[int]
) -> tuple[Pillars, Polygons, tuple[LayerNumber, ...]]:
    """Everything below the top cells but the layer numbers ``fixed``; and layers with shapes and no dose.

    Raises:
        ProcessError: no round pillar has a dose.
    """
    unit = content.unit_nm * nm
    round_ones: list[tuple[Array, Array, float, float, int]] = []
    corners: list[Array] = []
    others: list[tuple[float, int]] = []
    missing: set[LayerNumber] = set()
    for stack in (s for top in content.tops for s in flat.stacks(content, top)):
        if stack.layer[0] in fixed:
            continue
        if stack.layer not in doses:
            missing.add(stack.layer)
            continue
        outlines, x, y, dose = stack.outlines * unit, stack.x * unit, stack.y * unit, doses[stack.layer]
        area, centre, roundness = _measured(outlines)
        is_round = roundness > _ROUND
        for k in np.flatnonzero(is_round).tolist():
            round_ones.append((x + centre[k, 0], y + centre[k, 1], float(area[k]), dose, stack.layer[0]))
        some = outlines[~is_round]
        if len(some):
            corners += list((some[None] + np.stack([x, y], -1)[:, None, None]).reshape(-1, *some.shape[1:]))
            others += [(dose, stack.layer[0])] * (len(some) * len(x))
    if not round_ones:
        raise ProcessError("the mask holds no round pillar with a dose; nothing can be certified")
    table = np.array(others, float).reshape(-1, 2)
    polygons = Polygons(corners, table[:, 0], table[:, 1].astype(np.int64))
    return _pillars(round_ones), polygons, tuple(sorted(missing))


def _pillars(found: list[tuple[Array, Array, float, float, int]]) -> Pillars:
    x, y = (np.concatenate([each[k] for each in found]) for k in (0, 1))
    kind = np.repeat(np.arange(len(found), dtype=np.int32), [len(each[0]) for each in found])
    area, dose, layer = (np.array([each[k] for each in found]) for k in (2, 3, 4))
    return Pillars(x, y, kind, 2 * np.sqrt(area / np.pi), area, dose, layer)


def _measured(outlines: Array) -> tuple[Array, Array, Array]:
    """(k,) areas, (k, 2) centroids and (k,) roundness of (k, n, 2) polygons."""
    after = np.roll(outlines, -1, axis=1)
    cross = outlines[..., 0] * after[..., 1] - after[..., 0] * outlines[..., 1]
    area = cross.sum(1) / 2
    centre = ((outlines + after) * cross[..., None]).sum(1) / (6 * area[:, None])
    around = np.hypot(*np.moveaxis(after - outlines, -1, 0)).sum(1)
    return area, centre, 4 * np.pi * area / around**2
