"""What a verdict counts: intervals over 3.92, products of neighbouring frames over their own scatter."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from characterize.captures import Gain
from characterize.inference import verdict
from characterize.inference.asbuilt import AsBuilt
from characterize.inference.missing import Unstated
from characterize.model import PARAMETERS, PLACE

RNG = np.random.default_rng(41)
NOTHING = Unstated.none(4)


def test_a_cause_is_known_to_its_interval_over_3_92():
    """Known where that is within the scale of the parameter, wherever it lies; else from the prior, or only loosely."""
    scale = {name: PARAMETERS[PLACE[name]].scale for name in ("bias_nm", "height_nm", "index")}
    names = ("bias_nm", "log_gain", "height_nm", "index")
    sigma = np.array([0.5 * scale["bias_nm"], 9.0, 1.1 * scale["height_nm"], 1.2 * scale["index"]])
    middle = np.array([37.0 * scale["bias_nm"], 2.0, -61.0 * scale["height_nm"], 0.3])
    said = verdict.process_verdict(
        names, middle - 1.96 * sigma, middle + 1.96 * sigma, np.array([0.1, 0.1, 0.69, 0.71]), NOTHING
    )
    assert said.startswith(f"the process is known to bias_nm +- {sigma[0]:.2g};")
    low, high = middle[2] - 1.96 * sigma[2], middle[2] + 1.96 * sigma[2]
    assert f"loosely: height_nm {low:.3g} to {high:.3g}" in said
    assert said.endswith("from prior knowledge only: index")
    assert "log_gain" not in said
    sigma[2] = 0.98 * scale["height_nm"]
    said = verdict.process_verdict(
        names, middle - 1.96 * sigma, middle + 1.96 * sigma, np.array([0.1, 0.1, 0.8, 0.7]), NOTHING
    )
    assert f"height_nm +- {sigma[2]:.2g}" in said
    assert "loosely: index" in said


@pytest.mark.parametrize("frames", [2, 5])
def test_products_of_neighbouring_frames_scatter_by_one_about_nothing(frames):
    """Unit noise a pixel with shares of dark and flat that all frames have in common; 600 draws: 0.041 and 0.029."""
    shape = (frames, 9, 11)
    dark, flat = RNG.uniform(0.2, 0.5, shape), RNG.uniform(0.1, 0.4, shape)
    masked = RNG.uniform(size=shape) < 0.1
    found = []
    for _ in range(600):
        one, two = RNG.standard_normal((2, 1, 9, 11))
        own = np.sqrt(1 - dark**2 - flat**2) * RNG.standard_normal(shape)
        found.append(verdict._from_frame_to_frame(np.where(masked, 0.0, own + dark * one + flat * two),
                                                  dark * ~masked, flat * ~masked))  # fmt: skip
    assert np.mean(found) == pytest.approx(0, abs=0.2)
    assert np.std(found) == pytest.approx(1, abs=0.13)


def test_products_of_neighbouring_pixels_are_over_the_root_of_their_number():
    one, other = RNG.standard_normal((2, 3, 8, 10))
    one[0, :2], other[1, 3] = 0.0, 0.0
    want = [(a * b).sum() / np.sqrt(n) for a, b, n in zip(one, other, (60, 70, 80), strict=True)]
    assert verdict._together(one, other) == pytest.approx(want, rel=1e-12)


def test_an_interval_is_that_of_the_profile_or_1_96_sigma_and_draws_follow_the_covariance():
    covariance = np.array([[0.09, -0.06], [-0.06, 0.25]])
    names = ("bias_nm", "distance_um")
    fitted = SimpleNamespace(
        names=names, value=np.array([7.0, 0.4]), covariance=covariance, low=np.array([]), high=np.array([]),
        draws=np.empty((0, 2)), sigma=AsBuilt.sigma.fget(SimpleNamespace(covariance=covariance)),
    )  # fmt: skip
    assert fitted.sigma == pytest.approx([0.3, 0.5])
    assert AsBuilt.correlation.fget(fitted)[0, 1] == pytest.approx(-0.4)
    reach = stats.norm.ppf(0.975) * 0.5
    assert AsBuilt.interval(fitted, "distance_um") == pytest.approx((0.4 - reach, 0.4 + reach), rel=1e-6)
    drawn = AsBuilt.samples(fitted, 40_000, seed=3)
    assert drawn.mean(0) == pytest.approx(fitted.value, abs=0.01)  # four sigma of the mean
    assert np.cov(drawn.T) == pytest.approx(covariance, abs=0.007)  # four sigma: 0.25 sqrt(2 / 40000) x 4
    fitted.low, fitted.high = np.array([6.1, -0.2]), np.array([7.3, 1.9])
    assert AsBuilt.interval(fitted, "distance_um") == (-0.2, 1.9)
    fitted.draws = np.arange(14.0).reshape(7, 2)
    again = AsBuilt.samples(fitted, 16, seed=3)
    _, counts = np.unique(again[:, 0], return_counts=True)
    assert sorted(counts) == [2, 2, 2, 2, 2, 3, 3]


@pytest.mark.parametrize("skewness", [0.085, 0.115])
def test_light_is_too_little_where_counts_of_the_brightest_pixel_are_skew_by_a_tenth(skewness):
    """Intervals take counts for Gaussian; a Poisson count of mean m has skewness 1/sqrt(m): a tenth at 100."""
    peak = skewness**-2.0
    assert stats.poisson(peak).stats("s") == pytest.approx(skewness, rel=1e-9)
    image = np.full((2, 7, 8), 23.0)  # background of the frames, which is no light of the lens
    image[1, 4, 3] += peak
    one = SimpleNamespace(converged=True, image=image, residual_sigma=np.ones(image.shape), chi2_per_dof=1.0,
                          value=np.zeros(2))  # fmt: skip
    found = verdict.problems(("bias_nm", "coma_x_rad"), one, Gain(1.3, 0.01, 2.0))
    assert [words.startswith("too little light") for words in found] == [True] * (skewness > 0.1)


@pytest.mark.parametrize(("waves", "refused"), [(0.6, False), (1.3, True)])
def test_a_wave_front_that_leaves_less_than_half_the_peak_is_no_tolerance(waves, refused):
    """Maréchal: a phase of w rad rms leaves exp(-w²) of the peak: 70 % at 0.6 rad, 18 % at 1.3 rad."""
    one = SimpleNamespace(converged=True, image=900 * np.eye(9)[None], residual_sigma=np.ones((1, 9, 9)),
                          chi2_per_dof=1.0, value=waves * np.array([0.6, 9.0, -0.8]))  # fmt: skip
    found = verdict.problems(("coma_x_rad", "bias_nm", "spherical_rad"), one, Gain(1.3, 0.01, 2.0))
    assert [words.startswith("aberrations of") for words in found] == [True] * refused
    assert (np.exp(-(waves**2)) < 0.5) == refused
