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
    (entries,) exposure of an edge by its own pillar, at unit dose. ranges: Gaussians
    widened by the mean pillar. spots: (n, 2) x and y, and (n,) area times dose of marks
    and labels. dose_of: (body, first row, entries of a block) -> (rows, columns)
    relative doses.
    """

    bodies: Sequence[PillarArray]
    drawn: DrawnKinds
    own: Array
    ranges: ScatterRanges
    point: PointExposure
    spots: tuple[Array, Array]
    dose_of: Callable[[int, int, Array], Array]


def exact_edges(scene: ExposedLattices, samples: int) -> tuple[Array, Array, Array]:
    """Exposure of the edges of sample pillars, by direct sums.

    Pillars within 5 sites count with their exact shapes. Every other pillar, and piece
    of a mark, is a Gaussian sum whose second moment is that of its shape.

    Args:
        scene: lattices with doses.
        samples: pillars of the first lattice, evenly over it.

    Returns:
        (samples,) rows, (samples,) columns and (samples,) exposures.
    """
    lens = scene.bodies[0]
    rows, columns = _some(lens, samples)
    exposure = _distant(scene, (rows, columns))
    for n, (row, column) in enumerate(
        zip(rows.tolist(), columns.tolist(), strict=True)
    ):
        block, first = _around(lens, row)
        dose = scene.dose_of(0, first, block)
        left = max(column - _NEIGHBOURS, 0)
        nearby = slice(left, column + _NEIGHBOURS + 1)
        entry = int(block[row - first, column])
        exposure[n] += dose[row - first, column] * scene.own[entry]
        exposure[n] += _close(
            scene, (block[:, nearby], dose[:, nearby]), (row - first, column - left)
        )
    return rows, columns, exposure


def _some(body: PillarArray, samples: int) -> tuple[Array, Array]:
    """Rows and columns of at most some ``samples`` pillars, evenly over a lattice.

    Only sampled rows are read, so that no list of all pillars is needed. Where these
    hold no pillar, the first block with pillars is taken.
    """
    rows, columns = [], []
    for row in np.unique(
        np.linspace(0, body.rows - 1, 4 * samples).astype(int)
    ).tolist():
        occupied = np.nonzero(body.source(row, row + 1)[0])[0]
        chosen = (
            occupied[np.unique(np.linspace(0, len(occupied) - 1, samples).astype(int))]
            if len(occupied)
            else occupied
        )
        rows.append(np.full(len(chosen), row))
        columns.append(chosen)
    sites = np.concatenate(rows), np.concatenate(columns)
    if not len(sites[0]):  # a few pillars, off the sampled rows
        first, block = next((f, b) for f, b in body.blocks() if b.any())
        sites = tuple(v[:samples] for v in np.nonzero(block))  # type: ignore[assignment]
        sites = sites[0] + first, sites[1]
    chosen = np.unique(np.linspace(0, len(sites[0]) - 1, samples).astype(int))
    return sites[0][chosen], sites[1][chosen]


def _around(body: PillarArray, row: int) -> tuple[Array, int]:
    """Classes of the rows within 5 sites of a row, and the first of these rows."""
    first = max(row - _NEIGHBOURS, 0)
    return np.ascontiguousarray(
        body.source(first, min(row + _NEIGHBOURS + 1, body.rows))
    ), first


def _distant(scene: ExposedLattices, sites: tuple[Array, Array]) -> Array:
    """(samples,) background of all pillars and marks more than 5 sites away.

    sum of dose * area * weight / (pi w^2) * exp(-r^2 / w^2), with widths w that the
    size of the mean pillar has widened.

    Args:
        scene: lattices with doses.
        sites: rows and columns of the samples on the first lattice.
    """
    lens = scene.bodies[0]
    area = scene.drawn.area_um2
    sample_x = lens.columns_um[sites[1]]
    sample_y = lens.rows_um(0, lens.rows)[sites[0]]
    ranges = [*_terms(scene.ranges.far), *_terms(scene.ranges.middle)]
    total = np.zeros(len(sample_x))
    for number, body in enumerate(scene.bodies):
        for first, block in body.blocks():
            dose = scene.dose_of(number, first, block)
            mass = (area.take(block) * dose).astype(np.float32)
            y = body.rows_um(first, len(block))
            for width, weight in ranges:
                scale = weight / (np.pi * width**2)
                bell_x = _bell(body.columns_um, sample_x, width)
                bell_y = _bell(y, sample_y, width)
                total += scale * ((mass @ bell_x) * bell_y).sum(0, dtype=float)
                if not number:
                    total -= scale * _own_block(mass, first, sites, bell_x, bell_y)
    points, mass = scene.spots
    for width, weight in _terms(scene.ranges.far):
        if len(points):
            bell = _bell(points[:, 0], sample_x, width) * _bell(
                points[:, 1], sample_y, width
            )
            total += weight / (np.pi * width**2) * (mass @ bell)
    return total


def _terms(point: PointExposure) -> list[tuple[float, float]]:
    """[(width in um, weight)] of the Gaussians."""
    return list(zip(point.widths_um.tolist(), point.weights.tolist(), strict=True))


def _bell(positions: Array, centres: Array, width: float) -> Array:
    """(positions, centres) exp(-((position - centre) / width)^2), float32."""
    return np.asarray(
        np.exp(-(((positions[:, None] - centres) / width) ** 2)), np.float32
    )


def _own_block(
    mass: Array, first: int, sites: tuple[Array, Array], bell_x: Array, bell_y: Array
) -> Array:
    """(samples,) sum over the pillars of a block within 5 sites of each sample.

    Args:
        mass: (rows, columns) dose times area.
        first: row of the block.
        sites: rows and columns of the samples.
        bell_x: (columns, samples) Gaussian along x.
        bell_y: (rows, samples) Gaussian along y.
    """
    sums = np.zeros(len(sites[0]))
    for n, (row, column) in enumerate(
        zip(sites[0].tolist(), sites[1].tolist(), strict=True)
    ):
        rows = slice(
            max(row - _NEIGHBOURS - first, 0), max(row + _NEIGHBOURS + 1 - first, 0)
        )
        columns = slice(max(column - _NEIGHBOURS, 0), column + _NEIGHBOURS + 1)
        sums[n] = bell_y[rows, n] @ mass[rows, columns] @ bell_x[columns, n]
    return sums


def _close(
    scene: ExposedLattices, block: tuple[Array, Array], site: tuple[int, int]
) -> float:
    """Exposure of the edges of one pillar by the pillars within 5 sites.

    Exact shapes are summed. Where a Gaussian is far wider than the pillars, each is a
    Gaussian of the same second moment.

    Args:
        scene: lattices with doses.
        block: (rows, columns) classes and doses around the pillar.
        site: row and column of the pillar in the block.
    """
    (index, doses), (row, column) = block, site
    body = scene.bodies[0]
    drawn = scene.drawn
    point = scene.point
    others = index > 0
    others[row, column] = False
    i, j = np.nonzero(others)
    entry = index[i, j]
    dose = doses[i, j]
    # rows run towards -y
    offset = np.column_stack([(j - column) * body.pitch_um, (row - i) * body.down_um])
    distance = np.hypot(*offset.T)
    own_class = int(index[row, column])
    edge = drawn.edge_points_um(own_class)
    total = 0.0
    for width, weight in zip(
        point.widths_um.tolist(), point.weights.tolist(), strict=True
    ):
        if width >= COARSE * body.nearest_um:
            wider = (2 * drawn.wider_um2[own_class] + drawn.wider_um2[entry]) / 3
            square = width**2 + wider  # of discs R^2 of the edge, R^2 / 2 of the area
            bell = np.exp(-(distance**2) / square) / (np.pi * square)
            total += weight * float((dose * drawn.area_um2[entry] * bell).sum())
            continue
        for kind in np.unique(entry[distance < _reach(drawn, edge, width)]).tolist():
            is_kind = entry == kind
            at = edge[:, None] - offset[is_kind]
            exposure = drawn.exposure_at(kind, at, width) * dose[is_kind]
            total += weight * float(exposure.sum(-1).mean())
    return total


def _reach(kinds: DrawnKinds, edge: Array, width: float) -> float:
    """Distance of two sites beyond which one pillar does not expose the other's edge.

    Six widths between the shapes, where a Gaussian is below exp(-36); um.
    """
    widest = float(np.sqrt(kinds.wider_um2.max()))
    return float(np.hypot(*edge.T).max()) + widest + 6 * width
