"""What the network sees of the light, and how that moves with the pixel pitch."""

import math

import pytest
import torch

from codesign.train.imaging import _normal, read_out
from metalens.image import sensor as camera
from metalens.image.sensor import Sensor

WINDOW, SAMPLE_UM = 240, 1.0
FULL = Sensor(
    pitch_um=8.0,
    base_pitch_um=8.0,
    exposure_e=1e7,
    full_well_e=1e8,
    read_noise_e=0.0,
    bits=16,
)


def _pitch(value):
    return torch.tensor(value, dtype=torch.float64, requires_grad=True)


def _wave(period_um, *, sample_um=SAMPLE_UM):
    count = round(WINDOW / sample_um)
    x = (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * sample_um
    return (
        (1 + 0.5 * torch.cos(2 * math.pi * x / period_um))
        .expand(count, count)
        .contiguous()
    )


def test_a_wider_box_dims_a_wave_by_its_sinc():
    """Closed form: a box of width p passes sinc(p / period) of a wave.

    The cubic takes the light at an edge from the two samples beside it, cos(pi sample /
    period) = 0.9995 of it, and
    the slope is a tenth of that term.
    """
    period, pitch, sample = 48.0, _pitch(8.0), 0.5
    wave = _wave(period, sample_um=sample)
    mean = camera.mean_electrons(wave, sample, sensor=FULL, pitch_um=pitch, grid_um=8.0)
    torch.testing.assert_close(
        mean.detach(),
        camera.mean_electrons(wave, sample, sensor=FULL),
        rtol=1e-12,
        atol=0,
    )
    x = (torch.arange(30, dtype=torch.float64) - 14.5) * 8.0
    inner = slice(3, -3)  # four periods
    contrast = (
        (mean[15] * torch.cos(2 * math.pi * x / period))[inner].mean()
        / mean[15][inner].mean()
        * 2
    )
    (slope,) = torch.autograd.grad(contrast, pitch)
    angle = math.pi * 8.0 / period
    assert float(contrast.detach()) == pytest.approx(
        0.5 * math.sin(angle) / angle, rel=1e-3
    )
    expected = 0.5 * (math.cos(angle) / 8.0 - math.sin(angle) / angle / 8.0)
    assert float(slope) == pytest.approx(expected, rel=1e-2)


def test_the_scene_stays_in_place_while_the_pitch_moves():
    """A spot 60 um from the middle, in pixels: no slope, where the place in the bare
    frame has -60 / pitch^2.
    """
    x = torch.arange(WINDOW, dtype=torch.float64) - (WINDOW - 1) / 2
    spot = torch.exp(-((x - 60.0) ** 2 + x[:, None] ** 2) / (2 * 10.0**2))
    places = torch.arange(30, dtype=torch.float64) - 14.5
    slopes = []
    for grid_um in (8.0, None):
        pitch = _pitch(8.0)
        mean = camera.mean_electrons(
            spot, SAMPLE_UM, sensor=FULL, pitch_um=pitch, grid_um=grid_um
        )
        place = (mean.sum(0) * places).sum() / mean.sum()
        slopes.append(float(torch.autograd.grad(place, pitch)[0]))
    assert abs(slopes[0]) < 1e-6
    assert slopes[1] == pytest.approx(-60.0 / 64, rel=1e-3)


def test_light_of_an_area_does_not_depend_on_the_pitch():
    pitch = _pitch(8.0)
    sensor = Sensor(8.0, 8.0, 1000.0, 200.0, 1e6, 0.0)
    mean = camera.mean_electrons(
        torch.ones(WINDOW, WINDOW),
        SAMPLE_UM,
        sensor=sensor,
        pitch_um=pitch,
        grid_um=8.0,
    )
    assert float(mean.detach()[10, 10]) == pytest.approx(1200.0, rel=1e-6)
    (slope,) = torch.autograd.grad(mean[5:-5, 5:-5].mean(), pitch)
    assert abs(float(slope)) < 1e-4 * 1200 / 8


@pytest.mark.parametrize("exact", [True, False])
def test_read_noise_of_an_area_falls_as_the_inverse_of_the_pitch(exact):
    """Dark frames with ambient light: the variance that reads bring, per pixel area,
    has the slope -2 / pitch.
    """
    sensor = Sensor(8.0, 8.0, 0.0, 400.0, 1e6, 30.0, 16)
    light = torch.zeros(64, WINDOW, WINDOW)
    pitch = _pitch(8.0)
    mean = camera.mean_electrons(light, SAMPLE_UM, sensor=sensor)
    reads = (8.0 / pitch) ** 2
    generator = torch.Generator().manual_seed(3)
    if exact:
        electrons = camera.expose(mean, sensor=sensor, generator=generator, reads=reads)
    else:
        electrons = _normal(mean, sensor, generator, reads)
    variance = electrons.var()
    (slope,) = torch.autograd.grad(variance, pitch)
    # 57 600 pixels: 0.6 % each, 5 sigma
    assert float(variance.detach()) == pytest.approx(400 + 900, rel=0.03)
    assert float(slope) == pytest.approx(-2 * 900 / 8.0, rel=0.06)


def test_a_network_sees_frames_of_mean_0_and_deviation_1_and_dark_ones_as_nothing():
    """Numpy's deviation of a sample; a frame without any contrast is not blown up by
    its rounding.
    """
    light = torch.rand(2, 24, 31, generator=torch.Generator().manual_seed(4)) + 0.5
    light[1] = 0.0
    sensor = Sensor(3.0, 3.0, 500.0, 0.0, 4000.0, 0.0, 12)
    seen = read_out(
        light,
        3.0,
        torch.tensor(3.0, dtype=torch.float64),
        sensor,
        generator=None,
        quiet=True,
    )[:, 0]
    bright = seen[0].double().numpy()
    assert abs(bright.mean()) < 1e-6  # float32
    assert bright.std(ddof=1) == pytest.approx(1.0, abs=1e-6)
    assert float(seen[1].abs().max()) == 0.0
