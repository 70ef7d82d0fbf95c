"""How far the fast sum is from exact shapes, at sample pillars."""

import numpy as np

from layout.dose.assign import Assigned, Fields, Ladder, classes
from layout.dose.bodies import NONE, Body
from layout.dose.drawn import Drawn
from layout.dose.exposure import CLEARS, PointExposure
from metalens.ground.arrays import Array

_NEIGHBOURS = 5  # sites on each side whose shapes are taken exactly


def sampled_error(
    fields: Fields,
    steps: Ladder,
    found: Assigned,
    *,
    point: PointExposure,
    samples: int,
) -> float:
    """Largest |fast - exact| / wanted exposure at pillars of the first body, evenly
    drawn.

    Exact: whole shapes of all pillars within 5 sites, seen along the edges, and the
    direct sum over every other
    pillar (and piece of a rectangle) of Gaussians whose second moment is that of its
    shape.
    """
    lens = fields.bodies[0]
    rows, columns = _some(lens, samples)
    dose = np.zeros(NONE + 1)
    dose[: len(steps.factors)] = steps.factors
    distant = _distant(fields, steps, dose, (rows, columns))
    own = _own(lens, (rows, columns), fields.table.drawn, point)
    worst = 0.0
    for n, (row, column) in enumerate(
        zip(rows.tolist(), columns.tolist(), strict=True)
    ):
        block, first = _around(lens, row)
        chosen = classes(fields, 0, first, block, steps)
        entry = int(block[row - first, column])
        near = fields.at(found.far, 0, row, 1, found.near)[0, column]
        fast = dose[chosen[row - first, column]] * fields.table.own[entry] + near
        left = max(column - _NEIGHBOURS, 0)
        here = slice(left, column + _NEIGHBOURS + 1)
        given = dose[chosen[:, here]]
        beside = _close(
            fields, (block[:, here], given), (row - first, column - left), point
        )
        exact = distant[n] + given[row - first, column - left] * own[entry] + beside
        worst = max(worst, abs(fast - exact) / (CLEARS * fields.table.goal[entry]))
    return float(worst)


def _some(body: Body, samples: int) -> tuple[Array, Array]:
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


def _own(
    body: Body, sites: tuple[Array, Array], drawn: Drawn, point: PointExposure
) -> Array:
    """(entries,) exposure of the edges of the pillars on these sites by themselves, at
    unit dose; each shape once.
    """
    used = np.zeros(len(drawn.area_um2), bool)
    for row in np.unique(sites[0]).tolist():
        used[body.source(row, row + 1)[0][sites[1][sites[0] == row]]] = True
    return drawn.edges(used, point)[0]


def _around(body: Body, row: int) -> tuple[Array, int]:
    first = max(row - _NEIGHBOURS, 0)
    return np.ascontiguousarray(
        body.source(first, min(row + _NEIGHBOURS + 1, body.rows))
    ), first


def _distant(
    fields: Fields, steps: Ladder, dose: Array, sites: tuple[Array, Array]
) -> Array:
    """(samples,) background from all that is more than 5 sites away, by the direct sum
    of Gaussians.
    """
    lens, area = fields.bodies[0], fields.table.area_um2
    at_x, at_y = lens.columns_um[sites[1]], lens.rows_um(0, lens.rows)[sites[0]]
    ranges = [*_terms(fields.ranges.far), *_terms(fields.ranges.middle)]
    total = np.zeros(len(at_x))
    for number, body in enumerate(fields.bodies):
        for first, block in body.blocks():
            mass = (
                area.take(block)
                * dose.take(classes(fields, number, first, block, steps))
            ).astype(np.float32)
            y = body.rows_um(first, len(block))
            for width, weight in ranges:
                wx, wy = _bell(body.columns_um, at_x, width), _bell(y, at_y, width)
                total += (
                    weight / (np.pi * width**2) * ((mass @ wx) * wy).sum(0, dtype=float)
                )
                if not number:
                    total -= (
                        weight
                        / (np.pi * width**2)
                        * _own_block(mass, first, sites, wx, wy)
                    )
    points, areas, of = fields.spots
    given = dose[
        steps.nearest(
            (CLEARS * fields.rects.goal - fields.of_rects(fields.far)) / fields.own
        )
    ]
    for width, weight in _terms(fields.ranges.far):
        if len(points):
            bell = _bell(points[:, 0], at_x, width) * _bell(points[:, 1], at_y, width)
            total += weight / (np.pi * width**2) * ((areas * given[of]) @ bell)
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
    fields: Fields,
    block: tuple[Array, Array],
    site: tuple[int, int],
    point: PointExposure,
) -> float:
    """Exposure of the edges of one pillar by the shapes within 5 sites, exact."""
    (index, given), (row, column), body, drawn = (
        block,
        site,
        fields.bodies[0],
        fields.table.drawn,
    )
    y = (row - np.arange(index.shape[0])) * body.down_um  # rows run towards -y
    x = (np.arange(index.shape[1]) - column) * body.pitch_um
    mine = int(index[row, column])
    edge, others = drawn.edge_um(mine), index > 0
    others[row, column] = False
    total = 0.0
    for entry in np.unique(index[others]).tolist():
        i, j = np.nonzero(others & (index == entry))
        at = edge[:, None] - np.stack([x[j], y[i]], -1)
        for width, weight in zip(point.widths_um, point.weights, strict=True):
            total += weight * float(
                (drawn.given(entry, at, float(width)) * given[i, j]).sum(-1).mean()
            )
    return total
