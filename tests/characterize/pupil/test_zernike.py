"""Zernike polynomials: orthonormal over the disc by an exact quadrature, a few of them
as polynomials by hand.
"""

import numpy as np
import pytest

from characterize.pupil import zernike


def test_unit_variance_and_orthogonal_over_the_disc():
    """Gauss in rho² and even angles integrate products of order 12 exactly."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    rho, share = np.sqrt((nodes + 1) / 2), weights / 2
    theta = np.arange(17) * 2 * np.pi / 17
    which = zernike.zernike_indices(0, 6)
    assert len(which) == 28
    values = np.stack(
        [zernike.zernike_polynomial(i, rho[:, None], theta[None]) for i in which]
    )
    gram = np.einsum("irt,jrt,r->ij", values, values, share) / 17
    assert gram == pytest.approx(np.eye(28), abs=1e-12)


def test_some_by_hand_at_a_point_off_both_axes():
    x, y = np.array([0.3]), np.array([-0.5])
    r2 = 0.34
    want = {
        (2, 0): np.sqrt(3) * (2 * r2 - 1),
        (2, 2): np.sqrt(6) * (0.09 - 0.25),
        (2, -2): np.sqrt(6) * 2 * 0.3 * -0.5,
        (3, 1): np.sqrt(8) * (3 * r2 - 2) * 0.3,
        (3, -1): np.sqrt(8) * (3 * r2 - 2) * -0.5,
        (3, -3): np.sqrt(8) * (3 * 0.09 * -0.5 + 0.125),
        (4, 0): np.sqrt(5) * (6 * r2**2 - 6 * r2 + 1),
        (4, 2): np.sqrt(10) * (4 * r2 - 3) * (0.09 - 0.25),
    }
    assert zernike.zernike_basis(list(want), x, y)[:, 0] == pytest.approx(
        list(want.values()), abs=1e-13
    )
    assert zernike.zernike_basis([], x, y).shape == (0, 1)
