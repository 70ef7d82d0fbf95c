"""Shares of a tolerance and rows of results, by stand-ins: half to the solver, 0.4 to
the fit, rows in their places.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from metalens import rcwa
from metalens.cell import Light, Response
from metalens.cell.record import Cell, Index
from metalens.pillars import engines, workers
from metalens.pillars.curve import Nodes

CELL = Cell(0.30, 0.7, Index(3.6))
LIGHTS = [Light(0.85, 0.2, "s"), Light(0.85, 0.2, "p")]


def of(number, diameter):
    """Unlike numbers in every column."""
    t, r = complex(0.7 + number, diameter), complex(-0.2 * diameter, 0.3 + number)
    return Response(
        t, r, 1e-3 * (number + diameter), 9, 0.9 + diameter, "rcwa", True, ""
    )


def test_half_of_a_tolerance_is_the_solver_s_and_two_fifths_the_fit_s(monkeypatch):
    asked, first, fits = [], [], []

    def smooth_all(cell, lights, span, *, tolerance, engine):
        asked.append((lights, span, tolerance, engine))
        return [lambda d, k=k: first.append((d, k)) or of(k, d) for k in range(2)]

    def explore(solve, low, high, *, tolerance, cheaper_um):
        fits.append((low, high, tolerance, cheaper_um.tolist()))
        at = np.array([low, 0.11, high][: 1 + len(fits)])
        return SimpleNamespace(
            diameter_um=at, converged=len(fits) == 1, reason=f"reason {len(fits)}"
        )

    monkeypatch.setattr(workers, "smooth_all", smooth_all)
    monkeypatch.setattr(workers, "reduced", SimpleNamespace(
        explore=explore, starts=lambda low, high: [low, high], curve=lambda nodes, *, tolerance: (nodes, tolerance)
    ))  # fmt: skip
    found = workers.work(
        workers.curves_task(CELL, LIGHTS, (0.07, 0.23), tolerance=6e-3, engine="rcwa")
    )
    assert asked == [(LIGHTS, (0.07, 0.23), pytest.approx(3e-3), "rcwa")]
    assert first[:4] == [(0.07, 0), (0.07, 1), (0.23, 0), (0.23, 1)]
    assert [fit[:3] for fit in fits] == [(0.07, 0.23, pytest.approx(2.4e-3))] * 2
    assert [fit[3] for fit in fits] == [[], [0.07, 0.11]]  # of the light before
    assert found["counts"] == [2, 3]
    made = workers.curves(found, tolerance=6e-3)
    assert [tolerance for _, tolerance in made] == [pytest.approx(2.4e-3)] * 2
    for k, (nodes, _) in enumerate(made):
        assert isinstance(nodes, Nodes)
        at = [0.07, 0.11, 0.23][: 2 + k]
        assert nodes.diameter_um.tolist() == at
        want = [of(k, d) for d in at]
        assert nodes.response.tolist() == [[one.t, one.r] for one in want]
        assert nodes.error.tolist() == [one.t_error for one in want]
        assert nodes.energy.tolist() == [one.energy for one in want]
        assert (nodes.converged, nodes.reason) == (k == 0, f"reason {k + 1}")


def test_elements_of_a_jones_matrix_are_rows_and_take_the_energy_of_what_comes(
    monkeypatch,
):
    """xx, xy, yx, yy: what leaves first, so the energies of x and y come in turn."""
    t = np.array([[0.9 + 0.1j, 0.02j], [0.03 + 0j, 0.8 - 0.2j]])
    found = SimpleNamespace(
        t=t, r=0.1 * t + 0.5, t_error=4e-4, orders=13, energy=np.array([0.98, 0.93])
    )
    asked = []
    monkeypatch.setattr(
        rcwa, "jones", lambda *args, **words: asked.append((*args, words)) or found
    )
    made = workers.work(workers.jones_task(CELL, 0.17, 0.91, tolerance=1e-3, reach=6))
    assert asked == [(CELL, 0.17, 0.91, {"harmonics": 6})]
    assert made["diameter_um"] == [0.17] * 4
    assert made["t"] == [[0.9, 0.1], [0.0, 0.02], [0.03, 0.0], [0.8, -0.2]]
    assert np.array(made["r"]) @ (1, 1j) == pytest.approx(
        (0.1 * t + 0.5).ravel(), rel=1e-15
    )
    assert made["energy"] == [0.98, 0.93, 0.98, 0.93]
    assert made["error"] == [4e-4] * 4


def meshes(asked, *errors):
    """Meshes with these errors, which may depend on the diameter; at 1e-2 they meet the
    tolerance.
    """

    def mesh(place, error):
        def at(diameter_um):
            asked.append((place, diameter_um))
            found = error(diameter_um) if callable(error) else error
            return SimpleNamespace(t_error=found, converged=found <= 1e-2)

        return at

    return [mesh(place, error) for place, error in enumerate(errors)]


@pytest.mark.parametrize(
    ("errors", "kept", "solved"),
    [
        ((0.009, 0.001), 0, 1),
        ((0.03, 0.01, 0.001), 1, 2),
        ((0.02, 0.05), 0, 2),
        (
            (0.03, 0.0121, 0.001),
            2,
            3,
        ),  # above 1.2 times the tolerance the third is worth its time
        ((0.03, 0.0119, 0.001), 1, 2),
        ((0.0119, 0.03, 0.001), 0, 2),
        ((0.03, 0.02, 0.025), 1, 3),
    ],
)
def test_a_diameter_takes_the_first_mesh_that_serves_and_else_the_best(
    errors, kept, solved
):
    asked = []
    place, found = engines._met(meshes(asked, *errors), 0.17, 1.2e-2)
    assert (place, found.t_error) == (kept, errors[kept])
    assert asked == [(k, 0.17) for k in range(solved)]


def test_between_two_diameters_that_need_a_finer_mesh_that_one_begins():
    """A resonance from 0.15 to 0.19; beside it, and where a neighbour did not fail, the
    coarse mesh is asked first.
    """
    asked = []
    at = engines._stepped(
        meshes(asked, lambda d: 0.05 if 0.15 < d < 0.19 else 0.002, 0.004), 1.2e-2
    )
    order = [0.1, 0.2, 0.16, 0.18, 0.17, 0.12, 0.165, 0.17]
    assert [at(d).t_error for d in order] == [
        0.002,
        0.002,
        0.004,
        0.004,
        0.004,
        0.002,
        0.004,
        0.004,
    ]
    want = [
        (0, 0.1),
        (0, 0.2),
        (0, 0.16),
        (1, 0.16),
        (0, 0.18),
        (1, 0.18),
        (1, 0.17),
        (0, 0.12),
        (1, 0.165),
    ]
    assert asked == want  # 0.17 is remembered


def test_a_line_of_a_journal_counts_where_its_columns_are_as_long_as_one_another():
    """And t and r have a real and an imaginary part; any other line is of a task that
    is done again.
    """
    whole = {
        "diameter_um": [0.1, 0.12, 0.17], "t": [[0.9, 0.1], [0.8, 0.2], [0.7, -0.1]], "r": [[0.1, 0.0]] * 3,
        "error": [1e-3, 2e-3, 3e-3], "energy": [1.0, 0.99, 0.98],
    }  # fmt: skip
    assert workers._entry(json.dumps(["a task", whole])) == ("a task", whole)
    for name, value in {
        "error": [1e-3, 2e-3], "energy": [1.0], "diameter_um": [0.1] * 4, "t": [[0.9, 0.1, 0.0]] * 3, "r": [[0.1, 0]],
    }.items():  # fmt: skip
        assert workers._entry(json.dumps(["a task", whole | {name: value}])) is None, (
            name
        )
    without = {name: value for name, value in whole.items() if name != "error"}
    for line in (
        json.dumps(["a task", without]),
        '["a task"',
        json.dumps(["a task", whole])[:-4],
        "7",
    ):
        assert workers._entry(line) is None
