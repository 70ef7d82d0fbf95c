"""Windowed propagation against the exact sum, case by case; its error estimate; its
derivatives.

Error budget: the tolerance asked for. The estimate may not be below the true error nor
above three times it.
"""

import dataclasses

import numpy as np
import pytest
import torch

from metalens import propagate, psf
from metalens.core.errors import PropagationError

WAVELENGTH, PITCH = 0.85, 0.4
K = 2 * np.pi / WAVELENGTH
GEOMETRY = dict(
    pitch_um=PITCH,
    wavelength_um=WAVELENGTH,
    sensor_distance_um=120.0,
    depths_um=[1000.0, 1300.0, 1800.0],
    window_um=16.0,
    samples=20,
)


def lens(shape, *, kind="focus", distance=120.0, source=1300.0, pitch=PITCH, seed=0):
    """Round lens that focuses ``source`` on the sensor; noisy, of random phases, or a
    double helix.
    """
    random = np.random.default_rng(seed)
    y, x = ((np.arange(n) - (n - 1) / 2) * pitch for n in shape)
    r2 = x**2 + y[:, None] ** 2
    phase = -K * (
        r2 / (np.sqrt(r2 + distance**2) + distance)
        + r2 / (np.sqrt(r2 + source**2) + source)
    )
    level = (r2 <= max(x[-1], y[-1], pitch) ** 2).astype(float)
    if kind == "noisy":
        phase = phase + random.normal(0, 0.3, shape)
        level = level * random.uniform(0.7, 1, shape)
    if kind == "random":
        phase = random.uniform(-np.pi, np.pi, shape)
    if kind == "helix":
        zone = np.clip(np.ceil(4 * r2 / r2.max()), 1, 4)
        phase = phase + (2 * zone - 1) * np.arctan2(y[:, None], x)
    return phase, level


def compare(phase, level, *, dtype=torch.float64, tolerance=1e-6, **geometry):
    """(stack, true relative error); maps carry gradients so that the exact sum is never
    chosen.
    """
    arguments = GEOMETRY | geometry
    given = torch.tensor(phase, dtype=dtype, requires_grad=True)
    maps = given, torch.tensor(level, dtype=dtype)
    stack = psf.psf_stack(*maps, tolerance=tolerance, integrate=False, **arguments)
    (stack.intensity**2).sum().backward()
    assert torch.isfinite(stack.intensity).all()
    assert torch.isfinite(given.grad).all()
    want = np.abs(propagate.exact(phase, level, **arguments)) ** 2
    want /= want.sum((-1, -2), keepdims=True)
    got = stack.numpy().intensity
    return stack, float(np.linalg.norm(got - want) / np.linalg.norm(want))


def check(phase, level, **arguments):
    stack, error = compare(phase, level, **arguments)
    assert stack.converged, stack.error
    assert error <= stack.tolerance
    assert error <= stack.error <= 3 * error + 2e-12, (error, stack.error)
    return stack


@pytest.mark.parametrize("kind", ["focus", "noisy", "random", "helix"])
@pytest.mark.parametrize("angle_rad", [0.0, (0.3, -0.2)])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_every_lens_meets_the_tolerance_and_the_estimate_tells(
    kind, angle_rad, tolerance
):
    check(*lens((96, 96), kind=kind), tolerance=tolerance, angle_rad=angle_rad)


@pytest.mark.parametrize("kind", ["focus", "random"])
def test_float32_inputs(kind):
    stack = check(
        *(np.float32(m).astype(float) for m in lens((128, 128), kind=kind)),
        dtype=torch.float32,
        tolerance=1e-4,
    )
    assert stack.intensity.dtype == torch.float32


def test_float32_reaches_a_millionth():
    phase, level = (np.float32(m).astype(float) for m in lens((128, 128), kind="noisy"))
    stack, error = compare(phase, level, dtype=torch.float32, tolerance=1e-6)
    assert error <= 1e-6
    assert error <= stack.error <= 1e-6


def test_source_1_mm_away_and_at_infinity():
    check(*lens((96, 96)), depths_um=[1000.0, np.inf])


@pytest.mark.parametrize(("distance", "window"), [(20.0, 12.0), (200e3, 12000.0)])
def test_sensor_at_20_um_and_200_mm(distance, window):
    shape = (48, 48) if distance < 100 else (96, 96)
    check(
        *lens(shape, distance=distance),
        sensor_distance_um=distance,
        window_um=window,
        tolerance=1e-5,
    )


@pytest.mark.parametrize(
    ("shape", "samples"), [((95, 95), 20), ((96, 96), 19), ((95, 96), 20)]
)
def test_odd_and_even_grids(shape, samples):
    check(*lens(shape, kind="noisy"), samples=samples)


def test_window_off_by_half_a_pixel():
    shifted = check(*lens((96, 96), kind="noisy"), offset_um=(0.4, 0.0))
    centred = check(*lens((96, 96), kind="noisy"))
    moved = shifted.numpy().intensity[..., :-1] / shifted.numpy().intensity[
        ..., :-1
    ].sum((-1, -2), keepdims=True)
    other = centred.numpy().intensity[..., 1:] / centred.numpy().intensity[..., 1:].sum(
        (-1, -2), keepdims=True
    )
    # half a sample of 0.8 um matters
    assert np.linalg.norm(moved - other) > 0.1 * np.linalg.norm(other)


def test_40_degree_field():
    check(*lens((96, 96)), angle_rad=np.deg2rad(40.0), window_um=30.0)


@pytest.mark.parametrize("pitch", [0.3, 0.425, 0.7, 3.0])
def test_pitch_below_and_above_half_a_wavelength(pitch):
    check(*lens((64, 64), pitch=pitch), pitch_um=pitch, window_um=12.0)


def test_single_open_pillar_is_a_sphere():
    level = np.zeros((33, 33))
    level[20, 9] = 0.5
    stack, _ = compare(np.zeros((33, 33)), level, tolerance=1e-9)
    x = (np.arange(20) - 9.5) * 0.8
    dx, dy = x - (9 - 16) * PITCH, x - (20 - 16) * PITCH
    r2 = dx**2 + dy[:, None] ** 2 + 120.0**2
    want = 1 / r2**2 * (1 / r2 + K**2)
    energy = (want * (0.5 * PITCH**2 * 120.0 / (2 * np.pi)) ** 2).sum() * 0.8**2
    got = stack.numpy()
    assert abs(got.intensity[0] - want / want.sum()).max() < 1e-9 * got.intensity.max()
    assert got.energy_um2 == pytest.approx(energy, rel=1e-9)


def test_one_pillar_in_all():
    check(np.zeros((1, 1)), np.ones((1, 1)), tolerance=1e-9)


def test_window_of_one_pixel():
    stack, error = compare(*lens((64, 64)), samples=1, window_um=0.8)
    assert error == 0  # the only sample holds all the light
    want = (
        np.abs(
            propagate.exact(
                *lens((64, 64)), **GEOMETRY | dict(samples=1, window_um=0.8)
            )[:, 0, 0]
        )
        ** 2
        * 0.64
    )
    assert stack.numpy().energy_um2 == pytest.approx(want, rel=1e-6)


def test_empty_aperture_is_refused():
    with pytest.raises(PropagationError, match="empty aperture"):
        psf.psf_stack(np.zeros((8, 8)), np.zeros((8, 8)), **GEOMETRY)


def test_nan_is_refused_with_its_place():
    phase, level = lens((16, 16))
    phase[3, 5] = np.nan
    with pytest.raises(PropagationError, match="row 3, column 5"):
        psf.psf_stack(phase, level, **GEOMETRY)


@pytest.mark.parametrize("shape", [(40, 120), (120, 40)])
def test_maps_that_are_not_square(shape):
    check(*lens(shape, kind="noisy"), angle_rad=(0.1, 0.2))


def test_a_large_window_is_cut_into_tiles_over_one_pass_of_the_pillars():
    geometry = dict(sensor_distance_um=20.0, window_um=30.0, samples=16)
    check(*lens((64, 64), distance=20.0), tolerance=1e-4, **geometry)


@pytest.mark.parametrize(
    ("window_um", "offset_um"),
    [pytest.param(900.0, (0.0, 0.0), marks=pytest.mark.slow), (500.0, (200.0, -50.0))],
)
def test_a_window_that_is_wide_for_its_distance(window_um, offset_um):
    """The middle of the window is seen under a larger angle than its corners."""
    phase, level = lens((38, 41), kind="random")
    _, error = compare(
        phase,
        level,
        tolerance=1e-3,
        sensor_distance_um=300.0,
        window_um=window_um,
        samples=45,
        offset_um=offset_um,
    )
    assert error < 1e-3


@pytest.mark.slow
def test_a_window_too_large_for_the_windowed_method_goes_by_transforms():
    geometry = dict(pitch_um=3.0, sensor_distance_um=3000.0, window_um=800.0, samples=6)
    check(*lens((300, 300), distance=3000.0, pitch=3.0), tolerance=1e-4, **geometry)


def test_energy_is_kept_in_a_large_window():
    """All light of a small smooth lens meets the sensor: Σ|U|² dx² equals that of the
    exact sum to 1e-6.
    """
    y, x = np.mgrid[:32, :32] - 15.5
    level = np.exp(-(x**2 + y**2) / 40)
    geometry = GEOMETRY | dict(
        sensor_distance_um=40.0, window_um=60.0, samples=48, depths_um=[1e4]
    )
    phase = torch.zeros(32, 32, dtype=torch.float64, requires_grad=True)
    got = (
        psf.psf_stack(phase, torch.tensor(level), tolerance=1e-7, **geometry)
        .numpy()
        .energy_um2[0]
    )
    step = 60.0 / 48
    want = (
        np.abs(propagate.exact(np.zeros((32, 32)), level, **geometry)) ** 2
    ).sum() * step**2
    assert got == pytest.approx(want, rel=1e-6)
    # Parseval; the rest misses the window
    assert got == pytest.approx((level**2).sum() * PITCH**2, rel=2e-3)


def test_a_batch_of_lenses_equals_the_lenses():
    maps = [lens((48, 48), kind="noisy", seed=s) for s in range(2)]
    phase, level = (np.stack([m[i] for m in maps]) for i in (0, 1))
    both = psf.psf_stack(phase, level, **GEOMETRY)
    for i, (p, t) in enumerate(maps):
        one = psf.psf_stack(p, t, **GEOMETRY)
        assert np.allclose(both.intensity[i], one.intensity, rtol=0, atol=1e-14)


def test_a_tilt_moves_the_light_to_plus_x_and_a_slip_down_to_plus_y():
    y, x = np.mgrid[:64, :64] - 31.5
    phase, level = lens((64, 64))
    tilted = phase + K * 0.02 * x * PITCH + K * 0.01 * y * PITCH
    stack = psf.psf_stack(tilted, level, **GEOMETRY)
    light = stack.intensity[1]
    # rings are cut by the window
    assert (light.sum(0) * stack.x_um).sum() == pytest.approx(120 * 0.02, abs=0.15)
    assert (light.sum(1) * stack.y_um).sum() == pytest.approx(120 * 0.01, abs=0.15)


def central(function, step):
    """Fourth-order finite difference of a scalar function at 0."""
    return (
        8 * (function(step) - function(-step))
        - (function(2 * step) - function(-2 * step))
    ) / (12 * step)


def score(phase, level, **geometry):
    """A scalar that breaks every symmetry of the stack."""
    stack = psf.psf_stack(phase, level, tolerance=1e-9, **GEOMETRY | geometry)
    shape = stack.intensity.shape
    ramp = torch.arange(shape.numel(), dtype=torch.float64).view(shape)
    return (
        torch.sin(0.37 * ramp) * stack.intensity
    ).sum() + 1e-3 * stack.energy_um2.sum()


def test_directional_derivatives_in_phase_and_transmission():
    phase, level = (torch.tensor(m) for m in lens((48, 48), kind="noisy"))
    random = torch.Generator().manual_seed(0)
    way = torch.randn(2, 48, 48, generator=random, dtype=torch.float64)
    at = [m.clone().requires_grad_() for m in (phase, level)]
    grads = torch.autograd.grad(score(*at), at)
    for i in (0, 1):
        want = central(
            lambda h, i=i: score(
                phase + h * way[0] * (i == 0), level + h * way[1] * (i == 1)
            ).item(),
            1e-3,
        )
        assert (grads[i] * way[i]).sum().item() == pytest.approx(want, rel=1e-7)


def test_gradient_against_the_exact_sum():
    """dU/dφ of a pillar is i times its own share of U, known in closed form."""
    phase, level = lens((64, 64), kind="noisy")
    fields = propagate.exact(phase, level, **GEOMETRY)
    weight = np.random.default_rng(1).uniform(size=fields.shape)
    given = torch.tensor(phase, requires_grad=True)
    stack = psf.psf_stack(given, torch.tensor(level), **GEOMETRY)
    (stack.intensity * torch.tensor(weight)).sum().backward()
    power = np.abs(fields) ** 2
    total = power.sum((1, 2), keepdims=True)
    slope = weight / total - (weight * power).sum((1, 2), keepdims=True) / total**2
    pillars = np.random.default_rng(0).choice(np.flatnonzero(level), 60, replace=False)
    want = []
    for pillar in pillars:
        alone = np.zeros_like(level)
        alone.flat[pillar] = level.flat[pillar]
        share = propagate.exact(phase, alone, **GEOMETRY)
        want.append((slope * 2 * (np.conj(fields) * 1j * share).real).sum())
    got = given.grad.numpy().flat[pillars]
    assert np.linalg.norm(got - want) < 2e-4 * np.linalg.norm(want)


@pytest.mark.parametrize(
    "merit", [lambda light: (light**2).sum(), lambda light: light[1, 9:11, 9:11].sum()]
)
def test_gradient_at_a_focus_where_it_nearly_vanishes(merit):
    """A lens in focus with all its light on the window: what is left of the gradient is
    small beside its parts.
    """
    phase, level = (torch.tensor(m) for m in lens((128, 128)))
    grads = []
    for tolerance in (1e-4, 1e-10):
        given = phase.clone().requires_grad_()
        stack = psf.psf_stack(
            given, level, tolerance=tolerance, **GEOMETRY | dict(window_um=32.0)
        )
        merit(stack.intensity).backward()
        grads.append(given.grad)
    assert (grads[0] - grads[1]).norm() < 2e-4 * grads[1].norm()


def test_choose_takes_the_exact_sum_for_few_pillars_and_says_why():
    small = propagate.choose_method(propagate.make_case((8, 8), **GEOMETRY), 1e-4)
    large = propagate.choose_method(propagate.make_case((600, 600), **GEOMETRY), 1e-4)
    assert small.method == "exact"
    assert "64 pillars" in small.reason
    assert large.method == "windowed"
    assert "nodes" in large.reason
    assert (
        propagate.choose_method(
            propagate.make_case((8, 8), **GEOMETRY), 1e-4, differentiable=True
        ).method
        == "windowed"
    )


def test_settings_that_cannot_be_met_are_reported_not_hidden():
    stack, error = compare(*lens((64, 64)), tolerance=1e-13)
    assert not stack.converged
    assert error < 1e-9
    assert dataclasses.replace(stack, tolerance=1e-9).converged
