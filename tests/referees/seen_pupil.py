"""Where the pupil of an eye that looks along a direction is seen on the sensor: similar
triangles.
"""

import torch


def pupil_of(direction, slip_mm, geometry):
    """(batch, 2) mm: the pupil, a radius from the middle of the eye, through a lens
    that slipped, on the sensor.
    """
    point = (
        torch.tensor(geometry.centre_mm, dtype=direction.dtype)
        - slip_mm
        + geometry.radius_mm * direction
    )
    return point[..., :2] / point[..., 2:] * geometry.sensor_distance_mm
