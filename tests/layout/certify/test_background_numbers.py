"""Pixels of wide Gaussians by hand: where they lie, the weights of a spline, a blur as
two sums.
"""

import math

import numpy as np
import pytest

from layout.certify import background
from layout.certify.background import Raster

RANGE = 2.0  # um: four pixels of 0.5


def test_a_raster_holds_its_box_and_two_pixels_around():
    """11 um are 22 pixels, 2.2 um are 4 and a part."""
    made = Raster.over((-3.1, 2.2, 7.9, 4.4), RANGE)
    assert (made.rows, made.columns, made.range_um, made.pixel_um) == (9, 27, 2.0, 0.5)
    assert (made.left_um, made.bottom_um) == pytest.approx((-4.1, 1.2), rel=1e-15)
    assert made.halo_um == pytest.approx(9.5, rel=1e-15)  # four ranges and three pixels
    assert made.left_um + 0.5 * (made.columns - 1) >= 7.9 + 0.5
    assert made.bottom_um + 0.5 * (made.rows - 1) >= 4.4 + 0.5


@pytest.mark.parametrize(
    ("low", "high", "first", "end"),
    [
        (
            10.0,
            12.0,
            39,
            86,
        ),  # (10 - 9.5 + 20) / 0.5 = 41, less 2; (12 + 9.5 + 20) / 0.5 = 83, and 3
        (10.2, 12.2, 39, 86),
        (-19.0, 12.0, 0, 86),
        (10.0, 29.0, 39, 100),
        (-90.0, -80.0, 0, 3),
    ],
)
def test_rows_between_two_heights_hold_the_reach_of_the_kernel(low, high, first, end):
    some = Raster(RANGE, -7.0, -20.0, 100, 31).between(low, high)
    assert (some.rows, some.columns, some.left_um, some.range_um) == (
        end - first,
        31,
        -7.0,
        RANGE,
    )
    assert some.bottom_um == pytest.approx(-20 + 0.5 * first, rel=1e-15)


def spline(off):
    """Quadratic: on the pixels one before, at and after, for a place ``off`` pixels
    after a middle.
    """
    return np.array([(1 - 2 * off) ** 2 / 8, 3 / 4 - off**2, (1 + 2 * off) ** 2 / 8])


@pytest.mark.parametrize(
    ("u", "v"),
    [(5.0, 3.0), (4.75, 3.4), (5.4, 2.5), (1.0, 1.0), (7.0, 5.0), (7.4, 5.4)],
)
def test_a_mass_goes_to_nine_pixels_by_two_splines(u, v):
    """Places in pixels, of 7 rows and 9 columns; a half goes on to the next one."""
    raster, image = Raster(RANGE, -4.1, 1.2, 7, 9), np.zeros((7, 9))
    raster.put(
        np.array([-4.1 + 0.5 * u]), np.array([1.2 + 0.5 * v]), np.array([3.7]), image
    )
    want = np.zeros((7, 9))
    i, j = math.floor(u + 0.5 + 1e-9), math.floor(v + 0.5 + 1e-9)
    want[j - 1 : j + 2, i - 1 : i + 2] = 3.7 * np.outer(spline(v - j), spline(u - i))
    assert image == pytest.approx(want, abs=1e-12)


@pytest.mark.parametrize(("u", "v"), [(0.4, 3.0), (7.6, 3.0), (5.0, 0.4), (5.0, 5.6)])
def test_a_mass_off_the_raster_is_passed_over(u, v):
    raster, image = Raster(RANGE, -4.1, 1.2, 7, 9), np.zeros((7, 9))
    raster.put(
        np.array([-4.1 + 0.5 * u]), np.array([1.2 + 0.5 * v]), np.array([3.7]), image
    )
    assert not image.any()


def test_one_pixel_becomes_a_gaussian_that_is_a_squared_pixel_narrower():
    """16 - 1 squared pixels of 0.5 um, cut 16 pixels away, of unit mass to what is cut
    off: erfc(16 / sqrt(15)).
    """
    raster, image = Raster(RANGE, 0.0, 0.0, 41, 47), np.zeros((41, 47))
    image[18, 22] = 2.5
    got = raster.blurred(image)
    y, x = np.mgrid[-18:23, -22:25]
    want = 2.5 * np.exp(-(x**2 + y**2) / 15) / (math.pi * 15 * 0.25)
    want[(np.abs(x) > 16) | (np.abs(y) > 16)] = 0
    assert got == pytest.approx(want, rel=1e-12)
    assert got.sum() * 0.25 == pytest.approx(2.5, rel=1e-7)


@pytest.mark.parametrize("taps", [3, 5, 7, 9])
@pytest.mark.parametrize(("first", "end"), [(0, 11), (0, 4), (3, 8), (9, 11)])
def test_a_blur_is_a_sum_along_rows_and_one_across_them(taps, first, end):
    """A kernel without symmetry, as two matrices; zero outside."""
    rng = np.random.default_rng(taps)
    image, kernel = rng.uniform(-1, 1, (11, 8)), rng.uniform(0.1, 1, taps)
    out = np.full((11, 8), 7.0)
    background._blur(image, kernel, out, first, end)
    reach = taps // 2

    def matrix(n):
        return np.array(
            [
                [
                    kernel[b - a + reach] if abs(b - a) <= reach else 0.0
                    for b in range(n)
                ]
                for a in range(n)
            ]
        )

    want = np.full((11, 8), 7.0)
    want[first:end] = (matrix(11) @ image @ matrix(8).T)[first:end]
    assert out == pytest.approx(want, abs=1e-12)


def test_a_mass_on_and_off_the_pixels_exposes_as_its_gaussian_does():
    """Both splines widen by what the kernel lacks: exp(-r² / 4) / (4 pi), to 1e-3
    within a range and a half.
    """
    raster = Raster.over((-9.0, -8.0, 9.0, 8.0), RANGE)
    image = np.zeros((raster.rows, raster.columns))
    raster.put(np.array([0.37]), np.array([-0.81]), np.array([1.9]), image)
    x, y = np.array([0.37, 1.6, -1.2]), np.array([-0.81, 0.3, -2.9])
    want = 1.9 * np.exp(-((x - 0.37) ** 2 + (y + 0.81) ** 2) / 4) / (4 * math.pi)
    assert raster.take(x, y, raster.blurred(image)) == pytest.approx(
        want, rel=1e-3
    )  # (pixel / range)^4, some times 0.004
