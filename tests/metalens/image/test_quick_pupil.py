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
    error = abs(image / image[32, 32] - airy).max()
    assert (
        error < 0.02
    )  # weight 1 / (1 - q²) of the rim: up to 6 % of amplitude, 1.5 % of a side lobe's place


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
    assert abs(wide.sum((1, 2)).numpy() - 1 + beyond).max() < 2e-4


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
    # oblique rays land further out
    landing = r * (1 / np.hypot(r, 9e3) - 1 / np.hypot(r, 18e3)) * 2000 / cosine**3
    disc = math.sqrt((landing**2 * r).sum() / r.sum() / 2)
    assert width == pytest.approx(disc, rel=0.02)  # diffraction at the rim


def test_a_window_wider_than_the_period_is_refused():
    with pytest.raises(PropagationError, match="nodes"):
        pupils.psf(FLAT, PUPIL, depths_um=FOCUS, focus_um=20e3, samples=2000)
