"""Both polarisations in the image: their flux and |E|² against plane waves, and how
many components are imaged.
"""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from metalens.design import Focus
from metalens.image import Frames, Grid, Optics, SmoothWave, Window, imager, psfs
from metalens.image.rays import Rays, polarisation_factors
from metalens.image.texture import texture_error
from metalens.optics import Layers
from metalens.psf import (
    VectorPupil,
    dominant_components,
    of_flux,
    transmitted_polarization,
)

sys.path.insert(0, str(Path(__file__).parents[2]))
from referees.true_image import Referee

# NA 0.38
RADIUS, DISTANCE, FOCUS, STEP, WINDOW, WAVE = (25.0, 60.0, 5000.0, 1.2, 21, 0.85)
LENS = SmoothWave(Focus(WAVE, DISTANCE, FOCUS), RADIUS)
OPTICS = Optics(LENS, Layers(), DISTANCE)
REFEREE = Referee(
    radius=RADIUS,
    distance=DISTANCE,
    focus=FOCUS,
    design_wavelength=WAVE,
    fine=0.3,
    count=320,
)
GRID = Grid((5, 7), STEP, (2000.0, 4000.0), window=WINDOW)
MIDDLE = (8.0, -4.5)


def _psf(optics, place, depth, components, *, flux):
    at = torch.tensor([place], dtype=torch.float64)
    depths = torch.tensor([depth])
    window = Window(WINDOW, STEP, True, components, flux)
    light = psfs(optics, at, depths_um=depths, wavelength_um=WAVE, window=window)[
        0, 0
    ].double()
    return light / light.sum()


def _true(referee, kind, place, depth):
    want = torch.from_numpy(
        referee.sampled(getattr(referee, kind)(place, depth, WAVE), STEP, WINDOW).copy()
    )
    return want / want.sum()


@pytest.mark.parametrize(
    ("place", "depth"), [((9.3, -3.9), 3000.0), ((0.0, 0.0), 900.0)]
)
@pytest.mark.parametrize(("kind", "whole"), [("flux", 4), ("polarised", 6)])
def test_psfs_of_both_polarisations_are_those_of_plane_waves(place, depth, kind, whole):
    """In focus and far out of it. Apart: light that the rim bends out of the window and
    the fold takes back, 4e-3.
    """
    want, other = (
        _true(REFEREE, name, place, depth)
        for name in (kind, "polarised" if kind == "flux" else "flux")
    )
    got = _psf(OPTICS, place, depth, whole, flux=kind == "flux")
    error = float(texture_error(got, want))
    assert error < 6e-3
    three = _psf(OPTICS, place, depth, 3, flux=kind == "flux")
    # what three components leave
    assert float(texture_error(three, want)) < error + 1.5e-3
    scalar = float(texture_error(_psf(OPTICS, place, depth, 0, flux=True), want))
    if kind == "flux":
        assert scalar < error + 1e-3  # the scalar is the flux to the fourth order in NA
        assert float(texture_error(got, other)) > 1.8 * error
    else:
        assert scalar > 1.8 * error


@pytest.mark.parametrize(
    ("slope", "towards"),
    [((0.0, 0.0), (0.0, 0.0)), ((0.3, -0.2), (-0.1, 0.4)), ((0.5, 0.4), (0.5, 0.4))],
)
def test_the_power_through_the_plane_is_what_left_the_lens(slope, towards):
    """A plane wave at any angle: S_z of light whose power along z is 1 is 1 for each
    polarisation, |E|² 1 / cos θ.
    """
    a, b = (
        torch.tensor([x, y, math.sqrt(1 - x * x - y * y)], dtype=torch.float64)
        for x, y in (slope, towards)
    )
    electric = transmitted_polarization(a, b)
    fields = of_flux(electric, b)
    signs = torch.tensor(fields.signs, dtype=torch.float64)
    assert float(signs @ fields.pupils**2) == pytest.approx(2, rel=1e-12)
    assert float((electric**2).sum()) == pytest.approx(2 / float(b[2]), rel=1e-12)


def test_a_pixel_counts_flux_and_an_image_says_what_one_scalar_misses_of_it():
    """Points, each through its own PSF of plane waves. They show more of the high
    frequencies than the texture of the
    stated error: 2.5 times it. |E|² lies otherwise."""
    light = np.zeros(GRID.samples)
    light[1, 5], light[3, 1], light[2, 2], light[2, 4] = 6.3, 2.9, 3.7, 1.1
    depth = np.broadcast_to(np.linspace(2300.0, 3700.0, 7), GRID.samples)
    seen, cover, far = (
        torch.from_numpy(np.stack([near, whole])[None])
        for near, whole in (
            (0 * light, light),
            (0 * light, 0 * light + 1),
            (depth, depth),
        )
    )
    about = {"step": STEP, "window": WINDOW, "waves": [(WAVE, 1.0)], "middle": MIDDLE}
    flux, energy = (
        REFEREE.image(light, depth, psf=of, **about)
        for of in (REFEREE.flux, REFEREE.polarised)
    )
    field = math.atan(MIDDLE[0] / DISTANCE), math.atan(MIDDLE[1] / DISTANCE)
    images = {}
    wanted = {"auto": flux, "flux": flux, "vector": energy}.items()
    for polarisation, want in wanted:
        made = imager(
            LENS, GRID, tolerance=5e-3, field=field, polarisation=polarisation
        )
        images[polarisation] = got = made(Frames(seen, cover, far))[0].numpy()
        assert np.linalg.norm(got - want) / np.linalg.norm(want) < 2.5 * made.error
        assert (made.plan.window.components > 0) == (polarisation != "auto")
        assert made.parts["polarisation"] < 2e-3  # of the scalar at NA 0.38 too
    # 1e-2 of the image: what a choice of one for the other would miss
    apart = energy - flux
    assert np.linalg.norm(
        images["vector"] - images["flux"] - apart
    ) < 0.4 * np.linalg.norm(apart)
    assert images["flux"].sum() == pytest.approx(flux.sum(), rel=1e-2)


def test_mixtures_of_the_components_image_as_the_components_do():
    """Six transforms of Ex, Ey, Ez of both polarisations, added, against six mixtures;
    the light is kept.
    """
    draw = torch.Generator().manual_seed(3)
    weight = torch.rand(9, 11, generator=draw, dtype=torch.float64)
    light = weight * torch.exp(
        7j * torch.rand(9, 11, generator=draw, dtype=torch.float64)
    )
    p = torch.linspace(-0.5, 0.6, 11, dtype=torch.float64).expand(9, 11)
    q = torch.linspace(-0.6, 0.4, 9, dtype=torch.float64)[:, None].expand(9, 11)
    slope = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64)
    parts = transmitted_polarization(
        slope / slope.norm(), torch.stack([p, q, torch.sqrt(1 - p**2 - q**2)])
    )
    plain = (torch.fft.fft2(light * parts).abs() ** 2).sum(0)
    made = dominant_components(VectorPupil(parts, (1.0,) * 6), weight, 6)
    assert set(made.signs) == {1.0}
    mixed = (torch.fft.fft2(light * made.pupils).abs() ** 2).sum(0)
    assert torch.allclose(
        mixed / mixed.sum(), plain / plain.sum(), rtol=1e-9, atol=1e-12
    )
    # Parseval
    assert float(mixed.sum()) == pytest.approx(99 * float((weight**2).sum()), rel=1e-12)
    few = dominant_components(VectorPupil(parts, (1.0,) * 6), weight, 2)
    assert float(((few.pupils * weight) ** 2).sum()) == pytest.approx(
        float((weight**2).sum()), rel=1e-12
    )


def test_the_gradient_of_both_polarisations_is_that_of_differences():
    weight = torch.linspace(0.3, 1.9, WINDOW**2).reshape(WINDOW, WINDOW)
    window = replace(Window(WINDOW, STEP), components=3)

    def score(c):
        added = replace(
            LENS,
            added_rad=lambda x, y: c[0] * (x / RADIUS) ** 3 + c[1] * x * y / RADIUS**2,
        )
        at = torch.tensor([[0.7, -0.5]], dtype=torch.float64)
        depths = torch.tensor([4000.0])
        light = psfs(
            Optics(added, Layers(), DISTANCE),
            at,
            depths_um=depths,
            wavelength_um=WAVE,
            window=window,
        )
        return (light[0, 0] * weight).double().sum()

    at = torch.tensor([1.3, -0.8], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(score(at), at)
    step = 1e-2 * torch.eye(2, dtype=torch.float64)
    with torch.no_grad():
        wide = torch.stack([score(at + s) - score(at - s) for s in step]) / 2e-2
    # float32, steps of 1e-2
    assert torch.allclose(slope, wide, rtol=5e-3, atol=5e-3 * float(wide.abs().max()))


@pytest.mark.parametrize("order", [(1.0, 1.5), (1.6, 1.0, 1.3)])
def test_nodes_beyond_the_rim_and_beyond_grazing_have_finite_fields(order):
    """No light is on them, but 0 times nan would be in every sum; those that pass carry
    a flux of 1 a polarisation,
    near the normal, where s and p are alike to p²."""
    none = torch.zeros(0)
    aside = torch.linspace(-1.4, 1.4, 29, dtype=torch.float64)
    middle = torch.tensor([0.2, -0.1], dtype=torch.float64)
    rays = Rays(none, none, none, none, none, none, aside, middle, none, none)
    found = polarisation_factors(
        rays, torch.tensor([0.1, 0.3], dtype=torch.float64), order, flux=True
    )
    assert torch.isfinite(found.pupils).all()
    signs = torch.tensor(found.signs)[:, None, None]
    flux = (signs * found.pupils**2).sum(0)
    away = torch.hypot(aside[:, None] + middle[1], aside + middle[0])
    torch.testing.assert_close(
        flux[away < 0.1], torch.full_like(flux[away < 0.1], 2.0), rtol=2e-3, atol=0
    )
    assert (away < 0.1).sum() >= 2
