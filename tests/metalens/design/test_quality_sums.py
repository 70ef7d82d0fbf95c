"""Strehl ratio, efficiency and phase errors of pillars, from typed levels and errors, in two blocks."""

import math

import numpy as np
import pytest

from metalens.design import of_phase
from metalens.design.profiles import Focus
from metalens.lens import Layers, Stop

RNG = np.random.default_rng(6)


def test_quality_is_that_of_the_sum_of_all_pillars():
    """Wanted and made phases whole turns apart differ by nothing; a phase common to all is an error like any other."""
    error, level = RNG.normal(0.1, 0.35, 40), RNG.uniform(0.4, 0.98, 40)
    error[33] = -2.6
    wanted = RNG.uniform(-20, 20, 40)
    made_rad = wanted + error + 2 * math.pi * RNG.integers(-4, 5, 40)
    sums = of_phase.Sums()
    for part in (slice(0, 13), slice(13, 40)):
        sums.add(wanted[part], made_rad[part], level[part])
    focus = Focus(0.79, 1700.0, 23e3)
    made = sums.quality(focus, 310.0, 2.5, period_um=0.26)
    field = (level * np.exp(1j * error)).sum()
    assert made.pillars == 40
    assert made.turns == 2.5
    assert made.transmission == pytest.approx(np.mean(level**2), rel=1e-12)
    assert made.efficiency == pytest.approx(abs(field / 40) ** 2, rel=1e-12)
    assert made.strehl == pytest.approx(abs(field / level.sum()) ** 2, rel=1e-12)
    assert made.rms_phase_error_rad == pytest.approx(math.sqrt(np.mean(error**2)), rel=1e-12)
    assert made.max_phase_error_rad == pytest.approx(2.6, rel=1e-12)
    assert made.numerical_aperture == pytest.approx(310 / math.hypot(310, 1700), rel=1e-12)
    assert made.field_of_view_rad == pytest.approx(2 * of_phase.field_angle(focus, 310.0), rel=1e-12)
    assert made.sampled_aperture == pytest.approx(0.79 / 0.52, rel=1e-12)
    steepest = 310 / math.hypot(310, 1700) + 310 / math.hypot(310, 23e3)  # rays at the rim
    assert made.steepest == pytest.approx(steepest, rel=1e-12)


def test_thirty_places_of_the_lens_are_light_enough_for_a_wave_front():
    """Places 20 um apart: a hole of 61.6 um about one holds 29 of them, one of 62.3 um about a middle of two holds 30;
    light at 0.1 rad comes from half a step aside."""
    few, enough = (Focus(0.79, 1700.0, math.inf, Layers(stop=Stop(r, 100.0))) for r in (61.6, 62.3))
    assert of_phase._wavefront_variance(few, 600.0, 0.0) == math.inf
    assert of_phase._wavefront_variance(enough, 600.0, math.atan(0.1)) < 1e-3


def test_the_field_behind_a_hole_beside_the_axis_is_that_of_its_worst_side():
    """Turned by quarters it is the same; light from the side that moves off the vertex has more coma than of the
    middle of either."""
    sides = [(90.0, 30.0), (-30.0, 90.0), (-90.0, -30.0), (30.0, -90.0)]
    holes = [Focus(0.79, 1700.0, 23e3, Layers(stop=Stop(160.0, 300.0, side))) for side in sides]
    found = [of_phase._wavefront_variance(focus, 600.0, 0.15) for focus in holes]
    one_side = [of_phase._from_the_side(focus, 600.0, 0.15) for focus in holes]
    assert found == pytest.approx([max(found)] * 4, rel=1e-9)
    assert max(one_side) == pytest.approx(found[0], rel=1e-9)
    assert max(one_side) > 1.5 * min(one_side)
