"""Pixels that are added in squares: light of the fine ones, wherever the grid is moved."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from metalens.psf import PsfStack, on_pixels

draw = np.random.default_rng(3)


def made():
    light = draw.uniform(0, 1, (1, 2, 48, 48))
    light /= light.sum((-1, -2), keepdims=True)
    about = {
        "weights": np.ones(1),
        "step_um": 0.5,
        "centres_um": np.zeros((1, 2)),
        "sensor_distance_um": 900.0,
    }
    axes = {
        "depths_um": np.array([5e3, 9e3]),
        "angles_rad": np.zeros((1, 2)),
        "wavelengths_um": np.array([0.85]),
    }
    return PsfStack(
        light,
        np.array([[700.0, 400.0]]),
        **axes,
        **about,
        tolerance=1e-4,
        error=1e-4,
        reason="drawn",
    )


@pytest.mark.parametrize("bins", [2, 3])
def test_a_binned_pixel_holds_the_light_of_its_pixels(bins):
    """12 pixels of 1.5 um and half of a window of 24: what fine pixels hold, times
    their energy, adds up.
    """
    stack = made()
    fine = on_pixels(stack, pitch_um=1.5, count=12, shift_um=(0.4, -0.7))
    wide = on_pixels(
        stack, pitch_um=1.5, bins=bins, count=12 // bins, shift_um=(0.4, -0.7)
    )
    assert (fine.step_um, wide.step_um) == (1.5, 1.5 * bins)
    light = fine.intensity * fine.energy_um2[..., None, None]
    added = light.reshape(1, 2, 12 // bins, bins, 12 // bins, bins).sum((3, 5))
    assert wide.intensity * wide.energy_um2[..., None, None] == pytest.approx(
        added, rel=1e-9
    )
    assert wide.energy_um2 == pytest.approx(fine.energy_um2, rel=1e-9)
    assert (wide.energy_um2 < 0.8 * stack.energy_um2).all()


def test_light_in_pixels_is_of_sum_one_and_its_energy_what_falls_on_them():
    """Pixels of three samples: sums of blocks of 3 x 3, of the whole window or of its
    middle 18 um.
    """
    stack = made()
    blocks = stack.intensity.reshape(1, 2, 16, 3, 16, 3).sum((3, 5))
    for count, part in ((None, slice(None)), (12, slice(2, 14))):
        got = on_pixels(stack, pitch_um=1.5, count=count)
        light = blocks[..., part, part]
        share = light.sum((2, 3))
        assert got.intensity == pytest.approx(light / share[..., None, None], rel=1e-9)
        assert got.energy_um2 == pytest.approx(stack.energy_um2 * share, rel=1e-9)
        assert isinstance(got.intensity, np.ndarray)


def test_a_pitch_that_is_trained_keeps_its_derivative():
    stack = made()
    pitch = torch.tensor(1.7, dtype=torch.float64, requires_grad=True)

    def weighed(pitch_um):
        found = on_pixels(stack, pitch_um=pitch_um, count=9)
        rows = np.arange(9.0)[:, None] - 2 * np.arange(9.0)
        return (
            torch.as_tensor(found.intensity) * torch.from_numpy(rows)
        ).sum() + torch.as_tensor(found.energy_um2).sum()

    weighed(pitch).backward()
    step = 1e-6
    want = (float(weighed(1.7 + step)) - float(weighed(1.7 - step))) / (2 * step)
    assert float(pitch.grad) == pytest.approx(want, rel=1e-6)
    assert on_pixels(stack, pitch_um=pitch, count=9).step_um == pytest.approx(1.7)


def test_an_error_within_the_tolerance_has_converged_the_end_included():
    for error, met in ((0.99e-4, True), (1e-4, True), (1.01e-4, False)):
        assert replace(made(), error=error).converged is met
