"""How alone a pillar stands: what is missing of the neighbours that change its bias."""

from collections.abc import Iterator

import numpy as np

from metalens.ground.arrays import Array


def isolation(present: Array, pitch_um: float, range_um: float) -> Array:
    """How alone each site is: 0 where all neighbours stand, 1 where none does (y, x), float32.

    Neighbours count by exp(-r^2 / range^2) within 3 ranges; the site itself does not. Only tiles that are
    neither empty nor full with all their surroundings are worked on.

    Args:
        present: (y, x) true where a pillar stands.
    """
    from scipy.ndimage import correlate1d

    reach = max(1, int(np.ceil(3 * range_um / pitch_um)))
    weights = np.exp(-((np.arange(-reach, reach + 1) * pitch_um / range_um) ** 2)).astype(np.float32)
    total = float(weights.sum()) ** 2 - 1
    padded = np.pad(np.asarray(present, bool), reach)
    alone = np.zeros(present.shape, np.float32)
    for rows, columns in _tiles(present.shape):
        around = padded[rows.start : rows.stop + 2 * reach, columns.start : columns.stop + 2 * reach]
        here = np.asarray(present[rows, columns], np.float32)
        if around.all() or not here.any():
            continue
        near = correlate1d(around.astype(np.float32), weights, axis=0)[reach:-reach]
        near = correlate1d(near, weights, axis=1)[:, reach:-reach]
        alone[rows, columns] = np.clip(1 - (near - here) / total, 0, 1)
    return alone


def _tiles(shape: tuple[int, ...], side: int = 96) -> Iterator[tuple[slice, slice]]:
    for row in range(0, shape[0], side):
        for column in range(0, shape[1], side):
            yield slice(row, min(row + side, shape[0])), slice(column, min(column + side, shape[1]))
