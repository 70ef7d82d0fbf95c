"""Rational interpolation: functions that are rational come back exactly, with their
poles.
"""

import numpy as np
import pytest

from metalens.library import rational

POLES = np.array([0.1 - 0.02j, 0.2 - 1e-5j, 0.33 - 0.1j])
X = np.linspace(0.05, 0.3, 31)


def rows(x):
    """Two components with common poles, one of them 1e-5 off the real axis."""
    x = np.asarray(x, float)
    first = 1.3 + 0.2j + (0.02 / (x[..., None] - POLES)).sum(-1)
    return np.stack([first, 0.5 - (0.01j / (x[..., None] - POLES)).sum(-1)], -1)


def test_a_rational_function_is_found_with_its_poles():
    r = rational.fit_rational_aaa(X, rows(X), tolerance=1e-10)
    assert len(r.support) == 4  # degree 3
    assert r.residual < 1e-10
    t = np.random.default_rng(0).uniform(0.05, 0.3, (7, 9))
    assert np.abs(r(t) / rows(t) - 1).max() < 1e-9
    assert np.abs(np.sort_complex(r.poles()) - POLES).max() < 1e-9


def test_data_on_the_support_are_met_exactly():
    r = rational.fit_rational_aaa(X, rows(X), tolerance=1e-3)
    assert np.array_equal(r(r.support), r.values)
    assert np.abs(r(X) - rows(X)).max() == pytest.approx(r.residual, rel=1e-9)


def test_start_and_terms_bound_the_degree():
    r = rational.fit_rational_aaa(X, rows(X), tolerance=0.0, terms=3, start=X[[4, 9]])
    assert len(r.support) == 3
    assert set(X[[4, 9]]) <= set(r.support)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_few_data(count):
    r = rational.fit_rational_aaa(X[:count], rows(X[:count]), tolerance=1e-12)
    assert np.isfinite(r(X)).all()
    assert len(r.poles()) <= max(0, len(r.support) - 1)
