"""Element functions written out as polynomials, rules by integrals in closed form, and
their exact relations.
"""

import math

import numpy as np
import pytest

from metalens.modal import shapes

S = np.array([0.0, 0.13, 0.6, 1.0])
R3, R5, R7 = math.sqrt(3), math.sqrt(5), math.sqrt(7)
VALUES = [
    1 - S,
    S,
    R3 * (S**2 - S),
    R5 * (2 * S**3 - 3 * S**2 + S),
    R7 * (5 * S**4 - 10 * S**3 + 6 * S**2 - S),
]
SLOPES = [
    1 + 0 * S,
    R3 * (2 * S - 1),
    R5 * (6 * S**2 - 6 * S + 1),
    R7 * (20 * S**3 - 30 * S**2 + 12 * S - 1),
]
EXACT = {"rel": 1e-13, "abs": 1e-14}  # roundings of float64


def test_rules_lie_on_the_unit_interval():
    point, weight = shapes.gauss_rule(2)
    assert point == pytest.approx(np.array([1 - 1 / R3, 1 + 1 / R3]) / 2, **EXACT)
    assert weight == pytest.approx(np.array([0.5, 0.5]), **EXACT)
    s, w = shapes.graded_rule(2)
    t = (1 + np.array([-1, 1]) / R3) / 2
    assert s == pytest.approx(t**10, **EXACT)
    assert w == pytest.approx(5 * t**9, **EXACT)
    s, w = shapes.graded_rule(
        12
    )  # to the 23rd degree of t: s^1.3 has the 13th, and 9 of the step
    for power in (0.0, 0.7, 1.3):
        assert (w * s**power).sum() == pytest.approx(1 / (1 + power), rel=1e-13)


def test_polynomials_are_those_written_out():
    value, slope = shapes.polynomial_basis(4, S)
    assert value == pytest.approx(np.array(VALUES), **EXACT)
    assert slope == pytest.approx(np.array(SLOPES), **EXACT)
    value, slope = shapes.polynomial_basis(1, S)
    assert (value.tolist(), slope.tolist()) == (
        [(1 - S).tolist(), S.tolist()],
        [[1.0] * 4],
    )


def test_plain_functions_lie_on_a_gauss_rule():
    one = shapes.polynomial_interval(3, 5)
    s, w = shapes.gauss_rule(5)
    assert one.degree == 3
    assert np.array_equal(one.point, s)
    assert np.array_equal(one.weight, w)
    assert one.value == pytest.approx(shapes.polynomial_basis(3, s)[0])
    assert one.slope == pytest.approx(shapes.polynomial_basis(3, s)[1])


@pytest.mark.parametrize("at_end", [False, True])
def test_bubbles_of_the_rim_are_powers_of_the_distance_from_it(at_end):
    """Two powers beyond polynomials of the third degree, on 40 points: all products are
    polynomials of t below 80.
    """
    tau = (0.7, 1.3)
    one = shapes.rim_interval(3, 40, tau, at_end)
    s, w = one.point, one.weight
    away = shapes.graded_rule(40)[0]
    assert (one.degree, one.value.shape, one.slope.shape) == (5, (6, 40), (5, 40))
    assert s == pytest.approx(1 - away if at_end else away)
    assert w.sum() == pytest.approx(1, rel=1e-13)
    plain = shapes.polynomial_basis(3, s)
    assert one.value[:4] == pytest.approx(plain[0])
    assert one.slope[:3] == pytest.approx(plain[1])
    assert (one.slope * w) @ one.slope.T == pytest.approx(
        np.eye(5), abs=1e-12
    )  # rounding of two rounds
    for k, power in enumerate(
        tau
    ):  # made of the bubbles before it and a positive share of the new one
        parts = np.vstack([one.value[2 : 4 + k], away**power - away])
        share, *_ = np.linalg.lstsq(parts.T, one.value[4 + k], rcond=None)
        assert share @ parts == pytest.approx(
            one.value[4 + k], abs=1e-11
        )  # of parts some tens of times as large
        assert np.sign(share[-1]) == 1
        for n in (1, 2, 5):  # by parts: values vanish at both ends
            assert (one.value[4 + k] * n * s ** (n - 1) * w).sum() == pytest.approx(
                -(one.slope[3 + k] * s**n * w).sum(), abs=1e-12
            )


def test_derivatives_of_values_are_slopes():
    assert shapes.derivative_matrix(3).tolist() == [
        [-1, 1, 0, 0],
        [0, 0, 1, 0],
        [0, 0, 0, 1],
    ]
    value, slope = shapes.polynomial_basis(3, S)
    step = 1e-6
    high, low = (shapes.polynomial_basis(3, S + d)[0] for d in (step, -step))
    assert shapes.derivative_matrix(3).T @ slope == pytest.approx(
        (high - low) / (2 * step), abs=1e-8
    )  # third derivative
    assert value.shape == (4, 4)


def test_products_on_a_square_run_along_xi_slowly_and_have_their_curls_and_gradients():
    xi, eta = shapes.polynomial_interval(2, 4), shapes.polynomial_interval(3, 5)
    both = shapes.square_basis(xi, eta)
    assert both.weight == pytest.approx(
        np.array([a * b for a in xi.weight for b in eta.weight])
    )

    def products(a, b):
        return np.array([[u * v for u in f for v in g] for f in a for g in b])

    assert both.along_xi == pytest.approx(products(xi.slope, eta.value))
    assert both.along_eta == pytest.approx(products(xi.value, eta.slope))
    assert both.scalar == pytest.approx(products(xi.value, eta.value))
    assert both.turn == pytest.approx(products(xi.slope, eta.slope))
    d_xi, d_eta = (
        [-one.slope[0], one.slope[0], *one.slope[1:]] for one in (xi, eta)
    )  # derivatives of the values
    curls = np.vstack(
        [-products(xi.slope, d_eta), products(d_xi, eta.slope)]
    )  # d(along eta)/dxi - d(along xi)/deta
    assert both.curl.T @ both.turn == pytest.approx(curls)
    many = len(both.along_xi)
    assert both.gradient[:many].T @ both.along_xi == pytest.approx(
        products(d_xi, eta.value)
    )
    assert both.gradient[many:].T @ both.along_eta == pytest.approx(
        products(xi.value, d_eta)
    )
