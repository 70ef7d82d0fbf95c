"""From the source to the lens, off the axis or on it: in air, and through a plane plate of glass, tilted or not."""

import math

import numpy as np

from characterize.model.parameters import PLACE
from metalens.ground.arrays import Array
from metalens.ground.errors import FitError
from metalens.ground.paths import source_path

INDEX = 1.51  # of crown glass from 0.6 to 1.1 um: 1.515 to 1.506
_TOGETHER = 20_000  # numbers of an array that stays in the cache


def source_paths(x_um: Array, y_um: Array, *, depth_um: Array, tangents: tuple[float, float], values: Array) -> Array:
    """(frames, *shape) path to (x, y) on the lens from sources at ``depth_um`` (frames,), um, less that to its centre.

    Args:
        tangents: (x, y) of the chief ray of a source on the axis.
        values: all parameters, of which source_x_um, source_y_um, glass_um and the tilts of the glass are used.

    Raises:
        FitError: the plate does not fit between source and lens.
    """
    lateral = [values[PLACE[f"source_{a}_um"]] for a in "xy"]
    out = np.empty((len(depth_um), *x_um.shape))
    step = max(1, _TOGETHER // x_um.size)
    for first in range(0, len(depth_um), step):
        z = depth_um[first : first + step].reshape(-1, *(1,) * x_um.ndim)
        leaning = tangents[0] - lateral[0] / z, tangents[1] - lateral[1] / z
        out[first : first + step] = source_path(x_um, y_um, leaning, 1 / z)
    if values[PLACE["glass_um"]] != 0:
        for one, z in zip(out, depth_um.tolist(), strict=True):
            leaning = tangents[0] - lateral[0] / z, tangents[1] - lateral[1] / z
            one += extra_path(x_um, y_um, tangents=leaning, depth_um=z, values=values)
    return out


def extra_path(x_um: Array, y_um: Array, *, tangents: tuple[float, float], depth_um: float, values: Array) -> Array:
    """(*shape) path to (x, y) on the lens with the plate less that without it, um, and less that at the lens centre.

    Along the plate's normal the source lies L away, across it rho. The path is the stationary value over the
    invariant sine s (Hamilton's characteristic function; Snell's law)

        W = rho s + (L - t) sqrt(1 - s²) + t sqrt(n² - s²)

    and three of Newton's steps from the straight ray leave less than 1e-9 um.

    Args:
        tangents: (x, y) of the chief ray; the source is at (-z tx, -z ty, -z), z = ``depth_um``.
        values: all parameters, of which glass_um and its tilts are used.

    Raises:
        FitError: the plate does not fit between source and lens.
    """
    t = float(values[PLACE["glass_um"]])
    lean = [math.tan(math.radians(values[PLACE[f"glass_tilt_{a}_deg"]])) for a in "xy"]
    normal = np.array([*lean, 1.0]) / math.hypot(*lean, 1.0)

    def longer(x: Array, y: Array) -> Array:
        ray = x + depth_um * tangents[0], y + depth_um * tangents[1]
        r2 = ray[0] ** 2 + ray[1] ** 2 + depth_um**2
        along = ray[0] * normal[0] + ray[1] * normal[1] + depth_um * normal[2]
        if along.min() <= t:
            raise FitError(f"{t:.4g} um of glass between lens and source, which leave {along.min():.4g} um for it")
        across = np.sqrt(np.maximum(r2 - along**2, 0.0))
        s = across / np.sqrt(r2)
        for _ in range(3):
            outside, inside = np.sqrt(1 - s * s), np.sqrt(INDEX**2 - s * s)
            missed = across - (along - t) * s / outside - t * s / inside
            s = s + missed / ((along - t) / outside**3 + t * INDEX**2 / inside**3)
        outside, inside = np.sqrt(1 - s * s), np.sqrt(INDEX**2 - s * s)
        return np.asarray(across * s + (along - t) * outside + t * inside - np.sqrt(r2))

    return np.asarray(longer(np.asarray(x_um), np.asarray(y_um)) - longer(np.zeros(1), np.zeros(1)))
