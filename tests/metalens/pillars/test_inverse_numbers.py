"""Diameters of a phase by inverses in closed form: lines in the area, rising and
falling, below and above a turn.
"""

import math

import numpy as np
import pytest
import torch

from metalens.ground.errors import DomainError
from metalens.pillars import inverse, polynomial
from metalens.pillars.polynomial import Curve

TURN = 2 * math.pi
LOW, HIGH = 0.1, 0.3


def line(middle, half):
    """Phase middle + half x, where x runs from -1 to 1 as the area does."""
    return Curve((middle, half), LOW, HIGH, 2)


def at(x):
    """Diameter of x."""
    return np.sqrt((LOW**2 + HIGH**2 + x * (HIGH**2 - LOW**2)) / 2)


def test_phases_of_more_than_a_turn_are_met_from_the_end_of_least_phase_on():
    """From -3 to 5 rad: whole turns beside them are the same pillar; of two that are
    alike, the one of less phase.
    """
    for half in (4.0, -4.0):
        phase = np.array(
            [-2.9, 0.3, 3.28, -3.0 + TURN + 0.1, 40 * TURN + 0.3, -7 * TURN + 0.3]
        )
        least = np.array([-2.9, 0.3, 3.28, -2.9, 0.3, 0.3])
        found = inverse.diameter(line(1.0, half), phase, within_um=None, gap="refuse")
        assert found == pytest.approx(at((least - 1.0) / half), rel=1e-9)


def test_phases_that_no_pillar_has_go_to_the_nearer_end_or_are_refused():
    """From 0.5 to 3.5 rad, 3 rad of a turn: up to the middle of the rest the widest is
    nearer, then the thinnest.
    """
    p, middle = line(2.0, 1.5), 3.5 + (TURN - 3.0) / 2
    phase = np.array([[0.5, 3.5, 2.0], [middle - 0.01, middle + 0.01, 0.49 + TURN]])
    found = inverse.diameter(p, phase, within_um=None, gap="nearest")
    assert found == pytest.approx(
        np.array([[LOW, HIGH, at(0)], [HIGH, LOW, LOW]]), rel=1e-9
    )
    with pytest.raises(
        DomainError, match=r"index \(1, 0\).*0\.477 of a turn \(3 sites\)"
    ):
        inverse.diameter(p, phase, within_um=None, gap="refuse")
    just = np.array([3.5 + 0.9e-6, 0.5 + TURN])  # a millionth of a rad is rounding
    assert inverse.diameter(p, just, within_um=None, gap="refuse") == pytest.approx(
        [HIGH, LOW], rel=1e-5
    )
    with pytest.raises(DomainError, match=r"index \(0,\)"):
        inverse.diameter(p, np.array([3.5 + 1.1e-6]), within_um=None, gap="refuse")


def test_within_a_part_of_the_domain_and_for_one_number():
    """Between x = -1/2 and 1/4 the phase runs from 1.25 to 2.375 rad."""
    ends = float(at(-0.5)), float(at(0.25))
    found = inverse.diameter(line(2.0, 1.5), 1.9, within_um=ends, gap="refuse")
    assert float(found) == pytest.approx(float(at(-0.1 / 1.5)), rel=1e-9)
    assert np.shape(found) == ()
    assert float(
        inverse.diameter(line(2.0, 1.5), 1.0, within_um=ends, gap="nearest")
    ) == pytest.approx(ends[0])
    assert (
        inverse.diameter(
            line(2.0, 1.5), np.float32([2.0]), within_um=None, gap="refuse"
        ).dtype
        == np.float32
    )
    for wrong in ((0.2, 0.2), (0.09, 0.2), (0.2, 0.31), (0.25, 0.2)):
        with pytest.raises(DomainError, match="inside the curve's domain"):
            inverse.diameter(line(2.0, 1.5), 2.0, within_um=wrong, gap="refuse")


def test_a_phase_that_is_no_number_and_a_curve_that_turns_back_are_refused():
    with pytest.raises(DomainError, match=r"index \(1, 0\) is not finite"):
        inverse.diameter(
            line(2.0, 1.5),
            np.array([[1.0, 2.0], [math.nan, math.inf]]),
            within_um=None,
            gap="nearest",
        )
    bent = Curve((0.0, 1.0, 1.0), LOW, HIGH)  # x + x², least at x = -1/2
    with pytest.raises(DomainError, match="not monotone"):
        inverse.diameter(bent, np.array([0.5]), within_um=None, gap="nearest")
    rising = float(0.2 + 0.1 * -0.49), HIGH
    found = inverse.diameter(bent, np.array([0.75]), within_um=rising, gap="refuse")
    assert found == pytest.approx([0.2 + 0.1 * 0.5], rel=1e-9)  # 1/2 + 1/4


def test_a_tensor_has_the_derivative_of_the_inverse():
    """d = sqrt(a + b phase): d' = b / (2 d), with b = (HIGH² - LOW²) / (2 half)."""
    phase = torch.tensor([0.9, 2.7], dtype=torch.float64, requires_grad=True)
    found = inverse.diameter(line(2.0, 1.5), phase, within_um=None, gap="refuse")
    assert found.tolist() == pytest.approx(
        at((np.array([0.9, 2.7]) - 2.0) / 1.5).tolist(), rel=1e-9
    )
    (found * torch.tensor([1.0, -3.0])).sum().backward()
    rate = (HIGH**2 - LOW**2) / (2 * 1.5) / (2 * found.detach().numpy())
    assert phase.grad.tolist() == pytest.approx((rate * [1, -3]).tolist(), rel=1e-9)


def test_one_step_from_the_table_is_the_rule(monkeypatch):
    """4095 steps of 2 rad: between two, phase is a line of the diameter to 1e-7 rad,
    squared beyond rounding.
    """
    slope_of, steps = polynomial.slope_of, []
    monkeypatch.setattr(
        polynomial, "slope_of", lambda p, d: steps.append(len(d)) or slope_of(p, d)
    )
    for half in (1.0, -1.0):
        steps.clear()
        phase = np.linspace(1.0, 3.0, 701)
        found = inverse.diameter(line(2.0, half), phase, within_um=None, gap="refuse")
        assert found == pytest.approx(at((phase - 2.0) / half), rel=1e-9)
        assert steps == [701]
