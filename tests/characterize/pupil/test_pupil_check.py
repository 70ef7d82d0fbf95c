"""What a pupil fit is judged by, against formulas: agreement, light missed beyond
noise, order of the planes.
"""

import math

import numpy as np
import pytest

from characterize.inference.leastsquares import FitImages
from characterize.pupil import check
from characterize.pupil.judge import measure_agreement

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
    seen, told = RNG.uniform(20, 90, (3, 6, 7)), RNG.uniform(20, 90, (3, 6, 7))
    usable, saturated = (
        RNG.uniform(size=seen.shape) > 0.2,
        RNG.uniform(size=seen.shape) > 0.9,
    )
    got = measure_agreement(told, data(seen, usable, saturated), 17.0)
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
    noisy = light + 11.0 + RNG.normal(0, 3.0, light.shape)
    length = math.sqrt((light**2).sum() + light.size * 9.0)
    by_noise = 3.0 * math.sqrt(light.size) / length
    for beyond in (0.05, 0.2):
        nrmse = math.hypot(by_noise, beyond)
        assert check.unexplained_share(nrmse, data(noisy), 11.0) == pytest.approx(
            beyond, rel=0.15
        )  # the noise to 1 %
    assert check.unexplained_share(0.9 * by_noise, data(noisy), 11.0) == 0.0


def waves(order):
    """Planes that turn slowly from one picture into another; ``order`` is theirs in the
    stack.
    """
    one, other = RNG.uniform(size=(2, 12, 13))
    turn = np.linspace(0, math.pi / 2, 12)[:, None, None]
    return (np.cos(turn) * one + np.sin(turn) * other)[order]


def test_planes_in_order_score_one_and_shuffled_ones_nothing():
    assert check.order_score(data(waves(np.arange(12)))) == pytest.approx(1.0, abs=0.1)
    scores = [check.order_score(data(waves(RNG.permutation(12)))) for _ in range(40)]
    assert abs(np.mean(scores)) < 0.15  # one shuffle scatters by 0.3
    assert math.isnan(check.order_score(data(waves(np.arange(12))[:5])))
    assert math.isnan(
        check.order_score(data(np.tile(RNG.uniform(size=(1, 9, 9)), (8, 1, 1))))
    )


def test_order_is_the_share_of_likeness_that_neighbours_have():
    """By its definition, with every correlation from numpy."""
    planes = waves(RNG.permutation(12)) + RNG.normal(0, 0.02, (12, 12, 13))
    flat = planes.reshape(12, -1)
    alike = np.corrcoef(flat - np.median(flat, axis=1, keepdims=True))
    pairs = [alike[i, j] for i in range(12) for j in range(12) if i != j]
    follow = np.mean([alike[i, i + 1] for i in range(11)])
    best = np.mean([np.sort(np.delete(row, i))[-2:] for i, row in enumerate(alike)])
    want = (follow - np.mean(pairs)) / (best - np.mean(pairs))
    assert check.order_score(data(planes)) == pytest.approx(want, rel=1e-9)


def test_noise_is_the_robust_scatter_of_steps_about_their_median():
    """Light that grows by 5 from plane to plane while pixels swing by 2: steps of 5 ±
    4, noise 1.4826 x 4 / √2.
    """
    chequer = np.where(np.add.outer(np.arange(20), np.arange(22)) % 2, 2.0, -2.0)
    planes = np.array([50 + 5.0 * k + (-1) ** k * chequer for k in range(6)])
    by_noise = (
        1.4826
        * 4
        / math.sqrt(2)
        * math.sqrt(planes.size)
        / math.sqrt(((planes - 30) ** 2).sum())
    )
    assert check.unexplained_share(
        math.hypot(by_noise, 0.03), data(planes), 30.0
    ) == pytest.approx(0.03, rel=1e-9)


@pytest.mark.parametrize(
    ("wider", "said"), [(1.08, ""), (1.25, "doubted"), (1.6, "refused")]
)
def test_a_spot_predicted_too_wide_is_doubted_from_a_quarter_on_and_refused_from_a_half(
    wider, said
):
    """Gaussian spots of widths 1 and q overlap by 2q / (1 + q²): at its best brightness
    one misses |1 - q²| / (1 + q²).

    So does a wavelength or an aperture that is wrong by as much: 8 % is what right
    optics miss, 50 % are wrong ones.
    """
    y, x = np.mgrid[-24:25, -24:25]

    def spot(width):
        return np.exp(-((x - 0.3) ** 2 + (y + 0.2) ** 2) / (2 * width**2))

    planes = np.stack([spot(3.5)] * 5)  # too few for an order
    other = spot(3.5 * wider)
    told = np.stack([other * (other * spot(3.5)).sum() / (other**2).sum()] * 5)
    score = measure_agreement(told, data(planes), 0.0)
    share = check.unexplained_share(score.nrmse, data(planes), 0.0)
    assert share == pytest.approx((wider**2 - 1) / (wider**2 + 1), rel=1e-3)
    assert any(
        "misses" in words
        for words in check.pupil_problems(data(planes), score.ncc, share, "")
    ) == (said == "refused")
    assert any("misses" in words for words in check.pupil_warnings(share, "")) == (
        said == "doubted"
    )
