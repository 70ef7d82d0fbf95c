"""The kernel from a pillar to a window sample, and what is left of it beside a plane wave.

K = d/(2πr²)(1/r - ik) exp(ik(r - r_w)) exp(ik(s_z - s_ref)), its carrier removed: r_w is the path to the middle of the
window, s_ref that from the source of the middle depth. It is smooth in everything. Through films the paths and the
amplitude are those of :mod:`metalens.propagate.paths`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from metalens.ground.arrays import Array
from metalens.propagate.geometry import Case
from metalens.propagate.paths import beyond, cosines, from_source, reference_depth, residual


def probe() -> Array:
    """Positions along an axis at which a smooth function is looked at."""
    return np.array([-1.0, 0.0, 1.0])


def kernel(case: Case, x: Any, y: Any, X: Any, Y: Any, inverse: Any) -> Array:
    """K of the module's heading, without the pillar's area, at lens (x, y) and window offset (X, Y)."""
    level, away = beyond(case, x, y, X, Y)
    path = away + from_source(case, x, y, case.tangents, inverse)
    path = path - from_source(case, x, y, case.tangents, reference_depth(case))
    return np.asarray(level * np.exp(1j * case.wavenumber * path))


def direction_range(case: Case, rows_um: Array) -> tuple[float, float]:
    """(least, largest) p = n sin θ cos φ over the lens, for the row nodes given; never of zero width."""
    high_x = case.half_size_um[1]
    edge = np.array([-high_x, high_x]) - case.centre_um[0]
    far = np.concatenate([rows_um, [0.0]]) - case.centre_um[1]
    p = cosines(case, edge, np.array([[np.abs(far).min()], [np.abs(far).max()]]))
    low, high = float(p.min()), float(p.max())
    spare = max(1e-9, 1e-6 * (high - low))
    most = 1.0 if case.behind is None else case.behind.layers[0][0]
    return max(low - spare, -most + 1e-15), min(high + spare, most - 1e-15)


def correction(case: Case, p: Any, e: Any, X: Any, Y: Any) -> Array:
    """Kernel less the plane waves exp(-ik(pX + qY)): d/(2πr²)(1/r - ik) exp(ik(r - r_w + pX + qY))."""
    level, path = residual(case, p, e, X, Y)
    return np.asarray(level * np.exp(1j * case.wavenumber * path))


def over_blocks(case: Case) -> Callable[[Any, Any], Array]:
    """The kernel at (y, x) of the lens for the corners and the middle of the window and the extreme depths."""
    wy, wx = case.half_window_um
    inverse = np.array([min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)])
    X, Y, v = (g.reshape(-1, 1, 1, 1) for g in np.meshgrid(probe() * wx, probe() * wy, inverse, indexing="ij"))
    return lambda y, x: kernel(case, x, y, X, Y, v)
