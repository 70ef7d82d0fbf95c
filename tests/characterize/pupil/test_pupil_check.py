"""What a pupil fit is judged by, against formulas: agreement, noise of pixels."""

import math

import numpy as np
import pytest

from characterize.inference.leastsquares import FitImages
from characterize.pupil.score import measure_agreement, pixel_noise_e

RNG = np.random.default_rng(9)


def data(images, usable=None, saturated=None):
    everywhere = np.ones(images.shape, bool)
    return FitImages(
        images,
        everywhere if usable is None else usable,
        ~everywhere if saturated is None else saturated,
        np.full(images.shape, 4.0),
        np.ones(images.shape),
    )


def test_agreement_counts_light_above_the_background_in_pixels_that_count():
    seen = RNG.uniform(20, 90, (3, 6, 7))
    told = RNG.uniform(20, 90, (3, 6, 7))
    usable = RNG.uniform(size=seen.shape) > 0.2
    saturated = RNG.uniform(size=seen.shape) > 0.9
    got = measure_agreement(
        told, data(seen, usable, saturated), np.full_like(seen, 17.0)
    )
    keep = usable & ~saturated
    a, b = told[keep], seen[keep]
    centred = (
        (a - a.mean())
        @ (b - b.mean())
        / math.sqrt(((a - a.mean()) ** 2).sum() * ((b - b.mean()) ** 2).sum())
    )
    assert got.ncc == pytest.approx(centred, rel=1e-12)
    assert got.nrmse == pytest.approx(
        math.sqrt(((a - b) ** 2).sum() / ((b - 17.0) ** 2).sum()), rel=1e-12
    )
    planes = [np.corrcoef(told[k][keep[k]], seen[k][keep[k]])[0, 1] for k in range(3)]
    assert got.plane_ncc == pytest.approx(np.mean(planes), rel=1e-12)


def test_what_noise_explains_is_not_missed():
    """Frames that are the same but for noise of 3: a prediction that errs by noise
    alone misses nothing.
    """
    light = np.zeros((9, 30, 32))
    light[:, 12:15, 9:20] = 400.0
    noisy = light + RNG.normal(11.0, 3.0, light.shape)
    level = np.full_like(light, 11.0)
    assert measure_agreement(light + 11.0, data(noisy), level).unexplained < 0.03
    for share in (0.9, 0.7):  # of the light that is predicted; the noise to 1 %
        found = measure_agreement(share * light + 11.0, data(noisy), level)
        want = (1 - share) * np.linalg.norm(light) / np.linalg.norm(noisy - 11.0)
        assert found.unexplained == pytest.approx(want, rel=0.05)


def test_noise_is_the_robust_scatter_of_steps_about_their_median():
    """Light that grows by 5 from plane to plane while pixels swing by 2: steps of 5 ±
    4, noise 1.4826 x 4 / √2.
    """
    chequer = np.where(np.add.outer(np.arange(20), np.arange(22)) % 2, 2.0, -2.0)
    planes = np.array([50 + 5.0 * k + (-1) ** k * chequer for k in range(6)])
    assert pixel_noise_e(data(planes)) == pytest.approx(1.4826 * 4 / math.sqrt(2))
