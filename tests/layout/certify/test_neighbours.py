"""Exposure by neighbours through narrow Gaussians, against sums over all pillars and an
integral.
"""

import math

import numpy as np
import pytest
from scipy import integrate, special

from layout.certify import neighbours
from layout.certify.neighbours import Pairs, reach_um


def pillars(seed, n=40, pitch=0.41):
    """x, y, mass, radius on a lattice that has gaps; pillars of many sizes, doses that
    are not alike.
    """
    rng = np.random.default_rng(seed)
    x, y = (
        v.ravel()
        for v in np.meshgrid(
            (np.arange(n) - n / 2.3) * pitch, (np.arange(n) - 9.7) * pitch
        )
    )
    held = rng.random(len(x)) < 0.7
    radius = rng.uniform(0.05, 0.15, held.sum())
    return (
        x[held],
        y[held],
        rng.uniform(0.5, 1.5, held.sum()) * np.pi * radius**2,
        radius,
    )


def test_wide_ranges_see_gaussians_of_the_same_second_moment():
    x, y, mass, radius = every = pillars(5)
    some = slice(300, 360)
    assert reach_um(0.5, 0.3) == 4 * 0.5  # exp(-16) is left out
    found = Pairs.of(radius, 0.5)(tuple(v[some] for v in every), every)
    square = 0.25 + radius**2 / 2 + radius[some, None] ** 2
    away = (x - x[some, None]) ** 2 + (y - y[some, None]) ** 2
    terms = mass * np.exp(-away / square) / (np.pi * square)
    assert found == pytest.approx(
        terms.sum(1, where=away > 0), rel=1e-6
    )  # neighbours beyond exp(-16) are left out


@pytest.mark.parametrize("range_um", [0.041, 0.16, 0.4])
def test_narrow_ranges_see_exact_discs(range_um):
    """Non-central chi-square round the rim; those asked about come in any order, and
    not all of them.
    """
    x, y, mass, radius = every = pillars(6, n=14)
    some = np.random.default_rng(1).permutation(len(x))[:40]
    found = Pairs.of(radius, range_um)(tuple(v[some] for v in every), every)
    turn = 2 * np.pi * (np.arange(96) + 0.5) / 96
    want = np.zeros(40)
    for m, n in enumerate(some.tolist()):
        others = np.arange(len(x)) != n
        ring_x, ring_y = (
            x[n] + radius[n] * np.cos(turn)[:, None],
            y[n] + radius[n] * np.sin(turn)[:, None],
        )
        square = (ring_x - x[others]) ** 2 + (ring_y - y[others]) ** 2
        given = special.chndtr(
            2 * (radius[others] / range_um) ** 2, 2.0, 2 * square / range_um**2
        )
        want[m] = (given * mass[others] / (np.pi * radius[others] ** 2)).mean(0).sum()
    # between twelve radii and 46 gaps of a function that is nearly straight: 0.7 % of a
    # neighbour that touches
    assert found == pytest.approx(want, rel=7e-3, abs=2e-6)


def test_the_rim_of_a_disc_by_another_is_the_mean_of_an_integral():
    """Exposure at a distance s of a disc of radius R by exp(-r² / a²) / (pi a²), ring
    by ring, over the rim.
    """
    a, seen, other, gap = 0.16, 0.071, 0.093, 0.11

    def exposure(s):
        return integrate.quad(
            lambda r: (
                2
                * r
                / a**2
                * math.exp(-((r - s) ** 2) / a**2)
                * special.i0e(2 * r * s / a**2)
            ),
            0,
            other,
        )[0]

    apart, turns = seen + other + gap, (np.arange(64) + 0.5) * 2 * math.pi / 64
    want = np.mean(
        [
            exposure(math.sqrt(apart**2 + seen**2 - 2 * apart * seen * math.cos(t)))
            for t in turns
        ]
    )
    pairs = Pairs.of(np.array([0.05, seen, other, 0.1]), a)
    x, y = np.array([3.0, 3.0 + apart * 0.6]), np.array([7.0, 7.0 + apart * 0.8])
    radius, dose = np.array([seen, other]), np.array([1.3, 0.8])
    mass = dose * math.pi * radius**2
    got = pairs((x[:1], y[:1], mass[:1], radius[:1]), (x, y, mass, radius))
    assert got[0] == pytest.approx(
        0.8 * want, rel=2e-3
    )  # what is interpolated is nearly straight in the gap
    assert reach_um(a, 0.2) == pytest.approx(0.2 + 6 * a)  # exp(-36) is nothing


def test_a_table_holds_its_radii_and_gaps_up_to_where_discs_are_gaussians():
    """Twelve radii, 46 gaps of six ranges; beyond 1.5 of the widest diameter, 0.45,
    there is none.
    """
    radius = np.array([0.09, 0.15, 0.04])
    narrow, wide = Pairs.of(radius, 0.449), Pairs.of(radius, 0.451)
    assert narrow.log_mean.shape == (12, 12, 46)
    assert narrow.least_um == 0.04
    assert narrow.step_um == pytest.approx(0.01)
    assert narrow.gap_um == pytest.approx(6 * 0.449 / 45)
    assert narrow.reach_um == pytest.approx(0.3 + 6 * 0.449)
    assert wide.log_mean.size == 0
    assert wide.reach_um == pytest.approx(4 * 0.451)


@pytest.mark.parametrize(("a", "step"), [(0.2, 7), (0.041, 20), (0.25, 35)])
def test_discs_of_one_size_see_each_other_too(a, step):
    """The exact mean over the rim of the second, by chi-square, at gaps of the table:
    up to 4.7 ranges, 1.2 um.
    """
    turn, r, gap = 2 * np.pi * (np.arange(96) + 0.5) / 96, 0.1, 6 * a / 45 * step
    apart = 2 * r + gap
    square = apart**2 + r**2 - 2 * apart * r * np.cos(turn)
    want = special.chndtr(2 * (r / a) ** 2, 2.0, 2 * square / a**2).mean()
    both = (
        np.array([1.0, 1.0]),
        np.array([2.0, 2.0 + apart]),
        np.full(2, 0.7 * np.pi * r**2),
        np.full(2, r),
    )
    pairs = Pairs.of(both[3], a)
    assert pairs.step_um == pytest.approx(1e-6 * r / 11, rel=1e-6)
    assert pairs(both, both) == pytest.approx(
        [0.7 * want] * 2, rel=1e-5
    )  # radii 1e-6 of one apart


def test_what_lies_beyond_four_widths_of_a_gaussian_is_nothing():
    """exp(-16), of the Gaussian's own width: of the range, half of the other's and once
    the own radius, squared.
    """
    out_of = 4 * math.sqrt(0.5**2 + 0.1**2 / 2 + 0.07**2)
    for apart, want in (
        (out_of * 0.999, math.exp(-16 * 0.999**2) * 0.01 / (out_of / 4) ** 2),
        (out_of * 1.001, 0),
    ):
        x, y = np.array([5.0, 5.0 - 0.28 * apart]), np.array([1.0, 1.0 + 0.96 * apart])
        radius = np.array([0.07, 0.1])
        every = x, y, np.pi * radius**2, radius
        got = Pairs.of(radius, 0.5)(tuple(v[:1] for v in every), every)
        assert got[0] == pytest.approx(
            want, rel=1e-6, abs=1e-17
        )  # beside the pillar's own, taken off: 0.02


def test_between_nodes_a_table_is_straight_along_every_axis_and_at_its_ends():
    """A function linear in all three at once, read where it is known: at nodes, between
    them, on the last of each.
    """
    i, j, k = np.meshgrid(np.arange(3.0), np.arange(4.0), np.arange(5.0), indexing="ij")
    table = 0.3 * i - 0.2 * j * k + 0.1 * i * j * k - 0.05
    mean = getattr(
        neighbours._mean, "py_func", neighbours._mean
    )  # as written: a place beyond the table is an error
    for one, two, gap in (
        (0.0, 0.0, 0.0),
        (0.4, 2.7, 3.2),
        (1.6, 1.1, 0.8),
        (2.0, 3.0, 4.0),
        (-1e-12, 3.0, 4.0),
    ):
        want = 0.3 * one - 0.2 * two * gap + 0.1 * one * two * gap - 0.05 - 0.7
        assert mean(table, one, two, gap, 0.7) == pytest.approx(
            math.exp(want), rel=1e-9
        )
    uneven = np.random.default_rng(2).normal(size=(3, 4, 5))
    for place in ((0, 3, 4), (2, 1, 2), (1, 2, 0)):
        assert mean(uneven, *map(float, place), 0.0) == pytest.approx(
            math.exp(uneven[place]), rel=1e-12
        )
