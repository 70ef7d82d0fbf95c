"""Phase and level of all pillars in one pass, against the polynomials written out as
powers of the diameter.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell
from metalens.cell.shapes import Rectangle
from metalens.ground.errors import DomainError
from metalens.lens import DiameterMap, Lens, Pairs, answers
from metalens.pillars import Proxy

PHASE, LEVEL = np.array([[9.0, 7.0, 0.5, -0.2]]), np.array([[0.8, 0.15, 0.05001]])
RANGE = (0.1, 0.3)


def proxy(power=1):
    return Proxy(PHASE, LEVEL, RANGE, (0.85, 0.85), 0.0, 0.0, power=power)


def by_hand(d, power):
    """Chebyshev polynomials by their cosines, of the diameter to a power between its
    ends.
    """
    low, high = RANGE[0] ** power, RANGE[1] ** power
    x = np.clip((2 * d**power - low - high) / (high - low), -1, 1)
    angle = np.arccos(x)
    phase = sum(c * np.cos(n * angle) for n, c in enumerate(PHASE[0]))
    level = np.minimum(sum(c * np.cos(n * angle) for n, c in enumerate(LEVEL[0])), 1.0)
    there = d > 0
    return np.where(there, phase, 0), np.where(there, level, 0)


def sizes(columns=7):
    """Five rows with a gap, the ends among them."""
    d = np.random.default_rng(3).uniform(*RANGE, (5, columns))
    d[1, 2], d[4, 0], d[3, -1] = 0.0, RANGE[0], RANGE[1]
    return d


def wrapped(phase):
    return phase - 2 * math.pi * np.rint(phase / (2 * math.pi))


@pytest.mark.parametrize("power", [1, 2, 3])
@pytest.mark.parametrize("columns", [7, 1031])  # one part of a row, and three
def test_every_pillar_has_its_wrapped_phase_and_its_level(power, columns):
    d = sizes(columns)
    phase, level = np.full(d.shape, 9.0), np.full(d.shape, 9.0)
    answers.put_all(proxy(power), d, (0.85, 0.0), phase, level)
    want = by_hand(d, power)
    assert phase == pytest.approx(
        wrapped(want[0]), abs=1e-12
    )  # rounding of phases of some ten
    assert level == pytest.approx(want[1], abs=1e-13)
    assert np.abs(want[0]).max() > 4 * math.pi  # whole turns come off
    assert level[3, -1] == 1.0  # the polynomial reaches 1.00001 there


def test_a_turn_is_added_before_whole_turns_come_off():
    d = sizes()
    turn = np.random.default_rng(5).uniform(-9, 9, d.shape)
    phase, level = np.zeros(d.shape, np.float32), np.zeros(d.shape, np.float32)
    answers.put_all(proxy(), d, (0.85, 0.0), phase, level, turn)
    want = by_hand(d, 1)
    away = np.where(d > 0, want[0] + turn - phase, 0) / (2 * math.pi)
    assert (
        np.abs(away - np.rint(away)).max() < 1e-7
    )  # float32: 2^-24 of half a turn, and its cast
    assert phase[1, 2] == level[1, 2] == 0
    assert np.abs(phase).max() <= np.float32(math.pi)
    assert level == pytest.approx(want[1], abs=1e-7)


def lens(d, **other):
    return Lens(DiameterMap(d, 0.4, **other.pop("map", {})), Cell(0.4, shape=Rectangle(0.6)), proxy(), 0.85, 100.0,
                math.inf, "map", **other)  # fmt: skip


@pytest.mark.parametrize(("hand", "twice"), [("left", -2), ("right", 2)])
def test_a_lens_fills_maps_with_its_own_turns(hand, twice):
    d, turn = sizes(), np.random.default_rng(5).uniform(0, 3, (5, 7))
    phase, level = np.zeros(d.shape), np.zeros(d.shape)
    answers.fill(lens(d, map={"angle_rad": turn}, hand=hand), (0.85, 0.0), phase, level)
    want = by_hand(d, 1)
    assert phase == pytest.approx(
        np.where(d > 0, wrapped(want[0] + twice * turn), 0), abs=1e-12
    )
    answers.fill(lens(d), (0.85, 0.0), phase, level)
    assert phase == pytest.approx(wrapped(want[0]), abs=1e-12)
    assert level == pytest.approx(want[1], abs=1e-13)


def test_a_table_of_two_sizes_is_wrapped_too():
    x, y = np.array([0.1, 0.2]), np.array([0.12, 0.17, 0.22])
    t = np.random.default_rng(2).uniform(0.3, 0.9, (1, 2, 3, 2)) * np.exp(
        1j * np.array(3.1)
    )
    d, long = np.array([[0.1, 0.2, 0.0]]), np.array([[0.22, 0.12, 0.0]])
    pairs = Pairs(np.array([0.85]), x, y, t, (100.0, 900.0))
    one = Lens(DiameterMap(d, 0.4, length_um=long), Cell(0.4, shape=Rectangle()), pairs.proxy, 0.85, 100.0, 900.0,
               "map", pairs=pairs)  # fmt: skip
    phase, level = np.zeros((1, 3)), np.zeros((1, 3))
    answers.fill(one, (0.85, 0.0), phase, level)
    assert phase[0] == pytest.approx([3.1, 3.1, 0.0])
    assert level[0] == pytest.approx([abs(t[0, 0, 2, 0]), abs(t[0, 1, 0, 0]), 0.0])


def test_diameters_beyond_the_proxy_are_refused_and_gaps_are_not():
    assert len(answers.polynomials(proxy(), np.zeros((2, 2)), (0.85, 0.0))) == 6
    for wrong in (0.0999, 0.3001):
        with pytest.raises(DomainError):
            answers.polynomials(
                proxy(), np.array([[0.0, 0.2], [wrong, 0.25]]), (0.85, 0.0)
            )
    scale, shift, power, ceiling, in_phase, in_level = answers.polynomials(
        proxy(2), sizes(), (0.85, 0.0)
    )
    assert (scale, shift) == pytest.approx(
        (25.0, -1.25)
    )  # 0.01 to 0.09: twice over 0.08, and the middle 0.05
    assert (power, ceiling) == (2, 1.0)
    assert (len(in_phase), len(in_level)) == (4, 3)
