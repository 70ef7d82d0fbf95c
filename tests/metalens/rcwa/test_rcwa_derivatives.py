"""Derivatives of the transmission: central differences of eighth order; a closed form
where modes coincide.
"""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from metalens import modal, rcwa
from metalens.cell.light import Light
from metalens.cell.record import Cell, Film, Index
from metalens.ground.errors import CellError
from metalens.rcwa.conditions import case, case_waves
from metalens.rcwa.derivative import differentiate, mixed, sections
from metalens.rcwa.layer import layer
from metalens.rcwa.solver import truncated
from metalens.rcwa.stack import respond

PLAIN = Cell(0.4, 0.7, pillar=Index(3.6), substrate=Index(1.4525))
LOSSY = replace(PLAIN, pillar=Index(3.6, 0.1))
RICH = Cell(
    0.4,
    0.6,
    pillar=Index(3.4, 0.05),
    substrate="SiO2",
    cover=Index(1.2),
    between=Index(1.1),
    sidewall_rad=0.03,
    under=(Film("SiO2", 0.1), Film(Index(2.0), 0.05)),
    over=(Film(Index(1.3, 0.02), 0.2),),
)
DIFFERENCES = (4 / 5, -1 / 5, 4 / 105, -1 / 280)


def slope(value, at, step):
    """Central difference of eighth order: error step^8 of the ninth derivative, and
    rounding / step.
    """
    parts = [
        w * (value(at + i * step) - value(at - i * step))
        for i, w in enumerate(DIFFERENCES, 1)
    ]
    return sum(parts) / step


def transmission(cell, diameter_um, wavelength_um, direction, steps):
    """At three orders; a tilted wall in the layers that are differentiated."""
    this = case(cell, Light(wavelength_um, **direction))
    if not steps:
        return truncated(this, np.array([diameter_um]), 3).t[0]
    ways, zero = case_waves(this, 3)
    layers = [
        layer(*mixed(this, ways, np.array(diameter_um), part))
        for part in sections(steps)
    ]
    heights = tuple(part.share * cell.height_um * this.k0 for part in sections(steps))
    return respond(ways, replace(this.media, heights=heights), layers, zero).t[zero]


@pytest.mark.parametrize("tilt", [0.03, -0.02])
def test_layers_of_the_derivatives_meet_the_collocated_wall(tilt):
    """Fourth order: sixteen times less with twice the steps, towards what ``solve``
    takes.
    """
    cell = replace(PLAIN, sidewall_rad=tilt)
    direction = {"angle_rad": 0.0, "azimuth_rad": 0.0, "polarization": "x"}
    want = truncated(case(cell, Light(0.85, **direction)), np.array([0.21]), 3, 8).t[0]
    errors = [
        abs(transmission(cell, 0.21, 0.85, direction, steps) - want) for steps in (4, 8)
    ]
    assert errors[1] < 2e-3
    assert errors[1] < 0.2 * errors[0]


@pytest.mark.parametrize(
    ("cell", "steps", "angle_rad", "azimuth_rad", "polarization"),
    [
        (PLAIN, 0, 0.0, 0.0, "x"),
        (LOSSY, 0, 0.2, 0.0, "p"),
        (LOSSY, 0, 0.2, math.pi / 2, "s"),
        (RICH, 1, 0.25, 0.3, "s"),
        (RICH, 1, -0.25, 0.3, "p"),
    ],
)
def test_every_derivative_against_differences(
    cell, steps, angle_rad, azimuth_rad, polarization
):
    diameter, wavelength = 0.21, 0.85
    direction = {
        "angle_rad": angle_rad,
        "azimuth_rad": azimuth_rad,
        "polarization": polarization,
    }
    got = differentiate(
        case(cell, Light(wavelength, **direction)),
        diameter,
        harmonics=3,
        steps=steps,
        angle_rad=angle_rad,
    )

    def t(cell=cell, diameter=diameter, wavelength=wavelength, **turned):
        return transmission(cell, diameter, wavelength, direction | turned, steps)

    n, k = cell.pillar.n, cell.pillar.k
    want = {
        "diameter_um": slope(lambda d: t(diameter=d), diameter, 1e-4),
        "height_um": slope(
            lambda h: t(cell=replace(cell, height_um=h)), cell.height_um, 1e-3
        ),
        "n": slope(lambda n: t(cell=replace(cell, pillar=Index(n, k))), n, 1e-3),
        "wavelength_um": slope(lambda w: t(wavelength=w), wavelength, 3e-4),
    }
    if k:
        want["k"] = slope(lambda k: t(cell=replace(cell, pillar=Index(n, k))), k, 1e-3)
    if angle_rad:
        want["angle_rad"] = slope(lambda a: t(angle_rad=a), angle_rad, 1e-3)
    assert got.t == pytest.approx(t(), abs=1e-13)
    for name, value in want.items():
        assert abs(getattr(got, name) - value) < 1e-8 * max(1, abs(value)), name


def film(n, height, wavelength=0.85, below=1.4525):
    """Slab of index n between ``below`` and air: Airy's sum."""
    enter, leave = 2 * below / (below + n), 2 * n / (n + 1)
    down, up = (n - below) / (n + below), (n - 1) / (n + 1)
    phase = cmath.exp(2j * math.pi * n * height / wavelength)
    return enter * leave * phase / (1 - down * up * phase**2) / math.sqrt(below)


@pytest.mark.parametrize(("angle_rad", "polarization"), [(0.0, "x"), (0.15, "p")])
def test_the_modal_method_has_the_same_slopes(angle_rad, polarization):
    light = {"angle_rad": angle_rad, "polarization": polarization}
    ours = rcwa.derivatives(LOSSY, 0.13, 0.85, harmonics=8, **light)
    theirs = modal.gradient(LOSSY, 0.13, 0.85, **light)
    for name in (
        "t",
        "diameter_um",
        "height_um",
        "n",
        "k",
        "wavelength_um",
        "angle_rad",
    ):
        want = getattr(theirs, name)
        assert abs(getattr(ours, name) - want) <= 4e-2 * abs(want), (
            name
        )  # truncation of 8 orders, on a slope


@pytest.mark.parametrize("diameter_um", [0.0, 0.2, 0.4])
def test_hard_degenerate_modes_of_a_homogeneous_layer(diameter_um):
    n, height = 1.7, 0.7
    cell = replace(PLAIN, pillar=Index(n), between=Index(n))
    got = rcwa.derivatives(cell, diameter_um, 0.85, harmonics=4)
    step = 1e-4
    by_height = slope(lambda h: film(n, h), height, step)
    by_wavelength = slope(lambda w: film(n, height, w), 0.85, step)
    assert abs(got.t - film(n, height)) < 1e-12
    assert abs(got.height_um - by_height) < 1e-9
    assert abs(got.wavelength_um - by_wavelength) < 1e-9
    assert abs(got.diameter_um) < 1e-12


def test_hard_no_height_has_the_slope_of_a_thin_film():
    n = 1.7
    flat = replace(PLAIN, pillar=Index(n), between=Index(n), height_um=0.0)
    got = rcwa.derivatives(flat, 0.2, 0.85, harmonics=3)
    assert abs(got.height_um - slope(lambda h: film(n, h), 0.0, 1e-3)) < 1e-9
    assert got.n == got.wavelength_um == 0


def test_weak_disc_changes_the_film_by_its_share_of_the_cell():
    n, diameter = 1.7, 0.02
    got = rcwa.derivatives(
        replace(PLAIN, pillar=Index(n), between=Index(n)), diameter, 0.85, harmonics=1
    )
    whole = slope(lambda n: film(n, 0.7), n, 1e-4)
    assert abs(got.n - whole * math.pi * diameter**2 / 4 / 0.16) < 1e-12


def test_k_is_n_turned_by_a_quarter():
    got = rcwa.derivatives(LOSSY, 0.2, 0.85, harmonics=3)
    assert got.k == 1j * got.n


def test_height_only_turns_the_phase_where_one_mode_travels_alone():
    n = 1.4525
    got = rcwa.derivatives(
        replace(PLAIN, pillar=Index(n), between=Index(n), cover=Index(n)),
        0.2,
        0.85,
        harmonics=3,
    )
    assert abs(got.height_um - 2j * math.pi * n / 0.85 * got.t) < 1e-11


def test_slope_with_angle_vanishes_at_normal_incidence_and_joins():
    assert rcwa.derivatives(PLAIN, 0.2, 0.85, harmonics=3).angle_rad == 0
    near = rcwa.derivatives(
        PLAIN, 0.2, 0.85, harmonics=3, angle_rad=1e-8, polarization="p"
    )
    assert abs(near.angle_rad) < 1e-5


@pytest.mark.parametrize(("n_side", "n"), [(1.4525, 3.6), (1.0, 3.6), (1.0, 1.0)])
def test_hard_rayleigh_anomaly_gives_numbers(n_side, n):
    cell = replace(PLAIN, pitch_um=0.85 / n_side, pillar=Index(n))
    got = rcwa.derivatives(cell, 0.2, 0.85, harmonics=3)
    assert all(cmath.isfinite(getattr(got, name)) for name in got.__slots__)


def test_absorbing_substrate_and_total_reflection_are_refused():
    with pytest.raises(CellError, match="do not absorb"):
        rcwa.derivatives(replace(PLAIN, substrate=Index(1.45, 0.1)), 0.2, 0.85)
    with pytest.raises(CellError, match="totally reflected"):
        rcwa.derivatives(
            replace(PLAIN, cover=Index(0.3)), 0.2, 0.85, angle_rad=0.6, polarization="s"
        )


@pytest.mark.parametrize("tilt", [0.12, -0.07])
def test_a_tilted_wall_counts_with_its_mean_area_where_nothing_is_reflected(tilt):
    """Index-matched: t = exp(i k n h), and dt/dn = i k h s t, s the mean of pi D(z)²/4
    over the cell's area.
    """
    n, diameter, height = 1.7, 0.21, 0.6
    matched = dict.fromkeys(("pillar", "between", "substrate", "cover"), Index(n))
    cell = replace(PLAIN, **matched, height_um=height, sidewall_rad=tilt)
    got = rcwa.derivatives(cell, diameter, 0.85, harmonics=3)
    k, spread = 2 * math.pi / 0.85, 2 * height * math.tan(tilt)
    share = math.pi / 4 * (diameter**2 + spread**2 / 12) / cell.pitch_um**2
    assert abs(got.t - cmath.exp(1j * k * n * height)) < 1e-12
    assert abs(got.n - 1j * k * height * share * got.t) < 1e-10
    assert abs(got.height_um - 1j * k * n * got.t) < 1e-10
    upright = rcwa.derivatives(
        replace(cell, sidewall_rad=0.0), diameter, 0.85, harmonics=3
    )
    assert abs(got.n - upright.n) > 1e-2 * abs(got.n)  # the tilt does matter
