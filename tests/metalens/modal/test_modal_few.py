"""Few modes and a matrix root against all modes of the layer: the same scattering
matrix, for a part of the work.
"""

import numpy as np
import pytest

from metalens.cell.light import Incidence
from metalens.cell.record import Cell, Index
from metalens.modal.assembly import assemble_disc
from metalens.modal.case import case_of
from metalens.modal.engine import solve_on_mesh
from metalens.modal.few_modes import (
    carrying_modes,
    few_modes,
    matrix_root,
    symmetric_square,
)
from metalens.modal.homogeneous import exact_zero_order, homogeneous_modes
from metalens.modal.ladder import RUNGS
from metalens.modal.layer import LayerMedium, electric_modes, magnetic_modes
from metalens.modal.match import few_scattering, half_space, scattering_matrix
from metalens.modal.pencil import (
    CoordinateTurn,
    LayerPencil,
    electric_pencil,
    is_lossless,
    magnetic_pencil,
)
from metalens.modal.spaces import build_symmetry_class

COARSE = RUNGS[0].choice(0.5).plan
CASES = [
    (0.08, 0.0, "x"),
    (0.302, 0.0, "x"),
    (0.2, 0.2, "p"),
    (0.272, 0.0873, "p"),
    (0.2, 0.2, "s"),
]


def cell(height=0.7, n=3.6, k=0.0):
    return Cell(0.4, height, Index(n, k), Index(1.4525), Index(1.0), Index(1.0))


def both(case, *, magnetic, weak):
    """Scattering matrices from all modes and from few (None where they are not few)."""
    electric = bool(case.bloch) and case.p == magnetic
    symmetry_class = build_symmetry_class(
        assemble_disc(case.rho, COARSE),
        electric=electric,
        half_phase_rad=case.bloch or None,
    )
    b, medium = (
        homogeneous_modes(symmetry_class),
        LayerMedium(case.k0, case.disc, case.around),
    )
    halves = [
        half_space(b, case.k0, e, magnetic=magnetic) for e in (case.below, case.above)
    ]
    full = scattering_matrix(
        (magnetic_modes if magnetic else electric_modes)(b, medium),
        case.height,
        *halves,
    ).matrix
    pencil = (magnetic_pencil if magnetic else electric_pencil)(b, medium)
    found = few_modes(pencil, case.height, weak=weak)
    if found is None:
        return full, None
    sign = (
        np.array([[-1, 1], [1, -1]]) if magnetic else 1
    )  # the dual unknown reflects with the other sign
    return full, sign * few_scattering(pencil, found, case.height, *halves).matrix


@pytest.mark.parametrize("magnetic", [False, True])
@pytest.mark.parametrize(("diameter", "angle", "polarization"), CASES)
def test_few_modes_give_the_matrix_of_all(diameter, angle, polarization, magnetic):
    case = case_of(cell(), diameter, Incidence(0.85, angle, polarization))
    sharp = (
        25 if diameter == 0.272 else 1
    )  # a relative 1e-12 of the dark mode's wavenumber is 1e-8 of t
    for weak, within in ((1e-12, 2e-9 * sharp), (1e-7, 1e-6)):
        full, few = both(case, magnetic=magnetic, weak=weak)
        assert np.abs(few - full).max() < within
        assert (
            np.abs(few.conj().T @ few - np.eye(2)).max() < 1e-12
        )  # whatever was left out
        assert abs(few[0, 1] - few[1, 0]) < 1e-12


def test_thin_layer_keeps_all_modes():
    case = case_of(cell(height=0.001), 0.2, Incidence(0.85))
    assert both(case, magnetic=False, weak=1e-12)[1] is None
    assert abs(solve_on_mesh(case, COARSE).matrix[1, 0]) > 0.9


@pytest.mark.parametrize("height", [50.0, 1000.0])
def test_hard_tall_pillar_conserves_energy(height):
    case = case_of(cell(height=height), 0.2, Incidence(0.85))
    matrix = solve_on_mesh(case, COARSE, weak=RUNGS[0].weak).matrix
    assert np.abs(matrix.conj().T @ matrix - np.eye(2)).max() < 1e-11


def test_absorbing_and_metallic_layers_take_all_modes():
    assert not is_lossless(LayerMedium(1.0, 3.6**2 + 0.1j, 1.0))
    assert not is_lossless(LayerMedium(1.0, -4.0, 1.0))
    assert is_lossless(LayerMedium(1.0, 3.6**2, 1.0))


def near_diagonal(random, signs, ends):
    """Levels between two ends in any order, and a matrix about them that is symmetric
    but for signs.
    """
    n = len(signs)
    level = np.geomspace(*ends, n)[random.permutation(n)]
    rest = random.normal(size=(n, n)) * np.sqrt(level)
    return level, np.diag(level) + signs[:, None] * (rest + rest.T) / 4


def test_root_of_a_matrix_near_a_diagonal():
    random = np.random.default_rng(3)
    n = 24
    signs = np.where(np.arange(n) < 12, 1.0, -1.0)
    level, square = near_diagonal(random, signs, (50, 1e5))
    found = matrix_root(square, signs, 30.0, 1e-13)
    assert np.abs(found @ found - square).max() < 1e-11 * level.max()
    assert (np.linalg.eigvals(found).real > 0).all()
    assert np.abs(
        signs[:, None] * found - (signs[:, None] * found).T
    ).max() < 1e-11 * np.sqrt(level.max())


def test_a_root_that_single_precision_holds_takes_no_steps_in_double():
    random = np.random.default_rng(13)
    n = 40
    signs = np.where(random.random(n) < 0.4, 1.0, -1.0)
    level, square = near_diagonal(random, signs, (60, 3e4))
    quick, exact = (
        matrix_root(square, signs, 30.0, accuracy) for accuracy in (4e-8, 1e-13)
    )
    beside = ~np.eye(n, dtype=bool)
    assert (quick[beside] == quick[beside].astype(np.float32)).all()
    assert not (exact[beside] == exact[beside].astype(np.float32)).all()
    assert np.abs(quick - exact).max() < 1e-6 * np.sqrt(
        level.min()
    )  # 3e-7 is asked, of steps that halve the rest
    assert (
        np.abs(signs[:, None] * quick - (signs[:, None] * quick).T).max() == 0
    )  # so the matrix stays unitary


@pytest.mark.parametrize(
    ("square", "change", "ends"), [(0.89, 2.7e-7, True), (0.88, 4.2e-7, False)]
)
def test_single_precision_ends_at_the_first_step_below_a_few_of_its_roundings(
    square, change, ends
):
    """Of one level 1, E = (square - 1 - E²) / 2: each step leaves E times the change of
    the one before. 3e-7 is asked,
    five halves of the rounding of 1: a fourth step that changes less is the last, and
    0.06 of it is left; after one
    that changes more there is another, which leaves no more than rounding."""
    e = [(square - 1) / 2]
    for _ in range(4):
        e.append((square - 1 - e[-1] ** 2) / 2)
    assert e[3] - e[4] == pytest.approx(change, rel=0.02)  # two digits
    exact = np.sqrt(square) - 1
    found = matrix_root(np.array([[square]]), np.ones(1), 1.0, 4e-8)[0, 0] - 1
    # 0.06 is told to 1.9e-9, and a step that begins with that rounding ends with one of
    # its own
    close = 4e-9
    assert abs(found - (e[4] if ends else exact)) < close
    assert e[4] - exact > 3 * close


def test_root_of_levels_wider_apart_than_single_precision_counts():
    random = np.random.default_rng(5)
    level = np.geomspace(
        10.0, 1e12, 24
    )  # the roots of single precision are 0.1 off at the upper end
    signs = np.where(np.arange(24) % 3, 1.0, -1.0)
    rest = (
        0.2
        * random.uniform(-1, 1, (24, 24))
        * np.sqrt(np.minimum(level[:, None], level))
    )
    square = np.diag(level) + signs[:, None] * (rest + rest.T)
    found = matrix_root(square, signs, 1.0, 1e-12)
    off = np.abs(found @ found - square)[
        :6, :6
    ]  # of the rows that carry: 1e-12 of the roots, times the rows they meet
    assert off.max() < 1e-9 * level[:6].max()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [1, 3, 11, 24])
def test_a_product_by_strips_is_the_whole_product(n, dtype):
    random = np.random.default_rng(n)
    signs = np.where(random.random(n) < 0.4, 1.0, -1.0)
    half = random.integers(-9, 10, (n, n))
    e = (signs[:, None] * (half + half.T)).astype(
        dtype
    )  # whole numbers, whose products have no rounding
    assert (symmetric_square(e, signs) == e @ e).all()
    assert symmetric_square(e, signs).dtype == dtype


def test_root_refuses_what_is_far_from_a_diagonal():
    square = np.array([[1.0, 50.0], [-50.0, 1.0]])
    assert matrix_root(square, np.array([1.0, -1.0]), 1.0, 1e-12) is None


@pytest.mark.parametrize(
    ("half_phase_rad", "lowest", "want"),
    [
        (None, 3e-10, 0.0),
        (None, -3e-10, 0.0),
        (None, 2e-9, 2e-9),
        (None, 0.7, 0.7),  # a family without the zero order
        (0.4, 0.16 * 1.049, 0.4**2),
        (0.4, 0.16 * 0.951, 0.4**2),
        (0.4, 0.16 * 1.051, 0.16 * 1.051),
        (0.4, 0.16 * 0.949, 0.16 * 0.949),
    ],
)
def test_the_zero_order_has_its_exact_wavenumber_where_this_family_has_it(
    half_phase_rad, lowest, want
):
    """Within a twentieth of the square of half the phase over a cell, which meshes hold
    far better; no others move,
    and rounding leaves no square below 0."""
    given = np.array([lowest, 9.1, -1e-12, 0.161])
    assert exact_zero_order(given.copy(), half_phase_rad).tolist() == [
        want,
        9.1,
        0.0,
        0.161,
    ]


@pytest.mark.parametrize("half_phase", [None, 0.05, 0.3, 1.3])
@pytest.mark.parametrize("rho", [0.1, 0.5, 0.9])
def test_quick_homogeneous_modes_are_the_homogeneous_modes(half_phase, rho):
    for electric in (True, False):
        symmetry_class = build_symmetry_class(
            assemble_disc(rho, COARSE), electric=electric, half_phase_rad=half_phase
        )
        slow, quick = (
            homogeneous_modes(symmetry_class, careful=True),
            homogeneous_modes(symmetry_class, quick=True),
        )
        assert np.abs(slow.tm / quick.tm - 1).max() < 1e-6
        assert np.abs(slow.te - quick.te).max() < 3e-8 * slow.te.max()
        gram = quick.vector.T @ symmetry_class.cell.mass @ quick.vector
        assert np.abs(gram - np.eye(quick.size)).max() < 1e-6
        direct = quick.vector.T @ symmetry_class.disc.mass @ quick.vector
        assert np.abs(direct - quick.disc_mass).max() < 1e-6


def test_a_rung_leaves_out_less_than_a_hundredth_of_its_estimate():
    case = case_of(cell(), 0.2, Incidence(0.85))
    for rung in RUNGS[:2]:
        plan = rung.choice(case.rho).plan
        quick, exact = (
            solve_on_mesh(case, plan, weak=rung.weak),
            solve_on_mesh(case, plan),
        )
        error = rung.error(exact, case.rho)
        assert np.abs(quick.matrix - exact.matrix).max() < 1e-2 * error


@pytest.mark.parametrize(("ranks", "held"), [((3, 4), True), ((4, 4), False)])
def test_modes_are_few_as_long_as_four_fifths_of_all_directions_hold_them(ranks, held):
    """Nine low levels of twenty and no coupling among the others, which are alike in
    either block: the directions that
    the low ones pull at, as many as the ranks of the coupling, close the space. 16 of
    20 are few, 17 are not."""
    random = np.random.default_rng(8)
    te = np.concatenate([np.linspace(3.0, 7.0, 5), np.full(5, 1200.0)])
    tm = np.concatenate([np.linspace(4.0, 9.0, 4), np.full(6, 1500.0)])
    coupling = np.zeros((10, 10))
    for rows, columns, rank in (
        (slice(5, 10), slice(4), ranks[0]),
        (slice(5), slice(4, 10), ranks[1]),
    ):
        part = coupling[rows, columns]
        left, right = (
            np.linalg.qr(random.normal(size=(n, rank)))[0] for n in part.shape
        )
        part += left * np.linspace(40.0, 60.0, rank) @ right.T
    turn = CoordinateTurn(np.eye(10), 10)
    pencil = LayerPencil(
        te, tm, np.ones(10), -np.ones(10), coupling, turn, turn, None, None, dual=False
    )
    found = carrying_modes(
        pencil, 2.0, 1e-6, 1e-10
    )  # (ln 1e-6 / 2)² = 48: levels to that carry, to 203 are low
    if not held:
        assert found is None
        return
    whole = np.diag(np.concatenate([te, tm]))
    whole[:10, 10:], whole[10:, :10] = coupling, -coupling.T
    level, vectors = found[0], np.concatenate(found[1:])
    assert (
        np.abs(whole @ vectors - level * vectors).max() < 1e-9 * 1500
    )  # ten times the accuracy asked, of the largest
    assert np.count_nonzero(np.linalg.eigvals(whole).real < 48) == len(level) == 9
