"""Waves of the orders beside Maxwell's equations order by order."""

import math
from fractions import Fraction

import numpy as np
import pytest

from metalens.rcwa.orders import basis
from metalens.rcwa.orders.waves import half_space, normal_component, plane_waves

PITCH, WAVELENGTH, KX, KY, AZIMUTH = 0.47, 0.83, 0.31, -0.17, 0.6


def made(symmetry="none", kx=KX, ky=KY, azimuth=AZIMUTH):
    return plane_waves(
        basis.disc_basis(2, symmetry),
        pitch_um=PITCH,
        wavelength_um=WAVELENGTH,
        kx=kx,
        ky=ky,
        azimuth_rad=azimuth,
    )


@pytest.mark.parametrize(("kx", "ky"), [(KX, KY), (0.0, 0.0)])
def test_p_waves_lie_along_the_wave_vector_and_s_waves_across(kx, ky):
    """The orders (m, n) of Ex, then of Ey: E of unit length at one order only; without
    a direction the azimuth's.
    """
    these, circle = made(kx=kx, ky=ky), basis.disc_basis(2, "none").ex
    count = len(circle.m)
    for i, (m, n) in enumerate(zip(circle.m.tolist(), circle.n.tolist(), strict=True)):
        x, y = kx + m * WAVELENGTH / PITCH, ky + n * WAVELENGTH / PITCH
        length = abs(complex(x, y))
        cos, sin = (
            (x / length, y / length) if length else (np.cos(AZIMUTH), np.sin(AZIMUTH))
        )
        for place, along in ((i, (cos, sin)), (count + i, (-sin, cos))):
            want = np.zeros(2 * count)
            want[i], want[count + i] = along
            assert these.fold[:, place] == pytest.approx(want, abs=1e-14)
            assert these.kappa[place] == pytest.approx(length, abs=1e-14)
            assert (these.m[place], these.n[place]) == (m, n)
        assert these.along[:, i] == pytest.approx((cos, sin), abs=1e-14)
    assert these.p_count == count
    assert these.bare == 0
    zero = np.flatnonzero((circle.m == 0) & (circle.n == 0))[0]
    assert (these.zero_p, these.zero_s) == (zero, count + zero)


@pytest.mark.parametrize(
    ("symmetry", "kx", "bare", "p", "s"),
    [("x", 0.0, 1, True, False), ("p", KX, 0, True, False), ("s", KX, 0, False, True)],
)
def test_waves_of_mirrors_are_as_many_as_fields_and_hold_one_zero_order(
    symmetry, kx, bare, p, s
):
    these = made(symmetry, kx, 0.0, 0.0)
    assert these.fold.T @ these.fold == pytest.approx(
        np.eye(len(these.kappa)), abs=1e-14
    )
    assert these.fold.shape[0] == these.fold.shape[1]
    assert these.bare == bare
    for there, place, low, high in (
        (p, these.zero_p, 0, these.p_count),
        (s, these.zero_s, these.p_count, len(these.kappa)),
    ):
        assert (place >= 0) is there
        if there:
            assert low <= place < high
            assert these.m[place] == these.n[place] == 0
            assert these.kappa[place] == pytest.approx(kx, abs=1e-14)
            assert np.abs(these.fold[:, place]).max() == pytest.approx(1, abs=1e-14)
        else:
            assert place == -1


@pytest.mark.parametrize("index", [1.4525, 1.31 + 0.2j, 1.31 - 0.2j])
def test_outgoing_waves_obey_maxwell_order_by_order(index):
    """kz u = P w and kz w = Q u with P = 1 - k²/n² of p and 1 of s, Q = n² of p and n²
    - k² of s.
    """
    these = made()
    kz = normal_component(these.kappa, index)
    assert (kz.imag >= 0).all()
    assert ((kz.real > 0) | (kz.imag > 0)).all()
    assert kz**2 == pytest.approx(index**2 - these.kappa**2, abs=1e-13)
    u, w = half_space(these, index)
    p = np.arange(len(kz)) < these.p_count
    P, Q = (
        np.where(p, 1 - these.kappa**2 / index**2, 1),
        np.where(p, index**2, index**2 - these.kappa**2),
    )
    assert kz * u == pytest.approx(P * w, abs=1e-13)
    assert kz * w == pytest.approx(Q * u, abs=1e-13)
    ez = np.where(p, these.kappa * w / index**2, 0)  # eps Ez = -k·w
    assert u**2 + ez**2 == pytest.approx(
        np.ones(len(kz)), abs=1e-13
    )  # E·E of a plane wave


def test_a_wave_that_just_does_not_propagate_keeps_its_digits():
    """n² - k² of nearly equal numbers, beside exact arithmetic of these very numbers:
    squared first, 6e-5 would go.
    """
    index, kappa = 1.4525, 1.4525 * (1 + 2**-40)
    want = math.sqrt(Fraction(kappa) ** 2 - Fraction(index) ** 2)
    assert normal_component(np.array([kappa]), index)[0] == pytest.approx(
        1j * want, rel=1e-14
    )
