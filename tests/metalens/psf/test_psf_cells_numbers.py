"""Nyquist's step of windows by the sines of their outermost rays, and how many points a
cell has, by hand.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from metalens.core.errors import PropagationError
from metalens.propagate import PropagationCase
from metalens.psf import cells

# 4.4 um to either side along x, 2.96 um along y; the window's middle lies at (14.0,
# -8.5)
CASE = PropagationCase(
    (17, 23),
    0.4,
    0.85,
    62.0,
    (0.21, -0.13),
    (1 / 400,),
    (14.0, -8.5),
    0.6,
    (9, 11),
    row_um=0.37,
)


def sine(along, across):
    return along / math.sqrt(along**2 + across**2 + 62.0**2)


def test_the_finest_fringes_are_those_of_the_rays_from_both_ends_nearest_to_the_middle():
    """Along x the rays of the row that is 5.54 um off, along y those of the column that
    is 9.6 um off.
    """
    band_x = (sine(-14.0 + 4.4, 5.54) - sine(-14.0 - 4.4, 5.54)) / 0.85
    band_y = (sine(8.5 + 2.96, 9.6) - sine(8.5 - 2.96, 9.6)) / 0.85
    assert band_x > band_y
    assert cells.nyquist_um(CASE) == pytest.approx(1 / (2 * band_x), rel=1e-12)
    tall = dataclasses.replace(
        CASE, shape=(60, 23)
    )  # 10.915 um to either side: beyond the middle of the window
    band_y = (sine(8.5 + 10.915, 9.6) - sine(8.5 - 10.915, 9.6)) / 0.85
    assert cells.nyquist_um(tall) == pytest.approx(1 / (2 * band_y), rel=1e-12)
    wide = dataclasses.replace(
        CASE, shape=(60, 100)
    )  # 19.8 um: nothing lies between the middle and either axis
    band_x = (sine(-14.0 + 19.8, 0.0) - sine(-14.0 - 19.8, 0.0)) / 0.85
    assert cells.nyquist_um(wide) == pytest.approx(1 / (2 * band_x), rel=1e-12)


def stepped(steps, samples=(9, 11)):
    """A window of so many of Nyquist's steps."""
    return dataclasses.replace(
        CASE, step_um=steps * cells.nyquist_um(CASE), samples=samples
    )


def test_steps_up_to_nyquists_are_sampled_as_they_are():
    for steps in (0.3, 1.0):
        case = stepped(steps)
        assert cells.plan_pixel_cells(case) == cells.PixelCells(1, case, (0.0, 0.0))
    assert cells.plan_pixel_cells(stepped(1 + 1e-6)).points == 4


@pytest.mark.parametrize(
    ("steps", "finer", "points"), [(2.9, 2, 6), (2.9, 4, 12), (3.1, 2, 8), (1.7, 8, 16)]
)
def test_cells_have_so_many_points_in_nyquists_step_and_two_around_the_window(
    steps, finer, points
):
    """A wave of 1 / finer of half a turn from point to point, weighed by the rule for
    differences up to the fourth.
    """
    case = stepped(steps)
    found = cells.plan_pixel_cells(case, finer)
    assert found.points == points
    assert found.case.step_um == pytest.approx(case.step_um / points, rel=1e-12)
    assert found.case.samples == (9 * points + 4, 11 * points + 4)
    second = (2 * math.sin(math.pi / (2 * finer))) ** 2 / 24
    fourth = 17 / 5760 * (2 * math.sin(math.pi / (2 * finer))) ** 4
    left = 1 - second - fourth - np.sinc(1 / (2 * finer))
    assert found.left == pytest.approx(
        (left / fourth, fourth / second), rel=1e-6
    )  # of differences: 1e-13 of 2e-7
    assert (
        dataclasses.replace(found.case, step_um=case.step_um, samples=case.samples)
        == case
    )


def test_by_default_two_points_stand_in_nyquists_step_then_four_and_eight():
    assert cells.FINER == (2, 4, 8)
    assert cells.plan_pixel_cells(stepped(2.5)).points == 6


@pytest.mark.parametrize("turned", [False, True])
def test_six_thousand_points_along_an_axis_are_the_most(turned):
    """1499 cells of four points and two on either side; of 1500 there are 6004."""
    whole, more = ((1499, 3), (1500, 3)) if turned else ((3, 1499), (3, 1500))
    assert max(cells.plan_pixel_cells(stepped(1.5, whole)).case.samples) == 6000
    with pytest.raises(
        PropagationError, match="6004 points along an axis, at most 6000"
    ):
        cells.plan_pixel_cells(stepped(1.5, more))


def test_means_follow_the_second_and_fourth_differences_of_a_lone_point():
    """A lit point among its differences, 1 -2 1 and 1 -4 6 -4 1 along each axis, by the
    module's weights.
    """
    fine = cells.PixelCells(3, CASE, (0.11, 0.23))
    light = np.zeros((2 * 3 + 4, 3 * 3 + 4))
    light[4, 7] = (
        9.0  # the last row of the first cells, the last column of the second ones
    )
    d2, d4 = {0: -2.0, 1: 1.0, -1: 1.0}, {0: 6.0, 1: -4.0, -1: -4.0, 2: 1.0, -2: 1.0}
    want, parts = np.zeros((2, 3)), np.zeros((3, 2, 3))
    for i in range(6):
        for j in range(9):
            y, x = i + 2 - 4, j + 2 - 7
            terms = (
                float(x == y == 0),
                (d2.get(x, 0) * (y == 0) + d2.get(y, 0) * (x == 0)) / 24,
                -17 / 5760 * (d4.get(x, 0) * (y == 0) + d4.get(y, 0) * (x == 0))
                + d2.get(x, 0) * d2.get(y, 0) / 576,
            )
            parts[:, i // 3, j // 3] += terms  # nine points a cell, and light of nine
    want = parts.sum(0)
    got, error = cells.integrate_cells(torch.from_numpy(light)[None], fine)
    assert got[0].numpy() == pytest.approx(want, abs=1e-14)
    first, second, fourth = np.linalg.norm(parts.reshape(3, -1), axis=1)
    assert error == pytest.approx(
        0.11 * math.hypot(fourth, 0.23 * second) / first, rel=1e-12
    )
