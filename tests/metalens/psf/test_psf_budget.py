"""The parts of a PSF's error: cells against fine samples, polarisations against plane
waves, light left outside.
"""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens import propagate, psf
from metalens.optics import Layers
from metalens.psf import lens_psfs, spectrum
from tests.referees import vectorial

WAVELENGTH, PITCH = 0.85, 0.3


def lens(distance, count=150, radius=21.0, bend=0.0):
    """Maps that focus collimated light at ``distance``; ``bend`` adds coma."""
    axis = (np.arange(count) - (count - 1) / 2) * PITCH
    x, y = axis, axis[:, None]
    r2 = x**2 + y**2
    phase = (
        -2 * np.pi / WAVELENGTH * r2 / (np.sqrt(r2 + distance**2) + distance)
        + bend * x * r2 / radius**3
    )
    return phase, (np.hypot(x + 0.4, y) < radius).astype(float)


def geometry(distance, **more):
    about = dict(
        pitch_um=PITCH,
        wavelength_um=WAVELENGTH,
        sensor_distance_um=distance,
        depths_um=[np.inf],
    )
    return about | dict(window_um=12.0, samples=16, tolerance=1e-5) | more


def test_a_coarse_window_gives_the_light_on_its_cells():
    """NA 0.55 on steps of 0.75 um: against 9 x 9 samples of the exact sum in every cell
    (midpoint rule: 3e-3).
    """
    maps = lens(32.0, bend=4.0)
    about = geometry(32.0, tolerance=1e-3, window_um=6.0, samples=8)
    stack = psf.psf_stack(*maps, **about)
    exact_about = {n: v for n, v in about.items() if n != "tolerance"} | dict(
        samples=8 * 9
    )
    fine = np.abs(propagate.exact(*maps, **exact_about)[0]) ** 2
    cells = fine.reshape(8, 9, 8, 9).mean((1, 3))
    assert "cells of" in stack.reason
    assert stack.energy_um2[0] == pytest.approx(cells.sum() * 0.75**2, rel=2e-3)
    error = np.linalg.norm(stack.intensity[0] - cells / cells.sum()) / np.linalg.norm(
        cells / cells.sum()
    )
    assert error < stack.budget.sampling + 3e-3
    assert stack.budget.sampling <= 5e-4
    assert stack.error == pytest.approx(
        math.hypot(stack.budget.numerical, stack.budget.sampling)
    )
    assert stack.converged
    plain = psf.psf_stack(*maps, **about, integrate=False)
    assert (
        abs(plain.intensity[0] * plain.energy_um2[0] / 0.75**2 - fine[4::9, 4::9]).max()
        < 1e-3 * fine.max()
    )


@pytest.mark.parametrize("distance", [60.0, 24.0])
def test_both_polarisations_are_those_of_plane_waves(distance):
    """NA 0.33 and 0.66; the direction of a ray is that to the window's middle: 12 um /
    distance of second order.
    """
    phase, level = lens(distance, bend=2.0)
    about = geometry(distance, window_um=31 * PITCH, samples=31)
    stack = psf.psf_stack(phase, level, **about, polarisation="vector", integrate=False)
    axis = (np.arange(150) - 74.5) * PITCH
    field = level * np.exp(1j * phase) * vectorial.turned(axis, axis[:, None], distance)
    # an odd window on an even lattice: the referee's samples lie half a pitch beside
    half = PITCH / 2
    image = vectorial.image(
        field, step=PITCH, wavelength=WAVELENGTH, distance=distance, count=720
    )
    want = image[60:91, 60:91]
    shifted = psf.psf_stack(
        phase,
        level,
        **about,
        polarisation="vector",
        integrate=False,
        offset_um=(half, half),
    )
    got = shifted.intensity[0] / np.linalg.norm(shifted.intensity[0])
    scalar = psf.psf_stack(
        phase, level, **about, integrate=False, offset_um=(half, half)
    ).intensity[0]
    want = want / np.linalg.norm(want)
    error, without = (
        np.linalg.norm(g - want) for g in (got, scalar / np.linalg.norm(scalar))
    )
    assert error < 0.15 * without
    assert stack.energy_um2.shape == (1,)


def test_the_scalar_error_is_of_fourth_order_and_that_of_both_polarisations():
    """Small apertures: 16 times as much at twice the aperture; at NA 0.53 that of the
    flux of a lens in focus.
    """
    assert psf.scalar_error(0.2) / psf.scalar_error(0.1) == pytest.approx(16, rel=0.05)
    about = geometry(33.0, window_um=8.0, samples=48)
    scalar, flux = (
        psf.psf_stack(*lens(33.0), **about, polarisation=of).intensity
        for of in ("scalar", "flux")
    )
    error = np.linalg.norm(scalar - flux) / np.linalg.norm(flux)
    assert error == pytest.approx(
        psf.scalar_error(math.sin(math.atan(21.0 / 33.0))), rel=0.2
    )


@pytest.mark.parametrize(
    ("sine", "angle", "source", "fixed"),
    # light from the side out of focus, aberrated, in focus; steep and aberrated
    [(0.16, (0.18, 0.12), 600.0, True), (0.14, (0.38, -0.1), 400.0, False), (0.3, (0.0, 0.12), 400.0, True),
     (0.4, (-0.2, 0.33), 400.0, False)],
)  # fmt: skip
def test_what_one_scalar_misses_is_below_what_is_said_of_light_from_the_side(
    sine, angle, source, fixed
):
    """The flux of both polarisations (plane waves judge it elsewhere) against the
    scalar, lenses for 400 um on the axis
    or at the angle.

    On the axis apertures alone decide; from the side 1/cos of the rays, which the half
    spread of their sines does not
    know: it is up to forty times below the truth. Ten times the truth is said at most.
    """
    radius, count = 16.0, 96
    distance = radius / math.tan(math.asin(sine))
    axis = (np.arange(count) - (count - 1) / 2) * PITCH * 1.15
    (tx, ty), r2 = np.tan(angle), axis**2 + axis[:, None] ** 2
    cx, cy = (distance * tx, distance * ty) if fixed else (0.0, 0.0)
    sx, sy = (400 * tx, 400 * ty) if fixed else (0.0, 0.0)
    phase = -2 * np.pi / WAVELENGTH * (
        np.sqrt((axis - cx) ** 2 + (axis[:, None] - cy) ** 2 + distance**2)
        + np.sqrt((axis + sx) ** 2 + (axis[:, None] + sy) ** 2 + 400.0**2)
    )  # fmt: skip
    blur = 2 * radius * abs(1 - 400 / source) + (
        0 if fixed else 0.3 * distance * math.hypot(tx, ty)
    )
    about = geometry(
        distance,
        pitch_um=PITCH * 1.15,
        depths_um=[source],
        angle_rad=angle,
        tolerance=1e-5,
    )
    about |= dict(
        window_um=8 + blur,
        samples=int(min(70, (8 + blur) * 4 * sine / WAVELENGTH)),
        integrate=False,
    )
    scalar, both = (
        psf.psf_stack(phase, (r2 < radius**2) * 1.0, **about, polarisation=of).intensity
        for of in ("scalar", "flux")
    )
    true = np.linalg.norm(scalar - both) / np.linalg.norm(both)
    lens = SimpleNamespace(
        layers=Layers(),
        sensor_distance_um=distance,
        wavelength_um=WAVELENGTH,
        diameters=SimpleNamespace(radius_um=radius, pitch_um=0.0),
    )
    said = psf.scalar_error(
        lens_psfs.sine_aperture(lens, angle), lens_psfs.obliquity_variation(lens, angle)
    )
    assert 0.1 * said < true < said


def test_light_beside_the_window_is_said():
    """A window as wide as the first dark ring of a sharp round pupil holds 0.838 of the
    light (Airy).
    """
    distance, radius = 400.0, 21.0
    sine = math.sin(math.atan(radius / distance))
    ring = 0.6098 * WAVELENGTH / sine
    about = geometry(distance, window_um=2 * ring, samples=40, tolerance=1e-4)
    stack = psf.psf_stack(*lens(distance), **about)
    axis = (np.arange(40) - 19.5) / 20
    inside = np.hypot(axis, axis[:, None]) <= 1
    energy = stack.energy_um2[0] * stack.intensity[0][inside].sum()
    # Airy on axis for a lens some 5 zones deep: 1 %; cells at the border of the disc: 1
    # %
    assert energy / (np.pi * radius**2) == pytest.approx(0.838, abs=0.02)
    assert stack.budget.outside == pytest.approx(
        1 - stack.energy_um2[0] / (np.pi * radius**2), abs=5e-3
    )


def test_the_budget_is_kept_in_the_file(tmp_path):
    stack = psf.psf_stack(*lens(90.0), **geometry(90.0))
    made = dataclasses.replace(
        stack.budget, spectrum=3e-3, polarisation=0.02, glass=0.001
    )
    stack = dataclasses.replace(stack, budget=made)
    psf.save(tmp_path / "psf.h5", stack)
    back = psf.load(tmp_path / "psf.h5").budget
    assert (back.spectrum, back.polarisation, back.outside) == (
        3e-3,
        0.02,
        stack.budget.outside,
    )
    assert math.isnan(back.neighbours)
    assert back.total == pytest.approx(math.hypot(back.numerical, 3e-3, 0.02, 0.001))


def test_energies_of_directions_and_depths_compare_through_the_irradiance_of_a_source():
    about = geometry(
        90.0,
        depths_um=[700.0, 1500.0],
        angle_rad=[[0.3, -0.2], [0.0, 0.0]],
        tolerance=1e-3,
    )
    stack = psf.psf_stack(*lens(90.0), **about)
    place = np.array([-700 * np.tan(0.3), 700 * np.tan(0.2), -700.0])
    away = np.linalg.norm(place)
    assert stack.irradiance_per_um2.shape == stack.energy_um2.shape
    assert stack.irradiance_per_um2[0, 0] == pytest.approx(
        700.0 / away / away**2, rel=1e-12
    )
    assert stack.irradiance_per_um2[1, 1] == pytest.approx(1500.0**-2, rel=1e-12)


def test_light_of_a_diode_beyond_the_library_is_told():
    """A line of 20 nm at 850 nm, known to 12 nm below and 17 nm above: two tails of a
    normal distribution.
    """
    diode = spectrum.Source(850.0, 20.0)
    told = spectrum.outside_library_text(diode, (0.838, 0.867))
    deviation = 20.0 / math.sqrt(8 * math.log(2))
    tails = sum(math.erfc(away / deviation / math.sqrt(2)) / 2 for away in (12, 17))
    share, words = told[2:].split(" of the light lies beyond ")
    # two digits; silicon weighs the blue by 4 % more, the red less
    assert float(share) == pytest.approx(tails, rel=0.05)
    assert words.startswith("838 to 867 nm, where the pillars are not known")
    assert spectrum.outside_library_text(diode, (0.8, 0.9)) == ""
    assert spectrum.outside_library_text(diode, (0.85, 0.85)) == ""
    assert spectrum.share_outside_library(diode, (0.838, 0.867)) == pytest.approx(
        tails, rel=0.05
    )  # as above
    assert (
        spectrum.share_outside_library(
            spectrum.SpectralNodes(np.array([0.81]), np.ones(1), 0.0), (0.838, 0.867)
        )
        == 0.0
    )  # refused later


@pytest.mark.parametrize("seed", range(6))
def test_the_estimate_holds_in_single_precision_where_windows_are_dim_or_tiny(seed):
    """Random phases, windows of 1 to 20 samples beside the light, tolerances down to
    1e-6: never below the truth.
    """
    draw = np.random.default_rng(seed)
    phase = draw.uniform(-np.pi, np.pi, (61, 74)).astype(np.float32)
    level = draw.uniform(0.5, 1, phase.shape).astype(np.float32)
    samples = int(draw.integers(1, 20))
    about = geometry(
        draw.uniform(60, 300),
        window_um=draw.uniform(1, 9),
        samples=samples,
        depths_um=[700.0, 2000.0],
    )
    about |= dict(
        offset_um=tuple(draw.uniform(-20, 20, 2)), tolerance=10 ** draw.uniform(-6, -3)
    )
    maps = torch.tensor(phase, requires_grad=True), torch.tensor(level)
    stack = psf.psf_stack(*maps, **about, integrate=False)
    exact_about = {name: value for name, value in about.items() if name != "tolerance"}
    want = (
        np.abs(propagate.exact(phase.astype(float), level.astype(float), **exact_about))
        ** 2
    )
    want /= want.sum((-1, -2), keepdims=True)
    assert np.linalg.norm(
        stack.numpy().intensity - want
    ) <= stack.error * np.linalg.norm(want)
