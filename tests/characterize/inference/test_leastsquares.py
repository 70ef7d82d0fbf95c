"""The loss by which fits from several starts are compared is the one that each of them
lowers.
"""

import numpy as np
import pytest

from characterize.inference.leastsquares import (
    FitImages,
    FitProblem,
    GaussianPrior,
    SolverSettings,
    invert_information,
)


def test_the_variance_of_a_pixel_has_three_parts():
    """Floor + light over its scale + (share of the light)²; darkness below zero has no
    shot noise.
    """
    image = np.array([[[57.0, -8.0], [0.0, 1300.0]]])
    floor = np.array([[[3.1, 4.7], [2.2, 9.3]]])
    scale = np.array([[[1.7, 0.6], [1.1, 2.3]]])
    data = FitImages(image, image > 0, image < 0, floor, scale, 0.03)
    want = [
        [[3.1 + 57 / 1.7 + (0.03 * 57) ** 2, 4.7], [2.2, 9.3 + 1300 / 2.3 + 39.0**2]]
    ]
    assert data.variance(image) == pytest.approx(np.array(want), rel=1e-12)
    seen = FitImages(
        image,
        image > 0,
        image < 0,
        floor,
        scale,
        0.03,
        common_floor=0.3,
        common_light=0.02,
    )
    dark, flat = seen.shared(image)  # of the variance the one, of the light the other
    assert dark**2 == pytest.approx(0.3 * floor, rel=1e-12)
    assert flat.ravel() == pytest.approx([1.14, 0.0, 0.0, 26.0], rel=1e-12)


def test_a_straight_model_has_the_covariance_of_normal_equations():
    """Two amplitudes, one with a prior, pixels of unlike noise: information,
    covariance, estimate and chi² in numpy.
    """
    rng = np.random.default_rng(8)
    shapes = rng.uniform(0.3, 1.6, (2, 3, 6, 5))
    sigma = rng.uniform(1.2, 4.1, (3, 6, 5))
    usable = rng.uniform(size=sigma.shape) > 0.1
    image = (
        31.0 * shapes[0] + 17.0 * shapes[1] + sigma * rng.standard_normal(sigma.shape)
    )
    data = FitImages(
        image, usable, np.zeros_like(usable), sigma**2, np.full(sigma.shape, 1e15)
    )
    wide = np.full(2, np.inf)
    prior = GaussianPrior(np.array([0.0, 14.0]), np.array([np.inf, 0.21]), -wide, wide)

    def model(x, slopes):
        return np.tensordot(x, shapes, 1), shapes if slopes else None

    found = FitProblem(model, data, prior).fit(
        np.array([20.0, 20.0]), SolverSettings(step_tolerance=1e-6)
    )
    columns = (shapes / sigma * usable).reshape(2, -1)
    told, information = np.diag([0.0, 0.21**-2]), columns @ columns.T
    covariance = np.linalg.inv(information + told)
    value = covariance @ (columns @ (image / sigma).ravel() + told @ [0.0, 14.0])
    left = (image - np.tensordot(value, shapes, 1)) / sigma * usable
    assert found.information == pytest.approx(information, rel=1e-9)
    assert found.covariance == pytest.approx(covariance, rel=1e-9)
    # it stops when a step moves 1e-6 sigma
    assert found.value == pytest.approx(value, rel=1e-7)
    assert found.residual_sigma == pytest.approx(left, abs=1e-5)
    assert found.chi2_per_dof == pytest.approx(
        (left**2).sum() / (usable.sum() - 2), rel=1e-7
    )


def test_parameters_of_unlike_units_are_inverted_alike():
    matrix = np.array([[3.0, 0.8, -0.1], [0.8, 2.0, 0.3], [-0.1, 0.3, 1.4]])
    units = np.array([1e-7, 3.0, 4e8])
    assert invert_information(matrix / np.outer(units, units)) / np.outer(
        units, units
    ) == pytest.approx(np.linalg.inv(matrix))


def test_what_bounds_hold_back_is_told_in_sigma():
    """Least at 7 and 2.5, the first held at 4: the second gives way, by normal
    equations.
    """
    shapes = np.array([[2.0, 0.0, 0.3], [0.4, 1.5, 0.0]])[:, None, None]
    everywhere = np.ones((1, 1, 3), bool)
    data = FitImages(
        np.tensordot([7.0, 2.5], shapes, 1),
        everywhere,
        ~everywhere,
        np.full((1, 1, 3), 1.3),
        everywhere * 1e15,
    )
    wide = np.full(2, np.inf)
    bounds = GaussianPrior(np.zeros(2), wide, -wide, np.array([4.0, np.inf]))
    found = FitProblem(
        lambda x, slopes: (np.tensordot(x, shapes, 1), shapes if slopes else None),
        data,
        bounds,
    ).fit(np.zeros(2), SolverSettings(step_tolerance=1e-9))
    flat = shapes.reshape(2, -1)
    covariance = 1.3 * np.linalg.inv(flat @ flat.T)
    held = 2.5 + (flat[0] @ flat[1]) / (flat[1] @ flat[1]) * 3.0
    assert found.value == pytest.approx([4.0, held], rel=1e-6)
    want = (np.array([7.0, 2.5]) - [4.0, held]) / np.sqrt(np.diag(covariance))
    assert found.beyond == pytest.approx(want, rel=1e-5)


def test_pixels_beyond_the_outlier_limit_on_either_side_are_no_part_of_chi_square():
    """One of 25 sigma above, one as far below: the estimate stays, and 38 of 40 pixels
    less one parameter count.
    """
    rng = np.random.default_rng(5)
    image = 7.0 + 1.3 * rng.standard_normal((1, 5, 8))
    image[0, 1, 2] += 25 * 1.3
    image[0, 3, 6] -= 25 * 1.3
    everywhere = np.ones(image.shape, bool)
    data = FitImages(
        image,
        everywhere,
        ~everywhere,
        np.full(image.shape, 1.69),
        np.full(image.shape, 1e15),
    )
    ones = np.ones((1, *image.shape))
    start = np.array([6.0])
    found = FitProblem(
        lambda x, slopes: (x[0] * ones[0], ones if slopes else None),
        data,
        GaussianPrior.none(start),
    ).fit(start)
    left = (image - found.value[0]) / 1.3
    inside = np.abs(left) < 6
    assert inside.sum() == 38
    assert found.chi2_per_dof == pytest.approx((left[inside] ** 2).sum() / 37, rel=1e-6)


def test_the_deviance_of_counts_is_that_of_poisson():
    """2 (d ln(d / I) - d + I) of counts d about light I, without a floor; saturated
    pixels only below, masked ones never.

    Error: 4 points of Gauss and Jacobi, 1e-3 for light a factor of three off.
    """
    seen = np.array([[[70.0, 9.0, 310.0, 40.0, 40.0, 40.0]]])
    image = np.array([[[90.0, 27.0, 130.0, 30.0, 60.0, 30.0]]])
    usable = np.array([[[True, True, True, True, True, False]]])
    saturated = np.array([[[False, False, False, True, True, False]]])
    data = FitImages(
        seen, usable, saturated, np.full(seen.shape, 1e-9), np.ones(seen.shape)
    )
    want = 2 * (seen * np.log(seen / image) - seen + image)
    want = np.where([[[True, True, True, True, False, False]]], want, 0.0)
    assert data.deviance(image) == pytest.approx(want, rel=1.5e-3)


def test_the_merit_s_slope_is_the_score_that_a_fit_sets_to_zero():
    """At the estimate of Poisson's rate, mean count over exposure, the merit is lowest:
    central differences of 1e-3 of it.
    """
    rng = np.random.default_rng(3)
    shape = rng.uniform(20.0, 400.0, (2, 6, 7))
    counts = rng.poisson(1.3 * shape).astype(float)
    everywhere = np.ones(shape.shape, bool)
    data = FitImages(
        counts, everywhere, ~everywhere, np.full(shape.shape, 1e-6), 1.0 + 0 * shape
    )
    problem = FitProblem(
        lambda x, slopes: (x[0] * shape, shape[None] if slopes else None),
        data,
        GaussianPrior.none(np.ones(1)),
    )
    found = problem.fit(np.array([0.9]), SolverSettings(step_tolerance=1e-6))
    rate = counts.sum() / shape.sum()
    assert found.value == pytest.approx([rate], rel=1e-6)
    below, at, above = (
        problem.merit(np.array([rate * (1 + e)])) for e in (-1e-3, 0.0, 1e-3)
    )
    assert at < min(below, above)
    curvature = (below + above - 2 * at) / (1e-3 * rate) ** 2
    assert curvature / 2 == pytest.approx(1 / found.covariance.item(), rel=0.02)
