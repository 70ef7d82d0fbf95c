"""What is no lens, no window and no tolerance is refused in words, by name, before
anything is computed.
"""

import numpy as np
import pytest
import torch

from metalens import psf
from metalens.cell import Film, Index
from metalens.core.errors import PropagationError, SceneError
from metalens.field import Grid, imager
from metalens.lens import Layers, media
from metalens.psf.spectrum import read_measured_spectrum

PHASE = np.random.default_rng(2).uniform(0, 6, (12, 15))
ABOUT = dict(
    pitch_um=0.41,
    wavelength_um=0.87,
    sensor_distance_um=21.0,
    depths_um=[190.0],
    window_um=5.0,
    samples=9,
)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (
            dict(tolerance=np.inf),
            "tolerance is inf, need a relative error above 0 and below 1",
        ),
        (dict(tolerance=3.0), "tolerance is 3.0"),
        (
            dict(samples=9.5),
            "samples = 9.5: need a number or a pair .x, y. of each, samples whole",
        ),
        (
            dict(angle_rad=np.zeros((0, 2))),
            "angle_rad of shape .0, 2.: need one direction",
        ),
        (dict(wavelength_um=[]), "wavelength_um is empty"),
        (
            dict(depths_um=[[190.0, 230.0]]),
            "depths_um of shape .1, 2., offset_um of .2,.: need .depth,. and a pair",
        ),
        (dict(offset_um=1.5), "offset_um of ..: need"),
        (dict(offset_um=(1.5,)), "offset_um of .1,.: need"),
    ],
)
def test_arguments_that_mean_nothing(more, words):
    with pytest.raises(PropagationError, match=words):
        psf.psf_stack(PHASE, np.ones((12, 15)), **ABOUT | more)


@pytest.mark.parametrize(
    ("phase", "level", "words"),
    [
        (
            PHASE,
            np.ones((3, 15)),
            "phase_rad of shape .12, 15., transmission of .3, 15.: need .…, y, x. of both",
        ),
        (PHASE[0], np.ones(15), "phase_rad of shape .15,.,"),
        (PHASE[None][:0], np.ones((0, 12, 15)), "phase_rad of shape .0, 12, 15."),
        (PHASE, np.ones((2, 12, 15)), "transmission of .2, 12, 15."),
        (
            PHASE.astype("f2"),
            np.ones((12, 15)),
            "phase_rad is torch.float16, need float32 or float64",
        ),
    ],
)
def test_maps_that_are_no_lens(phase, level, words):
    with pytest.raises(PropagationError, match=words):
        psf.psf_stack(phase, level, **ABOUT)


@pytest.mark.parametrize(
    ("waves", "weights", "words"),
    [
        ([], [], "wavelengths_um is .., need one wavelength above 0 or more"),
        ([0.85, np.nan], [0.4, 0.6], r"wavelengths_um is \[0\.85, nan\]"),
        ([0.84, 0.87], [1.0], r"2 wavelengths with weights \[1\.0\], need"),
        ([0.84, 0.87], [1.3, -0.3], r"weights \[1\.3, -0\.3\]"),
        (
            [0.84, 0.87],
            [0.4, 1.4],
            "need one of 0 or more each, sum 1",
        ),  # an image of 1.8 times the light
    ],
)
def test_wavelengths_that_are_no_spectrum(waves, weights, words):
    with pytest.raises(PropagationError, match=words):
        psf.SpectralNodes(np.array(waves), np.array(weights), 0.0)


@pytest.mark.parametrize("spectrum", [None, psf.Source(850.0, 10.0)])
@pytest.mark.parametrize("tolerance", [0.0, -1e-3, 2.0, np.nan])
def test_no_lens_is_looked_at_to_such_a_tolerance(spectrum, tolerance):
    """Below 0 its square would be that of a tolerance; a spectrum would ask for
    wavelengths first.
    """
    with pytest.raises(
        PropagationError,
        match=f"tolerance is {tolerance}, need a relative error above 0",
    ):
        psf.from_lens(None, psf.View((400.0,)), tolerance=tolerance, spectrum=spectrum)


@pytest.mark.parametrize("spectrum", [None, psf.Source(850.0, 10.0)])
def test_no_lens_is_looked_at_from_nowhere(spectrum):
    with pytest.raises(
        PropagationError, match="angles_rad is empty, need one direction"
    ):
        psf.from_lens(None, psf.View((400.0,), ()), spectrum=spectrum)


def test_curves_of_no_file():
    with pytest.raises(PropagationError, match="spectrum: no file"):
        read_measured_spectrum([], within_um=(0.8, 0.9))


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (dict(field=(0.0, np.pi / 2)), "field of .0.0, 1.57.* rad, need angles"),
        (dict(field=(np.nan, 0.1)), "field of .nan"),
        (
            dict(polarisation="circular"),
            "polarisation = 'circular': need one of scalar, flux, vector, auto",
        ),
    ],
)
def test_images_of_no_field(more, words):
    with pytest.raises(SceneError, match=words):
        imager(None, Grid((7, 5), 4.8, (600.0, 900.0), margin=3, window=7), **more)


@pytest.mark.parametrize("polarisation", ["scalar", "flux"])
def test_second_derivatives(polarisation):
    phase = torch.from_numpy(PHASE).requires_grad_()
    stack = psf.psf_stack(phase, np.ones((12, 15)), polarisation=polarisation, **ABOUT)
    seen = stack.intensity[0, 4, 2] + 1e-3 * stack.energy_um2.sum()
    assert float(torch.autograd.grad(seen, phase, retain_graph=True)[0].abs().max()) > 0
    with pytest.raises(
        PropagationError,
        match="second derivatives of sums over pillars are not known: leave create",
    ):
        torch.autograd.grad(seen, phase, create_graph=True)


def test_one_transmission_serves_a_batch_of_lenses():
    both = psf.psf_stack(np.stack([PHASE, -PHASE]), np.ones((12, 15)), **ABOUT)
    one = psf.psf_stack(-PHASE, np.ones((12, 15)), **ABOUT)
    assert both.intensity[1] == pytest.approx(one.intensity, rel=1e-12)


def test_films_without_a_gap_refuse_rays_beyond_the_critical_angle_by_name():
    """Glass from pillars to sensor under a cover of air: rays with n sin θ above 1, 40
    degrees in 1.55, leave no
    pillar."""
    level, angle = np.ones((41, 41)), (0.0, 0.9)
    about = ABOUT | {
        "tolerance": 1e-3,
        "layers": Layers(behind=(Film(Index(1.55), 21.0),)),
    }
    assert np.isfinite(
        psf.psf_stack(0 * level, level, **about).intensity
    ).all()  # n sin θ of the rim 0.7
    with pytest.raises(
        PropagationError,
        match=r"the films fill .*n sin θ = 1\.\d+ .*cover of index 1: need a gap",
    ):
        psf.psf_stack(0 * level, level, angle_rad=angle, **about)
    gap = about | {"layers": Layers(behind=(Film(Index(1.55), 20.0),))}
    assert np.isfinite(
        psf.psf_stack(0 * level, level, angle_rad=angle, **gap).intensity
    ).all()


def test_no_power_passes_a_face_beyond_its_critical_angle():
    w = np.array([0.0, 0.9**2, 1.0, 1.2**2])
    for power in media.passed_apart((1.0, 1.55), w):
        assert power[0] == pytest.approx(4 * 1.55 / 2.55**2)
        assert power[1] > 0.5
        assert power[2:].tolist() == [0.0, 0.0]
