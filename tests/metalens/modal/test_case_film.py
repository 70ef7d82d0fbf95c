"""Two half-spaces without a layer, at an angle: Fresnel's formulas by the angles of
Snell's law.
"""

import math

import numpy as np
import pytest

from metalens.modal.case import ModalCase, fresnel_scattering


@pytest.mark.parametrize("p", [False, True])
@pytest.mark.parametrize("angle", [0.0, 0.31])
def test_amplitudes_are_those_of_fresnel(p, angle):
    """Light from n = 1.45 to 1.2; powers of a unit flux along the normal, so t is √(cos
    ratio) times the textbook's.
    """
    n1, n2, k0 = 1.45, 1.2, 2.3
    inside = math.asin(n1 * math.sin(angle) / n2)
    c1, c2 = math.cos(angle), math.cos(inside)
    r = (
        (n1 * c2 - n2 * c1) / (n2 * c1 + n1 * c2)
        if p
        else (n1 * c1 - n2 * c2) / (n1 * c1 + n2 * c2)
    )
    case = ModalCase(
        rho=0.4,
        k0=k0,
        height=0.0,
        below=n1**2,
        above=n2**2,
        disc=4.0,
        around=1.0,
        bloch=k0 * n1 * math.sin(angle),
        p=p,
    )
    made = fresnel_scattering(case)
    assert abs(made[0, 0]) == pytest.approx(abs(r), rel=1e-12)
    assert abs(made[1, 0]) ** 2 == pytest.approx(1 - r**2, rel=1e-12)
    assert np.abs(made @ made.conj().T - np.eye(2)).max() < 1e-12
    if not p:
        assert made[0, 0].real == pytest.approx(r, rel=1e-12)
