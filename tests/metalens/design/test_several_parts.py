"""Tables, starts and pistons of the search for pillars of several wavelengths, each by
what it promises.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.design import several
from metalens.pillars import Proxy

DRAW = np.random.default_rng(53)
WAVES, WEIGHTS, SPAN = (0.50, 0.57, 0.61), np.array([1.3, 0.4, 2.2]), (0.09, 0.29)


def proxy():
    """Up to 3.5 turns over the diameters, of curves that bend, |T| from 0.84 to 0.99."""
    phase = np.array([[0.5, 9.3, 0.7], [-0.8, -1.2, 0.35], [0.1, 0.2, 0.0]])
    return Proxy(
        phase, np.array([[0.9, 0.06], [0.03, 0.0]]), (0.08, 0.3), (0.5, 0.61), 0.0, 0.0
    )


def stock(span=SPAN):
    return several._stock(proxy(), span, WAVES, WEIGHTS)


def test_steps_of_the_table_are_a_twentieth_of_a_radian_at_the_wavelength_that_turns_most():
    made = stock()
    assert made.sizes_um[[0, -1]] == pytest.approx(SPAN)
    assert np.diff(made.sizes_um) == pytest.approx(made.sizes_um[1] - made.sizes_um[0])
    turned = np.array(
        [np.abs(np.diff(proxy().phase_rad(made.sizes_um, wave))) for wave in WAVES]
    )
    assert 0.0495 < turned.max() <= 0.05 * (1 + 1e-3)  # slopes are looked at 513 places
    few = stock((0.2, 0.202))
    assert len(few.sizes_um) == 64


def test_sums_are_those_of_squared_distances_less_the_weights():
    """Σ w |t - exp(i phase)|² of pillars, all sizes of the table: single precision of
    sums of 8.
    """
    made = stock()
    phases = DRAW.uniform(-9, 9, (3, 7))
    t = np.stack(
        [
            proxy().transmission(made.sizes_um, w)
            * np.exp(1j * proxy().phase_rad(made.sizes_um, w))
            for w in WAVES
        ]
    )
    away = np.abs(t[:, None] - np.exp(1j * phases)[..., None]) ** 2
    want = np.einsum("l,lpn->pn", WEIGHTS, away)
    assert made.sums(phases) + WEIGHTS.sum() == pytest.approx(want, abs=2e-5)
    assert made.nearest(phases).tolist() == want.argmin(1).tolist()


def test_between_sizes_of_the_table_the_vertex_of_a_parabola_is_taken():
    made = several._Stock(np.array([2.0, 2.5, 3.0, 3.5, 4.0]), *[np.empty(0)] * 3)
    sizes = made.sizes_um
    sums = np.array([
        3.0 * (sizes - 3.1) ** 2 - 7,  # inside
        0.4 * (sizes - 2.26) ** 2,  # nearer the second
        (sizes - 1.0) ** 2,  # least at either end: the end itself
        (sizes - 9.0) ** 2,
        [5.0, 1.0, 1.0, 1.0, 5.0],  # flat to one side: half way to the middle
    ])  # fmt: skip
    assert made._between(sums) == pytest.approx([3.1, 2.26, 2.0, 4.0, 2.75])


@pytest.mark.parametrize("count", [1, 2, 3])
def test_sixteen_starts_are_spread_over_all_turns(count):
    """Roots of x^(n+1) = x + 1: the golden ratio, the plastic number, 1.2207; powers of
    their inverse are the steps.
    """
    root = max(
        r.real for r in np.roots([1, *[0] * (count - 1), -1, -1]) if abs(r.imag) < 1e-9
    )
    made = several._starts(count)
    assert made.shape == (16, count)
    for k, row in enumerate(made):
        assert row == pytest.approx(
            [2 * math.pi * (k * root ** -(i + 1) % 1) for i in range(count)], abs=1e-9
        )


def test_the_start_that_ends_lowest_is_taken(monkeypatch):
    ends = iter([(5.0, "a"), (-2.0, "b"), (3.0, "c"), *[(0.0, "d")] * 13])
    monkeypatch.setattr(
        several._Stock, "_settled", lambda self, phases, start: next(ends)
    )
    assert stock().pistons(DRAW.uniform(-9, 9, (3, 40))) == "b"


def test_pillars_and_pistons_in_turn_end_where_neither_lowers_the_sum():
    """From every start the pistons are the phases of Σ t exp(-i phase) of the pillars
    they pick, and the sum is that
    of both. A step of the table moves a mean over 60 pillars by 1e-3 rad: a few of them
    are left."""
    made, phases = stock(), DRAW.uniform(-9, 9, (3, 60))
    for start in several._starts(3)[:4]:
        total, pistons = made._settled(phases, start)
        pick = made.nearest(phases + pistons[:, None])
        best = np.angle((made.t[:, pick] * np.exp(-1j * phases)).sum(1))
        assert np.abs(np.angle(np.exp(1j * (best - pistons)))).max() < 5e-3
        assert total == pytest.approx(
            float(made.sums(phases + pistons[:, None]).min(1).sum()), rel=1e-5
        )
        again = made._settled(phases, pistons)[0]
        assert again <= total + 1e-4


def test_some_sites_are_picked_evenly_the_ends_among_them(monkeypatch):
    monkeypatch.setattr(several, "_SAMPLE", 5)
    blocks = [
        ("rows", "inside", np.arange(6.0)),
        ("rows", "inside", np.arange(6.0, 13.0)),
    ]
    place = SimpleNamespace(
        blocks=lambda phase: [(a, b, phase * c) for a, b, c in blocks]
    )
    found = several._sampled(
        place, [SimpleNamespace(phase=1.0), SimpleNamespace(phase=-2.0)]
    )
    assert found.tolist() == [[0, 3, 6, 9, 12], [0, -6, -12, -18, -24]]
