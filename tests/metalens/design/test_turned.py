"""Lenses of turned pillars and on hexagonal lattices: phases by explicit matrices,
focus and energy in closed form.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens import design, propagate, psf, rcwa
from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes import Rectangle
from metalens.core.errors import LensError
from metalens.design import Focus, Limits
from metalens.library import GeometricPhase, PillarLibrary, Sweep
from tests.proxies import proxy_of
from tests.referees.turned_pillar import isolated

CELL = Cell(0.41, 0.5, Index(3.6), shape=Rectangle(0.5))
T_X = 0.97 * np.exp(0.7j)
T_Y = 0.95 * np.exp(-2.2j)
SIZE = 0.23
WAVELENGTH = 0.94
FOCUS = Focus(WAVELENGTH, 31.0, math.inf)


def library():
    """One size of a known pillar; a proxy of constant phase and level about it."""
    sizes = np.linspace(0.2, 0.26, 20)
    t = np.stack([np.full(20, T_X), np.full(20, T_Y)])[:, None, None]
    c = (T_X - T_Y) / 2
    proxy = proxy_of([np.angle(c), 0.0], [abs(c), 0.0], (0.2, 0.26), 0.94)
    angles = np.radians([0, 15, 30, 45, -30, -15])
    solved = isolated(T_X, T_Y, angles)
    turned = GeometricPhase(
        SIZE, WAVELENGTH, angles, solved, np.full(6, 0.01), 1.01 * solved[:, None]
    )
    sweep = Sweep((WAVELENGTH,), diameters_um=(0.2, 0.26), samples=20, light="circular")
    small = np.full(t.shape, 1e-3)
    about = (t, t * 0, small, small, np.empty((0, 5)), "rcwa", 1)
    axes = ("x", "y"), np.zeros(1), np.array([WAVELENGTH]), sizes
    return PillarLibrary(CELL, sweep, *axes, *about, proxy, (), turned=turned)


def made(hand="right", **about):
    arguments = {
        "aperture_um": 17.0,
        "library": library(),
        "hand": hand,
        "limits": Limits(min_gap_nm=90),
    } | about
    phase = design.phase_of(None, FOCUS, radius_um=8.5)
    return phase, design.assign_geometric_phase(phase, FOCUS, **arguments)


@pytest.mark.parametrize(("hand", "sign"), [("right", 1), ("left", -1)])
def test_every_pillar_gives_the_light_of_its_hand_the_wanted_phase(hand, sign):
    phase, (lens, quality, found) = made(hand)
    d = lens.diameters
    there = d.diameter_um > 0
    assert (d.diameter_um[there] == np.float32(SIZE)).all()
    assert 0 <= d.angle_rad.min() <= d.angle_rad.max() < math.pi
    come = np.array([1, 1j * sign]) / math.sqrt(2)
    # the part of the other hand
    leave = isolated(T_X, T_Y, d.angle_rad.astype(float)[there]) @ come @ come
    wanted = phase(d.x_um, d.y_um)[there]
    # float32 turns: 2 pi 2^-24 of twice the turn
    assert np.abs(np.angle(leave * np.exp(-1j * wanted))).max() < 2e-6
    assert np.allclose(
        leave, (lens.transmission() * np.exp(1j * lens.phase_rad()))[there], atol=2e-6
    )
    assert quality.wavefront_efficiency == pytest.approx(
        abs(T_X - T_Y) ** 2 / 4, abs=1e-6
    )
    assert found.converted == pytest.approx(abs(T_X - T_Y) ** 2 / 4)
    assert found.unconverted == pytest.approx(abs(T_X + T_Y) ** 2 / 4)
    assert found.converted_error == pytest.approx(
        rcwa.SAFETY * 0.0201 * abs(T_X - T_Y) ** 2 / 4
    )


def test_light_of_the_other_hand_is_spread_as_much_as_the_lens_would_focus():
    _, (lens, *_) = made("right")
    wrong = dataclasses.replace(lens, hand="left")
    at = np.zeros((1, 2))
    case = propagate.make_case(
        lens.diameters.diameter_um.shape,
        **lens.diameters.grid._asdict(),
        wavelength_um=WAVELENGTH,
        sensor_distance_um=31.0,
        depths_um=math.inf,
        window_um=1.0,
        samples=1,
    )
    bright, dark = (
        abs(propagate.field_at(one.phase_rad(), one.transmission(), case, at)[0, 0])
        ** 2
        for one in (lens, wrong)
    )
    assert dark < 0.05 * bright


@pytest.mark.parametrize(
    ("limits", "words"),
    [
        (Limits(min_diameter_nm=120.0), "115 nm wide"),
        (Limits(min_gap_nm=170.0), "turned towards each other"),
    ],
)
def test_pillars_that_are_not_printed_at_any_turn_are_refused(limits, words):
    with pytest.raises(LensError, match=words):
        made(limits=limits)


def test_a_library_without_turned_pillars_is_refused():
    with pytest.raises(LensError, match="light = 'circular'"):
        made(library=dataclasses.replace(library(), turned=None))


HEXAGONAL = Cell(0.336, 0.7, Index(3.6), lattice=Lattice("hexagonal"))
ROUND = proxy_of([3.4, 3.4], [0.91, 0.0], (0.08, 0.24), 0.85)
AT = Focus(0.85, 33.0, math.inf)


@pytest.fixture(scope="module")
def hexagonal():
    phase = design.phase_of(None, AT, radius_um=11.0)
    return design.make(
        phase, AT, aperture_um=22.0, cell=HEXAGONAL, proxy=ROUND, limits=Limits(60, 60)
    )


def test_sites_of_a_hexagonal_lens_fill_the_aperture_about_a_pillar_on_the_axis(
    hexagonal,
):
    lens, quality = hexagonal
    d = lens.diameters
    assert d.steps_um == (0.168, 0.291)  # rows on the grid of the mask
    assert d.diameter_um[len(d.diameter_um) // 2, d.diameter_um.shape[1] // 2] > 0
    reach = np.hypot(*np.meshgrid(d.x_um, d.y_um))[d.diameter_um > 0].max()
    assert 11.0 - 0.168 - 0.336 < reach <= 11.0 - 0.168
    area = quality.pillars * d.site_um2
    # pillars of the rim: 0.4 um of 22
    assert area == pytest.approx(math.pi * (11.0 - 0.168) ** 2, rel=0.01)
    assert quality.sampled_aperture == pytest.approx(0.85 / (math.sqrt(3) * 0.336))
    assert quality.steepest == pytest.approx(math.sin(math.atan(11 / 33)), rel=0.02)


def test_its_focus_lies_where_it_should_with_the_light_of_the_closed_form(hexagonal):
    """All pillars in step at the focus: |U| = sum of area T d |1/r - ik| / (2 pi r²), and the Airy width about it."""
    lens, _ = hexagonal
    found = design.check_focus(lens, axial=False)
    assert found.figures.strehl == pytest.approx(1, abs=1e-3)  # of the PSF
    assert max(abs(found.x_um), abs(found.y_um)) < 1e-3
    d = lens.diameters
    rows, columns = np.nonzero(d.diameter_um)
    r2 = d.x_um[columns] ** 2 + d.y_um[rows] ** 2 + 33.0**2
    k = 2 * np.pi / 0.85
    peak = (
        0.91
        * 0.336
        * 0.291
        * (33.0 / (2 * np.pi * r2) * np.hypot(1 / np.sqrt(r2), k)).sum()
    )
    stack = psf.from_lens(
        lens, psf.View((math.inf,), window_um=8.1, samples=81), tolerance=1e-5
    )
    assert stack.intensity[0, 0, 40, 40] * stack.energy_um2[
        0, 0
    ] / stack.step_um**2 == pytest.approx(peak**2, rel=2e-5)
    given = 0.91**2 * len(rows) * 0.336 * 0.291
    radius = np.hypot(*np.meshgrid(stack.x_um, stack.y_um))
    core = (
        stack.intensity[0, 0][radius < 0.61 * 0.85 / math.sin(math.atan(11 / 33))].sum()
        * stack.energy_um2[0, 0]
    )
    # Airy; NA 0.32 and the edge of the pixels: 2 %
    assert core / given == pytest.approx(0.838, abs=0.03)


def test_a_lattice_too_coarse_for_the_rim_is_told():
    far = Focus(0.85, 5.0, math.inf)
    coarse = dataclasses.replace(HEXAGONAL, pitch_um=0.56)
    phase = design.phase_of(None, far, radius_um=11.0)
    _, quality = design.make(
        phase, far, aperture_um=22.0, cell=coarse, proxy=ROUND, limits=Limits(60, 60)
    )
    assert (
        quality.steepest
        > quality.sampled_aperture
        == pytest.approx(0.85 / (math.sqrt(3) * 0.56))
    )
