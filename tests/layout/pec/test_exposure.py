"""Point exposure: closed forms against quadrature, and the fit of a measured function."""

import numpy as np
import pytest

from layout.pec.psf import (
    PointExposure,
    _fit_error,
    disc_exposure,
    fit_point_spread,
    point_exposure,
    rim_of_own_disc,
    slope_at_rim,
)
from layout.process.process import ExposureSettings
from metalens.core.errors import ProcessError
from tests.referees.rims import at_edges

GOLD = np.pi * (3 - np.sqrt(5))


def disc_points(radius, count=40_000):
    """Evenly spread points in a disc (sunflower)."""
    n = np.arange(count) + 0.5
    return (
        radius
        * np.sqrt(n / count)[:, None]
        * np.stack([np.cos(GOLD * n), np.sin(GOLD * n)], -1)
    )


@pytest.mark.parametrize(
    ("distance", "width"),
    [(0.0, 0.05), (0.1, 0.05), (0.17, 0.05), (0.4, 0.3), (5.0, 3.0)],
)
def test_exposure_by_a_disc_is_the_integral_of_the_point_exposure(distance, width):
    points = disc_points(0.1)
    r2 = (points[:, 0] - distance) ** 2 + points[:, 1] ** 2
    want = np.exp(-r2 / width**2).mean() * 0.1**2 / width**2
    # the sum over 40 000 points: 5e-4
    assert disc_exposure(distance, 0.2, width) == pytest.approx(want, rel=1e-3)


@pytest.mark.parametrize("width", [0.002, 0.01, 0.1, 1.0, 30.0])
def test_own_rim_and_its_slope_are_the_disc_seen_at_its_radius(width):
    assert rim_of_own_disc(0.2, width) == pytest.approx(
        float(disc_exposure(0.1, 0.2, width)), rel=1e-9
    )
    h = 1e-4 * min(width, 0.1)
    slope = (
        disc_exposure(0.1 - h, 0.2, width) - disc_exposure(0.1 + h, 0.2, width)
    ) / (2 * h)
    assert slope_at_rim(0.2, width) == pytest.approx(float(slope), rel=1e-5)


def test_a_wide_disc_clears_at_one_half():
    # curvature: a / (2 sqrt(pi) D)
    assert rim_of_own_disc(200.0, 0.01) == pytest.approx(0.5, abs=1e-4)


def test_the_double_gaussian_holds_all_energy_in_the_asked_ratio():
    point = point_exposure(ExposureSettings(alpha_um=0.01, beta_um=31.0, eta=0.6))
    assert point.within(np.array([1.0, 1e4])) == pytest.approx(
        [1 / 1.6 + 0.6 / 1.6 * -np.expm1(-(31.0**-2)), 1]
    )
    radius = np.linspace(0, 0.2, 20_001)
    ring = 2 * np.pi * radius * point.density(radius)
    assert np.sum((ring[1:] + ring[:-1]) / 2) * 1e-5 == pytest.approx(
        float(point.within(np.array(0.2))), rel=1e-5
    )


def test_a_table_of_a_double_gaussian_is_fitted_to_its_energy():
    truth = PointExposure(np.array([0.012, 9.0]), np.array([1.0, 0.7]) / 1.7)
    radius = np.geomspace(0.003, 30, 120)
    found = fit_point_spread(radius, 17.0 * truth.density(radius))
    probe = np.array([0.02, 0.1, 1.0, 5.0, 9.0, 20.0])
    assert found.weights.sum() == pytest.approx(1)
    assert abs(found.within(probe) - truth.within(probe)).max() < 0.01
    assert found.fit_error < 0.02


def test_a_power_law_tail_is_fitted_where_two_gaussians_fail():
    # f = 1 / (1 + (r/a)^2)^1.5: energy within r is 1 - 1 / sqrt(1 + (r/a)^2), in closed
    # form
    core = 0.01
    radius = np.geomspace(0.002, 50, 150)
    found = fit_point_spread(radius, (1 + (radius / core) ** 2) ** -1.5)
    probe = np.array([0.01, 0.03, 0.1, 1.0, 10.0])
    want = 1 - 1 / np.sqrt(1 + (probe / core) ** 2)
    assert abs(found.within(probe) - want).max() < 0.01
    assert found.fit_error < 0.02


@pytest.mark.parametrize(
    ("radius", "density"),
    [
        ([1, 2, 3], [1, 1, 1]),
        ([1, 3, 2, 4], [1] * 4),
        ([1, 2, 2, 4], [1] * 4),
        ([0, 1, 2, 3], [1] * 4),
        ([1, 2, 3, 4], [1, 1, 0, 1]),
        ([1, 2, 3, np.inf], [1] * 4),
        ([1, 2, 3, 4], [1, 1, np.nan, 1]),
    ],
)
def test_an_impossible_table_is_refused(radius, density):
    with pytest.raises(ProcessError, match="at least 4 rising radii"):
        fit_point_spread(np.array(radius, float), np.array(density, float))


def test_edges_of_two_pillars_see_each_other():
    point = PointExposure(np.array([0.3]), np.array([1.0]))
    centres = np.array([[0.0, 0.0], [0.4, 0.0]])
    got = at_edges(
        centres, np.array([0.2, 0.1]), np.array([1.0, 2.0]), point, which=np.array([0])
    )
    angle = np.linspace(0, 2 * np.pi, 2001)[:-1]
    distance = np.hypot(0.1 * np.cos(angle) - 0.4, 0.1 * np.sin(angle))
    want = rim_of_own_disc(0.2, 0.3) + 2 * disc_exposure(distance, 0.1, 0.3).mean()
    assert got[0] == pytest.approx(float(want), rel=1e-9)


def test_the_error_of_a_fit_is_against_the_integral_of_its_table():
    """Density r^-1.5 and then r^-2 between 1, 4 and 9 um: rings of 4π (√4 - √1) and 2π
    c ln(9 / 4).
    """
    radius = np.array([1.0, 4.0, 9.0])
    density = np.array([1.0, 1 / 8, 1 / 8 * (4 / 9) ** 2])
    rings = np.array([4 * np.pi * (2 - 1), 2 * np.pi * density[1] * 16 * np.log(9 / 4)])
    # all of its energy lies within the first radius
    narrow = PointExposure(np.array([1e-6]), np.array([1.0]))
    assert _fit_error(narrow, radius, density) == pytest.approx(rings.sum(), rel=1e-9)
    whole = PointExposure(np.array([2.7]), np.array([1.0]))
    within = np.exp(-((1 / 2.7) ** 2)) - np.exp(-((radius[1:] / 2.7) ** 2))
    assert _fit_error(whole, radius, density) == pytest.approx(
        abs(within - np.cumsum(rings)).max(), rel=1e-9
    )
