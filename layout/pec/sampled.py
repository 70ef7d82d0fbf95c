"""Exposure of sample pillars by the direct sum over exact shapes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from layout.mask.plan import PillarArray
from layout.pec.bodies import COARSE, ScatterRanges
from layout.pec.drawn import DrawnKinds
from layout.pec.psf import PointExposure
from metalens.core.arrays import Array

_NEIGHBOURS = 5  # sites on each side whose shapes are taken exactly


@dataclass(frozen=True, eq=False, slots=True)
class ExposedLattices:
    """Doses on lattices, as the exact sum takes them.

    bodies: the samples are pillars of the first. drawn: their kinds, by entry. own:
    (entries,) exposure of an edge by its own pillar, at unit dose.
    ranges: Gaussians widened by the mean pillar. spots: x and y (n, 2), and area times
    dose of what is no pillar.
    dose_of: (body, first row, entries of a block) -> (rows, columns) relative doses.
    """

    bodies: Sequence[PillarArray]
    drawn: DrawnKinds
    own: Array
    ranges: ScatterRanges
    point: PointExposure
    spots: tuple[Array, Array]
    dose_of: Callable[[int, int, Array], Array]


def exact_edges(scene: ExposedLattices, samples: int) -> tuple[Array, Array, Array]:
    """Rows and columns of pillars, evenly drawn, and the exposure of their edges.

    Exact: whole shapes of all pillars within 5 sites, seen along the edges, and the
    direct sum over every other pillar (and piece of a mark) of Gaussians whose second
    moment is that of its shape.

    Args:
        scene: lattices with doses.
        samples: pillars of the first lattice.
    """
    lens = scene.bodies[0]
    rows, columns = _some(lens, samples)
    exposure = _distant(scene, (rows, columns))
    for n, (row, column) in enumerate(
        zip(rows.tolist(), columns.tolist(), strict=True)
    ):
        block, first = _around(lens, row)
        given = scene.dose_of(0, first, block)
        left = max(column - _NEIGHBOURS, 0)
        here = slice(left, column + _NEIGHBOURS + 1)
        entry = int(block[row - first, column])
        exposure[n] += given[row - first, column] * scene.own[entry]
        exposure[n] += _close(
            scene, (block[:, here], given[:, here]), (row - first, column - left)
        )
    return rows, columns, exposure


def _some(body: PillarArray, samples: int) -> tuple[Array, Array]:
    """Pillars of some rows spread over the lens, so that no list of all pillars is
    made.
    """
    rows, columns = [], []
    for row in np.unique(
        np.linspace(0, body.rows - 1, 4 * samples).astype(int)
    ).tolist():
        found = np.nonzero(body.source(row, row + 1)[0])[0]
        pick = (
            found[np.unique(np.linspace(0, len(found) - 1, samples).astype(int))]
            if len(found)
            else found
        )
        rows.append(np.full(len(pick), row))
        columns.append(pick)
    every = np.concatenate(rows), np.concatenate(columns)
    if not len(every[0]):  # a few pillars, off the sampled rows
        first, block = next((f, b) for f, b in body.blocks() if b.any())
        every = tuple(v[:samples] for v in np.nonzero(block))  # type: ignore[assignment]
        every = every[0] + first, every[1]
    pick = np.unique(np.linspace(0, len(every[0]) - 1, samples).astype(int))
    return every[0][pick], every[1][pick]


def _around(body: PillarArray, row: int) -> tuple[Array, int]:
    first = max(row - _NEIGHBOURS, 0)
    return np.ascontiguousarray(
        body.source(first, min(row + _NEIGHBOURS + 1, body.rows))
    ), first


def _distant(scene: ExposedLattices, sites: tuple[Array, Array]) -> Array:
    """(samples,) background from all that is more than 5 sites away, by the direct sum
    of Gaussians.
    """
    lens = scene.bodies[0]
    area = scene.drawn.area_um2
    at_x = lens.columns_um[sites[1]]
    at_y = lens.rows_um(0, lens.rows)[sites[0]]
    ranges = [*_terms(scene.ranges.far), *_terms(scene.ranges.middle)]
    total = np.zeros(len(at_x))
    for number, body in enumerate(scene.bodies):
        for first, block in body.blocks():
            dose = scene.dose_of(number, first, block)
            mass = (area.take(block) * dose).astype(np.float32)
            y = body.rows_um(first, len(block))
            for width, weight in ranges:
                scale = weight / (np.pi * width**2)
                wx = _bell(body.columns_um, at_x, width)
                wy = _bell(y, at_y, width)
                total += scale * ((mass @ wx) * wy).sum(0, dtype=float)
                if not number:
                    total -= scale * _own_block(mass, first, sites, wx, wy)
    points, mass = scene.spots
    for width, weight in _terms(scene.ranges.far):
        if len(points):
            bell = _bell(points[:, 0], at_x, width) * _bell(points[:, 1], at_y, width)
            total += weight / (np.pi * width**2) * (mass @ bell)
    return total


def _terms(point: PointExposure) -> list[tuple[float, float]]:
    return list(zip(point.widths_um.tolist(), point.weights.tolist(), strict=True))


def _bell(positions: Array, centres: Array, width: float) -> Array:
    return np.asarray(
        np.exp(-(((positions[:, None] - centres) / width) ** 2)), np.float32
    )


def _own_block(
    mass: Array, first: int, sites: tuple[Array, Array], wx: Array, wy: Array
) -> Array:
    """(samples,) what pillars of this block within 5 sites of each sample contribute."""
    found = np.zeros(len(sites[0]))
    for n, (row, column) in enumerate(
        zip(sites[0].tolist(), sites[1].tolist(), strict=True)
    ):
        rows = slice(
            max(row - _NEIGHBOURS - first, 0), max(row + _NEIGHBOURS + 1 - first, 0)
        )
        columns = slice(max(column - _NEIGHBOURS, 0), column + _NEIGHBOURS + 1)
        found[n] = wy[rows, n] @ mass[rows, columns] @ wx[columns, n]
    return found


def _close(
    scene: ExposedLattices, block: tuple[Array, Array], site: tuple[int, int]
) -> float:
    """Exposure of the edges of one pillar by those within 5 sites: of exact shapes, or
    Gaussians of their second moments where the point exposure is far wider than these.
    """
    (index, given), (row, column) = block, site
    body = scene.bodies[0]
    drawn = scene.drawn
    point = scene.point
    others = index > 0
    others[row, column] = False
    i, j = np.nonzero(others)
    entry = index[i, j]
    dose = given[i, j]
    # rows run towards -y
    place = np.column_stack([(j - column) * body.pitch_um, (row - i) * body.down_um])
    away = np.hypot(*place.T)
    mine = int(index[row, column])
    edge = drawn.edge_points_um(mine)
    total = 0.0
    for width, weight in zip(
        point.widths_um.tolist(), point.weights.tolist(), strict=True
    ):
        if width >= COARSE * body.nearest_um:
            wider = (2 * drawn.wider_um2[mine] + drawn.wider_um2[entry]) / 3
            square = width**2 + wider  # of discs R^2 of the edge, R^2 / 2 of the area
            bell = np.exp(-(away**2) / square) / (np.pi * square)
            total += weight * float((dose * drawn.area_um2[entry] * bell).sum())
            continue
        for kind in np.unique(entry[away < _reach(drawn, edge, width)]).tolist():
            same = entry == kind
            at = edge[:, None] - place[same]
            seen = drawn.exposure_at(kind, at, width) * dose[same]
            total += weight * float(seen.sum(-1).mean())
    return total


def _reach(drawn: DrawnKinds, edge: Array, width: float) -> float:
    """From middle to middle, where pillars expose each other's edges (exp(-36))."""
    widest = float(np.sqrt(drawn.wider_um2.max()))
    return float(np.hypot(*edge.T).max()) + widest + 6 * width
