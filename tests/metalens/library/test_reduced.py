"""Reduced order in the diameter against exact solves at diameters that it never saw."""

import functools

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell.record import Cell, Index
from metalens.cell.response import Response
from metalens.core.errors import DomainError
from metalens.library import curve as reduced

# 850 nm: a dip near 194 nm, a steep flank near 302, one of 10 pm near 282
HARD = Cell(0.40, 0.7, Index(3.6))
SPAN = (0.08, 0.32)


@functools.cache
def exact(diameter_um: float) -> Response:
    """A small truncation is a function of the diameter like any other: its own
    truncation error does not matter.
    """
    return rcwa.solve(HARD, diameter_um, 0.85, harmonics=6)


def explored(tolerance: float) -> reduced.ResponseCurve:
    nodes = reduced.sample_adaptively(exact, *SPAN, tolerance=tolerance)
    # so that the estimate of the interpolation stands alone
    silent = np.zeros_like(nodes.error)
    nodes = reduced.SolvedNodes(
        nodes.diameter_um, nodes.response, silent, nodes.converged
    )
    return reduced.fit_response_curve(nodes, tolerance=tolerance)


def violations(curve: reduced.ResponseCurve, count: int) -> tuple[int, float, float]:
    """(entries whose error is above its estimate, largest error, largest estimate) at
    random diameters.
    """
    d = np.random.default_rng(7).uniform(*SPAN, count)
    value, estimate = curve(d)
    error = abs(value[:, 0] - [exact(float(x)).t for x in d])
    return int((error > estimate).sum()), float(error.max()), float(estimate.max())


@pytest.mark.parametrize(("tolerance", "most"), [(1e-3, 45), (1e-6, 60)])
def test_estimate_holds_on_held_out_diameters(tolerance, most):
    curve = explored(tolerance)
    assert curve.nodes.converged
    assert len(curve.nodes.diameter_um) <= most
    wrong, error, estimate = violations(curve, 400)
    assert wrong == 0
    assert error < tolerance
    assert estimate < 2 * tolerance


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [1e-3, 1e-4, 1e-6])
def test_estimate_holds_on_ten_thousand_held_out_diameters(tolerance):
    wrong, error, _ = violations(explored(tolerance), 10_000)
    assert wrong <= 10
    assert error < tolerance


def test_resonances_are_the_poles():
    found = explored(1e-4).resonances()
    sharpest = found[np.argmin(found[:, 1])]
    assert sharpest[1] < 3e-5
    assert 0.275 < sharpest[0] < 0.29
    level = [abs(exact(float(sharpest[0] + k * sharpest[1])).t) for k in (-1, 0, 1)]
    assert max(level) - min(level) > 0.2  # t turns within one half-width


def test_nodes_return_what_was_solved():
    curve = explored(1e-3)
    value, estimate = curve(curve.nodes.diameter_um)
    assert np.array_equal(value, curve.nodes.response)
    assert np.array_equal(estimate, curve.nodes.error)


def test_outside_the_nodes_is_refused():
    with pytest.raises(DomainError, match="the curve holds"):
        explored(1e-3)(np.array([0.33]))


def test_too_few_solves_say_so():
    nodes = reduced.sample_adaptively(exact, *SPAN, tolerance=1e-6, most=20)
    assert not nodes.converged
    assert len(nodes.diameter_um) == 20


def test_the_solvers_error_enters_the_estimate():
    def coarse(diameter_um: float) -> Response:
        made = exact(diameter_um)
        return Response(
            made.t, made.r, 0.02, made.orders, made.energy, made.engine, True, ""
        )

    curve = reduced.fit_response_curve(
        reduced.sample_adaptively(coarse, *SPAN, tolerance=1e-3), tolerance=1e-3
    )
    d = np.linspace(*SPAN, 400)
    estimate = curve(d)[1]
    assert estimate.min() > 0.01
