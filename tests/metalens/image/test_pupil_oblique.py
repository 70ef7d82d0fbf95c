"""The quick pupil off axis: the axial model at angle 0, the full engine at 8 degrees,
and its gradient.
"""

import math

import numpy as np
import pytest
import torch

from metalens.design.profiles import Focus, hyperbolic_phase
from metalens.image import pupil as pupils
from metalens.image.pupil import Field, Pupil
from metalens.psf import psf_stack

PUPIL = Pupil(radius_um=300.0, nodes=128)
DEPTHS = torch.tensor([17e3, 24e3], dtype=torch.float64)


def test_on_axis_it_is_the_axial_model():
    rough = torch.randn(
        128, 128, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    want = pupils.psf(rough, PUPIL, depths_um=DEPTHS, focus_um=20e3)
    got = pupils.psf(
        rough, PUPIL, depths_um=DEPTHS, fields=[Field()] * 2, focus_um=20e3
    )
    assert (
        float((got - want).norm() / want.norm()) < 5e-3
    )  # cells on the rim are weighed along the lens, not the cone


@pytest.mark.parametrize("turn", [0.0, 0.25])
def test_a_lens_with_a_saddle_images_as_in_the_full_engine(turn):
    """A saddle breaks every symmetry; 8 degrees in +x, and in +y."""
    x, y = pupils.coordinates(PUPIL)
    field = Field(math.radians(8.0), 2 * math.pi * turn)
    saddle = 4 * (x / 300) ** 2 - 3 * (y / 300) ** 2 + 2 * (x / 300) ** 3
    got = pupils.psf(
        saddle, PUPIL, depths_um=DEPTHS, fields=[field] * 2, focus_um=20e3, samples=128
    )
    sites = 800
    axis = (np.arange(sites) - (sites - 1) / 2) * 0.75
    u, v = axis / 300, axis[:, None] / 300
    phase = (
        hyperbolic_phase(axis, axis[:, None], Focus(0.85, 2000.0, 20e3))
        + 4 * u**2
        - 3 * v**2
        + 2 * u**3
    )
    angle = (field.angle_rad, 0.0) if turn == 0 else (0.0, field.angle_rad)
    stack = psf_stack(
        phase, (np.hypot(axis, axis[:, None]) <= 300).astype(float), pitch_um=0.75, wavelength_um=0.85,
        sensor_distance_um=2000.0, depths_um=DEPTHS.numpy(), angle_rad=angle, window_um=96.0, samples=128,
        tolerance=1e-3,
    )  # fmt: skip
    want = torch.as_tensor(np.asarray(stack.intensity)).reshape(2, 128, 128).float()
    got = got / got.sum((1, 2), keepdim=True)
    # the saddle in steps of a node: 0.15 rad at the rim; rim cells; the cone's
    # obliquity factor
    assert float((got - want).norm() / want.norm()) < 0.04


def test_gradient_is_that_of_a_difference():
    generator = torch.Generator().manual_seed(3)
    small = Pupil(radius_um=150.0, nodes=48)
    phase = torch.randn(
        48, 48, generator=generator, dtype=torch.float64, requires_grad=True
    )
    along = torch.randn(48, 48, generator=generator, dtype=torch.float64)
    weight = torch.rand(64, 64, generator=generator)
    fields = [Field(0.2, 1.0), Field(0.1, 4.0)]

    def value(p):
        image = pupils.psf(
            p, small, depths_um=DEPTHS, fields=fields, focus_um=20e3, samples=64
        )
        return (image * weight).sum().double()

    (slope,) = torch.autograd.grad(value(phase), phase)
    with torch.no_grad():
        change = (value(phase + 0.01 * along) - value(phase - 0.01 * along)) / 0.02
    assert float((slope * along).sum()) == pytest.approx(
        float(change), rel=3e-3
    )  # single precision: 1e-5 / 0.02


def test_light_outside_the_window_is_what_is_missing():
    """At 20 degrees a hyperbolic lens throws most of its light out of 18 um, and no
    light is made.
    """
    steep = Field(math.radians(20.0), 0.7)
    flat = torch.zeros(128, 128, dtype=torch.float64)
    image = pupils.psf(
        flat, PUPIL, depths_um=DEPTHS, fields=[steep] * 2, focus_um=20e3, samples=256
    )
    assert bool((image.sum((1, 2)) < 1.002).all())
    assert bool((image.sum((1, 2)) > 0.9).all())
