"""Pillars of two sizes under change: a table of closed forms and its tangents, kinds by
hand, what rates differ by.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell
from metalens.cell.shapes import Rectangle
from metalens.ground.errors import LensError
from metalens.lens import DiameterMap, Lens, Pairs
from metalens.made import two_sizes
from metalens.made.own import OwnRates
from metalens.made.two_sizes import Kinds, PairSensitivities, PairTable
from metalens.pillars import Proxy

WAVES, X, Y = (
    np.array([0.63, 0.85]),
    0.1 + 0.03 * np.arange(5),
    0.15 + 0.02 * np.arange(6),
)


def smooth(x, y, light):
    """A cubic in both sizes, which splines hold; not alike in x and y, or for both
    lights.
    """
    a, b = 10 * (x - 0.15), 10 * (y - 0.2)
    other = 0.1 if light == "y" else 0.0
    return (
        0.6
        - other
        + 0.2j
        + (0.1 + 0.2j) * a
        - 0.15j * b
        + 0.05 * a * b**2
        - (0.04 - 0.1j) * a**3
        + other * b**3
    )


def lens(light="x", size=None, length=None):
    size = np.full((3, 4), X[1]) if size is None else size
    length = np.full((3, 4), Y[2]) if length is None else length
    by_light = np.stack([smooth(X[:, None], Y, one) for one in "xy"], -1)
    t = np.stack([0.3 * by_light, by_light])
    pairs = Pairs(WAVES, X, Y, t, (170.0, 800.0))
    cell = Cell(0.4, shape=Rectangle())
    return Lens(DiameterMap(size, 0.4, length_um=length), cell, pairs.proxy, 0.85, 150.0, 900.0, "map", pairs=pairs,
                light=light)  # fmt: skip


@pytest.mark.parametrize("light", ["x", "y"])
def test_between_its_entries_a_table_is_cubic_in_both_sizes(light):
    x, y = np.array([[0.11, 0.173], [0.1, 0.22]]), np.array([[0.16, 0.2], [0.25, 0.15]])
    found = PairTable.of(lens(light)).t(x, y)
    assert found.shape == (2, 2)
    assert found == pytest.approx(smooth(x, y, light), abs=1e-12)  # rounding of splines


def test_few_sizes_take_the_degree_that_they_have():
    one = lens()
    few = Pairs(WAVES, X[:2], Y[:3], one.pairs.t[:, :2, :3], (170.0, 800.0))
    table = PairTable.of(
        Lens(one.diameters, one.cell, few.proxy, 0.85, 150.0, 900.0, "map", pairs=few)
    )
    t = few.t[1, :, :, 0]
    assert complex(table.t(np.array(0.115), np.array(Y[1]))) == pytest.approx(
        (t[0, 1] + t[1, 1]) / 2
    )
    middle = (
        3 * t[1, 0] + 6 * t[1, 1] - t[1, 2]
    ) / 8  # half way between the first two, on their parabola
    assert complex(table.t(np.array(X[1]), np.array(0.16))) == pytest.approx(middle)


@pytest.mark.parametrize(
    ("dx", "dy"),
    [(-0.02, 0.0), (0.013, 0.0), (0.0, -0.01), (0.0, 0.017), (-0.01, 0.012)],
)
def test_beyond_its_ends_level_and_phase_go_on_straight(dx, dy):
    """ln t at the nearest place, and its slopes by differences inside: the level grows
    by |t| times the real part.
    """
    x, y = (
        (0.1 if dx < 0 else 0.22 if dx > 0 else 0.17),
        (0.15 if dy < 0 else 0.25 if dy > 0 else 0.21),
    )
    value, step = smooth(x, y, "x"), 1e-6
    by_x = (smooth(x + step, y, "x") - smooth(x - step, y, "x")) / (2 * step) / value
    by_y = (smooth(x, y + step, "x") - smooth(x, y - step, "x")) / (2 * step) / value
    change = dx * by_x + dy * by_y
    found = PairTable.of(lens()).t(np.array([x + dx, 0.16]), np.array([y + dy, 0.2]))
    want = min(abs(value) * (1 + change.real), 1.0) * np.exp(
        1j * (np.angle(value) + change.imag)
    )
    assert found[0] == pytest.approx(want, abs=1e-8)  # of the differences
    assert found[1] == pytest.approx(smooth(0.16, 0.2, "x"), abs=1e-12)


def test_a_level_beyond_the_table_stays_between_a_thousandth_and_1():
    for sign, level in ((1, 1.0), (-1, 1e-3)):
        t = np.broadcast_to(
            (0.5 + sign * 3 * (X - 0.1))[:, None, None], (5, 6, 2)
        ) * np.exp(0.4j)
        pairs = Pairs(WAVES, X, Y, np.stack([t, t]), (170.0, 800.0))
        one = lens()
        table = PairTable.of(
            Lens(
                one.diameters,
                one.cell,
                pairs.proxy,
                0.85,
                150.0,
                900.0,
                "map",
                pairs=pairs,
            )
        )
        far = table.t(np.array([0.4]), np.array([0.2]))
        assert far[0] == pytest.approx(level * np.exp(0.4j), rel=1e-9)


def test_pillars_of_one_size_have_no_table():
    proxy = Proxy(
        np.array([[3.0, 2.8]]), np.array([[0.9]]), (0.1, 0.3), (0.85, 0.85), 0.0, 0.0
    )
    with pytest.raises(LensError, match="one size each"):
        PairTable.of(
            Lens(
                DiameterMap(np.full((2, 3), 0.2), 0.4),
                Cell(0.4),
                proxy,
                0.85,
                150.0,
                900.0,
                "map",
            )
        )


SIZE = np.array([[0.2, 0.0, 0.13], [0.13, 0.2, 0.13]])
LENGTH = np.array([[0.17, 0.0, 0.24], [0.21, 0.17, 0.24]])


def test_kinds_rise_by_width_then_length_and_count_their_pillars():
    """Sizes are of one kind to half of 0.05 nm."""
    off = 2e-5 * np.array([[1, 0, -1], [1, -1, 1]])
    for size in (SIZE, np.where(SIZE > 0, SIZE + off, 0)):
        kinds = Kinds.of(DiameterMap(size, 0.4, length_um=LENGTH))
        assert kinds.width_um == pytest.approx(np.array([0.13, 0.13, 0.2]))
        assert kinds.length_um == pytest.approx(np.array([0.21, 0.24, 0.17]))
        assert kinds.count.tolist() == [1, 2, 2]
        index = kinds.index(DiameterMap(size, 0.4, length_um=LENGTH))
        assert index.tolist() == [[2, 3, 1], [0, 2, 1]]
        assert index.dtype == np.int32
        some = kinds.index(
            DiameterMap(size, 0.4, length_um=LENGTH), slice(1, 2), slice(0, 2)
        )
        assert some.tolist() == [[0, 2]]
    apart = np.where(SIZE > 0, SIZE + 1e-4 * np.array([[1, 0, 0], [0, 0, 0]]), 0)
    assert Kinds.of(DiameterMap(apart, 0.4, length_um=LENGTH)).count.tolist() == [
        1,
        2,
        1,
        1,
    ]
    full = Kinds.of(
        DiameterMap(SIZE[1:], 0.4, length_um=LENGTH[1:])
    )  # no site is empty
    assert full.count.tolist() == [1, 1, 1]
    assert Kinds.of(DiameterMap(SIZE, 0.4)).length_um.tolist() == [0.0, 0.0]


def test_pairs_to_solve_lie_far_from_each_other():
    """From (0, 0): the farthest is (9, 0), then (4, 5), 6.4 from both ends of the line;
    (1, 0) comes last, once.
    """
    points = np.array([[1.0, 0], [0, 0], [9, 0], [4, 5], [4, 1], [0, 0]])
    assert two_sizes._apart(points, 1, 4) == [1, 2, 3, 4]
    assert two_sizes._apart(points, 1, 9) == [1, 2, 3, 4, 0]
    assert two_sizes._apart(points, 3, 1) == [3]


def test_sensitivities_are_of_the_most_frequent_pair_first_with_the_unseen_beside_the_solvers_error(
    monkeypatch,
):
    """Rates along a line of sizes: linear radial functions are straight between nodes
    and level beyond the last.
    """
    size, length = np.zeros((2, 4)), np.zeros((2, 4))
    size[0], length[0] = [0.13, 0.13, 0.21, 0.17], [0.2, 0.2, 0.2, 0.2]
    size[1, 0], length[1, 0] = 0.13, 0.2
    asked = []

    def solved(lens, width, long):
        asked.append((width.tolist(), long.tolist()))
        rates = np.array([[2.0 - 1j + 3 * w, 1e-9 * (w > 0.15)] for w in width]).T
        return {
            "x": OwnRates(rates, np.zeros(len(width)), 0.011),
            "y": OwnRates(2 * rates, np.zeros(3), 0.3),
        }

    monkeypatch.setattr(two_sizes, "pair_rates", solved)
    found = two_sizes.pair_sensitivities(lens(size=size, length=length))
    assert asked[0][0] == pytest.approx([0.13, 0.21, 0.17])
    assert asked[0][1] == pytest.approx([0.2] * 3)
    assert list(found) == ["x", "y"]
    assert found["x"].error == pytest.approx(
        0.011, abs=1e-9
    )  # 0.17 is the middle of a straight line
    assert found["y"].error == pytest.approx(0.3, abs=1e-9)
    assert found["x"].width_um == pytest.approx([0.13, 0.21, 0.17])
    rates = {
        0.13: 1.0,
        0.21: 5.0,
        0.17: 2.0,
    }  # the line has 3 in the middle: half of 2 off

    def bent(lens, width, long):
        found = np.array([[rates[round(float(w), 6)] for w in width]], complex)
        return {"x": OwnRates(found, np.zeros(3), 0.011)}

    monkeypatch.setattr(two_sizes, "pair_rates", bent)
    assert two_sizes.pair_sensitivities(lens(size=size, length=length))[
        "x"
    ].error == pytest.approx(0.511)
    monkeypatch.setattr(two_sizes, "pair_rates", solved)
    few = two_sizes.pair_sensitivities(lens(size=size, length=length), count=1)
    assert few["x"].error == 0.011
    assert asked[-1][0] == pytest.approx([0.13])


def test_two_dozen_pairs_are_solved(monkeypatch):
    asked = []

    def solved(lens, width, long):
        asked.append(len(width))
        return {
            "x": OwnRates(np.ones((1, len(width)), complex), np.zeros(len(width)), 0.0)
        }

    monkeypatch.setattr(two_sizes, "pair_rates", solved)
    two_sizes.pair_sensitivities(
        lens(
            size=0.1 + 0.002 * np.arange(35.0).reshape(5, 7),
            length=np.full((5, 7), 0.2),
        )
    )
    assert asked == [24]


def test_what_is_unseen_is_the_largest_relative_miss_of_the_second_half():
    """Nodes 0, 8 tell 2 and 6 by straight lines: rates 0, 8 give 2 and 6, where 3 and
    10 stand: off by 1 and 4.
    """
    width, length = np.array([0.0, 8.0, 2.0, 6.0]), np.full(4, 0.2)
    rates = np.array([[0, 8, 3, 10], [5, 5, 5, 5], [1e-6, 1e-6, 5e-6, 1e-6]], complex)
    assert two_sizes._unseen(width, length, rates) == pytest.approx(
        math.hypot(1, 4) / math.hypot(3, 10)
    )
    rates[2] = [0, 0, 2e-5, 0]  # above a millionth of 10, off by itself
    assert two_sizes._unseen(width, length, rates) == pytest.approx(1.0)
    odd = two_sizes._unseen(width[:3], length[:3], rates[:1, :3])  # two tell one
    assert odd == pytest.approx(1 / 3)
    assert two_sizes._unseen(width[:1], length[:1], rates[:, :1]) == 0
    tiny = np.array([[0, 0, 3e-10, 0]], complex)
    assert two_sizes._unseen(width, length, tiny) == pytest.approx(0.3)  # against 1e-9


def test_rates_at_other_pairs_are_carried_and_the_causes_not_solved_are_0():
    made = PairSensitivities(
        np.array([0.1, 0.2]),
        np.array([0.3, 0.3]),
        np.array([[1 + 2j, 3.0], [4.0, -2j]]),
        0.0,
    )
    found = made.at(np.array([0.1, 0.125, 0.2]), np.array([0.3, 0.3, 0.3]))
    want = [[1 + 2j, 1.5 + 1.5j, 3.0], [4.0, 3.0 - 0.5j, -2j]]
    assert found[:2] == pytest.approx(np.array(want))
    assert not found[2:].any()
    assert found.shape[1] == 3
