"""What looking for causes beside a fit starts from: residuals and slopes over the
noise, priors, a misfit above 1.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference import missing

draw = np.random.default_rng(4)
IMAGE, SLOPES = draw.uniform(20, 90, (3, 4, 5)), draw.normal(size=(2, 3, 4, 5))
USABLE, FULL = (
    draw.uniform(size=IMAGE.shape) > 0.2,
    draw.uniform(size=IMAGE.shape) > 0.9,
)
RESIDUAL = draw.normal(size=IMAGE.shape) * 4
SHARED = draw.normal(size=(2, 3, 4, 5))


def looked(monkeypatch, chi2_per_dof, patched=False):
    data = SimpleNamespace(
        usable=USABLE,
        saturated=FULL,
        variance=lambda image: 2.5 * image + 9.0,
        shared=lambda image: SHARED,
    )
    model = SimpleNamespace(images=lambda x, names: (IMAGE, SLOPES))
    prior = SimpleNamespace(sigma=np.array([0.3, 2.1]), mean=np.array([-0.4, 1.3]))
    task = SimpleNamespace(
        model=model,
        data=data,
        prior=prior,
        names=("one", "two"),
        all_of=lambda value: value,
    )
    mode = SimpleNamespace(
        value=np.array([0.2, -3.0]),
        residual_sigma=RESIDUAL,
        chi2_per_dof=chi2_per_dof,
        image=IMAGE,
        slopes=SLOPES,
    )
    monkeypatch.setattr(missing.causes, "systematic_changes", lambda *_: ())
    monkeypatch.setattr(
        missing, "_ghost", lambda *_: missing.ScoreTest("ghost", 0.0, 0, 1.0)
    )
    monkeypatch.setattr(
        missing,
        "_patch",
        lambda *_: missing.ScoreTest("patch", 4.0, int(patched), 0.03),
    )
    return missing.run_score_tests(task, mode)


@pytest.mark.parametrize(
    ("chi2_per_dof", "noise"), [(0.6, 1.0), (1.0, 1.0), (2.25, 1.5)]
)
def test_residuals_are_counted_in_the_noise_that_they_show_but_never_in_less_than_is_known(
    monkeypatch, chi2_per_dof, noise
):
    made = looked(monkeypatch, chi2_per_dof)
    counted = (USABLE & ~FULL).ravel()
    assert made.fit.rest == pytest.approx(
        np.clip(RESIDUAL, -6, 6).ravel() * counted / noise, rel=1e-12
    )
    assert made.fit.pull == pytest.approx(
        np.array([0.6 / 0.09, -4.3 / 4.41]) / noise, rel=1e-12
    )
    assert not made.leans
    assert made.reckoned().sigma.tolist() == [0.0, 0.0]


@pytest.mark.parametrize(("sigma", "sought"), [(2.9, 0), (3.1, 1)])
def test_patches_are_looked_for_where_chi_square_is_above_that_of_noise(
    monkeypatch, sigma, sought
):
    """By three of its sigma, the root of two over the pixels that count."""
    above = sigma * math.sqrt(2 / (USABLE & ~FULL).sum())
    assert len(looked(monkeypatch, 1 + above, patched=True).leans) == sought


def test_slopes_are_over_the_noise_and_priors_add_to_what_they_know(monkeypatch):
    fit = looked(monkeypatch, 1.3).fit
    counted = (USABLE & ~FULL).ravel()
    noise = np.array([math.sqrt(2.5 * light + 9.0) for light in IMAGE.ravel()])
    rows = SLOPES.reshape(2, -1) * counted / noise
    assert fit.slopes == pytest.approx(rows, rel=1e-12)
    assert fit.known[0, 1] == pytest.approx(rows[0] @ rows[1], rel=1e-9)
    assert np.diag(fit.known) == pytest.approx(
        (rows**2).sum(1) + np.array([1 / 0.09, 1 / 4.41]), rel=1e-9
    )
    assert fit.shared == pytest.approx(
        SHARED * (counted / noise).reshape(IMAGE.shape), rel=1e-12
    )


@pytest.mark.parametrize(("share", "degrees"), [(0.8e-3, 0), (1.2e-3, 1)])
@pytest.mark.parametrize("size", [0.05, 30.0])
def test_a_change_of_which_the_fit_leaves_less_than_a_thousandth_of_the_square_is_not_told(
    share, degrees, size
):
    """Whatever its size: along a slope, and beside all of them by the root of its
    share.
    """
    slopes = np.array([4.0, 0.5, 20.0, 7.0])[:, None] * np.eye(4, IMAGE.size)
    rest = draw.normal(size=IMAGE.size)
    fit = missing.FitAtMode(
        tuple("abcd"),
        slopes,
        slopes @ slopes.T,
        rest,
        np.zeros((2, *IMAGE.shape)),
        np.zeros(4),
    )
    change = size * (
        math.sqrt(1 - share) * np.eye(1, IMAGE.size, 2)
        + math.sqrt(share) * np.eye(1, IMAGE.size, 6)
    )
    found = fit.lean("hidden", change)
    assert found.degrees == degrees
    assert found.chi2 == pytest.approx(degrees * rest[6] ** 2, rel=1e-9)
