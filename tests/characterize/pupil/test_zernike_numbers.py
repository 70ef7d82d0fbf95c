"""Orders, names and values of Zernike polynomials at single places, and at the rim
where all radial parts are one.
"""

import math

import numpy as np
import pytest

from characterize.pupil import zernike


def test_orders_run_from_low_to_high_and_sines_before_cosines():
    assert zernike.zernike_indices(2, 4) == [
        (2, -2), (2, 0), (2, 2),
        (3, -3), (3, -1), (3, 1), (3, 3),
        (4, -4), (4, -2), (4, 0), (4, 2), (4, 4),
    ]  # fmt: skip
    assert zernike.zernike_indices(0, 1) == [(0, 0), (1, -1), (1, 1)]
    assert zernike.zernike_indices(3, 2) == []


def test_names_are_those_of_the_aberrations():
    assert {zernike.zernike_name(index) for index in zernike.zernike_indices(2, 4)} == {
        "oblique astigmatism", "defocus", "astigmatism", "oblique trefoil", "coma y", "coma x", "trefoil", "spherical",
        "Z(4, -4)", "Z(4, -2)", "Z(4, 2)", "Z(4, 4)",
    }  # fmt: skip
    named = {
        (2, -2): "oblique astigmatism",
        (2, 0): "defocus",
        (2, 2): "astigmatism",
        (3, -3): "oblique trefoil",
    }
    named |= {
        (3, -1): "coma y",
        (3, 1): "coma x",
        (3, 3): "trefoil",
        (4, 0): "spherical",
        (5, -3): "Z(5, -3)",
    }
    assert {index: zernike.zernike_name(index) for index in named} == named


@pytest.mark.parametrize("index", zernike.zernike_indices(0, 7))
def test_at_the_rim_a_polynomial_is_its_wave_at_its_full_size(index):
    n, m = index
    theta = np.array([0.3, 1.9, -2.4])
    wave = np.sin(-m * theta) if m < 0 else np.cos(m * theta)
    want = math.sqrt(n + 1) * (math.sqrt(2) if m else 1.0) * wave
    assert zernike.zernike_polynomial(index, np.ones(3), theta) == pytest.approx(
        want, abs=1e-10
    )  # of terms of 1e3


def test_radial_parts_of_high_orders_by_hand():
    """R of (5, 1), (6, 2) and (6, 0) at 0.7: 10 r⁵ - 12 r³ + 3 r and so on."""
    r, theta = 0.7, 0.4
    want = {
        (5, 1): math.sqrt(12) * (10 * r**5 - 12 * r**3 + 3 * r) * math.cos(theta),
        (6, -2): math.sqrt(14)
        * (15 * r**6 - 20 * r**4 + 6 * r**2)
        * math.sin(2 * theta),
        (6, 0): math.sqrt(7) * (20 * r**6 - 30 * r**4 + 12 * r**2 - 1),
    }
    for index, value in want.items():
        assert zernike.zernike_polynomial(
            index, np.array([r]), np.array([theta])
        ) == pytest.approx([value], rel=1e-12)


def test_coordinates_count_from_x_towards_y():
    x, y = np.array([[0.3, -0.2]]), np.array([[0.1, 0.6]])
    found = zernike.zernike_basis([(1, 1), (1, -1), (2, -2)], x, y)
    assert found.shape == (3, 1, 2)
    assert found == pytest.approx(
        np.stack([2 * x, 2 * y, math.sqrt(6) * 2 * x * y]), rel=1e-12
    )
    assert zernike.zernike_basis([], x, y).shape == (0, 1, 2)
