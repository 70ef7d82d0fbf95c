"""The PSF record: normalisation, angles, wavelengths, files, pixels, metrics; answers
in closed form.
"""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from metalens import propagate, psf
from metalens.core.errors import PropagationError
from metalens.psf import metrics as psf_metrics
from metalens.psf import spectrum

GEOMETRY = dict(
    pitch_um=0.4,
    wavelength_um=0.85,
    sensor_distance_um=120.0,
    depths_um=[1000.0, 1600.0],
)
WINDOW = dict(window_um=16.0, samples=20)


def focus(n=64, source=1300.0, distance=120.0, wavelength=0.85):
    x = (np.arange(n) - (n - 1) / 2) * 0.4
    r2 = x**2 + x[:, None] ** 2
    path = r2 / (np.sqrt(r2 + distance**2) + distance) + r2 / (
        np.sqrt(r2 + source**2) + source
    )
    return -2 * np.pi / wavelength * path, (r2 <= x[-1] ** 2).astype(float)


def gaussian_stack(widths, step=0.5, n=81):
    """Gaussian PSFs of given standard deviations along depth."""
    x = (np.arange(n) - (n - 1) / 2) * step
    r2 = x**2 + x[:, None] ** 2
    light = np.stack([np.exp(-r2 / (2 * w * w)) for w in widths])
    base = psf.psf_stack(*focus(16), **GEOMETRY, **WINDOW)
    depths = np.linspace(16e3, 18e3, len(widths))
    light /= light.sum((1, 2), keepdims=True)
    ones = np.ones(len(widths))
    return dataclasses.replace(
        base, intensity=light, energy_um2=ones, depths_um=depths, step_um=step
    )


def test_each_psf_has_sum_one_and_its_energy_beside_it():
    phase, level = focus()
    stack = psf.psf_stack(phase, level, **GEOMETRY, **WINDOW)
    power = np.abs(propagate.exact(phase, level, **GEOMETRY, **WINDOW)) ** 2
    assert stack.intensity.sum((1, 2)) == pytest.approx(1, abs=1e-12)
    assert stack.energy_um2 == pytest.approx(power.sum((1, 2)) * 0.8**2, rel=1e-4)
    assert stack.intensity.dtype == np.float64


def test_angles_make_an_axis_and_equal_single_angles():
    phase, level = focus()
    several = psf.psf_stack(
        phase, level, **GEOMETRY, **WINDOW, angle_rad=[[0.1, 0.0], [0.0, -0.2]]
    )
    assert several.intensity.shape == (2, 2, 20, 20)
    assert several.angles_rad == pytest.approx(np.array([[0.1, 0.0], [0.0, -0.2]]))
    assert several.centres_um[1] == pytest.approx([0, 120 * np.tan(-0.2)])
    one = psf.psf_stack(phase, level, **GEOMETRY, **WINDOW, angle_rad=(0.0, -0.2))
    # of sum 1: rounding of angles side by side
    assert several.intensity[1] == pytest.approx(one.intensity, abs=1e-12)


def test_torch_in_torch_out_and_dtype_follows():
    phase, level = (torch.tensor(m, dtype=torch.float32) for m in focus())
    stack = psf.psf_stack(phase, level, **GEOMETRY, **WINDOW)
    assert isinstance(stack.intensity, torch.Tensor)
    assert stack.intensity.dtype == torch.float32
    with pytest.raises(PropagationError, match="float32 or float64"):
        psf.psf_stack(torch.zeros(4, 4, dtype=torch.int32), level, **GEOMETRY, **WINDOW)


@settings(max_examples=15)
@given(pitch=st.floats(1.0, 7.0), bins=st.integers(1, 3))
def test_pixels_keep_all_light(pitch, bins):
    light = torch.tensor(gaussian_stack([2.0, 3.0]).intensity)
    seen = psf.integrate_pixels(light, 0.5, pitch_um=pitch * bins)
    assert seen.sum((1, 2)).numpy() == pytest.approx(1, abs=1e-6)


def test_binning_twice_equals_pixels_twice_as_wide():
    light = torch.tensor(gaussian_stack([2.0], n=80).intensity)
    fine, wide = (
        psf.integrate_pixels(light, 0.5, pitch_um=pitch).numpy() for pitch in (2.5, 5.0)
    )
    assert np.abs(fine.reshape(1, 8, 2, 8, 2).sum((2, 4)) - wide).max() < 1e-12


def test_pixels_are_differentiable_in_pitch():
    light = torch.tensor(gaussian_stack([2.0]).intensity)
    pitch = torch.tensor(3.13, dtype=torch.float64, requires_grad=True)

    def score(p):
        seen = psf.integrate_pixels(light, 0.5, pitch_um=p, shape=(9, 9))
        return ((seen / seen.sum()) ** 2).sum()

    score(pitch).backward()
    want = (score(3.13 + 1e-6) - score(3.13 - 1e-6)) / 2e-6
    assert pitch.grad.item() == pytest.approx(want.item(), rel=1e-5)


def test_blur_of_even_discs_is_their_radius():
    """Of two discs, one off the middle; quarters lie on whole samples, one off at most."""
    place = (np.arange(201) - 100) * 0.5
    near, wide = (
        np.hypot(place - at, place[:, None] + 2 * at) <= b
        for at, b in ((0.0, 37.0), (7.0, 19.0))
    )
    np.testing.assert_allclose(
        psf_metrics.blur_um(np.stack([near, wide]).astype(float), 0.5),
        [37.0, 19.0],
        atol=0.5 / 0.404,
    )
    middle = near[80:121, 70:131].astype(float)  # lit all over, 20.5 by 30.5 um of it
    held = 20.5 * 30.5 / (np.pi * 37.0**2)
    assert psf_metrics.blur_um(middle, 0.5, held) == pytest.approx(37.0, rel=1e-12)
    # a tenth of the light beside it, half on either side
    most = wide[20:, 60:].astype(float)
    ends = np.quantile(
        np.repeat(place[60:], most.sum(0).astype(int)),
        [0.5 - 0.25 / 0.9, 0.5 + 0.25 / 0.9],
    )
    down = np.quantile(
        np.repeat(place[20:], most.sum(1).astype(int)),
        [0.5 - 0.25 / 0.9, 0.5 + 0.25 / 0.9],
    )
    want = np.hypot(np.ptp(ends), np.ptp(down)) / 2 / 0.404 / np.sqrt(2)
    assert psf_metrics.blur_um(most, 0.5, 0.9) == pytest.approx(want, abs=0.5 / 0.404)


def test_polychromatic_psf_converges_with_the_nodes():
    phase, level = focus(96, wavelength=0.85)
    path = np.hypot(19.0, 120.0) - 120.0 + np.hypot(19.0, 1000.0) - 1000.0
    results = []
    for tolerance in (1e-2, 1e-3, 1e-7):
        found = spectrum.spectral_nodes(
            spectrum.Source(), path_um=path, tolerance=tolerance
        )
        maps = np.stack([phase] * len(found.weights))
        other = GEOMETRY | dict(wavelength_um=found.wavelengths_um.tolist())
        results.append(
            psf.psf_stack(
                maps,
                level,
                **other,
                **WINDOW,
                weights=found.weights.tolist(),
                tolerance=1e-7,
            ).intensity
        )
    errors = [
        np.linalg.norm(r - results[-1]) / np.linalg.norm(results[-1])
        for r in results[:2]
    ]
    assert errors[0] < 1e-2
    assert errors[1] < 1e-3


def test_a_direction_off_both_axes_asks_the_proxy_for_its_angle_to_the_axis():
    from metalens.cell import Cell
    from metalens.lens import DiameterMap, Lens, response
    from metalens.library import Proxy
    from metalens.psf.lens_psfs import library_incidence

    angled = (
        np.array([[[1.3, 4.0]], [[0.4, 0.0]]]),
        np.array([[[0.6, 0.3]], [[-0.05, 0.0]]]),
    )  # of sin² of the angle
    proxy = Proxy(*angled, (0.1, 0.3), (0.9, 0.98), 0.0, 0.0, max_angle_rad=0.5)
    sizes = np.array([[0.1, 0.0], [0.3, 0.22]])
    lens = Lens(
        DiameterMap(sizes, 0.4), Cell(pitch_um=0.4), proxy, 0.95, 120.0, 1300.0, "map"
    )
    phase, level = np.empty((2, 2)), np.empty((2, 2))
    response.fill_response(
        lens, (0.94, library_incidence(lens, (0.17, -0.31))), phase, level
    )
    direction = np.array([np.tan(0.17), np.tan(-0.31), 1.0])
    tilt = np.arccos(1 / np.linalg.norm(direction))
    share = 2 * (np.sin(tilt) / np.sin(0.5)) ** 2 - 1
    want = np.where(sizes > 0, 1.3 + 4.0 * (10 * sizes - 2) + 0.4 * share, 0)
    assert np.exp(1j * phase) == pytest.approx(np.exp(1j * want), abs=1e-12)
    assert np.abs(phase).max() <= np.pi
    assert level == pytest.approx(
        np.where(sizes > 0, 3 * sizes - 0.05 * share, 0), abs=1e-12
    )
    # a library of normal incidence alone
    upright = Proxy(angled[0][0], angled[1][0], (0.1, 0.3), (0.9, 0.98), 0.0, 0.0)
    flat = dataclasses.replace(lens, proxy=upright)
    response.fill_response(
        flat, (0.94, library_incidence(flat, (0.17, -0.31))), phase, level
    )
    assert level == pytest.approx(3 * sizes)


def test_metrics_of_an_oblong_spot_off_the_middle():
    """Gaussian of 2.1 by 1.3 um about (1.5, -2.3): each axis has its own number, radii
    count from the centroid.
    """
    stack = gaussian_stack([2.0, 2.0], step=0.4, n=81)
    x = stack.x_um
    light = np.exp(
        -((x - 1.5) ** 2) / (2 * 2.1**2) - (x[:, None] + 2.3) ** 2 / (2 * 1.3**2)
    )
    light = np.stack([light, light[::-1]]) / light.sum()
    stack = dataclasses.replace(stack, intensity=light, energy_um2=np.array([3.0, 7.0]))
    f = np.array([0.03, 0.11])
    found = psf_metrics.mtf(stack, frequencies_per_um=f)
    want = [np.exp(-2 * (np.pi * s * f) ** 2) for s in (2.1, 1.3)]
    assert found == pytest.approx(np.array([want, want]), abs=1e-7)
