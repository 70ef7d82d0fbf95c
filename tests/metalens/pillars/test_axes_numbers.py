"""Where a library over two sizes is solved, what its bars are made of: every step on numbers made by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from metalens.pillars.axes import between, solving


def swept(x, y, samples):
    """Settings of so few samples that their entries can be counted."""
    return SimpleNamespace(diameters_um=x, lengths_um=y, samples=samples, tolerance=0.1)


def test_entries_share_the_step_of_the_longer_range():
    x, y = solving.entries(swept((0.1, 0.4), (0.2, 0.29), 13))  # 0.3 in 12 steps of 0.025: 0.09 holds 3 of them
    assert x == pytest.approx(0.1 + 0.025 * np.arange(13), abs=1e-15)
    assert y == pytest.approx([0.2, 0.225, 0.25, 0.275], abs=1e-15)
    x, y = solving.entries(swept((0.3, 0.44), (0.1, 0.38), 5))
    assert x == pytest.approx([0.3, 0.37, 0.44], abs=1e-15)
    assert x[-1] <= 0.44
    assert len(y) == 5


def test_nodes_are_added_in_the_middle_of_the_gaps_with_most_doubt():
    """Sums of doubt in the gaps: 3, 9 and 4; the second halved leaves 5 and 4; then the one of 5."""
    lines, look = np.array([0.0, 1.0, 3.0, 4.0]), np.array([0.5, 0.6, 1.5, 2.5, 3.2])
    profile = np.array([1.0, 2.0, 4.0, 5.0, 4.0])
    assert solving._more(lines, look, profile) == pytest.approx([0, 1, 2, 2.5, 3, 4])
    edge = solving._more(np.array([0.0, 1.0, 2.0]), np.array([1.0, 1.9]), np.array([99.0, 1.0]))
    assert edge == pytest.approx([0, 1, 1.5, 1.75, 2])  # what lies on a node counts for neither gap


def test_first_nodes_are_chebyshev_s_and_the_search_ends_where_few_pairs_stay_above(monkeypatch):
    """(1 - share) of the tolerance is for the interpolation; a doubt is looked at between the nodes."""
    asked = []

    def told(doubt_of):
        def surface(lines, values, look, *, tolerance):
            asked.append((lines, look, tolerance))
            return SimpleNamespace(doubt=doubt_of(len(asked), *look))

        return surface

    gridded = []

    def grid(x, y, console, label):
        gridded.append((x, y))
        return np.zeros((len(x), len(y), 4)), None

    nodes = SimpleNamespace(grid=grid, swaps=False)
    rows = np.arange(61 * 61).reshape(61, 61)
    few, many = int(0.03 * 3721), int(0.03 * 3721) + 1  # 111 of 3721 pairs may stay above 0.04
    monkeypatch.setattr(
        solving, "surface", told(lambda turn, x, y: np.where(rows < (many if turn == 1 else few), 0.0401, 0.0399))
    )
    x, y = solving._lines(nodes, swept((0.1, 0.4), (0.2, 0.3), 13), None)
    first = np.cos(np.pi * np.arange(7) / 6)
    assert asked[0][0][0] == pytest.approx(0.25 - 0.15 * first, abs=1e-15)
    assert asked[0][0][1] == pytest.approx(0.25 - 0.05 * first, abs=1e-15)
    assert [v.size for v in asked[0][1]] == [61, 61]
    assert (asked[0][1][0][0], asked[0][1][0][-1], asked[0][1][1][0], asked[0][1][1][-1]) == (0.1, 0.4, 0.2, 0.3)
    assert asked[0][2] == 0.1
    assert all(np.array_equal(a, b) for (a, b) in zip(gridded[0], asked[0][0], strict=True))
    assert len(asked) == 2  # one round more: two nodes on each axis
    assert (len(x), len(y)) == (9, 9)


@pytest.mark.parametrize("swaps", [False, True])
def test_each_axis_gets_nodes_where_its_own_doubt_lies(monkeypatch, swaps):
    """A ridge at small x and a spot at large y; a resonance counts as ten tolerances; together where they exchange."""
    seen = []

    def surface(lines, values, look, *, tolerance):
        x, y = look
        doubt = np.full((61, 61), 0.03) + 0.02 * (x[:, None] < 0.12) + np.where((x[:, None] > 0.39) & (y > 0.28), 50, 0)
        seen.append(lines)
        return SimpleNamespace(doubt=doubt)

    monkeypatch.setattr(solving, "surface", surface)
    nodes = SimpleNamespace(grid=lambda x, y, console, label: (np.zeros((len(x), len(y), 4)), None), swaps=swaps)
    monkeypatch.setattr(solving, "MOST", 9)
    x, y = solving._lines(nodes, swept((0.1, 0.4), (0.1, 0.3), 13), None)
    assert (len(x), len(y)) == (9, 9)
    look = np.linspace(0.1, 0.4, 61), np.linspace(0.1, 0.3, 61)
    doubt = np.minimum(surface(None, None, look, tolerance=0.1).doubt, 1.0)
    own = [doubt.mean(1), doubt.mean(0)]
    if swaps:
        own = [own[0] + own[1]] * 2
    for got, start, place, profile in zip((x, y), seen[0], look, own, strict=True):
        assert got == pytest.approx(solving._more(start, place, profile), abs=1e-15)


def test_pairs_held_out_follow_roberts_s_sequence():
    g = 1.324717957244746  # g³ = g + 1
    row, column = solving._spread((np.zeros(31), np.zeros(17)))
    n = np.arange(1, 25)
    assert row.tolist() == np.floor(np.mod(0.5 + n / g, 1) * 31).tolist()
    assert column.tolist() == np.floor(np.mod(0.5 + n / g**2, 1) * 17).tolist()


def test_held_out_pairs_are_off_by_their_largest_element():
    places = np.linspace(0.1, 0.4, 31), np.linspace(0.2, 0.3, 17)
    row, column = solving._spread(places)
    value = np.zeros((31, 17, 4), complex)
    off = np.array([0.01, -0.03j, 0.02, 0.005])
    exact = SimpleNamespace(
        solve=lambda pairs, console, label: [SimpleNamespace(t=(off * (1 + k)).reshape(2, 2)) for k in range(24)]
    )
    doubt = np.arange(31 * 17.0).reshape(31, 17)
    got = solving._held_out(exact, places, value, doubt, None)
    assert got[:, 0] == pytest.approx(places[0][row])
    assert got[:, 1] == pytest.approx(places[1][column])
    assert got[:, 2] == pytest.approx(0.03 * (1 + np.arange(24)))
    assert got[:, 3] == pytest.approx(doubt[row, column])


def test_errors_of_the_solver_are_carried_as_shifts_of_the_sizes():
    """t = 3 x + 2j y in one element, half as steep in the other: steepness hypot(3, 2) + 2 / range of x everywhere."""
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
            want[i, j] = bars[a : a + 2, b : b + 2].max()  # the slope is the same everywhere: it drops out
    assert got == pytest.approx(want, rel=1e-9)


def test_a_carried_error_grows_with_the_slope():
    """t = x² (4 entries a node): bars at x = 0.2 and 0.6 with slopes 0.4 and 1.2, carried to slopes between."""
    places = np.linspace(0.0, 0.8, 17), np.array([0.3, 0.4, 0.5])
    value = (places[0] ** 2)[:, None, None] * np.ones((17, 3, 4))
    nodes = np.array([0.2, 0.6]), np.array([0.3, 0.5])
    bars = np.array([[0.02, 0.02], [0.05, 0.05]])
    steep = 2 * places[0] + 2 / 0.8
    shift = max(0.02 / (0.4 + 2.5), 0.05 / (1.2 + 2.5))
    got = solving._carried(nodes, bars, places, value)
    assert got[1:-1] == pytest.approx((shift * steep)[1:-1, None] * np.ones(3), rel=1e-9)  # ends: one-sided slopes


def test_the_rival_has_fewer_lines_and_keeps_both_ends():
    assert between._fewer(10).tolist() == [0, 1, 3, 4, 5, 7, 8, 9]
    assert between._fewer(7).tolist() == [0, 1, 3, 4, 5, 6]  # the last one stays
    assert between._fewer(3).tolist() == [0, 1, 2]


def test_half_a_distance_of_nodes_in_places():
    assert between._half_gap(np.array([0.0, 0.1, 0.4]), np.linspace(0, 0.4, 11)) == 3  # 0.2 / 2 / 0.04: 2.5, up
    assert between._half_gap(np.array([0.4, 0.1, 0.0]) * -1, np.linspace(0, -0.4, 21)) == 5
    assert between._half_gap(np.array([0.0, 0.4]), np.array([0.2])) == 0


def test_the_doubt_is_the_larger_disagreement_around_a_place(monkeypatch):
    """Interpolations made by hand on unlike axes: along y first apart in one place, the rival in another."""
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
        assert all(np.array_equal(one, other) for one, other in zip(got, arrays, strict=False))
        assert got[5] == 0.4
    assert made.value[1, 15] == pytest.approx([0.51 + 0.1j, 0.5 + 0.06j])
    assert made.value[0, 0] == pytest.approx([0.5 + 0.1j] * 2)
    doubt = np.full((9, 19), 0.02)  # a twentieth of the tolerance
    # half of a node's distance: 0.125 of 0.125 along x, one place; 1/6 of 1/9 along y, two
    doubt[0:3, 13:18] = 0.1
    doubt[6:9, 1:6] = 0.07
    assert made.doubt == pytest.approx(doubt, abs=1e-12)


def test_lines_are_fitted_along_x_and_their_values_along_y(monkeypatch):
    """A tenth of the tolerance each; every line of nodes on its own, all elements of the matrix together."""
    asked = []

    def fit(nodes, values, *, tolerance):
        asked.append((nodes, values, tolerance))
        slope = (values[-1] - values[0]) / (nodes[-1] - nodes[0])
        return lambda at: values[0] + (np.asarray(at) - nodes[0])[:, None] * slope

    monkeypatch.setattr(between.rational, "fit", fit)
    x, y, at_x, at_y = np.array([0.0, 1.0, 3.0]), np.array([1.0, 2.0]), np.array([0.5, 2.0]), np.array([1.0, 1.5, 1.75])
    values = np.stack([x[:, None] * y, x[:, None] - 2 * y], axis=-1)
    got = between._both(x, y, values, at_x, at_y, 0.3)
    assert got == pytest.approx(np.stack([at_x[:, None] * at_y, at_x[:, None] - 2 * at_y], axis=-1))
    assert [one[2] for one in asked] == pytest.approx([0.03] * 4)
    assert [len(one[0]) for one in asked] == [3, 3, 2, 2]


def test_a_grid_of_nodes_is_solved_pair_by_pair(monkeypatch):
    """Of pairs that may be exchanged the larger size first; x and y change places in the matrix of the other."""
    asked = []
    monkeypatch.setattr(solving, "sized", lambda cell, x, y: (x, y))
    monkeypatch.setattr(
        solving.workers, "jones_task", lambda cell, x, wave, *, tolerance, reach: (*cell, wave, tolerance, reach)
    )

    def run(tasks, console, label):
        asked.extend(tasks)
        for a, b, *_ in tasks:
            yield {"t": [[a, 0], [0, b], [a * b, 1], [2, a + b]], "error": [a, 3 * b]}

    settings = swept((0.1, 0.4), (0.2, 0.3), 31)
    for swaps in (False, True):
        asked.clear()
        monkeypatch.setattr(solving, "swaps", lambda cell, sweep, swaps=swaps: swaps)
        nodes = solving._Nodes("cell", settings, 0.7, 6, SimpleNamespace(run=run))
        t, bars = nodes.grid(np.array([0.2, 0.3]), np.array([0.2, 0.3, 0.4]), None, "")
        assert (t.shape, bars.shape) == ((2, 3, 4), (2, 3))
        assert t[1, 2 if not swaps else 0] == pytest.approx(
            [0.3, 0.4j, 0.12 + 1j, 2 + 0.7j] if not swaps else [0.3, 0.2j, 0.06 + 1j, 2 + 0.5j]
        )
        if swaps:
            assert asked == [(0.2, 0.2, 0.7, 0.1, 6), (0.3, 0.2, 0.7, 0.1, 6), (0.4, 0.2, 0.7, 0.1, 6),
                             (0.3, 0.3, 0.7, 0.1, 6), (0.4, 0.3, 0.7, 0.1, 6)]  # fmt: skip
            assert t[0, 2] == pytest.approx([2 + 0.6j, 0.08 + 1j, 0.2j, 0.4])  # both axes turned round
        assert bars[0, 2] == pytest.approx(1.2 if not swaps else 0.6)
        assert nodes.solves == (6 if not swaps else 5)


def test_the_truncation_is_the_least_that_meets_its_share_at_four_probes(monkeypatch):
    from metalens import rcwa

    asked = []

    def jones(cell, size, wavelength, *, tolerance, harmonics):
        asked.append((cell, size, wavelength, tolerance, harmonics))
        return SimpleNamespace(converged=harmonics >= 7)

    monkeypatch.setattr(solving, "sized", lambda cell, x, y: (x, y))
    monkeypatch.setattr(rcwa, "jones", jones)
    settings = swept((0.1, 0.4), (0.2, 0.3), 31)
    settings.wavelengths_um = (0.7, 0.8)
    for most, want in ((12, 7), (6, 6), (4, 4)):
        monkeypatch.setattr(rcwa, "most_harmonics", lambda cell, size, most=most: most)
        asked.clear()
        assert solving._reach("cell", settings) == want
    monkeypatch.setattr(rcwa, "most_harmonics", lambda cell, size: 12)
    asked.clear()
    solving._reach("cell", settings)
    last = [one for one in asked if one[4] == 7]
    places = [(0.1 + 0.3 * a, 0.2 + 0.1 * b) for a, b in ((0.31, 0.74), (0.66, 0.36), (0.87, 0.93), (0.52, 0.11))]
    assert [one[0] for one in last] == [pytest.approx(p) for p in places for _ in (0, 1)]
    assert [one[1] for one in last] == pytest.approx([p[0] for p in places for _ in (0, 1)])
    assert [one[2] for one in last] == [0.7, 0.8] * 4
    assert [one[3] for one in last] == pytest.approx([0.06] * 8)
    assert asked[0][4] == 5


@pytest.mark.parametrize(("ratio", "wide"), [(0.8, 1.6), (0.1, 0.5)])
def test_a_bar_is_the_doubt_widened_by_what_every_other_pair_shows_and_the_solver_s(monkeypatch, ratio, wide):
    """Twice the largest error to doubt of the pairs 0, 2, 4, …, at least a half; never above 2."""
    places = np.linspace(0.1, 0.4, 31), np.linspace(0.2, 0.3, 17)
    doubt = np.linspace(0.01, 2.0, 31 * 17).reshape(31, 17)
    held = np.tile([0.15, 0.25, 0.0, 0.02], (24, 1))
    held[6, 2], held[7, 2] = 0.02 * ratio, 99.0  # the second half is left to judge
    for name, answer in {
        "check": lambda *_: None,
        "Journal": lambda *_: SimpleNamespace(finish=lambda: None),
        "entries": lambda _: places,
        "_reach": lambda *_: 6,
        "_Nodes": lambda *_: SimpleNamespace(grid=lambda *_: (None, None), solves=5),
        "_lines": lambda *_: (None, None),
        "surface": lambda *_, **__: SimpleNamespace(value=np.ones((31, 17, 4)), doubt=doubt),
        "_held_out": lambda *_: held.copy(),
        "_carried": lambda *_: 0.3 * doubt,
        "AxesLibrary": lambda *given: given,
    }.items():
        monkeypatch.setattr(solving, name, answer)
    settings = swept((0.1, 0.4), (0.2, 0.3), 31)
    settings.wavelengths_um = (0.7, 0.8)
    monkeypatch.setattr(solving.config, "dumps", lambda _: "")
    _, _, wavelengths, x, y, t, error, found, solves, reach, _ = solving.sweep(None, settings)
    want = np.minimum((wide + 0.3) * doubt, 2.0)
    assert (want.max() == 2.0) == (wide > 1)
    assert error == pytest.approx(np.stack([want, want]))
    assert (t.shape, solves, reach, x is places[0], y is places[1]) == ((2, 31, 17, 2, 2), 10, 6, True, True)
    assert wavelengths.tolist() == [0.7, 0.8]
    row, column = solving._spread(places)
    for index in (0, 1):
        mine = found[24 * index : 24 * (index + 1)]
        assert (mine[:, 0] == index).all()
        assert mine[:, 3] == pytest.approx(held[:, 2])
        assert mine[:, 4] == pytest.approx(want[row, column])
