"""Arithmetic of pillar tables on numbers typed in."""

import math

import numpy as np
import pytest

from codesign.budget.response import interpolate_response, put_right, scatter_rad


def test_the_phase_of_a_link_is_its_scatter_about_the_mean_over_the_pillars():
    """0.4, 0.1 and -0.8 rad in shares of 0.5, 0.3 and 0.2, a common turn that wraps
    left out.
    """
    share, off = np.array([0.5, 0.3, 0.2]), np.array([0.4, 0.1, -0.8])
    common = np.angle((np.exp(1j * off) * share).sum())
    want = math.sqrt((((off - common) ** 2) * share).sum())
    for turn in (0.0, 2.9, -3.0):
        assert scatter_rad(off + turn, share) == pytest.approx(want, rel=1e-9)


def test_a_common_phase_is_no_error():
    share = np.array([0.25, 0.5, 0.25])
    assert scatter_rad(np.full(3, 2.0), share) == pytest.approx(0, abs=1e-12)
    assert scatter_rad(np.array([0.1, 0.0, -0.1]) + 3, share) == pytest.approx(
        0.1 * math.sqrt(0.5), rel=1e-12
    )


def test_between_the_diameters_level_and_unwound_phase_are_straight():
    """The phase passes half a turn, to either side of a diameter of the library."""
    d, level, phase = (
        np.array([0.10, 0.14, 0.20]),
        np.array([0.9, 0.7, 0.8]),
        np.array([2.0, 3.6, 5.9]),
    )
    got = interpolate_response(level * np.exp(1j * phase), d, np.array([[0.11, 0.18]]))
    want = [
        [0.85 * np.exp(2.4j), (0.7 + 0.1 * 2 / 3) * np.exp(1j * (3.6 + 2.3 * 2 / 3))]
    ]
    assert got == pytest.approx(np.array(want), rel=1e-12)


def test_a_ratio_is_carried_to_other_diameters_by_its_logarithm():
    at = np.array([0.1, 0.2])
    ratio = np.array(
        [1.1 * np.exp(3.0j), 0.8 * np.exp(3.4j)]
    )  # passes half a turn in between
    table = np.array([0.9j, 0.5, -0.7])
    got = put_right(table, np.array([0.1, 0.13, 0.2]), at, ratio)
    between_them = math.exp(0.7 * math.log(1.1) + 0.3 * math.log(0.8)) * np.exp(
        1j * 3.12
    )
    assert got == pytest.approx(
        table * np.array([ratio[0], between_them, ratio[1]]), rel=1e-12
    )
