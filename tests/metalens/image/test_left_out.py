"""What PSFs are said to leave out, by PSFs of two windows each; how many components the
tolerances keep.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from metalens.design import Focus
from metalens.image import Optics, SmoothWave, Window, psfs
from metalens.image.model_error import (
    JudgedPsfs,
    choose_polarisation,
    folding_error,
    polarisation_error,
)
from metalens.image.texture import texture_error
from metalens.optics import Layers
from metalens.psf import SpectralNodes

WAVE, DISTANCE = 0.85, 33.0
FAST = Optics(
    SmoothWave(Focus(WAVE, DISTANCE, 5000.0), 25.0), Layers(), DISTANCE
)  # NA 0.6
WAVES = SpectralNodes(np.array([WAVE, 0.9]), np.array([0.7, 0.3]), 0.0)
AT = (
    torch.tensor([[3.0, -4.0], [21.0, 9.0], [-14.0, 2.0]], dtype=torch.float64),
    torch.tensor([900.0, 4000.0]),
)
WINDOW = Window(21, 1.2, True)


def seen(**other):
    return psfs(
        FAST,
        AT[0],
        depths_um=AT[1],
        wavelength_um=WAVE,
        window=replace(WINDOW, **other),
    ).double()


def image_error(got, want, light):
    """Of PSFs (places, depths), each as bright as its light, over the brightest place
    of each depth, rms.
    """
    each = texture_error(got, want).numpy() * light.numpy() / light.numpy().max(0)
    return np.sqrt(np.mean(each**2))


def test_components_that_are_left_out_are_judged_by_shapes_of_all_of_them():
    """PSFs of sum 1 with one component against those of four, in the light of the four;
    of all of them nothing.
    """
    few, whole = seen(components=1), seen(components=4)
    want = image_error(
        few / few.sum((-1, -2), keepdim=True),
        whole / whole.sum((-1, -2), keepdim=True),
        whole.sum((-1, -2)),
    )
    judged = JudgedPsfs(FAST, WAVES, replace(WINDOW, components=1), AT)
    assert polarisation_error(judged) == pytest.approx(want, rel=1e-5)  # float32
    assert polarisation_error(judged, seen(components=4)) == pytest.approx(
        want, rel=1e-5
    )
    assert (
        polarisation_error(JudgedPsfs(FAST, WAVES, replace(WINDOW, components=4), AT))
        == 0.0
    )


def test_light_that_folds_back_is_judged_by_twice_the_period():
    whole = seen(period=2 * WINDOW.period)
    want = image_error(seen(), whole, whole.sum((-1, -2)))
    assert want > 1e-4
    assert folding_error(JudgedPsfs(FAST, WAVES, WINDOW, AT)) == pytest.approx(
        want, rel=1e-4
    )


def test_the_scalar_stays_where_its_error_is_below_the_tolerance_and_the_image_says_it():
    at = torch.tensor([[3.0, -4.0]], dtype=torch.float64), torch.tensor([4000.0])
    judged = JudgedPsfs(FAST, WAVES, WINDOW, at)
    said = polarisation_error(judged)
    for tolerance, components in (
        (1.01 * said, 0),
        (0.99 * said, 4),
    ):  # three leave more than a fifth of that
        assert (
            choose_polarisation(
                judged, "auto", within=(tolerance, 0.2 * tolerance)
            ).components
            == components
        )
    assert choose_polarisation(judged, "scalar", within=(1e-9, 1e-9)).components == 0
    energy = choose_polarisation(
        judged, "vector", within=(1.01 * said, 0.2 * 1.01 * said)
    )
    assert (energy.flux, energy.whole) == (False, 6)
    assert energy.components > 0
