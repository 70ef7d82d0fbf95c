"""A valley's steps and slopes in closed form: straight models, and bent ones of
constant second derivative.
"""

import numpy as np
import pytest
from scipy import optimize

from characterize.inference import posterior
from characterize.inference.leastsquares import FitImages, GaussianPrior
from characterize.inference.posterior import LocalMode

RNG = np.random.default_rng(71)
SHAPE, SIGMA = (2, 5, 7), 0.37
PICTURES = RNG.normal(size=(3, *SHAPE)) + 0.6 * RNG.normal(
    size=SHAPE
)  # overlap: parameters are correlated
COLUMNS = PICTURES.reshape(3, -1).T
MODE = np.array([0.8, 1.7, -0.4])


def straight(x, jacobian):
    return 50.0 + SIGMA * np.tensordot(
        x, PICTURES, 1
    ), SIGMA * PICTURES if jacobian else None


def data(noise=0.0):
    """Of the mode, with noise of one size; shot noise is none of it."""
    everywhere = np.ones(SHAPE, bool)
    seen = straight(MODE, False)[0] + SIGMA * noise
    return FitImages(
        seen, everywhere, ~everywhere, np.full(SHAPE, SIGMA**2), np.full(SHAPE, 1e15)
    )


def valley(model=straight, *, of=None, known=None, **bounds):
    free = GaussianPrior.none(MODE)
    prior = GaussianPrior(
        free.mean,
        free.sigma,
        bounds.get("low", free.low),
        bounds.get("high", free.high),
    )
    return LocalMode(model, of or data(), MODE, prior, known=known)


def test_an_outlier_is_held_at_the_root_of_six_times_its_sigma():
    """Weight 6 / |r| of its square: r² 6 / |r|; a full pixel that the image fills says nothing of the parameters."""
    noise = np.zeros(SHAPE)
    noise[0, 1, 2], noise[1, 4, 3], noise[1, 0, 0] = -13.0, 5.0, 20.0
    of = data(noise)
    of.saturated[1, 0, 0], of.saturated[0, 0, 1] = True, True
    one = valley(of=of)
    bottom = one.bottom[: np.prod(SHAPE)].reshape(SHAPE)
    assert bottom[0, 1, 2] == pytest.approx(np.sqrt(6 * 13))
    assert bottom[1, 4, 3] == pytest.approx(-5)
    root = np.ones(SHAPE)
    root[0, 1, 2], root[1, 0, 0] = np.sqrt(6 / 13), np.sqrt(6 / 20)
    root[0, 0, 1] = (
        0  # as bright as the pixel: silent; the darker image at the other is a miss
    )
    assert one.slopes[:-3] == pytest.approx(COLUMNS * root.reshape(-1, 1), rel=1e-9)
    assert one.least == pytest.approx(6 * 13 + 25 + 6 * 20)


def test_a_shifted_residual_is_solved_as_least_squares_from_anywhere():
    one, shift = valley(of=data(RNG.normal(size=SHAPE))), 0.8 * RNG.normal(size=70 + 3)
    begin = MODE + np.array([0.5, -0.3, 0.9])
    want, misfit, *_ = np.linalg.lstsq(
        COLUMNS, -(one.residual(np.zeros(3)) + shift)[:70], rcond=None
    )
    got, value = one.descend(begin, shift=shift)
    assert got == pytest.approx(want, abs=1e-5)  # a damping of 1e-6 of steps of one
    assert value == pytest.approx(misfit[0] + (shift[70:] ** 2).sum(), rel=1e-9)


def test_bounds_are_kept_by_the_best_place_inside():
    low, high = MODE - np.array([0.1, 9, 9]), MODE + np.array([9, 0.05, 9])
    one, shift = valley(low=low, high=high), 3.0 * COLUMNS @ np.array([0.2, -0.3, 0.1])
    shift = np.concatenate([shift, np.zeros(3)])
    want = optimize.lsq_linear(
        COLUMNS, -(one.residual(np.zeros(3)) + shift)[:70], (low, high)
    ).x
    assert want[0] == pytest.approx(low[0])
    got, _ = one.descend(MODE + np.array([0.3, -0.2, 0.4]), shift=shift)
    assert got == pytest.approx(want, abs=1e-4)


@pytest.mark.parametrize(("share", "moves"), [(0.97, True), (1.03, False)])
def test_a_step_that_gains_less_than_the_least_is_not_tried(share, moves):
    """From 0.6 of one column away: its square, of the parabola, is what a step gains."""
    away = np.array([0.0, 0.6, 0.0])
    gain = 0.36 * (COLUMNS[:, 1] ** 2).sum()
    got, value = valley().descend(MODE + away, least=share * gain, rounds=1)
    assert got == pytest.approx(MODE if moves else MODE + away, abs=1e-5)
    assert value == pytest.approx(0 if moves else gain, abs=1e-6)


@pytest.mark.parametrize(("factor", "left"), [(1.6, 0.0), (0.4, 0.01 / 1.01)])
def test_slopes_that_are_wrong_by_a_factor_are_right_after_one_step(factor, left):
    """One parameter: the secant is the slope. A first step too far is not taken, and
    damps the next by a hundredth.
    """
    bright = 50.0 + np.zeros(SHAPE)
    slope = 0.02 * PICTURES[:1]

    def model(x, jacobian):
        return bright + SIGMA * x[0] * slope[0], SIGMA * slope if jacobian else None

    everywhere = np.ones(SHAPE, bool)
    of = FitImages(
        bright, everywhere, ~everywhere, np.full(SHAPE, SIGMA**2), np.full(SHAPE, 1e15)
    )
    mode = np.zeros(1)
    one = LocalMode(
        model,
        of,
        mode,
        GaussianPrior.none(mode),
        known=(bright, factor * SIGMA * slope),
    )
    got, _ = one.descend(np.array([4.0]), rounds=2, least=0.0)
    assert got[0] == pytest.approx(4.0 * left, abs=2e-5)


@pytest.mark.parametrize("sigma", [0.0099, 0.0101, 1.7])
def test_slopes_explain_what_a_step_missed_by_the_least_change_and_stay_after_one_that_tells_nothing(
    sigma,
):
    """By the secant, and not at all for steps that no information has in common with
    this one (Broyden 1965).
    """
    rng = np.random.default_rng(9)
    missed, step, other = rng.normal(size=70), rng.normal(size=3), rng.normal(size=3)
    step *= sigma / np.linalg.norm(COLUMNS @ step)
    metric = COLUMNS.T @ COLUMNS
    other -= (other @ metric @ step) / (step @ metric @ step) * step
    got = posterior.broyden_update(COLUMNS, step, missed) - COLUMNS
    assert got @ other == pytest.approx(0, abs=1e-12 / sigma)
    assert got @ step == pytest.approx(missed * (sigma > 0.01), abs=1e-12)


CURVES = RNG.normal(size=(3, *SHAPE))
BENT = 0.11


def bent(x, jacobian):
    """Each parameter acts by x + BENT / 2 (x - mode)² of a picture of its own: slopes
    change straight.
    """
    way = x - MODE
    image = straight(x, False)[0] + SIGMA * BENT / 2 * np.tensordot(way**2, CURVES, 1)
    return image, SIGMA * (
        PICTURES + BENT * way[:, None, None, None] * CURVES
    ) if jacobian else None


def bend(way):
    """(pixels, 3) change of the slopes on a way from the mode."""
    return (BENT * way[:, None] * CURVES.reshape(3, -1)).T


def test_slopes_go_with_ways_met_before_as_far_as_a_place_lies_along_them(monkeypatch):
    """Along is by the metric of the information; what is left of the second way is at
    right angles to the first.
    """
    one, first, second = (
        valley(bent),
        np.array([0.9, -0.4, 0.2]),
        np.array([0.5, 0.7, -0.3]),
    )
    metric = COLUMNS.T @ COLUMNS
    monkeypatch.setattr(posterior, "_HOLDS", 0.0)
    assert one.slopes_at(MODE + first)[:-3] == pytest.approx(
        COLUMNS + bend(first), abs=1e-9
    )
    assert one.slopes_at(MODE + second)[:-3] == pytest.approx(
        COLUMNS + bend(second), abs=1e-9
    )
    monkeypatch.setattr(posterior, "_HOLDS", np.inf)
    square = second - (first @ metric @ second) / (first @ metric @ first) * first
    way = 0.6 * first + 0.7 * square + np.array([0.1, 0.05, 0.3])
    shares = [way @ metric @ v / (v @ metric @ v) for v in (first, square)]
    assert all(0 < share < 1.5 for share in shares)
    want = COLUMNS + bend(shares[0] * first + shares[1] * square)
    assert one.slopes_at(MODE + way)[:-3] == pytest.approx(want, abs=1e-6)
    assert len(one.met) == 2
    far = one.slopes_at(MODE + 2 * first)[:-3]  # half again at most
    assert far == pytest.approx(COLUMNS + bend(1.5 * first), abs=1e-6)


@pytest.mark.parametrize(("missed", "computed"), [(0.39, False), (0.41, True)])
def test_slopes_hold_where_the_trapezium_rule_misses_two_fifths_of_a_sigma(
    missed, computed
):
    """From the mode alone it misses BENT / 2 w² of the picture, whatever the noise."""
    one, asked = valley(bent, of=data(RNG.uniform(-2, 2, SHAPE))), []
    one._model = lambda x, jacobian: asked.append(jacobian) or bent(x, jacobian)
    way = np.array([0.0, np.sqrt(missed / (BENT / 2 * np.linalg.norm(CURVES[1]))), 0.0])
    got = one.slopes_at(MODE + way)[:-3]
    assert (True in asked) is computed
    assert got == pytest.approx(COLUMNS + bend(way) * computed, abs=1e-9)
