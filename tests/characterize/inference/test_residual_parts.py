"""The phase that physics leaves over, by stand-ins: chi-square, what modes cost
parameters, and when one is kept.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference import leastsquares, residual
from characterize.inference.leastsquares import FitImages, GaussianPrior
from characterize.model import MODES, PLACE, prior_rad

RNG = np.random.default_rng(53)
NAMES = ("height_nm", "bias_nm")


def test_chi_square_is_of_good_pixels_none_of_which_counts_more_than_six_sigma():
    """Of light 50, 80, 20, 10, 40 e with a floor of 6 e² and shot noise of light / 0.8;
    one unusable, one full.
    """
    image = np.array([50.0, 80.0, 20.0, 10.0, 40.0]).reshape(1, 1, 5)
    electrons = image + np.array([9.0, -13.0, 100.0, 7.0, 8.0]).reshape(1, 1, 5)
    usable = np.array([True, True, True, False, True]).reshape(1, 1, 5)
    full = np.array([False, False, False, False, True]).reshape(1, 1, 5)
    data = FitImages(
        electrons, usable, full, np.full_like(image, 6.0), np.full_like(image, 0.8)
    )
    asked = []

    def model(value, jacobian):
        asked.append((value, jacobian))
        return image, None

    want = 81 / (6 + 50 / 0.8) + 169 / (6 + 80 / 0.8) + 36
    assert residual._misfit(model, data, "value") == pytest.approx(want, rel=1e-12)
    assert asked == [("value", False)]


def test_unknown_modes_take_from_the_parameters_what_marginals_say():
    """The inverse of the parameters' block of the covariance, the modes held by their
    prior.
    """
    p = 3
    slopes = RNG.normal(size=(40 + MODES, p + MODES))
    information = slopes.T @ slopes
    whole = information.copy()
    whole[np.arange(p, p + MODES), np.arange(p, p + MODES)] += 1 / prior_rad() ** 2
    want = np.linalg.inv(np.linalg.inv(whole)[:p, :p])
    got = residual._without_modes(information, p)
    assert got == pytest.approx(
        want, rel=1e-6, abs=1e-6 * abs(want).max()
    )  # inverses of condition 1e3 and less


def test_modes_stand_after_the_parameters_with_no_bounds():
    prior = GaussianPrior(
        np.array([1.5, -2.0]),
        np.array([0.4, np.inf]),
        np.array([-3.0, -np.inf]),
        np.array([5.0, 7.0]),
    )
    joint = residual._with_modes(prior)
    assert joint.mean.tolist() == [1.5, -2.0] + [0] * MODES
    assert joint.sigma.tolist() == [0.4, np.inf, *prior_rad()]
    assert joint.low.tolist() == [-3.0, -np.inf] + [-np.inf] * MODES
    assert joint.high.tolist() == [5.0, 7.0] + [np.inf] * MODES


def test_values_go_to_their_places_and_the_rest_to_the_modes():
    base = np.arange(len(PLACE)) + 0.5

    class Model(SimpleNamespace):
        def images(self, x, wanted):
            return x, self.modes, wanted

        def with_residual(self, modes, basis):
            return Model(modes=modes)

    of = residual.residual_phase_problem(Model(modes=None), NAMES, base)
    want = base.copy()
    want[PLACE["height_nm"]], want[PLACE["bias_nm"]] = -7.0, 4.0
    x, modes, wanted = of(np.array([-7.0, 4.0]), True)
    assert np.array_equal(x, want)
    assert (modes, wanted) == (None, [*NAMES])
    x, modes, wanted = of(np.array([-7.0, 4.0, 0.1, 0.2, 0.3]), True)
    assert np.array_equal(x, want)
    assert modes.tolist() == [0.1, 0.2, 0.3]
    assert wanted == [*NAMES, "residual_0", "residual_1", "residual_2"]
    assert of(np.array([-7.0, 4.0, 0.1]), False)[2] is None
    assert base[PLACE["bias_nm"]] == PLACE["bias_nm"] + 0.5  # what was given stays


@pytest.mark.parametrize(
    ("before", "after", "kept"),
    [
        (6000.0, 5750.0, False),
        (6000.0, 5650.0, True),
        (30000.0, 29405.0, False),
        (30000.0, 29300.0, True),
    ],
)
def test_a_phase_is_kept_where_unseen_frames_gain_four_sigma_and_a_fiftieth(
    monkeypatch, before, after, kept
):
    """4 frames of 750 good pixels: 6000 has to fall by 4 sqrt(2 · 3000) = 310, 30000 by
    its fiftieth, 600.

    By depth they are frames 1, 2, 0 and 3: the first and the third say what the others
    are judged by, and back.
    """
    pixels = np.ones((4, 30, 26), bool)
    usable, full = pixels.copy(), ~pixels
    usable[:, 0, :], full[:, 1, 0:4] = False, True
    data = FitImages(1.0 * pixels, usable, full, 1.0 * pixels, 1.0 * pixels)
    assert (usable & ~full).sum() == 3000
    model = SimpleNamespace(
        setting=SimpleNamespace(depth_um=np.array([3.0, 1.0, 2.0, 4.0]))
    )
    p, asked, split = len(NAMES), [], []
    model.only = lambda index: split.append(index.tolist()) or model
    value = RNG.normal(size=p + MODES)
    slopes = RNG.normal(size=(60 + MODES, p + MODES))
    made = _solution(value, slopes.T @ slopes)

    def fit(images, part, begin, *, prior, settings):
        asked.append((len(begin), settings.finish))
        return made if settings.finish else SimpleNamespace(value=begin)

    told = iter([before / 3, after / 4, 2 * before / 3, 3 * after / 4])
    monkeypatch.setattr(
        residual, "residual_phase_problem", lambda here, names, base: None
    )
    monkeypatch.setattr(residual, "_misfit", lambda images, rest, x: next(told))
    monkeypatch.setattr(leastsquares, "fit_levenberg_marquardt", fit)
    start = np.array([2.0, -1.0])
    got = residual.fit_residual_phase(
        model, data, NAMES, start, base=start, prior=GaussianPrior.none(start)
    )
    assert asked == [(p, False), (p + MODES, False)] * 2 + [(p + MODES, True)] * kept
    assert split == [[0, 1], [2, 3], [2, 3], [0, 1]]
    if not kept:
        assert got is None
        return
    assert (got.before, got.after) == (
        pytest.approx(before / 3000),
        pytest.approx(after / 3000),
    )
    assert np.array_equal(got.solution.value, value[:p])
    assert np.array_equal(got.modes, value[p:])
    assert got.rms_rad == pytest.approx(np.sqrt((value[p:] ** 2).sum()), rel=1e-12)
    assert np.array_equal(got.solution.covariance, made.covariance[:p, :p])
    assert np.array_equal(
        got.solution.information, residual._without_modes(made.information, p)
    )
    assert np.array_equal(got.solution.slopes, made.slopes[:p])
    assert np.array_equal(got.solution.beyond, made.beyond[:p])


def test_three_frames_are_too_few_to_leave_any_out():
    data = SimpleNamespace(electrons=np.zeros((3, 5, 6)))
    assert (
        residual.fit_residual_phase(None, data, NAMES, None, base=None, prior=None)
        is None
    )


def _solution(value, information):
    """All fields by name; those that are cut to the parameters tell which of them they
    are of.
    """
    told = {field.name: None for field in dataclasses.fields(leastsquares.FitSolution)}
    size = len(value)
    told |= {
        "value": value,
        "covariance": RNG.normal(size=(size, size)),
        "information": information,
    }
    told |= {"beyond": np.arange(size), "slopes": np.arange(size) + 0.5}
    return leastsquares.FitSolution(**told)
