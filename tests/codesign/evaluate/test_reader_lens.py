"""A lens trained with the reader's branch: its gradient is that of a finite difference,
it mends, it repeats.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from codesign.batches import depth_um, sensor_irradiance
from codesign.evaluate import reader, reader_lens
from codesign.evaluate.reader import ReaderConfig
from codesign.evaluate.reader_lens import LensTraining
from codesign.network import blur, losses
from codesign.network.blur import BlurBranch
from codesign.optics import formed
from codesign.optics.stack import OpticsConfig
from codesign.train import LearningRateSchedule
from metalens.core.errors import ConfigError
from metalens.image.engine import normalised
from metalens.image.forming import build_imager
from metalens.image.plan import spectral
from metalens.psf.spectrum import SpectralNodes

CONFIG = ReaderConfig(
    frames=64, pool=32, test=32, pixels=32, pitch_um=24.0, fwhm_nm=90.0
)
OPTICS = OpticsConfig(
    aperture_mm=0.3, focus_mm=30.0, polynomials=5, depths_mm=(12.0, 50.0), sample_um=24.0, window_samples=13,
    image_tolerance=0.3, angle_deg=11.0, fwhm_nm=90.0,
)  # fmt: skip
BENT = torch.tensor([0.8, -0.5, 0.9, 0.4, -0.7], dtype=torch.float64)
FEW = LensTraining(turns=2, hold=2, batch=4, phase=LearningRateSchedule(0.1), seed=3)


@pytest.fixture(scope="module")
def learn():
    return reader.render_scenes(CONFIG, sensor_distance_um=2000.0).learn


def _psfs(whole, coefficients):
    """The image through all kernels of these PSFs: gradients are those of all nodes."""
    plane = formed.optics_of(OPTICS, coefficients)
    y, x = torch.meshgrid(whole.plan.y_um, whole.plan.x_um, indexing="ij")
    places = torch.stack([x.flatten(), y.flatten()], -1)
    light = spectral(
        plane, places, whole.plan.depths_um, whole.plan.waves, whole.plan.window
    )
    psfs, _ = normalised(light.reshape(whole.stack.shape), plane, whole.plan)
    return build_imager(whole.grid, whole.plan, psfs, whole.energy, tolerance=1e-5)


@pytest.fixture(scope="module")
def whole():
    """The image through the lens, of two wavelengths that do not weigh alike."""
    found = formed.make_imager(
        OPTICS, BENT, CONFIG.pixels + 2 * CONFIG.margin, margin=CONFIG.margin
    )
    waves = SpectralNodes(
        np.array([0.81, 0.87]), np.array([0.3, 0.7]), found.plan.waves.error
    )
    return _psfs(replace(found, plan=replace(found.plan, waves=waves)), BENT)


def _branch():
    torch.manual_seed(5)
    return BlurBranch(nn.BatchNorm2d(blur.FEATURES)).train()


def _plain(light, sample_um, pitch_um, sensor, *, generator, exact):
    """A sensor without noise and steps: drawn photons and counts jump, and with them a
    finite difference.
    """
    return (
        (light - light.mean((-2, -1), keepdim=True)) / light.std((-2, -1), keepdim=True)
    )[:, None]


def test_the_gradient_of_the_lens_is_that_of_a_finite_difference_of_the_loss(
    learn, whole, monkeypatch
):
    """The same frames and branch behind PSFs of the lens a little to either side, all
    nodes formed anew.
    """
    monkeypatch.setattr(reader_lens, "read_out", _plain)
    batch = learn.batch(0, FEW.batch)

    def loss(coefficients):
        seen = sensor_irradiance(
            batch.frames, _psfs(whole, coefficients), margin=CONFIG.margin
        )
        pixels = _plain(seen, 0, 0, None, generator=None, exact=False)
        told, _ = _branch()(pixels)
        return float(
            losses.depth_loss(
                told, blur.window_vergence(depth_um(batch.frames, margin=CONFIG.margin))
            )
        )

    value, slope = reader_lens.gone_backward(
        _branch(), OPTICS, whole, learn, CONFIG, FEW, step=0, live=True
    )
    got = reader_lens.lens_gradient(OPTICS, whole, BENT, slope)
    way = torch.tensor([0.3, 0.8, -0.5, 0.4, 0.6], dtype=torch.float64)
    with torch.no_grad():
        assert value == pytest.approx(loss(BENT), rel=1e-4)
        want = (loss(BENT + 0.1 * way) - loss(BENT - 0.1 * way)) / 0.2
    assert float(got @ way) == pytest.approx(
        want, rel=3e-3
    )  # 1.2e-3 from 0.01 to 0.3; float32 losses: 4e-4


def test_a_lens_that_stands_gathers_nothing_and_teaches_the_branch_all_the_same(
    learn, whole
):
    branch = _branch()
    live, slope = reader_lens.gone_backward(
        branch, OPTICS, whole, learn, CONFIG, FEW, step=0, live=True
    )
    want = branch.depth.weight.grad.clone()
    again = _branch()
    still, none = reader_lens.gone_backward(
        again, OPTICS, whole, learn, CONFIG, FEW, step=0, live=False
    )
    assert still == pytest.approx(live, rel=1e-4)
    assert float(slope.abs().sum()) > 0
    assert not bool(none.any())
    assert torch.allclose(again.depth.weight.grad, want, rtol=1e-2, atol=1e-5)


def test_training_repeats_bit_for_bit_moves_by_its_rate_and_leaves_the_generator(learn):
    torch.manual_seed(11)
    before = torch.get_rng_state()
    path, told = reader_lens.train_lens(OPTICS, BENT, learn, CONFIG, FEW)
    again, _ = reader_lens.train_lens(OPTICS, BENT, learn, CONFIG, FEW)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(path, again)
    assert len(told) == FEW.turns == len(path) - 1
    assert torch.equal(path[0], BENT)
    still, _ = reader_lens.train_lens(
        OPTICS, BENT, learn, CONFIG, replace(FEW, phase=LearningRateSchedule(0.0))
    )
    assert torch.equal(still, BENT.expand_as(still))
    assert torch.equal(path[1], BENT)  # one gradient tells nothing of its noise
    assert (
        float((path[-1] - BENT).norm()) < 0.1
    )  # less than the rate a turn, all terms together


def test_a_lens_that_moved_is_imaged_through_the_plan_of_another(whole):
    """Its PSFs at the nodes are those that the engine forms of that lens; the lens that
    stands keeps its own.
    """
    assert torch.equal(reader_lens.moved_image(OPTICS, whole, BENT).stack, whole.stack)
    found, want = (
        reader_lens.moved_image(OPTICS, whole, BENT + 0.2),
        _psfs(whole, BENT + 0.2),
    )
    assert torch.allclose(found.stack, want.stack, rtol=1e-9, atol=1e-12)
    assert not torch.allclose(found.stack, whole.stack, rtol=1e-2)
    assert not found.stack.requires_grad


@pytest.mark.parametrize(
    ("change", "message"),
    [({"sample_um": 12.0}, "samples of the pitch"), ({"polynomials": 0}, "1 polynomial"),
     ({"image": "uniform", "fwhm_nm": 0.0}, "'true'")],
)  # fmt: skip
def test_optics_that_cannot_be_trained_are_refused(learn, change, message):
    with pytest.raises(ConfigError, match=message):
        reader_lens.train_lens(replace(OPTICS, **change), BENT, learn, CONFIG, FEW)


@pytest.mark.parametrize(
    "change", [{"turns": 0}, {"hold": 0}, {"batch": 0}, {"anew": 0}, {"rate": 0.0}]
)
def test_impossible_trainings_are_refused(change):
    with pytest.raises(ConfigError, match="counts of 1 or more"):
        LensTraining(**change)
