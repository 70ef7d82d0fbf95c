"""Modes of the empty cell on a coarse mesh: orthonormal, diagonal, and the disc's
matrices in their coordinates.
"""

import numpy as np
import pytest
import scipy.linalg as sl

from metalens.modal import homogeneous
from metalens.modal.assembly import assemble_disc
from metalens.modal.mesh import MeshPlan
from metalens.modal.spaces import build_symmetry_class

PLAN = MeshPlan(1, 2, 1)
SPACES = [(False, None), (False, 0.4), (True, 1.3)]


@pytest.fixture(scope="module", params=SPACES)
def cell(request):
    electric, half = request.param
    return build_symmetry_class(
        assemble_disc(0.57, PLAN), electric=electric, half_phase_rad=half
    )


@pytest.fixture(scope="module", params=["plain", "careful", "quick"])
def made(cell, request):
    return homogeneous.homogeneous_modes(
        cell, careful=request.param == "careful", quick=request.param == "quick"
    )


TIGHT = 1e-7  # the quick way loses up to eight digits


def test_modes_are_orthonormal_and_make_the_curl_diagonal(cell, made):
    v, a = made.vector, len(made.te)
    assert made.size == len(v) == v.shape[1] == a + len(made.tm)
    assert v.T @ cell.cell.mass @ v == pytest.approx(np.eye(made.size), abs=TIGHT)
    want = np.diag(np.concatenate([made.te, np.zeros(len(made.tm))]))
    assert v.T @ cell.cell.curl @ v == pytest.approx(want, abs=TIGHT * made.te.max())
    assert (np.diff(made.te) > -1e-9).all()
    assert (np.diff(made.tm) > -1e-9).all()


def test_wavenumbers_are_those_of_the_dense_problems(cell, made):
    g = cell.gradient
    want = sl.eigh(g.T @ cell.cell.mass @ g, cell.cell.scalar, eigvals_only=True)
    assert made.tm == pytest.approx(want, rel=TIGHT, abs=TIGHT)
    every = sl.eigh(cell.cell.curl, cell.cell.mass, eigvals_only=True)
    assert np.concatenate([np.zeros(len(made.tm)), made.te]) == pytest.approx(
        every, rel=TIGHT, abs=TIGHT * every[-1]
    )
    assert made.te.min() >= 0


def test_gradients_of_the_scalars_are_the_tm_modes(cell, made):
    f = made.scalar
    assert f.T @ cell.cell.scalar @ f == pytest.approx(np.eye(len(made.tm)), abs=TIGHT)
    raised = cell.gradient @ f
    assert made.vector[:, len(made.te) :] * np.sqrt(made.tm) == pytest.approx(
        raised, abs=1e-6 * np.abs(raised).max()
    )


def test_the_careful_way_is_taken_where_both_are_asked(cell):
    both, careful = (
        homogeneous.homogeneous_modes(cell, careful=True, quick=quick)
        for quick in (True, False)
    )
    assert np.array_equal(both.tm, careful.tm)
    assert np.array_equal(both.te, careful.te)


def test_the_discs_matrices_are_in_the_modes_coordinates(cell, made):
    v, a = made.vector, len(made.te)
    assert made.disc_mass == pytest.approx(v.T @ cell.disc.mass @ v, abs=TIGHT)
    assert made.disc_curl == pytest.approx(
        v[:, :a].T @ cell.disc.curl @ v[:, :a], abs=TIGHT * made.te.max()
    )
    assert made.disc_scalar == pytest.approx(
        made.scalar.T @ cell.disc.scalar @ made.scalar, abs=TIGHT
    )


def test_the_zero_order_is_given_its_exact_wavenumber(cell, made):
    """kx² of a Bloch wave, in half pitches half its phase; 0 where there is none, of
    the uniform field.
    """
    exact = (cell.half_phase_rad or 0.0) ** 2
    for found, plain in ((made.te_exact, made.te), (made.tm_exact, made.tm)):
        assert found[1:] == pytest.approx(np.maximum(plain[1:], 0), abs=1e-12)
    lowest = made.te_exact[0], made.tm_exact[0]
    assert exact in lowest  # by one of the two families


@pytest.mark.parametrize(
    ("lowest", "half", "want"),
    [
        (0.6**2 * 1.049, 0.6, 0.36),  # within a twentieth
        (0.6**2 * 0.951, 0.6, 0.36),
        (0.6**2 * 1.051, 0.6, 0.6**2 * 1.051),
        (0.6**2 * 0.949, 0.6, 0.6**2 * 0.949),
        (0.9e-9, None, 0.0),
        (-0.9e-9, None, 0.0),
        (1.1e-9, None, 1.1e-9),
        (-0.2, 0.6, 0.0),
    ],
)
def test_a_wavenumber_near_that_of_the_zero_order_takes_it(lowest, half, want):
    found = homogeneous.exact_zero_order(np.array([lowest, 7.0]), half)
    assert found == pytest.approx(np.array([want, 7.0]), rel=1e-12, abs=0)
