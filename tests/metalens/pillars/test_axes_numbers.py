"""Where a library over two sizes is solved, what its bars are made of: every step on
numbers made by hand.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes import Rectangle
from metalens.ground import config
from metalens.pillars import Sweep
from metalens.pillars.axes import between, solving

SQUARE = Cell(0.42, 0.4, Index(1.7), Index(1.45), shape=Rectangle())
OBLONG = replace(
    SQUARE, lattice=Lattice("rectangular", 1.1)
)  # where sizes are not exchanged


def swept(x, y, samples, waves=(0.7,)):
    """Settings of so few samples that their entries can be counted."""
    return Sweep(waves, diameters_um=x, lengths_um=y, samples=samples, tolerance=0.1)


def pillar(x, y, wave=0.7, near=0.012):
    """(..., 4) Jones matrix in closed form: a resonance that moves with both sizes;
    exchanged sizes exchange x and y.

    near: half-width of the resonance.
    """
    x, y = np.broadcast_arrays(x, y)

    def one(a, b):
        pole = 0.2 * near / (a - 0.21 - 0.3 * (b - 0.25) + 1j * near)
        return 0.5 * np.exp(2j * np.pi * (a + 0.4 * b) / wave) + pole

    def mixed(a, b):
        return 0.1j * np.cos(9 * a - 4 * b)

    return np.stack([one(x, y), mixed(x, y), mixed(y, x), one(y, x)], axis=-1)


def bar(x, y):
    """Of the solver: unlike for exchanged sizes where those are solved by themselves."""
    return 0.002 + 0.01 * x + 0.003 * y


class Solver:
    """A journal whose pillars are solved in closed form."""

    def __init__(self, near=0.012, loud=1.0):
        self.near, self.loud, self.asked, self.ended = (
            near,
            loud,
            {"pillars": [], "held out": []},
            False,
        )

    def run(self, tasks, console, label):
        made = []
        for task in tasks:
            size, shape = (
                task["size_um"],
                config.loads(task["cell"], Cell, where="task").shape,
            )
            x, y, wave = size, shape.ratio * size, task["lights"][0][0]
            self.asked[label].append((x, y, wave, task["tolerance"], task["harmonics"]))
            t = [[v.real, v.imag] for v in pillar(x, y, wave, self.near).tolist()]
            made.append(
                {
                    "t": t,
                    "error": [
                        self.loud * bar(x, y) * share for share in (0.5, 0.25, 1.0, 0.7)
                    ],
                }
            )
        return made

    def finish(self):
        self.ended = True

    def lines(self, count, wave=0.7):
        """Nodes of the first grid that has so many along x, from the order of what was
        asked for.
        """
        found = [set(), set()]
        for x, y, *_ in (one for one in self.asked["pillars"] if one[2] == wave):
            if (
                len(found[0] | {round(x, 12)}) > count
                or len(found[1] | {round(y, 12)}) > count
            ):
                break
            found[0].add(round(x, 12))
            found[1].add(round(y, 12))
        return tuple(np.array(sorted(each)) for each in found)


def test_entries_share_the_step_of_the_longer_range():
    rounding = 1e-14  # a step, its multiple and a sum below 1: 1e-16 each
    x, y = solving.entries(
        swept((0.1, 0.4), (0.2, 0.27), 25)
    )  # 0.3 in 24 steps of 0.0125: 0.07 holds 5 of them
    assert x == pytest.approx(0.1 + 0.0125 * np.arange(25), abs=rounding)
    assert y == pytest.approx([0.2, 0.2125, 0.225, 0.2375, 0.25, 0.2625], abs=rounding)
    x, y = solving.entries(swept((0.3, 0.41), (0.1, 0.32), 21))
    assert x == pytest.approx(np.linspace(0.3, 0.41, 11), abs=rounding)
    assert x[-1] <= 0.41
    assert len(y) == 21


def test_nodes_are_added_in_the_middle_of_the_gaps_with_most_doubt():
    """Sums of doubt in the gaps: 3, 9 and 4; the second halved leaves 5 and 4; then the
    one of 5.
    """
    lines, look = np.array([0.0, 1.0, 3.0, 4.0]), np.array([0.5, 0.6, 1.5, 2.5, 3.2])
    profile = np.array([1.0, 2.0, 4.0, 5.0, 4.0])
    assert solving._more(lines, look, profile) == pytest.approx([0, 1, 2, 2.5, 3, 4])
    edge = solving._more(
        np.array([0.0, 1.0, 2.0]), np.array([1.0, 1.9]), np.array([99.0, 1.0])
    )
    assert edge == pytest.approx(
        [0, 1, 1.5, 1.75, 2]
    )  # what lies on a node counts for neither gap


def test_pairs_held_out_follow_roberts_s_sequence():
    g = 1.324717957244746  # g³ = g + 1
    row, column = solving._spread((np.zeros(31), np.zeros(17)))
    n = np.arange(1, 25)
    assert row.tolist() == np.floor(np.mod(0.5 + n / g, 1) * 31).tolist()
    assert column.tolist() == np.floor(np.mod(0.5 + n / g**2, 1) * 17).tolist()


def test_errors_of_the_solver_are_carried_as_shifts_of_the_sizes():
    """t = 3 x + 2j y in one element, half as steep in the other: steepness hypot(3, 2)
    + 2 / range of x everywhere.
    """
    places = np.linspace(0.1, 0.5, 9), np.linspace(0.2, 0.4, 5)
    first = 3 * places[0][:, None] + 2j * places[1]
    value = np.stack([first / 2, first], axis=-1)
    nodes = np.array([0.1, 0.3, 0.5]), np.array([0.2, 0.37, 0.4])
    bars = np.array([[0.01, 0.02, 0.03], [0.07, 0.011, 0.012], [0.005, 0.004, 0.09]])
    got = solving._carried(nodes, bars, places, value)
    want = np.empty((9, 5))
    for i, x in enumerate(places[0]):
        for j, y in enumerate(places[1]):
            a, b = int(x >= 0.3 - 1e-9), int(y >= 0.37)
            want[i, j] = bars[
                a : a + 2, b : b + 2
            ].max()  # the slope is the same everywhere: it drops out
    assert got == pytest.approx(want, rel=1e-9)


def test_a_carried_error_grows_with_the_slope():
    """t = x² (4 entries a node): bars at x = 0.2 and 0.6 with slopes 0.4 and 1.2,
    carried to slopes between.
    """
    places = np.linspace(0.0, 0.8, 17), np.array([0.3, 0.4, 0.5])
    value = (places[0] ** 2)[:, None, None] * np.ones((17, 3, 4))
    nodes = np.array([0.2, 0.6]), np.array([0.3, 0.5])
    bars = np.array([[0.02, 0.02], [0.05, 0.05]])
    steep = 2 * places[0] + 2 / 0.8
    shift = max(0.02 / (0.4 + 2.5), 0.05 / (1.2 + 2.5))
    got = solving._carried(nodes, bars, places, value)
    assert got[1:-1] == pytest.approx(
        (shift * steep)[1:-1, None] * np.ones(3), rel=1e-9
    )  # ends: one-sided slopes


def test_the_rival_has_fewer_lines_and_keeps_both_ends():
    assert between._fewer(10).tolist() == [0, 1, 3, 4, 5, 7, 8, 9]
    assert between._fewer(7).tolist() == [0, 1, 3, 4, 5, 6]  # the last one stays
    assert between._fewer(3).tolist() == [0, 1, 2]


def test_half_a_distance_of_nodes_in_places():
    assert (
        between._half_gap(np.array([0.0, 0.1, 0.4]), np.linspace(0, 0.4, 11)) == 3
    )  # 0.2 / 2 / 0.04: 2.5, up
    assert (
        between._half_gap(np.array([0.4, 0.1, 0.0]) * -1, np.linspace(0, -0.4, 21)) == 5
    )
    assert between._half_gap(np.array([0.0, 0.4]), np.array([0.2])) == 0


def test_the_doubt_is_the_larger_disagreement_around_a_place(monkeypatch):
    """Interpolations made by hand on unlike axes: along y first apart in one place, the
    rival in another.
    """
    x, y = np.linspace(0, 1, 5), np.linspace(0, 2, 7)
    at_x, at_y = np.linspace(0, 1, 9), np.linspace(0, 2, 19)
    values = np.arange(5 * 7 * 2.0).reshape(5, 7, 2)
    calls = []

    def both(a, b, values, at_a, at_b, tolerance):
        calls.append((a, b, values, at_a, at_b, tolerance))
        out = np.full((len(at_a), len(at_b), 2), 0.5 + 0.1j)
        if len(calls) == 2:  # the other order: rows along y
            out[15, 1] += 0.02, -0.08j
        if len(calls) == 3:
            out[7, 3] += 0.05
        return out

    monkeypatch.setattr(between, "_both", both)
    made = between.surface((x, y), values, (at_x, at_y), tolerance=0.4)
    fewer = [0, 1, 3, 4], [0, 1, 3, 4, 5, 6]
    want = [
        (x, y, values, at_x, at_y), (y, x, values.swapaxes(0, 1), at_y, at_x),
        (x[fewer[0]], y[fewer[1]], values[np.ix_(*fewer)], at_x, at_y),
    ]  # fmt: skip
    for got, arrays in zip(calls, want, strict=True):
        assert all(
            np.array_equal(one, other) for one, other in zip(got, arrays, strict=False)
        )
        assert got[5] == 0.4
    assert made.value[1, 15] == pytest.approx([0.51 + 0.1j, 0.5 + 0.06j])
    assert made.value[0, 0] == pytest.approx([0.5 + 0.1j] * 2)
    doubt = np.full((9, 19), 0.02)  # a twentieth of the tolerance
    # half of a node's distance: 0.125 of 0.125 along x, one place; 1/6 of 1/9 along y,
    # two
    doubt[0:3, 13:18] = 0.1
    doubt[6:9, 1:6] = 0.07
    assert made.doubt == pytest.approx(doubt, abs=1e-12)


def test_lines_are_fitted_along_x_and_their_values_along_y(monkeypatch):
    """A tenth of the tolerance each; every line of nodes on its own, all elements of
    the matrix together.
    """
    asked = []

    def fit(nodes, values, *, tolerance):
        asked.append((nodes, values, tolerance))
        slope = (values[-1] - values[0]) / (nodes[-1] - nodes[0])
        return lambda at: values[0] + (np.asarray(at) - nodes[0])[:, None] * slope

    monkeypatch.setattr(between.rational, "fit", fit)
    x, y, at_x, at_y = (
        np.array([0.0, 1.0, 3.0]),
        np.array([1.0, 2.0]),
        np.array([0.5, 2.0]),
        np.array([1.0, 1.5, 1.75]),
    )
    values = np.stack([x[:, None] * y, x[:, None] - 2 * y], axis=-1)
    got = between._both(x, y, values, at_x, at_y, 0.3)
    assert got == pytest.approx(
        np.stack([at_x[:, None] * at_y, at_x[:, None] - 2 * at_y], axis=-1)
    )
    assert [one[2] for one in asked] == pytest.approx([0.03] * 4)
    assert [len(one[0]) for one in asked] == [3, 3, 2, 2]


def test_the_truncation_is_the_least_that_meets_its_share_at_four_probes(monkeypatch):
    from metalens import rcwa

    asked = []

    def jones(cell, size, wavelength, *, tolerance, harmonics):
        asked.append((cell, size, wavelength, tolerance, harmonics))
        return SimpleNamespace(converged=harmonics >= 7)

    monkeypatch.setattr(rcwa, "jones", jones)
    settings = swept((0.1, 0.4), (0.2, 0.3), 31, (0.7, 0.8))
    for most, want in ((12, 7), (6, 6), (4, 4)):
        monkeypatch.setattr(rcwa, "most_harmonics", lambda cell, size, most=most: most)
        asked.clear()
        assert solving._reach(SQUARE, settings) == want
    monkeypatch.setattr(rcwa, "most_harmonics", lambda cell, size: 12)
    asked.clear()
    solving._reach(SQUARE, settings)
    last = [one for one in asked if one[4] == 7]
    places = [
        (0.1 + 0.3 * a, 0.2 + 0.1 * b)
        for a, b in ((0.31, 0.74), (0.66, 0.36), (0.87, 0.93), (0.52, 0.11))
    ]
    assert [one[0].shape.ratio for one in last] == pytest.approx(
        [p[1] / p[0] for p in places for _ in (0, 1)]
    )
    assert [one[1] for one in last] == pytest.approx(
        [p[0] for p in places for _ in (0, 1)]
    )
    assert [one[2] for one in last] == [0.7, 0.8] * 4
    assert [one[3] for one in last] == pytest.approx([0.06] * 8)
    assert asked[0][4] == 5


@pytest.mark.parametrize("cell", [SQUARE, OBLONG])
def test_a_grid_of_nodes_is_solved_pair_by_pair(cell):
    """Of pairs that may be exchanged the larger size first; x and y change places in
    the matrix of the other.
    """
    solver, swaps = Solver(), cell is SQUARE
    nodes = solving._Nodes(cell, swept((0.1, 0.4), (0.1, 0.4), 31), 0.7, 6, solver)
    x, y = np.array([0.2, 0.3]), np.array([0.2, 0.3, 0.4])
    t, bars = nodes.grid(x, y, None, "pillars")
    assert t == pytest.approx(pillar(x[:, None], y), abs=1e-12)
    places = (
        (np.maximum(x[:, None], y), np.minimum(x[:, None], y))
        if swaps
        else (x[:, None], y)
    )
    assert bars == pytest.approx(bar(*places))
    asked = np.array(solver.asked["pillars"])
    pairs = [(0.2, 0.2), (0.3, 0.2), (0.4, 0.2), (0.3, 0.3), (0.4, 0.3)]
    pairs = pairs if swaps else [(a, b) for a in x for b in y]
    assert asked[:, :2] == pytest.approx(np.array(pairs))
    assert (asked[:, 2:] == [0.7, 0.1, 6]).all()
    assert nodes.solves == len(pairs)
    again, _ = nodes.grid(x, y[:2], None, "pillars")
    assert np.array_equal(again, t[:, :2])
    assert nodes.solves == len(asked) == len(pairs)  # known by now


@pytest.mark.parametrize("cell", [SQUARE, OBLONG])
def test_nodes_are_added_to_chebyshev_s_where_each_axis_doubts_until_few_pairs_do(cell):
    """0.4 of the tolerance is for the interpolation, between the nodes; 3 % of the
    pairs may stay above; a resonance
    counts as ten tolerances; both axes together where sizes are exchanged."""
    y_range, swaps = ((0.1, 0.4) if cell is SQUARE else (0.12, 0.33)), cell is SQUARE
    settings, solver = swept((0.1, 0.4), y_range, 31), Solver()
    x, y = solving._lines(
        solving._Nodes(cell, settings, 0.7, 6, solver), settings, None
    )
    first = np.cos(np.pi * np.arange(7) / 6)
    low, high = y_range
    look = np.linspace(0.1, 0.4, 61), np.linspace(low, high, 61)
    lines = 0.25 - 0.15 * first, (low + high) / 2 - (high - low) / 2 * first
    assert len(x) > 9
    for count in range(7, len(x) + 1, 2):
        if not swaps:
            assert all(
                np.allclose(a, b, atol=1e-9)
                for a, b in zip(solver.lines(count), lines, strict=True)
            )
        doubt = between.surface(
            lines, pillar(lines[0][:, None], lines[1]), look, tolerance=0.1
        ).doubt
        assert ((doubt > 0.04).mean() <= 0.03) == (count == len(x))
        if count < len(x):
            own = [np.minimum(doubt, 1.0).mean(1), np.minimum(doubt, 1.0).mean(0)]
            own = [own[0] + own[1]] * 2 if swaps else own
            lines = [
                solving._more(*each) for each in zip(lines, look, own, strict=True)
            ]
    assert x == pytest.approx(lines[0], abs=1e-12)
    assert y == pytest.approx(lines[1], abs=1e-12)


def test_no_more_nodes_are_added_than_may_be(monkeypatch):
    monkeypatch.setattr(solving, "MOST", 9)
    settings = swept((0.1, 0.4), (0.12, 0.33), 31)
    x, y = solving._lines(
        solving._Nodes(OBLONG, settings, 0.7, 6, Solver(0.003)), settings, None
    )
    assert (len(x), len(y)) == (9, 9)


@pytest.mark.parametrize(("near", "loud"), [(0.5, 1.0), (0.05, 300.0)])
def test_a_bar_is_the_doubt_widened_by_what_every_other_pair_shows_and_the_solver_s(
    monkeypatch, near, loud
):
    """Twice the largest error to doubt of the pairs 0, 2, 4, ..., at least a half;
    never above 2; the second half of
    the pairs is left to judge. Pairs that show more than the doubt, and such that show
    less with a poor solver."""
    solver = Solver(near, loud)
    monkeypatch.setattr(solving, "Journal", lambda *_: solver)
    found = solving.sweep(OBLONG, swept((0.1, 0.4), (0.2, 0.3), 31, (0.7, 0.8)))
    places = found.x_um, found.y_um
    row, column = solving._spread(places)
    told = []
    for index, wave in enumerate((0.7, 0.8)):
        x, y = solver.lines(99, wave)
        made = between.surface(
            (x, y), pillar(x[:, None], y, wave, near), places, tolerance=0.1
        )
        exact = pillar(places[0][row], places[1][column], wave, near)
        missed = np.abs(made.value[row, column] - exact).max(axis=-1)
        ratio = missed / made.doubt[row, column]
        wide = max(0.5, 2 * max(ratio[::2]))
        told.append(wide)
        carried = solving._carried(
            (x, y), loud * bar(x[:, None], y), places, made.value
        )
        want = np.minimum(wide * made.doubt + carried, 2.0)
        assert (want.max() == 2.0) == (loud > 1)
        assert np.median(want) < 2.0
        assert found.t[index].reshape(made.value.shape) == pytest.approx(
            made.value, abs=1e-9
        )
        assert found.t_error[index] == pytest.approx(want, rel=1e-6)
        mine = found.held_out[24 * index : 24 * (index + 1)]
        want = [
            np.full(24, index),
            places[0][row],
            places[1][column],
            missed,
            want[row, column],
        ]
        assert mine == pytest.approx(np.stack(want, axis=1), rel=1e-6, abs=1e-9)
    assert found.solves == sum(map(len, solver.asked.values()))
    assert (min(told) == 0.5) == (loud > 1)
    assert max(told) > 0.5
    assert solver.ended
    assert (found.harmonics, found.wavelength_um.tolist()) == (
        solver.asked["pillars"][0][4],
        [0.7, 0.8],
    )
