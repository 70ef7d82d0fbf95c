"""Free-form design: the spline against closed forms, and a short design that beats its
start at the energy asked.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from metalens.core import config
from metalens.core.errors import ConfigError
from metalens.design import profiles
from metalens.design.free_form import FisherSettings
from metalens.design.free_form import search as free
from metalens.design.profiles import Focus
from metalens.image import pupil as pupils
from metalens.image.pupil import Pupil

SMALL = Pupil(radius_um=400.0, nodes=136)
FOCUS = Focus(0.85, 2000.0, 20e3)
QUICK = FisherSettings(
    controls=6, iterations=28, starts=1, focus_mm=(20.0, 20.0)
).about(FOCUS, 400.0)


def test_vortices_carry_their_charges():
    turn = np.linspace(-math.pi, math.pi, 1000, endpoint=False)
    for radius, charge in ((100.0, 1), (390.0, 3)):
        phase = profiles.vortex_phase(
            radius * np.cos(turn), radius * np.sin(turn), radius_um=400.0, zones=2
        )
        winding = np.angle(np.exp(1j * np.diff(phase))).sum() / (2 * math.pi)
        assert winding == pytest.approx(charge, abs=0.01)


def test_a_short_design_gains_information_and_keeps_the_energy():
    flat = torch.zeros(136, 136, dtype=torch.float64)
    before = free.score_phase(flat, SMALL, focus_um=20e3, settings=QUICK)
    made = free.optimize_free_form(SMALL, QUICK)
    assert made.converged
    assert float(made.score.encircled.min()) >= 0.499
    assert float(made.score.information.mean()) > 1.15 * float(
        before.information.mean()
    )


def test_depths_that_no_image_tells_apart_are_worth_the_least_logarithm():
    """A kilometre away images do not change: both terms are the log of the floor of
    1e-4 per mm².
    """
    far = dataclasses.replace(QUICK, depths_mm=(1e6, 2e6))
    flat = torch.zeros(136, 136, dtype=torch.float64)
    loss, _ = free.axial_loss(flat, SMALL, 20e3, far, torch.Generator())
    # 1e-7 of information over the floor
    assert float(loss) == pytest.approx(-math.log(1e-4), abs=1e-3)


def test_the_same_seed_gives_the_same_phase():
    brief = FisherSettings(controls=5, iterations=2, starts=1).about(FOCUS, 400.0)
    assert torch.equal(
        free.optimize_free_form(SMALL, brief).nodes_rad,
        free.optimize_free_form(SMALL, brief).nodes_rad,
    )


def test_the_lens_phase_is_the_designed_one():
    """The function of position gives the phase of the pupil's nodes at their places."""
    quick = FisherSettings(controls=5, iterations=3, starts=1)
    focus = Focus(0.85, 2000.0, 20e3)
    phase, found = free.fisher_profile(focus, radius_um=300.0, settings=quick)
    pupil = free.design_pupil(focus, 300.0, quick.about(focus, 300.0))
    x, y = (axis.numpy() for axis in pupils.coordinates(pupil))
    want = found.nodes_rad.numpy()
    for row, column in ((30, 17), (12, 40)):
        at = x[row, [column]], y[row, [column]]
        base = profiles.hyperbolic_phase(
            *at, dataclasses.replace(focus, source_distance_um=found.focus_um)
        )
        assert (phase(*at) - base).item() == pytest.approx(want[row, column], abs=1e-9)


def test_impossible_wishes_are_refused():
    wishes = (
        "encircled = 1.2",
        "controls = 2",
        "depths_mm = [26.0, 16.0]",
        "pixel_um = 0.0",
        "focus_mm = [9.0, 8.0]",
    )
    for wish in wishes:
        with pytest.raises(ConfigError, match=wish.split(" ")[0]):
            config.loads(wish, FisherSettings)


def test_what_is_left_out_follows_the_lens():
    """The paper's lens as it was; depths scale as the aperture squared, spots as
    wavelength over NA.
    """
    paper = FisherSettings().about(Focus(0.85, 2000.0, 20e3), 500.0)
    assert (paper.depths_mm, paper.focus_mm, paper.radius_um) == (
        (16.0, 26.0),
        (18.0, 22.0),
        18.0,
    )
    assert paper.pixel_um == 3.0
    assert (paper.window_um, paper.climb_window_um, paper.sample_um, paper.step_um) == (
        144.0,
        96.0,
        0.75,
        200.0,
    )
    half = FisherSettings(pixel_um=1.3).about(Focus(0.633, 1500.0, 20e3), 250.0)
    waves = [250.0**2 * abs(1e-3 / z - 1 / 20e3) / (2 * 0.633) for z in half.depths_mm]
    assert waves == pytest.approx([1.75, 1.75], rel=0.08)  # depths of two digits
    assert (
        half.depths_mm[0]
        < half.focus_mm[0]
        < 20.0
        < half.focus_mm[1]
        < half.depths_mm[1]
    )
    assert half.radius_um == pytest.approx(5.3 * 0.633 * 1500 / 250, rel=0.03)
    assert half.sample_um == pytest.approx(1.3 / 4, rel=0.03)
    own = FisherSettings(depths_mm=(7.0, 8.0)).about(Focus(0.85, 2000.0, 20e3), 500.0)
    assert 7.0 < own.focus_mm[0] < own.focus_mm[1] < 8.0
    # holds the blur of a lens for 20 mm
    assert own.window_um > 8 * 500.0 * 2000.0 * (1 / 7e3 - 1 / 20e3) * 0.99


def test_a_fast_lens_is_judged_on_samples_that_hold_its_band():
    """Twice finer samples tell the same: at NA 0.6 samples of 0.75 um, as fit a lens of
    NA 0.24, lost half of it.
    """
    focus, radius = Focus(0.85, 133.0, 2e3), 100.0
    asked = FisherSettings(pixel_um=1.1).about(focus, radius)
    pupil = free.design_pupil(focus, radius, asked)
    flat = torch.zeros(pupil.nodes, pupil.nodes, dtype=torch.float64)
    fine = dataclasses.replace(asked, sample_um=asked.sample_um / 2)
    got, want = (
        free.score_phase(
            flat, pupil, focus_um=2e3, settings=s, depths=3
        ).information.mean()
        for s in (asked, fine)
    )
    # interpolation between samples when pixels are cut
    assert float(got) == pytest.approx(float(want), rel=0.02)


def test_pixels_wider_than_a_spot_are_refused():
    with pytest.raises(ConfigError, match="pixel_um = 40"):
        FisherSettings(pixel_um=40.0).about(Focus(0.85, 2000.0, 20e3), 500.0)
