"""Slopes of small maps pair by pair, and the factor of linear rows on fields by
matrices of two by two.
"""

import math

import numpy as np
import pytest
import torch

from metalens.lens import NeighbourRows
from metalens.psf import among

PITCH, WAVE = 0.37, 0.83
ALONG, ACROSS, ASIDE = (
    0.3 - 0.2j,
    -0.15 + 0.4j,
    0.9 - 0.7j,
)  # C - 1 for a sine of 1; of the diagonal, on either field
# two rows of one sine: all that is told is in proportion to it, for amplitudes over the
# field's share
ROWS = NeighbourRows(
    np.array([0.4, 0.2, 0.4, 0.2]),
    np.array([False, False, True, True]),
    np.array(
        [
            [
                (1 + s * (c + d)) * (1 - s * s) ** power
                for s, d in ((0.4, 0), (0.2, 0), (0.4, ASIDE), (0.2, ASIDE))
            ]
            for c, power in ((ALONG, 0.25), (ACROSS, -0.25))
        ]
    ),
    np.ones((2, 4), complex),
    np.zeros(4),
    WAVE,
)


def drawn(shape, dark=0.2):
    """Complex t of pillars, some of which are missing."""
    rng = np.random.default_rng(5)
    light = rng.uniform(0.3, 1, shape) * np.exp(1j * rng.uniform(-0.9, 0.9, shape))
    return np.where(rng.random(shape) < dark, 0, light)


def paired(light, i, j, along):
    """Phase from pillar to pillar by all pairs among the five by five pillars about
    one.
    """
    rows, columns = light.shape
    found = 0j
    for a in range(rows):
        for b in range(columns):
            if (
                along == "x"
                and b + 1 < columns
                and abs(a - i) <= 2
                and -2 <= b - j <= 1
            ):
                found += light[a, b + 1] * np.conj(light[a, b])
            if along == "y" and a + 1 < rows and abs(b - j) <= 2 and -2 <= a - i <= 1:
                found += light[a + 1, b] * np.conj(light[a, b])
    return math.atan2(found.imag, found.real) if abs(found) > 0 else 0.0


def test_slopes_are_the_mean_turn_of_the_pairs_of_five_by_five_pillars():
    light = drawn((8, 11))
    found = among.phase_slopes(torch.from_numpy(light), PITCH)
    for got, along in zip(found, "xy", strict=True):
        want = [
            [paired(light, i, j, along) / PITCH for j in range(11)] for i in range(8)
        ]
        assert got.numpy() == pytest.approx(np.array(want), abs=1e-12)


def test_a_single_row_has_no_slope_across_it_and_dark_pillars_none_at_all():
    light = torch.polar(
        torch.ones(1, 9, dtype=torch.float64),
        0.31 * torch.arange(9.0, dtype=torch.float64)[None],
    )
    across, down = among.phase_slopes(light, PITCH)
    assert across.numpy() == pytest.approx(np.full((1, 9), 0.31 / PITCH), rel=1e-12)
    assert not down.any()
    across, down = among.phase_slopes(light.T, PITCH)
    assert down.numpy() == pytest.approx(np.full((9, 1), 0.31 / PITCH), rel=1e-12)
    assert not across.any()
    two = torch.from_numpy(np.exp(1j * np.array([[0.0, 0.4], [-0.3, 0.1]])))
    across, down = among.phase_slopes(two, PITCH)
    assert across.numpy() == pytest.approx(np.full((2, 2), 0.4 / PITCH), rel=1e-12)
    assert down.numpy() == pytest.approx(np.full((2, 2), -0.3 / PITCH), rel=1e-12)
    assert not torch.stack(
        among.phase_slopes(torch.zeros(5, 6, dtype=torch.complex128), PITCH)
    ).any()


def factors(sx, sy):
    """J of light turned by the sines (sx, sy), as a matrix."""
    sine, angle = math.hypot(sx, sy), math.atan2(sy, sx)
    aside = ASIDE * math.sin(2 * angle) ** 2
    g = np.array([math.cos(angle), math.sin(angle)])
    outward = np.outer(g, g)
    return (1 + sine * (ALONG + aside)) * outward + (1 + sine * (ACROSS + aside)) * (
        np.eye(2) - outward
    )


@pytest.mark.parametrize(
    ("sx", "sy"), [(0.13, 0.29), (-0.21, 0.08), (0.0, -0.17), (0.26, 0.0)]
)
def test_both_fields_take_their_factors_along_and_across_the_slope(sx, sy):
    """Slopes in radians over a pillar: 2 pi sine pitch / wavelength, 0.9 at most."""
    turn = 2 * math.pi * PITCH / WAVE
    y, x = np.indices((7, 9))
    phase, level = (
        torch.from_numpy(turn * (sx * x + sy * y) - 0.4),
        torch.full((7, 9), 0.6, dtype=torch.float64),
    )
    want = factors(sx, sy)
    got = among.apply_jones_coupling(phase, level, ROWS, PITCH)
    for part, at in ((got.xx, (0, 0)), (got.yy, (1, 1)), (got.xy, (0, 1))):
        assert part.numpy() == pytest.approx(
            np.full((7, 9), want[at]), rel=1e-11, abs=1e-11
        )
    mean = np.trace(want) / 2
    light = torch.polar(level, phase)
    assert among.mean_coupling(light, ROWS, PITCH).numpy() == pytest.approx(
        np.full((7, 9), mean), rel=1e-11
    )
    turned, weaker = among.apply_scalar_coupling(phase, level, ROWS, PITCH)
    assert (turned - phase).numpy() == pytest.approx(
        np.full((7, 9), np.angle(mean)), rel=1e-10
    )
    assert weaker.numpy() == pytest.approx(np.full((7, 9), 0.6 * abs(mean)), rel=1e-11)


@pytest.mark.parametrize("rows", [1, 3, 5, 8, 9])
def test_rows_that_are_taken_together_make_no_difference(monkeypatch, rows):
    light = torch.from_numpy(drawn((9, 7), dark=0.0))
    phase, level = torch.angle(light), light.abs()
    mean, fields = (
        among.mean_coupling(light, ROWS, PITCH),
        among.apply_jones_coupling(phase, level, ROWS, PITCH),
    )
    monkeypatch.setattr(among, "ROWS", rows)
    assert among.mean_coupling(light, ROWS, PITCH).numpy() == pytest.approx(
        mean.numpy(), rel=1e-12
    )
    for got, want in zip(
        among.apply_jones_coupling(phase, level, ROWS, PITCH), fields, strict=True
    ):
        assert got.numpy() == pytest.approx(want.numpy(), rel=1e-12, abs=1e-13)


@pytest.mark.parametrize(("slope", "flat"), [(0.9e-4, True), (1.1e-4, False)])
def test_a_slope_below_a_ten_thousandth_of_a_radian_a_micron_turns_nothing(slope, flat):
    phase = torch.from_numpy(slope * PITCH * np.indices((6, 7))[1])
    got = among.apply_jones_coupling(
        phase, torch.ones(6, 7, dtype=torch.float64), ROWS, PITCH
    )
    sine = 0.0 if flat else slope * WAVE / (2 * math.pi)
    assert (got.xx - 1).numpy() == pytest.approx(
        np.full((6, 7), sine * ALONG), rel=1e-6, abs=1e-14
    )
    assert (got.yy - 1).numpy() == pytest.approx(
        np.full((6, 7), sine * ACROSS), rel=1e-6, abs=1e-14
    )
    assert float(got.xy.abs().max()) < 1e-18  # rounding of a slope that is along x
