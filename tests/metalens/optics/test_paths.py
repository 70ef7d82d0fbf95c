"""Path differences: against the plain difference of square roots in 60 digits, for
every kind of operand.
"""

import math
from decimal import Decimal, getcontext

import numpy as np
import pytest
import torch

from metalens.optics import paths

getcontext().prec = 60
# um: a pillar beside the axis, and one that is not; a mask's reach in between
X, Y = (3.7e-4, -217.3)
PLACES = [(X, Y), (311.9, 5e-7), (-0.42, 0.17)]


def away(x, y, z):
    return (Decimal(x) ** 2 + Decimal(y) ** 2 + Decimal(z) ** 2).sqrt()


@pytest.mark.parametrize("z", [0.3, 1983.0, 2.6e4, 1e9])
@pytest.mark.parametrize(("x", "y"), PLACES)
def test_every_difference_keeps_its_digits(x, y, z):
    """Four operations of 1e-16 each on the quotient; the numerator of a tilted path may
    cancel, so it is not small.
    """
    tx, ty = 0.31, -0.17
    lens = Decimal(x) ** 2 + Decimal(y) ** 2
    axial = lens / ((lens + Decimal(z) ** 2).sqrt() + Decimal(z))
    assert paths.axial_path_difference(x * x + y * y, z) == pytest.approx(
        float(axial), rel=1e-15
    )
    plain = away(x + 0.0, y, z) - Decimal(z)  # 60 digits survive the subtraction
    assert float(axial) == pytest.approx(float(plain), rel=1e-15)
    centre = z * tx, z * ty
    to_sensor = (
        (Decimal(x) - Decimal(centre[0])) ** 2
        + (Decimal(y) - Decimal(centre[1])) ** 2
        + Decimal(z) ** 2
    ).sqrt() - away(*centre, z)
    scale = math.hypot(x, y)
    assert paths.sensor_path(x, y, centre, z) == pytest.approx(
        float(to_sensor), abs=2e-15 * scale
    )
    from_source = (
        (Decimal(x) + Decimal(z) * Decimal(tx)) ** 2
        + (Decimal(y) + Decimal(z) * Decimal(ty)) ** 2
        + Decimal(z) ** 2
    ).sqrt() - Decimal(z) * (1 + Decimal(tx) ** 2 + Decimal(ty) ** 2).sqrt()
    assert paths.source_path(x, y, (tx, ty), 1 / z) == pytest.approx(
        float(from_source), abs=2e-15 * scale
    )


def test_a_far_source_is_a_plane_wave_and_its_rays_lean_with_the_tangents():
    tx, ty = 0.4, -0.3
    s = math.sqrt(1 + tx * tx + ty * ty)
    assert paths.source_path(2.5, 1.5, (tx, ty), 0.0) == pytest.approx(
        (2.5 * tx + 1.5 * ty) / s, rel=1e-15
    )
    assert paths.axial_path_difference(np.array([4.0, 9.0]), math.inf).tolist() == [
        0.0,
        0.0,
    ]


def test_gradients_are_those_of_a_difference():
    place = torch.tensor(
        [211.0, -97.0, 0.21, -0.13, 4e-5], dtype=torch.float64, requires_grad=True
    )
    assert torch.autograd.gradcheck(
        lambda p: paths.source_path(p[0], p[1], (p[2], p[3]), p[4]), place
    )
    assert torch.autograd.gradcheck(
        lambda p: paths.sensor_path(p[0], p[1], (1e3 * p[2], 1e3 * p[3]), 9e6 * p[4]),
        place,
    )
