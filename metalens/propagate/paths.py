"""Paths and amplitudes of a case: closed forms in one medium, rays through
plane-parallel films where there are some.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from metalens.core.arrays import Array
from metalens.optics import Media, media, saddle_correction
from metalens.optics.paths import sensor_path
from metalens.propagate.geometry import PropagationCase

SOME = 32  # pillars along an axis whose rays tell what films leave out


def reference_depth(case: PropagationCase) -> float:
    """Inverse depth, 1/um, of the source whose phase is removed: the middle of the
    range.

    Args:
        case: geometry of the propagation.
    """
    inverse = case.inverse_depths_per_um
    return (min(inverse) + max(inverse)) / 2


def from_source(
    case: PropagationCase, x: Any, y: Any, tangents: Any, inverse: Any
) -> Any:
    """Optical path from a source to (x, y), less its path to the lens centre, um; numpy
    or torch operands.

    Args:
        case: geometry of the propagation.
        x, y: places on the lens, um.
        tangents: (x, y) of the field angle, in air.
        inverse: 1 / depth of the source, 1/um.
    """
    return media.source_path(case.front, x, y, tangents, inverse)


def to_sensor(
    case: PropagationCase, x: Any, y: Any, centre: tuple[float, float] | None = None
) -> Any:
    """Optical path from (x, y) on the lens to a point of the sensor, by default the
    middle of the window, less that from the lens centre, um.

    Args:
        case: geometry of the propagation.
        x, y: places on the lens, um.
        centre: (x, y) of the point, um.
    """
    cx, cy = case.centre_um if centre is None else centre
    if case.behind is None:
        return sensor_path(x, y, (cx, cy), case.sensor_distance_um)
    reach2 = cx * cx + cy * cy
    pairs = case.media.layers
    more = x * x + y * y - 2 * (x * cx + y * cy)
    return media.path_difference(
        pairs, media.solve_direction_square(pairs, reach2), reach2, more
    )[1]


def chief_path(case: PropagationCase) -> float:
    """Optical path from the lens centre to the window centre, um: the phase that all
    methods share.

    Args:
        case: geometry of the propagation.
    """
    reach2 = case.centre_um[0] ** 2 + case.centre_um[1] ** 2
    pairs = case.media.layers
    return float(media.whole_path(pairs, media.solve_direction_square(pairs, reach2)))


def ray_to_offset(
    case: PropagationCase, x: Any, y: Any, X: Any, Y: Any
) -> tuple[Any, Any]:
    """(amplitude, path) from lens (x, y) to the window offset (X, Y); the path less
    that to the window's centre.

    Args:
        case: geometry of the propagation.
        x, y: places on the lens, um. X, Y: offsets from the window's centre, um.
    """
    dx, dy = case.centre_um[0] - x, case.centre_um[1] - y
    change = X * X + Y * Y + 2 * (X * dx + Y * dy)
    behind, reach2 = case.media, dx * dx + dy * dy
    w0 = media.solve_direction_square(behind.layers, reach2)
    w, difference = media.path_difference(behind.layers, w0, reach2, change)
    return ray_amplitude(behind, case.wavenumber, w, case.reach_um), difference


def ray_amplitude(behind: Media, wavenumber: float, w: Any, reach_um: float) -> Any:
    """Stationary-phase amplitude of the ray of w = p², without its phase kL.

        -i k/(2π) √(T / spread) (1 + iC/(kL))

    with T the transmitted power, spread the area on the sensor per area of p, L the
    optical path, and C the saddle-point correction. In one medium it is
    d/(2πr²) (1/r - ik).

    Args:
        behind: media from lens to sensor. wavenumber: in vacuum, rad/um.
        w: squared p of the rays. reach_um: largest lateral distance of any ray.
    """
    layers = behind.layers
    passed = media.passed_at(behind.order, w)
    spread = media.area_spreading(layers, w)
    real, imaginary = saddle_correction(behind, wavenumber, reach_um).at(w)
    correction = (real + 1j * imaginary) / (wavenumber * media.whole_path(layers, w))
    magnitude = wavenumber / (2 * np.pi) * (passed / spread) ** 0.5
    return -1j * magnitude * (1 + 1j * correction)


def films_error(case: PropagationCase, level: Array) -> float:
    """Relative L2 error of PSFs by the kernel through films; 0 in one medium.

    Twice the root-mean-square error of the amplitude over some pillars, weighted by
    their light, each for the sample of the window farthest from it.

    Args:
        case: geometry of the propagation.
        level: (y, x) transmission.
    """
    if case.behind is None:
        return 0.0
    rows, columns = (slice(None, None, max(1, n // SOME)) for n in case.shape)
    light = np.maximum(np.asarray(level[rows, columns], float) ** 2, 1e-300)
    (y, x), (half_y, half_x) = case.pillars_um, case.half_window_um
    far_x = np.abs(case.centre_um[0] - x[columns]) + half_x
    far_y = np.abs(case.centre_um[1] - y[rows]) + half_y
    w = media.solve_direction_square(case.behind.layers, far_x**2 + far_y[:, None] ** 2)
    error = saddle_correction(case.behind, case.wavenumber, case.reach_um).error(w)
    return 2 * float(np.sqrt((light * error**2).sum() / light.sum()))


def ray_cosines(case: PropagationCase, across: Any, far: Any) -> Any:
    """Direction cosine p along x of rays from lens points to the window centre.

    p = across / (reach per direction), for the ray of this reach through the media.

    Args:
        case: geometry of the propagation.
        across, far: offset along x, and along the other axis, um.
    """
    pairs = case.media.layers
    return across / media.reach_per_direction(
        pairs, media.solve_direction_square(pairs, across * across + far * far)
    )


def rayleigh_sommerfeld_kernel(
    case: PropagationCase, x: Any, y: Any, X: Any, Y: Any, inverse: Any
) -> Array:
    """Field at a window offset (X, Y) of a pillar of unit area at lens (x, y).

    d/(2πr²) (1/r - ik) exp(ik path): the path from source to pillar less that from the
    reference depth, plus that from pillar to offset less that to the window's centre.

    Args:
        case: geometry of the propagation.
        x, y: lens positions, um. X, Y: offsets from the window's centre, um.
        inverse: 1 / depth of the source, 1/um.
    """
    level, sensor_path = ray_to_offset(case, x, y, X, Y)
    path = sensor_path + from_source(case, x, y, case.tangents, inverse)
    path = path - from_source(case, x, y, case.tangents, reference_depth(case))
    return np.asarray(level * np.exp(1j * case.wavenumber * path))


def over_blocks(case: PropagationCase) -> Callable[[Any, Any], Array]:
    """The kernel at (y, x) of the lens for the corners and the middle of the window and
    the extreme depths.

    Args:
        case: geometry of the propagation.
    """
    wy, wx = case.half_window_um
    inverse = np.array(
        [min(case.inverse_depths_per_um), max(case.inverse_depths_per_um)]
    )
    ends = np.array([-1.0, 0.0, 1.0])
    X, Y, inverse_grid = (
        grid.reshape(-1, 1, 1, 1)
        for grid in np.meshgrid(ends * wx, ends * wy, inverse, indexing="ij")
    )
    return lambda y, x: rayleigh_sommerfeld_kernel(case, x, y, X, Y, inverse_grid)
