"""What settings may add to what none of them changes: Pythagorean numbers, and the very
edge of a goal.
"""

import math
from types import SimpleNamespace

import pytest

from codesign.budget import floor
from codesign.budget.entry import Entry
from metalens.ground.errors import ConfigError

LINKS = (
    Entry("subject and calibration", math.nan, math.nan, 5e-3, ""),
    Entry("fixation", math.nan, math.nan, 12e-3, ""),
    Entry("spectrum", 0.0, 0.0, 40e-3, "", counted=False),
)


def test_a_goal_of_85_leaves_84_above_a_floor_of_13():
    assert floor.allowance_rad(85e-3, LINKS) == pytest.approx(84e-3, rel=1e-12)
    assert floor.allowance_rad(0.7, ()) == pytest.approx(0.7, rel=1e-12)


@pytest.mark.parametrize("links", [LINKS[:2], LINKS[1::-1]])
def test_a_goal_at_the_floor_is_refused_with_its_largest_link(links):
    """0.013 rad are 0.7448 degrees, 0.012 are 0.6875."""
    least = math.hypot(5e-3, 12e-3)
    with pytest.raises(
        ConfigError, match=r"errs by 0\.745 deg, most of it fixation with 0\.688 deg"
    ):
        floor.allowance_rad(least, links)
    assert floor.allowance_rad(least * (1 + 1e-9), links) > 0


def test_of_a_reader_only_what_counts_is_a_floor(monkeypatch):
    asked = []

    def reading(run, frames, *, fwhm_nm):
        asked.append((run, frames, fwhm_nm))
        return SimpleNamespace(path=lambda: iter(LINKS))

    monkeypatch.setattr(floor, "Reading", reading)
    assert floor.floor("rig", "run", "frames") == LINKS[:2]
    assert floor.floor("rig", "run", "frames", fwhm_nm=37.0) == LINKS[:2]
    assert asked == [("run", "frames", 0.0), ("run", "frames", 37.0)]
