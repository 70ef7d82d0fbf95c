"""Pixels keep the light and have smooth gradients; noise and its gradients have the
moments of Poisson and Gauss.
"""

import math

import pytest
import torch

from metalens.core.errors import SceneError
from metalens.image import sensor as sensors
from metalens.image.sensor import Sensor
from metalens.psf import integrate_pixels, pixel_weights

torch.manual_seed(0)
IMAGE = torch.rand(40, 52, dtype=torch.float64) + 0.1


def test_coinciding_edges_give_the_exact_area_sum():
    binned = integrate_pixels(IMAGE, 1.0, pitch_um=4.0)
    want = IMAGE.reshape(10, 4, 13, 4).sum((1, 3))
    # the cubic passes through the cumulative at every sample edge
    assert (binned - want).abs().max() < 1e-12


@pytest.mark.parametrize("pitch", [2.0, 2.37, math.pi, 7.77, 10.0])
def test_energy_is_kept_at_any_pitch(pitch):
    padded = torch.nn.functional.pad(IMAGE, (12, 12, 12, 12))
    total = integrate_pixels(padded, 1.0, pitch_um=pitch).sum()
    assert abs(total / IMAGE.sum() - 1) < 1e-12  # telescoping sum; asked: 1e-6


def test_pitch_gradient_is_continuous_where_edges_meet():
    def gradient(pitch):
        p = torch.tensor(pitch, dtype=torch.float64, requires_grad=True)
        pixels = integrate_pixels(IMAGE, 1.0, pitch_um=p, shape=(5, 5))
        (pixels * torch.arange(25.0).reshape(5, 5)).sum().backward()
        return float(p.grad)

    for meeting in (
        2.0,
        4.0,
        6.0,
        8.0,
    ):  # pixel edges on sample edges: the kink of plain area overlap
        jump = abs(gradient(meeting + 1e-7) - gradient(meeting - 1e-7))
        assert jump < 1e-5 * abs(gradient(meeting))
    step = 1e-5
    pixels = [
        integrate_pixels(IMAGE, 1.0, pitch_um=p, shape=(5, 5))
        for p in (3.3 - step, 3.3 + step)
    ]
    slope = (
        (pixels[1] - pixels[0]) / (2 * step) * torch.arange(25.0).reshape(5, 5)
    ).sum()
    assert gradient(3.3) == pytest.approx(float(slope), rel=1e-8)


def test_pixel_larger_than_the_image_holds_all_its_light():
    pixels = integrate_pixels(IMAGE, 1.0, pitch_um=60.0)
    assert pixels.shape == (1, 1)
    assert float(pixels) == pytest.approx(float(IMAGE.sum()), rel=1e-12)


def test_shift_moves_the_pixel_grid_towards_plus_x():
    spot = torch.zeros(30, 30, dtype=torch.float64)
    spot[15, 17] = 1
    moved = integrate_pixels(spot, 1.0, pitch_um=5.0, shift_um=(0.0, 5.0))
    still = integrate_pixels(spot, 1.0, pitch_um=5.0)
    assert torch.allclose(moved[:, :-1], still[:, 1:], atol=1e-12)


@pytest.mark.parametrize("mean", [1.0, 3.0, 50.0])
def test_photon_gradient_has_the_moments_of_poisson(mean):
    n = 400_000
    m = torch.full((n,), mean, dtype=torch.float64, requires_grad=True)
    k = sensors.draw_photons(m, torch.Generator().manual_seed(1))
    assert float(k.detach().mean()) == pytest.approx(mean, abs=5 * math.sqrt(mean / n))
    assert float(k.detach().var()) == pytest.approx(mean, rel=0.02)
    (first,) = torch.autograd.grad(k.sum(), m, retain_graph=True)
    (second,) = torch.autograd.grad((k**2).sum(), m)
    # sampling error: sd of the slopes is 1 / (2 sqrt m) and about (1 + 3 sqrt m) per
    # draw
    assert float(first.mean()) == pytest.approx(1, abs=5 * 0.5 / math.sqrt(mean * n))
    assert float(second.mean()) == pytest.approx(
        2 * mean + 1, abs=5 * (2 + 3 * math.sqrt(mean)) / math.sqrt(n)
    )


def test_dark_pixels_give_zero_counts_and_finite_gradient():
    mean = torch.zeros(5, requires_grad=True)
    sensors.expose(mean, sensor=Sensor(read_noise_e=0.0)).sum().backward()
    assert torch.equal(mean.grad, torch.ones(5))


def test_saturated_frame_sticks_at_full_scale_without_gradient():
    light = torch.full((6, 6), 50.0, requires_grad=True)
    sensor = Sensor(bits=8, read_noise_e=0.0)
    frame = sensors.digitise(
        sensors.expose(
            sensors.mean_electrons(light, 3.0, sensor=sensor), sensor=sensor
        ),
        sensor=sensor,
    )
    frame.sum().backward()
    assert torch.equal(frame, torch.full((6, 6), 255.0))
    assert torch.equal(light.grad, torch.zeros(6, 6))


@pytest.mark.parametrize("bits", [8, 10, 12])
def test_digitised_levels_are_whole_numbers_with_a_straight_gradient(bits):
    electrons = torch.linspace(10, 7900, 50, dtype=torch.float64, requires_grad=True)
    level = sensors.digitise(electrons, sensor=Sensor(bits=bits))
    level.sum().backward()
    assert torch.equal(level, level.round())
    assert torch.allclose(
        electrons.grad, torch.full((50,), (2**bits - 1) / 8000, dtype=torch.float64)
    )


def test_low_snr_mode_has_the_stated_ratio():
    flat = torch.full((300, 300), 0.3, dtype=torch.float64)
    dim = sensors.low_snr(Sensor(bits=12), 0.3, snr_db=15.0)
    mean = sensors.mean_electrons(flat, 3.0, sensor=dim)[2:-2, 2:-2]
    frame = sensors.expose(mean, sensor=dim, generator=torch.Generator().manual_seed(2))
    signal = float(mean.mean()) - dim.ambient_e
    # sd of 9e4 pixels: 0.02 dB
    assert 20 * math.log10(signal / float(frame.std())) == pytest.approx(15, abs=0.1)
    assert float(sensors.variance(mean, sensor=dim).mean()) == pytest.approx(
        float(frame.var()), rel=0.03
    )


def test_impossible_sensors_are_refused():
    for bad in (
        {"pitch_um": 0.0},
        {"read_noise_e": -1.0},
        {"bits": 0},
        {"full_well_e": math.inf},
    ):
        with pytest.raises(SceneError, match=next(iter(bad))):
            Sensor(**bad)


# no two numbers alike, and a pitch unlike the base pitch: every factor shows
ODD = Sensor(
    pitch_um=4.1,
    base_pitch_um=2.9,
    exposure_e=730.0,
    ambient_e=41.0,
    full_well_e=5200.0,
    read_noise_e=5.3,
)
AREA = (4.1 / 2.9) ** 2


def test_noise_of_a_pixel_has_photon_read_and_rounding_parts():
    sensor = Sensor(
        **{
            n: getattr(ODD, n)
            for n in ("pitch_um", "base_pitch_um", "full_well_e", "read_noise_e")
        },
        bits=6,
    )
    step = 5200 * AREA / 63  # 165 e: rounding rules, 2270 of 2700 e²
    told = float(
        sensors.variance(torch.tensor(401.0, dtype=torch.float64), sensor=sensor)
    )
    assert told == pytest.approx(401 + 5.3**2 + step**2 / 12, rel=1e-12)
    # over whole steps: rounding is even
    mean = torch.linspace(3000, 3000 + 12 * step, 400_000, dtype=torch.float64)
    frame = sensors.digitise(
        sensors.expose(mean, sensor=sensor, generator=torch.Generator().manual_seed(5)),
        sensor=sensor,
    )
    scatter = float(((frame * step - mean) ** 2).mean())
    assert scatter == pytest.approx(
        float(sensors.variance(mean, sensor=sensor).mean()), rel=0.01
    )  # 4e5 draws: 0.002


def test_reads_add_their_noise_and_the_well_caps_the_light():
    mean = torch.full((200_000,), 53.7, dtype=torch.float64)
    frame = sensors.expose(
        mean, sensor=ODD, generator=torch.Generator().manual_seed(6), reads=3.0
    )
    # 11.8 / sqrt(2e5) = 0.026
    assert float(frame.mean()) == pytest.approx(53.7, abs=0.1)
    # sqrt(2 / 2e5) = 0.003
    assert float(frame.var()) == pytest.approx(53.7 + 3 * 5.3**2, rel=0.02)
    full = sensors.expose(
        mean * 1e4, sensor=ODD, generator=torch.Generator().manual_seed(7)
    )
    assert float(full.mean()) == pytest.approx(5200 * AREA, abs=0.1)


def test_a_narrower_box_on_the_same_grid_keeps_the_mean_of_flat_light():
    """Box of 2.3 um on a grid of 4.1 um: flat light reads as a pixel of the grid, a
    ramp reads its middle value.
    """
    ramp = (torch.arange(80, dtype=torch.float64) + 0.5) * 0.31
    image = ramp[:, None] + 0 * ramp
    got = integrate_pixels(image, 0.31, pitch_um=2.3, grid_um=4.1, shape=(3, 4))
    middles = 80 * 0.31 / 2 + (torch.arange(3, dtype=torch.float64) - 1) * 4.1
    assert torch.allclose(
        got, (middles * (4.1 / 0.31) ** 2)[:, None].expand(3, 4), rtol=1e-9
    )
    mean = sensors.mean_electrons(image, 0.31, sensor=ODD, count=3)
    want = 730 * middles * AREA + 41 * AREA
    assert torch.allclose(mean[:, 1], want, rtol=1e-9)
    rows = pixel_weights(80, 0.31, pitch_um=4.1, count=3, shift_um=1.7)
    assert torch.allclose(rows @ ramp / (4.1 / 0.31), middles + 1.7, rtol=1e-9)
