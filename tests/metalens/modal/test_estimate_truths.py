"""What both forms say of one another, from forms that are typed in; half-spaces and
cutoffs in closed form.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.cell.light import Incidence
from metalens.cell.record import Cell, Index
from metalens.modal import engine, match
from metalens.modal.case import case_of
from metalens.modal.ladder import RUNGS

RNG = np.random.default_rng(77)
LAYER = {"disc": 9.0 + 0.2j, "around": 1.44, "below": 2.2, "above": 1.21}
CASE = SimpleNamespace(k0=1.7, bloch=0.31, rho=0.42, size=1.6, strange=2.5, **LAYER)


def matrix(scale=1.0):
    return scale * (RNG.normal(size=(2, 2)) + 1j * RNG.normal(size=(2, 2)))


def test_modes_belong_together_by_their_wavenumbers_and_not_by_their_order():
    """The nearest pair first; one that is left over belongs to none."""
    q = np.array([4.9 + 0.01j, 2.2 + 0.03j, 1.1])
    other = np.array([2.2 + 0.05j, 4.93 + 0.01j])
    assert engine.nearest_pairs(q, other).tolist() == [[1, 0], [0, 1]]


@pytest.mark.parametrize("hole", [False, True])
def test_halves_of_the_difference_are_told_by_wavenumber_and_the_rest_so_that_neither_hides_the_other(
    hole,
):
    """Both forms of an absorbing cell on a coarse mesh: what the wavenumbers of pairs
    explain, element by element of
    absolute sizes, and what is left; drift by how far each wavenumber squared lies
    below the densest medium's."""
    inside, around = Index(3.3, 0.02), Index(1.2)
    inside, around = (around, inside) if hole else (inside, around)
    case = case_of(
        Cell(0.4, 0.5, inside, Index(1.45), Index(1.1), around),
        0.21,
        Incidence(0.85, 0.2, "p"),
    )
    assert bool(case.strange) is hole
    plan, weak = RUNGS[0].choice(case.rho).plan, RUNGS[0].weak
    first, second = (
        engine.solve_form(case, plan, magnetic=magnetic, weak=weak)
        for magnetic in (False, True)
    )
    found = engine.solve_on_mesh(case, plan, weak=weak)
    pairs, left = [], set(range(len(second.q)))
    for k in range(len(first.q)):  # no two lie near each other here
        near = min(left, key=lambda n, k=k: abs(first.q[k] - second.q[n]), default=None)
        if near is not None:
            left.discard(near)
            pairs.append((k, near))
    assert len(pairs) >= 2
    explained = [first.by_q[k] * (first.q[k] - second.q[n]) for k, n in pairs]
    assert found.waves == pytest.approx(
        sum(np.abs(part) for part in explained).max() / 2, rel=1e-9
    )
    assert found.rim == pytest.approx(
        np.abs(first.matrix - second.matrix - sum(explained)).max() / 2, rel=1e-6
    )
    assert found.spread == pytest.approx(found.waves + found.rim, rel=1e-12)
    dense = case.k0**2 * (3.3 + 0.02j) ** 2
    drift = sum(
        np.abs(by) * abs(dense - q**2) / (2 * abs(q))
        for by, q in zip(first.by_q, first.q, strict=True)
    )
    assert found.drift == pytest.approx(drift.max(), rel=1e-9)
    assert found.energy == pytest.approx((first.energy + second.energy) / 2)
    assert found.unknowns == first.unknowns + second.unknowns
    assert (found.bloch, found.strange) == (case.bloch, case.strange)
    assert found.grazing == max(first.grazing, second.grazing)
    assert found.damping == min(first.damping, second.damping)
    assert (first.damping != second.damping) is hole
    assert found.beside == max(
        match.cutoff_proximity(case.k0**2 * n**2, case.bloch) for n in (1.45, 1.1)
    )
    assert found.size == pytest.approx(case.k0 * abs(3.3 + 0.02j) / math.pi, rel=1e-12)
    mean = (first.matrix + second.matrix) / 2
    assert (
        np.abs(found.matrix - mean).max()
        < 0.05 * np.abs(first.matrix - second.matrix).max()
    )  # second order


def test_the_mean_of_matrices_with_one_basis_is_of_the_roots_of_their_products():
    turn = np.linalg.qr(matrix())[0]
    a, b = np.array([0.8 + 0.3j, 0.6 - 0.4j]), np.array([0.75 + 0.35j, 0.62 - 0.5j])
    got = engine.geometric_mean((turn * a) @ turn.conj().T, (turn * b) @ turn.conj().T)
    assert got == pytest.approx((turn * (a * np.sqrt(b / a))) @ turn.conj().T, rel=1e-9)
    black = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-5]])
    assert engine.geometric_mean(black, 3 * black) == pytest.approx(2 * black)
    assert engine.determinant_2x2(np.array([[2.0, 3j], [1.5, -1.0]])) == pytest.approx(
        -2 - 4.5j
    )


def test_the_ladder_is_climbed_until_an_estimate_meets_the_tolerance_or_the_least_is_kept(
    monkeypatch,
):
    errors = {"a": 0.4, "b": 0.02, "c": 0.05}

    def rung(name):
        choice = SimpleNamespace(plan=name)
        return SimpleNamespace(
            name=name,
            choice=lambda rho: choice,
            weak=1e-9,
            error=lambda solution, rho, before: errors[solution],
        )

    monkeypatch.setattr(engine, "RUNGS", tuple(rung(name) for name in errors))
    monkeypatch.setattr(
        engine,
        "first_rung",
        lambda tolerance, rho, size: 0 if (rho, size) == (0.42, 1.6) else 2,
    )
    monkeypatch.setattr(engine, "solve_on_mesh", lambda case, plan, *, weak: plan)
    usual = SimpleNamespace(**{**vars(CASE), "strange": 0.0})
    met = engine.refine_mesh(usual, 0.02)
    assert (met.solution, met.error, met.converged) == ("b", 0.02, True)
    missed = engine.refine_mesh(usual, 0.01)
    assert (missed.solution, missed.error, missed.converged) == ("b", 0.02, False)
    assert engine.refine_mesh(usual, 0.5).solution == "a"


def test_cells_unlike_those_of_lenses_begin_two_meshes_before_and_are_judged_by_all_that_were_solved(
    monkeypatch,
):
    """Two meshes alone say nothing of such a cell, whatever the tolerance; rungs "d"
    and "e" have one mesh.
    """
    bars = {"a": 9.0, "b": 9.0, "c": 0.02, "d": 2e-3, "e": 0.0, "f": 1e-3}
    asked = []

    def rung(name):
        choice = SimpleNamespace(plan="d" if name == "e" else name)

        def error(one, rho, before):
            asked.append((name, "".join(before)))
            return bars[name]

        return SimpleNamespace(
            name=name, choice=lambda rho: choice, weak=0.0, error=error
        )

    monkeypatch.setattr(engine, "RUNGS", tuple(rung(name) for name in bars))
    monkeypatch.setattr(
        engine, "first_rung", lambda tolerance, rho: 1 if tolerance > 3e-3 else 3
    )
    monkeypatch.setattr(engine, "solve_on_mesh", lambda case, plan, *, weak: plan)
    hole = SimpleNamespace(**{**vars(CASE), "strange": 1.0})
    for tolerance, name, judged in (
        (2.0, "c", [("c", "ab")]),
        (3.5e-3, "d", [("c", "ab"), ("d", "abc")]),
        (2.5e-3, "d", [("d", "bc")]),
        (1e-4, "f", [("d", "bc"), ("f", "bcd")]),
    ):
        asked.clear()
        found = engine.refine_mesh(hole, tolerance)
        assert (found.solution, found.error, found.converged) == (
            name,
            bars[name],
            tolerance > bars[name],
        )
        assert asked == judged
    bars["c"] = 1.4
    monkeypatch.setattr(engine, "RUNGS", tuple(rung(name) for name in "abc"))
    found = engine.refine_mesh(
        hole, 3.5e-3
    )  # of what two meshes say an amplitude of 1 is unknown
    assert (found.error, found.converged) == (1.0, False)


def test_half_spaces_admit_modes_as_plane_waves_of_their_own_kind():
    """i kz and i k0² eps / kz of the electric form, i kz / eps and i k0² / kz of the
    magnetic one.
    """
    te, tm = np.array([0.3, 9.0]), np.array([1.1, 5.0, 2.25 * 1.7**2])
    basis = SimpleNamespace(te=te, te_exact=te, tm_exact=tm)
    k0, eps = 1.7, 2.25

    def kz(square):
        value = k0**2 * eps - square
        return (
            math.sqrt(value)
            if value > 0
            else 1j * math.sqrt(-value)
            if value < 0
            else 1e-8 * k0
        )

    for magnetic, first, second in ((False, 1.0, eps), (True, 1 / eps, 1.0)):
        want = [1j * kz(s) * first for s in te] + [
            1j * k0**2 * second / kz(s) for s in tm
        ]
        found = match.half_space(basis, k0, eps, magnetic=magnetic)
        assert found.admittance == pytest.approx(np.array(want), rel=1e-9)
        assert found.ports.tolist() == [
            0,
            2,
            3,
            4,
        ]  # the last at its cutoff, moved off it


def test_orders_near_their_cutoff_take_the_wavenumbers_of_the_lattice():
    """(0.4 - pi)² + pi² = 17.386 near a cutoff of 17: within two fifths of it, and 2 %
    of what the mesh has.
    """
    exact = (0.4 - math.pi) ** 2 + math.pi**2
    squares = np.array([1.01 * exact, 1.03 * exact, 0.4**2, 0.8 * exact, 0.995 * exact])
    got = match.near_cutoff(squares, 17.0, 0.4)
    assert got == pytest.approx([exact, 1.03 * exact, 0.16, 0.8 * exact, exact])
    assert match.near_cutoff(squares, 40.0, 0.4) is squares


@pytest.mark.parametrize(
    ("apart", "want"),
    [
        (0.0, 1.0),
        (-0.07, 1.0),
        (0.1, 1.0),
        (-0.16, 0.5),
        (0.25, 0.2),
        (0.4, 0.0),
        (0.6, 0.0),
    ],
)
def test_an_order_counts_as_at_its_cutoff_by_one_over_the_distance(apart, want):
    """The least order (pi - 1.1)², ``apart`` of the cutoff beyond it or short of it;
    the next is far.
    """
    cutoff = (math.pi - 1.1) ** 2 / (1 + apart)
    assert match.cutoff_proximity(cutoff, 1.1) == pytest.approx(want, abs=1e-9)


@pytest.mark.parametrize(
    ("cutoff", "bloch"), [(17.0, 0.4), (120.0, -1.3), (3.1, 1.5), (61.0, 0.0)]
)
def test_the_wavenumbers_of_the_lattice_are_all_up_to_twice_the_cutoff(cutoff, bloch):
    found = np.sort(match.lattice_wavenumbers(cutoff, bloch))
    every = [
        (bloch + math.pi * m) ** 2 + (math.pi * n) ** 2
        for m in range(-40, 41)
        for n in range(41)
    ]
    want = sorted(v for v in every if v <= 2 * cutoff)
    assert found[: len(want)] == pytest.approx(want, rel=1e-12)


def test_the_zero_order_keeps_the_wavenumber_of_the_mesh():
    """Its (k0 sin)² is what both sides share: it is no order that begins to propagate."""
    zero = 1.3**2
    assert match.near_cutoff(np.array([0.9999 * zero]), 1.05 * zero, 1.3).tolist() == [
        0.9999 * zero
    ]
    assert (
        match.cutoff_proximity(1.05 * zero, 1.3) == 0
    )  # the next, (pi - 1.3)², is 1.9 times as far
