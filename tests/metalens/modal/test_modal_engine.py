"""The modal engine against closed forms, invariants, its own two forms, and the slower
methods.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens import modal, rcwa
from metalens.cell.light import Incidence
from metalens.cell.record import Cell, Film, Index
from metalens.core.errors import CellError
from metalens.modal.case import case_of
from metalens.modal.mesh import MeshPlan, assemble_disc
from metalens.modal.solver import LEVELS, solve_on_mesh
from metalens.modal.spaces import homogeneous_modes

WAVELENGTH = 0.85
PLAN = MeshPlan(3, 3)
COARSE = LEVELS[0]


def cell(height=0.7, n=3.6, k=0.0, pitch=0.4, substrate=1.4525, cover=1.0, between=1.0):
    return Cell(
        pitch, height, Index(n, k), Index(substrate), Index(cover), Index(between)
    )


def film(n, height, wavelength=WAVELENGTH, below=1.4525, above=1.0):
    """Power-normalised t of a slab between half-spaces at normal incidence (Airy)."""
    r1, r2 = (below - n) / (below + n), (n - above) / (n + above)
    t12 = 2 * np.sqrt(below * n) / (below + n) * 2 * np.sqrt(n * above) / (n + above)
    phase = np.exp(2j * np.pi * n * height / wavelength)
    return t12 * phase / (1 + r1 * r2 * phase**2)


# --- elements
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("half_phase", [None, 0.3, 1.2])
def test_empty_cell_has_plane_waves_as_modes(half_phase):
    basis = homogeneous_modes(
        assemble_disc(0.5, PLAN), PLAN, electric=True, half_phase_rad=half_phase
    )
    along = (
        range(1, 5)
        if half_phase is None
        else [half_phase / math.pi + m for m in range(-4, 4)]
    )
    exact = np.array(sorted(m**2 + n**2 for m in along for n in range(1, 5)))[:3]
    got = basis.tm[:3] / math.pi**2
    assert abs(got / exact - 1).max() < 4e-2  # smooth waves on 5 cubic elements
    assert (got > exact * (1 - 1e-12)).all()  # Rayleigh-Ritz: from above


def test_plane_waves_converge_exponentially_with_the_degree():
    errors = []
    for degree in (3, 4, 5):
        plan = MeshPlan(degree, degree, (), (0.7,), core=0.5)
        basis = homogeneous_modes(
            assemble_disc(0.5, plan), plan, electric=False, half_phase_rad=0.3
        )
        errors.append(abs(basis.tm[0] - 0.09) / 0.09)
    assert errors[1] < errors[0] / 5
    assert errors[2] < errors[1] / 5


# --- solutions with a known answer
# ---------------------------------------------------------------------------------


@pytest.mark.parametrize("height", [0.0, 1e-9, 0.01, 0.7, 5.0, 50.0])
def test_pillar_of_air_is_a_film_of_air(height):
    got = modal.solve(cell(height, n=1.0), 0.2, WAVELENGTH)
    # q to 1e-11, times k0 h
    assert abs(got.t - film(1.0, height)) < 1e-10 + 1e-10 * height
    assert got.converged


@pytest.mark.parametrize(("n", "k"), [(2.0, 0.0), (3.6, 0.1), (3.6, 3.0)])
def test_homogeneous_layer_of_any_permittivity(n, k):
    layer = Cell(0.4, 0.7, Index(n, k), Index(1.4525), Index(1.0), Index(n, k))
    assert abs(modal.solve(layer, 0.2, WAVELENGTH).t - film(n + 1j * k, 0.7)) < 1e-10


@pytest.mark.parametrize("polarization", ["s", "p"])
def test_oblique_homogeneous_layer_is_fresnel(polarization):
    angle = math.radians(20)
    layer = cell(0.7, n=2.0, between=2.0)
    k0 = 2 * math.pi / WAVELENGTH
    kx = 2 * math.pi / WAVELENGTH * math.sin(angle)
    kz = [np.sqrt((k0 * n) ** 2 - kx**2 + 0j) for n in (1.4525, 2.0, 1.0)]
    y = [
        k / n**2 if polarization == "p" else k
        for k, n in zip(kz, (1.4525, 2.0, 1.0), strict=True)
    ]
    r1 = (y[0] - y[1]) / (y[0] + y[1])
    r2 = (y[1] - y[2]) / (y[1] + y[2])
    t12 = (
        4 * np.sqrt(y[0] * y[1]) / (y[0] + y[1]) * np.sqrt(y[1] * y[2]) / (y[1] + y[2])
    )
    phase = np.exp(1j * kz[1] * 0.7)
    want = t12 * phase / (1 + r1 * r2 * phase**2)
    got = modal.solve(
        layer,
        0.2,
        WAVELENGTH,
        angle_rad=angle,
        polarization=polarization,
        tolerance=1e-3,
    )
    assert abs(got.t - want) < got.t_error
    assert got.t_error < 1e-3


def test_reciprocity_with_absorption():
    s = solve_on_mesh(case_of(cell(k=0.1), 0.2, Incidence(WAVELENGTH)), COARSE).matrix
    assert abs(s[0, 1] - s[1, 0]) < 1e-12
    assert np.linalg.norm(s, 2) < 1


def test_polarisations_are_equal_at_normal_incidence():
    answers = {
        modal.solve(cell(), 0.2, WAVELENGTH, polarization=p, azimuth_rad=a).t
        for p in "xysp"
        for a in (0.0, 1.0)
    }
    assert len(answers) == 1


# --- hard cases
# ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("height", [50.0, 1000.0])
def test_hard_tall_pillars_stay_unitary(height):
    s = solve_on_mesh(case_of(cell(height), 0.2, Incidence(WAVELENGTH)), COARSE).matrix
    assert abs(s.conj().T @ s - np.eye(2)).max() < 1e-10


def test_hard_guided_mode_of_a_thin_layer_of_low_contrast():
    """A sharp resonance: on the coarsest mesh both forms lie 1e-3 apart, and 0.08 from
    what coupled waves say.
    """
    layer = Cell(
        0.9505, 0.1774, Index(2.2762), Index(1.7968), Index(1.6359), Index(1.9933)
    )
    waves = rcwa.solve(layer, 0.1899, 0.86503351, harmonics=13)
    got = modal.solve(layer, 0.1899, 0.86503351, tolerance=1e-2)
    assert waves.t_error < 4e-3
    assert max(abs(got.t - waves.t), abs(got.r - waves.r)) < got.t_error + waves.t_error
    assert got.t_error < 0.1


@pytest.mark.parametrize("short", [1e-4, 1e-8, 0.0])
def test_hard_substrate_order_at_cutoff(short):
    got = modal.solve(cell(), 0.2, 0.4 * 1.4525 / (1 - short))
    assert np.isfinite([got.t, got.r]).all()
    # rounding times the admittance of an order at its cutoff, 1e8
    assert abs(got.energy - 1) < 1e-9


def test_hard_pitch_equals_wavelength():
    got = modal.solve(cell(), 0.2, 0.4)
    assert np.isfinite([got.t, got.r]).all()
    assert abs(got.energy - 1) < 1e-9  # as above
    assert abs(got.t) ** 2 + abs(got.r) ** 2 < 1


@pytest.mark.parametrize("polarization", ["s", "p"])
def test_hard_tiny_angles_join_normal_incidence(polarization):
    case = [
        case_of(cell(), 0.2, Incidence(WAVELENGTH, a, polarization))
        for a in (0.0, 1e-12, 1e-8, 1e-5, 1e-3)
    ]
    t = [solve_on_mesh(c, COARSE).matrix[1, 0] for c in case]
    assert t[1] == t[0] == t[2]
    assert abs(t[3] - t[0]) < 1e-7
    assert abs(t[4] - t[0]) < 1e-4  # t is even in the angle: 20 theta² at most here


@pytest.mark.parametrize("polarization", ["s", "p"])
def test_hard_grazing(polarization):
    case = case_of(cell(), 0.2, Incidence(WAVELENGTH, math.radians(89), polarization))
    solution = solve_on_mesh(case, COARSE)
    assert np.isfinite(solution.matrix).all()
    assert abs(solution.energy - 1) < 1e-12


def test_angle_and_azimuth_have_the_symmetry_of_the_square():
    one = modal.solve(
        cell(), 0.2, WAVELENGTH, angle_rad=0.2, polarization="p", tolerance=1e-2
    ).t
    two = modal.solve(
        cell(), 0.2, WAVELENGTH, angle_rad=-0.2, polarization="p", tolerance=1e-2
    ).t
    three = modal.solve(
        cell(),
        0.2,
        WAVELENGTH,
        angle_rad=0.2,
        azimuth_rad=math.pi / 2,
        polarization="y",
        tolerance=1e-2,
    ).t
    # cos(π/2) is 6e-17; sums of 1e2 to 1e3 terms of order 1
    assert max(abs(two - one), abs(three - one)) < 1e-12


def test_hard_float32_numbers_are_taken_in_double_precision():
    diameter, wavelength = np.float32(0.2), np.float32(0.85)
    single = modal.solve(cell(), diameter, wavelength, tolerance=1e-2)
    double = modal.solve(cell(), float(diameter), float(wavelength), tolerance=1e-2)
    assert single == double


# --- refusals ------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"diameter_um": 0.4}, "rcwa"),
        ({"diameter_um": 0.0}, "diameter_um"),
        ({"diameter_um": math.nan}, "diameter_um"),
        ({"wavelength_um": -1.0}, "wavelength_um"),
        ({"angle_rad": 2.0}, "angle_rad"),
        ({"angle_rad": math.nan}, "angle_rad"),
        ({"angle_rad": 0.1, "azimuth_rad": math.inf}, "azimuth_rad"),
        ({"angle_rad": 0.1, "azimuth_rad": 0.3}, "rcwa"),
        ({"polarization": "z"}, "polarization"),
        ({"tolerance": 0.0}, "tolerance"),
    ],
)
def test_bad_numbers_are_refused(change, word):
    with pytest.raises(CellError, match=word):
        modal.solve(
            **({"cell": cell(), "diameter_um": 0.2, "wavelength_um": 0.85} | change)
        )


def test_elements_refuse_tilted_walls_by_name():
    with pytest.raises(CellError, match="upright pillar"):
        case_of(Cell(0.4, sidewall_rad=0.02), 0.2, Incidence(0.85))


CLEAR = {
    "under": (Film(Index(1.9), 0.07), Film(Index(1.6), 0.12)),
    "over": (Film(Index(1.3), 0.11), Film(Index(2.0), 0.05)),
}
ABSORBING = {
    "under": (Film(Index(1.9, 0.2), 0.07),),
    "over": (Film(Index(1.3, 0.05), 0.11),),
}
GUIDING = {"under": (Film(Index(3.0), 0.9),)}  # orders that only the film carries
LIGHTS = [{}] + [{"angle_rad": 0.2, "polarization": p} for p in "sp"]


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("films", [CLEAR, ABSORBING], ids=["clear", "absorbing"])
def test_a_layer_between_films_is_the_stack_of_characteristic_matrices(films, light):
    """RCWA solves films alone by characteristic matrices, to rounding; the quick way to
    the modes of the elements leaves 1e-7."""
    layer = Cell(
        0.36, 0.5, Index(1.7), Index(1.46), Index(1.1), between=Index(1.7), **films
    )
    want = rcwa.solve(layer, 0.2, WAVELENGTH, **light)
    got = modal.solve(layer, 0.2, WAVELENGTH, **light)
    assert abs(got.t - want.t) < 1e-6
    assert abs(got.r - want.r) < 1e-6


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("films", [CLEAR, ABSORBING, GUIDING])
def test_pillars_between_films_agree_with_coupled_waves(films, light):
    pillar = Cell(0.36, 0.5, Index(2.4), Index(1.46), Index(1.1), **films)
    got = modal.solve(pillar, 0.2, WAVELENGTH, tolerance=1e-3, **light)
    want = rcwa.solve(pillar, 0.2, WAVELENGTH, harmonics=8, **light)
    assert got.t_error < 1e-3
    assert want.t_error < 5e-2
    for one, other in ((got.t, want.t), (got.r, want.r)):
        assert abs(one - other) < got.t_error + want.t_error
    if films is not ABSORBING:
        assert abs(got.energy - 1) < 1e-12


def test_absorbing_half_space_is_refused():
    with pytest.raises(CellError, match="absorbs"):
        modal.solve(Cell(0.4, 0.7, Index(3.6), Index(1.45, 0.1)), 0.2, 0.85)


def test_tilted_walls_agree_with_coupled_waves_and_join_the_upright_pillar():
    """RCWA alone has a bar several times as wide; a tilt of 1e-6 moves t by 1e-5."""
    tilted = cell(n=2.6)
    tilted = dataclasses.replace(tilted, sidewall_rad=0.03)
    got = modal.solve(tilted, 0.17, WAVELENGTH, tolerance=1e-2)
    want = rcwa.solve(tilted, 0.17, WAVELENGTH, harmonics=7)
    for one, other in ((got.t, want.t), (got.r, want.r)):
        assert abs(one - other) < got.t_error + want.t_error
    assert got.converged
    assert got.t_error < want.t_error / 3
    nearly = dataclasses.replace(tilted, sidewall_rad=1e-6)
    joined = modal.solve(nearly, 0.17, WAVELENGTH, tolerance=1e-3)
    upright = modal.solve(cell(n=2.6), 0.17, WAVELENGTH, tolerance=1e-4)
    assert abs(joined.t - upright.t) < joined.t_error + 1e-4
