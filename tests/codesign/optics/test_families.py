"""Families of starting lenses against closed forms: two spots where the parts point,
rings with foci of their own.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.optics import families, stack
from codesign.optics.families import StartingPhase
from codesign.optics.stack import OpticsConfig
from metalens.core.errors import ConfigError
from metalens.design import Focus, profiles

FOCUS = Focus(0.85, 2000.0, 30_000.0)
PLAIN = OpticsConfig(
    aperture_mm=0.5, focus_mm=30.0, depths_mm=(30.0, 30.1), depth_count=2, sample_um=6.0, window_samples=41,
    polynomials=0,
)  # fmt: skip


def test_two_parts_make_two_spots_where_they_point():
    """In focus the halves x > 0 and x < 0 send their light to +24 and -24 um along x,
    and nowhere along y.
    """
    psf = (
        stack.lens_psf_stack(replace(PLAIN, parts=2, apart_um=48.0), torch.zeros(0))
        .intensity[0]
        .double()
    )
    place = (torch.arange(41, dtype=torch.float64) - 20) * 6.0
    along_x, along_y = psf.sum(0), psf.sum(1)
    right, left = along_x[place > 3], along_x[place < -3]
    assert float((right * place[place > 3]).sum() / right.sum()) == pytest.approx(
        24.0, abs=3.0
    )  # half a sample
    assert float((left * place[place < -3]).sum() / left.sum()) == pytest.approx(
        -24.0, abs=3.0
    )
    assert float(right.sum() / left.sum()) == pytest.approx(1.0, rel=0.02)
    assert abs(float((along_y * place).sum() / along_y.sum())) < 0.5
    assert float(along_x[place.abs() < 3].sum()) < 0.1 * float(psf.sum())


def test_three_parts_point_a_third_of_a_turn_apart():
    start = StartingPhase(FOCUS, 250.0, parts=3, apart_um=30.0)
    k = 2 * math.pi / 0.85
    for turn in (0.0, 2 * math.pi / 3, 4 * math.pi / 3):
        x, y = (
            180.0 * math.cos(turn + 0.3),
            180.0 * math.sin(turn + 0.3),
        )  # off the middle of the sector
        way = math.cos(turn) * x + math.sin(turn) * y
        found = start.phase_rad(
            torch.tensor(x, dtype=torch.float64), torch.tensor(y, dtype=torch.float64)
        )
        assert float(found) == pytest.approx(k * 15.0 / 2000.0 * way, rel=1e-9)


def test_each_ring_is_the_hyperbolic_lens_of_its_own_focus():
    start = StartingPhase(FOCUS, 250.0, foci_um=(20_000.0, 60_000.0))
    for radius, focus in (
        (100.0, 20_000.0),
        (170.0, 20_000.0),
        (180.0, 60_000.0),
        (249.0, 60_000.0),
    ):  # 176.8 parts
        x, y = radius * math.cos(0.7), radius * math.sin(0.7)
        found = start.phase_rad(
            torch.tensor(x, dtype=torch.float64), torch.tensor(y, dtype=torch.float64)
        )
        both = replace(FOCUS, source_distance_um=focus), FOCUS
        own, common = (
            profiles.hyperbolic_phase(np.array([x]), np.array([y]), f) for f in both
        )
        assert float(found) == pytest.approx(float((own - common).ravel()[0]), abs=1e-6)


def test_radial_terms_know_no_azimuth_and_free_ones_do():
    x, y = np.array([0.6, -0.28, 0.0]), np.array([0.0, 0.53, -0.6])
    places = torch.from_numpy(x), torch.from_numpy(y)
    radial = families.phase_terms(*places, 3, "radial")
    for power, term in zip((2, 4, 6), radial, strict=True):
        assert term.numpy() == pytest.approx(np.hypot(x, y) ** power)


def test_free_terms_are_rings_and_waves_in_their_order():
    x, y = np.array([0.6, -0.28, 0.0, 0.0, -1.1]), np.array([0.0, 0.53, -0.6, 0.0, 0.4])
    free = families.phase_terms(torch.from_numpy(x), torch.from_numpy(y), 23, "free")
    rho, theta = np.hypot(x, y), np.arctan2(y, x)
    orders = [(n, m) for n in range(2, 7) for m in range(-n, n + 1, 2)]
    assert len(free) == 23 < len(orders)
    for (n, m), term in zip(orders, free, strict=False):
        want = rho**n * (np.cos(m * theta) if m >= 0 else np.sin(-m * theta))
        assert term.numpy() == pytest.approx(
            want, abs=1e-13
        )  # rounding of a dozen products below 3
    across = families.phase_terms(
        torch.from_numpy(x), torch.from_numpy(y)[:, None], 5, "free"
    )  # of a row and a column
    assert all(term.shape == (5, 5) for term in across)
    assert across[3].numpy().diagonal() == pytest.approx(free[3].numpy())


@pytest.mark.parametrize(
    "change",
    [
        {"family": "radial"}, {"zones": 2}, {"parts": 3, "apart_um": 40.0}, {"foci_mm": (18.0, 45.0, 90.0)},
    ],
)  # fmt: skip
def test_pillars_and_training_see_one_phase(change):
    settings = replace(PLAIN, polynomials=4, **change)
    moved = torch.tensor([0.7, -0.4, 0.3, 1.1], dtype=torch.float64)
    x, y = np.array([31.0, -77.0, 204.0]), np.array([-15.0, 66.0])
    grid = [
        torch.from_numpy(np.broadcast_to(a, (2, 3)).copy()) for a in (x, y[:, None])
    ]
    pillars = stack.phase_of(settings, moved.numpy())(x, y)
    training = stack.phase_at(
        settings, moved, *grid
    ).numpy() + profiles.hyperbolic_phase(x, y[:, None], settings.focus)
    apart = np.angle(np.exp(1j * (pillars - training)))
    assert np.abs(apart).max() < 1e-8  # thousands of radians in float64


@pytest.mark.parametrize(
    "change",
    [{"parts": 0}, {"apart_um": -1.0}, {"foci_mm": (20.0, 0.0)}, {"zones": -1}],
)
def test_impossible_starts_are_refused(change):
    with pytest.raises(ConfigError, match="need zones of 0 or more"):
        replace(PLAIN, **change)
