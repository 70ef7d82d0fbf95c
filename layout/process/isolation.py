"""How alone a pillar stands: what is missing of the neighbours that change its bias."""

from collections.abc import Callable

import numpy as np

from metalens.core.arrays import Array
from metalens.core.errors import ProcessError

_LEAST = (
    4e-4  # weight of all neighbours together: float32 sums have it to a few percent
)

_ROUNDING = 1e-5  # of float32 sums over all neighbours


def isolation_map(
    present: Array,
    steps_um: tuple[float, float],
    range_um: float,
    *,
    centred: bool = False,
) -> Array:
    """(y, x) isolation of each site, float32: 0 with all neighbours, 1 with none.

    isolation = 1 - sum of exp(-r^2 / range^2) over the pillars, over the same sum with
    all sites filled. Neighbours count within 3 ranges along each axis, the site itself
    does not.

    Args:
        present: (y, x) true where a pillar stands.
        steps_um: (x, y) distance of neighbouring columns and rows.
        range_um: of the bias of isolated pillars.
        centred: every other place alone is a site, as on a hexagonal lattice
            (:class:`metalens.lens.DiameterMap`): those with row + column odd are empty,
            or those with it even.

    Raises:
        ProcessError: a range so short that no site has neighbours.
    """
    from scipy.ndimage import correlate1d

    along_x, along_y = (
        np.exp(-((np.arange(-n, n + 1) * step / range_um) ** 2)).astype(np.float32)
        for n, step in ((isolation_halo(step, range_um), step) for step in steps_um)
    )
    weights = np.outer(along_y, along_x)
    if centred:  # a neighbour is an even number of rows and columns away
        away = np.add.outer(*(np.arange(n) - n // 2 for n in weights.shape))
        weights = weights[away % 2 == 0]
    total = float(weights.sum(dtype=float)) - 1
    if total < _LEAST:
        raise ProcessError(
            f"bias.range_um = {range_um:g}: neighbours on steps of {steps_um[0]:.4g} and {steps_um[1]:.4g} um do not "
            "count at that distance; need a third of the pitch or more, or isolated_nm = 0"
        )
    own = np.asarray(present, np.float32)
    weight = correlate1d(own, along_y, axis=0, mode="constant")
    weight = correlate1d(weight, along_x, axis=1, mode="constant")
    isolation = np.clip(1 - (weight - own) / total, 0, 1)
    return np.where(isolation > _ROUNDING, isolation, np.float32(0))


def isolation_rows(
    present: Callable[[int, int], Array],
    first: int,
    end: int,
    steps_um: tuple[float, float],
    range_um: float,
    *,
    centred: bool = False,
) -> Array:
    """:func:`isolation_map` of some rows of a lens that is read by rows.

    Args:
        present: of a first and an end row: (rows, x) true where a pillar stands; an end
            beyond the last row counts as the last.
        first: row.
        end: row after the last.
        steps_um: (x, y) distance of neighbouring columns and rows.
        range_um: of the bias of isolated pillars.
        centred: as of :func:`isolation_map`.
    """
    halo = isolation_halo(steps_um[1], range_um)
    low = max(0, first - halo)
    around = present(low, end + halo)
    isolation = isolation_map(around, steps_um, range_um, centred=centred)
    return isolation[first - low : end - low]


def isolation_halo(step_um: float, range_um: float) -> int:
    """Rows (or columns) of this distance whose pillars bear on a pillar.

    Args:
        step_um: from row to row.
        range_um: of the bias of isolated pillars.
    """
    return max(1, int(np.ceil(3 * range_um / step_um)))
