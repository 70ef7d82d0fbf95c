"""Nodes between even and Legendre's, and pillars looked up, mirrored and folded, by
small cases.
"""

import math

import numpy as np
import pytest
from scipy import optimize

from characterize.model import gather
from metalens.lens import DiameterMap, Stop

RNG = np.random.default_rng(3)


def test_nodes_are_pulled_towards_even_ones():
    """x = asin(pull t) / asin(pull) of Legendre's nodes: none is pulled by 0, all lie
    evenly in angle by 1.
    """
    legendre = np.polynomial.legendre.leggauss(7)[0]
    for pull in (1e-4, 0.6, 0.97):
        want = [
            optimize.brentq(
                lambda x, t=t, p=pull: math.sin(math.asin(p) * x) - p * t, -1, 1
            )
            for t in legendre
        ]
        assert gather.even_nodes(7, pull, -3.0, 11.0) == pytest.approx(
            4.0 + 7.0 * np.array(want), abs=1e-10
        )
    assert gather.even_nodes(7, 1e-4, -3.0, 11.0) == pytest.approx(
        4.0 + 7.0 * legendre, abs=1e-7
    )


def test_interpolation_from_pulled_nodes_is_exact_for_powers_of_their_sine():
    """Degrees 0 to 6 through seven nodes, at places of any shape, the ends among them."""
    pull, span = 0.83, (-3.0, 11.0)
    places = np.array([[-3.0, 0.4, 3.9], [7.7, 10.1, 11.0]])
    weights = gather.even_interpolation(7, pull, span, places)
    assert weights.shape == (2, 3, 7)
    nodes = gather.even_nodes(7, pull, *span)

    def sine(x):
        return np.sin(math.asin(pull) * (x - 4.0) / 7.0) / pull

    for degree in range(7):
        assert weights @ sine(nodes) ** degree == pytest.approx(
            sine(places) ** degree, abs=1e-11
        )
    assert np.abs(weights @ sine(nodes) ** 7 - sine(places) ** 7).max() > 1e-4


def test_the_pull_keeps_the_branch_as_far_as_the_tolerance_asks():
    """Branches at ± 1 / pull = cosh(a) leave exp(-a n): a n is ln(1e5 / tolerance) + n
    / 60.
    """
    for count, tolerance in ((40, 1e-3), (90, 1e-6)):
        found = gather.node_stretch(count, tolerance)
        assert math.acosh(1 / found) * count == pytest.approx(
            math.log(1e5 / tolerance) + count / 60, rel=1e-9
        )
        step = 1e-5
        assert gather.node_density(count, tolerance) == pytest.approx(
            math.asin(found) / found, rel=1e-12
        )
        # where nodes lie: dt / dx in the middle
        slope = math.sin(math.asin(found) * step) / found / step
        assert gather.node_density(count, tolerance) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize(("axis", "alike"), [(None, True), (0, False), (1, False)])
def test_both_mirrors_and_straight_light_are_needed_for_a_quarter_to_tell_all(
    axis, alike
):
    quarter = RNG.uniform(0.1, 0.2, (3, 2))
    half = np.concatenate([quarter, quarter[::-1]])
    whole = np.concatenate([half, half[:, ::-1]], axis=1)
    if axis is not None:
        whole = whole + 0.01 * np.expand_dims(np.arange(whole.shape[axis]), 1 - axis)
    d = DiameterMap(whole, 0.4)
    assert gather.is_mirror_symmetric(d, (0.0, 0.0)) is alike
    assert gather.is_mirror_symmetric(d, (0.0, 0.0), Stop(20.0, 30.0)) is alike
    assert not gather.is_mirror_symmetric(d, (0.0, 0.0), Stop(20.0, 30.0, (0.0, 0.2)))
    assert not gather.is_mirror_symmetric(d, (0.1, 0.0))
    assert not gather.is_mirror_symmetric(d, (0.0, -0.1))


@pytest.mark.parametrize(("count", "first"), [(5, 2), (6, 3)])
def test_each_place_takes_the_weight_of_its_mirror_image_the_middle_one_its_own(
    count, first
):
    weights = np.arange(1.0, 2 * count + 1).reshape(count, 2) ** 2
    kept = weights.copy()
    found = gather.fold_weights(weights, first)
    for i in range(first, count):
        image = count - 1 - i
        want = kept[i] if image == i else kept[i] + kept[image]
        assert found[i].tolist() == want.tolist()
    assert weights.tolist() == kept.tolist()
    assert gather.fold_weights(weights, 0) is weights


def test_functions_of_a_pillar_stand_column_by_column_real_parts_first():
    table = np.array([[1 + 2j, 3 - 1j], [0.5 - 2j, 4j]])
    place, turns = (
        np.array([[0, 1, 1], [1, 0, 0]]),
        np.array([[1, 1j, -1], [2 - 1j, 0.5, 1j]]),
    )
    found = gather.gather_light(table, place, turns)
    assert found.shape == (3, 2, 4)
    for row, column in np.ndindex(2, 3):
        values = table[place[row, column]] * turns[row, column]
        assert found[column, row].tolist() == [*values.real, *values.imag]
