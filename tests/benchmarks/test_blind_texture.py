"""Blind-texture information: Gaussian blur in closed form, gradients, and what a
symmetric blur cannot tell.
"""

import math

import pytest
import torch

from benchmarks.rivals import blind_texture as blind
from benchmarks.rivals.blind_texture import Texture
from metalens.ground.errors import ConfigError, SceneError
from metalens.image.sensor import Sensor

FINE = Texture(pitch_um=1.0, pixels=16, contrast=0.2, noise=0.0, folds=1)
AXIS = (torch.arange(128, dtype=torch.float64) - 63.5) / 2


def gaussian(width_um):
    spot = torch.exp(
        -(AXIS[:, None] ** 2 + AXIS**2)
        / (2 * torch.as_tensor(width_um, dtype=torch.float64)[..., None, None] ** 2)
    )
    return spot / spot.sum((-2, -1), keepdim=True)


def frequencies2():
    """Squared frequencies of the patch without 0, 1/um²."""
    f = torch.fft.fftfreq(16, dtype=torch.float64)
    both = f[:, None] ** 2 + f**2
    return both[both > 0]


def pair(width_um=1.5, slope=0.4, step_um=20.0):
    """Gaussians whose width grows by ``slope`` um per mm, around ``width_um``."""
    change = slope * step_um * 1e-3 / 2
    widths = torch.tensor([width_um - change, width_um + change], dtype=torch.float64)
    return (*gaussian(widths), dict(step_um=step_um, sample_um=0.5, texture=FINE))


def test_gaussian_blur_in_closed_form():
    """OTF = exp(-2 pi² w² f²), so without noise d ln P / dz = -8 pi² w w' f² whatever
    the texture.
    """
    near, far, setting = pair()
    change = 8 * math.pi**2 * 1.5 * 0.4 * frequencies2()
    assert float(blind.blind_information(near, far, **setting)) == pytest.approx(
        0.5 * float((change**2).sum()), rel=1e-3
    )


def test_unknown_contrast_and_fall_cost_their_share():
    """Without noise the nuisances are 1 and ln f: what is left is the residual of a
    straight line in ln f.
    """
    near, far, setting = pair()
    change, logs = (
        8 * math.pi**2 * 1.5 * 0.4 * frequencies2(),
        torch.log(frequencies2()) / 2,
    )
    lines = torch.stack([torch.ones_like(logs), logs], 1)
    left = change - lines @ torch.linalg.lstsq(lines, change[:, None]).solution[:, 0]
    found = blind.blinder_information(near, far, **setting)
    assert float(found) == pytest.approx(0.5 * float((left**2).sum()), rel=2e-3)
    assert float(found) < float(blind.blind_information(near, far, **setting))


def test_matrix_is_that_of_differences_of_the_power():
    """Entries of contrast and depth against 1/2 sum of products of numeric slopes of ln
    P, with noise.
    """
    step, spots = 1e-4, gaussian(torch.tensor([1.45, 1.55], dtype=torch.float64))
    found = blind.blind_matrix(
        *spots,
        step_um=20.0,
        sample_um=0.5,
        texture=Texture(1.0, 16, noise=0.05, folds=1),
    )
    logs = []
    for sign in (-1, 1):
        one = Texture(
            1.0, 16, contrast=0.2 * math.exp(sign * step / 2), noise=0.05, folds=1
        )
        logs.append(torch.log(blind.power(spots, 0.5, one)[0]))
    contrast = ((logs[1] - logs[0]) / (2 * step)).mean(0)
    depth = (logs[0][1] - logs[0][0]) / 20e-3
    assert float(found[1, 1]) == pytest.approx(
        0.5 * float((contrast**2).sum()), rel=1e-5
    )
    assert float(found[0, 1]) == pytest.approx(
        0.5 * float((contrast * depth).sum()), rel=1e-3
    )


@pytest.mark.parametrize(
    "measure", [blind.blind_information, blind.blinder_information]
)
def test_gradient_is_that_of_finite_differences(measure):
    texture = Texture(pitch_um=3.0, pixels=4, contrast=0.3, noise=0.05)
    generator = torch.Generator().manual_seed(2)
    spots = [
        torch.rand(6, 6, generator=generator, dtype=torch.float64, requires_grad=True)
        for _ in range(2)
    ]
    assert torch.autograd.gradcheck(
        lambda a, b: measure(a, b, step_um=200.0, sample_um=1.0, texture=texture),
        spots,
        rtol=1e-5,
    )


def test_noise_and_displacement():
    near, far, setting = pair()
    values = []
    for noise in (0.0, 0.01, 0.1):
        noisy = Texture(1.0, 16, noise=noise, folds=1)
        values.append(
            float(blind.blind_information(near, far, **(setting | {"texture": noisy})))
        )
    assert values[0] > values[1] > values[2] > 0
    moved = torch.roll(far, (3, -2), (0, 1))
    assert float(blind.blind_information(near, moved, **setting)) == pytest.approx(
        float(blind.blind_information(near, far, **setting)), rel=1e-4
    )


def test_aliases_are_folded():
    """At every frequency of the patch: the sum over its nine aliases of Gaussian OTF,
    pixel and 1/f² texture.
    """
    texture = Texture(pitch_um=3.0, pixels=4, contrast=0.2, noise=0.1)
    whole, seen = blind.power(gaussian(1.2), 0.5, texture)
    own = [(y, x) for y in range(-2, 2) for x in range(-2, 2) if (y, x) != (0, 0)]
    shown = [
        (y, x) for y in range(-2, 3) for x in range(-2, 3) if (y, x) != (0, 0)
    ]  # of the twelve, -2 to 2
    scale = 0.04 / (sum(1 / (y**2 + x**2) for y, x in shown) / len(shown))
    want = []
    for y, x in own:
        total = 0.0
        for fy, fx in ((y + 4 * i, x + 4 * j) for i in (-1, 0, 1) for j in (-1, 0, 1)):
            power2 = (fy**2 + fx**2) / 12.0**2
            pixel = math.prod(
                math.sin(math.pi * f / 4) / (math.pi * f / 4) if f else 1.0
                for f in (fy, fx)
            )
            if min(fy, fx) >= -6 and max(fy, fx) < 6 and (fy, fx) != (0, 0):
                total += (
                    scale
                    / (fy**2 + fx**2)
                    * math.exp(-4 * math.pi**2 * 1.44 * power2)
                    * pixel**2
                )
        want.append(total)
    assert seen.tolist() == pytest.approx(want, rel=1e-9)
    assert whole.tolist() == pytest.approx([w + 0.01 for w in want], rel=1e-9)


def test_sides_of_a_focus_are_confused_by_a_symmetric_blur():
    depths = torch.linspace(16e3, 26e3, 11, dtype=torch.float64)
    texture = Texture(pitch_um=1.0, pixels=32, noise=0.01, folds=1)
    both_ways = 1.0 + 0.5 * (depths - 21e3).abs() * 1e-3
    one_way = 1.0 + 0.3 * (depths - 16e3) * 1e-3
    setting = dict(sample_um=0.5, texture=texture)
    confused = blind.blind_error(gaussian(both_ways), depths, **setting)
    told = blind.blind_error(gaussian(one_way), depths, **setting)
    mirror = (2 * (depths - 21e3).abs() * 1e-3) / 2  # either side equally likely
    assert torch.allclose(confused, mirror, atol=0.15)
    assert float(told.max()) < 0.5  # half a step of the depths
    same = blind.blind_error(
        gaussian(torch.full((11,), 2.0, dtype=torch.float64)), depths, **setting
    )
    apart = (depths[:, None] - depths).abs().mean(1) * 1e-3
    assert torch.allclose(same, apart, atol=1e-9)


def test_noise_of_a_bright_pixel_is_that_of_its_photons():
    sensor = Sensor(18.0, 9.0, 2000.0, 0.0, 4000.0, 0.0, 12)
    assert blind.relative_noise(sensor, albedo=0.5) == pytest.approx(
        1 / math.sqrt(4000), rel=1e-2
    )
    with pytest.raises(ConfigError, match="albedo"):
        blind.relative_noise(sensor, albedo=0.0)


def test_bad_input_is_refused():
    near, far, setting = pair()
    with pytest.raises(SceneError, match="sampled"):
        blind.blind_information(
            near, far, **(setting | {"texture": Texture(1.0, 16, folds=3)})
        )
    for wrong in (
        dict(pitch_um=0.0),
        dict(pitch_um=3.0, pixels=7),
        dict(pitch_um=3.0, folds=2),
    ):
        with pytest.raises(ConfigError):
            Texture(**wrong)


def test_noise_under_ambient_light_at_a_pitch_of_its_own():
    sensor = Sensor(4.1, 2.9, 730.0, 310.0, 5200.0, 17.3, 7)
    area, step = (4.1 / 2.9) ** 2, 5200 * (4.1 / 2.9) ** 2 / 127
    light = 0.43 * 730 * area
    want = math.sqrt(light + 310 * area + 17.3**2 + step**2 / 12) / light
    assert blind.relative_noise(sensor, albedo=0.43) == pytest.approx(
        want, rel=1e-6
    )  # the mean passes through float32
