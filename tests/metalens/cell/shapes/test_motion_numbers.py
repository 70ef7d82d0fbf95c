"""Rates of Fourier factors of outlines of several signed parts, small wave numbers, and
the stencil by powers.
"""

import math

import numpy as np
import pytest
from scipy.special import jv

from metalens.cell.shapes import EllipseArc, Outline, PolygonLoop, motion
from metalens.core.errors import CellError

CLOCKWISE = ((0.11, 0.31), (0.27, 0.05), (-0.19, -0.13))
ANTICLOCKWISE = ((0.02, 0.03), (0.09, -0.01), (0.12, 0.07), (0.05, 0.11))


def outline(shift):
    """Four parts whose numbers are moved by ``shift`` (20,)."""
    base = (
        np.array(
            [
                0.31,
                0.17,
                0.4,
                0.05,
                0.08,
                -0.9,
                *np.ravel(CLOCKWISE),
                *np.ravel(ANTICLOCKWISE),
            ]
        )
        + shift
    )
    loops = [tuple(map(tuple, part.reshape(-1, 2))) for part in (base[6:12], base[12:])]
    return Outline(
        (
            EllipseArc(*base[:3]),
            EllipseArc(*base[3:6], sign=-1),
            PolygonLoop(loops[0], sign=-1),
            PolygonLoop(loops[1]),
        )
    )


def test_numbers_of_parts_follow_one_another():
    want = [0.31, 0.17, 0.4, 0.05, 0.08, -0.9, 0.11, 0.31, 0.27, 0.05, -0.19, -0.13]
    assert motion.shape_parameters(outline(np.zeros(20)))[
        :12
    ].tolist() == pytest.approx(want, rel=1e-15)
    assert motion.shape_parameters(outline(np.zeros(20)))[
        12:
    ].tolist() == pytest.approx(np.ravel(ANTICLOCKWISE), rel=1e-15)


@pytest.mark.parametrize("number", range(20))
def test_every_number_moves_the_factor_as_its_difference(number):
    """One at a time, of wave numbers of either sign and of 0; central differences of
    1e-5: 1e-9 of the rate.
    """
    gx, gy = (
        np.array([3.1, -11.7, 0.0, 0.0, 7.3]),
        np.array([-5.9, 2.3, 4.1, 0.0, 19.0]),
    )
    rates = 1.0 * (np.arange(20) == number)
    ends = [outline(s * 1e-5 * rates).fourier(gx, gy) for s in (1, -1)]
    want = (ends[0] - ends[1]) / 2e-5
    got = motion.fourier_shape_derivative(outline(np.zeros(20)), gx, gy, rates + 0j)
    assert got == pytest.approx(want, abs=1e-8 * np.abs(want).max())


@pytest.mark.parametrize("s", [3e-4, 0.999e-3, 1.6e-3, 0.02])
def test_an_ellipse_of_small_wave_number_grows_by_its_area(s):
    """d(π a b 2 J1(s) / s) / da = π b (2 J1(s)/s - 2 J2(s) (a x)² / s²); series below
    1e-3: to s⁴/192 of it, 5e-15.
    """
    a, b, x = 0.31, 0.17, s / 0.31
    part = Outline((EllipseArc(a, b),))
    got = [
        motion.fourier_shape_derivative(
            part, np.array([x]), np.array([0.0]), np.eye(3)[k]
        )[0].real
        for k in (0, 1)
    ]
    value, slope = 2 * jv(1, s) / s, 2 * jv(2, s)
    assert got[0] == pytest.approx(np.pi * b * (value - slope), rel=3e-14, abs=0.0)
    assert got[1] == pytest.approx(np.pi * a * value, rel=3e-14, abs=0.0)


@pytest.mark.parametrize(
    ("h", "off"),
    [(0.003, 2e-15), (0.031, 2e-15), (0.0499, 5e-15), (0.09, 2e-13), (0.7, 5e-15)],
)
def test_spherical_bessel_functions_of_small_arguments_keep_their_digits(h, off):
    """Σ (-1)ᵏ (2k + 2) x^(2k+1) / (2k+3)!. The series leaves x⁷/45360 of x/3 below
    0.05, 1e-12; above, cancellation
    costs 3 ε / x²."""
    want = math.fsum(
        (-1) ** k * (2 * k + 2) * h ** (2 * k + 1) / math.factorial(2 * k + 3)
        for k in range(12)
    )
    for sign in (1, -1):
        assert motion._j1(np.array([sign * h]))[0] == pytest.approx(
            sign * want, rel=off + h**6 / 15120 * (h < 0.05), abs=0
        )


def test_differences_are_exact_for_powers_up_to_the_sixth():
    """And of x⁷ leave 36 h⁶ (45·1 - 9·128 + 2187 = 1080, of 30): the weights are
    Taylor's.
    """
    powers = np.arange(8)

    def of(x):
        return x**powers * np.array([5.0, 1.7, 3.0, -2.0, 1.3, 0.7, 0.2, 1.0])

    step = 0.3
    got = motion.sixth_order_difference(of, step)
    assert got[:7] == pytest.approx([0, 1.7, 0, 0, 0, 0, 0], abs=1e-14)
    assert got[7] == pytest.approx(36 * step**6, rel=1e-12)


def test_a_change_of_length_on_one_side_alone_is_refused():
    for side in (1, -1):
        with pytest.raises(CellError, match="no derivative"):
            motion.sixth_order_difference(
                lambda x, side=side: np.ones(3 if x * side > 2.5e-3 else 2), 1e-3
            )


def test_corners_that_go_out_from_the_origin_grow_a_polygon_by_twice_its_area():
    """Of triangles either way round, wherever they lie; one that is cut out takes as
    much away.
    """
    for corners in np.random.default_rng(6).normal(size=(24, 3, 2)):
        area = abs(np.linalg.det(corners[1:] - corners[0])) / 2
        for sign in (1, -1):
            part = Outline((PolygonLoop(tuple(map(tuple, corners)), sign=sign),))
            got = motion.fourier_shape_derivative(
                part, np.zeros(1), np.zeros(1), corners.ravel()
            )
            assert got[0] == pytest.approx(sign * 2 * area, rel=1e-9)
