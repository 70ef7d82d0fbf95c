"""Derivatives of ln t by differences through a solver that is a formula: slopes, their
error, what lies between.
"""

import dataclasses

import numpy as np
import pytest

from layout.study.sensitivity import LogSensitivities, compute_sensitivities
from metalens.cell.record import Cell, Index
from metalens.fabrication import ResponseError, named
from tests.layout.study.test_tolerance import hyperbolic

ROWS = named(ResponseError)
SLOPES = {"height_nm": 3.1j, "index": -0.02 + 0.4j, "sidewall_deg": 0.3 + 0.1j}
FINER = {
    "height_nm": 1.03,
    "index": 0.91,
    "sidewall_deg": 1.2,
}  # by how much they differ at the finer truncation


def solver(cell, diameter_um, wavelength_um, finer):
    """ln t is a straight line in every number, so that differences are slopes."""
    now = {
        "height_nm": cell.height_um,
        "index": cell.pillar.n,
        "sidewall_deg": cell.sidewall_rad,
    }
    terms = (
        SLOPES[name] * (FINER[name] if finer else 1) * value
        for name, value in now.items()
    )
    return np.exp(sum(terms) * diameter_um / wavelength_um)


def test_slopes_are_the_finer_ones_and_the_error_is_what_the_coarser_differ_by():
    """The wall's slope is 0.1 and small, and its change is the largest, of its own
    size: 0.2 of 1.2.
    """
    lens = dataclasses.replace(hyperbolic(21), cell=Cell(0.4, 0.61, Index(2.7)))
    found = compute_sensitivities(lens, count=5, solver=solver)
    assert found.diameter_um == pytest.approx(np.linspace(0.1, 0.3, 5))
    for name, slope in SLOPES.items():
        want = slope * FINER[name] * found.diameter_um / 0.85
        assert found.rates[ROWS.index(name)] == pytest.approx(want, rel=1e-9), name
    assert not found.rates[3:].any()
    assert np.linalg.norm(found.rates[2]) < 0.5
    assert found.error == pytest.approx(0.2 / 1.2, rel=1e-9)
    assert found.by_edges(np.array([0.2])) is None


def test_between_the_diameters_rates_are_straight_lines_and_beyond_them_the_end_holds():
    diameter, rate = np.array([0.1, 0.14, 0.3]), np.array([1.0 - 2j, 3.0 + 1j, -1.0])
    told = LogSensitivities(diameter, np.array([rate, 2 * rate]), 0.1, edges=1j * rate)
    at = np.array([0.09, 0.13, 0.22, 0.35])
    want = np.array([1.0 - 2j, 2.5 + 0.25j, 1.0 + 0.5j, -1.0])
    assert told.at(at)[:2] == pytest.approx(np.array([want, 2 * want]))
    assert told.at(at).shape == (len(ROWS), 4)
    assert not told.at(at)[2:].any()
    assert told.by_edges(at) == pytest.approx(1j * want)
    assert dataclasses.replace(told, edges=np.zeros(3, complex)).by_edges(at) is None
