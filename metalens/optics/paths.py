"""Differences of optical paths, without cancellation, of numpy, torch and plain numbers."""

import math
from typing import Any


def hypot_minus_length(length: Any, more: Any) -> Any:
    """sqrt(length² + more) - length, for a length of 0 or more; operands broadcast.

    Accuracy: three roundings of the type that came in.
    """
    return more / ((length * length + more) ** 0.5 + length)


def axial_path_difference(radius2_um2: Any, distance_um: Any) -> Any:
    """Extra path from an axial point out to radius r, sqrt(r² + z²) - z, from r² (paper
    Eq. 1).

    Args:
        radius2_um2: (*shape) squared distance from the axis.
        distance_um: axial distance, above 0; inf gives 0.

    >>> axial_path_difference(9.0, 4.0)
    1.0
    """
    return (
        radius2_um2 * 0.0
        if math.isinf(distance_um)
        else hypot_minus_length(distance_um, radius2_um2)
    )


def source_path(x: Any, y: Any, tangents: Any, inverse_depth: Any) -> Any:
    """Path from a point source to (x, y), less its path to the lens centre, um; exact
    for a source at infinity.

    r - r0 = (ρ²/z + 2(x·tx + y·ty)) / (√(ρ²/z² + 2(x·tx + y·ty)/z + s²) + s) with s² =
    1 + tx² + ty², the source at
    (-z·tx, -z·ty, -z). Operands broadcast; no division by the depth.

    Args:
        tangents: (x, y) of the field angle, in air.
        inverse_depth: 1 / depth, 1/um.
    """
    tx, ty = tangents
    s = (1 + tx * tx + ty * ty) ** 0.5
    tilt = 2 * (x * tx + y * ty)
    numerator = (x * x + y * y) * inverse_depth + tilt
    return numerator / ((numerator * inverse_depth + s * s) ** 0.5 + s)


def sensor_path(x: Any, y: Any, centre: Any, distance: Any) -> Any:
    """Path from a pillar at (x, y) to a point of the sensor, less the path from the
    lens centre, um.

    Args:
        distance: from lens to sensor, um.
    """
    cx, cy = centre
    r0 = (cx * cx + cy * cy + distance * distance) ** 0.5
    return hypot_minus_length(r0, x * x + y * y - 2 * (x * cx + y * cy))
