"""The loss by which fits from several starts are compared is the one that each of them
lowers.
"""

import math

import numpy as np
import pytest
from scipy import special

from characterize.inference import constrained, leastsquares
from characterize.inference.leastsquares import (
    FitImages,
    GaussianPrior,
    SolverSettings,
    fit_levenberg_marquardt,
    invert_information,
)


@pytest.mark.parametrize("huber", [6.0, 2.6])
def test_starts_are_ranked_by_the_loss_that_is_minimised(huber):
    """Residuals of 9 and 15 sigma, a masked pixel of 40, one saturated pixel; Huber's
    loss from scipy.
    """
    rng = np.random.default_rng(4)
    shape, sigma = rng.uniform(0.5, 1.5, (1, 5, 7)), 3.1
    noise = sigma * rng.standard_normal(shape.shape)
    noise[0, 1, 2], noise[0, 3, 3], noise[0, 4, 4], noise[0, 0, 6] = (
        9 * sigma,
        -15 * sigma,
        40 * sigma,
        -11.0,
    )
    usable, saturated = np.ones(shape.shape, bool), np.zeros(shape.shape, bool)
    usable[0, 4, 4], saturated[0, 0, 6] = False, True
    data = FitImages(
        170.0 * shape + noise,
        usable,
        saturated,
        np.full(shape.shape, sigma**2),
        np.full(shape.shape, 1e12),
        0.0,
    )

    def model(x, slopes):
        return x[0] * shape, shape[None] if slopes else None

    found = fit_levenberg_marquardt(
        model, data, np.array([150.0]), settings=SolverSettings(huber=huber)
    )
    left = (data.electrons - found.value[0] * shape) / sigma
    left = np.where(saturated, np.maximum(left, 0), left)[usable]
    # scipy halves the square; the light's own noise, 170 / 1e12 of a variance, is left
    # out
    want = (
        2 * special.huber(huber, left).sum()
        + 2 * np.log(sigma) * (usable & ~saturated).sum()
    )
    assert found.merit == pytest.approx(want, rel=1e-9)


def test_the_variance_of_a_pixel_has_three_parts():
    """Floor + light over its scale + (share of the light)²; darkness below zero has no
    shot noise.
    """
    image = np.array([[[57.0, -8.0], [0.0, 1300.0]]])
    floor, scale = (
        np.array([[[3.1, 4.7], [2.2, 9.3]]]),
        np.array([[[1.7, 0.6], [1.1, 2.3]]]),
    )
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


def test_silent_pixels_weigh_nothing_and_far_ones_by_their_distance():
    """Saturated below the model: silent; above it: whole; two sigma of 1.6, ten of 4
    beyond 2.5; a masked one.
    """
    level = np.array([[[10.0, 10.0, 10.0, 10.0, 10.0]]])
    seen = np.array([[[9.0, 13.0, 13.2, -30.0, 99.0]]])
    saturated = np.array([[[True, True, False, False, False]]])
    usable = np.array([[[True, True, True, True, False]]])
    sigma = np.array([[[1.0, 2.0, 1.6, 4.0, 5.0]]])
    data = FitImages(seen, usable, saturated, sigma**2, np.full(level.shape, 1e30))
    free = GaussianPrior.none(np.zeros(1))
    state = leastsquares._state(
        data,
        (np.zeros(1), level, np.ones((1, *level.shape))),
        free,
        SolverSettings(huber=2.5),
    )
    assert state.residual.ravel() == pytest.approx([0.0, 1.5, 2.0, -10.0, 17.8])
    assert state.weight.ravel() == pytest.approx([0.0, 1.0, 1.0, 0.25, 0.0])
    assert state.information.item() == pytest.approx(1 / 4 + 1 / 2.56 + 0.25 / 16)
    assert state.gradient.item() == pytest.approx(-(1.5 / 2 + 2 / 1.6 - 0.25 * 10 / 4))


def test_some_frames_keep_what_belongs_to_them():
    stack = np.arange(24.0).reshape(3, 2, 4)
    data = FitImages(stack, stack > 5, stack > 20, stack + 0.3, stack + 0.7, 0.02)
    part = data.planes(np.array([0, 2]))
    assert part.model_error == 0.02
    for name, want in (
        ("electrons", stack),
        ("usable", stack > 5),
        ("saturated", stack > 20),
        ("variance_e2", stack + 0.3),
        ("scale", stack + 0.7),
    ):
        assert np.array_equal(getattr(part, name), want[[0, 2]])


def test_a_straight_model_has_the_covariance_of_normal_equations():
    """Two amplitudes, one with a prior, pixels of unlike noise: information,
    covariance, estimate and chi² in numpy.
    """
    rng = np.random.default_rng(8)
    shapes, sigma = (
        rng.uniform(0.3, 1.6, (2, 3, 6, 5)),
        rng.uniform(1.2, 4.1, (3, 6, 5)),
    )
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

    found = fit_levenberg_marquardt(
        model,
        data,
        np.array([20.0, 20.0]),
        prior=prior,
        settings=SolverSettings(step_tolerance=1e-6),
    )
    columns = (shapes / sigma * usable).reshape(2, -1)
    told, information = np.diag([0.0, 0.21**-2]), columns @ columns.T
    covariance = np.linalg.inv(information + told)
    value = covariance @ (columns @ (image / sigma).ravel() + told @ [0.0, 14.0])
    left = (image - np.tensordot(value, shapes, 1)) / sigma * usable
    assert found.information == pytest.approx(information, rel=1e-9)
    assert found.covariance == pytest.approx(covariance, rel=1e-9)
    assert found.value == pytest.approx(
        value, rel=1e-7
    )  # it stops when a step moves 1e-6 sigma
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


@pytest.mark.parametrize("away", [3e-3, 1e-2, 0.028])
def test_a_step_too_short_to_show_in_rounded_images_changes_no_slopes(away):
    """A straight model whose images come in single precision: bright pixels of 3e5,
    known to their root, round by up to
    3e-5 sigma each, 5e-4 in all of 25 x 20. Over a step of ``away`` sigma these would
    be slopes of 5e-4 / ``away``
    sigma a sigma along it. A fit that begins so close ends with the slopes that it was
    given.
    """
    rng = np.random.default_rng(15)
    shapes = (
        rng.uniform(0.7, 1.3, (2, 1, 25, 20))
        * [[[[3e5]]], [[[1.0]]]]
        * [[[[1.0]]], [[[2e4]]]]
    )
    truth, sigma = np.array([1.0, -0.37]), 550.0
    image = np.tensordot(truth, shapes, 1)
    everywhere = np.ones(image.shape, bool)
    data = FitImages(
        image,
        everywhere,
        ~everywhere,
        np.full(image.shape, sigma**2),
        np.full(image.shape, 1e15),
    )

    def rounded(x, slopes):
        return np.tensordot(x, shapes, 1).astype(np.float32).astype(
            float
        ), shapes if slopes else None

    scaled = shapes.reshape(2, -1) / sigma
    size, turn = np.linalg.eigh(scaled @ scaled.T)
    begin = truth + away * turn @ (np.array([0.8, -0.6]) / np.sqrt(size))
    found = fit_levenberg_marquardt(
        rounded, data, begin, settings=SolverSettings(secant=True, step_tolerance=1e-4)
    )
    assert found.slopes == pytest.approx(shapes, rel=1e-12)
    assert found.converged


def test_longer_steps_bring_slopes_up_to_date():
    """e^x of a picture from 0.3 sigma off, with slopes of where it is sought: after one
    step they are the secant.
    """
    shape = np.random.default_rng(2).uniform(0.5, 1.5, (1, 6, 5))
    sigma = (
        0.01 * float(np.linalg.norm(shape)) * np.exp(0.4) / 1.2
    )  # of a parameter: 0.012
    everywhere = np.ones(shape.shape, bool)
    data = FitImages(
        np.exp(0.4) * shape,
        everywhere,
        ~everywhere,
        np.full(shape.shape, sigma**2),
        np.full(shape.shape, 1e15),
    )
    asked = []

    def model(x, slopes):
        asked.append(float(x[0]))
        return np.exp(x[0]) * shape, np.exp(x)[
            :, None, None, None
        ] * shape if slopes else None

    settings = SolverSettings(secant=True, near=np.inf, finish=False, iterations=1)
    found = fit_levenberg_marquardt(model, data, np.array([0.39]), settings=settings)
    (begin, end) = asked
    want = (np.exp(end) - np.exp(begin)) / (end - begin)
    assert end - begin > 0.1 * 0.012
    assert found.slopes[0] == pytest.approx(want * shape, rel=1e-9)


@pytest.mark.parametrize("size", [0.029, 0.031, 1.7])
def test_a_jacobian_brought_up_to_date_explains_the_step_and_keeps_what_lies_across(
    size,
):
    """Of all that give the images' change for the step, the one that changes nothing
    for steps at right angles to it in
    the measure of the curvature; steps below 0.03 sigma teach nothing."""
    rng = np.random.default_rng(12)
    before = rng.normal(size=(3, 2, 4, 5))
    image, later = rng.normal(40, 3, (2, 2, 4, 5))
    usable = rng.uniform(size=image.shape) > 0.2
    data = FitImages(
        image + 1.3,
        usable,
        np.zeros_like(usable),
        np.full(image.shape, 2.1**2),
        np.full(image.shape, 1.7),
    )
    wide = np.full(3, np.inf)
    prior, x = (
        GaussianPrior(np.zeros(3), np.array([0.3, np.inf, 2.0]), -wide, wide),
        np.array([0.2, -1.0, 3.0]),
    )
    state = leastsquares._state(
        data, (x, image, before), prior, SolverSettings(), travel=0.4
    )
    step = rng.normal(size=3)
    step *= size / np.sqrt(step @ state.curvature @ step)
    found = leastsquares._secant(
        data, state, step, later, prior, SolverSettings(), moved=size
    )
    assert found.x == pytest.approx(x + step)
    assert found.travel == pytest.approx(0.4 + size)
    assert np.array_equal(found.image, later)
    if size < 0.03:
        assert np.array_equal(found.jacobian, before)
        return
    assert np.tensordot(step, found.jacobian, 1) == pytest.approx(
        later - image, abs=1e-9
    )
    for other in np.eye(3):
        across = other - step * (step @ state.curvature @ other) / size**2
        assert np.tensordot(across, found.jacobian - before, 1) == pytest.approx(
            np.zeros_like(image), abs=1e-9
        )


def test_what_a_jacobian_did_not_foresee_is_a_share_of_the_change_in_sigma_of_pixels_that_count():
    """A change of 5 in one pixel foreseen as 2, of 3 in another foreseen whole, and one
    in a masked pixel.
    """
    image, slopes = np.array([[[10.0, 20.0, 30.0]]]), np.array([[[[1.0, 1.5, 9.0]]]])
    usable = np.array([[[True, True, False]]])
    data = FitImages(
        image,
        usable,
        ~usable & False,
        np.array([[[2.0, 3.0, 1.0]]]) ** 2,
        np.full((1, 1, 3), 1e30),
    )
    free = GaussianPrior.none(np.zeros(1))
    state = leastsquares._state(
        data, (np.zeros(1), image, slopes), free, SolverSettings()
    )
    got = leastsquares._missed(
        state, np.array([2.0]), image + np.array([[[5.0, 3.0, -70.0]]])
    )
    assert got == pytest.approx((3 / 2) / math.hypot(5 / 2, 3 / 3), rel=1e-12)


@pytest.mark.parametrize(("tolerance", "settled"), [(5.1e-5, True), (4.9e-5, False)])
def test_where_no_step_lowers_the_misfit_one_of_ten_tolerances_is_settled(
    tolerance, settled
):
    """Slopes that promise five sigma, images that are only ever worse: ten tries, the
    last damped by 1e-3 6^9 to
    5 / 10078.7 = 4.961e-4 sigma."""
    shape = np.full((1, 1, 5), 1 / math.sqrt(5))
    everywhere = np.ones(shape.shape, bool)
    data = FitImages(
        5 * shape,
        everywhere,
        ~everywhere,
        np.ones(shape.shape),
        np.full(shape.shape, 1e15),
    )

    def model(x, slopes):
        return -x[0] * shape, shape[None] if slopes else None

    found = fit_levenberg_marquardt(
        model, data, np.zeros(1), settings=SolverSettings(step_tolerance=tolerance)
    )
    assert found.converged is settled
    assert found.reason == (
        "last step moved 0.0005 sigma" if settled else "no step lowers the misfit"
    )
    assert found.value == [0.0]
    assert found.iterations == 1


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
    found = fit_levenberg_marquardt(
        lambda x, slopes: (np.tensordot(x, shapes, 1), shapes if slopes else None),
        data,
        np.zeros(2),
        prior=bounds,
        settings=SolverSettings(step_tolerance=1e-9),
    )
    flat = shapes.reshape(2, -1)
    covariance = 1.3 * np.linalg.inv(flat @ flat.T)
    held = 2.5 + (flat[0] @ flat[1]) / (flat[1] @ flat[1]) * 3.0
    assert found.value == pytest.approx([4.0, held], rel=1e-6)
    want = (np.array([7.0, 2.5]) - [4.0, held]) / np.sqrt(np.diag(covariance))
    assert found.beyond == pytest.approx(want, rel=1e-5)


def test_a_step_that_leaves_the_ball_ends_on_it():
    """Equal curvature: the least is at (3, 4.5), the nearest point of the ball of
    radius 2 about 0 on the way there.
    """
    shapes = np.eye(2)[:, None, None]
    everywhere = np.ones((1, 1, 2), bool)
    data = FitImages(
        np.array([[[3.0, 4.5]]]),
        everywhere,
        ~everywhere,
        np.ones((1, 1, 2)),
        np.full((1, 1, 2), 1e15),
    )
    settings = SolverSettings(
        step_tolerance=1e-6,
        bounded=True,
        ball=constrained.BallConstraint(np.arange(2), 2.0),
    )
    found = fit_levenberg_marquardt(
        lambda x, slopes: (x[None, None], shapes if slopes else None),
        data,
        np.array([0.3, -0.2]),
        settings=settings,
    )
    assert found.value == pytest.approx(
        np.array([3.0, 4.5]) * 2 / math.hypot(3.0, 4.5), rel=1e-4
    )


def test_exact_slopes_are_made_where_a_step_ended():
    """Every place but the first has been tried without slopes before, and the last
    lowers the misfit of all.
    """
    shape = np.random.default_rng(2).uniform(0.5, 1.5, (1, 6, 5))
    everywhere = np.ones(shape.shape, bool)
    light = np.full(shape.shape, 1e-4), np.full(shape.shape, 1e15)
    data = FitImages(np.exp(0.9) * shape, everywhere, ~everywhere, *light)
    tried, exact = [], []

    def model(x, slopes):
        (exact if slopes else tried).append(float(x[0]))
        return np.exp(x[0]) * shape, np.exp(x)[
            :, None, None, None
        ] * shape if slopes else None

    found = fit_levenberg_marquardt(
        model, data, np.array([0.6]), settings=SolverSettings(secant=True)
    )
    assert len(exact) > 1
    assert exact[0] == 0.6
    assert set(exact[1:]) <= set(tried)
    assert found.value == pytest.approx([0.9], abs=1e-4)


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
    found = fit_levenberg_marquardt(
        lambda x, slopes: (x[0] * ones[0], ones if slopes else None),
        data,
        np.array([6.0]),
    )
    left = (image - found.value[0]) / 1.3
    inside = np.abs(left) < 6
    assert inside.sum() == 38
    assert found.chi2_per_dof == pytest.approx((left[inside] ** 2).sum() / 37, rel=1e-6)
