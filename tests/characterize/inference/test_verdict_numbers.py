"""What a verdict counts: intervals over 3.92, products of neighbouring frames over
their own scatter.
"""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.captures import Gain
from characterize.inference import verdict
from characterize.inference.asbuilt import AsBuilt
from characterize.inference.missing import Unstated
from characterize.model import PARAMETERS, PLACE
from tests.characterize.inference.test_explore import Straight, task

RNG = np.random.default_rng(41)
NOTHING = Unstated.none(4)


def rows_of(names):
    return [PARAMETERS[PLACE[name]] for name in names]


def test_a_cause_is_known_to_its_interval_over_3_92():
    """Known where that is within the scale of the parameter, wherever it lies; else
    from the prior, or only loosely.
    """
    scale = {
        name: PARAMETERS[PLACE[name]].scale
        for name in ("bias_nm", "height_nm", "index")
    }
    names = ("bias_nm", "log_gain", "height_nm", "index")
    sigma = np.array(
        [0.5 * scale["bias_nm"], 9.0, 1.1 * scale["height_nm"], 1.2 * scale["index"]]
    )
    middle = np.array([37.0 * scale["bias_nm"], 2.0, -61.0 * scale["height_nm"], 0.3])
    said = verdict.process_verdict(
        rows_of(names),
        middle - 1.96 * sigma,
        middle + 1.96 * sigma,
        np.array([0.1, 0.1, 0.69, 0.71]),
        NOTHING,
    )
    assert said.startswith(f"the process is known to bias_nm +- {sigma[0]:.2g};")
    low, high = middle[2] - 1.96 * sigma[2], middle[2] + 1.96 * sigma[2]
    assert f"loosely: height_nm {low:.3g} to {high:.3g}" in said
    assert said.endswith("from prior knowledge only: index")
    assert "log_gain" not in said
    sigma[2] = 0.98 * scale["height_nm"]
    said = verdict.process_verdict(
        rows_of(names),
        middle - 1.96 * sigma,
        middle + 1.96 * sigma,
        np.array([0.1, 0.1, 0.8, 0.7]),
        NOTHING,
    )
    assert f"height_nm +- {sigma[2]:.2g}" in said
    assert "loosely: index" in said


@pytest.mark.parametrize("frames", [2, 5])
def test_products_of_neighbouring_frames_scatter_by_one_about_nothing(frames):
    """Unit noise a pixel with shares of dark and flat that all frames have in common;
    600 draws: 0.041 and 0.029.
    """
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
    want = [
        (a * b).sum() / np.sqrt(n)
        for a, b, n in zip(one, other, (60, 70, 80), strict=True)
    ]
    assert verdict._together(one, other) == pytest.approx(want, rel=1e-12)


def test_an_interval_is_that_of_the_profile_or_1_96_sigma_and_draws_follow_the_covariance():
    covariance = np.array([[0.09, -0.06], [-0.06, 0.25]])
    names = ("bias_nm", "distance_um")
    fitted = SimpleNamespace(
        design=b.row(sensor_distance_um=1700.0),
        names=names, value=np.array([7.0, 0.4]), covariance=covariance, low=np.array([]), high=np.array([]),
        draws=np.empty((0, 2)), sigma=AsBuilt.sigma.fget(SimpleNamespace(covariance=covariance)),
    )  # fmt: skip
    assert fitted.sigma == pytest.approx([0.3, 0.5])
    assert AsBuilt.correlation.fget(fitted)[0, 1] == pytest.approx(-0.4)
    reach = stats.norm.ppf(0.975) * 0.5
    assert AsBuilt.interval(fitted, "distance_um") == pytest.approx(
        (0.4 - reach, 0.4 + reach), rel=1e-6
    )
    drawn = AsBuilt.samples(fitted, 40_000, seed=3)
    assert drawn.mean(0) == pytest.approx(
        fitted.value, abs=0.01
    )  # four sigma of the mean
    assert np.cov(drawn.T) == pytest.approx(
        covariance, abs=0.007
    )  # four sigma: 0.25 sqrt(2 / 40000) x 4
    fitted.low, fitted.high = np.array([6.1, -0.2]), np.array([7.3, 1.9])
    assert AsBuilt.interval(fitted, "distance_um") == (-0.2, 1.9)
    fitted.draws = np.arange(14.0).reshape(7, 2)
    again = AsBuilt.samples(fitted, 16, seed=3)
    _, counts = np.unique(again[:, 0], return_counts=True)
    assert sorted(counts) == [2, 2, 2, 2, 2, 3, 3]


@pytest.mark.parametrize("skewness", [0.085, 0.115])
def test_light_is_too_little_where_counts_of_the_brightest_pixel_are_skew_by_a_tenth(
    skewness,
):
    """Intervals take counts for Gaussian; a Poisson count of mean m has skewness
    1/sqrt(m): a tenth at 100.
    """
    peak = skewness**-2.0
    assert stats.poisson(peak).stats("s") == pytest.approx(skewness, rel=1e-9)
    image = np.full(
        (2, 7, 8), 23.0
    )  # background of the frames, which is no light of the lens
    image[1, 4, 3] += peak
    one = SimpleNamespace(converged=True, image=image, residual_sigma=np.ones(image.shape), chi2_per_dof=1.0,
                          value=np.zeros(2))  # fmt: skip
    found = verdict.problems(("bias_nm", "coma_x_rad"), one, Gain(1.3, 0.01, 2.0))
    assert [words.startswith("too little light") for words in found] == [True] * (
        skewness > 0.1
    )


@pytest.mark.parametrize(("waves", "refused"), [(0.6, False), (1.3, True)])
def test_a_wave_front_that_leaves_less_than_half_the_peak_is_no_tolerance(
    waves, refused
):
    """Maréchal: a phase of w rad rms leaves exp(-w²) of the peak: 70 % at 0.6 rad, 18 %
    at 1.3 rad.
    """
    one = SimpleNamespace(converged=True, image=900 * np.eye(9)[None], residual_sigma=np.ones((1, 9, 9)),
                          chi2_per_dof=1.0, value=waves * np.array([0.6, 9.0, -0.8]))  # fmt: skip
    found = verdict.problems(
        ("coma_x_rad", "bias_nm", "spherical_rad"), one, Gain(1.3, 0.01, 2.0)
    )
    assert [words.startswith("aberrations of") for words in found] == [True] * refused
    assert (np.exp(-(waves**2)) < 0.5) == refused


def finished(residual_sigma, **more):
    told = {
        "converged": True,
        "image": 900 * (residual_sigma != 9),
        "residual_sigma": residual_sigma,
    }
    return SimpleNamespace(
        **(told | {"chi2_per_dof": 1.0, "value": np.zeros(2)} | more)
    )


@pytest.mark.parametrize(
    ("size", "count", "told"), [(6.4, 21, True), (6.4, 19, False), (5.6, 40, False)]
)
def test_a_ghost_is_two_hundredths_of_the_pixels_beyond_six_sigma(size, count, told):
    """Of 1000, on either side; a normal residual is there once in five hundred million."""
    assert stats.norm.sf(6) * 2 < 1 / 5e8
    residual_sigma = np.zeros((2, 20, 25))
    residual_sigma.flat[: 3 * count : 3] = size * (-1.0) ** np.arange(count)
    one = finished(residual_sigma, image=900 * np.eye(25)[None])
    found = verdict.problems(("bias_nm", "coma_x_rad"), one, Gain(1.3, 0.01, 2.0))
    assert any("beyond 6 sigma: a ghost" in words for words in found) is told


def test_the_frame_that_is_explained_worst_has_the_most_squares_in_all():
    """Frame 1 with 7 times 4 has 112; frame 0 one of 10, whose cube is more; frame 2
    more pixels, which are less.
    """
    residual_sigma = np.full((3, 6, 8), 0.1)
    residual_sigma[0, 2, 3], residual_sigma[1, 4, :7], residual_sigma[2] = (
        10.0,
        -4.0,
        1.3,
    )
    one = finished(residual_sigma, chi2_per_dof=2.71, image=900 * np.eye(8)[None])
    found = verdict.problems(("bias_nm", "coma_x_rad"), one, Gain(1.3, 0.01, 2.0))
    assert "chi-square per degree of freedom is 2.71, not 1" in found[0]
    assert "(worst: frame 1)" in found[0]


def by_pixels(residual, dark, flat):
    """Sigma by which frames go together, one pixel after the other with its whole
    covariance matrix.
    """
    total = expected = variance = 0.0
    for y, x in np.ndindex(residual.shape[1:]):
        own, some = residual[:, y, x], residual[:, y, x] != 0
        root = np.sqrt(1 + (flat[:, y, x] * some) ** 2)
        r, d, f = own / root, dark[:, y, x] * some / root, flat[:, y, x] * some / root
        k = np.outer(d, d) + np.outer(f, f)
        k[np.diag_indices(len(k))] = some
        a = (np.eye(len(k), k=1) + np.eye(len(k), k=-1)) / 2
        total, expected = total + r @ a @ r, expected + np.trace(a @ k)
        variance += 2 * np.trace(a @ k @ a @ k)
    return (total - expected) / np.sqrt(variance)


def test_sigma_of_frames_that_go_together_counts_shares_of_seen_pixels_only():
    """A third of the pixels are masked; shares of dark and flat differ from pixel to
    pixel and are taken off.
    """
    shape = (4, 11, 9)
    dark, flat = RNG.uniform(0.4, 0.8, shape), RNG.uniform(0.5, 1.3, shape)
    residual = RNG.standard_normal(shape) + 1.6 * RNG.standard_normal(shape[1:])
    residual[RNG.uniform(size=shape) < 0.35] = 0.0
    want = by_pixels(np.clip(residual, -6, 6), dark, flat)
    assert want > 5
    found = [
        words
        for words in verdict.structure(residual, np.stack([dark, flat]))
        if "frame to frame" in words
    ]
    assert f"({want:.1f} sigma)" in found[0]


@pytest.mark.parametrize("sign", [1, -1])
def test_no_pixel_counts_for_more_than_six_sigma_beside_its_neighbour(sign):
    """One pair of 30 and 6.5 is 36 over the root of 16 x 24 pairs, 1.8 sigma, not 9.9;
    a square of nine has six.
    """
    residual = np.where(np.indices((17, 24)).sum(0) % 2, 1e-3, -1e-3)[None]
    residual[0, 4, 5], residual[0, 5, 5] = 30.0 * sign, 6.5 * sign
    assert not any("pixel to pixel" in words for words in verdict.structure(residual))
    residual[0, 4:7, 9:12] = 30.0 * sign
    found = next(
        words for words in verdict.structure(residual) if "pixel to pixel" in words
    )
    assert (
        f"({7 * 36 / np.sqrt(16 * 24):.1f} sigma)" in found
    )  # pairs with a thousandth in them: 0.036 at most


@pytest.mark.parametrize("sign", [1, -1])
def test_a_darker_frame_is_told_as_a_brighter_one(sign):
    residual = np.tile(np.array([[1.0, -1.0], [-1.0, 1.0]]), (3, 5, 6))
    residual[2] += 0.47 * sign  # of 120 pixels: 5.15
    assert any(
        "frame 2 is brighter or darker than the model by 5.1 sigma" in w
        for w in verdict.structure(residual)
    )


def test_what_moves_a_parameter_most_in_its_own_errors_is_named_first_and_three_are():
    """0.9, 6, 1.5, 3 and 0.2 errors at most, of which the second and the fourth are the
    smallest numbers.
    """
    names, sigma = ("bias_nm", "coma_x_rad"), np.array([0.8, 0.01])
    errors = np.array([[0.9, 0.3], [0.0, 6.0], [1.5, 0.0], [0.0, 3.0], [0.2, 0.1]])
    causes = (
        "a plate of glass",
        "an oblique saddle",
        "uneven light",
        "a ghost",
        "an echo",
    )
    by_cause = errors * sigma
    unstated = Unstated(
        causes,
        by_cause,
        np.diag((by_cause**2).sum(0)) * [[9.0], [4.0]],
        np.zeros((2, 2)),
    )
    said = verdict.process_verdict(
        rows_of(names), -1.96 * sigma, 1.96 * sigma, np.full(2, 0.1), unstated
    )
    assert "that is without oblique saddle, ghost, uneven light: bias_nm" in said


def test_expected_error_without_draws_is_that_of_the_covariance(monkeypatch):
    """To first order in C: root of tr C G over the image's length, G the products of
    pictures at right angles to it.
    """
    bright, pictures = RNG.uniform(2, 9, (5, 6, 7)), RNG.normal(size=(3, 5, 6, 7))
    pictures[1] += 0.7 * pictures[0]
    pictures[2] = 0.8
    value = np.array([0.31, -0.12, 5.0])
    root = np.array([[0.02, 0.0, 0.0], [-0.03, 0.012, 0.0], [0.0, 0.0, 1.7]])
    found = SimpleNamespace(
        draws=np.empty((0, 3)),
        covariance=root @ root.T,
        best=SimpleNamespace(value=value),
    )
    image = (bright + np.tensordot(value[:2], pictures[:2], 1)).ravel()
    flat = pictures[:2].reshape(2, -1)
    across = flat - np.outer(flat @ image, image) / (image @ image)
    want = np.sqrt(
        np.trace(found.covariance[:2, :2] @ (across @ across.T)) / (image @ image)
    )
    monkeypatch.setattr(verdict, "_SHOWN", 2000)
    got = verdict.predicted_error(task(Straight(bright, pictures)), found)
    assert got == pytest.approx(
        (want, want), rel=0.06
    )  # of a mean of 2000 squares: three times 1.6 %, and C's square


@pytest.mark.parametrize(
    ("chi2", "pixels", "gain_sigma_e", "said"),
    [
        (0.84, 9000, 0.0, True),  # 15 % below, as 15 % above is no longer noise
        (0.86, 9000, 0.0, False),
        (0.72, 450, 0.0, True),  # four of sqrt(2 / 450) are 0.267
        (0.72, 350, 0.0, False),
        (0.84, 9000, 0.1, False),  # 0.1 of 2.1 e a count, four times: 0.19
        (0.49, 9000, 0.9, True),
    ],
)
def test_frames_with_less_noise_than_stated_are_told(chi2, pixels, gain_sigma_e, said):
    """Averages of frames, or a gain of counts 16 times as large: chi-square 0.11 was
    passed over.
    """
    solution = SimpleNamespace(chi2_per_dof=chi2, residual_sigma=np.ones(pixels))
    words = verdict.quiet(solution, Gain(2.1, gain_sigma_e, 2.7), whole=True)
    assert len(words) == said
    assert not said or f"is {chi2:.2f}, below 1" in words[0]
    assert not verdict.quiet(
        solution, Gain(2.1, gain_sigma_e, 2.7, known=False), whole=True
    )


@pytest.mark.parametrize(
    ("read_noise_e", "coarse"), [(0.0, True), (9.2, True), (9.4, False)]
)
def test_counts_that_are_coarser_than_noise_hides_are_told_whatever_chi_square_is(
    read_noise_e, coarse
):
    """31 electrons a count: 9.3 of noise are 0.3 of a count. Where nobody says how much
    there is, nothing is told.
    """
    solution = SimpleNamespace(residual_sigma=np.ones((4, 9, 11)), chi2_per_dof=0.99)
    words = [
        verdict.quiet(solution, Gain(31.0, 0.4, read_noise_e), whole=whole)
        for whole in (True, False)
    ]
    for said, end in zip(
        words, ("fitted as rounded counts", "of merged exposures"), strict=True
    ):
        assert [
            one.startswith("counts are 31 electrons apart and noise") and end in one
            for one in said
        ] == [True] * coarse
    assert not verdict.quiet(
        solution, Gain(31.0, 0.4, read_noise_e, read_known=False), whole=True
    )
