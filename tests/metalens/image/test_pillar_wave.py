"""Pillars as the image sees them: against the PSFs summed over every pillar, and their
gradient against differences.
"""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.cell import Cell, Index
from metalens.cell.shapes.straight import Rectangle
from metalens.core.errors import SceneError
from metalens.design import Focus, profiles
from metalens.image import Grid, Optics, PillarWave, Window, imager, model_error, psfs
from metalens.image.texture import texture_error
from metalens.lens import DiameterMap, Lens, NeighbourRows
from metalens.optics import Layers
from metalens.psf import View, from_lens, integrate_pixels
from tests.proxies import proxy_of

PITCH, DISTANCE, FOCUS, STEP, SAMPLES = 0.4, 240.0, 6000.0, 4.8, 15
PROXY = proxy_of([6.0, 3.2 * math.pi], [0.9, -0.03], (0.08, 0.32), 0.85, 1e-6)


@pytest.fixture(scope="module")
def lens():
    x = (np.arange(251) - 125) * PITCH
    focus = Focus(0.85, DISTANCE, FOCUS)
    wanted = np.remainder(
        profiles.hyperbolic_phase(x, x[:, None], focus) - 0.2, 2 * math.pi
    )
    # into the range of the proxy
    wanted += 2 * math.pi * np.ceil((6.0 - 3.2 * math.pi - wanted) / (2 * math.pi))
    diameter = 0.2 + 0.12 * (wanted - 6.0) / (3.2 * math.pi)
    diameter = np.where(np.hypot(x, x[:, None]) <= 50.0, diameter, 0.0)
    cell = Cell(pitch_um=PITCH, pillar=Index(3.6), substrate=Index(1.45))
    return Lens(
        DiameterMap(diameter, PITCH), cell, PROXY, 0.85, DISTANCE, FOCUS, "hyperbolic"
    )


@pytest.mark.parametrize("angle", [0.0, 9.0])
def test_psfs_of_gathered_pillars_are_those_of_all_pillars(lens, angle):
    """Both twice averaged over squares of a sample; apart: cells of 2.5 um, rim, light
    folded back (1 % each).
    """
    tilt, fine = (math.radians(angle), math.radians(-0.4 * angle)), 9
    wide = SAMPLES + 4
    made = from_lens(
        lens, View((4000.0,), (tilt,), wide * STEP, wide * fine), tolerance=1e-4
    )
    light = torch.as_tensor(made.intensity[0, 0] * made.energy_um2[0, 0]).double() / (
        math.pi * 50.0**2
    )
    box = torch.ones(1, 1, fine, fine, dtype=torch.float64) / fine**2
    smooth = torch.nn.functional.conv2d(light[None, None], box, padding=fine // 2)[0, 0]
    want = integrate_pixels(smooth, STEP / fine, pitch_um=STEP)[2:-2, 2:-2]
    at = torch.tensor([[DISTANCE * math.tan(t) for t in tilt]], dtype=torch.float64)
    optics = Optics(PillarWave(lens), Layers(), DISTANCE)
    got = psfs(
        optics,
        at,
        depths_um=torch.tensor([4e3]),
        wavelength_um=0.85,
        window=Window(SAMPLES, STEP),
    )[0, 0]
    assert float(texture_error(got.double(), want)) < 3e-2
    assert float(got.sum() / want.sum()) == pytest.approx(1, abs=2.5e-2)
    said = model_error.gathering_error(
        optics, 0.85, Window(SAMPLES, STEP), (at, torch.tensor([4e3]))
    )
    true = float(texture_error(got.double() / got.sum(), want / want.sum()))
    # 3e-3; either reference errs by 1e-3 to 2e-3 of what it samples
    assert 0.5 * true < said < 2 * true


ROWS = NeighbourRows(
    np.array([0.1, 0.22, 0.16]),
    np.array([False, False, True]),
    np.array(
        [[0.95 - 0.2j, 0.8 - 0.5j, 0.9 - 0.3j], [1.0 - 0.1j, 0.9 - 0.3j, 0.95 - 0.25j]]
    ),
    np.ones((2, 3), complex),
    np.zeros(3),
    0.85,
)


def test_the_image_holds_the_neighbours_that_the_lens_holds(lens):
    """As without them: cells, rim, light folded back; a tenth of what they change."""
    test_psfs_of_gathered_pillars_are_those_of_all_pillars(
        replace(lens, neighbours=ROWS), 9.0
    )
    at = torch.tensor([[31.0, -7.0]], dtype=torch.float64)
    few = torch.tensor([4e3])
    with_, without = (
        psfs(
            Optics(PillarWave(one), Layers(), DISTANCE),
            at,
            depths_um=few,
            wavelength_um=0.85,
            window=Window(9, STEP),
        )
        for one in (replace(lens, neighbours=ROWS), lens)
    )
    assert float(with_.sum() / without.sum()) < 0.95


def test_the_gradient_to_a_pillar_is_that_of_differences_with_neighbours(lens):
    """Growing a patch changes slopes at its edge as well."""
    _differentiates(replace(lens, neighbours=ROWS))


def test_the_gradient_to_a_pillar_is_that_of_differences(lens):
    _differentiates(lens)


def _differentiates(lens):
    diameter = torch.from_numpy(lens.diameters.diameter_um).clone()
    diameter = torch.where(diameter > 0, diameter.clamp(0.082, 0.318), 0.0)
    at = torch.tensor([[12.0, -7.0]], dtype=torch.float64)
    window = Window(9, STEP)
    weight = torch.linspace(0.3, 1.9, 81).reshape(9, 9)
    step = torch.zeros_like(diameter)
    # a patch beside the axis grows
    step[150:200, 90:170] = (diameter[150:200, 90:170] > 0) * 1e-3

    def score(d):
        optics = Optics(PillarWave(lens, diameter_um=d), Layers(), DISTANCE)
        light = psfs(
            optics, at, depths_um=torch.tensor([4e3]), wavelength_um=0.85, window=window
        )[0, 0]
        return (light * weight).double().sum()

    leaf = diameter.clone().requires_grad_()
    (slope,) = torch.autograd.grad(score(leaf), leaf)
    with torch.no_grad():
        wide = 0.5 * (score(diameter + step) - score(diameter - step))
    # the value reads one cell in two of a line, the slope their mean: 5 % at a patch of
    # 20 um
    assert float((slope * step).sum()) == pytest.approx(float(wide), rel=8e-2)


def test_an_image_through_pillars_of_two_sizes_is_refused_with_what_knows_them(lens):
    """Not for its lattice, which is square, nor for turns that it has not."""
    sizes = replace(lens.diameters, length_um=lens.diameters.diameter_um * 1.2)
    paired = SimpleNamespace(
        diameters=sizes, pairs=object(), cell=lens.cell, one_light="", hand=""
    )
    with pytest.raises(
        SceneError, match=r"pillars of two sizes .* metalens psf LENS --light x"
    ) as refused:
        PillarWave(paired)
    assert "lattice" not in str(refused.value)


def test_other_orders_are_weak_and_sum_to_less_than_the_light(lens):
    shares = PillarWave(lens).orders(0.85, (-1, 0, 1, 2))
    assert 0.76 < shares[1] < 0.87  # |t|² of 0.87² to 0.93²
    assert 0 < sum(v for m, v in shares.items() if m != 1) < 0.05


def test_an_imager_of_a_lens_file_carries_its_stray_light(lens):
    made = imager(lens, Grid((8, 8), STEP, (3e3, 6e3), window=SAMPLES), tolerance=5e-2)
    assert made.stray is not None
    assert set(made.stray.shares) == {-1, 0, 2, 3}


def test_pillars_that_answer_x_and_y_apart_are_no_unpolarised_image(lens):
    """A rectangle's proxy is of light along x (or the mean at angles): the image of
    both polarisations is refused.
    """
    oblong = replace(lens, cell=replace(lens.cell, shape=Rectangle(ratio=0.6)))
    with pytest.raises(SceneError, match="the lens knows light along x alone"):
        PillarWave(oblong)
    angled = replace(oblong, proxy=replace(PROXY, max_angle_rad=0.3))
    with pytest.raises(SceneError, match="the mean of both polarisations"):
        PillarWave(angled)
    PillarWave(replace(lens, cell=replace(lens.cell, shape=Rectangle(ratio=1.0))))
