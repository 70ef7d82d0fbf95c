"""Parts of a PSF's light and of its error, each by hand: noise of pillars, the darkest
depth, faces that are passed.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens import psf
from metalens.propagate import MovingGeometry, PropagationCase, blocks
from metalens.psf import compute
from metalens.psf.compute import IntensityResult

CASE = PropagationCase(
    (30, 41),
    0.37,
    0.85,
    62.0,
    (0.21, -0.13),
    (1 / 400, 1 / 900),
    (14.0, -8.5),
    0.6,
    (9, 11),
)
OTHER = PropagationCase(
    (30, 41),
    0.37,
    0.79,
    62.0,
    (0.21, -0.13),
    (1 / 400, 1 / 900),
    (14.0, -8.5),
    0.6,
    (9, 11),
)


def test_a_phasor_errs_by_arithmetic_interpolation_and_long_paths():
    made = SimpleNamespace(
        moments=SimpleNamespace(carrier=SimpleNamespace(rounding_rad=3e-4))
    )
    got = compute._phasor(torch.float32, 4e-3, made)  # a fortieth of the setting
    assert got == pytest.approx(math.hypot(8e-7, 1e-4, 3e-4), rel=1e-12)


def test_light_that_rounds_is_that_of_every_component_at_its_largest_factor():
    """Two components of three maps: squares of the largest factors times the maps' sums
    of squares.
    """
    factors = np.zeros((2, 3, 4, 5))
    (
        factors[0, 0, 1, 2],
        factors[0, 0, 3, 3],
        factors[0, 2, 0, 0],
        factors[1, 1, 2, 2],
    ) = 0.3, -0.7, 1.2, 0.4
    powers = [10.0, 20.0, 50.0]
    got = compute._noisy(powers, (np.array([1.0, -1.0]), factors))
    assert got == pytest.approx(0.49 * 10 + 1.44 * 50 + 0.16 * 20, rel=1e-12)
    assert compute._noisy([7.0], None) == 7.0


def test_errors_of_a_result_add_as_squares():
    assert IntensityResult(
        torch.ones(1), 0.02, "", 1.0, sampling=0.03, source=0.06
    ).whole == pytest.approx(0.07, rel=1e-12)


@pytest.mark.parametrize("method", ["windowed", "wide"])
def test_brightness_is_that_of_the_darkest_depth(monkeypatch, method):
    """Mean light, or Σ I² / Σ I of a wide window, over that of random phases."""
    monkeypatch.setattr(compute, "relative_error", lambda samples, seen: 1e-4)
    total = torch.full((3, 9, 11), 2.0, dtype=torch.float64)
    total[1], total[2, 4, 5] = 0.5, 40.0
    found = compute._judged(
        total, [], [], ([CASE], [1.0], 9.0), SimpleNamespace(method=method, reason="")
    )
    assert found.brightness == pytest.approx(
        0.5 / compute._incoherent(9.0, CASE) ** 2, rel=1e-9
    )


def test_power_of_windows_is_weighed_by_the_light_of_the_wavelengths():
    phase, level = (
        torch.from_numpy(np.random.default_rng(3).uniform(0.1, 1, (2, 30, 41)))
        for _ in range(2)
    )
    found = compute._windowed(
        compute.IntensityRequest(phase, level, [CASE, OTHER], [0.7, 0.4]),
        torch.float64,
        1e-4,
        None,
    )
    squares = (level**2).sum((1, 2)).tolist()
    assert found.power == pytest.approx(0.7 * squares[0] + 0.4 * squares[1], rel=1e-9)


def test_the_flux_of_an_exact_sum_is_that_of_the_window():
    """Components of the flux add with their signs, however the light is summed; from
    the side, at NA 0.6.
    """
    y, x = (np.indices((40, 40)) - 19.5) * 0.4
    phase = -2 * np.pi / 0.85 * np.sqrt(x**2 + y**2 + 11.0**2)
    about = dict(
        pitch_um=0.4,
        wavelength_um=0.85,
        sensor_distance_um=11.0,
        depths_um=[np.inf],
        angle_rad=(0.3, -0.2),
    )
    about |= dict(
        window_um=0.6,
        samples=2,
        tolerance=1e-5,
        polarisation="flux",
        integrate=False,
        offset_um=(0.9, 0.4),
    )
    exact = psf.psf_stack(phase, np.ones_like(phase), **about)
    assert exact.reason.startswith("exact")
    window = psf.psf_stack(
        torch.tensor(phase, requires_grad=True),
        torch.ones(40, 40, dtype=torch.float64),
        **about,
    )
    assert window.reason.startswith("windowed")
    assert exact.energy_um2 == pytest.approx(window.numpy().energy_um2, rel=1e-4)


def test_a_moving_window_is_seen_from_its_tile():
    moving = MovingGeometry(
        torch.zeros(2),
        torch.ones(1),
        torch.tensor(62.0),
        torch.tensor([14.0, -8.5], dtype=torch.float64),
    )
    tile = PropagationCase(
        (30, 41), 0.37, 0.85, 62.0, (0.21, -0.13), (1 / 400,), (15.2, -9.1), 0.6, (3, 4)
    )
    assert compute._shifted(moving, CASE, tile).centre.tolist() == pytest.approx(
        [15.2, -9.1]
    )
    assert compute._shifted(moving, CASE, CASE) is moving


def needed(shape, kernel, axis=0):
    """Nodes that a kernel asks for in blocks of 32 pillars."""
    case = PropagationCase(
        shape, 0.4, 0.85, 62.0, (0.0, 0.0), (1 / 400,), (0.0, 0.0), 0.6, (3, 3)
    )
    return blocks._needed(case, axis, 32, kernel, 1e-5, 0).nodes


def test_blocks_at_both_ends_have_the_nodes_that_they_need():
    """Light that bends at one end of the lens alone: as many nodes whichever end that
    is.
    """
    ends = [
        needed((320, 60), lambda y, x, s=s: np.exp(0.3j * np.exp(s * y / 12)) + 0 * x)
        for s in (1, -1)
    ]
    assert ends[0] == ends[1]
    assert ends[0] > needed(
        (320, 60), lambda y, x: np.exp(0.3j * np.exp(-np.abs(y) / 12)) + 0 * x
    )


def test_blocks_are_looked_at_across_the_whole_lens():
    """Fringes along y that are finer the farther off the axis they lie, exp(i x y / 9):
    half as wide, fewer nodes.
    """
    for axis in (0, 1):
        shape = (64, 160) if axis == 0 else (160, 64)
        wide, narrow = (
            needed(s, lambda y, x: np.exp(1j * x * y / 9), axis)
            for s in (shape, (64, 64))
        )
        assert wide > narrow
