"""Windows narrower than their PSFs: light from beyond one side must not be shown on the
other.
"""

import math

import pytest
import torch

from metalens.core.errors import PropagationError
from metalens.design import Focus
from metalens.field import Grid, Layers, Optics, SmoothWave, Window, imager, plan
from metalens.field.left_out import Judged, folded
from metalens.field.points import SPARE, psfs
from metalens.field.texture import texture_error
from metalens.psf import SpectralNodes
from tests.referees.true_image import Referee

WAVE = SmoothWave(Focus(0.85, 240.0, 6000.0), 50.0)
OPTICS = Optics(WAVE, Layers(), 240.0)
SAMPLES, STEP_UM = 9, 9.6
PLACE, DEPTH_UM = (240.0 * math.tan(math.radians(40.0)), -7.0), 5200.0


def _psf(window, place=PLACE):
    at, depth = (torch.tensor(a, dtype=torch.float64) for a in ([place], [DEPTH_UM]))
    return psfs(OPTICS, at, depths_um=depth, wavelength_um=0.85, window=window)[
        0
    ].double()


@pytest.fixture(scope="module")
def true():
    """(1, y, x) light on the samples by plane waves, of that on the lens."""
    referee = Referee(
        radius=50.0,
        distance=240.0,
        focus=6000.0,
        design_wavelength=0.85,
        fine=0.3,
        count=1024,
        looked_at=48.0,
    )
    return torch.from_numpy(
        referee.sampled(referee.intensity(PLACE, DEPTH_UM, 0.85), STEP_UM, SAMPLES)
    )[None]


@pytest.fixture(scope="module")
def aside():
    """The image of a camera that looks 40 degrees aside through a lens of 0.1 mm,
    windows of 86 um.
    """
    grid = Grid((3, 5), STEP_UM, (3000.0, 9000.0), margin=SAMPLES // 2, window=SAMPLES)
    return imager(WAVE, grid, field=(math.radians(40.0), 0.0), tolerance=0.1)


def test_psfs_of_an_oblique_camera_hold_their_own_light_alone(true, aside):
    """A fifth of the light lands beyond the window there; 0.02 is what nodes of any
    period differ by from plane waves
    at such an angle (paths of the second order about the field point)."""
    window = aside.plan.window
    assert window.period > SPARE
    assert float(texture_error(_psf(window), true)) < 0.025
    assert float(_psf(window).sum() / true.sum()) == pytest.approx(1.0, abs=0.02)
    assert float(texture_error(_psf(Window(SAMPLES, STEP_UM)), true)) > 0.2


def test_what_is_folded_back_is_the_error_that_plane_waves_find(true):
    window = Window(SAMPLES, STEP_UM)
    at = tuple(torch.tensor(a, dtype=torch.float64) for a in ([PLACE], [DEPTH_UM]))
    waves = SpectralNodes(torch.tensor([0.85]).numpy(), torch.ones(1).numpy(), 0.0)
    told, error = (
        folded(Judged(OPTICS, waves, window, at)),
        float(texture_error(_psf(window), true)),
    )
    assert told == pytest.approx(error, abs=0.03)


def test_the_error_of_an_image_counts_what_is_folded_back(aside):
    """What is left of it lies within its share of the tolerance, 0.24 of 0.1, at the
    places that nobody planned.
    """
    assert 0 < aside.parts["folded"] < 0.024
    assert aside.error >= aside.parts["folded"]
    assert aside.parts["outside"] > 0.2  # 0.07 when light from beyond counted as held


def test_the_rim_of_a_wide_field_is_looked_at_too():
    """Blurs grow towards the rim: with the least period a quarter of a PSF in a corner
    of this field is wrong. Light
    folded back is held to 0.005 over the field, some times that in its corners, where
    other paths err by 0.03."""
    window = imager(
        WAVE, Grid((31, 31), STEP_UM, (3000.0, 9000.0), window=SAMPLES), tolerance=0.02
    ).plan.window
    place = (18 * STEP_UM, -17 * STEP_UM)
    referee = Referee(
        radius=50.0,
        distance=240.0,
        focus=6000.0,
        design_wavelength=0.85,
        fine=0.3,
        count=1024,
        looked_at=48.0,
    )
    light = torch.from_numpy(
        referee.sampled(referee.intensity(place, DEPTH_UM, 0.85), STEP_UM, SAMPLES)
    )[None]
    assert float(texture_error(_psf(window, place), light)) < 0.06
    assert float(texture_error(_psf(Window(SAMPLES, STEP_UM), place), light)) > 0.2


def test_a_period_grows_no_further_than_beyond_four_windows():
    """However little may be folded back: nodes grow with its square."""
    window, waves = (
        Window(SAMPLES, STEP_UM),
        SpectralNodes(torch.tensor([0.85]).numpy(), torch.ones(1).numpy(), 0.0),
    )
    at = (
        torch.tensor([PLACE], dtype=torch.float64),
        torch.tensor([DEPTH_UM], dtype=torch.float64),
    )
    assert plan._unfolded(OPTICS, waves, window, at, 0.0).period == pytest.approx(
        4 * SPARE
    )
    assert plan._unfolded(OPTICS, waves, window, at, 1.0).period == SPARE
    tried = (
        Window(SAMPLES, STEP_UM, period=SPARE * more) for more in (1, 2**0.25, 2**0.5)
    )
    left = [folded(Judged(OPTICS, waves, one, at)) for one in tried]
    for tolerance, more in (
        (0.5 * (left[0] + left[1]), 2**0.25),
        (0.5 * (left[1] + left[2]), 2**0.5),
    ):
        made = plan._unfolded(
            OPTICS, waves, window, at, tolerance
        )  # quarters of an octave
        assert made.period == pytest.approx(SPARE * more, rel=1e-12)


def test_a_period_shorter_than_the_window_is_refused():
    with pytest.raises(
        PropagationError, match=r"a period of 1\.0 windows: need 1\.06 or more"
    ):
        Window(SAMPLES, STEP_UM, period=1.0)
