"""Bars of lenses of two sizes, and how far apart rays may lie to be said to meet."""

from types import SimpleNamespace

import numpy as np
import pytest

from metalens.design import Focus, paired
from metalens.design.focusing import focuses, meeting_um
from metalens.design.turned import _conversion
from metalens.pillars.circular import Turned
from metalens.rcwa import SAFETY
from tests.referees.turned_pillar import isolated

K = 2 * np.pi / 1.31


def test_the_bar_of_each_polarisation_is_of_its_own_efficiency(monkeypatch):
    """Amplitudes √η of the peak that are off by the mean bar of the pillars: (√η + b)²
    - η.
    """
    monkeypatch.setattr(paired, "_covered", lambda stock, alike: 0.5)
    monkeypatch.setattr(paired, "least_period_um", lambda cell: 0.4)
    quality = [
        SimpleNamespace(
            quality=lambda *_, e=e, **__: SimpleNamespace(wavefront_efficiency=e)
        )
        for e in (0.81, 0.36)
    ]
    stock = SimpleNamespace(
        error=np.array([0.01, 0.05, 0.3]),
        leaked=np.array([[0.1, 0.02], [0.3, 0.04], [9.0, 9.0]]),
    )
    used = np.array([3, 1, 0])
    made = paired._split(
        stock,
        quality,
        used,
        (None, None),
        100.0,
        SimpleNamespace(cell=None),
        alike=False,
    )
    bar = (3 * 0.01 + 0.05) / 4
    assert made.wavefront_efficiency_error == pytest.approx(
        ((0.9 + bar) ** 2 - 0.81, (0.6 + bar) ** 2 - 0.36), rel=1e-12
    )
    assert made.leaked == pytest.approx((0.15, 0.025))
    assert (made.pairs, made.multiplexed, made.covered) == (2, True, 0.5)


@pytest.mark.parametrize(
    ("apart", "meets"), [(0.15, True), (0.25, False), (-0.15, True), (-0.25, False)]
)
def test_rays_meet_within_a_fifth_of_the_lens(apart, meets):
    """A lens of focal length f: at the sensor at d its rays have come from radius r to
    r (1 - d / f).
    """
    sensor_um = 900.0
    focal_um = sensor_um / (1 - apart)

    def phase(x, y):
        return -K * np.hypot(np.hypot(x, y[:, None]), focal_um)

    focus, about = Focus(1.31, sensor_um), {"radius_um": 60.0, "pitch_um": 0.6}
    assert bool(focuses(phase, focus, **about)) is meets
    assert meeting_um(phase, focus, **about)[2] == pytest.approx(focal_um, rel=1e-5)


@pytest.mark.parametrize("hand", ["right", "left"])
def test_bars_of_converted_and_unconverted_light(hand):
    """Truncations whose t_x was 1 % and t_y 3 % larger: shares |t_x -+ t_y|² / 4 of
    theirs, SAFETY times as far off.

    One turn is solved 0.04i off on the diagonal: half of it either way round, 0.02 of
    the amplitude beside the model.
    """
    t_x, t_y, angles = (
        0.93 * np.exp(0.4j),
        0.81 * np.exp(-2.0j),
        np.radians([0, 20, 50, -35]),
    )
    solved = isolated(t_x, t_y, angles)
    before = np.stack(
        [isolated(1.01 * t_x, 1.03 * t_y, angles), isolated(1.005 * t_x, t_y, angles)],
        axis=1,
    )
    plain = _conversion(
        Turned(0.23, 0.94, angles, solved, np.full(4, 0.01), before), hand
    )
    for sign, share, bar in (
        (-1, plain.converted, plain.converted_error),
        (1, plain.unconverted, plain.unconverted_error),
    ):
        here, there, near = (
            abs(a * t_x + sign * b * t_y) ** 2 / 4
            for a, b in ((1, 1), (1.01, 1.03), (1.005, 1))
        )
        assert share == pytest.approx(here, rel=1e-9)
        assert bar == pytest.approx(
            SAFETY * max(abs(there - here), abs(near - here)), rel=1e-9
        )
    assert plain.isolated_error < 1e-12
    solved[2, 0, 0] += 0.04j
    assert _conversion(
        Turned(0.23, 0.94, angles, solved, np.full(4, 0.01), before), hand
    ).isolated_error == (pytest.approx(0.02, rel=1e-9))
