"""Legendre polynomials by closed forms, nodes of few points by hand, counts of nodes
from tails that are given.
"""

import math

import numpy as np
import pytest

from metalens.ground import legendre

EXACT = {"rel": 1e-14, "abs": 1e-14}  # a few roundings of float64


def test_the_first_polynomials_are_the_closed_forms_with_their_norms():
    t = np.array([[0.3, -0.7, 0.9]])
    forms = [
        np.ones_like(t),
        t,
        (3 * t**2 - 1) / 2,
        (5 * t**3 - 3 * t) / 2,
        (35 * t**4 - 30 * t**2 + 3) / 8,
    ]
    want = np.stack(
        [
            form * math.sqrt(half / 2)
            for form, half in zip(forms, (1, 3, 5, 7, 9), strict=True)
        ],
        -1,
    )
    found = legendre.values(5, t)
    assert found.shape == (1, 3, 5)
    assert found == pytest.approx(want, **EXACT)
    assert legendre.values(1, 0.4) == pytest.approx(np.array([math.sqrt(0.5)]), **EXACT)


def test_three_nodes_and_what_leads_to_them():
    """Gauss's rule of three points: 0 and the roots of 3/5, weights 8/9 and 5/9."""
    root = math.sqrt(0.6)
    t, w = legendre.nodes(3)
    assert t == pytest.approx(np.array([-root, 0, root]), **EXACT)
    assert w == pytest.approx(np.array([5 / 9, 8 / 9, 5 / 9]), **EXACT)
    assert legendre.mapped(3, 2.5, 7.1) == pytest.approx(
        np.array([4.8 - 2.3 * root, 4.8, 4.8 + 2.3 * root]), **EXACT
    )
    half, slope, bend = math.sqrt(0.5), math.sqrt(1.5) * root, math.sqrt(2.5)
    modes = [
        [5 / 9 * half, 8 / 9 * half, 5 / 9 * half],
        [-5 / 9 * slope, 0, 5 / 9 * slope],
    ]
    modes.append(
        [5 / 9 * 0.4 * bend, -8 / 9 * 0.5 * bend, 5 / 9 * 0.4 * bend]
    )  # (3 t² - 1) / 2 of t² = 3/5 and 0
    assert legendre.to_nodes(3) == pytest.approx(np.array(modes), **EXACT)


def test_interpolation_between_two_nodes_is_the_straight_line():
    t = np.array([-0.2, 0.5])
    share = (1 + t * math.sqrt(3)) / 2  # of the node at +1/√3
    assert legendre.interpolation(2, t) == pytest.approx(
        np.stack([1 - share, share], -1), **EXACT
    )


def lines(count, *rows):
    """(lines, count) samples of functions of given coefficients."""
    t, _ = legendre.nodes(count)
    return np.stack([legendre.values(len(row), t) @ np.array(row) for row in rows])


def test_the_count_is_where_the_rest_of_all_lines_falls_below_the_tolerance():
    """Powers by mode 9 + 16 = 25, 0, 0.64, 0.36 of two lines: of 26 in all the tails
    are 1, 1/26, 1/26, 0.36/26.
    """
    samples = lines(21, [3j, 0, 0.8], [4, 0, 0, 0.6])
    rest = math.sqrt(1 / 26), math.sqrt(0.36 / 26)
    for tolerance, count in [
        (1.0, 0),
        (1.001 * rest[0], 1),
        (0.999 * rest[0], 3),
        (1.001 * rest[1], 3),
    ]:
        assert legendre.needed(samples, tolerance) == count
    for tolerance in (0.999 * rest[1], 1e-9):
        assert legendre.needed(samples, tolerance) == 4


def test_too_few_samples_are_said_by_one_more_than_there_are():
    """17 of 20 modes, 0.85 of them, are still told; 18 are not."""
    assert legendre.needed(lines(20, [0.0] * 16 + [1.3]), 1e-9) == 17
    assert legendre.needed(lines(20, [0.0] * 17 + [1.3]), 1e-9) == 21
    assert legendre.needed(lines(20, [0.0] * 19 + [1.3]), 1e-9) == 21
