"""Polynomials between wavelengths and angles: exact for polynomials, and error
estimates above the errors.
"""

import math

import numpy as np
import pytest

from metalens import library, modal
from metalens.cell import Light
from metalens.pillars import few_nodes
from metalens.pillars.record import DEFAULT_CELL, Sweep

WAVES = tuple(round(0.84 + 0.002 * i, 3) for i in range(11))


def test_few_values_are_all_picked_and_many_at_the_ends_and_between():
    assert few_nodes.picks((0.85,)) == (0.85,)
    assert few_nodes.picks(WAVES[:6]) == WAVES[:6]
    assert few_nodes.picks(WAVES) == (0.84, 0.844, 0.85, 0.856, 0.86)


def test_lights_share_normal_incidence():
    sweep = Sweep(WAVES, (0.0, 10.0))
    made = few_nodes.lights(sweep, (0.84, 0.86), (0.0, 10.0))
    assert made == [
        Light(0.84, 0.0, "x"),
        Light(0.86, 0.0, "x"),
        *(Light(w, math.radians(10), p) for p in ("s", "p") for w in (0.84, 0.86)),
    ]


@pytest.mark.parametrize("degree", [0, 2, 4])
def test_polynomials_are_exact(degree):
    nodes = np.array([0.84, 0.842, 0.85, 0.858, 0.86])
    values = ((nodes - 0.85) * 100) ** degree
    assert few_nodes.lagrange(nodes, 0.847) @ values == pytest.approx(
        (-0.3) ** degree, abs=1e-12
    )
    assert few_nodes.lagrange(nodes, 0.842) @ values == pytest.approx(
        values[1], abs=1e-12
    )


@pytest.mark.parametrize("speed", [20.0, 100.0, 400.0])
def test_the_estimate_is_above_the_error(speed):
    nodes = np.array(few_nodes.picks(WAVES))
    d = np.linspace(0, 1, 50)

    def t(wavelength):
        return (
            0.04
            * np.exp(1j * speed * wavelength * (1 + d))
            / (wavelength - 0.8 - 0.01 * d)
        )

    table = np.stack([np.stack([t(w), 0 * d, 0 * d + 1e-9 + 0j]) for w in nodes])
    for wavelength in WAVES:
        row = few_nodes.between(nodes, table, wavelength)
        error, estimate = np.abs(row[0] - t(wavelength)), row[2].real
        used = (
            estimate < 0.1
        )  # beyond any tolerance that a sweep accepts the row is solved instead
        assert (error[used] <= estimate[used]).all()
        assert speed > 200 or used.any()


def test_wavelengths_between_nodes_lie_within_their_error_bars():
    sweep = Sweep(WAVES, samples=40, tolerance=1e-2, diameters_um=(0.08, 0.2))
    made = library.sweep(DEFAULT_CELL, sweep)
    assert made.converged
    assert made.solves < 11 * 12  # fewer than one curve a wavelength would take
    for k, i in ((1, 5), (3, 20), (6, 30), (8, 38)):
        exact = modal.solve(
            DEFAULT_CELL, float(made.diameter_um[i]), WAVES[k], tolerance=1e-3
        )
        assert (
            abs(made.t[0, 0, k, i] - exact.t)
            <= made.t_error[0, 0, k, i] + exact.t_error
        )


def test_rows_come_from_wavelengths_then_angles():
    angles = (0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 18.0)
    sweep = Sweep(WAVES, angles)

    def row(light):
        value = (
            (light.wavelength_um - 0.85) ** 2
            + math.sin(light.angle_rad) ** 4
            + (light.polarization == "p")
        )
        return np.array([[value], [2 * value], [1e-6]], complex)

    first = few_nodes.lights(sweep, few_nodes.picks(WAVES), few_nodes.picks(angles))
    solved = {
        light: row(light)
        for light in first
        if light.angle_rad or light.polarization == "x"
    }
    full = few_nodes.complete(sweep, solved, {}, np.array([0.1]))
    assert len(full) == 11 * (1 + 2 * 6)
    for light, made in full.items():
        if light.angle_rad and light.polarization == "s":
            assert np.abs(made[:2] - row(light)[:2]).max() < 1e-12
            assert made[2].real >= 1e-6


def test_diameters_that_a_narrow_resonance_passes_must_be_solved():
    sweep, d = Sweep(WAVES), np.linspace(0.08, 0.2, 121)
    still = np.stack([np.ones(121), np.zeros(121), np.full(121, 1e-6)]) + 0j
    nodes = few_nodes.lights(sweep, few_nodes.picks(WAVES), (0.0,))
    poles = {
        w: np.array([[0.15 + (w.wavelength_um - 0.84), 1e-4], [0.1, 0.02]])
        for w in nodes
    }
    full = few_nodes.complete(sweep, {w: still for w in nodes}, poles, d)
    for light, row in full.items():
        hit = np.abs(d - 0.15 - (light.wavelength_um - 0.84)) < 4e-4
        assert light in nodes or (row[2].real[hit] == 1).all()
        assert (
            row[2].real[d < 0.14] < 1e-3
        ).all()  # wide resonances are seen at every node
    vanishing = {
        w: found[: 1 if w.wavelength_um < 0.845 else 0] for w, found in poles.items()
    }
    full = few_nodes.complete(sweep, {w: still for w in nodes}, vanishing, d)
    assert (
        full[few_nodes.light(0.846, 0.0, "x")][2].real[np.abs(d - 0.152) < 0.015] == 1
    ).all()


def test_a_narrow_resonance_passes_from_one_node_to_the_other_and_four_half_widths_beyond():
    d = np.linspace(0.1, 0.2, 1001)
    there, here = np.array([[0.15, 1e-3]]), np.array([[0.16, 2e-3]])
    for pair in ((here, there), (there, here)):
        mask = few_nodes._passed(*pair, d)
        assert (d[mask].min(), d[mask].max()) == pytest.approx(
            (0.142, 0.168), abs=1.01e-4
        )
        assert mask.sum() == np.ptp(np.flatnonzero(mask)) + 1  # one run
    lost = few_nodes._passed(
        there, np.empty((0, 2)), d
    )  # at no place of the other: 20 nm to either side
    assert (d[lost].min(), d[lost].max()) == pytest.approx((0.126, 0.174), abs=1.01e-4)
