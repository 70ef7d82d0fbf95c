"""Irradiance on the lens plane by a point source off the axis: solid angle of a small
square, by its corners.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.psf.record import PsfStack


def solid_angle(x, y, z, side):
    """Of a square of ``side`` in the plane z = 0 about (x, y), from (0, 0, z): Σ ±
    atan(x y / (z r)) of its corners.
    """
    ends = [
        (x + a * side / 2, y + b * side / 2, a * b) for a in (-1, 1) for b in (-1, 1)
    ]
    return sum(
        sign * math.atan2(u * v, z * math.sqrt(u * u + v * v + z * z))
        for u, v, sign in ends
    )


def test_irradiance_is_the_solid_angle_of_a_square_micrometre():
    angles, depths = (
        np.array([[0.0, 0.0], [0.23, -0.41], [-0.6, 0.1]]),
        np.array([310.0, 1250.0]),
    )
    found = PsfStack.irradiance_per_um2.fget(
        SimpleNamespace(angles_rad=angles, depths_um=depths)
    )
    for row, (ax, ay) in zip(found, angles, strict=True):
        for value, z in zip(row, depths, strict=True):
            want = solid_angle(z * math.tan(ax), z * math.tan(ay), z, 1.0)
            assert value == pytest.approx(
                want, rel=1e-4
            )  # of a square that is seen under 3 mrad; rounding 1e-8
