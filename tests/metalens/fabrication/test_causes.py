"""The table of causes in closed form: maps over the lens, derivatives of pillars, drawn
lenses, t under a change.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell, Index, Layer
from metalens.fabrication import perturbations, response
from metalens.fabrication.perturbations import (
    PERTURBATIONS,
    CDError,
    ResponseError,
    WavefrontError,
    WaveguideModel,
)
from metalens.fabrication.process import State
from metalens.fabrication.response import Sensitivity

U, V = np.array([0.37, -0.8, 0.1]), np.array([-0.52, 0.31, 0.66])
COUNT = len(perturbations.names_of_kind(ResponseError))


def test_biases_over_the_lens_by_hand():
    """10, -4, 7, 3, 2, -5 nm of: all, x, y, bow, saddle, oblique saddle; in um at three
    places off every axis.
    """
    names = ("bias_nm", "bias_x_nm", "bias_y_nm", "bias_r_nm", "bias_a_nm", "bias_o_nm")
    made = State.of(dict(zip(names, (10.0, -4.0, 7.0, 3.0, 2.0, -5.0), strict=True)))
    bow = 0.5 * (2 * (U**2 + V**2) - 1)
    want = 10 - 4 * U + 7 * V + 3 * bow + 2 * (U**2 - V**2) - 5 * 2 * U * V
    assert made.bias_um(U, V) == pytest.approx(want * 1e-3, rel=1e-12)
    assert made["bias_y_nm"] == 7.0
    assert not made.has_wavefront_error()
    assert not made.phase_rad(U, V).any()
    assert perturbations.derivative_maps(CDError, U, V)[1] == pytest.approx(
        1e-3 * U, rel=1e-12
    )
    assert perturbations.names_of_kind(CDError) == names


def test_wave_fronts_are_zernike_polynomials_of_unit_mean_square():
    """Against cosines and sines of the angle; orthogonal over the disc with piston,
    tilt and focus.
    """
    radius, angle = np.hypot(U, V), np.arctan2(V, U)
    want = [
        math.sqrt(6) * radius**2 * np.cos(2 * angle),
        math.sqrt(6) * radius**2 * np.sin(2 * angle),
        math.sqrt(8) * (3 * radius**3 - 2 * radius) * np.cos(angle),
        math.sqrt(8) * (3 * radius**3 - 2 * radius) * np.sin(angle),
        math.sqrt(8) * radius**3 * np.cos(3 * angle),
        math.sqrt(8) * radius**3 * np.sin(3 * angle),
        math.sqrt(5) * (6 * radius**4 - 6 * radius**2 + 1),
    ]
    assert perturbations.derivative_maps(WavefrontError, U, V) == pytest.approx(
        np.array(want), rel=1e-9
    )
    x, w = np.polynomial.legendre.leggauss(8)
    r = np.sqrt((x + 1) / 2)[:, None]
    turn = np.arange(16) * math.pi / 8 + 0.1
    u = r * np.cos(turn)
    v = r * np.sin(turn)
    weight = np.repeat(w / 2 / 16, 16)
    basis = np.concatenate(
        [
            np.stack([np.ones_like(u), 2 * u, 2 * v]),
            perturbations.derivative_maps(WavefrontError, u, v),
        ]
    ).reshape(10, -1)
    assert basis * weight @ basis.T == pytest.approx(np.eye(10), abs=1e-9)
    made = State.of({"coma_y_rad": 0.3, "trefoil_x_rad": -0.2})
    assert made.phase_rad(U, V) == pytest.approx(
        0.3 * want[3] - 0.2 * want[4], rel=1e-9
    )
    assert made.has_wavefront_error()


def effective(d, n, around=1.3, k=2 * math.pi / 0.85):
    """b(V) = 1 - exp(-V²), V the normalised frequency: n_eff² = around² + b (n² -
    around²).
    """
    contrast = n**2 - around**2
    return np.sqrt(
        around**2 + (1 - np.exp(-((k * d / 2) ** 2) * contrast / 9)) * contrast
    )


def test_quick_derivatives_are_those_of_guides_of_one_mode():
    """By differences of exp(i k n_eff h): height, index (b of D √(n² - n0²)), a wall
    about half height.
    """
    d = np.array([0.11, 0.17, 0.23])
    h = 0.62
    n = 3.1
    wall = math.radians(2.5)
    k = 2 * math.pi / 0.85
    step = 1e-4
    up, down = effective(d + step, n), effective(d - step, n)
    here = effective(d, n)
    guide = WaveguideModel(
        k,
        d,
        here,
        (up - down) / (2 * step),
        (up - 2 * here + down) / step**2,
        n,
        1.3,
        h,
        wall,
    )
    rows = {
        row.name: acts.quick(guide) for row, acts in perturbations.response_errors()
    }
    assert rows["height_nm"] == pytest.approx(1j * k * here, rel=1e-9)
    by_index = (effective(d, n + 1e-5) - effective(d, n - 1e-5)) / 2e-5
    assert rows["index"] == pytest.approx(1j * k * h * by_index, rel=1e-5)
    # a frustum: D + 2 z tan(wall), to second order in the wall
    z = (np.arange(400) + 0.5) / 400 * h - h / 2

    def phase(lean):
        at = d[:, None] + 2 * z * lean
        second = guide.effective[:, None] + (at - d[:, None]) * guide.slope[:, None]
        return (
            k
            * (second + (at - d[:, None]) ** 2 / 2 * guide.curvature[:, None]).mean(1)
            * h
        )

    by_wall = (phase(wall + 1e-4) - phase(wall - 1e-4)) / 2e-4
    assert rows["sidewall_deg"] == pytest.approx(1j * by_wall, rel=1e-4)
    # of one side, the mean of both polarisations: half of it
    by_diameter = 1j * k * h * guide.slope
    assert rows["width_nm"] == pytest.approx(by_diameter / 2, rel=1e-12)
    assert rows["length_nm"] == pytest.approx(by_diameter / 2, rel=1e-12)
    assert not rows["turn_deg"].any()


@pytest.mark.parametrize(
    ("films", "heights"),
    [
        ((None, "SiO2", None), (0.103, 0.2, 0.309)),
        (("HfO2", "SiO2", "HfO2"), (0.102, 0.204, 0.306)),
    ],
)
def test_a_taller_layered_pillar_is_taller_in_its_own_material(films, heights):
    """12 nm in proportion to the heights of its sections; of all where none is of the
    pillar's material.
    """
    layers = tuple(
        Layer(h, material=film) for h, film in zip((0.1, 0.2, 0.3), films, strict=True)
    )
    acts = next(
        acts for row, acts in perturbations.response_errors() if row.name == "height_nm"
    )
    cell = Cell(0.4, 0.6, layers=layers)
    numbers = acts.numbers(cell, 0.2)
    made, _ = perturbations.changed_pillar(cell, 0.2, numbers, 0.012, 0.85)
    assert [layer.height_um for layer in made.layers] == pytest.approx(heights)
    assert made.height_um == pytest.approx(0.612)


def test_slopes_go_on_along_their_tangents_beyond_the_diameters_they_were_made_for():
    rows = np.array([[1.0, -2.0 + 1j, 3.0], [0.5j, 4.0, -1.0]])
    made = Sensitivity(rows, 0.2, low_um=0.1, high_um=0.35)
    for d in (0.14, 0.31):
        o = d - 0.2
        assert made.at(np.array([d]))[:, 0] == pytest.approx(
            [*(r[0] + r[1] * o + r[2] * o * o for r in rows), *[0] * (COUNT - 2)]
        )
    for d, edge in ((0.05, 0.1), (0.5, 0.35)):
        o = edge - 0.2
        want = [
            r[0] + r[1] * o + r[2] * o * o + (d - edge) * (r[1] + 2 * r[2] * o)
            for r in rows
        ]
        assert made.at(np.array([d, 0.2]))[:, 0] == pytest.approx(
            [*want, *[0] * (COUNT - 2)]
        )  # the other causes are not there
        assert made.at(np.array([d, 0.2]))[:, 1] == pytest.approx(
            [*rows[:, 0], *[0] * (COUNT - 2)]
        )


class Line:
    """A proxy of straight phase and transmission."""

    domain_um, wavelengths_um = (0.1, 0.3), (0.85, 0.85)

    def phase_rad(self, d, wavelength, angle=0.0):
        return 7.0 * d + 20 * d**2 + angle

    def dphase_ddiameter(self, d, wavelength, angle=0.0):
        return 7.0 + 40 * d

    def transmission(self, d, wavelength, angle=0.0):
        return 0.9 - d

    def dtransmission_ddiameter(self, d, wavelength, angle=0.0):
        return np.full_like(d, -1.0)


def test_effective_indices_follow_from_the_phase_and_start_at_that_of_thin_cylinders():
    """phase = k n_eff h; the thinnest: Rayleigh's cylinders across the field, of a fill
    of 5 %.
    """
    cell = Cell(0.4, 0.6, Index(3.1), between=Index(1.2))
    d = np.linspace(0.1, 0.3, 21)
    made = response.effective_indices(cell, Line(), 0.85, d)
    k, fill = 2 * math.pi / 0.85, math.pi * 0.01 / 4 / 0.16
    ratio = (3.1**2 - 1.44) / (3.1**2 + 1.44)
    thin = 1.2 * math.sqrt((1 + fill * ratio) / (1 - fill * ratio))
    want = thin + (7 * d + 20 * d**2 - 0.9) / (k * 0.6)
    assert made.effective == pytest.approx(want, rel=1e-9)
    assert made.slope == pytest.approx((7 + 40 * d) / (k * 0.6), rel=1e-6)
    assert made.curvature == pytest.approx(np.full(21, 40 / (k * 0.6)), rel=1e-4)
    assert (made.k, made.index, made.around, made.height_um) == pytest.approx(
        (k, 3.1, 1.2, 0.6)
    )


def test_the_table_says_what_the_documents_say():
    """Prior, bound and unit of the rows that a fit opens by default."""
    rows = {
        row.name: (row.scale, row.sigma, row.low, row.high, row.unit, row.free)
        for row in PERTURBATIONS
    }
    assert rows["bias_nm"] == (1.0, 15.0, -26.0, 26.0, 1e-3, True)
    for name in ("bias_x_nm", "bias_y_nm", "bias_r_nm"):
        assert rows[name] == (1.0, 10.0, -15.0, 15.0, 1e-3, True)
    for name in ("bias_a_nm", "bias_o_nm"):
        assert rows[name] == (1.0, 10.0, -15.0, 15.0, 1e-3, False)
    assert rows["height_nm"] == (5.0, 10.0, -28.0, 28.0, 1e-3, True)
    assert rows["index"] == (0.02, 0.02, -0.075, 0.075, 1.0, False)
    assert rows["sidewall_deg"] == (
        0.3,
        0.5,
        -1.6,
        1.6,
        pytest.approx(math.pi / 180),
        False,
    )
    assert rows["coma_x_rad"] == (0.05, 1.0, -6.0, 6.0, 1.0, True)
