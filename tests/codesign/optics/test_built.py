"""PSFs of made lenses on training's samples: against the sum over every pillar, with
all symmetries broken.
"""

import dataclasses

import numpy as np
import pytest
import torch

from characterize.model import as_built
from characterize.model.parameters import PLACE, parameter_vector
from codesign.optics import as_built_lens
from codesign.optics import stack as optics
from codesign.optics.stack import PixelPsfStack
from metalens import psf
from metalens.fabrication import proxy_sensitivity
from tests.codesign import made_lens as m

X = parameter_vector(
    m.TRUE | {"wavelength_nm": 0.7, "stage_zero_um": 50.0, "background_e": 9.0}
)


def _engine(x, settings):
    """The same PSFs from every pillar, integrated over samples whose light is
    low-passed to their grid.
    """
    lens, known = m.small(), m.at_rest(x)
    t = as_built.as_built_transmission(lens, proxy_sensitivity(lens), known)
    samples, window = 8 * 15, 45.0
    found = psf.psf_stack(
        np.angle(t), np.abs(t), pitch_um=0.4, wavelength_um=0.85, depths_um=settings.depths_um.numpy(),
        sensor_distance_um=300.0 + float(known[PLACE["distance_um"]]), window_um=window, samples=samples,
        tolerance=1e-4,
    )  # fmt: skip
    edge = window / (2 * settings.sample_um)
    m_ = np.arange(1, int(edge + 0.5) + 1)
    kept = np.clip(edge - m_ + 0.5, 0, 1) * np.sinc(m_ / window * settings.sample_um)
    place = (np.arange(11) - 5) * settings.sample_um
    fine = (np.arange(samples) - (samples - 1) / 2) * window / samples
    waves = np.cos(2 * np.pi * m_ / window * (place[:, None] - fine)[..., None])
    rows = settings.sample_um / window * (1 + 2 * (waves * kept).sum(-1))
    light = found.energy_um2 / (float((lens.diameters.diameter_um > 0).sum()) * 0.16)
    return PixelPsfStack(
        torch.as_tensor(rows @ (found.intensity * light[:, None, None]) @ rows.T),
        settings.depths_um,
    )


@pytest.mark.parametrize("x", [parameter_vector(), X], ids=["design", "made"])
def test_psfs_agree_with_the_sum_over_every_pillar(x):
    got = as_built_lens.MadeLens(m.small(), m.OPTICS).stack(x)
    want = _engine(x, m.OPTICS)
    # rim cells of the pupil, and light of other orders: 2e-3 on wide lenses
    assert as_built_lens.psf_error(got, want) < 6e-3
    assert (
        got.intensity.sum((1, 2)) / want.intensity.sum((1, 2)) - 1
    ).abs().max() < 0.02  # half a pitch at the rim is 1.3 % of the light
    far = as_built_lens.MadeLens(m.small(), m.OPTICS).stack()
    # the errors of this lens are far above the tolerance
    assert x is not X or as_built_lens.psf_error(far, want) > 0.05


def test_every_pillar_can_be_asked_as_it_was_made():
    """By which the true image of a made lens tells what cells of pillars leave out of
    it.
    """
    known = m.at_rest(X)
    want = as_built.as_built_transmission(
        m.small(), proxy_sensitivity(m.small()), known
    )
    got = (
        as_built_lens.MadeLens(m.small(), m.OPTICS)
        .stack(X)
        .plane.wave.pillar_transmission(0.85, 0.0)
        .numpy()
    )
    # half a step of the table, 5e-6 um of 79 rad/um
    assert abs(got - want).max() < 4e-4


def test_a_tilt_of_the_bias_to_plus_x_moves_the_light_along_x_alone():
    """Phase grows with the diameter: a lens thicker at +x delays the light there and
    bends it to +x.
    """
    settings = dataclasses.replace(m.OPTICS, window_samples=15)
    light = (
        as_built_lens.MadeLens(m.small(), settings)
        .stack(parameter_vector({"bias_x_nm": 10.0}))
        .intensity.double()
    )
    axis = (torch.arange(15, dtype=torch.float64) - 7) * 3.0
    x, y = ((light.sum(d) * axis).sum(1) / light.sum((1, 2)) for d in (1, 2))
    # rad at the rim: phase is 3 turns over 0.24 um of diameter ...
    slope = 3 * np.pi * 2 / 0.24 * 10e-3 / 2
    expected = slope / 60.0 / (2 * np.pi / 0.85) * 300.0
    assert abs(y).max() < 0.02
    assert x.min() > 0.3 * expected > 0


def test_only_what_the_lens_keeps_enters():
    bench = parameter_vector(
        {
            "stage_zero_um": 300.0,
            "wavelength_nm": 2.0,
            "crosstalk_px": 1.0,
            "log_gain": 3.0,
        }
    )
    made_lens = as_built_lens.MadeLens(m.small(), m.OPTICS)
    assert torch.equal(made_lens.stack(bench).intensity, made_lens.stack().intensity)


def test_draws_of_the_posterior_have_its_covariance_and_come_from_their_seed():
    built = m.asbuilt(sigma=0.5)
    draws, again = (
        np.array([built.parameters(row) for row in built.lens_samples(400, seed=3)])
        for _ in range(2)
    )
    assert np.array_equal(draws, again)
    bias = draws[:, PLACE["bias_nm"]]
    assert abs(bias.mean() - 6.0) < 4 * 0.5 / 20
    assert abs(bias.std() - 0.5) < 4 * 0.5 / np.sqrt(800)


def test_the_design_matches_the_smooth_lens_of_training():
    """Pillars against the phase they were made for: two ways to the same samples."""
    got = as_built_lens.MadeLens(m.small(), m.OPTICS).stack()
    want = optics.lens_psf_stack(m.OPTICS, torch.zeros(0))
    # the grids of both windows cut the band at different harmonics
    assert as_built_lens.psf_error(got, want) < 0.25
