"""What the tests on straight models cannot tell: bent valleys to their ends, draws,
weights of outliers, priors.
"""

import math
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import ends, explore, posterior, search, verdict
from characterize.inference.leastsquares import (
    FitImages,
    GaussianPrior,
    SolverSettings,
    fit_levenberg_marquardt,
)
from characterize.inference.posterior import REACH, LocalMode
from characterize.model import PARAMETERS, PLACE, KnownValue
from tests.referees.one_profile import profile

RNG = np.random.default_rng(21)
SHAPES = np.array(
    [[[[0.43, -0.17, 0.28]]], [[[0.05, 0.4, -0.17]]]]
)  # (parameter, frame, y, x)
NOISE = 0.7


def seen(images):
    everywhere = np.ones(images.shape, bool)
    return FitImages(
        images,
        everywhere,
        ~everywhere,
        np.full(images.shape, NOISE**2),
        np.full(images.shape, 1e15),
    )


def bent(x, jacobian):
    """The first parameter acts as e^x: its valley is a parabola in e^x, and far from
    one in x.
    """
    image = math.exp(x[0]) * SHAPES[0] + x[1] * SHAPES[1]
    return image, np.stack(
        [math.exp(x[0]) * SHAPES[0], SHAPES[1]]
    ) if jacobian else None


@pytest.mark.parametrize("top", [4.0, 1.8])
def test_ends_of_a_bent_valley_are_those_of_what_is_straight_in_the_data(top):
    """e^x is known to ± 1.96 sigma, the second amplitude fitted along: x to its
    logarithm; a bound cuts it.
    """
    truth = np.array([1.5, 0.6])
    data = seen(bent(truth, False)[0])
    columns = SHAPES.reshape(2, -1).T
    reach = REACH * NOISE * math.sqrt(np.linalg.inv(columns.T @ columns)[0, 0])
    middle = math.exp(1.5)
    assert 0.5 < reach / middle < 0.7  # ends far from alike
    low, high = math.log(middle - reach), math.log(middle + reach)
    prior = GaussianPrior(
        np.zeros(2), np.full(2, np.inf), np.array([-9.0, -99.0]), np.array([top, 99.0])
    )
    found, better = profile(LocalMode(bent, data, truth, prior), 0)
    assert better is None
    assert not found.parabolic
    # a search ends within 0.08 of the root of the rise, 4 % of it, and goes the rest by
    # proportion
    assert found.low == pytest.approx(low, abs=0.05 * (1.5 - low))
    assert found.high == pytest.approx(min(high, top), abs=0.05 * (high - 1.5))
    for value, rise in zip(found.value, found.rise, strict=True):
        want = ((math.exp(value) - middle) / (reach / REACH)) ** 2
        assert rise == pytest.approx(
            want, abs=0.05 * max(want, 0.4)
        )  # descents end within 0.02


@pytest.mark.parametrize("slope", [0.63, 0.35, 0.28, 0.245])
def test_ends_on_a_flat_tail_are_not_where_a_quarter_of_a_sigma_is_left(slope):
    """slope ln(1 + x) has risen by 1.96 sigma at exp(1.96 sigma / slope) - 1: 7 to 94
    sigma out, where the last quarter
    of a sigma is a fifth to half of the way. Of a last step, 0.15 of it at most, the
    bend misses half the square, 1 %;
    slopes brought up to date by images as much again."""
    across, beside = np.linalg.qr(SHAPES.reshape(2, -1).T)[0].T.reshape(SHAPES.shape)

    def flat(x, jacobian):
        out = max(x[0], -0.99)
        image = 5 + slope * math.log1p(out) * across + x[1] * beside
        return image, np.stack(
            [slope / (1 + out) * across, beside]
        ) if jacobian else None

    mode, want = np.array([0.0, 0.7]), math.expm1(REACH * NOISE / slope)
    prior = GaussianPrior(
        mode, np.full(2, np.inf), np.array([-0.95, -99.0]), np.full(2, 1e9)
    )
    valley = LocalMode(flat, seen(flat(mode, False)[0]), mode, prior)
    found = ends.find_limit(
        valley, 0, 1, REACH, most=2 * REACH * float(valley.sigma[0])
    )  # no farther a step than a search
    assert found.place == pytest.approx(want, rel=0.03)


@pytest.mark.parametrize(("share", "sign"), [(0.03, 1), (0.04, -1)])
def test_without_an_end_in_time_it_is_the_farthest_place_that_was_tried(share, sign):
    """A straight valley, whose end is 1.96 sigma off, in steps of a share of a sigma:
    40 of them are tried.
    """
    truth = np.array([1.5, 0.6])

    def straight(x, jacobian):
        return np.tensordot(x, SHAPES, 1), SHAPES if jacobian else None

    valley = LocalMode(
        straight,
        seen(straight(truth, False)[0]),
        truth,
        GaussianPrior.none(np.zeros(2)),
    )
    sigma = float(valley.sigma[0])
    for begin, way in ((None, 0.0), (truth + sign * 0.3 * valley.along(0), 0.3)):
        found = ends.find_limit(valley, 0, sign, REACH, begin=begin, most=share * sigma)
        assert (found.place - truth[0]) / sigma == pytest.approx(
            sign * min(way + 40 * share, REACH), rel=1e-6
        )
    whole = ends.find_limit(valley, 0, sign, REACH, most=0.5 * sigma)
    assert (whole.place - truth[0]) / sigma == pytest.approx(sign * REACH, rel=1e-6)


@pytest.mark.parametrize("sign", [-1, 1])
def test_steps_to_and_fro_give_the_farthest_place_that_holds(sign):
    """Slopes of no use: the image of any other place is far off, so that only the mode
    holds.
    """
    truth = np.array([1.5, 0.6])

    def torn(x, jacobian):
        return np.tensordot(truth, SHAPES, 1) + 40 * (
            x[0] != truth[0]
        ), SHAPES if jacobian else None

    valley = LocalMode(
        torn, seen(torn(truth, False)[0]), truth, GaussianPrior.none(np.zeros(2))
    )
    assert ends.find_limit(valley, 0, sign, REACH).place == truth[0]


@pytest.mark.parametrize("sign", [-1, 1])
def test_an_end_that_others_have_passed_is_given_up_and_one_beyond_them_is_not(sign):
    """e^x is known to its sigma times 1.96: from 1.5 the ends are logarithms, 0.9 lower
    and 0.5 higher, by three
    images. What reaches a fifth of that farther is worth fewer; what reaches a
    twentieth less changes none."""
    truth, asked = np.array([1.5, 0.6]), []

    def counted(x, jacobian):
        asked.append(jacobian)
        return bent(x, jacobian)

    def ended(reached):
        valley = LocalMode(
            counted, seen(bent(truth, False)[0]), truth, GaussianPrior.none(np.zeros(2))
        )
        asked.clear()
        return ends.find_limit(valley, 0, sign, REACH, beyond=reached), len(asked)

    whole, images = ended(-math.inf)
    way = abs(whole.place - 1.5)
    assert images > 2
    near, same = ended(sign * whole.place - 0.05 * way)
    assert (near.place, same) == (whole.place, images)
    short, few = ended(sign * whole.place + 0.2 * way)
    assert few < images
    assert sign * short.place < sign * whole.place + 0.2 * way


def test_along_a_valley_the_rest_goes_with_the_covariance():
    """One sigma of the first parameter moves it by sigma and raises the parabola by 1;
    nothing cheaper does.
    """
    valley = LocalMode(
        bent,
        seen(bent(np.array([1.5, 0.6]), False)[0]),
        np.array([1.5, 0.6]),
        GaussianPrior.none(np.zeros(2)),
    )
    for i in (0, 1):
        step = valley.along(i)
        assert step[i] == pytest.approx(valley.sigma[i], rel=1e-9)
        information = np.linalg.inv(valley.covariance)
        assert step @ information @ step == pytest.approx(1, rel=1e-9)
        assert (information @ step)[1 - i] == pytest.approx(
            0, abs=1e-9 * abs(information).max()
        )


def fake(sigma, rho, least, common=0.0):
    covariance = np.array([[1, rho], [rho, 1]]) * np.outer(sigma, sigma)
    shared = common * covariance
    return SimpleNamespace(
        sigma=np.array(sigma),
        covariance=covariance,
        least=least,
        calibration=lambda: shared,
    )


def test_a_parameter_that_no_draw_moves_leaves_a_regular_covariance():
    drawn = np.column_stack([RNG.normal(0, 2.0, 50), np.full(50, 3.0)])
    got = explore._covariance(drawn, fake((0.7, 2.1), 0.6, 0.0), np.array([0.31, 5.3]))
    assert got == pytest.approx(
        np.array([[0.31**2, 0.12 * 0.31 * 5.3], [0.12 * 0.31 * 5.3, 5.3**2]]), rel=1e-9
    )


def test_draws_that_follow_the_parabola_take_nothing_from_what_it_knows():
    """Of 96 draws of a known normal law of 23 parameters. Errors of that law weighed by
    the covariance give 23 in the
    mean; by that of the draws alone 23 * 95 / 71 = 31 (of an inverse Wishart law), with
    a fifth of the parabola 28."""
    rng = np.random.default_rng(8)
    mix = rng.normal(size=(23, 23)) + 2 * np.eye(23)
    true = mix @ mix.T
    sigma = np.sqrt(np.diag(true))
    valley = SimpleNamespace(covariance=true, sigma=sigma)
    drawn = [rng.multivariate_normal(np.zeros(23), true, 96) for _ in range(20)]
    weighed = [
        np.trace(np.linalg.solve(explore._covariance(one, valley, sigma), true))
        for one in drawn
    ]
    assert np.mean(weighed) == pytest.approx(23, rel=0.02)


def test_draws_that_leave_the_parabola_say_how_parameters_go_together():
    """Two thousand of correlation -0.8, the parabola says 0.6: a fifth of it is left,
    to 4 sigma of the sample's.
    """
    drawn = np.random.default_rng(9).multivariate_normal(
        [0, 0], [[1, -1.6], [-1.6, 4]], 2000
    )
    got = explore._covariance(drawn, fake((0.7, 2.1), 0.6, 0.0), np.array([0.31, 5.3]))
    want = (0.8 * -0.8 + 0.2 * 0.6) * 0.31 * 5.3
    assert got[0, 1] == pytest.approx(
        want, abs=4 * 0.8 * 0.36 / math.sqrt(2000) * 0.31 * 5.3
    )
    assert np.diag(got) == pytest.approx([0.31**2, 5.3**2])


def test_without_draws_the_predicted_error_is_that_of_the_covariance(monkeypatch):
    """Images 1 + a q of a picture at right angles, a normal about 0.7 with sigma 0.3;
    nothing leaves the bounds.
    """
    bright, picture = np.zeros((1, 2, 4)), np.zeros((1, 2, 4))
    bright[0, 0], picture[0, 1] = 2.0, 1.7

    def problem(model, names, start):
        assert model == "quick"
        return lambda x, jacobian: (bright + x[0] * picture + x[1] * 100, None)

    monkeypatch.setattr(verdict.residual, "residual_phase_problem", problem)
    monkeypatch.setattr(verdict, "models_between_depths", lambda model: model)
    monkeypatch.setattr(verdict, "_SHOWN", 4000)
    wide = np.full(2, np.inf)
    covariance = np.diag([0.09, 4.0])
    prior = GaussianPrior(np.zeros(2), wide, -wide, wide)
    model = SimpleNamespace(quick=lambda: "quick")
    about = SimpleNamespace(
        model=model, names=("bias_nm", "background_e"), prior=prior, start=None
    )
    best = SimpleNamespace(value=np.array([0.7, 5.0]))
    found = SimpleNamespace(draws=np.empty((0, 2)), covariance=covariance, best=best)
    angle = np.arctan2(RNG.normal(0.7, 0.3, 10**6) * 1.7, 2.0) - math.atan2(
        0.7 * 1.7, 2.0
    )
    want = math.sqrt(np.mean(np.sin(angle) ** 2))
    # 4000 draws of a square: 1.1 % of its root
    assert verdict.predicted_error(about, found) == pytest.approx(
        (want, want), rel=0.05
    )
    about.prior = GaussianPrior(
        np.zeros(2), wide, np.array([0.7, -9.0]), np.array([0.7, 9.0])
    )
    assert verdict.predicted_error(about, found) == pytest.approx((0, 0), abs=1e-12)


def test_information_counts_outliers_by_huber_and_satisfied_saturated_pixels_not_at_all():
    """One amplitude; residuals from the value found, weights min(1, h / |r|)."""
    shape, sigma = RNG.uniform(0.5, 1.5, (2, 5, 4)), RNG.uniform(1.5, 3.0, (2, 5, 4))
    image = 90.0 * shape + sigma * RNG.standard_normal(shape.shape)
    image[0, 1, 2] += 25 * sigma[0, 1, 2]
    image[1, 0, 0] -= 12 * sigma[1, 0, 0]
    usable, full = np.ones(shape.shape, bool), np.zeros(shape.shape, bool)
    usable[0, 4, 3], full[1, 2, 2], full[1, 3, 1] = False, True, True
    image[1, 2, 2], image[1, 3, 1] = (
        40.0,
        90 * shape[1, 3, 1] + 4 * sigma[1, 3, 1],
    )  # brighter than it, or not yet
    data = FitImages(image, usable, full, sigma**2, np.full(shape.shape, 1e15))
    found = fit_levenberg_marquardt(
        lambda x, slopes: (x[0] * shape, shape[None] if slopes else None), data, np.array([80.0]),
        settings=SolverSettings(huber=3.0, step_tolerance=1e-9),
    )  # fmt: skip
    left = (image - found.value[0] * shape) / sigma
    weight = np.minimum(1, 3 / np.abs(left)) * usable
    weight[1, 2, 2] = 0.0
    assert left[1, 3, 1] > 3  # a full pixel that the model falls short of counts
    assert found.information[0, 0] == pytest.approx(
        (weight * shape**2 / sigma**2).sum(), rel=1e-6
    )
    assert (weight * shape / sigma * left).sum() == pytest.approx(
        0, abs=1e-4 * (weight * shape / sigma).sum()
    )


def test_metrology_with_an_error_takes_the_place_of_what_is_usual():
    names = ("bias_nm", "height_nm", "distance_um", "background_e")
    known = {
        "bias_nm": KnownValue("bias_nm", 3.1, 0.7),
        "height_nm": KnownValue("height_nm", -4.2, 0.0),
    }
    got = search.prior_of(names, known, b.row(sensor_distance_um=1800.0))
    table = [PARAMETERS[PLACE[name]] for name in names]
    assert got.mean.tolist() == [3.1, -4.2, table[2].start, table[3].start]
    assert got.sigma.tolist() == [0.7, table[1].sigma, table[2].sigma, table[3].sigma]
    assert (got.low[2], got.high[2]) == (
        max(table[2].low, -450.0),
        min(table[2].high, 450.0),
    )
    assert (got.low[0], got.high[0]) == (table[0].low, table[0].high)


def test_chance_of_a_misfit_is_that_of_the_pixels_that_count():
    left = np.array([0.3, 0.0, -1.2, 0.0, 0.7, 2.0, -0.1])
    assert verdict.chance_of(SimpleNamespace(residual_sigma=left)) == pytest.approx(
        math.sqrt(2 / 5)
    )
    assert verdict.chance_of(
        SimpleNamespace(residual_sigma=np.zeros(4))
    ) == pytest.approx(math.sqrt(2))


def test_a_place_above_the_level_is_no_end_while_slopes_do_not_hold():
    """r = (x, 2 (y - x), 0), x at least 1.19: at (1.2, 0.1) all is too high, and what
    is first believed of y leads
    nowhere. Slopes are asked for once more, and the end is that of the ball: x = y =
    1.96."""
    asked = []

    class Believed:
        mode, bottom, least, above = np.zeros(2), np.zeros(3), 0.0, 0.0
        slopes = np.array([[1.0, 0.0], [-2.0, 2.0], [0.0, 0.0]])
        prior = GaussianPrior(
            np.zeros(2), np.full(2, np.inf), np.array([1.19, -9.0]), np.full(2, 9.0)
        )

        def residual(self, x):
            return self.slopes @ x

        def slopes_at(self, x, rest):
            asked.append(x)
            return (
                self.slopes
                if len(asked) > 1
                else np.array([[2.2, 0.0], [1.22, 0.0], [0.0, 1.0]])
            )

    found = ends.find_limit(Believed(), 0, 1, 1.96, begin=np.array([1.2, 0.1]))
    assert len(asked) == 2
    assert found.place == pytest.approx(1.96, rel=1e-6)


@pytest.mark.parametrize(
    ("missed", "left", "onward"), [(0.65, 0.55, 0), (0.55, 0.55, 1), (0.65, 0.65, 1)]
)
def test_slopes_that_missed_more_than_is_left_to_go_are_asked_for_anew(
    missed, left, onward
):
    """r = (x, d) but (0, 0) at the mode, a parameter of steps of 1 at most: the first
    misses d of the images, and by
    the least change that explains it lengthens r = (1, d) with x. What is left to go is
    then goal - √(1 + d²): where
    it is less than 0.6, slopes that missed by more say nothing of it; else a step is
    worth its image."""
    asked = []

    class Torn:
        mode, bottom, least, above, slopes = (
            np.zeros(1),
            np.zeros(2),
            0.0,
            0.0,
            np.array([[1.0], [0.0]]),
        )
        prior = GaussianPrior(
            np.zeros(1), np.full(1, np.inf), np.full(1, -9.0), np.full(1, 9.0)
        )

        def residual(self, x):
            return np.array([x[0], missed * (x[0] > 0)])

        def slopes_at(self, x, rest):
            asked.append(float(x[0]))
            return self.slopes

    length = math.hypot(1, missed)
    found = ends.find_limit(Torn(), 0, 1, length + left, most=1.0)
    assert found.place == pytest.approx(
        math.sqrt((length + left) ** 2 - missed**2), rel=1e-6
    )
    assert asked[0] == pytest.approx(1 + onward * left / length)


def test_a_mode_begins_first_where_it_foretells_what_the_walk_does_and_begins_count_by_a_tenth_of_a_sigma(
    monkeypatch,
):
    """It reaches 2 + 2 · 1: within a twentieth of its sigma of 4.04, not of 4.06; the
    other mode, 3 above, 2.5 + 1 · 2.
    A begin that reaches 0.09 sigma beyond the first one's end is not worth it."""
    valley, other = (SimpleNamespace(mode=np.array([1.0, at]), sigma=np.array([0.5, size]), above=above)
                     for at, size, above in ((2.0, 1.0, 0.0), (2.5, 2.0, 3.0)))  # fmt: skip
    found = object.__new__(ends.LimitSearch)
    found._valleys, found._level = {-1: valley, -2: other, 3: valley}, 4.0
    for reach, first in ((4.04, [(-1, 4.0)]), (4.06, []), (4.49, [(-2, 4.5)])):
        places = [(3, np.array([9.0, reach])), (5, np.array([9.0, 3.1]))]
        found._by = SimpleNamespace(
            outermost=lambda i, sign, level, places=places: places
        )
        begins = found._begins(1, 1)
        assert [(k, round(far, 9)) for k, _, far in begins] == [
            *first,
            (3, reach),
            (5, 3.1),
        ]
        assert [begin is None for _, begin, _ in begins] == [True] * len(first) + [
            False,
            False,
        ]
        assert begins[-2][1] is places[0][1]
    places[0][1][1] = 0.04  # downwards: the mode reaches 0
    assert found._begins(1, -1)[0] == (-1, None, pytest.approx(0.0))


@pytest.mark.parametrize("walked", [True, False])
@pytest.mark.parametrize(
    ("reach", "done", "count"), [(4.04, True, 1), (4.06, True, 2), (4.04, False, 2)]
)
def test_a_begin_is_tried_where_it_promises_more_or_none_before_was_found(
    monkeypatch, walked, reach, done, count
):
    """By a tenth of a sigma of 1 beyond 3.95; from a mode beside a walk in few turns."""
    tried, valley = [], SimpleNamespace(sigma=np.array([0.5, 1.0]))

    def reached(valley, i, sign, goal, **others):
        tried.append(others)
        return SimpleNamespace(place=3.95, done=done or len(tried) > 1)

    monkeypatch.setattr(ends, "find_limit", reached)
    found, place = object.__new__(ends.LimitSearch), np.array([9.0, 4.0])
    found._level, found._by, found._valleys = (
        4.0,
        place if walked else None,
        {-1: valley},
    )
    begins = [(-1, None, 4.2), (2, place, reach), (2, place, 3.96)]
    assert (
        len(found._farthest(((1, 1, begins), {-1: valley, 2: valley})))
        == count
        == len(tried)
    )
    assert [one["promised"] for one in tried] == [4.2, reach][:count]
    assert [one["turns"] for one in tried] == [3 if walked else 40, 40][:count]


class Steep:
    """r = (u, 0.3 w, 3 + 0.15 w²): 9 + u² + 0.99 w² + ..., of which straight models
    know the 0.09 only.
    """

    mode, above, least = np.zeros(2), 0.0, 9.0
    prior = GaussianPrior(
        np.zeros(2), np.full(2, np.inf), np.full(2, -9.0), np.full(2, 9.0)
    )

    def __init__(self):
        self.images = 0
        self.bottom, self.slopes = self.residual(self.mode), self.slopes_at(self.mode)

    def residual(self, x):
        self.images += 1
        return np.array([x[0], 0.3 * x[1], 3 + 0.15 * x[1] ** 2])

    def slopes_at(self, x, rest=None):
        return np.array([[1.0, 0.0], [0.0, 0.3], [0.0, 0.3 * x[1]]])


def test_an_end_that_steps_get_no_nearer_to_is_found_where_it_was_foretold():
    """At 1.96: of steps eleven times too long across it none leads farther. Where more
    was foretold, it is sought.
    """
    valley, begin = Steep(), np.array([1.9, 0.8])
    found = ends.find_limit(valley, 0, 1, 1.96, begin=begin, promised=1.95)
    assert found.done
    assert found.place == pytest.approx(1.96, rel=0.05)
    assert found.place < 1.96  # on the way to a place beside the valley
    sought = Steep()
    ends.find_limit(sought, 0, 1, 1.96, begin=begin, promised=2.3)
    assert valley.images < 10 < sought.images


@pytest.mark.parametrize(
    ("most", "reach"), [((99.0, 99.0), 5.0), ((2.0, 99.0), 2.0), ((99.0, 0.7), 0.7)]
)
def test_a_step_outwards_is_as_long_as_asked_and_no_longer_than_its_limits(most, reach):
    """r = (x, y - x): from (0, 0) as far as x = 5 with y along, five sigma; its length,
    or that of x, may be held.
    """
    here = posterior.ResidualPoint(
        np.zeros(2), np.zeros(2), np.array([[1.0, 0.0], [-1.0, 1.0]])
    )
    step, least, size = ends._outwards(
        here, 0, 1, 25.0, GaussianPrior.none(np.zeros(2)), most
    )
    assert step == pytest.approx([reach, reach])
    assert (least, size) == pytest.approx((0.0, 0.7 if most[1] < 1 else 5.0))


def test_two_ends_make_a_profile_whose_sides_are_not_confused():
    """By hand: points of both sides in order, about the mode; the high end was not
    found.
    """
    low = ends.ConfidenceLimit(-1.9, [(-1.2, 2.6), (-0.4, 0.7)], [], steps=5)
    high = ends.ConfidenceLimit(3.7, [(1.4, 1.1)], [], steps=2, done=False)
    found = ends.join_limits([low, high], 0.3, 0.8, 2.5)
    assert (found.low, found.high, found.found) == (-1.9, 3.7, (True, False))
    assert found.value.tolist() == [-1.2, -0.4, 0.3, 1.4]
    assert found.rise.tolist() == [2.6, 0.7, 0.0, 1.1]
    assert not found.parabolic  # 3.4 / 2 and 2.2 / 2 = 1.1
    assert ends.is_parabolic(-1.9, 2.1, 0.3, 2.0)  # 0.9 and 1.1
    assert not ends.is_parabolic(-1.9, 1.9, 0.3, 2.0)  # 0.8
    assert not ends.is_parabolic(-2.1, 2.1, 0.3, 2.0)  # 1.2


def test_ends_met_at_once_have_the_curve_of_the_parabola():
    """(x - mode)² / sigma² at its 2.5, 1.96 and 1 sigma, whatever was seen on the way
    of one step.
    """
    met = [
        ends.ConfidenceLimit(
            0.3 + side * 1.96 * 0.8, [(9.0, 9.0)], [], steps=1, done=side > 0
        )
        for side in (-1, 1)
    ]
    found = ends.join_limits(met, 0.3, 0.8, 1.96)
    assert found.value == pytest.approx([-1.7, -1.268, -0.5, 0.3, 1.1, 1.868, 2.3])
    assert found.rise == pytest.approx(((found.value - 0.3) / 0.8) ** 2)
    assert found.parabolic
    assert found.found == (False, True)
