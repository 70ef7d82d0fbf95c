"""What is no lens, no window and no tolerance is refused in words, by name, before anything is computed."""

import numpy as np
import pytest

from metalens import psf
from metalens.cell import Film, Index
from metalens.ground.errors import PropagationError
from metalens.lens import Layers, media

PHASE = np.random.default_rng(2).uniform(0, 6, (12, 15))
ABOUT = dict(pitch_um=0.41, wavelength_um=0.87, sensor_distance_um=21.0, depths_um=[190.0], window_um=5.0, samples=9)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (dict(tolerance=np.inf), "tolerance is inf, need a relative error above 0 and below 1"),
        (dict(tolerance=3.0), "tolerance is 3.0"),
        (dict(samples=9.5), "samples = 9.5: need a number or a pair .x, y. of each, samples whole"),
        (dict(angle_rad=np.zeros((0, 2))), "angle_rad of shape .0, 2.: need one direction"),
        (dict(wavelength_um=[]), "wavelength_um is empty"),
        (dict(depths_um=[[190.0, 230.0]]), "depths_um of shape .1, 2., offset_um of .2,.: need .depth,. and a pair"),
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
        (PHASE, np.ones((3, 15)), "phase_rad of shape .12, 15., transmission of .3, 15.: need .…, y, x. of both"),
        (PHASE[0], np.ones(15), "phase_rad of shape .15,.,"),
        (PHASE[None][:0], np.ones((0, 12, 15)), "phase_rad of shape .0, 12, 15."),
        (PHASE, np.ones((2, 12, 15)), "transmission of .2, 12, 15."),
        (PHASE.astype("f2"), np.ones((12, 15)), "phase_rad is torch.float16, need float32 or float64"),
    ],
)
def test_maps_that_are_no_lens(phase, level, words):
    with pytest.raises(PropagationError, match=words):
        psf.psf_stack(phase, level, **ABOUT)


def test_one_transmission_serves_a_batch_of_lenses():
    both = psf.psf_stack(np.stack([PHASE, -PHASE]), np.ones((12, 15)), **ABOUT)
    one = psf.psf_stack(-PHASE, np.ones((12, 15)), **ABOUT)
    assert both.intensity[1] == pytest.approx(one.intensity, rel=1e-12)


def test_films_without_a_gap_refuse_rays_beyond_the_critical_angle_by_name():
    """Glass from pillars to sensor under a cover of air: rays with n sin θ above 1, 40 degrees in 1.55, leave no
    pillar."""
    level, angle = np.ones((41, 41)), (0.0, 0.9)
    about = ABOUT | {"tolerance": 1e-3, "layers": Layers(behind=(Film(Index(1.55), 21.0),))}
    assert np.isfinite(psf.psf_stack(0 * level, level, **about).intensity).all()  # n sin θ of the rim 0.7
    with pytest.raises(PropagationError, match=r"the films fill .*n sin θ = 1\.\d+ .*cover of index 1: need a gap"):
        psf.psf_stack(0 * level, level, angle_rad=angle, **about)
    gap = about | {"layers": Layers(behind=(Film(Index(1.55), 20.0),))}
    assert np.isfinite(psf.psf_stack(0 * level, level, angle_rad=angle, **gap).intensity).all()


def test_no_power_passes_a_face_beyond_its_critical_angle():
    w = np.array([0.0, 0.9**2, 1.0, 1.2**2])
    for power in media.passed_apart((1.0, 1.55), w):
        assert power[0] == pytest.approx(4 * 1.55 / 2.55**2)
        assert power[1] > 0.5
        assert power[2:].tolist() == [0.0, 0.0]
