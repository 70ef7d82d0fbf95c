"""Strehl ratio, efficiency and phase errors of pillars, from typed levels and errors,
in two blocks.
"""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from metalens.cell import Film, Index
from metalens.design import of_phase
from metalens.design.profiles import Focus
from metalens.lens import Layers, Stop

RNG = np.random.default_rng(6)


def test_quality_is_that_of_the_sum_of_all_pillars():
    """Wanted and made phases whole turns apart differ by nothing; a phase common to all
    is an error like any other.
    """
    error, level = RNG.normal(0.1, 0.35, 40), RNG.uniform(0.4, 0.98, 40)
    error[33] = -2.6
    wanted = RNG.uniform(-20, 20, 40)
    made_rad = wanted + error + 2 * math.pi * RNG.integers(-4, 5, 40)
    sums = of_phase.MetricSums()
    for part in (slice(0, 13), slice(13, 40)):
        sums.add(wanted[part], made_rad[part], level[part])
    focus = Focus(0.79, 1700.0, 23e3)
    made = sums.quality(focus, 310.0, 2.5, period_um=0.26)
    field = (level * np.exp(1j * error)).sum()
    assert made.pillars == 40
    assert made.turns == 2.5
    assert made.transmission == pytest.approx(np.mean(level**2), rel=1e-12)
    assert made.wavefront_efficiency == pytest.approx(abs(field / 40) ** 2, rel=1e-12)
    assert made.strehl == pytest.approx(abs(field / level.sum()) ** 2, rel=1e-12)
    assert made.rms_phase_error_rad == pytest.approx(
        math.sqrt(np.mean(error**2)), rel=1e-12
    )
    assert made.max_phase_error_rad == pytest.approx(2.6, rel=1e-12)
    assert made.numerical_aperture == pytest.approx(
        310 / math.hypot(310, 1700), rel=1e-12
    )
    assert made.field_of_view_rad == pytest.approx(
        2 * of_phase.field_angle(focus, 310.0), rel=1e-12
    )
    assert made.sampled_aperture == pytest.approx(0.79 / 0.52, rel=1e-12)
    steepest = 310 / math.hypot(310, 1700) + 310 / math.hypot(
        310, 23e3
    )  # rays at the rim
    assert made.steepest == pytest.approx(steepest, rel=1e-12)


def test_the_field_behind_a_stop_ends_where_half_its_light_misses_the_lens():
    """Two circles, of the hole and of the lens, as far apart as Snell's law moves the
    light through the substrate: the
    angle at which they share half the hole. Alone the wave front of what is left has no
    end there."""
    hole, radius, thick, index = 31.0, 58.0, 150.0, 1.45

    def shared(apart: float) -> float:
        half = [
            math.acos((apart**2 + a**2 - b**2) / (2 * apart * a))
            for a, b in ((hole, radius), (radius, hole))
        ]
        return sum(
            a**2 * (t - math.sin(2 * t) / 2)
            for a, t in zip((hole, radius), half, strict=True)
        )

    apart = brentq(
        lambda s: shared(s) - math.pi * hole**2 / 2,
        radius - 0.5 * hole,
        radius + 0.5 * hole,
    )
    inside = math.sin(math.atan(apart / thick))
    layers = Layers(front=(Film(Index(index), thick),), stop=Stop(hole, thick))
    found = of_phase.field_angle(Focus(0.85, 600.0, math.inf, layers), radius)
    # 61 places across: their count is good to 1 % of the hole, by which half of it
    # moves 0.4 um or 2e-3 rad
    assert found == pytest.approx(math.asin(index * inside), abs=3e-3)


def test_a_narrow_hole_before_a_wide_lens_has_the_field_that_it_lights():
    """A hole of a twentieth of the lens, so narrow that aberrations come later: half
    its light leaves the lens at
    tan = 600 / 1500, through air."""
    found = of_phase.field_angle(
        Focus(0.79, 1000.0, math.inf, Layers(stop=Stop(30.0, 1500.0))), 600.0
    )
    # of 61 places across the hole half a place is 0.5 um; the rim's curve takes 0.4 um:
    # 5e-4 rad together
    assert found == pytest.approx(math.atan(0.4), abs=1e-3)


def test_the_field_behind_a_hole_beside_the_axis_is_that_of_its_worst_side():
    """Turned by quarters it is the same; light from the side that moves off the vertex
    has more coma than of the
    middle of either."""
    sides = [(90.0, 30.0), (-30.0, 90.0), (-90.0, -30.0), (30.0, -90.0)]
    holes = [
        Focus(0.79, 1700.0, 23e3, Layers(stop=Stop(160.0, 300.0, side)))
        for side in sides
    ]
    found = [of_phase._wavefront_variance(focus, 600.0, 0.15) for focus in holes]
    one_side = [of_phase._from_the_side(focus, 600.0, 0.15) for focus in holes]
    assert found == pytest.approx([max(found)] * 4, rel=1e-9)
    assert max(one_side) == pytest.approx(found[0], rel=1e-9)
    assert max(one_side) > 1.5 * min(one_side)
