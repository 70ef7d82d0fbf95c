"""Derivatives of pillars by their own shape, where the solver is replaced by closed
forms: who weighs what, and by
how much two truncations differ."""

import cmath
import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.cell import Cell, Index
from metalens.cell.shapes import Circle, Rectangle
from metalens.ground.errors import LensError
from metalens.lens import DiameterMap, Lens
from metalens.lens.pairs import Pairs
from metalens.made import Answers, own
from metalens.pillars import Proxy

CELL = Cell(0.4, 0.57, Index(2.6), shape=Rectangle(0.62))
PROXY = Proxy(
    np.array([[4.6, 4.2]]), np.array([[0.83, 0.02]]), (0.1, 0.3), (0.85, 0.85), 0.0, 0.0
)
ANGLED = Proxy(PROXY.phase_coefficients[None], PROXY.transmission_coefficients[None], *((0.1, 0.3), (0.85, 0.85)), 0, 0,
               max_angle_rad=0.2)  # fmt: skip


def lens(cell=CELL, proxy=PROXY, hand=""):
    turns = {"angle_rad": np.full((3, 4), 0.3)} if hand else {}
    return Lens(
        DiameterMap(np.full((3, 4), 0.2), 0.4, **turns),
        cell,
        proxy,
        0.85,
        150.0,
        1500.0,
        "map",
        hand=hand,
    )


def rates(coarse, fine):
    """What is judged of rows (causes, and the edges last) of both truncations."""
    return own._judged(np.array(coarse, complex), np.array(fine, complex))


def test_the_error_is_the_largest_change_of_a_row_over_its_size():
    """Rows of 3-4-5 and 5-12-13 triangles: changes of 0.5 over 5 and of 2.6 over 13."""
    found = rates([[3, 4.5j], [5, 12], [2.6, 1]], [[3, 4j], [5, 14.6], [0.6, 1]])
    change = 2.6 / math.hypot(5, 14.6), 0.1, 2 / math.hypot(0.6, 1)
    assert found.error == pytest.approx(change[2], rel=1e-12)
    assert found.rates.tolist() == [[3, 4j], [5, 14.6]]
    assert found.edges.tolist() == [0.6, 1]
    assert rates(
        [[3, 4.5j], [5, 12], [0, 0]], [[3, 4j], [5, 14.6], [0, 0]]
    ).error == pytest.approx(change[0])
    assert rates(
        [[3, 4.5j], [5, 12], [0, 0]], [[3, 4j], [5, 12], [0, 0]]
    ).error == pytest.approx(change[1])


def test_a_row_of_rounding_does_not_count_and_a_little_more_does():
    """A millionth of the largest, 20."""
    for size, want in ((1.9e-5, 0.0), (2.1e-5, 0.5)):
        assert rates(
            [[20, 1], [size, size / 2], [0, 0]], [[20, 1], [size, 0], [0, 0]]
        ).error == pytest.approx(want)
    assert rates([[0, 0], [0, 0]], [[0, 0], [0, 0]]).error == 0
    turned = rates(
        [[-20, -1], [-8, -3], [0, 0]], [[-20, -1], [-8.8, -3], [0, 0]]
    )  # signs do not count
    assert turned.error == pytest.approx(0.8 / math.hypot(8.8, 3))
    tiny = rates(
        [[2e-10, 0], [0, 0]], [[4e-10, 0], [0, 0]]
    )  # less than 1e-9 is measured against that
    assert tiny.error == pytest.approx(0.2)


def test_weights_are_of_the_light_that_the_proxy_is_of():
    round_cell = Cell(0.4, 0.57, Index(2.6), shape=Circle())
    assert own.seen(lens()).tolist() == [[1, 0], [0, 0]]  # light along x
    assert own.seen(lens(proxy=ANGLED)).tolist() == [[0.5, 0], [0, 0.5]]
    assert own.seen(lens(round_cell)).tolist() == [[0.5, 0], [0, 0.5]]
    for hand, sign in (("right", 1), ("left", -1)):
        want = np.array([[1, 1j * sign], [1j * sign, -1]]) / 2
        assert own.seen(lens(hand=hand)) == pytest.approx(want, abs=1e-15)


def solver(log):
    """ln t of every number of a cell with slopes of its own, whatever the truncation,
    which is told apart by 1 %.
    """

    def derivatives(cell, size_um, wavelength_um, *, harmonics, by):
        log.append((size_um, wavelength_um, harmonics, cell.shape.ratio))
        t = np.array([[0.7 + size_um, 0.1j], [0.2, -0.4j]])
        slope = {name: len(name) + 1j * size_um + 0.01 * harmonics for name in by}
        moved = {
            name: SimpleNamespace(t=np.array([[v, 2 * v], [3 * v, -v]]))
            for name, v in slope.items()
        }
        return SimpleNamespace(jones=SimpleNamespace(t=t), by=moved)

    return derivatives


def expected(names, size, harmonics, weight):
    """By hand: Σ share weight · dt / Σ weight · t."""
    t = np.array([[0.7 + size, 0.1j], [0.2, -0.4j]])
    dt = np.array([[1, 2], [3, -1]])
    slope = sum(
        share * (len(name) + 1j * size + 0.01 * harmonics)
        for name, share in names.items()
    )
    return slope * (weight * dt).sum() / (weight * t).sum()


@pytest.mark.parametrize(("sidewall", "reach"), [(0.0, (6, 8)), (0.05, (5, 6))])
def test_each_size_is_asked_of_two_truncations_and_edges_less_size(
    monkeypatch, sidewall, reach
):
    log = []
    monkeypatch.setattr("metalens.rcwa.jones_derivatives", solver(log))
    monkeypatch.setattr(
        own,
        "_difference",
        lambda row, wave, weights, task: [1j * task[1] for _ in weights],
    )
    monkeypatch.setattr(
        own.executor,
        "gather",
        lambda work, common, tasks: [work(common, task) for task in tasks],
    )
    cell = Cell(0.4, 0.57, Index(2.6), shape=Rectangle(0.62), sidewall_rad=sidewall)
    sizes = np.array([0.17, 0.23, 0.21])
    found = own.own_rates(lens(cell), sizes)
    assert [entry[:3] for entry in log] == [
        (size, 0.85, n) for n in reach for size in sizes
    ]
    weight = np.diag([1.0, 0.0])
    edges = {"grow_um": 1.0, "size_um": -1.0}
    assert found.edges == pytest.approx(
        np.array([expected(edges, s, reach[1], weight) for s in sizes])
    )
    causes = [row for _, row in own.of_kind(Answers)]
    assert found.rates.shape == (len(causes), 3)
    for line, row in zip(found.rates, causes, strict=True):
        numbers = own._numbers(row, cell, 0.2)
        if numbers is None:
            assert line == pytest.approx(1j * sizes)
        else:
            want = [
                expected(own._numbers(row, cell, s), s, reach[1], weight) for s in sizes
            ]
            assert line == pytest.approx(np.array(want))
    every = np.vstack([found.rates, found.edges])
    assert 0 < found.error < 0.01 * np.abs(every).max()


def test_a_cause_of_no_number_goes_by_differences_beside_those_that_have_one(
    monkeypatch,
):
    numbers = SimpleNamespace(
        acts=Answers(
            quick=None, changed=None, step=0.1, numbers=lambda cell, d: {"height_um": d}
        )
    )
    steps = SimpleNamespace(acts=Answers(quick=None, changed=None, step=0.1))
    bends = SimpleNamespace(acts=None)
    assert own._numbers(numbers, CELL, 0.3) == {"height_um": 0.3}
    assert own._numbers(steps, CELL, 0.3) is None
    assert own._numbers(bends, CELL, 0.3) is None
    monkeypatch.setattr(own, "of_kind", lambda kind: [(2, steps), (5, numbers)])
    monkeypatch.setattr("metalens.rcwa.jones_derivatives", solver([]))
    monkeypatch.setattr(
        own,
        "_difference",
        lambda row, wave, weights, task: [wave * 1j for _ in weights],
    )
    weights = (np.diag([1.0, 0]), np.diag([0, 1.0]))
    found = own._derived((0.85, {"size_um": -1.0}, weights), (CELL, 0.2, 7))
    for line, weight in zip(found, weights, strict=True):
        want = [
            0.85j,
            expected({"height_um": 0.2}, 0.2, 7, weight),
            expected({"size_um": -1.0}, 0.2, 7, weight),
        ]
        assert line == pytest.approx(want)


def test_pillars_of_two_sizes_are_each_seen_in_both_lights_and_have_no_edges(
    monkeypatch,
):
    log = []
    monkeypatch.setattr("metalens.rcwa.jones_derivatives", solver(log))
    monkeypatch.setattr(
        own, "_difference", lambda row, wave, weights, task: [0j for _ in weights]
    )
    monkeypatch.setattr(
        own.executor,
        "gather",
        lambda work, common, tasks: [work(common, task) for task in tasks],
    )
    cell = Cell(0.4, 0.57, Index(2.6), shape=Rectangle())
    found = own.pair_rates(lens(cell), np.array([0.17, 0.23]), np.array([0.21, 0.13]))
    assert list(found) == ["x", "y"]
    ratios = [0.21 / 0.17, 0.13 / 0.23] * 2
    assert [entry[0] for entry in log] == [0.17, 0.23] * 2
    assert [entry[3] for entry in log] == pytest.approx(ratios)
    place, row = next(
        (i, r) for i, (_, r) in enumerate(own.of_kind(Answers)) if r.name == "height_nm"
    )
    for light, weight in (("x", np.diag([1.0, 0])), ("y", np.diag([0, 1.0]))):
        names = own._numbers(row, cell, 0.2)
        want = [expected(names, size, 8, weight) for size in (0.17, 0.23)]
        assert found[light].rates[place] == pytest.approx(np.array(want))
        assert found[light].edges.tolist() == [0, 0]


def test_a_circle_keeps_its_form_and_pairs_are_sent_elsewhere(monkeypatch):
    monkeypatch.setattr(
        own, "_rates", lambda lens, cells, edges, weights: [(cells, edges, weights)]
    )
    circle = Cell(0.4, 0.57, Index(2.6), shape=Circle())
    cells, edges, weights = own.own_rates(lens(circle), np.array([0.17, 0.2]))
    assert (cells, edges) == ([(circle, 0.17), (circle, 0.2)], {})
    assert weights[0].tolist() == [[0.5, 0], [0, 0.5]]
    assert own.own_rates(lens(), np.array([0.17]))[1] == {
        "grow_um": 1.0,
        "size_um": -1.0,
    }
    table = Pairs(
        np.array([0.85]),
        np.array([0.2]),
        np.array([0.25]),
        np.ones((1, 1, 1, 2)),
        (150.0, 1500.0),
    )
    sizes = DiameterMap(np.full((3, 4), 0.2), 0.4, length_um=np.full((3, 4), 0.25))
    two = Lens(
        sizes,
        Cell(0.4, 0.57, shape=Rectangle()),
        table.proxy,
        0.85,
        150.0,
        1500.0,
        "map",
        pairs=table,
    )
    with pytest.raises(LensError, match="no function of one size"):
        own.own_rates(two, np.array([0.2]))


def test_a_difference_spans_twice_the_step_of_its_cause(monkeypatch):
    """t = exp(slope amount) of each light: the logarithm gives the slope back, whatever
    the step.
    """
    slopes = np.array([[2.0 - 1j, 0.3], [0.1j, -4.0 + 0.5j]])
    monkeypatch.setattr(
        "metalens.rcwa.jones",
        lambda cell, size, wave, *, harmonics: SimpleNamespace(t=cell),
    )
    asked = []

    def changed(cell, amount, wavelength_um):
        asked.append((amount, wavelength_um))
        return np.exp(slopes * amount)

    row = SimpleNamespace(acts=Answers(quick=None, changed=changed, step=0.003))
    found = own._difference(
        row, 0.83, (np.diag([1.0, 0]), np.diag([0, 1.0])), (CELL, 0.2, 8)
    )
    assert found == pytest.approx([2.0 - 1j, -4.0 + 0.5j], rel=1e-9)
    assert asked == [(-0.003, 0.83), (0.003, 0.83)]
    both = own._difference(row, 0.83, (np.eye(2),), (CELL, 0.2, 8))[0]
    ends = [
        cmath.exp((2 - 1j) * a) + cmath.exp((-4 + 0.5j) * a) for a in (-0.003, 0.003)
    ]
    assert both == pytest.approx(cmath.log(ends[1] / ends[0]) / 0.006, rel=1e-9)
    none = SimpleNamespace(acts=Answers(quick=None, changed=None, step=0.003))
    assert own._difference(none, 0.83, (np.eye(2), np.eye(2)), (CELL, 0.2, 8)) == [0, 0]
