"""What a fit leaves open, on models that are sums of given images: every number has a
formula.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from characterize.inference import (
    ends,
    explore,
    leastsquares,
    posterior,
    residual,
    verdict,
)
from characterize.inference.leastsquares import FitImages, GaussianPrior
from characterize.model import MODES, PLACE, prior_rad
from characterize.model.forward import FrameSetting
from characterize.model.parameters import NAMES

REACH = 1.959964
NAMED = ("bias_nm", "height_nm", "background_e")
RNG = np.random.default_rng(11)
DEPTH = np.array([31e3, 22e3, 27e3, 24e3, 29e3])  # not in order
START = np.zeros(len(NAMES))


class Straight:
    """A lens whose frames are ``bright`` plus a picture for each parameter; ``only``
    takes some frames.
    """

    def __init__(self, bright, pictures, depth=DEPTH):
        self.bright, self.pictures = bright, pictures
        self.setting = FrameSetting(
            depth,
            np.zeros((len(depth), 2)),
            np.ones(len(depth)),
            1.7,
            *bright.shape[1:],
        )
        self.groups = [SimpleNamespace(index=np.arange(len(depth)))]

    def quick(self, *_part):
        return self

    def only(self, index):
        return Straight(
            self.bright[index], self.pictures[:, index], self.setting.depth_um[index]
        )

    def images(self, x, names=None):
        values = [x[PLACE[name]] for name in NAMED]
        image = self.bright + np.tensordot(values, self.pictures, 1)
        return image, None if names is None else np.stack(
            [self.pictures[NAMED.index(n)] for n in names]
        )


def task(model, data=None, names=NAMED):
    wide = np.full(len(names), np.inf)
    prior = GaussianPrior(np.zeros(len(names)), wide, -wide, wide)
    return SimpleNamespace(
        model=model, data=data, names=names, prior=prior, start=START
    )


def valley(sigma, rho, least, common=0.0):
    covariance = np.array([[1, rho], [rho, 1]]) * np.outer(sigma, sigma)
    shared = common * covariance
    return SimpleNamespace(
        sigma=np.array(sigma),
        covariance=covariance,
        least=least,
        calibration=lambda: shared,
    )


def test_draws_give_the_correlation_and_intervals_the_sigma():
    drawn = RNG.multivariate_normal([3.0, -1.0], [[4.0, -1.2], [-1.2, 0.9]], 70)
    rho = np.corrcoef(drawn.T)[0, 1]
    got = explore._covariance(
        drawn, valley((0.7, 2.1), 0.6, 0.0), np.array([0.31, 5.3])
    )
    mixed = 0.8 * rho + 0.2 * 0.6
    assert got == pytest.approx(
        np.array([[0.31**2, 0.31 * 5.3 * mixed], [0.31 * 5.3 * mixed, 5.3**2]]),
        rel=1e-6,
    )


def test_predicted_error_is_the_sine_between_the_images():
    """A share a of a picture at right angles turns the image by atan(a q): its rms
    sine; the background is left out.
    """
    bright = np.zeros((5, 6, 7))
    bright[:, 1:3, 1:6] = 3.3
    picture = np.zeros((3, 5, 6, 7))
    picture[0, :, 4, 2:4] = 1.9
    picture[2] = 0.8
    drawn = RNG.normal(0, 1.3, (24, 3))
    drawn[:, 1] = 0
    found = SimpleNamespace(
        draws=drawn, best=SimpleNamespace(value=np.array([0.0, 0.0, 5.0]))
    )
    q2 = (picture[0] ** 2).sum() / (bright**2).sum()
    want = np.sqrt(np.mean(drawn[:, 0] ** 2 * q2 / (1 + drawn[:, 0] ** 2 * q2)))
    assert verdict.predicted_error(
        task(Straight(bright, picture)), found
    ) == pytest.approx((want, want), rel=1e-9)


def test_frames_in_between_lie_half_way_in_inverse_depth():
    model = Straight(np.ones((5, 2, 2)), np.ones((3, 5, 2, 2)))
    got = verdict.models_between_depths(model).setting.depth_um
    rising = np.sort(DEPTH)
    middle = 2 / (1 / rising[1:] + 1 / rising[:-1])
    want = dict(zip(rising, [*middle, middle[-1]], strict=True))
    assert got == pytest.approx([want[d] for d in DEPTH], rel=1e-12)


def test_frames_left_out_are_judged_with_what_the_others_know():
    """Each half of the depths, in order of depth, predicts the other: residual² over
    noise + J C Jᵀ, in numpy.

    One pixel is wrong by 30 sigma: it counts for 36, and in the half that says, for its
    weight at the mode.
    """
    bright, pictures = RNG.uniform(2, 9, (5, 4, 3)), RNG.standard_normal((3, 5, 4, 3))
    sigma = 0.83
    frames = (
        bright
        + np.tensordot([0.4, -0.9, 1.1], pictures, 1)
        + sigma * RNG.standard_normal(bright.shape)
    )
    frames[2, 1, 2] += 30 * sigma
    everywhere = np.ones(bright.shape, bool)
    data = FitImages(
        frames,
        everywhere,
        ~everywhere,
        np.full(bright.shape, sigma**2),
        np.full(bright.shape, 1e15),
    )
    model = Straight(bright, pictures)
    value = np.array([0.4, -0.9, 1.1])
    image = bright + np.tensordot(value, pictures, 1)
    got = verdict.left_out(
        task(model, data), SimpleNamespace(value=value, image=image, slopes=pictures)
    )
    order, total = np.argsort(DEPTH), 0.0
    root = np.sqrt(np.minimum(1, 6 * sigma / np.maximum(np.abs(image - frames), 1e-9)))
    for seen, hidden in ((order[::2], order[1::2]), (order[1::2], order[::2])):
        a, b = (pictures[:, part].reshape(3, -1).T for part in (seen, hidden))
        w = root[seen].ravel()
        covariance = sigma**2 * np.linalg.inv((a.T * w**2) @ a)
        value = np.linalg.lstsq(
            a * w[:, None], (frames - bright)[seen].ravel() * w, rcond=None
        )[0]
        variance = sigma**2 + np.einsum("ni,ij,nj->n", b, covariance, b)
        total += np.minimum(
            ((frames - bright)[hidden].ravel() - b @ value) ** 2 / variance, 36
        ).sum()
    assert got == pytest.approx(
        total / bright.size, rel=1e-4
    )  # a descent ends within 0.02 of the misfit
    four = model.only(np.arange(4)), data.planes(np.arange(4))
    assert np.isfinite(
        verdict.left_out(
            task(*four),
            SimpleNamespace(value=value, image=image[:4], slopes=pictures[:, :4]),
        )
    )
    assert np.isnan(
        verdict.left_out(
            task(model.only(np.arange(3)), data.planes(np.arange(3))), None
        )
    )


def test_modes_of_a_phase_that_nobody_knows_take_information_away():
    """What is left of the information is the inverse of the covariance's own block
    (Schur).
    """
    p = 3
    root = RNG.standard_normal((p + MODES, p + MODES + 4))
    information = root @ root.T
    joint = information + np.diag([0.0] * p + list(prior_rad() ** -2.0))
    want = np.linalg.inv(np.linalg.inv(joint)[:p, :p])
    assert residual._without_modes(information, p) == pytest.approx(want, rel=1e-6)


def test_misfit_of_hidden_frames_is_capped_at_six_sigma():
    image = np.full((1, 2, 3), 40.0)
    data = FitImages(
        image + np.array([[[1.0, -3.0, 80.0], [5.0, 7.0, 9.0]]]),
        np.array([[[True, True, True], [True, False, True]]]),
        np.array([[[False, False, False], [True, False, False]]]),
        np.full(image.shape, 2.3),
        np.full(image.shape, 1.6),
    )
    got = residual._misfit(lambda x, jacobian: (image, None), data, np.zeros(1))
    assert got == pytest.approx((1 + 9 + 81) / (2.3 + 40 / 1.6) + 36, rel=1e-12)


class Bent(Straight):
    """As :class:`Straight`, the first parameter by x + 0.2 x²; other slopes hold at its
    ends than at the mode.
    """

    def images(self, x, names=None):
        values = np.array([x[PLACE[name]] for name in NAMED])
        image = self.bright + np.tensordot(values + 0.2 * values**2, self.pictures, 1)
        slopes = (1 + 0.4 * values)[:, None, None, None] * self.pictures
        return image, None if names is None else np.stack(
            [slopes[NAMED.index(n)] for n in names]
        )


@pytest.mark.parametrize("beside", [1, 8])
def test_profiles_and_draws_are_the_same_bytes_for_any_number_of_threads(
    monkeypatch, beside
):
    monkeypatch.setattr(explore, "_BESIDE", beside)
    monkeypatch.setattr(
        ends, "_STRAIGHT", 0.1
    )  # of 0.6: ends ask for slopes of their own sooner
    model = Bent(30 + RNG.uniform(size=(5, 8, 9)), RNG.normal(size=(3, 5, 8, 9)))
    seen = model.bright + RNG.normal(0, 9.0, model.bright.shape)
    everywhere = np.ones(seen.shape, bool)
    about = task(
        model,
        FitImages(
            seen,
            everywhere,
            ~everywhere,
            np.full(seen.shape, 81.0),
            np.full(seen.shape, 1e15),
        ),
    )
    images = residual.residual_phase_problem(model, NAMED, START)
    mode = leastsquares.fit_levenberg_marquardt(
        images, about.data, np.zeros(3), prior=about.prior
    )
    before, found = torch.get_num_threads(), []
    for count in (1, 3):
        one = posterior.LocalMode(images, about.data, mode.value, about.prior)
        torch.set_num_threads(count)
        try:
            profiles, _ = explore._profiles(about, one, mode, {}, followed=False)
            drawn = posterior.draw_posterior([one], 7)
        finally:
            torch.set_num_threads(before)
        assert not profiles["bias_nm"].parabolic
        assert one.met
        found.append(
            [
                *(
                    part
                    for each in profiles.values()
                    for part in (each.value, each.rise)
                ),
                drawn,
            ]
        )
    assert all(np.array_equal(*pair) for pair in zip(*found, strict=True))
