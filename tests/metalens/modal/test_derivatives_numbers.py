"""Derivatives of t: both forms on a tiny mesh by differences, their mean, and what a
change of units makes of them.
"""

import cmath
import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.cell.light import Light
from metalens.cell.record import Cell, Index
from metalens.modal import derivatives
from metalens.modal.case import case_of
from metalens.modal.derivatives import form_rates, mean_rate
from metalens.modal.engine import geometric_mean
from metalens.modal.mesh import MeshPlan

PLAN = MeshPlan(1, 2, 1)
CELL = Cell(0.42, 0.63, Index(2.9, 0.03), Index(1.46), Index(1.2), Index(1.1))


def drawn(seed, tiny=0.0):
    rng = np.random.default_rng(seed)
    matrix = rng.normal(size=(2, 2)) + 1j * rng.normal(size=(2, 2))
    return matrix if not tiny else np.array([[1.0, 2.0], [3.0, 6.0 + tiny]]) + 0j


@pytest.mark.parametrize("kind", ["near", "apart", "of no inverse", "opposite"])
def test_the_rate_of_a_mean_is_its_difference(kind):
    """Where the mean is no root of a ratio, neither is its rate: matrices without an
    inverse, ratios of trace 0.
    """
    first = drawn(1, 1e-3 if kind == "of no inverse" else 0.0)
    rates = drawn(2), drawn(3)
    second = {
        "near": first @ (np.eye(2) + 0.1 * drawn(4)),
        "apart": first @ np.diag([2.0, 0.4 + 0.3j]),
        "of no inverse": drawn(4),
        "opposite": first
        @ np.diag([cmath.exp(1.5405j), cmath.exp(-1.5405j)])
        @ np.diag([1.0, -1.0])
        * 1j,
    }[kind]
    step = 1e-5
    high, low = (
        geometric_mean(first + s * rates[0], second + s * rates[1])
        for s in (step, -step)
    )
    found = mean_rate(first, second, *rates)
    assert found == pytest.approx(
        (high - low) / (2 * step), rel=1e-6, abs=1e-7
    )  # third derivatives, 1e-9 here
    if kind == "of no inverse":
        assert found == pytest.approx((rates[0] + rates[1]) / 2)


CASES = {
    "upright": (0.0, "x"),
    "s": (0.35, "s"),
    "p": (-0.35, "p"),
}


@pytest.mark.parametrize("magnetic", [False, True])
@pytest.mark.parametrize("light", list(CASES))
def test_rates_of_a_form_are_differences(monkeypatch, light, magnetic):
    """Of every number of the case, in half pitches, one after the other; with an angle
    of what that changes.
    """
    angle, polarization = CASES[light]
    case = case_of(CELL, 0.21, Light(0.85, angle, polarization))
    matrix, rates = form_rates(case, PLAN, magnetic=magnetic)
    names = {"k0", "disc", "around", "rho", "height", "below", "above"} | (
        {"bloch"} if angle else set()
    )
    assert set(rates) == names
    monkeypatch.setattr(
        derivatives, "changes", lambda *_: {}
    )  # of the ends the matrix alone is wanted
    for name in ("k0", "rho", "bloch", "above") if angle else names:
        step = 1e-4
        ends = [
            form_rates(
                dataclasses.replace(case, **{name: getattr(case, name) + d}),
                PLAN,
                magnetic=magnetic,
            )[0]
            for d in (step, -step)
        ]
        want = (ends[0] - ends[1]) / (2 * step)
        assert (
            np.abs(rates[name] - want).max() < 1e-5 * np.abs(want).max() + 1e-7
        )  # third derivatives 1e-7
    assert matrix.shape == (2, 2)


def test_a_gradient_is_in_the_units_of_its_names(monkeypatch):
    """Forms of known rates: each reaches the entry of light that passes upwards, with
    the factor of its own unit.
    """
    base = {
        "k0": 0.3 - 1j,
        "disc": 0.7j,
        "around": 0.2,
        "rho": 1.1 + 0.4j,
        "height": -0.6,
        "below": 0.05j,
    }
    base |= {"above": -0.11, "bloch": 0.9 - 0.2j}
    asked = []

    def rates(case, plan, *, magnetic):
        asked.append((plan, magnetic))
        matrix = np.array([[0.1, 0.7j], [0.7j, 0.2]])
        return matrix, {
            name: np.array([[0, 5.0], [value, 0]]) for name, value in base.items()
        }

    monkeypatch.setattr(derivatives, "form_rates", rates)
    rung = SimpleNamespace(
        choice=lambda rho: SimpleNamespace(plan=("plan of", round(rho, 9)))
    )
    monkeypatch.setattr(
        derivatives, "climb", lambda case, tolerance: SimpleNamespace(rung=rung)
    )
    monkeypatch.setattr(derivatives, "geometric_mean", lambda first, second: first)
    monkeypatch.setattr(
        derivatives,
        "mean_rate",
        lambda first, second, d_first, d_second: (d_first + d_second) / 2,
    )
    slopes = {"pillar": 0.31, "between": -0.17, "substrate": 0.23, "cover": 0.41}
    monkeypatch.setattr(derivatives, "slope", lambda part, wave: slopes[part])
    indices = {"pillar": 2.9 + 0.03j, "between": 1.1, "substrate": 1.46, "cover": 1.2}
    monkeypatch.setattr(derivatives, "index", lambda part, wave: indices[part])
    named = SimpleNamespace(pitch_um=0.42, **{name: name for name in slopes})
    for angle in (0.35, -0.35):
        case = case_of(CELL, 0.21, Light(0.85, abs(angle), "s"))
        monkeypatch.setattr(
            derivatives, "case_of", lambda cell, d, light, case=case: case
        )
        found = derivatives.gradient(
            named, 0.21, 0.85, angle_rad=angle, polarization="s"
        )
        assert found.t == 0.7j
        assert found.diameter_um == pytest.approx(base["rho"] / 0.42)
        assert found.height_um == pytest.approx(base["height"] / 0.21)
        assert found.n == pytest.approx(2 * (2.9 + 0.03j) * 0.7j)
        assert found.k == pytest.approx(2j * (2.9 + 0.03j) * 0.7j)
        k0 = 2 * math.pi / 0.85 * 0.21
        kx = k0 * math.sin(0.35)
        materials = (
            2 * (2.9 + 0.03j) * 0.31 * 0.7j
            - 2 * 1.1 * 0.17 * 0.2
            + 2 * 1.46 * 0.23 * 0.05j
        )
        materials -= 2 * 1.2 * 0.41 * 0.11
        assert found.wavelength_um == pytest.approx(
            materials - (k0 * base["k0"] + kx * base["bloch"]) / 0.85
        )
        assert found.angle_rad == pytest.approx(
            base["bloch"] * k0 * math.cos(0.35) * math.copysign(1, angle)
        )
    assert asked[:2] == [(("plan of", 0.5), False), (("plan of", 0.5), True)]
