"""The judge of oblique images against the closed form of a round aperture."""

import math

import numpy as np
import pytest

from benchmarks import oblique


def test_in_focus_on_the_axis_the_judge_has_airys_disc():
    """π (p / λ)² of the light per area in the middle, p = 0.204 at the rim (whose rays
    weigh 1 / (1 - p²): up to 4 %),
    none at 0.61 λ / p = 2.55 um."""
    case = oblique.Case(0.0, 0.0, 0.05, (3, 5))
    light = oblique._intensity(case, (0.0, 0.0), oblique.FOCUS) / oblique.FINE**2
    middle, sine = oblique.COUNT // 2, 50 / math.hypot(50, 240)
    assert light[middle, middle] == pytest.approx(
        math.pi * (sine / 0.85) ** 2, rel=0.05
    )
    dark = light[middle, middle : middle + 8].argmin() * oblique.FINE
    assert dark == pytest.approx(0.61 * 0.85 / sine, abs=oblique.FINE)


def test_a_hole_sends_on_what_passes_it():
    """All of its light reaches the lens behind it, cos⁴ of 11 degrees is off, and most
    lands on nine samples.
    """
    case = oblique.Case(25.0, 11.0, 0.05, (3, 5))
    place = 240 * math.tan(math.radians(11.0)), 7.0
    light = float(np.sum(oblique._samples(oblique._intensity(case, place, 5e3))))
    assert 0.9 * math.cos(math.radians(11.0)) ** 4 < light < 1.0
