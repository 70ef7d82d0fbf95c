"""Free-form design: the spline against closed forms, and a short design that beats its start at the energy asked."""

import math

import numpy as np
import pytest
import torch

from metalens import config
from metalens import design_fisher as free
from metalens.design_fisher import Fisher
from metalens.errors import ConfigError
from metalens.profiles import Focus
from metalens.pupil import Pupil

SMALL = Pupil(radius_um=400.0, nodes=136)
QUICK = Fisher(grids=(6, 10), iterations=28, starts=1, zones=(2,), focus_mm=(20.0, 20.0))


def test_spline_makes_constants_lines_and_is_smooth():
    x = np.linspace(-1, 1, 401)
    weights = free.spline(x, 9)
    assert np.abs(weights.sum(1) - 1).max() < 1e-14
    line = weights @ (np.arange(9) - 4.0)  # linear coefficients make a straight line
    assert np.abs(np.diff(line, 2)).max() < 1e-12
    bump = free.spline(x, 9) @ np.eye(9)[4]
    assert np.abs(np.diff(bump, 3)).max() < 1e-3  # second derivative continuous


def test_vortices_carry_their_charges():
    turn = np.linspace(-math.pi, math.pi, 1000, endpoint=False)
    for radius, charge in ((100.0, 1), (390.0, 3)):
        phase = free.vortices(radius * np.cos(turn), radius * np.sin(turn), radius_um=400.0, zones=2)
        winding = np.angle(np.exp(1j * np.diff(phase))).sum() / (2 * math.pi)
        assert winding == pytest.approx(charge, abs=0.01)


def test_a_short_design_gains_information_and_keeps_the_energy():
    flat = torch.zeros(136, 136, dtype=torch.float64)
    before = free.score(flat, SMALL, focus_um=20e3, settings=QUICK)
    made = free.optimise(SMALL, QUICK)
    assert made.converged
    assert float(made.score.encircled.min()) >= 0.499
    assert float(made.score.information.mean()) > 1.15 * float(before.information.mean())


def test_the_same_seed_gives_the_same_phase():
    brief = Fisher(grids=(5,), iterations=2, starts=1)
    assert torch.equal(free.optimise(SMALL, brief).controls, free.optimise(SMALL, brief).controls)


def test_the_lens_phase_is_the_designed_one():
    """The function of position and the pupil model give the same phase at the same places."""
    quick = Fisher(grids=(5,), iterations=1, starts=1, zones=(0,), focus_mm=(20.0, 20.0))
    phase, found = free.fisher_profile(Focus(0.85, 2000.0, 20e3), radius_um=300.0, settings=quick)
    x = np.array([-200.0, 0.0, 123.0])
    from metalens.profiles import hyperbolic

    extra = phase(x, x) - hyperbolic(x, x[:, None], Focus(0.85, 2000.0, found.focus_um))
    weights = free.spline(x / 300.0, 5)
    assert np.abs(extra - weights @ found.controls.numpy() @ weights.T).max() < 1e-9


def test_impossible_wishes_are_refused():
    for wish in ("encircled = 1.2", "grids = [2]", "depths_mm = [26.0, 16.0]", "pixel_um = 1.0"):
        with pytest.raises(ConfigError, match=wish.split(" ")[0]):
            config.loads(wish, Fisher)
