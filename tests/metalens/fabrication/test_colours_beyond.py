"""t of pillars at wavelengths that their library does not reach: along the tangent for
a while, then held.
"""

import numpy as np
import pytest

from metalens.fabrication import designed_transmission
from metalens.library.proxy import Proxy

D = np.array([0.12, 0.17, 0.23])


def proxy(low_um, high_um):
    """Phase (4.2 + 3.7 u) + (-0.3 - 0.15 u + 0.02 T2(u)) v of the unit diameter u,
    wavelength v; |T| 0.9 - 0.02 v.
    """
    phase, level = np.zeros((2, 3)), np.zeros((2, 3))
    phase[0], phase[1] = (4.2, 3.7, 0.0), (-0.3, -0.15, 0.02)
    level[0, 0], level[1, 0] = 0.9, -0.02
    return Proxy(phase, level, (0.10, 0.26), (low_um, high_um), 1e-3, 1e-3)


def formula(v):
    u = (2 * D - 0.36) / 0.16
    return (0.9 - 0.02 * v) * np.exp(
        1j * (4.2 + 3.7 * u + (-0.3 - 0.15 * u + 0.02 * (2 * u * u - 1)) * v)
    )


@pytest.mark.parametrize(
    ("wavelength_um", "v"), [(0.856, 1.2), (0.842, -1.6), (0.865, 3.0), (0.8471, -0.58)]
)
def test_a_straight_dependence_goes_on_as_it_is(wavelength_um, v):
    assert designed_transmission(
        proxy(0.845, 0.855), D, wavelength_um
    ) == pytest.approx(formula(v), abs=1e-9)


@pytest.mark.parametrize(("wavelength_um", "v"), [(0.880, 3.0), (0.820, -3.0)])
def test_it_is_held_from_the_width_of_the_library_on(wavelength_um, v):
    assert designed_transmission(
        proxy(0.845, 0.855), D, wavelength_um
    ) == pytest.approx(formula(v), abs=1e-9)


def test_a_library_at_one_wavelength_says_the_same_at_all():
    assert designed_transmission(proxy(0.85, 0.85), D, 0.861) == pytest.approx(
        designed_transmission(proxy(0.85, 0.85), D, 0.85)
    )


@pytest.mark.parametrize("end", [-1, 1])
def test_a_bent_dependence_goes_on_along_its_last_64th(end):
    """Phase 2 - 0.3 v + 0.4 (2 v² - 1) of the unit wavelength, |T| 0.8 - 0.05 v + 0.02
    (2 v² - 1): secants of 1/32
    of the half range."""
    phase, level = np.zeros((3, 1)), np.zeros((3, 1))
    phase[:, 0], level[:, 0] = (2.0, -0.3, 0.4), (0.8, -0.05, 0.02)
    made = Proxy(phase, level, (0.10, 0.26), (0.845, 0.855), 1e-3, 1e-3)

    def straight(first, bent, v):
        return first * v + bent * (2 * v * v - 1)

    def gone_on(first, bent, v):
        return (
            straight(first, bent, end)
            + (straight(first, bent, end) - straight(first, bent, end * 31 / 32))
            * 32
            * v
        )

    beyond = 0.7
    got = designed_transmission(made, D, 0.85 + end * 0.005 * (1 + beyond))
    want = (0.8 + gone_on(-0.05, 0.02, beyond)) * np.exp(
        1j * (2 + gone_on(-0.3, 0.4, beyond))
    )
    assert got == pytest.approx(np.full(3, want), abs=1e-9)
