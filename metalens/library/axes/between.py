"""t over two sizes, from exact solves on the nodes of a grid: rational along one size,
then along the other.

t is meromorphic in each size, with poles that move with the other one. Hence

    plain: t(x, y) = sum_jk l_j(x) l_k(y) t_jk, l the polynomials of Lagrange        (no poles: fails at resonances)
    here:  t(x, y_k) = r_k(x) for every node y_k, a rational function through the nodes
    x_j (AAA, one set of poles for
           all elements of the Jones matrix); then, at each x, a rational function of y
           through t(x, y_k).

The order of the two is arbitrary: the mean of both orders is the value. Where poles are
not resolved yet both orders
may err alike, so the doubt is the larger of their disagreement and of that with the
same made of fewer nodes (one in
four inner lines left out), the largest within half a distance of nodes.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter

from metalens.core.arrays import Array
from metalens.library import rational

FLOOR_SHARE = 0.05  # of the tolerance: in every doubt, for what neither order shows
FIT_SHARE = 0.1  # of the tolerance: residual of the rational fits


@dataclass(frozen=True, eq=False, slots=True)
class InterpolatedTable:
    """value: (p, q, components) at the places asked for; doubt: (p, q), of the
    interpolation alone.
    """

    value: Array
    doubt: Array


def interpolate_table(
    nodes: tuple[Array, Array],
    values: Array,
    places: tuple[Array, Array],
    *,
    tolerance: float,
) -> InterpolatedTable:
    """t at all pairs of places.

    Args:
        nodes: (m,) and (n,) rising sizes along x and y; values: (m, n, components)
            there.
        places: (p,) and (q,) sizes, within the nodes, evenly spaced.
    """
    (x, y), (at_x, at_y) = nodes, places
    first = _both(x, y, values, at_x, at_y, tolerance)
    second = _both(y, x, values.swapaxes(0, 1), at_y, at_x, tolerance).swapaxes(0, 1)
    apart = np.abs(first - second).max(axis=-1)
    row, column = _fewer(len(x)), _fewer(len(y))
    rival = _both(x[row], y[column], values[np.ix_(row, column)], at_x, at_y, tolerance)
    apart = np.maximum(apart, np.abs(rival - (first + second) / 2).max(axis=-1))
    reach = [_half_gap(node, place) for node, place in ((x, at_x), (y, at_y))]
    apart = maximum_filter(apart, size=[2 * n + 1 for n in reach], mode="nearest")
    return InterpolatedTable(
        (first + second) / 2, np.asarray(apart + FLOOR_SHARE * tolerance)
    )


def _fewer(count: int) -> Array:
    """Places of the nodes of the rival: one in four inner ones is left out."""
    place = np.arange(count)
    return np.asarray(place[(place % 4 != 2) | (place == count - 1)])


def _half_gap(nodes: Array, places: Array) -> int:
    """Places within half the mean distance of nodes."""
    if len(places) < 2:
        return 0
    return math.ceil(
        float(np.diff(nodes).mean()) / 2 / abs(float(places[1] - places[0]))
    )


def _both(
    x: Array, y: Array, values: Array, at_x: Array, at_y: Array, tolerance: float
) -> Array:
    """Along x on every line of nodes, then along y: (p, q, components)."""
    lines = [
        rational.fit_rational_aaa(x, values[:, k], tolerance=FIT_SHARE * tolerance)(
            at_x
        )
        for k in range(len(y))
    ]
    along = np.stack(lines, axis=1)
    return np.stack(
        [
            rational.fit_rational_aaa(y, line, tolerance=FIT_SHARE * tolerance)(at_y)
            for line in along
        ]
    )
