"""How far a parameter is walked, and what is read off a walk: Gaussians whose walk is a straight line."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference import walk
from characterize.inference.leastsquares import Prior
from characterize.inference.walk import Walk


def prior(mean=3.0, sigma=4.0, low=-5.0, high=99.0):
    free = np.full(2, np.inf)
    return Prior(
        np.array([0.0, mean, 0.0]),
        np.array([np.inf, sigma, np.inf]),
        np.r_[-free[0], low, -9.0],
        np.r_[free[0], high, 9],
    )


def mode(value=1.0, sigma=0.7, merit=20.0, **more):
    covariance = np.array([[0.5, 0.2, 0.0], [0.2, sigma**2, -0.3], [0.0, -0.3, 0.9]])
    known = {"value": np.array([2.0, value, 0.4]), "covariance": covariance, "merit": merit, "image": None}
    return SimpleNamespace(**known | more)


def test_a_walk_goes_two_and_a_half_prior_sigma_to_either_side_within_the_bounds():
    about = SimpleNamespace(prior=prior())
    assert walk._ends(about, mode(), 1) == (-5.0, 13.0)  # 3 - 10 lies beyond the bound
    assert walk._ends(SimpleNamespace(prior=prior(low=-99.0, high=8.0)), mode(), 1) == (-7.0, 8.0)
    assert walk._ends(about, mode(value=14.5), 1) == (-5.0, 14.5)  # the mode belongs to it
    assert walk._wide(about, mode(), 1) == 4.0
    free = SimpleNamespace(prior=prior(sigma=np.inf, low=-99.0))
    assert walk._wide(free, mode(), 1) == pytest.approx(3.2 * 0.7)
    assert walk._ends(free, mode(), 1) == pytest.approx((1 - 8 * 0.7, 1 + 8 * 0.7))  # eight of its own sigma


def test_valleys_are_walked_in_steps_of_their_sigma_up_to_fourteen_variances_above_the_best(monkeypatch):
    """A third of the prior's 4 at most; the second valley lies beside the first walk, and goes as far."""
    sides = []

    def side(task, part, one, i, end, *, step, settings, most):
        sides.append((one.value[1], end, step, most))
        return [mode(value=end, merit=60.0, information=np.eye(3))]

    monkeypatch.setattr(walk, "_side", side)
    monkeypatch.setattr(walk, "_measured", lambda task, data, x, image: 30.0 + abs(x[1] - 1))
    monkeypatch.setattr(walk.dataclasses, "replace", lambda one, **new: SimpleNamespace(**vars(one) | new))
    about = SimpleNamespace(
        prior=SimpleNamespace(**{n: getattr(prior(low=-99.0), n) for n in ("mean", "sigma", "low", "high")}),
        names=("a", "bias_nm", "c"), problem=lambda: None, data=None,
    )  # fmt: skip
    for passes in (False, True):
        monkeypatch.setattr(Walk, "passes", lambda self, value, passes=passes: passes)
        for sigma, step in ((0.7, 0.7), (2.0, 1.4)):
            sides.clear()
            modes = [mode(1.0, 0.3, information=np.eye(3)), mode(6.0, sigma, information=np.eye(3))]
            made = walk.walk(about, modes, "bias_nm", widened=1.5)
            assert [s[0] for s in sides] == [1.0, 1.0, 6.0, 6.0]
            assert [s[1] for s in sides[:2]] == [-7.0, 13.0]
            beside = [6 - 2 * step, 6 + 2 * step] if passes else [-7.0, 13.0]  # two steps where the walk came by
            assert [s[1] for s in sides[2:]] == pytest.approx(beside)
            assert [s[2] for s in sides] == pytest.approx([step] * 4)
            assert [s[3] for s in sides] == [30 + 1.5 * 14] * 4
            assert made.rise.min() == 0
            assert (made.index, made.shown) == (1, 21.0)


SLOPE = np.array([0.4, 1.0, -1.5])  # of all parameters along the walk of the second
OTHERS = np.array([[0.09, 0.0, 0.05], [0.0, 0.0, 0.0], [0.05, 0.0, 0.25]])
SIGMA, MIDDLE = 1.7, 5.0


@pytest.fixture(scope="module")
def straight():
    """A Gaussian: the rise (x - 5)² / 1.7², the others along a line with one covariance; stops a tenth of it apart."""
    at = MIDDLE + SIGMA * np.linspace(-6, 6, 121)
    value = np.array([2.0, 0.0, 7.0]) + (at - MIDDLE)[:, None] * SLOPE
    value[:, 1] = at
    return Walk(1, value, ((at - MIDDLE) / SIGMA) ** 2, np.broadcast_to(OTHERS, (121, 3, 3)).copy())


def covariance():
    return OTHERS + SIGMA**2 * np.outer(SLOPE, SLOPE)


def test_intervals_of_a_gaussian_are_those_of_its_covariance(straight):
    low, high = straight.interval(3.8415)
    near = 12 / 1200 * SIGMA  # a place of 1201 over twelve sigma
    middle, half = np.array([2.0, 5.0, 7.0]), 1.96 * np.sqrt(np.diag(covariance()))
    assert low == pytest.approx(middle - half, abs=near)
    assert high == pytest.approx(middle + half, abs=near)
    nowhere = Walk(1, straight.value, straight.rise + 9.0, straight.spread)
    assert nowhere.interval(3.8)[0] == pytest.approx(middle, abs=1e-6)


def test_the_mass_of_a_gaussian_is_its_integral_and_the_others_volume(straight):
    volume = math.sqrt(0.09 * 0.25 - 0.05**2)
    # cut where the rise is 14: erf(sqrt(7)) of it, 0.99982
    assert straight.log_mass() == pytest.approx(math.log(SIGMA * math.sqrt(2 * math.pi) * volume), abs=1e-3)
    half = walk._half_volume(np.stack([OTHERS, 4 * OTHERS]), 1)
    assert half == pytest.approx([math.log(volume), math.log(4 * volume)])


def test_a_profile_ends_at_a_rise_of_fourteen(straight):
    at, rise = straight.profile()
    assert rise == pytest.approx(((at - MIDDLE) / SIGMA) ** 2, abs=1e-3)
    assert (at[0], at[-1]) == pytest.approx((MIDDLE - SIGMA * math.sqrt(14), MIDDLE + SIGMA * math.sqrt(14)), abs=0.02)


@pytest.mark.parametrize("widened", [1.0, 2.3])
def test_draws_have_the_covariance_of_the_walk(straight, widened):
    """40000 draws: means to sigma / 200, covariances to 0.7 % of the product of both sigma, four of each."""
    walked = Walk(1, straight.value, straight.rise, straight.spread, 14 * widened)
    drawn = walked.draws(40_000, widened=widened, rng=np.random.default_rng(3))
    want = widened * covariance()
    sigma = np.sqrt(np.diag(want))
    assert np.abs((drawn.mean(0) - [2.0, 5.0, 7.0]) / sigma).max() < 0.02
    # cut at 3.74 sigma: 0.3 % of the variance
    assert np.abs((np.cov(drawn.T) - want) / np.outer(sigma, sigma)).max() < 0.03


def test_lowest_places_come_first():
    rise = np.array([3.0, 1.0, 4.0, 0.0, 0.0, 6.0, 2.0])
    made = Walk(0, np.arange(7.0)[:, None], rise, np.zeros((7, 1, 1)))
    assert made.minima() == [3, 4, 1, 6]


def test_what_lies_within_three_sigma_of_a_walk_is_passed(straight):
    """(2, 5, 7) and its place at 6: beside it by u in the others, u C⁻¹ u below 9."""
    inverse = np.linalg.inv(OTHERS[np.ix_([0, 2], [0, 2])])
    step = np.array([0.2, -0.3])
    length = math.sqrt(step @ inverse @ step)
    here = np.array([2.4, 6.0, 5.5])
    for times, near in ((2.99, True), (3.01, False)):
        off = np.array([step[0], 0.0, step[1]]) * times / length
        assert straight.passes(here + off) == near
    assert not straight.passes(np.array([2.0, 5 + 6.01 * SIGMA, 7.0]))


def test_what_is_held_has_no_spread_and_the_others_that_of_image_and_prior():
    information = np.array([[9.0, 2.0, 1.0], [2.0, 7.0, -1.0], [1.0, -1.0, 4.0]])
    about = SimpleNamespace(prior=SimpleNamespace(sigma=np.array([0.5, 2.0, np.inf])))
    got = walk._held(about, SimpleNamespace(value=np.zeros(3), information=information), 1)
    want = np.linalg.inv(np.array([[9.0 + 4.0, 1.0], [1.0, 4.0]]))
    assert got[np.ix_([0, 2], [0, 2])] == pytest.approx(want)
    assert not got[1].any()
    assert not got[:, 1].any()


def test_outliers_count_linearly_saturated_pixels_where_they_are_too_dark_and_the_prior_by_its_sigma():
    """Noise of 1 e without light: (d - t)² up to 4 of Huber's sigma, then twice that a sigma."""
    huber = walk.Settings().huber
    seen = np.array([[[0.5, huber + 2.0, 9.0, 50.0, 50.0]]])
    image = np.array([[[0.0, 0.0, 0.0, 49.0, 51.0]]])
    floor = np.full(seen.shape, 1.0)
    usable, saturated = np.ones(seen.shape, bool), np.zeros(seen.shape, bool)
    usable[..., 2] = False
    saturated[..., 3:] = True
    data = walk.Data(seen, usable, saturated, floor, np.full(seen.shape, 1e15))
    about = SimpleNamespace(prior=prior())
    got = walk._measured(about, data, np.array([7.0, 9.0, 7.0]), image)
    bent = huber * (2 * (huber + 2) - huber)
    assert got == pytest.approx(0.25 + bent + 1.0 + (6 / 4) ** 2, rel=1e-6)  # the pixel that is too bright: not counted
