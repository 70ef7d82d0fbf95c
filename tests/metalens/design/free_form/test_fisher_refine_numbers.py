"""What the solver of the last steps is told: values, slopes, what is missing, bounds;
and which point is kept.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.design.free_form import refine as last

START = torch.tensor([[0.2, -0.4, 0.7], [0.1, 0.3, -0.9]], dtype=torch.float64)
ASKED = SimpleNamespace(encircled=0.6, refine=17)


class Known:
    """Loss Σ (x - 1)², energies 0.7 - x₀ / 4 and 0.8 + x₃ / 2 of what is built, twice
    the controls.
    """

    def __init__(self):
        self.asked = 0

    def loss(self, phase, focus_um, generator):
        assert (focus_um, generator) == (19e3, None)
        self.asked += 1
        x = phase / 2
        return ((x - 1) ** 2).sum(), torch.stack([0.7 - x[0, 0] / 4, 0.8 + x[1, 0] / 2])


def told(monkeypatch, points):
    """The result of a solver that looks at these points, what it was given, and what it
    saw.
    """
    given, seen = {}, []

    def climb(start, value, constraint, **about):
        given.update(about, start=start.copy())
        for x in points:
            slope, missing, slopes = np.zeros(6), np.zeros(2), np.zeros((2, 6))
            seen.append((value(x, slope), slope))
            constraint(missing, x, slopes)
            seen[-1] += (missing, slopes)
        value(points[-1], np.zeros(0))
        constraint(np.zeros(2), points[-1], np.zeros((0, 0)))

    monkeypatch.setattr(last, "_climb", climb)
    known = Known()
    found = last.refine(START, lambda controls: 2 * controls, known, ASKED, 19e3)
    return found, given, seen, known


def test_the_solver_is_told_loss_and_missing_energy_with_their_slopes(monkeypatch):
    """0.601 less the energies: a thousandth more is asked for than is held. Once a
    point is known it is not asked
    again, whatever of it is wanted."""
    x = np.array([0.3, 0.5, -0.2, -0.1, 0.9, 0.4])
    _, given, seen, known = told(monkeypatch, [x])
    assert given["constraints"] == 2
    assert given["evaluations"] == 17
    assert given["start"] == pytest.approx(START.numpy().ravel())
    value, slope, missing, slopes = seen[0]
    assert value == pytest.approx(((x - 1) ** 2).sum(), rel=1e-12)
    assert slope == pytest.approx(2 * (x - 1), rel=1e-12)
    assert missing == pytest.approx(
        [0.601 - 0.7 + 0.3 / 4, 0.601 - 0.8 + 0.1 / 2], rel=1e-9
    )
    want = np.zeros((2, 6))
    want[0, 0], want[1, 3] = 0.25, -0.5
    assert slopes == pytest.approx(want, abs=1e-12)
    assert known.asked == 2  # the start and x


def test_the_best_point_that_holds_its_energy_is_kept(monkeypatch):
    """x₀ up to 0.4 holds 0.6, to the margin of a thousandth: 0.3999 is kept and 0.4001
    is not, however low.
    """
    best = np.array([0.3999, 0.6, 0.6, 0.6, 0.6, 0.6])
    lost = np.array([0.4001, 0.9, 0.9, 0.9, 0.9, 0.9])
    worse = np.array([0.1, 0.5, 0.5, 0.5, 0.5, 0.5])
    for points in ([worse, best, lost], [best, lost, worse], [lost, best]):
        found, *_ = told(monkeypatch, points)
        assert found.shape == (2, 3)
        assert found.numpy().ravel() == pytest.approx(best, rel=1e-15)
    found, *_ = told(monkeypatch, [lost])
    assert torch.equal(found, START)  # it held


def test_the_solver_stays_within_half_a_radian_and_its_evaluations():
    """A slope to +∞ in the first number and to -∞ in the second; a constraint that
    never binds.
    """
    seen = []

    def value(x, gradient):
        seen.append(x.copy())
        if gradient.size:
            gradient[:] = [-1.0, 2.0]
        return 2 * x[1] - x[0]

    def constraint(result, x, gradient):
        result[:] = -1.0
        if gradient.size:
            gradient[:] = 0.0

    last._climb(np.array([0.2, -0.7]), value, constraint, constraints=1, evaluations=9)
    assert 2 <= len(seen) <= 9
    places = np.array(seen)
    assert places.min(0) == pytest.approx([0.2, -1.2], abs=1e-9)
    assert places.max(0) == pytest.approx([0.7, -0.7], abs=1e-9)
    seen.clear()

    def wavy(x, gradient):
        seen.append(x.copy())
        if gradient.size:
            gradient[:] = 3 * np.cos(9 * x) + x
        return float((np.sin(9 * x) / 3 + x**2 / 2).sum())

    last._climb(np.array([0.2, -0.7]), wavy, constraint, constraints=1, evaluations=4)
    assert len(seen) == 4
