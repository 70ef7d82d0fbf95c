"""Bloch waves on the quarter cell: real matrices against complex fields, and which
functions carry the unknowns.
"""

import numpy as np
import pytest

from metalens.modal import spaces
from metalens.modal.assembly import assemble, integrate
from metalens.modal.mesh import X0, X1, Y0, Y1, MeshPlan
from metalens.modal.spaces import Selection

HALF = 0.7
ROWS = Selection(np.array([5, 2, 0, 7, 1, 4, 3]), 3, 1, 3, np.cos(HALF), np.sin(HALF))
COLUMNS = Selection(np.array([3, 6, 1, 0, 5]), 2, 2, 1, np.cos(HALF), np.sin(HALF))
STILL = Selection(np.array([4, 0, 6]), 3, 0, 0, 0.0, 1.0)


def fields(one, phase):
    """(functions, unknowns) complex values: real and imaginary part inside, real at x =
    0, exp(i phase) at the end.
    """
    out = np.zeros((len(one.order), one.size), complex)
    first, c = one.inside + one.start, one.inside
    out[:first, :first] = np.eye(first)
    out[:c, first : first + c] = 1j * np.eye(c)
    out[first:, first + c :] = np.exp(1j * phase) * np.eye(one.end)
    return out


def test_restricted_matrices_are_those_of_the_complex_fields():
    matrix = np.random.default_rng(3).normal(size=(8, 7))
    picked = matrix[np.ix_(ROWS.order, COLUMNS.order)]
    want = (fields(ROWS, HALF).conj().T @ picked @ fields(COLUMNS, HALF)).real
    assert ROWS.size == 10
    assert COLUMNS.size == 7
    assert spaces.restrict(matrix, ROWS, COLUMNS) == pytest.approx(want, abs=1e-14)
    step = 1e-5
    ends = [
        (fields(ROWS, HALF + d).conj().T @ picked @ fields(COLUMNS, HALF + d)).real
        for d in (step, -step)
    ]
    rate = spaces.restrict(matrix, ROWS, COLUMNS, rate=True)
    assert rate == pytest.approx(
        (ends[0] - ends[1]) / (2 * step), abs=1e-9
    )  # third derivative: 1e-11


def test_without_a_phase_the_functions_inside_are_the_unknowns():
    matrix = np.arange(56.0).reshape(8, 7)
    assert STILL.size == 3
    assert not STILL.periodic
    assert ROWS.periodic
    assert (
        spaces.restrict(matrix, STILL, STILL).tolist()
        == matrix[np.ix_([4, 0, 6], [4, 0, 6])].tolist()
    )
    assert (
        spaces.restrict(matrix, STILL, STILL, rate=True).tolist()
        == np.zeros((3, 3)).tolist()
    )


def test_unknowns_take_their_functions_in_order():
    values = 10 * np.arange(8)
    assert ROWS.unknowns(values).tolist() == [50, 20, 0, 70, 50, 20, 0, 10, 40, 30]
    assert STILL.unknowns(values).tolist() == [40, 0, 60]


WALL = np.array([0, X0, X1, Y0, Y1, X0 | Y0, X1 | Y1, 0, X1, X0])


@pytest.mark.parametrize(
    ("electric", "half", "inside", "start", "end"),
    [
        (True, None, [0, 7], [], []),
        (False, None, [0, 3, 4, 7], [], []),
        (True, HALF, [0, 7], [1, 9], [2, 8]),
        (False, HALF, [0, 3, 4, 7], [1, 5, 9], [2, 6, 8]),
    ],
)
def test_walls_decide_who_is_free(electric, half, inside, start, end):
    found = spaces.select(WALL, electric=electric, half_phase_rad=half)
    assert found.order.tolist() == [*inside, *start, *end]
    assert (found.inside, found.start, found.end) == (len(inside), len(start), len(end))
    assert (found.real, found.imaginary) == (
        (0.0, 1.0) if half is None else pytest.approx((np.cos(HALF), np.sin(HALF)))
    )


PLAN = MeshPlan(2, 2, 2)


@pytest.mark.parametrize(
    ("electric", "half"), [(True, None), (False, 0.4), (True, 1.3)]
)
def test_a_space_holds_the_restricted_matrices_and_a_basis(electric, half):
    geometry = assemble(0.57, PLAN)
    made = spaces.space(geometry, electric=electric, half_phase_rad=half)
    known = spaces.topology(PLAN, electric, half)
    for part, whole in ((made.cell, geometry.cell), (made.disc, geometry.disc)):
        assert np.array_equal(
            part.mass, spaces.restrict(whole.mass, known.vectors, known.vectors)
        )
        assert np.array_equal(
            part.curl, spaces.restrict(whole.curl, known.vectors, known.vectors)
        )
        assert np.array_equal(
            part.scalar, spaces.restrict(whole.scalar, known.scalars, known.scalars)
        )
    assert np.array_equal(
        made.gradient, spaces.restrict(geometry.gradient, known.vectors, known.scalars)
    )
    assert np.array_equal(made.transposed.toarray(), made.gradient.T)
    assert np.array_equal(
        made.within_transposed.toarray(), made.gradient.T[made.within]
    )
    assert (made.electric, made.half_phase_rad) == (electric, half)
    beyond = np.setdiff1d(np.arange(known.scalars.size), made.within)
    assert len(beyond) > 0
    assert not made.disc.scalar[beyond].any()  # those that do not reach into the disc
    inside = np.flatnonzero(made.disc.scalar.diagonal())
    assert np.isin(inside, made.within).all()
    # with all gradients the functions off the tree make a basis
    assert len(made.cotree) == known.vectors.size - known.scalars.size
    assert (np.diff(made.cotree) > 0).all()
    both = np.hstack([np.eye(known.vectors.size)[:, made.cotree], made.gradient])
    size = np.sqrt(np.diag(made.cell.mass))[:, None]
    apart = np.linalg.svd(
        size * both / np.linalg.norm(size * both, axis=0), compute_uv=False
    )
    assert apart[-1] > 1e-3 * apart[0]  # well conditioned: 1e-2 here


def test_phases_in_steps_of_a_quarter_share_a_cotree(monkeypatch):
    asked = []
    monkeypatch.setattr(
        spaces, "cotree", lambda plan, electric, phase: asked.append(phase)
    )
    geometry = assemble(0.57, PLAN)
    for half in (0.0, 0.24, 0.26, 1.3, None):
        spaces.space(geometry, electric=True, half_phase_rad=half)
    assert asked == [0.125, 0.125, 0.375, 1.375, None]


@pytest.mark.parametrize(("electric", "half"), [(True, None), (False, 0.4)])
def test_rates_of_a_space_are_differences(electric, half):
    geometry, step = assemble(0.57, PLAN), 1e-5
    by_radius, by_phase = spaces.space_rates(
        geometry, electric=electric, half_phase_rad=half
    )

    def matrices(one):
        return [
            one.cell.mass,
            one.cell.curl,
            one.cell.scalar,
            one.disc.mass,
            one.disc.curl,
            one.disc.scalar,
            one.gradient,
        ]

    def at(rho, phase):
        return matrices(
            spaces.space(assemble(rho, PLAN), electric=electric, half_phase_rad=phase)
        )

    here = at(0.57, half)
    moved = [at(0.57 + d, half) for d in (step, -step)]
    turned = [at(0.57, None if half is None else half + d) for d in (step, -step)]
    for rates, (high, low) in ((by_radius, moved), (by_phase, turned)):
        for got, a, b, size in zip(matrices(rates), high, low, here, strict=True):
            assert (
                np.abs(got - (a - b) / (2 * step)).max() < 1e-7 * np.abs(size).max()
            )  # third derivatives, rounding
        assert (rates.electric, rates.half_phase_rad) == (electric, half)
        assert rates.cotree.size == 0
    cell, _ = integrate(geometry.mesh, 0.57, rate=True)
    assert by_radius.cell.mass.shape[0] <= 2 * len(cell.mass)
