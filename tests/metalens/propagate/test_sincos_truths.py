"""Sines and cosines of turns, as the compiled loops have them, against those of the
standard library.
"""

import math

import numba
import numpy as np
import pytest

from metalens.propagate import sincos

TURNS64, TURNS32 = (
    getattr(f, "py_func", f) for f in (sincos.sincos_turns64, sincos.sincos_turns32)
)  # itself where none is compiled
T = np.concatenate([np.linspace(-0.5, 0.5, 20_001), [1e-9, -3e-5, 0.25, -0.25, 0.125]])


def test_double_turns_are_right_to_rounding():
    c, s = TURNS64(T)
    assert np.abs(c - np.cos(2 * np.pi * T)).max() < 7e-16  # three roundings of one
    assert np.abs(s - np.sin(2 * np.pi * T)).max() < 7e-16
    assert TURNS64(0.0) == (1.0, 0.0)


def test_single_turns_are_right_to_four_in_ten_million_and_to_a_sixth_of_that_on_average():
    c, s = TURNS32(T)
    assert c.dtype == s.dtype == np.float32
    exact = T.astype(np.float32).astype(float)
    for got, want in ((c, np.cos(2 * np.pi * exact)), (s, np.sin(2 * np.pi * exact))):
        assert np.abs(got - want).max() < 4.2e-7
        assert np.sqrt(((got - want) ** 2).mean()) < 8e-8


def test_power_series_end_where_double_precision_does():
    """The next term of sin(πt)/t and cos(πt) at half a turn lies below a rounding."""
    for odd, count in ((1, 11), (0, 12)):
        left = (
            math.pi ** (2 * count + odd) / math.factorial(2 * count + odd) * 0.25**count
        )
        assert left < 2.3e-16


@numba.njit
def in_a_loop(t, like):
    return sincos.sincos_turns(t, like)


@pytest.mark.parametrize("turns", [sincos.sincos_turns, in_a_loop])
def test_the_kind_of_the_array_chooses_the_precision(turns):
    """At a tenth of a turn a polynomial in single precision is some 1e-8 off, one in
    double precision 1e-16.
    """
    want = np.array([math.cos(0.2 * math.pi), math.sin(0.2 * math.pi)])
    off = {
        kind: np.abs(np.array(turns(0.1, np.empty(0, kind))) - want).max()
        for kind in ("f4", "f8")
    }
    assert 1e-10 < off["f4"] < 4.2e-7
    assert off["f8"] < 7e-16
