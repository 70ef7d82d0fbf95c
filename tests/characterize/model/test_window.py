"""Coarse samples of a window against plane waves of its band, and what moves it against differences."""

import dataclasses
import math

import numpy as np
import pytest

from characterize.model import window
from characterize.model.kernel import Kernel
from characterize.model.window import Operators, Terms, ways

K = 2 * math.pi / 0.85
KERNEL = Kernel(K, (-0.21, 0.27), (-0.17, 0.23), 1900.0, 1911.0, (0.03, -0.02))
AT = (np.arange(90) - 41.5) * 0.75  # not symmetric, as the samples of a window with an even number of pixels


def along(kernel, tolerance=1e-3, at=AT):
    """Coarse samples and ways along x."""
    nodes = np.linspace(*kernel.p, 23)
    return nodes, ways(
        kernel.by_x, nodes, at, kernel.bands(40.0, 40.0)[1], k=kernel.k, tolerance=tolerance, step_um=1.0
    )


@pytest.mark.parametrize("direction", [-0.83, 0.0, 0.37, 0.91])
def test_light_times_powers_of_its_direction_is_that_of_a_plane_wave(direction):
    """A wave of one direction of the band, times it and its square; of odd powers the weights are imaginary."""
    band = 0.9
    coarse = (np.arange(60) - 27.0) * math.pi / band / window.ROOM
    wave, want = (np.exp(1j * band * direction * place) for place in (coarse, AT))
    for power, weights in enumerate(window.turned(AT, coarse, band, 2)):
        found = weights @ wave * (1j if power % 2 else 1)
        assert found == pytest.approx(direction**power * want, abs=2e-3)  # 24 samples at 1.3 times the least density


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-5])
def test_fine_samples_are_those_of_the_path_itself(tolerance):
    """A tenth of the tolerance in the mean over the band; at its edge, which the outermost nodes are, five times."""
    nodes, (coarse, found) = along(KERNEL, tolerance)
    want = np.exp(1j * K * KERNEL.by_x(nodes, AT[:, None]))
    error = np.abs(found.carrier[:, None] * (found.fine @ found.to) - want)
    assert len(coarse) < len(AT)
    assert np.sqrt((error**2).mean()) < 0.1 * tolerance
    assert error.max() < 0.5 * tolerance


def test_samples_that_are_coarse_already_are_taken_as_they_are():
    at = (np.arange(30) - 14.5) * 1.9
    coarse, found = along(KERNEL, at=at)[1]
    assert coarse == pytest.approx(at, abs=1e-12)
    assert np.array_equal(found.fine, np.eye(30))


def test_band_holds_every_direction_seen_from_the_window():
    """Differences of the path along x, less those of the middle direction, at the corners of lens and window."""
    p, q, X, Y = (v.ravel() for v in np.meshgrid(KERNEL.p, KERNEL.q, (-40.0, 40.0), (-40.0, 40.0)))
    step = 1e-3

    def steep(p, q, Y):
        return (KERNEL.path(p, q, X + step, Y)[0] - KERNEL.path(p, q, X - step, Y)[0]) / (2 * step)

    seen = K * np.abs(steep(p, q, Y) - steep(0.03, 0.03, 0.0)).max()
    found = KERNEL.bands(40.0, 40.0)[1]
    assert seen <= found * (1 + 1e-6)
    assert found < 1.02 * seen  # the corners are the worst of it


def test_rates_are_the_differences_of_both_factors():
    """One term, no weight: E = Fy L Fxᵀ, its derivative by central differences of the exact factors (1e-6 of it)."""
    rng, off = np.random.default_rng(3), np.array([0.2, -0.2])
    p, q = np.linspace(*KERNEL.p, 23), np.linspace(*KERNEL.q, 19)
    light = rng.standard_normal((1, 19, 23)) + 1j * rng.standard_normal((1, 19, 23))
    bands = KERNEL.bands(40.0, 40.0)
    y, x = (
        ways(by, nodes, AT, band, k=K, tolerance=1e-6, step_um=1.0)
        for by, nodes, band in ((KERNEL.by_y, q, bands[0]), (KERNEL.by_x, p, bands[1]))
    )
    one = np.ones((len(y[0]), 1, len(x[0])), complex)
    rest = Terms(np.ones((1, 23)), np.ones((19, 1, 1)), one, np.ones(1), np.ones(1), 1.0)
    still = dataclasses.replace(rest, window=0 * one)
    operators = Operators(y[1], x[1], rest, lambda name: still)

    def field(k, off_um):
        down, across = KERNEL.by_y(q, AT[:, None], off_um), KERNEL.by_x(p, AT[:, None], off_um)
        return np.exp(1j * k * down) @ light[0] @ np.exp(1j * k * across).T

    farther = [field(K, h) for h in off]
    waves = [2 * math.pi / (0.85 + h) for h in 1e-3 * off]
    redder = [field(k, 0.0) for k in waves]
    for name, ends, step in (("distance", farther, 0.4), ("wave", redder, 0.4e-3)):
        want = (ends[0] - ends[1]) / step
        found = operators.rates(light, name)[0] * (y[1].carrier[:, None] * x[1].carrier)
        assert np.abs(found - want).max() < 1e-4 * np.abs(want).max()


@pytest.mark.parametrize(("kind", "of"), [(np.float32, np.complex64), (np.float64, np.complex128)])
def test_real_weights_of_complex_values_are_their_product(kind, of):
    rng = np.random.default_rng(12)
    weights = rng.normal(size=(5, 7)).astype(kind)
    values = (rng.normal(size=(7, 8)) + 1j * rng.normal(size=(7, 8))).astype(of)
    for some in (values, values[:, ::2]):  # also where they do not lie side by side
        got = window.weighted(weights, some)
        assert got.dtype == of
        assert got == pytest.approx(weights.astype(float) @ some, abs=1e-5 if kind is np.float32 else 1e-13)
