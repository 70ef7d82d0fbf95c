"""Coarse samples of a window against plane waves of its band, and what moves it against
differences.
"""

import dataclasses
import math

import numpy as np
import pytest

from characterize.model import window
from characterize.model.kernel import CompressedKernel
from characterize.model.window import CouplingTerms, WindowOperators, axis_operators

K = 2 * math.pi / 0.85
KERNEL = CompressedKernel(
    K, (-0.21, 0.27), (-0.17, 0.23), 1900.0, 1911.0, (0.03, -0.02)
)
AT = (
    np.arange(90) - 41.5
) * 0.75  # not symmetric, as the samples of a window with an even number of pixels


def along(kernel, tolerance=1e-3, at=AT):
    """Coarse samples and ways along x."""
    nodes = np.linspace(*kernel.p, 23)
    return nodes, axis_operators(
        kernel.by_x,
        nodes,
        at,
        kernel.bands(40.0, 40.0)[1],
        k=kernel.k,
        tolerance=tolerance,
        step_um=1.0,
    )


@pytest.mark.parametrize("direction", [-0.83, 0.0, 0.37, 0.91])
def test_light_times_powers_of_its_direction_is_that_of_a_plane_wave(direction):
    """A wave of one direction of the band, times it and its square; of odd powers the
    weights are imaginary.
    """
    band = 0.9
    coarse = (np.arange(60) - 27.0) * math.pi / band / window.ROOM
    wave, want = (np.exp(1j * band * direction * place) for place in (coarse, AT))
    for power, weights in enumerate(window.derivative_operators(AT, coarse, band, 2)):
        found = weights @ wave * (1j if power % 2 else 1)
        assert found == pytest.approx(
            direction**power * want, abs=2e-3
        )  # 24 samples at 1.3 times the least density


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-5])
def test_fine_samples_are_those_of_the_path_itself(tolerance):
    """A tenth of the tolerance in the mean over the band; at its edge, which the
    outermost nodes are, five times.
    """
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
    """Differences of the path along x, less those of the middle direction, at the
    corners of lens and window.
    """
    p, q, X, Y = (
        v.ravel() for v in np.meshgrid(KERNEL.p, KERNEL.q, (-40.0, 40.0), (-40.0, 40.0))
    )
    step = 1e-3

    def steep(p, q, Y):
        return (
            KERNEL.path(p, q, X + step, Y)[0] - KERNEL.path(p, q, X - step, Y)[0]
        ) / (2 * step)

    seen = K * np.abs(steep(p, q, Y) - steep(0.03, 0.03, 0.0)).max()
    found = KERNEL.bands(40.0, 40.0)[1]
    assert seen <= found * (1 + 1e-6)
    assert found < 1.02 * seen  # the corners are the worst of it


def test_rates_are_the_differences_of_both_factors():
    """One term, no weight: E = Fy L Fxᵀ, its derivative by central differences of the
    exact factors (1e-6 of it).
    """
    rng, off = np.random.default_rng(3), np.array([0.2, -0.2])
    p, q = np.linspace(*KERNEL.p, 23), np.linspace(*KERNEL.q, 19)
    light = rng.standard_normal((1, 19, 23)) + 1j * rng.standard_normal((1, 19, 23))
    bands = KERNEL.bands(40.0, 40.0)
    y, x = (
        axis_operators(by, nodes, AT, band, k=K, tolerance=1e-6, step_um=1.0)
        for by, nodes, band in ((KERNEL.by_y, q, bands[0]), (KERNEL.by_x, p, bands[1]))
    )
    one = np.ones((len(y[0]), 1, len(x[0])), complex)
    rest = CouplingTerms(
        np.ones((1, 23)), np.ones((19, 1, 1)), one, np.ones(1), np.ones(1), 1.0
    )
    still = dataclasses.replace(rest, window=0 * one)
    operators = WindowOperators(y[1], x[1], rest, lambda name: still)

    def field(k, off_um):
        down, across = (
            KERNEL.by_y(q, AT[:, None], off_um),
            KERNEL.by_x(p, AT[:, None], off_um),
        )
        return np.exp(1j * k * down) @ light[0] @ np.exp(1j * k * across).T

    farther = [field(K, h) for h in off]
    waves = [2 * math.pi / (0.85 + h) for h in 1e-3 * off]
    redder = [field(k, 0.0) for k in waves]
    for name, ends, step in (("distance", farther, 0.4), ("wave", redder, 0.4e-3)):
        want = (ends[0] - ends[1]) / step
        found = operators.rates(light, name)[0] * (y[1].carrier[:, None] * x[1].carrier)
        assert np.abs(found - want).max() < 1e-4 * np.abs(want).max()


@pytest.mark.parametrize(
    ("kind", "of"), [(np.float32, np.complex64), (np.float64, np.complex128)]
)
def test_real_weights_of_complex_values_are_their_product(kind, of):
    rng = np.random.default_rng(12)
    weights = rng.normal(size=(5, 7)).astype(kind)
    values = (rng.normal(size=(7, 8)) + 1j * rng.normal(size=(7, 8))).astype(of)
    for some in (values, values[:, ::2]):  # also where they do not lie side by side
        got = window.real_complex_product(weights, some)
        assert got.dtype == of
        assert got == pytest.approx(
            weights.astype(float) @ some, abs=1e-5 if kind is np.float32 else 1e-13
        )


RIM_UM = 28.0


@pytest.fixture(scope="module")
def waves_missed():
    """{samples taken together: (their even places, rms over the band of what they leave
    of a plane wave at every place
    of a window from -31 to 30)}: the nearest ones, by least squares over 60 waves of
    the band."""
    band, (t, share) = 0.9, np.polynomial.legendre.leggauss(60)
    step, at = math.pi / band / window.ROOM, np.linspace(-31.0, 30.0, 82)
    root = np.sqrt(np.r_[share, share] / 2)
    missed = {}
    for taps in range(6, 42, 2):
        count = max(
            math.ceil(61.0 / step) + 1, math.ceil((61.0 - 2 * RIM_UM) / step) + taps
        )  # beyond but the rim
        coarse, rms = -0.5 + (np.arange(count) - (count - 1) / 2) * step, []
        for place in at:
            some = np.argsort(np.abs(coarse - place), kind="stable")[:taps]
            turn = (
                band * t[:, None] * (coarse[some] - place)
            )  # the wave at the place is 1
            parts = np.concatenate([np.cos(turn), np.sin(turn)]) * root[:, None]
            goal = np.r_[root[:60], np.zeros(60)]
            rms.append(
                np.linalg.norm(
                    parts @ np.linalg.lstsq(parts, goal, rcond=None)[0] - goal
                )
            )
        missed[taps] = coarse, np.array(rms)
    return band, at, missed


@pytest.mark.parametrize("tolerance", np.geomspace(5e-2, 5e-3, 24))
def test_as_few_samples_are_taken_together_as_a_tenth_of_the_tolerance_asks_and_all_of_it_at_the_rim(
    waves_missed, tolerance
):
    """In the rim of 28 um, which lies beside what is seen, ten times as much may be
    missed.
    """
    band, at, missed = waves_missed
    inner = np.abs(at + 0.5) <= 30.5 - RIM_UM
    enough = min(
        n
        for n, (_, rms) in missed.items()
        if rms[inner].max() < 0.1 * tolerance and rms[~inner].max() < 1.0 * tolerance
    )
    places, weights = window._resampled(-31.0, 30.0, 82, band, float(tolerance), RIM_UM)
    assert places == pytest.approx(missed[enough][0], abs=1e-12)
    assert np.count_nonzero(weights, axis=1).max() == enough
