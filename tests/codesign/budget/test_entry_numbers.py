"""Lines of the error budget by Pythagorean numbers: what adds, what does not count,
what is not known.
"""

import math

import pytest

from codesign.budget.entry import NONE, Entry, more, total


def test_squares_add_of_what_counts_and_is_known():
    """3, 4 and 12 make 13; 8 and 15 make 17; 7 and 24 make 25."""
    links = [
        Entry("one", 3e-3, NONE, 8e-3, "so"),
        Entry("two", 4e-3, 0.07, NONE, "so"),
        Entry("switched off", 9e-3, 0.9, 0.5, "so", counted=False),
        Entry("not known and off", NONE, NONE, NONE, "so", counted=False),
        Entry("three", 12e-3, 0.24, -15e-3, "so"),
    ]
    told = total(links)
    assert (told.phase_rad, told.psf, told.gaze_rad) == pytest.approx(
        (13e-3, 0.25, 17e-3), rel=1e-12
    )
    assert (told.link, told.counted) == ("all links", True)
    assert told.method == "root of the sum of squares; without two"
    assert total(links[:1]).method == "root of the sum of squares"


def test_a_sum_of_nothing_is_nothing():
    told = total([])
    assert (told.phase_rad, told.psf, told.gaze_rad) == (0.0, 0.0, 0.0)


def test_what_an_error_has_more_leaves_what_was_before_in_its_squares():
    assert more(17.0, 8.0) == pytest.approx(15.0, rel=1e-12)
    assert more(-13.0, 5.0) == pytest.approx(12.0, rel=1e-12)
    assert more(0.3, 0.3) == 0.0
    assert more(0.2, 0.7) == 0.0
    assert math.isnan(Entry("x", NONE, 0.0, 0.0, "").phase_rad)
