"""Exposure by neighbours through narrow Gaussians, against sums over all pillars and an integral."""

import math

import numpy as np
import pytest
from scipy import integrate, special

from layout.certify.neighbours import Pairs, reach_um


def pillars(seed, n=40, pitch=0.41):
    """x, y, mass, radius on a lattice that has gaps; pillars of many sizes, doses that are not alike."""
    rng = np.random.default_rng(seed)
    x, y = (v.ravel() for v in np.meshgrid((np.arange(n) - n / 2.3) * pitch, (np.arange(n) - 9.7) * pitch))
    held = rng.random(len(x)) < 0.7
    radius = rng.uniform(0.05, 0.15, held.sum())
    return x[held], y[held], rng.uniform(0.5, 1.5, held.sum()) * np.pi * radius**2, radius


def test_wide_ranges_see_gaussians_of_the_same_second_moment():
    x, y, mass, radius = every = pillars(5)
    some = slice(300, 360)
    assert reach_um(0.5, 0.3) == 4 * 0.5  # exp(-16) is left out
    found = Pairs.of(radius, 0.5)(tuple(v[some] for v in every), every)
    square = 0.25 + radius**2 / 2 + radius[some, None] ** 2
    away = (x - x[some, None]) ** 2 + (y - y[some, None]) ** 2
    terms = mass * np.exp(-away / square) / (np.pi * square)
    assert found == pytest.approx(terms.sum(1, where=away > 0), rel=1e-6)  # neighbours beyond exp(-16) are left out


@pytest.mark.parametrize("range_um", [0.041, 0.16, 0.4])
def test_narrow_ranges_see_exact_discs(range_um):
    """Non-central chi-square round the rim; those asked about come in any order, and not all of them."""
    x, y, mass, radius = every = pillars(6, n=14)
    some = np.random.default_rng(1).permutation(len(x))[:40]
    found = Pairs.of(radius, range_um)(tuple(v[some] for v in every), every)
    turn = 2 * np.pi * (np.arange(96) + 0.5) / 96
    want = np.zeros(40)
    for m, n in enumerate(some.tolist()):
        others = np.arange(len(x)) != n
        ring_x, ring_y = x[n] + radius[n] * np.cos(turn)[:, None], y[n] + radius[n] * np.sin(turn)[:, None]
        square = (ring_x - x[others]) ** 2 + (ring_y - y[others]) ** 2
        given = special.chndtr(2 * (radius[others] / range_um) ** 2, 2.0, 2 * square / range_um**2)
        want[m] = (given * mass[others] / (np.pi * radius[others] ** 2)).mean(0).sum()
    # between twelve radii and 46 gaps of a function that is nearly straight: 0.7 % of a neighbour that touches
    assert found == pytest.approx(want, rel=7e-3, abs=2e-6)


def test_the_rim_of_a_disc_by_another_is_the_mean_of_an_integral():
    """Exposure at a distance s of a disc of radius R by exp(-r² / a²) / (pi a²), ring by ring, over the rim."""
    a, seen, other, gap = 0.16, 0.071, 0.093, 0.11

    def exposure(s):
        return integrate.quad(
            lambda r: 2 * r / a**2 * math.exp(-((r - s) ** 2) / a**2) * special.i0e(2 * r * s / a**2), 0, other
        )[0]

    apart, turns = seen + other + gap, (np.arange(64) + 0.5) * 2 * math.pi / 64
    want = np.mean([exposure(math.sqrt(apart**2 + seen**2 - 2 * apart * seen * math.cos(t))) for t in turns])
    pairs = Pairs.of(np.array([0.05, seen, other, 0.1]), a)
    x, y = np.array([3.0, 3.0 + apart * 0.6]), np.array([7.0, 7.0 + apart * 0.8])
    radius, dose = np.array([seen, other]), np.array([1.3, 0.8])
    mass = dose * math.pi * radius**2
    got = pairs((x[:1], y[:1], mass[:1], radius[:1]), (x, y, mass, radius))
    assert got[0] == pytest.approx(0.8 * want, rel=2e-3)  # what is interpolated is nearly straight in the gap
    assert reach_um(a, 0.2) == pytest.approx(0.2 + 6 * a)  # exp(-36) is nothing
