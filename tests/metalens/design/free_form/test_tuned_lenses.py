"""Tuned baselines: the scan finds what a finer scan finds, and what was measured apart."""

import math

import numpy as np
import pytest

from metalens.design.free_form import simple_lenses as baselines
from metalens.design.free_form.settings import Fisher
from metalens.design.profiles import Focus, hyperbolic
from metalens.ground.errors import ConfigError
from metalens.image.pupil import Pupil

PUPIL = Pupil(nodes=160)
ASKED = Fisher().about(Focus(0.85, 2000.0, 20e3), PUPIL.radius_um)


def test_the_hyperbolic_lens_is_best_focused_in_mid_range():
    """Best of a scan of foci within 2 % of the value measured apart in a paraxial model
    (0.24); the first three, at 14,
    16.8 and 21 mm, are not."""
    found = baselines.tuned(PUPIL, ASKED, foci_mm=(14.0, 21.0), count=3)
    assert found.information == pytest.approx(0.24, rel=0.02)
    assert 17.5e3 < found.focus_um < 21e3
    for focus in (17e3, 22e3):
        assert (
            baselines.judged(PUPIL, ASKED, zones=0, focus_um=focus).information
            <= found.information
        )


def test_a_helix_beats_the_hyperbolic_lens_and_winds():
    helix = baselines.judged(PUPIL, ASKED, zones=2, focus_um=20e3)
    assert helix.information == pytest.approx(0.29, rel=0.02)  # measured apart
    phase, focus = helix.phase(Focus(0.85, 2000.0, 50e3), radius_um=500.0)
    assert focus.source_distance_um == 20e3
    turn = np.linspace(-math.pi, math.pi, 721)
    x, y = 100 * np.cos(turn), 100 * np.sin(turn)
    extra = [
        float(phase(a[None], b[None])[0, 0] - hyperbolic(a, b, focus))
        for a, b in zip(x, y, strict=True)
    ]
    winding = np.angle(np.exp(1j * np.diff(extra))).sum() / (2 * math.pi)
    assert winding == pytest.approx(1, abs=0.01)


def test_double_helices_of_one_zone_to_six_are_tried():
    """As hard as a design: none is left out in between."""
    assert sorted(baselines.ZONES) == list(range(1, 7))


def test_an_impossible_scan_is_refused():
    with pytest.raises(ConfigError, match="foci_mm"):
        baselines.tuned(PUPIL, ASKED, foci_mm=(50.0, 12.0))
