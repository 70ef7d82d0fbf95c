"""A correction is made only where draws of the posterior agree on it."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import made_lens as m

from characterize.model import PLACE
from codesign.adapt import sure
from metalens.ground.errors import ConfigError

KNOTS = np.array([0.7, 1.0, 1.6])


def table(x):
    """A table that follows the bias, more at one end."""
    return KNOTS * x[PLACE["bias_nm"]]


def test_a_narrow_posterior_is_used_and_its_spread_told():
    found = sure.judge(m.asbuilt(sigma=0.3), table)
    assert found.usable
    assert np.allclose(found.sigma_nm, 0.3 * KNOTS, rtol=0.5)  # 24 draws: 15 % is one sigma


def test_a_wide_posterior_is_refused_with_what_would_settle_it():
    found = sure.judge(m.asbuilt(sigma=6.0), table)
    assert not found.usable
    for words in ("bias_nm", "focus", "micrographs", "AFM"):
        assert words in found.words


def test_two_lenses_that_fit_alike_are_wide_however_sharp_each_is():
    narrow = m.asbuilt(sigma=0.1)
    i = narrow.names.index("bias_nm")
    draws = np.tile(narrow.value, (60, 1))
    draws[::2, i] += 9.3
    assert sure.judge(narrow, table).usable
    assert not sure.judge(replace(narrow, draws=draws), table).usable


def test_draws_that_no_table_can_hold_are_refused():
    def impossible(x):
        raise ConfigError("the table would change by 3 nm per nm")

    assert "3 nm per nm" in sure.judge(m.asbuilt(), impossible).words
    with pytest.raises(TypeError):
        sure.judge(m.asbuilt(), None)
