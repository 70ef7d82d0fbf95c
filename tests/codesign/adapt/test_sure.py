"""A correction is made only where draws of the posterior agree on it."""

from dataclasses import replace

import numpy as np
import pytest

from characterize.inference.asbuilt import WithinModel
from characterize.model import PLACE
from codesign.adapt import correction, sure
from metalens.core.errors import ConfigError
from tests.codesign import made_lens as m

KNOTS = np.array([0.7, 1.0, 1.6])


def table(x):
    """A table that follows the bias, more at one end."""
    return KNOTS * x[PLACE["bias_nm"]]


def test_a_narrow_posterior_is_used_and_its_spread_told():
    found = sure.judge_correction(m.asbuilt(sigma=0.3), table)
    assert found.usable
    assert np.allclose(
        found.sigma_nm, 0.3 * KNOTS, rtol=0.5
    )  # 24 draws: 15 % is one sigma


def test_a_wide_posterior_is_refused_with_what_would_settle_it():
    found = sure.judge_correction(m.asbuilt(sigma=6.0), table)
    assert not found.usable
    for words in ("bias_nm", "focus", "micrographs", "AFM"):
        assert words in found.words


def test_what_nobody_stated_refuses_and_is_named():
    """Sharp within the model; a leaning wall and the index move the bias by 3 and 2.6
    nm, light by nothing of note.
    """
    sharp = m.asbuilt(sigma=0.1)
    i = sharp.names.index("bias_nm")
    causes = (
        "another refractive index",
        "uneven illumination",
        "a side wall that leans about half height",
    )
    by_cause = np.zeros((3, len(sharp.names)))
    by_cause[:, i] = 2.6, 0.05, 3.0
    whole = sharp.covariance + by_cause.T @ by_cause
    open_ = replace(
        sharp,
        covariance=whole,
        within=WithinModel(sharp.covariance),
        causes=causes,
        by_cause=by_cause,
    )
    found = sure.judge_correction(open_, table)
    assert not found.usable
    assert found.words.index("cross-section") < found.words.index("ellipsometry")
    for words in ("lamp", "both sides of focus"):  # the frames have said what they can
        assert words not in found.words
    assert found.sigma_nm == pytest.approx(np.hypot(2.6, 3.0) * KNOTS, rel=0.5)
    kept = replace(open_, bench=np.zeros_like(whole)).lens_samples(400, seed=1)[:, i]
    assert kept.std() == pytest.approx(
        0.1, rel=0.15
    )  # both go with the lens: its light is as sharp as before


def test_two_lenses_that_fit_alike_are_wide_however_sharp_each_is():
    narrow = m.asbuilt(sigma=0.1)
    i = narrow.names.index("bias_nm")
    draws = np.tile(narrow.value, (60, 1))
    draws[::2, i] += 9.3
    assert sure.judge_correction(narrow, table).usable
    assert not sure.judge_correction(replace(narrow, draws=draws), table).usable


def test_a_map_is_judged_apart_from_the_table():
    """The mean bias to 0.1 nm, a bow of the diameters to 5: half of it, 2.5 nm, at axis
    and rim, where -0.5 and 0.5 of
    it are taken off; half-way -0.25."""
    sharp = m.asbuilt(sigma=0.1)
    i = sharp.names.index("bias_r_nm")
    covariance = sharp.covariance.copy()
    covariance[i, i] = 25.0
    bowed = replace(sharp, covariance=covariance)
    assert sure.judge_correction(bowed, table).usable
    found = sure.judge_correction(bowed, correction.uneven_nm, part=sure.MAP)
    assert found.sigma_nm == pytest.approx(
        [2.5] + [1.25] * 8 + [2.5] * 8, rel=0.45
    )  # 24 draws: 15 % is one sigma
    assert "what varies over the lens open" in found.words
    assert "bias_r_nm" in found.words
    assert "height_nm" not in found.words
    assert sure.judge_correction(sharp, correction.uneven_nm, part=sure.MAP).usable


def test_draws_that_no_table_can_hold_are_refused():
    def impossible(x):
        raise ConfigError("the table would change by 3 nm per nm")

    assert "3 nm per nm" in sure.judge_correction(m.asbuilt(), impossible).words
    with pytest.raises(TypeError):
        sure.judge_correction(m.asbuilt(), None)
