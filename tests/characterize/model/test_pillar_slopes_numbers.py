"""Slopes of pillars from given functions of the diameter: polynomials, ends, degrees,
and what is kept of them.
"""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.model import pillar_slopes
from metalens.cell import Cell, Film, Index
from metalens.lens import DiameterMap, Lens
from metalens.made import (
    Answers,
    PairSensitivities,
    Sensitivity,
    Solved,
    named,
    of_kind,
)
from metalens.pillars import Proxy

NAMES = list(named(Answers))
RNG = np.random.default_rng(7)
CELL = Cell(0.4, 0.6, Index(2.2), Index(1.45))


def lens(diameters=((0.0, 0.14), (0.2, 0.11)), cell=CELL):
    proxy = Proxy(
        np.array([[1.3, 2.9]]),
        np.array([[0.9, 0.0]]),
        (0.08, 0.24),
        (0.83, 0.83),
        0.0,
        0.0,
    )
    return Lens(
        DiameterMap(np.array(diameters), 0.4), cell, proxy, 0.83, 90.0, np.inf, "map"
    )


def slope(k, d):
    """Of the k-th cause: a cubic of the diameter."""
    return (0.3 + 0.2j * k) + (4.0 - k) * d - 20j * d**2 + 70.0 * d**3


@pytest.fixture
def given(monkeypatch):
    """In place of a solver: cubics, and what was asked of them."""
    asked = []

    def exact(cell, diameter_um, wavelength_um, wanted, table):
        asked.append((cell, diameter_um, wavelength_um, wanted, table))
        return [complex(slope(k, diameter_um)) for k in range(len(NAMES))]

    monkeypatch.setattr(pillar_slopes, "_exact", exact)
    monkeypatch.setattr(pillar_slopes.solving, "solved", lambda lens: None)
    return asked


def test_polynomials_are_those_of_the_slopes_over_the_lens_and_tangents_beyond(given):
    """25 Chebyshev diameters from 0.11 to 0.2 um."""
    found = pillar_slopes._solve(lens(), 1e-6, {"sidewall_deg"})
    assert [one[1] for one in given] == pytest.approx(
        0.155 + 0.045 * np.cos(np.pi * (np.arange(25) + 0.5) / 25)
    )
    assert all(
        (one[0], one[2], one[3], one[4]) == (CELL, 0.83, {"sidewall_deg"}, None)
        for one in given
    )
    assert (found.low_um, found.high_um, found.center_um) == pytest.approx(
        (0.11, 0.2, 0.155)
    )
    assert found.coefficients.shape == (len(NAMES), 4)
    assert found.error < 1e-10
    at = np.array([0.11, 0.137, 0.2])
    values = found.at(at)
    for k in range(len(NAMES)):
        assert values[k] == pytest.approx(slope(k, at), rel=1e-9)
    assert found.coefficients[1, 0] == pytest.approx(slope(1, 0.155), rel=1e-9)


def test_pillars_of_one_size_are_looked_at_a_nanometre_to_either_side(given):
    found = pillar_slopes._solve(lens(((0.0, 0.14), (0.14, 0.14))), 1e-6, ())
    assert (found.low_um, found.high_um) == pytest.approx((0.139, 0.141))
    assert found.at(np.array(0.14))[0] == pytest.approx(slope(0, 0.14), rel=1e-9)


def test_the_least_degree_that_meets_the_tolerance_on_every_third_node_is_taken():
    """A square root of the distance to a place beside the nodes: errors fall by about 2
    a degree.
    """
    unit = np.cos(np.pi * (np.arange(25) + 0.5) / 25)
    rows = np.stack([np.sqrt(1.25 + unit), 0.1 * unit])
    judged = np.array([k % 3 == 1 for k in range(25)])
    size = np.abs(rows[0] - rows[0].mean()).max()
    errors = []
    for degree in range(1, 15):
        fit = np.polynomial.Polynomial.fit(unit[~judged], rows[0][~judged], degree)
        errors.append(np.abs(fit(unit[judged]) - rows[0][judged]).max() / size)
    for tolerance in (0.05, 1e-3):
        want = next(k for k, error in enumerate(errors) if error <= tolerance)
        assert pillar_slopes._degree(unit, rows, tolerance) == (
            want + 1,
            pytest.approx(errors[want], rel=1e-6),
        )
    best = int(np.argmin(errors))
    assert pillar_slopes._degree(unit, rows, 1e-12) == (
        best + 1,
        pytest.approx(errors[best], rel=1e-6),
    )


def test_a_row_that_hardly_changes_is_judged_by_a_billionth_of_the_largest():
    unit = np.cos(np.pi * (np.arange(25) + 0.5) / 25)
    rows = np.stack(
        [5.0 + 1e-12 * unit**2, 40.0 * unit]
    )  # 1e-12 / 2 of 4e-8 at degree 1
    degree, error = pillar_slopes._degree(unit, rows, 1e-3)
    assert degree == 1
    assert error < 1e-4


def test_a_solved_table_tells_the_slope_by_its_first_two_powers():
    """Those of causes that no solver knows in closed form are 0."""
    series = RNG.normal(size=(len(NAMES), 2)) + 1j * RNG.normal(size=(len(NAMES), 2))
    found = pillar_slopes._exact(
        CELL, 0.14, 0.83, (), SimpleNamespace(series=lambda d: series)
    )
    exact = [bool(row.acts.exact) for _, row in of_kind(Answers)]
    assert any(exact)
    assert not all(exact)
    assert found == pytest.approx(np.where(exact, series[:, 1] / series[:, 0], 0.0))
    unknown = [row.name for _, row in of_kind(Answers) if not row.acts.exact]
    assert [row.name for row in pillar_slopes._unknown()] == unknown


def test_without_a_table_slopes_are_the_solver_s_derivatives_over_t(monkeypatch):
    known = {
        row.acts.exact: 0.3 + 1j * k
        for k, (_, row) in enumerate(of_kind(Answers))
        if row.acts.exact
    }
    for solver, cell in (
        ("modal.gradient", CELL),
        ("rcwa.derivatives", dataclasses.replace(CELL, sidewall_rad=0.02)),
    ):
        module, name = solver.split(".")
        made = SimpleNamespace(t=0.7 - 0.4j, **known)
        monkeypatch.setattr(
            getattr(pillar_slopes, module), name, lambda *_, made=made, **__: made
        )
        found = pillar_slopes._exact(cell, 0.14, 0.83, (), None)
        want = [
            known[row.acts.exact] / (0.7 - 0.4j) if row.acts.exact else 0.0
            for _, row in of_kind(Answers)
        ]
        assert found == pytest.approx(want)


def test_what_no_solver_knows_is_a_difference_over_a_degree_where_it_is_wanted(
    monkeypatch,
):
    """Of ln t = (0.2 - 0.9i) lean + 0.4 lean³ in degrees, half of one to either side:
    of the cube a quarter.
    """

    def solved(cell, diameter_um, wavelength_um):
        lean = np.degrees(cell.sidewall_rad)
        known = {row.acts.exact: 0.0 for _, row in of_kind(Answers) if row.acts.exact}
        return SimpleNamespace(
            t=1.7j * np.exp((0.2 - 0.9j) * lean + 0.4 * lean**3), **known
        )

    monkeypatch.setattr(pillar_slopes.rcwa, "derivatives", solved)
    monkeypatch.setattr(pillar_slopes.modal, "gradient", lambda *_, **__: solved(*_))
    found = pillar_slopes._exact(CELL, 0.14, 0.83, {"sidewall_deg"}, None)
    place = NAMES.index("sidewall_deg")
    assert found[place] == pytest.approx((0.2 + 0.4 / 4 - 0.9j) * 180 / np.pi, rel=1e-9)
    assert not any(value for k, value in enumerate(found) if k != place)


def test_round_upright_pillars_without_films_have_their_own_solver():
    assert pillar_slopes._upright(CELL)
    for more in (
        {"sidewall_rad": 0.01},
        {"under": (Film(Index(1.9), 0.1),)},
        {"over": (Film(Index(1.9), 0.1),)},
    ):
        assert not pillar_slopes._upright(dataclasses.replace(CELL, **more))


@pytest.mark.parametrize("kind", ["plain", "solved", "edges", "pairs"])
def test_what_is_kept_is_what_was_found(kind):
    rows = RNG.normal(size=(4, 3)) + 1j * RNG.normal(size=(4, 3))
    made = Sensitivity(rows, 0.15, 0.013, 0.11, 0.2)
    if kind == "solved":
        table = Solved(
            0.83, np.array([0.1, 0.15, 0.21]), RNG.normal(size=(4, 5, 3)) + 0j
        )
        made = dataclasses.replace(made, solved=table)
    elif kind == "edges":
        made = dataclasses.replace(made, edges=rows[:1] * 2)
    elif kind == "pairs":
        pairs = PairSensitivities(
            np.array([0.1, 0.2]), np.array([0.15, 0.12]), rows[:, :2], 0.021
        )
        made = Sensitivity.of_pairs(pairs)
    back = pillar_slopes._unpacked(pillar_slopes._packed(made))
    assert back.error == made.error
    if kind == "pairs":
        for name in ("width_um", "length_um", "rates"):
            assert np.array_equal(getattr(back.pairs, name), getattr(made.pairs, name))
        assert back.pairs.error == 0.021
        return
    assert (back.center_um, back.low_um, back.high_um) == (0.15, 0.11, 0.2)
    assert np.array_equal(back.coefficients, rows)
    assert (back.edges is None) is (kind != "edges")
    assert back.edges is None or np.array_equal(back.edges, made.edges)
    assert (back.solved is None) is (kind != "solved")
    if back.solved is not None:
        assert back.solved.wavelength_um == 0.83
        assert np.array_equal(back.solved.diameter_um, [0.1, 0.15, 0.21])
        assert np.array_equal(back.solved.powers, made.solved.powers)


def test_what_was_solved_once_serves_the_same_pillars_alone():
    """Another place of the same pillars is the same; another size at either end,
    material, tolerance or wish is not.
    """
    about = pillar_slopes._about(lens(), 0.02, ["a"])
    assert pillar_slopes._about(lens(((0.11, 0.0), (0.14, 0.2))), 0.02, ["a"]) == about
    others = [
        pillar_slopes._about(lens(((0.0, 0.14), (0.21, 0.11))), 0.02, ["a"]),
        pillar_slopes._about(lens(((0.0, 0.14), (0.2, 0.10))), 0.02, ["a"]),
        pillar_slopes._about(
            lens(cell=dataclasses.replace(CELL, cover=Index(1.1))), 0.02, ["a"]
        ),
        pillar_slopes._about(lens(), 0.01, ["a"]),
        pillar_slopes._about(lens(), 0.02, []),
    ]
    assert len({about, *others}) == 6
