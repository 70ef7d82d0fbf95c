"""The kernel from a pillar to a window sample, and what is left of it beside a plane wave.

K = d/(2πr²)(1/r - ik) exp(ik(r - r_w)) exp(ik(s_z - s_ref)), its carrier removed: r_w is the path to the middle of the
window, s_ref that from the source of the middle depth. It is smooth in everything.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from metalens.ground.arrays import Array
from metalens.ground.paths import longer, source_path
from metalens.propagate.geometry import Case


def reference_depth(case: Case) -> float:
    """Inverse depth, 1/um, of the source whose phase is taken off: the middle of the range."""
    inverse = case.inverse_depths_per_um
    return (min(inverse) + max(inverse)) / 2


def probe() -> Array:
    return np.array([-1.0, 0.0, 1.0])


def kernel(case: Case, x: Any, y: Any, X: Any, Y: Any, inverse: Any) -> Array:
    """K of the module's heading, without the pillar's area, at lens (x, y) and window offset (X, Y)."""
    k, d = case.wavenumber, case.sensor_distance_um
    dx, dy = case.centre_um[0] - x, case.centre_um[1] - y
    r_w = np.sqrt(dx * dx + dy * dy + d * d)
    away = longer(r_w, X * X + Y * Y + 2 * (X * dx + Y * dy))
    r = r_w + away
    path = away + source_path(x, y, case.tangents, inverse)
    path = path - source_path(x, y, case.tangents, reference_depth(case))
    return np.asarray(d / (2 * np.pi * r * r) * (1 / r - 1j * k) * np.exp(1j * k * path))


def direction_range(case: Case, rows_um: Array) -> tuple[float, float]:
    """(least, largest) direction cosine p over the lens, for the row nodes given; never of zero width."""
    high_x = case.half_size_um[1]
    edge = np.array([-high_x, high_x]) - case.centre_um[0]
    far = np.concatenate([rows_um, [0.0]]) - case.centre_um[1]
    near = np.abs(far).min()
    p = edge / np.sqrt(edge**2 + np.array([[near**2], [np.abs(far).max() ** 2]]) + case.sensor_distance_um**2)
    low, high = float(p.min()), float(p.max())
    spare = max(1e-9, 1e-6 * (high - low))
    return max(low - spare, -1 + 1e-15), min(high + spare, 1 - 1e-15)


def cosine_y(case: Case, p: Any, e: Any) -> Any:
    """Direction cosine q along y of the ray from lens row e with cosine p to the window centre."""
    far = e - case.centre_um[1]
    return far * np.sqrt(1 - p * p) / np.sqrt(far * far + case.sensor_distance_um**2)


def correction(case: Case, p: Any, e: Any, X: Any, Y: Any) -> Array:
    """Kernel less the plane waves exp(-ik(pX + qY)): d/(2πr²)(1/r - ik) exp(ik(r - r_w + pX + qY))."""
    k, d = case.wavenumber, case.sensor_distance_um
    r, path = _residual(case, p, e, X, Y)
    return np.asarray(d / (2 * np.pi * r * r) * (1 / r - 1j * k) * np.exp(1j * k * path))


def _residual(case: Case, p: Any, e: Any, X: Any, Y: Any) -> tuple[Any, Any]:
    """(r, r - r_w + pX + qY) without cancellation."""
    far = e - case.centre_um[1]
    r_w = np.sqrt((far * far + case.sensor_distance_um**2) / (1 - p * p))
    g = p * X + cosine_y(case, p, e) * Y
    q = X * X + Y * Y - 2 * r_w * g
    r = np.sqrt(r_w * r_w + q)
    return r, (X * X + Y * Y + g * q / (r + r_w)) / (r + r_w)


def slopes(case: Case, p: Any, e: Any, X: Any, Y: Any) -> Array:
    """(3, …) logarithmic derivatives of the kernel in sensor distance, window centre x and y, at fixed pillar."""
    k, d = case.wavenumber, case.sensor_distance_um
    r, _ = _residual(case, p, e, X, Y)
    far = e - case.centre_um[1]
    r_w = np.sqrt((far * far + d * d) / (1 - p * p))
    radial = 1j * k - 2 / r - 1 / (r * r) / (1 / r - 1j * k)
    along = np.stack(np.broadcast_arrays(d / r, (X - r_w * p) / r, (Y - far) / r))
    out = np.asarray(radial * along)
    out[0] += 1 / d
    return out


def over_blocks(case: Case) -> Callable[[Any, Any], Array]:
    """The kernel at (y, x) of the lens for the corners and the middle of the window and the extreme depths."""
    wy, wx = case.half_window_um
    inverse = np.array([min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)])
    X, Y, v = (g.reshape(-1, 1, 1, 1) for g in np.meshgrid(probe() * wx, probe() * wy, inverse, indexing="ij"))
    return lambda y, x: kernel(case, x, y, X, Y, v)
