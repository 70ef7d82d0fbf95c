"""Two valleys of one parameter, where misfit, intervals and shares are a formula; the
bent bias of a lens by scipy.
"""

import itertools
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate, optimize, special

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import explore, leastsquares, search, walk
from characterize.inference.arrange import FrameArrangement
from characterize.inference.leastsquares import FitImages, GaussianPrior
from characterize.model import NAMES, PLACE, KnownValue, parameter_vector
from characterize.model.setting import FrameSetting

NAMED = ("bias_nm", "height_nm", "background_e")
DEPTH = np.array([31e3, 22e3, 27e3, 24e3, 29e3])
RNG = np.random.default_rng(5)
BRIGHT, PICTURES = RNG.uniform(3, 9, (5, 4, 3)), RNG.standard_normal((3, 5, 4, 3))
ROOTS, PER_NM, NOISE, HEIGHT = (-9.0, 14.0), 0.011, 0.4, 1.7


class Double:
    """The bias b acts as q (b - b1)(b - b2) on one picture; the height on a second, and
    by a share of q on the first.

    The height acts on the first as well, so that its valley moves along.
    """

    def __init__(self, index=None):
        self.index = index = np.arange(5) if index is None else index
        self.setting = FrameSetting(
            DEPTH[index], np.zeros((len(index), 2)), np.ones(len(index)), 1.7, 4, 3
        )
        self.groups = [SimpleNamespace(index=np.arange(len(index)))]

    def only(self, index):
        return Double(self.index[index])

    def rough(self, tolerance):
        return self

    def quick(self, *_part):
        return self

    def images(self, x, names=None):
        bias, height, level = (x[PLACE[name]] for name in NAMED)
        one, two, three = PICTURES[:, self.index]
        act = PER_NM * (bias - ROOTS[0]) * (bias - ROOTS[1])
        image = (
            BRIGHT[self.index] + act * one + height * (two + 0.3 * one) + level * three
        )
        slope = PER_NM * (2 * bias - sum(ROOTS))
        return image, None if names is None else np.stack(
            [slope * one, two + 0.3 * one, three]
        )


def prior(mean, sigma):
    wide = np.array([26.0, 99.0, 99.0])
    return GaussianPrior(
        np.array([mean, 0.0, 0.0]), np.array([sigma, np.inf, np.inf]), -wide, wide
    )


def task(known):
    return b.given(
        Double(),
        BRIGHT + HEIGHT * (PICTURES[1] + 0.3 * PICTURES[0]),
        NOISE,
        NAMED,
        known,
    )


def at(about, bias):
    """A fit to the end from the valley of a bias."""
    return leastsquares.fit_levenberg_marquardt(
        about.problem(), about.data, np.array([bias, HEIGHT, 0.0]), prior=about.prior
    )


def rise(bias, known):
    """-2 ln posterior, the rest fitted: least squares leave of the first picture what
    the other two do not hold.
    """
    columns = np.stack([PICTURES[1] + 0.3 * PICTURES[0], PICTURES[2]]).reshape(2, -1).T
    first = PICTURES[0].ravel()
    alone = first - columns @ np.linalg.lstsq(columns, first, rcond=None)[0]
    act = PER_NM * (bias - ROOTS[0]) * (bias - ROOTS[1])
    return (
        act**2 * (alone @ alone) / NOISE**2
        + ((bias - known.mean[0]) / known.sigma[0]) ** 2
    )


def test_draws_lie_in_both_valleys_as_often_as_the_density_says():
    known = prior(4.0, 15.0)
    about = task(known)
    found = explore.explore_posterior(about, [at(about, ROOTS[1])])
    fine = np.linspace(-25, 25, 200001)
    density = np.exp(-rise(fine, known) / 2)
    share = density[fine < 2.5].sum() / density.sum()
    left = float((found.draws[:, 0] < 2.5).mean())
    assert left == pytest.approx(
        share, abs=0.05
    )  # drawn evenly in the integral: 1/96; the cubic between stops: 0.03
    spread = found.draws[found.draws[:, 0] < 2.5, 0].std()
    middle = np.average(fine[fine < 2.5], weights=density[fine < 2.5])
    want = np.sqrt(
        np.average((fine[fine < 2.5] - middle) ** 2, weights=density[fine < 2.5])
    )
    assert spread == pytest.approx(want, rel=0.2)


def test_a_walk_between_two_stops_keeps_to_the_lower_of_each_place():
    def stop(bias, merit):
        return SimpleNamespace(
            value=np.array([bias, 1.0, 2.0]),
            merit=merit,
            information=np.diag([4.0, 9.0, 25.0]),
        )

    seen = walk.ProfileScan.of(
        task(prior(0.0, 15.0)),
        [stop(3.0, 8.0), stop(-1.0, 5.0), stop(3.0, 6.0), stop(1.0, 7.0)],
        0,
    )
    assert seen.value[:, 0].tolist() == [-1, 1, 3]
    assert seen.rise.tolist() == [5, 7, 6]
    assert seen.minima() == [0, 2]
    assert seen.spread[1] == pytest.approx(np.diag([0, 1 / 9, 1 / 25]))
    assert seen.passes(np.array([0.0, 1.6, 2.4]))  # 1.8 and 2 sigma
    assert not seen.passes(np.array([0.0, 1.8, 2.4]))  # 2.4 and 2
    assert not seen.passes(np.array([3.1, 1.0, 2.0]))  # beyond its end


@pytest.mark.parametrize(
    ("seen", "light"),
    [(31.0, 24.5), (3.1, 0.4), (-2.9, 5.2), (4.3, -1.7), (-2.2, -3.9), (19.0, 19.001)],
)
def test_misfit_of_a_pixel_is_the_integral_of_its_score(seen, light):
    """(d - t) / v(t) from the image to the count, by quadrature; v stays at its floor
    where there is no light.
    """
    floor, scale = 7.3, 1.9
    one = np.array([[[seen]]])
    data = FitImages(
        one,
        one == one,
        one != one,
        np.full(one.shape, floor),
        np.full(one.shape, scale),
    )
    about = SimpleNamespace(prior=GaussianPrior.none(np.zeros(1)))
    got = walk._measured(about, data, np.zeros(1), np.array([[[light]]]))
    score, ends = (
        lambda t: (seen - t) / (floor + max(t, 0.0) / scale),
        sorted({light, seen, *([0.0] * (light * seen < 0))}),
    )
    parts = [integrate.quad(score, a, b)[0] for a, b in itertools.pairwise(ends)]
    assert got == pytest.approx(2 * abs(sum(parts)), rel=1e-6, abs=1e-12)


def test_the_ends_of_a_lens_s_bent_bias_are_where_another_solver_finds_the_rise():
    """Three depths near focus leave the bias to a third of its prior: scipy fits the
    rest at both ends.
    """
    depths = (560.0, 600.0, 640.0)
    values = {"bias_nm": 15.0, "stage_zero_um": 4.0}
    data, model = b.near_focus(depths, **values)
    electrons = data.electrons
    free = {"bias_nm", "stage_zero_um", "log_gain", "background_e", "crosstalk_px"}
    start = parameter_vector({"crosstalk_px": 0.2})
    held = {
        name: KnownValue(name, float(start[PLACE[name]]))
        for name in NAMES
        if name not in free
    }
    about = search.SearchTask(
        model,
        data,
        start,
        held,
        FrameArrangement(0, 0, (0, 0), 1, np.arange(3), False, True, 0, False, ()),
    )
    place = [about.names.index(name) for name in ("bias_nm", "log_gain")]
    light = model.images(start)[0]
    begin = np.array([start[PLACE[name]] for name in about.names])
    begin[place[1]] = np.log((light * electrons).sum() / (light**2).sum())
    mode = search.refine_fit(about, begin)
    low, high = walk.scan_profile(about, [mode], "bias_nm").interval(3.8415)
    sigma, others = (
        np.sqrt(np.diag(mode.covariance)),
        np.delete(np.arange(len(begin)), place[0]),
    )

    def rise(bias):
        """Of the likelihood of a count 9 above Poisson's, by scipy."""

        def root(step):
            x = mode.value.copy()
            x[others] += step * sigma[others]
            x[place[0]] = bias
            image, pull = (
                about.problem()(x, False)[0],
                (x - about.prior.mean) / about.prior.sigma,
            )
            sign = np.sign(electrons - image)
            return np.append(
                sign * np.sqrt(2 * special.kl_div(electrons + 9, image + 9)), pull
            )

        return (
            2 * optimize.least_squares(root, np.zeros(len(others)), diff_step=1e-2).cost
        )

    least = rise(mode.value[place[0]])
    # a cubic between stops a sigma apart is off by 0.1; their fits end within 0.3 sigma
    # of the least: 0.1
    assert [rise(low[place[0]]) - least, rise(high[place[0]]) - least] == pytest.approx(
        [3.84, 3.84], abs=0.2
    )
