"""The optics that training moves: they are those of the full lens, their gradients are
exact, their errors physical.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.optics import stack as optics
from codesign.optics.lens_errors import DrawnLensErrors, LensErrors, pillar_proxy
from codesign.optics.stack import OpticsConfig
from metalens.core.errors import ConfigError, TrainingError
from metalens.image.pupil import coordinates, psf
from metalens.psf import psf_stack

SMALL = OpticsConfig(
    aperture_mm=0.2,
    sensor_distance_mm=0.4,
    focus_mm=20.0,
    polynomials=12,
    depths_mm=(14.0, 40.0),
    depth_count=3,
    sample_um=4.0,
    window_samples=17,
)


def _coefficients(scale=0.5):
    return scale * torch.randn(
        SMALL.polynomials,
        generator=torch.Generator().manual_seed(4),
        dtype=torch.float64,
    )


def samples_fine(settings):
    """Odd number of fine intensities a sample, at most lambda / (4 NA) apart."""
    count = math.ceil(2 * settings.sample_um / settings.pupil.field_step_um)
    return count + 1 - count % 2


def pupil_phase(settings, coefficients):
    """(nodes, nodes) phase beyond the hyperbolic focus on the pupil's nodes, rad."""
    return optics.phase_at(settings, coefficients, *coordinates(settings.pupil))


def _on_samples(fine, settings):
    """Fine intensities integrated over samples and low-passed to the grid of the
    samples, by two plain sums.
    """
    period, step = settings.pupil.period_um, settings.sample_um
    edge = period / (2 * step)
    top = math.floor(edge + 0.5)
    number = torch.arange(-top, top + 1, dtype=torch.float64)
    frequency = number / period
    kept = (edge - number.abs() + 0.5).clamp(0, 1)
    from_x = (
        (torch.arange(fine.shape[-1], dtype=torch.float64) - (fine.shape[-1] - 1) / 2)
        * step
        / samples_fine(settings)
    )
    to_x = (
        torch.arange(settings.window_samples) - (settings.window_samples - 1) / 2
    ) * step
    waves = torch.cos(2 * math.pi * frequency * (to_x[:, None, None] - from_x[:, None]))
    taps = (kept * torch.sinc(frequency * step) * waves).sum(-1) * step / period
    return taps @ fine @ taps.mT


def test_stack_is_the_intensity_of_the_pupil_on_samples_of_the_image():
    coefficients = _coefficients()
    wide = replace(SMALL, window_samples=31)
    fine = psf(
        pupil_phase(wide, coefficients),
        wide.pupil,
        depths_um=wide.depths_um,
        focus_um=20e3,
        sample_um=wide.sample_um / samples_fine(wide),
        samples=wide.window_samples * samples_fine(wide),
    )
    want = _on_samples(fine.double(), wide)
    got = optics.lens_psf_stack(wide, coefficients).intensity
    # light outside the window of the reference
    assert float((got - want).norm() / want.norm()) < 1e-3


@pytest.mark.parametrize(
    ("zones", "angle_deg"), [(0, 0.0), (3, 0.0), (0, 12.0), (3, -12.0)]
)
def test_psfs_are_those_of_the_pillar_lens_by_the_full_engine(zones, angle_deg):
    settings = replace(SMALL, zones=zones, angle_deg=angle_deg)
    coefficients = _coefficients()
    quick = optics.lens_psf_stack(settings, coefficients).intensity
    n, pitch = 500, 0.4
    x = (np.arange(n) - (n - 1) / 2) * pitch
    inside = (x[:, None] ** 2 + x**2 <= 100.0**2).astype(float)
    phase = optics.pillar_phase(settings, coefficients)(x, x)
    fine = samples_fine(settings)
    samples = settings.window_samples * fine
    full = psf_stack(
        phase,
        inside,
        pitch_um=pitch,
        wavelength_um=0.85,
        sensor_distance_um=400.0,
        depths_um=settings.depths_um.numpy(),
        angle_rad=math.radians(angle_deg),
        window_um=settings.window_samples * settings.sample_um,
        samples=samples,
        tolerance=1e-4,
    ).intensity
    pixels = _on_samples(torch.from_numpy(full), settings)
    quick = quick / quick.sum((1, 2), keepdim=True)
    pixels = pixels / pixels.sum((1, 2), keepdim=True)
    error = ((quick - pixels).norm(dim=(1, 2)) / pixels.norm(dim=(1, 2))).max()
    # first order in the window's size: k x³ / (2 d²) tan = 2e-2 at the window's edge,
    # where little light falls;
    # and the rim in 64 nodes against 500 pillars
    assert float(error) < 0.03


@pytest.mark.parametrize("angle_deg", [0.0, 10.0])
def test_gradient_agrees_with_a_finite_difference(angle_deg):
    settings = replace(SMALL, angle_deg=angle_deg)
    coefficients = _coefficients().requires_grad_()
    weight = torch.randn(3, 17, 17, generator=torch.Generator().manual_seed(5))
    value = (optics.lens_psf_stack(settings, coefficients).intensity * weight).sum()
    (gradient,) = torch.autograd.grad(value, coefficients)
    direction = torch.randn(
        12, generator=torch.Generator().manual_seed(6), dtype=torch.float64
    )
    step = 1e-3
    ahead, behind = (
        float(
            (
                optics.lens_psf_stack(
                    settings, coefficients.detach() + s * direction
                ).intensity.double()
                * weight
            ).sum()
        )
        for s in (step, -step)
    )
    # the intensity is float32: 1e-7 / 1e-3 of rounding, and the third derivative times
    # step²
    assert float(gradient @ direction) == pytest.approx(
        (ahead - behind) / (2 * step), rel=3e-3
    )


def test_a_shifted_sensor_is_a_shifted_focus():
    """A longer sensor distance d + e is in focus for 1/z = 1/z0 + e/d² (paraxial): the
    error phase does that.
    """
    shifted = 2.0
    vergence = 1 / 20_000.0 + shifted / 400.0**2
    error = DrawnLensErrors({"focus_um": shifted})
    with_error = optics.lens_psf_stack(SMALL, torch.zeros(12), error=error).intensity
    peaks = [
        float(
            optics.lens_psf_stack(replace(SMALL, focus_mm=1e-3 / v), torch.zeros(12))
            .intensity[0]
            .max()
        )
        for v in (vergence, 2 / 20_000.0 - vergence)
    ]
    same, opposite = (abs(float(with_error[0].max()) - p) for p in peaks)
    # fourth order in the aperture is left
    assert same < 0.02 * float(with_error[0].max()) < opposite


def test_astigmatism_and_tilt_keep_the_light_and_break_the_symmetry():
    plain = optics.lens_psf_stack(SMALL, torch.zeros(12)).intensity[1]
    bent = optics.lens_psf_stack(
        SMALL,
        torch.zeros(12),
        error=DrawnLensErrors({"tilt_waves": 0.3, "astigmatism_waves": 0.3}),
    ).intensity[1]
    assert torch.allclose(plain, plain.mT, atol=1e-6)
    assert not torch.allclose(bent, bent.mT, atol=1e-3)
    # the light within the window, of which the ripples of the low-pass at its edge are
    # 1 %
    assert float(bent.sum()) == pytest.approx(float(plain.sum()), abs=0.02)


def test_lost_optics_and_impossible_settings_are_refused():
    with pytest.raises(TrainingError, match="learning rate of the optics"):
        optics.lens_psf_stack(SMALL, torch.full((12,), float("nan")))
    with pytest.raises(ConfigError, match="depths_mm"):
        replace(SMALL, depths_mm=(20.0, 10.0))
    with pytest.raises(ConfigError, match="odd number"):
        replace(SMALL, window_samples=16)


def test_lens_errors_have_the_deviations_that_were_asked_for():
    """4000 draws: four sigma of a variance are 0.09 of it; turns are even over a circle."""
    spread = LensErrors(
        focus_um=2.0, tilt_waves=0.1, bias_nm=4.0, height_nm=8.0, gradient_nm=3.0
    )
    generator = torch.Generator().manual_seed(0)
    drawn = [spread.draw(generator) for _ in range(4000)]
    names = ("focus_um", "tilt_waves", "bias_nm", "height_nm", "gradient_nm")
    values = np.array([[one.amounts[name] for name in names] for one in drawn])
    unit = np.cov((values / [2.0, 0.1, 4.0, 8.0, 3.0]).T)
    assert abs(unit - np.eye(5)).max() < 0.09
    assert {one.amounts["index"] for one in drawn} == {0.0}
    turn = np.array([one.turn_rad for one in drawn])
    assert 0 < turn.min() < turn.max() < 2 * math.pi
    assert turn.mean() == pytest.approx(math.pi, abs=0.12)
    assert turn.std() == pytest.approx(2 * math.pi / math.sqrt(12), rel=0.05)
    assert LensErrors().draw(generator) is None


def test_a_bias_of_the_diameters_sends_light_straight_on():
    plain = optics.lens_psf_stack(SMALL, torch.zeros(12)).intensity
    hazy = optics.lens_psf_stack(
        SMALL, torch.zeros(12), error=DrawnLensErrors({"bias_nm": 20.0})
    ).intensity
    # pillars with phases evenly over a turn: rad of each for a nanometre of diameter
    wave_um = SMALL.wavelength_nm * 1e-3
    proxy = pillar_proxy(SMALL.cell, wave_um)
    diameter = np.linspace(*proxy.domain_um, 20_001)
    phase = proxy.phase_rad(diameter, wave_um)
    even = phase[0] + np.linspace(0, 2 * math.pi, 400, endpoint=False)
    slope = np.interp(even, phase, np.gradient(phase, diameter * 1e3))
    lost = 1 - math.exp(-np.var(slope, ddof=1) * 20.0**2)
    window = (SMALL.window_samples * SMALL.sample_um) ** 2 / (math.pi * 100.0**2)
    want = (1 - lost) * plain.sum((1, 2)) + lost * window
    torch.testing.assert_close(hazy.sum((1, 2)), want, rtol=1e-4, atol=0)
