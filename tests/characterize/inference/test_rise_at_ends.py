"""Where intervals of a lens's frames end: the rise of -2 ln L there, by another
minimiser over all other parameters.

Frames of a lens of 40 um at five depths, with every parameter that is fitted by default
and usual priors; ends by quick
images put right at the fit, rises by the whole model and SciPy's trust region.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import optimize

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import explore, posterior, search
from characterize.inference.arrange import FrameArrangement
from characterize.model import ForwardModel, parameter_vector

JUDGED = (
    "bias_nm",
    "bias_r_nm",
    "distance_um",
    "stage_scale",
    "oblique_astigmatism_rad",
)
HIDDEN = {name: value for name, value in b.VALUES.items() if name != "background_x_e"}


class Counted:
    """Images and Jacobians that any model was asked for."""

    def __init__(self, monkeypatch):
        self.images = self.slopes = 0
        plain = ForwardModel.images

        def images(model, x, wanted=None):
            self.images += 1
            self.slopes += wanted is not None
            return plain(model, x, wanted)

        monkeypatch.setattr(ForwardModel, "images", images)


def fitted():
    data, model = b.near_focus(b.DEPTHS, **HIDDEN)
    found = FrameArrangement(0, 0, (0, 0), 1, np.arange(5), False, True, 0, False, ())
    about = search.SearchTask(model, data, parameter_vector({}), {}, found)
    gain = search.starting_points(about, biases_nm=(0.0,))[0][search.PLACE["log_gain"]]
    begin = parameter_vector(HIDDEN | {"log_gain": float(gain)})
    return about, search.refine_fit(
        about, begin[[search.PLACE[name] for name in about.names]]
    )


def rise(about, mode, i, place, begin):
    """Of the least misfit with one parameter at a place, the noise that of the fit."""
    noise, prior = np.sqrt(about.data.variance(mode.image)), about.prior
    model, others = about.problem(), np.arange(len(mode.value)) != i
    size = np.sqrt(np.diag(mode.covariance))[others]

    def whole(z):
        x = np.full(len(mode.value), place)
        x[others] = z * size
        return x

    def rest(x):
        pull = (x - prior.mean) / prior.sigma
        return np.concatenate(
            [((model(x, False)[0] - about.data.electrons) / noise).ravel(), pull]
        )

    def slopes(z):
        pixels = (model(whole(z), True)[1] / noise).reshape(len(others), -1)
        return np.concatenate([pixels, np.diag(1 / prior.sigma)], 1)[others].T * size

    bounds = prior.low[others] / size, prior.high[others] / size
    inside = np.clip(begin[others] / size, bounds[0] + 1e-6, bounds[1] - 1e-6)
    found = optimize.least_squares(
        lambda z: rest(whole(z)),
        inside,
        slopes,
        bounds,
        xtol=1e-6,
        ftol=1e-6,
        max_nfev=12,
    )
    assert np.abs(rest(mode.value)).max() < 6  # no outliers, whose loss is another
    return 2 * found.cost - float((rest(mode.value) ** 2).sum())


def test_the_misfit_has_risen_by_384_where_intervals_end(monkeypatch):
    """Within 0.4 of 3.84 times chi-square a pixel: quick images are within 0.1 sigma of
    the whole model's out there, of
    which the square's slope, 2 times 1.96, makes 0.4; ends were within 0.2. An end of a
    straight profile takes one
    image or two, a bent one some more and slopes now and then: fewer than 4 and 1 for
    each of the 38.
    """
    about, mode = fitted()
    asked = Counted(monkeypatch)
    found = explore.explore_posterior(about, [mode])
    assert asked.images < 4 * 38
    assert asked.slopes < 38
    assert len(found.profiles) == 19
    assert all(one.found == (True, True) for one in found.profiles.values())
    best, level = found.best, posterior.REACH**2 * max(1.0, found.best.chi2_per_dof)
    for name in JUDGED:
        i, one = about.names.index(name), found.profiles[name]
        along = best.covariance[:, i] / best.covariance[i, i]
        for place in (one.low, one.high):
            got = rise(
                about, best, i, place, best.value + along * (place - best.value[i])
            )
            assert got == pytest.approx(level, abs=0.4), name
