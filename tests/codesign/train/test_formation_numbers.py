"""Noise of one normal draw, the cost of a pitch and the loss of the optics, each by its
formula.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.network import cost
from codesign.train import formation
from metalens.image import Sensor

RNG = np.random.default_rng(14)


def test_electrons_of_one_draw_have_photon_and_read_variance_up_to_the_well():
    """(draw - mean)² over a million pixels: m + reads read²; at the well the mean
    stops, and so does its noise.
    """
    sensor = Sensor(
        6.0, 4.0, 1.0, 0.0, 900.0, 7.3
    )  # the well grows with the area: 2.25 x 900
    mean = (
        torch.tensor([60.0, 500.0, 5000.0], dtype=torch.float64)[:, None, None]
        .expand(3, 600, 600)
        .contiguous()
    )
    reads = torch.tensor(1.7, dtype=torch.float64)
    drawn = formation._normal(mean, sensor, torch.Generator().manual_seed(5), reads)
    held = np.array([60.0, 500.0, 2025.0])
    got = drawn.mean((1, 2)).numpy(), drawn.var((1, 2)).numpy()
    variance = held + 7.3**2 * 1.7
    assert np.abs(got[0] - held).max() < 5 * math.sqrt(variance.max() / 360000)
    assert got[1] == pytest.approx(
        variance, rel=0.012
    )  # sqrt(2 / 360000) = 0.24 %, five of them


def test_the_cost_of_a_pitch_is_that_of_its_pixels():
    """Counts linear in the size are interpolated exactly: window / pitch x share of the
    resolution.
    """
    net = SimpleNamespace(
        counts=lambda architecture, sizes: 5.0 * np.asarray(sizes) + 11
    )
    pitch = torch.tensor(7.0, dtype=torch.float64, requires_grad=True)
    found = formation.network_macs(net, SimpleNamespace(resolution=0.75), 812.0, pitch)
    assert float(found.detach()) == pytest.approx(5 * 812 / 7 * 0.75 + 11, rel=1e-9)
    found.backward()
    assert float(pitch.grad) == pytest.approx(-5 * 812 * 0.75 / 49, rel=1e-6)
    assert float(
        cost.interpolate_counts(lambda sizes: 3.0 * np.asarray(sizes), 40.25)
    ) == pytest.approx(120.75, rel=1e-9)


def test_the_texture_of_the_optics_loss_falls_as_1_over_f_squared():
    power = formation._texture(12).numpy()
    fy, fx = np.fft.fftfreq(12)[:, None], np.fft.rfftfreq(12)
    assert power.shape == (12, 7)
    assert power.mean() == pytest.approx(1, rel=1e-5)
    assert power[3, 2] / power[1, 5] == pytest.approx(
        (fy[1, 0] ** 2 + fx[5] ** 2 + (0.5 / 12) ** 2)
        / (fy[3, 0] ** 2 + fx[2] ** 2 + (0.5 / 12) ** 2),
        rel=1e-5,
    )


def test_the_optics_loss_is_minus_log_information_and_a_hinge_on_the_energy():
    """Whittle's information by numpy over steps of 2 and 3 mm, in 1/mm²; energy within
    two samples of the middle.
    """
    psfs = RNG.uniform(0, 1, (3, 8, 8)) ** 2
    psfs *= np.array([0.7, 0.55, 0.8])[:, None, None] / psfs.sum((1, 2), keepdims=True)
    made = SimpleNamespace(
        intensity=torch.from_numpy(psfs),
        depths_um=torch.tensor([18e3, 20e3, 23e3]).double(),
    )
    settings = SimpleNamespace(sample_um=1.3)
    fy, fx = np.fft.fftfreq(8)[:, None], np.fft.fftfreq(8)
    power = 1 / (fy**2 + fx**2 + (0.5 / 8) ** 2)
    power = power / power[:, :5].mean()
    logs = np.log(np.abs(np.fft.fft2(psfs)) ** 2 * power + 1e-3)
    told = [
        0.5 * (((logs[k + 1] - logs[k]) / gap) ** 2).sum()
        for k, gap in ((0, 2.0), (1, 3.0))
    ]
    place = np.arange(8) - 3.5
    inside = np.clip(2 + 0.5 - np.hypot(place[:, None], place), 0, 1)
    share = (psfs * inside).sum((1, 2))
    energy = float(np.sort(share)[1]) + 0.01  # two of three are below
    want = (
        -np.mean(np.log(np.array(told) + 0.05))
        + 50 * np.maximum(energy - share, 0).mean()
    )
    assert float(formation.depth_loss(made, settings, energy=energy)) == pytest.approx(
        want, rel=1e-5
    )


def test_information_on_depth_is_that_of_the_whole_spectrum_at_unequal_steps():
    """1/2 sum over all frequencies of (d log S / dz)^2, S = |H|^2 texture + noise: here
    on the whole grid, in numpy.
    """
    depths_mm, size = np.array([14.0, 17.0, 25.0]), 15
    x = np.arange(size) - 7.0
    psf = np.stack([np.exp(-(x**2 / (2 * (0.8 + 0.05 * z) ** 2))) for z in depths_mm])
    psf = psf[:, :, None] * np.exp(-(x**2) / (2 * 1.3**2))
    psf /= psf.sum((1, 2), keepdims=True)
    fy, fx = np.fft.fftfreq(size), np.fft.fftfreq(size)
    texture = 1 / (fy[:, None] ** 2 + fx**2 + (0.5 / size) ** 2)
    texture /= texture[
        :, : size // 2 + 1
    ].mean()  # of mean 1 over the half that a real image has
    power = np.log(np.abs(np.fft.fft2(psf)) ** 2 * texture + 1e-3)
    wanted = 0.5 * (
        (np.diff(power, axis=0) / np.diff(depths_mm)[:, None, None]) ** 2
    ).sum((1, 2))

    made = SimpleNamespace(
        intensity=torch.tensor(psf), depths_um=torch.tensor(1e3 * depths_mm)
    )
    found = formation.depth_information(made)
    assert found.tolist() == pytest.approx(
        wanted.tolist(), rel=1e-6
    )  # the texture is made in single precision


def test_pixels_without_light_and_read_noise_have_hardly_any_noise_and_finite_slopes():
    """A variance of 1e-6 is left, so that the root has a slope: 500 of them times one
    draw.
    """
    mean = torch.zeros(2, 30, 30, dtype=torch.float64, requires_grad=True)
    sensor = Sensor(6.0, 4.0, 1.0, 0.0, 900.0, 0.0)
    made = formation._normal(
        mean,
        sensor,
        torch.Generator().manual_seed(5),
        torch.tensor(1.7, dtype=torch.float64),
    )
    assert float(made.detach().std()) == pytest.approx(
        1e-3, rel=0.1
    )  # of 1800 draws: 1.7 %
    made.sum().backward()
    assert (mean.grad - 1).numpy() == pytest.approx(
        500 * 1e3 * made.detach().numpy(), rel=1e-6
    )


@pytest.mark.parametrize(
    ("pitch_um", "wide"),
    [(9.0, 1.0), (10.0, 370 / 369), (12.3, 1.0), (9.36, 374.4 / 369)],
)
def test_a_frame_is_as_wide_as_its_whole_pixels(pitch_um, wide):
    """369 um: 41, 36.9, 30 and 39.4 pixels, the last one of them whole."""
    assert formation.frame_wide(41, 9.0, pitch_um) == pytest.approx(wide, abs=1e-12)
