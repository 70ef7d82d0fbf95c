"""The factor of unlike neighbours on maps: where the phase has which slope, on which
field, and its derivatives.
"""

import math

import numpy as np
import pytest
import torch

from metalens import psf
from metalens.lens import NeighbourRows
from metalens.psf import neighbour_coupling
from tests.referees import vectorial

WAVE, PITCH = 0.85, 0.4
ROWS = NeighbourRows(
    np.array([0.25, 0.45, 0.6, 0.3, 0.5]),
    np.array([False, False, False, True, True]),
    np.array(
        [
            [0.97 - 0.05j, 0.9 - 0.1j, 0.8 - 0.2j, 0.95 - 0.12j, 0.83 - 0.25j],
            [1.0 - 0.04j, 1.05 - 0.12j, 1.1 - 0.25j, 0.98 - 0.1j, 0.95 - 0.2j],
        ]
    ),
    np.ones((2, 5), complex),
    np.zeros(5),
    WAVE,
)


def grating(sine, azimuth, shape=(23, 31)):
    """Phase that turns light by this sine in this azimuth."""
    y, x = np.indices(shape) * PITCH
    return (
        2 * np.pi / WAVE * sine * (x * math.cos(azimuth) + y * math.sin(azimuth)) + 0.7
    )


def lens(distance=30.0, count=100):
    """Wrapped phase and open pillars of a lens off the middle of its map, and the (x,
    y) sines by which it turns.
    """
    axis = (np.arange(count) - (count - 1) / 2) * PITCH
    x, y = axis - 0.3, (axis + 0.2)[:, None]
    path = np.sqrt(x**2 + y**2 + distance**2)
    phase = np.angle(np.exp(-2j * np.pi / WAVE * path))
    return phase, (np.hypot(x, y) < 18.0).astype(float), (-x / path, -y / path)


@pytest.mark.parametrize("azimuth", [0.0, 0.4, math.pi / 4, 2.0])
def test_a_grating_has_the_factor_of_its_slope_and_azimuth_on_each_field(azimuth):
    """Wrapped, |slope| below pi / pitch; J has the fields along and across the slope as
    its own.
    """
    phase = torch.tensor(np.angle(np.exp(1j * grating(0.41, azimuth))))
    got = neighbour_coupling.apply_jones_coupling(
        phase, torch.full_like(phase, 0.8), ROWS, PITCH
    )
    along, across = ROWS.at(np.array(0.41), azimuth)
    c, s = math.cos(azimuth), math.sin(azimuth)
    assert got.xx.numpy() == pytest.approx(along * c * c + across * s * s, rel=1e-9)
    assert got.yy.numpy() == pytest.approx(along * s * s + across * c * c, rel=1e-9)
    assert got.xy.numpy() == pytest.approx((along - across) * c * s, rel=1e-9, abs=1e-9)
    turned, level = neighbour_coupling.apply_scalar_coupling(
        phase, torch.full_like(phase, 0.8), ROWS, PITCH
    )
    mean = (along + across) / 2
    assert (turned - phase).numpy() == pytest.approx(np.angle(mean), rel=1e-9)
    assert level.numpy() == pytest.approx(0.8 * abs(mean), rel=1e-9)


def about(**more):
    window = dict(
        window_um=9.0,
        samples=36,
        depths_um=[np.inf, 400.0],
        tolerance=1e-5,
        integrate=False,
    )
    return (
        dict(pitch_um=PITCH, wavelength_um=WAVE, sensor_distance_um=30.0)
        | window
        | more
    )


def test_a_psf_with_neighbours_is_that_of_the_maps_with_their_factor():
    """By the lens's own paths: apart are slopes from one side at the rim, 2e-3 of what
    the factor changes there.
    """
    phase, level, sines = lens()
    factor = ROWS.at(np.hypot(*sines), np.arctan2(sines[1], sines[0])).mean(0)
    want = psf.psf_stack(phase + np.angle(factor), level * np.abs(factor), **about())
    got = psf.psf_stack(phase, level, **about(), neighbours=ROWS)
    without = psf.psf_stack(phase, level, **about())
    change = np.linalg.norm(without.intensity - want.intensity)
    assert np.linalg.norm(got.intensity - want.intensity) < 0.02 * change
    assert got.energy_um2 == pytest.approx(want.energy_um2, rel=5e-4)
    assert (got.energy_um2 < 0.97 * without.energy_um2).all()


@pytest.mark.parametrize("kind", ["flux", "vector"])
def test_both_polarisations_with_neighbours_are_those_of_plane_waves(kind):
    """NA 0.51, the fields along and across the slope apart; rays to the window's
    middle: 9 um / distance² of second
    order. The mean of both on both fields alike is farther off."""
    count, distance = 96, 30.0
    axis = (np.arange(count) - (count - 1) / 2) * PITCH
    x, y = axis, axis[:, None]
    path = np.sqrt(x**2 + y**2 + distance**2)
    level = (np.hypot(x, y) < 18.0) * 1.0
    phase = -2 * np.pi / WAVE * (path - distance)
    sines, azimuth = np.hypot(x, y) / path, np.arctan2(y, x)
    along, across = ROWS.at(sines, azimuth)
    c, s = np.cos(azimuth), np.sin(azimuth)
    jones = np.array([[along * c * c + across * s * s, (along - across) * c * s],
                      [(along - across) * c * s, along * s * s + across * c * c]])  # fmt: skip
    turned = vectorial.turned(x, y, distance)
    light = level * np.exp(1j * phase) * np.einsum("pqyx,qcyx->pcyx", jones, turned)
    referee = {"flux": vectorial.flux, "vector": vectorial.image}[kind]
    want = referee(light, step=PITCH, wavelength=WAVE, distance=distance, count=480)[
        38:59, 38:59
    ]
    half = PITCH / 2  # an odd window on an even lattice
    seen = about(
        window_um=21 * PITCH, samples=21, depths_um=[np.inf], offset_um=(half, half)
    )
    got, plain, scalar = (
        psf.psf_stack(phase, level, **seen, neighbours=rows, polarisation=of).intensity[
            0
        ]
        for rows, of in ((ROWS, kind), (None, kind), (ROWS, "scalar"))
    )
    want = want / want.sum()
    error, without, mean = (
        np.linalg.norm(g - want) / np.linalg.norm(want) for g in (got, plain, scalar)
    )
    assert error < 0.3 * without
    assert error < 0.7 * mean


@pytest.mark.parametrize("polarisation", ["scalar", "flux"])
def test_derivatives_by_phases_go_through_the_slopes(polarisation):
    """A saddle on a lens of 40 pillars: the factor's own change is part of it; central
    differences.
    """
    phase, level, _ = lens(distance=14.0, count=40)
    given = dict(
        about(depths_um=[200.0], sensor_distance_um=14.0, window_um=6.0, samples=12),
        polarisation=polarisation,
    )
    weight = torch.linspace(0.2, 1.7, 144, dtype=torch.float64).reshape(12, 12)
    axis = torch.arange(40, dtype=torch.float64) / 20 - 1
    saddle = axis * axis[:, None] + 0.3 * axis**2

    def score(size, rows):
        made = psf.psf_stack(
            torch.tensor(phase) + size * saddle,
            torch.tensor(level),
            **given,
            neighbours=rows,
        )
        return (made.intensity[0] * made.energy_um2[0] * weight).sum()

    found = []
    for rows in (ROWS, None):
        size = torch.tensor(0.4, dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(score(size, rows), size)
        step = 1e-3
        wide = (
            score(torch.tensor(0.4 + step), rows)
            - score(torch.tensor(0.4 - step), rows)
        ) / (2 * step)
        assert float(slope) == pytest.approx(float(wide), rel=1e-4)
        found.append(float(slope))
    assert abs(found[0] - found[1]) > 1e-2 * abs(found[1])
