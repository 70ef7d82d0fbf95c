"""Eq. 6 on rendered triplets: the quick path gives the images of the exact one, and its
gradient is right.
"""

import pytest
import torch

from codesign.evaluate.optics import SensitivityScenes
from codesign.evaluate.scenes import SceneObjective
from metalens.core.errors import ConfigError
from metalens.design import Focus
from metalens.design.free_form.search import optimize_free_form
from metalens.design.free_form.settings import FisherSettings
from metalens.image import scene
from metalens.image.pupil import Pupil

PUPIL = Pupil(nodes=96)
SETTINGS = FisherSettings(
    objective="scenes",
    scenes=1,
    grids=(4,),
    iterations=2,
    starts=1,
    zones=(0,),
    encircled=0.0,
).about(Focus(0.85, 2000.0, 20e3), PUPIL.radius_um)
SMALL = SensitivityScenes(count=1, pitch_um=22.0, pixels=48, window_um=154.0)


@pytest.fixture(scope="module")
def objective():
    return SceneObjective(PUPIL, SETTINGS, SMALL)


def test_images_from_spectra_are_those_of_the_imager(objective):
    kernels = torch.rand(14, objective.size, objective.size)
    kernels = kernels / kernels.sum((1, 2), keepdim=True)
    optics = scene.with_kernels(objective.optics, kernels)
    quick = scene.image_spectra(objective.sources[0], optics, (48, 48))
    exact = scene.image(objective.frames[0], optics)
    assert (
        float((quick - exact).abs().max() / exact.max()) < 1e-5
    )  # the same sums in another order, float32


def test_gradient_of_eq_6_agrees_with_differences(objective):
    generator = torch.Generator().manual_seed(1)
    phase = torch.randn(96, 96, generator=generator, dtype=torch.float64)
    way = torch.randn(96, 96, generator=generator, dtype=torch.float64)
    point = phase.clone().requires_grad_(True)
    slope = torch.autograd.grad(objective.loss(point, 20e3, None)[0], point)[0]
    step = 0.02
    high, low = (
        float(objective.loss(phase + s * way, 20e3, None)[0]) for s in (step, -step)
    )
    got = float((slope * way).sum())
    assert got == pytest.approx(
        (high - low) / (2 * step), rel=0.02, abs=1e-4
    )  # float32 images, third derivative


def test_a_sharp_lens_loses_less_than_a_blurred_one(objective):
    flat = torch.zeros(96, 96, dtype=torch.float64)
    focused, blurred = (float(objective.loss(flat, f, None)[0]) for f in (20e3, 60e3))
    assert 0 < focused < blurred  # 0: no blur at all


def test_a_scene_design_needs_its_scenes(objective):
    with pytest.raises(ConfigError, match="scenes"):
        optimize_free_form(PUPIL, SETTINGS)
    assert optimize_free_form(PUPIL, SETTINGS, objective=objective).controls.shape == (
        4,
        4,
    )
