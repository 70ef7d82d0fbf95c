"""Paths over many places by polynomials: to rounding where those converge, the function
itself where they do not.
"""

import math
from typing import Any

import numpy as np
import pytest
import torch

from metalens.optics import interpolant


@pytest.mark.parametrize(
    ("height", "most"), [(15e3, 9), (700.0, 9 + 17), (430.0, 9 + 17 + 25)]
)
def test_a_square_root_is_taken_at_a_few_places(height: float, most: int) -> None:
    """√(h² + u), away from -h²: coefficients of u up to 600² fall by 6.7e3, 9.3 and 5.2
    each.
    """
    asked: list[int] = []

    def root(u: Any) -> Any:
        asked.append(math.prod(u.shape))
        return (height**2 + u) ** 0.5

    u = torch.linspace(0.2, 600.0, 3000, dtype=torch.float64) ** 2
    found = interpolant.chebyshev_interpolant(root, u.reshape(3, 1, -1))
    assert sum(asked) == most
    assert found.shape == (3, 1, 1000)
    want = np.sqrt(np.longdouble(height) ** 2 + u.numpy().astype(np.longdouble))
    assert np.abs(found.flatten().numpy() - want).max() < 3e-14 * float(want.max())


def test_what_no_polynomial_reaches_is_taken_as_it_is() -> None:
    u = np.linspace(0.0, 600.0, 2000) ** 2
    np.testing.assert_array_equal(
        interpolant.chebyshev_interpolant(np.sqrt, u), np.sqrt(u)
    )  # singular at its end
    few = np.array([0.3, 7.1, 2.2])
    np.testing.assert_array_equal(
        interpolant.chebyshev_interpolant(np.cbrt, few), np.cbrt(few)
    )
    alike = np.full(2000, 2.7)
    np.testing.assert_array_equal(
        interpolant.chebyshev_interpolant(np.cbrt, alike), np.cbrt(alike)
    )
