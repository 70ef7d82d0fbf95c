"""The quick pupil model against closed forms: Airy pattern, energy, tilt direction, and
its own convergence.
"""

import math

import numpy as np
import pytest
import torch
from scipy.special import j1

from metalens.core.errors import PropagationError
from metalens.image import pupil as pupils
from metalens.image.pupil import Pupil

PUPIL = Pupil(nodes=192)
FLAT = torch.zeros(192, 192, dtype=torch.float64)
FOCUS = torch.tensor([20e3], dtype=torch.float64)


def test_in_focus_the_pattern_is_airys():
    image = (
        pupils.psf(
            FLAT, PUPIL, depths_um=FOCUS, focus_um=20e3, sample_um=0.5, samples=65
        )[0]
        .double()
        .numpy()
    )
    s = (np.arange(65) - 32) * 0.5
    v = 2 * math.pi / 0.85 * PUPIL.edge * np.hypot(s[:, None], s) + 1e-9
    airy = (2 * j1(v) / v) ** 2
    error = np.abs(image / image[32, 32] - airy).max()
    assert (
        error < 0.02
    )  # weight 1 / (1 - q²) of the rim: up to 6 % of amplitude, 1.5 % of a side lobe's place


@pytest.mark.parametrize(("nodes", "samples"), [(64, 64), (96, 96), (96, 190)])
def test_a_window_holds_what_a_round_aperture_sends_there(nodes, samples):
    """∫ (2 J1(v) / v)² π (p / λ)², v = k p r: 0.94 to 0.99 of the light in half a
    period of the nodes and in all of it.

    Left are higher powers of p, 0.068 at the rim, and of the window over the period:
    6e-4. Counted by the squares of
    the weights of nodes across the rim the light is 7e-3, 5e-3 and 4e-3 too bright.
    """
    pupil = Pupil(150.0, 2200.0, 0.85, nodes)
    step = pupil.field_step_um / 2
    about = dict(depths_um=FOCUS, focus_um=20e3, sample_um=step, samples=samples)
    light = pupils.psf(torch.zeros(nodes, nodes), pupil, **about)[0].double().sum()
    x = (np.arange(10 * samples) - (10 * samples - 1) / 2) * step / 10
    v = 2 * math.pi / 0.85 * pupil.edge * np.hypot(x, x[:, None])
    want = (
        float(((2 * j1(v) / v) ** 2).sum())
        * (step / 10) ** 2
        * math.pi
        * (pupil.edge / 0.85) ** 2
    )
    assert float(light) / want == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("angle_deg", [0.0, 10.0, 20.0])
def test_the_light_of_the_aperture_is_its_area_from_every_side(angle_deg):
    """Nodes across the rim count by the share of them that is inside: dx dy = d² dq /
    (1 - q²)² sums to π R².
    """
    pupil = Pupil(150.0, 2200.0, 0.85, 128)
    slope = math.tan(math.radians(angle_deg))
    seen = pupils.view_pupil(pupil, pupils.Field(math.radians(angle_deg), 0.4), 20e3)
    away2 = (seen.x_um - 2200 * slope * math.cos(0.4)) ** 2 + (
        seen.y_um - 2200 * slope * math.sin(0.4)
    ) ** 2
    area = float(
        (seen.weight * (1 + away2 / 2200.0**2)).sum()
    )  # the weight has 1 / (1 - q²) once
    dimmed = (
        2
        * math.sqrt(2)
        * 90.0
        / (3 * 2 * math.pi / 0.85 * pupil.edge * pupil.period_um**2)
    )
    assert pupils.aperture_light(pupil, 90.0) == pytest.approx(
        area * (1 - dimmed), rel=3e-4
    )  # of nodes: 128^-1.5 / 3


def test_all_light_of_the_aperture_but_what_its_rim_bends_away_is_counted():
    """4√2 / (π² k p h) of a sharp round rim falls beyond ±h: 1.9e-3 here, in and out of
    focus.
    """
    wide = pupils.psf(
        FLAT,
        PUPIL,
        depths_um=torch.tensor([16e3, 20e3]),
        focus_um=20e3,
        sample_um=0.8,
        samples=420,
    )
    beyond = 4 * math.sqrt(2) / (math.pi**2 * 2 * math.pi / 0.85 * PUPIL.edge * 168)
    assert np.abs(wide.sum((1, 2)).numpy() - 1 + beyond).max() < 2e-4


def test_a_phase_ramp_to_plus_x_moves_the_light_to_plus_x():
    x, _ = pupils.coordinates(PUPIL)
    ramp = 2 * math.pi / 0.85 * x / 2000 * 12.0
    image = pupils.psf(
        ramp, PUPIL, depths_um=FOCUS, focus_um=20e3, sample_um=0.75, samples=128
    )[0]
    row, column = divmod(int(image.argmax()), 128)
    s = (torch.arange(128) - 63.5) * 0.75
    assert abs(s[column] - 12) < 1.0
    assert abs(s[row]) < 1.0


def test_blur_of_defocus_is_the_geometric_disc():
    image = pupils.psf(
        FLAT,
        PUPIL,
        depths_um=torch.tensor([9e3]),
        focus_um=18e3,
        sample_um=0.85,
        samples=380,
    )[0]
    s = (torch.arange(380) - 189.5) * 0.85
    width = math.sqrt(float((image * s[:, None] ** 2).sum() / image.sum()))
    r = np.linspace(0, 500, 4001)
    cosine = 2000 / np.hypot(r, 2000)
    landing = (
        r * (1 / np.hypot(r, 9e3) - 1 / np.hypot(r, 18e3)) * 2000 / cosine**3
    )  # oblique rays land further out
    disc = math.sqrt((landing**2 * r).sum() / r.sum() / 2)
    assert width == pytest.approx(disc, rel=0.02)  # diffraction at the rim


def test_finer_nodes_change_nothing():
    depth = torch.tensor([17.3e3])
    r = pupils.radius(PUPIL)
    finer = Pupil(nodes=320)
    coarse = pupils.psf(2 * torch.cos(r / 150), PUPIL, depths_um=depth, focus_um=20e3)
    fine = pupils.psf(
        2 * torch.cos(pupils.radius(finer) / 150), finer, depths_um=depth, focus_um=20e3
    )
    assert (
        float((coarse - fine).norm() / fine.norm()) < 1e-2
    )  # staircase of the rim cells


def test_a_window_wider_than_the_period_is_refused():
    with pytest.raises(PropagationError, match="nodes"):
        pupils.psf(FLAT, PUPIL, depths_um=FOCUS, focus_um=20e3, samples=2000)
