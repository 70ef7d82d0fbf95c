"""What films leave out of PSFs: of the light of every pillar to the window's farthest
corner, rays by Snell's law.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from metalens.lens import saddle_correction
from metalens.lens.media import Media
from metalens.propagate import PropagationCase, paths
from metalens.psf import compute

PITCH = 4.1
FILMS = Media((1.0, 1.52, 2.1), (11.0, 9.0, 3.0))
CASE = PropagationCase(
    (3, 4),
    PITCH,
    0.85,
    23.0,
    (0.21, -0.13),
    (1 / 400,),
    (14.0, -8.5),
    0.6,
    (9, 11),
    behind=FILMS,
)


def reach(p):
    return sum(
        t * p / math.sqrt(n * n - p * p)
        for n, t in ((1.0, 11.0), (1.52, 9.0), (2.1, 3.0))
    )


def errors():
    """(y, x) of the amplitude from each pillar to the corner farthest from it, 2.4 and
    3 um off the middle.
    """
    found = np.empty((3, 4))
    for i, y in enumerate(PITCH * np.array([-1.0, 0.0, 1.0])):
        for j, x in enumerate(PITCH * np.array([-1.5, -0.5, 0.5, 1.5])):
            far = max(
                math.hypot(14.0 + a - x, -8.5 + b - y)
                for a in (-3.0, 3.0)
                for b in (-2.4, 2.4)
            )
            p = brentq(lambda p, far=far: reach(p) - far, 0.0, 1 - 1e-12, xtol=1e-15)
            found[i, j] = saddle_correction(
                FILMS, 2 * math.pi / 0.85, CASE.reach_um
            ).error(np.array([p * p]))[0]
    return found


def test_the_error_of_films_is_twice_the_root_mean_square_of_the_amplitude_s_over_the_light():
    each = errors()
    assert each.max() > 3 * each.min() > 0  # pillars differ
    levels = [np.random.default_rng(8).uniform(0, 0.9, (3, 4))]
    for place in ((0, 0), (2, 0), (0, 3), (1, 2)):
        levels.append(np.zeros((3, 4)))
        levels[-1][place] = 0.37
    for level in levels:
        want = 2 * math.sqrt((level**2 * each**2).sum() / (level**2).sum())
        assert paths.films_error(CASE, level) == pytest.approx(want, rel=1e-6)
    dark = 2 * math.sqrt((each**2).mean())
    assert paths.films_error(CASE, np.zeros((3, 4))) == pytest.approx(dark, rel=1e-6)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_of_a_spectrum_the_worst_wavelength_counts_with_its_own_light(order):
    """Of two wavelengths, the shorter one's light on the pillar that errs least: its
    part alone would say a third.
    """
    cases = CASE, dataclasses.replace(CASE, wavelength_um=0.62)
    levels = [np.ones((3, 4)), np.zeros((3, 4))]
    levels[1][np.unravel_index(errors().argmin(), (3, 4))] = 0.7
    each = [
        paths.films_error(case, level)
        for case, level in zip(cases, levels, strict=True)
    ]
    assert each[0] > 2 * each[1] > 0
    maps = torch.from_numpy(np.stack([levels[i] for i in order]))
    lit = compute.IntensityRequest(
        torch.zeros_like(maps), maps, [cases[i] for i in order], [0.3, 0.7]
    )
    assert lit.films == pytest.approx(each[0], rel=1e-12)


def test_one_medium_leaves_nothing_out():
    air = PropagationCase(
        (3, 4), PITCH, 0.85, 23.0, (0.21, -0.13), (1 / 400,), (14.0, -8.5), 0.6, (9, 11)
    )
    assert paths.films_error(air, np.ones((3, 4))) == 0.0
