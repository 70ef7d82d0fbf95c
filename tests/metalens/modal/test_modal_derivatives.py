"""Exact derivatives of the modal engine against differentiated Chebyshev interpolants
of its values.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from metalens import modal
from metalens.cell.light import Light
from metalens.cell.record import Cell, Index
from metalens.modal.assembly import assemble
from metalens.modal.case import case_of
from metalens.modal.derivatives import form_rates, mean_rate
from metalens.modal.engine import evaluate, geometric_mean
from metalens.modal.homogeneous import modes
from metalens.modal.ladder import RUNGS
from metalens.modal.layer import axial
from metalens.modal.match import half_space
from metalens.modal.spaces import space
from metalens.modal.variation import overlaps

CELL = Cell(0.4, 0.7, Index(3.6, 0.02), Index(1.4525), Index(1.0), Index(1.0))
COARSE = RUNGS[0].choice(0.5).plan
ANY = 10.0  # tolerance that the coarsest mesh meets: all values come from one mesh


def slope(function, reach, points=6):
    """Derivative at 0 of the Chebyshev interpolant over [-reach, reach]: off by f⁽⁷⁾
    reach⁶ / 322 560.
    """
    x = np.cos(np.pi * (np.arange(points) + 0.5) / points)
    fit = np.polynomial.chebyshev.chebfit(
        x, np.array([function(reach * s) for s in x]), points - 1
    )
    return (
        np.polynomial.chebyshev.chebval(0, np.polynomial.chebyshev.chebder(fit)) / reach
    )


def value(cell=CELL, diameter=0.15, wavelength=0.85, angle_rad=0.0, polarization="x"):
    """t of the coarse mesh to all digits; ``solve`` stops at a thousandth of what the
    mesh is worth.
    """
    case = case_of(cell, diameter, Light(wavelength, angle_rad, polarization))
    return evaluate(case, RUNGS[0].choice(case.rho).plan).matrix[1, 0]


OBLIQUE = {"angle_rad": 0.3, "polarization": "s"}


CHANGES = {
    name: (reach, change)
    for name, reach, change in [
        ("diameter_um", 0.0013, lambda s: {"diameter": 0.15 + s}),
        ("height_um", 0.007, lambda s: {"cell": replace(CELL, height_um=0.7 + s)}),
        ("n", 0.01, lambda s: {"cell": replace(CELL, pillar=Index(3.6 + s, 0.02))}),
        ("k", 0.005, lambda s: {"cell": replace(CELL, pillar=Index(3.6, 0.02 + s))}),
        ("wavelength_um", 0.003, lambda s: {"wavelength": 0.85 + s}),
    ]
}


@pytest.mark.parametrize(
    ("name", "more"),
    [(name, {}) for name in CHANGES]
    + [
        ("diameter_um", OBLIQUE | {"polarization": "p"}),
        ("wavelength_um", OBLIQUE),
        ("n", OBLIQUE),
    ],
)
def test_gradient_against_differences(name, more):
    reach, change = CHANGES[name]
    got = getattr(modal.gradient(CELL, 0.15, 0.85, tolerance=ANY, **more), name)
    want = slope(lambda s: value(**change(s), **more), reach)
    # rounding of t (1e-11, and 1e-10 in the mesh) over the reach, relative to slopes of
    # 1 to 100 per um
    assert abs(got - want) < 1e-8 * max(abs(want), 10.0)


@pytest.mark.parametrize(("polarization", "angle"), [("s", 0.3), ("p", -0.3)])
def test_angle_derivative(polarization, angle):
    got = modal.gradient(
        CELL, 0.15, 0.85, angle_rad=angle, polarization=polarization, tolerance=ANY
    )
    want = slope(lambda s: value(angle_rad=angle + s, polarization=polarization), 0.007)
    assert abs(got.angle_rad - want) < 1e-7


@pytest.mark.parametrize("more", [{}, OBLIQUE, OBLIQUE | {"polarization": "p"}])
def test_wavelength_derivative_holds_the_dispersion_of_all_materials(more):
    """The Sellmeier formula of silica, smooth everywhere: in pillar and substrate, and
    in all but the pillar.
    """
    glass = Cell(0.4, 0.7, "SiO2", "SiO2", "SiO2", "SiO2")
    for cell in (
        replace(CELL, pillar="SiO2", substrate="SiO2"),
        replace(glass, pillar=Index(3.6)),
    ):
        got = modal.gradient(cell, 0.15, 0.85, tolerance=ANY, **more).wavelength_um
        want = slope(lambda s, c=cell: value(c, wavelength=0.85 + s, **more), 0.003)
        assert abs(got - want) < 1e-8 * max(abs(want), 10.0)


def test_angle_derivative_vanishes_at_normal_incidence():
    assert modal.gradient(CELL, 0.15, 0.85, tolerance=ANY).angle_rad == 0


def test_index_derivatives_are_analytic():
    got = modal.gradient(CELL, 0.2, 0.85, tolerance=ANY)
    assert abs(got.k - 1j * got.n) < 1e-13 * abs(got.n)


def test_value_is_that_of_solve():
    got, solved = modal.gradient(CELL, 0.2, 0.85), modal.solve(CELL, 0.2, 0.85)
    assert (
        abs(got.t - solved.t) < 1e-3 * solved.t_error
    )  # which leaves out what is worth less


def test_steepest_flank_and_dip_have_finite_exact_slopes():
    lossless = replace(CELL, pillar=Index(3.6))
    for diameter in (0.1937, 0.302):
        got = modal.gradient(lossless, diameter, 0.85, tolerance=ANY)
        want = slope(lambda s, d=diameter: value(lossless, d + s), 1.6e-4)
        assert abs(got.diameter_um - want) < 1e-7 * abs(want)


def test_degenerate_modes_need_no_care():
    """A homogeneous layer: all layer modes are homogeneous modes, many of them
    degenerate; t is Airy's formula.
    """
    layer = Cell(0.4, 0.7, Index(2.0), Index(1.4525), Index(1.0), Index(2.0))

    def film(wavelength, height):
        r1, r2 = (1.4525 - 2) / (1.4525 + 2), (2 - 1) / (2 + 1)
        t12 = 2 * np.sqrt(1.4525 * 2) / (1.4525 + 2) * 2 * np.sqrt(2) / 3
        phase = np.exp(4j * np.pi * height / wavelength)
        return t12 * phase / (1 + r1 * r2 * phase**2)

    got = modal.gradient(layer, 0.2, 0.85, tolerance=ANY)
    assert abs(
        got.wavelength_um - slope(lambda s: film(0.85 + s, 0.7), 0.006)
    ) < 1e-9 * abs(got.wavelength_um)
    assert abs(
        got.height_um - slope(lambda s: film(0.85, 0.7 + s), 0.006)
    ) < 1e-9 * abs(got.height_um)
    assert abs(got.diameter_um) < 1e-7


def test_lossless_derivatives_keep_the_matrix_unitary():
    case = case_of(replace(CELL, pillar=Index(3.6)), 0.15, Light(0.85, 0.3, "p"))
    for magnetic in (False, True):
        s, rates = form_rates(case, COARSE, magnetic=magnetic)
        for rate in rates.values():
            generator = s.conj().T @ rate
            assert np.abs(generator + generator.conj().T).max() < 1e-9 * max(
                1.0, np.abs(rate).max()
            )
            assert np.abs(rate - rate.T).max() < 1e-9 * max(1.0, np.abs(rate).max())


def test_mean_rate_against_differences():
    rng = np.random.default_rng(5)
    a, b, da, db = (
        rng.normal(size=(2, 2)) + 1j * rng.normal(size=(2, 2)) for _ in range(4)
    )
    a, b = np.eye(2) + 0.1 * a, np.eye(2) + 0.1 * b
    want = slope(lambda s: geometric_mean(a + s * da, b + s * db)[1, 0], 0.02)
    assert abs(mean_rate(a, b, da, db)[1, 0] - want) < 1e-10


def test_overlaps_at_equal_and_unequal_wavenumbers():
    q = np.array([2.0, 2.0, 2.0 + 1e-9, 1.0 + 3j, 40j])
    along, against = overlaps(q, 1.5)
    z, w = np.polynomial.legendre.leggauss(200)
    z, w = 0.75 * (z + 1), 0.75 * w
    up, down = (
        np.exp(1j * np.multiply.outer(q, z)),
        np.exp(1j * np.multiply.outer(q, 1.5 - z)),
    )
    assert np.abs(along - (up * w) @ up.T).max() < 1e-12
    assert np.abs(against - (up * w) @ down.T).max() < 1e-12


def test_half_space_modes_do_not_depend_on_the_medium():
    """Admittances are functions of the same transverse wavenumbers: i kz and i k0² eps
    / kz.
    """
    basis = modes(space(assemble(0.5, COARSE), electric=False, half_phase_rad=0.3))
    half = half_space(basis, 1.5, 2.1, magnetic=False)
    kz = axial(1.5**2 * 2.1 - basis.te_exact)
    assert np.abs(half.admittance[: len(kz)] - 1j * kz).max() < 1e-12
    assert math.isclose(
        half.admittance[len(kz)].imag,
        1.5**2 * 2.1 / math.sqrt(1.5**2 * 2.1 - 0.09),
        rel_tol=1e-12,
    )
