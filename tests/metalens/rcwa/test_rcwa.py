"""RCWA of a pillar: closed forms, invariants, an independent solver, refusals.

Error budgets: identities hold to 1e-12 (rounding of an eigenproblem of some hundred
orders); the reference values come
from a modal method on elements that follow the disc, whose two dual forms agree within
1e-4.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from metalens import rcwa
from metalens.cell.record import Cell, Film, Index
from metalens.core.errors import CellError, MaterialError

CELL = Cell(0.4, 0.7, pillar=Index(3.6), substrate=Index(1.4525))
WAVELENGTH = 0.85
ROUNDING = 1e-12


def amplitude(cell, diameter_um, wavelength_um=WAVELENGTH, *, harmonics=5, **direction):
    return rcwa.solve(
        cell, diameter_um, wavelength_um, harmonics=harmonics, **direction
    )


def fresnel_stack(
    indices, thicknesses, *, sine=0.0, wavelength_um=WAVELENGTH, polarization="s"
):
    """Power-normalised t and r of a stack by characteristic matrices (Born and Wolf
    1.6); ends are half-spaces.
    """
    k0 = 2 * math.pi / wavelength_um
    cosines = [np.sqrt(1 - (sine / n) ** 2 + 0j) for n in indices]
    admittance = [
        n * c if polarization == "s" else n / c
        for n, c in zip(indices, cosines, strict=True)
    ]
    M = np.eye(2, dtype=complex)
    for n, c, y, d in zip(
        indices[1:-1], cosines[1:-1], admittance[1:-1], thicknesses, strict=True
    ):
        phase = k0 * n * c * d
        M = M @ [
            [np.cos(phase), -1j * np.sin(phase) / y],
            [-1j * y * np.sin(phase), np.cos(phase)],
        ]
    b, c = M @ [1, admittance[-1]]
    first = admittance[0]
    return 2 * np.sqrt(first * admittance[-1].real) / (first * b + c), (
        first * b - c
    ) / (first * b + c)


DIRECTIONS = [
    {},
    {"angle_rad": 0.3, "polarization": "p"},
    {"angle_rad": 0.3, "polarization": "s"},
    {"angle_rad": 0.3, "azimuth_rad": 0.4, "polarization": "p"},
    {"angle_rad": 0.3, "azimuth_rad": 0.4, "polarization": "s"},
]


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("n", [1.0, 0.3, 2.0 + 0.1j, 0.2 + 5j, 12.0])
def test_hard_homogeneous_layer_is_the_film_of_the_closed_form(direction, n):
    index = Index(complex(n).real, complex(n).imag)
    cell = replace(CELL, pillar=index, between=index, height_um=0.2)
    got = rcwa.solve(cell, 0.2, WAVELENGTH, **direction)
    sine = math.sin(direction.get("angle_rad", 0.0))
    t, r = fresnel_stack(
        [1.4525, n, 1.0],
        [0.2],
        sine=sine,
        polarization=direction.get("polarization", "s"),
    )
    assert abs(got.t - t) < ROUNDING
    assert abs(got.r - r) < ROUNDING
    assert got.engine == "film"
    assert abs(got.energy - abs(t) ** 2 - abs(r) ** 2) < ROUNDING


def truncation(cell, size_um, harmonics=4, *, polarization="s", **more):
    """(t, r) of one truncation for one polarisation."""
    found = rcwa.solve_truncation(
        cell, size_um, WAVELENGTH, harmonics=harmonics, **more
    )
    place = int(polarization == "p") if "angle_rad" in more else 0
    return found.t[place, place], found.r[place, place]


@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("diameter_um", [0.01, 0.2, 0.4])
def test_hard_pillar_of_air_goes_through_the_modes_and_gives_the_film(
    diameter_um, direction
):
    got = truncation(replace(CELL, pillar="air"), diameter_um, **direction)
    sine = math.sin(direction.get("angle_rad", 0.0))
    t, r = fresnel_stack(
        [1.4525, 1.0, 1.0],
        [0.7],
        sine=sine,
        polarization=direction.get("polarization", "s"),
    )
    assert abs(got[0] - t) < ROUNDING
    assert abs(got[1] - r) < ROUNDING


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_films_under_and_over_against_characteristic_matrices(direction):
    cell = replace(
        CELL,
        pillar=Index(1.3),
        between=Index(1.3),
        cover=Index(1.1),
        under=(Film(Index(2.0, 0.2), 0.11), Film(Index(1.7), 0.23)),
        over=(Film(Index(1.38), 0.15), Film(Index(2.2), 0.05)),
    )
    sine = math.sin(direction.get("angle_rad", 0.0))
    t, r = fresnel_stack(
        [1.4525, 2.0 + 0.2j, 1.7, 1.3, 1.38, 2.2, 1.1],
        [0.11, 0.23, 0.7, 0.15, 0.05],
        sine=sine,
        polarization=direction.get("polarization", "s"),
    )
    exact = rcwa.solve(cell, 0.2, WAVELENGTH, **direction)
    modes = amplitude(
        replace(cell, pillar=Index(1.3 + 1e-14)), 0.2, harmonics=3, **direction
    )
    for got in (exact, modes):
        assert abs(got.t - t) < ROUNDING
        assert abs(got.r - r) < ROUNDING


def test_films_against_colour_science():
    colour = pytest.importorskip("colour.phenomena")
    cell = replace(
        CELL, pillar="air", under=(Film(Index(2.0), 0.12), Film(Index(1.38), 0.2))
    )
    got = rcwa.solve(replace(cell, height_um=0.0), 0.2, WAVELENGTH)
    R, T = colour.multilayer_tmm(
        np.array([1.4525, 2.0, 1.38, 1.0]), np.array([120.0, 200.0]), 850.0
    )[:2]
    assert abs(abs(got.r) ** 2 - np.ravel(R)[0]) < 1e-10
    assert abs(abs(got.t) ** 2 - np.ravel(T)[0]) < 1e-10


def test_a_thick_metal_film_reflects_and_nothing_overflows():
    mirror = replace(CELL, under=(Film(Index(0.2, 5.0), 30.0),))
    got = amplitude(mirror, 0.2)
    _, r = fresnel_stack([1.4525, 0.2 + 5j], [])
    assert abs(got.r - r) < ROUNDING
    assert abs(got.t) < 1e-30


def turned_over(cell):
    """The same stack lit from the other side."""
    return replace(
        cell,
        substrate=cell.cover,
        cover=cell.substrate,
        between=cell.fill,
        under=cell.over[::-1],
        over=cell.under[::-1],
        sidewall_rad=-cell.sidewall_rad,
    )


@settings(max_examples=40)
@given(
    pitch_um=st.floats(0.25, 0.8),
    fill=st.floats(0.0, 1.0),
    height_um=st.floats(0.0, 3.0),
    n=st.floats(0.2, 5.0),
    substrate=st.floats(1.0, 2.0),
    angle_rad=st.floats(-1.5, 1.5),
    polarization=st.sampled_from(["s", "p"]),
)
def test_any_lossless_cell_conserves_power_and_is_reciprocal(
    pitch_um, fill, height_um, n, substrate, angle_rad, polarization
):
    cell = Cell(pitch_um, height_um, pillar=Index(n), substrate=Index(substrate))
    light = {"angle_rad": angle_rad, "polarization": polarization}
    there, back = (
        amplitude(side, fill * pitch_um, harmonics=3, **light)
        for side in (cell, turned_over(cell))
    )
    # some draws sit on a mode or an order at its cut-off
    assert abs(there.energy - 1) < 1e-9
    assert abs(there.t - back.t) < 1e-9


def test_swap_of_sides_with_a_tilted_wall():
    cell = replace(CELL, sidewall_rad=0.04, pillar=Index(3.6, 0.05))
    there = amplitude(cell, 0.21)
    back = amplitude(turned_over(cell), 0.21)
    assert abs(there.t - back.t) < ROUNDING
    assert abs(there.r - back.r) > 1e-3


def test_diagonal_plane_of_incidence_has_no_preferred_side():
    a = amplitude(
        CELL, 0.2, angle_rad=0.2, azimuth_rad=math.pi / 4 - 0.1, polarization="p"
    ).t
    b = amplitude(
        CELL, 0.2, angle_rad=0.2, azimuth_rad=math.pi / 4 + 0.1, polarization="p"
    ).t
    assert abs(a - b) < ROUNDING


# t of pillars of n = 3.6 (or 3.82 + 0.0634i), pitch 0.4 um, height 0.7 um, from the
# modal method.
MODAL_850 = {
    0.08: 0.596704 - 0.784089j,
    0.1: 0.70657 - 0.686665j,
    0.13: 0.925472 - 0.327925j,
    0.16: 0.627371 + 0.759988j,
    0.2: -0.652702 - 0.596116j,
    0.22: 0.552577 - 0.184848j,
    0.25: 0.074349 - 0.282671j,
    0.28: -0.219911 - 0.008819j,
    0.32: 0.127343 - 0.120112j,
}
MODAL_940 = {
    0.08: 0.126586 - 0.979235j,
    0.13: 0.528023 - 0.835834j,
    0.16: 0.921104 - 0.326361j,
    0.2: -0.606622 + 0.781465j,
    0.22: -0.292337 - 0.609484j,
    0.25: -0.070747 - 0.969053j,
    0.28: 0.39798 + 0.120639j,
    0.32: -0.011646 + 0.051587j,
}
MODAL_LOSSY = {
    0.1: 0.716535 - 0.665918j,
    0.16: -0.131656 + 0.686107j,
    0.22: 0.019314 - 0.363176j,
}
MODAL_CELLS = [
    (CELL, 0.85, MODAL_850),
    (replace(CELL, substrate=Index(1.4513)), 0.94, MODAL_940),
    (replace(CELL, pillar=Index(3.82, 0.0634)), 0.85, MODAL_LOSSY),
]


@pytest.mark.parametrize(("cell", "wavelength_um", "values"), MODAL_CELLS)
def test_error_and_estimate_against_the_modal_method(cell, wavelength_um, values):
    results = [rcwa.solve(cell, d, wavelength_um, harmonics=10) for d in values]
    error = np.abs(
        [got.t - want for got, want in zip(results, values.values(), strict=True)]
    )
    # algebraic convergence; the flank at 302 nm needs more orders
    assert error.max() < 1.5e-2
    assert (error < [got.t_error for got in results]).all()


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "wavelength_um", "values"), MODAL_CELLS)
def test_a_hundredth_is_reached_over_the_whole_range(cell, wavelength_um, values):
    extra = (
        {0.1937: -0.014776 + 0.014716j, 0.302: 0.697059 - 0.690801j}
        if values is MODAL_850
        else {}
    )
    wanted = values | extra
    results = [rcwa.solve(cell, d, wavelength_um, harmonics=16) for d in wanted]
    error = np.abs(
        [got.t - want for got, want in zip(results, wanted.values(), strict=True)]
    )
    assert error.max() < 1e-2
    assert (error < [got.t_error for got in results]).all()


def test_errors_fall_as_the_square_of_the_truncation():
    error = {}
    for harmonics in (5, 10):
        results = [rcwa.solve(CELL, d, 0.85, harmonics=harmonics) for d in MODAL_850]
        error[harmonics] = np.median(
            np.abs(
                [
                    got.t - MODAL_850[d]
                    for got, d in zip(results, MODAL_850, strict=True)
                ]
            )
        )
    assert error[10] < error[5] / 3


@pytest.mark.parametrize(
    ("angle_deg", "polarization", "diameter_um", "want"),
    [
        (5, "s", 0.12, 0.841563 - 0.508937j),
        (5, "p", 0.2, -0.601156 - 0.717143j),
        (20, "s", 0.2, -0.014181 - 0.905069j),
        (20, "p", 0.272, 0.355477 + 0.901178j),
        (89, "p", 0.2, -0.074828 - 0.139944j),
    ],
)
def test_oblique_incidence_against_the_modal_method(
    angle_deg, polarization, diameter_um, want
):
    got = amplitude(
        CELL,
        diameter_um,
        harmonics=8,
        angle_rad=math.radians(angle_deg),
        polarization=polarization,
    )
    assert abs(got.t - want) < min(got.t_error, 3e-2)


def test_a_loose_tolerance_stops_early_and_a_tight_one_is_honest():
    loose = rcwa.solve(CELL, 0.12, WAVELENGTH, tolerance=0.2)
    assert loose.converged
    assert loose.t_error <= 0.2
    assert loose.orders < 300
    stuck = rcwa.solve(
        CELL,
        0.12,
        WAVELENGTH,
        angle_rad=0.1,
        azimuth_rad=0.3,
        polarization="s",
        tolerance=1e-8,
    )
    assert not stuck.converged
    assert stuck.t_error > 1e-8
    assert "above the tolerance" in stuck.reason


def plain_slices(cell, diameter_um, harmonics, slices):
    """t of a staircase of upright layers."""
    layers = tuple(rcwa.staircase_layers(cell, slices))
    upright = replace(cell, sidewall_rad=0.0, layers=layers)
    return truncation(upright, diameter_um, harmonics)[0]


@pytest.mark.parametrize("tilt_deg", [2, -2])
def test_tilted_wall_is_the_limit_of_plain_slices(tilt_deg):
    cell = replace(CELL, sidewall_rad=math.radians(tilt_deg))
    coarse, fine = (plain_slices(cell, 0.15, 3, slices) for slices in (32, 64))
    limit = fine + (fine - coarse) / 3  # second order, Richardson: 1e-6 left
    assert abs(truncation(cell, 0.15, 3)[0] - limit) < 1e-5
    got = amplitude(cell, 0.15, harmonics=5)
    assert abs(got.t - amplitude(CELL, 0.15, harmonics=5).t) > 1e-3
    assert abs(got.energy - 1) < 10 * ROUNDING  # seventy upright layers


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"diameter_um": -0.1}, "need a finite length >= 0"),
        ({"diameter_um": math.nan}, "need a finite length >= 0"),
        ({"diameter_um": 0.41}, "overlap"),
        ({"angle_rad": math.pi / 2}, "angle"),
        ({"angle_rad": math.nan}, "angle"),
        ({"azimuth_rad": math.inf}, "azimuth"),
        ({"polarization": "q"}, "need 'x', 'y', 's' or 'p'"),
        ({"angle_rad": 0.1, "azimuth_rad": 0.3, "polarization": "x"}, "ambiguous"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"harmonics": 0}, "harmonics"),
    ],
)
def test_bad_numbers_are_refused_by_name(change, message):
    numbers = {"diameter_um": 0.2, "wavelength_um": WAVELENGTH} | change
    with pytest.raises(CellError, match=message):
        rcwa.solve(CELL, **numbers)


def test_light_that_cannot_come_from_the_substrate_is_refused():
    with pytest.raises(CellError, match="cannot come"):
        rcwa.solve(
            replace(CELL, substrate=Index(0.5)),
            0.2,
            WAVELENGTH,
            angle_rad=0.6,
            polarization="s",
        )


def test_total_reflection_at_a_cover_of_low_index():
    got = amplitude(
        replace(CELL, cover=Index(0.3)), 0.2, angle_rad=0.6, polarization="s"
    )
    assert got.t == 0
    assert abs(abs(got.r) - 1) < ROUNDING


@pytest.mark.parametrize(
    ("wavelength_um", "error"),
    [(0.0, CellError), (-1.0, CellError), (math.nan, CellError), (5.0, MaterialError)],
)
def test_bad_wavelengths_are_refused(wavelength_um, error):
    with pytest.raises(error, match=r"wavelength| um"):
        rcwa.solve(Cell(0.4), 0.2, wavelength_um)
