"""What exploring adds to valleys: profiles stretched by the calibration's error, and a second lens in words."""

from types import SimpleNamespace

import numpy as np
import pytest

from characterize.inference import explore
from characterize.inference.ends import Profile

NAMES = ("bias_nm", "height_nm", "coma_x_rad", "index")


def test_a_profile_is_stretched_about_its_own_mode():
    """1.3 times as wide: the ends and the places of the curve, not how much it rises there."""
    one = Profile(1.1, 9.7, np.array([0.4, 2.0, 5.0, 11.0]), np.array([7.0, 1.0, 2.0, 6.0]), parabolic=False)
    wide = explore._widened(one, np.array([-50.0, 3.0, 8.0]), np.array([2.9, 1.3, 0.4]), 1)
    assert (wide.low, wide.high) == pytest.approx((3 - 1.3 * 1.9, 3 + 1.3 * 6.7), rel=1e-12)
    assert wide.value == pytest.approx(np.array([3 - 1.3 * 2.6, 3 - 1.3, 3 + 1.3 * 2, 3 + 1.3 * 8]), rel=1e-12)
    assert wide.rise is one.rise
    assert not wide.parabolic


def test_a_second_lens_is_told_by_the_three_parameters_that_differ_most_in_sigma():
    """Of steps -8, 3, -0.1 and 0.06 with errors 4, 0.5, 0.1 and 0.02: 2, 6, 1 and 3 sigma."""
    best = SimpleNamespace(
        value=np.array([2.0, -7.0, 0.3, 0.02]), covariance=np.diag([4.0, 0.5, 0.1, 0.02]) ** 2, merit=812.0
    )
    other = SimpleNamespace(value=best.value + np.array([-8.0, 3.0, -0.1, 0.06]), merit=814.5)
    found = SimpleNamespace(
        best=best, modes=(best, other), share=np.array([0.78, 0.22]), parabolic=np.array([True, False, True, True]),
        low=np.array([0.0, -9.25, 0.0, 0.0]), high=np.array([9.0, 1.5, 1.0, 1.0]),
    )  # fmt: skip
    bent, second = explore.words(SimpleNamespace(names=NAMES), found)
    assert bent.startswith("height_nm is bent: 95 % within -9.25 to 1.5 about -7, ")
    assert second.startswith("a second lens explains the frames nearly as well (misfit +2.5, probability 22%): ")
    assert ": height_nm -4 for -7, index 0.08 for 0.02, bias_nm -6 for 2; frames" in second


@pytest.mark.parametrize(("gain", "followed", "left"), [(0.06, True, True), (0.04, True, False), (5.0, False, False)])
def test_a_better_lens_met_on_the_way_out_ends_the_search_of_ends(monkeypatch, gain, followed, left):
    """By more than 0.05 of the misfit, and where it is to be followed; it is fitted to its end once."""
    refined = []

    class Found:
        def __init__(self, *given):
            self.rounds = 0

        def ends(self, wanted):
            return ["place", "another"]

        def beyond(self):
            self.rounds += 1
            return [(0, 1, None)] if self.rounds < 3 else []

        def profile(self, i):
            return f"profile {i}"

    def refine(task, place):
        refined.append(place)
        return SimpleNamespace(merit=812.0 - gain)

    monkeypatch.setattr(explore, "Search", Found)
    monkeypatch.setattr(explore, "refine", refine)
    task, mode = SimpleNamespace(names=("bias_nm", "height_nm")), SimpleNamespace(merit=812.0)
    profiles, other = explore._profiles(task, None, mode, {}, followed=followed)
    assert refined == (["place"] if followed else [])
    assert (other is not None) == left
    assert profiles == ({} if left else {"bias_nm": "profile 0", "height_nm": "profile 1"})
