"""Spots on pixels as wide as they are, with noise: Strehl ratio and encircled energy by
sums over a pupil.
"""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.captures.capture import Capture
from characterize.measure import frames, metrics

WAVE, RADIUS, DISTANCE = 0.85, 30.0, 140.0
SINE = RADIUS / math.hypot(RADIUS, DISTANCE)
DESIGN = b.row(RADIUS, wavelength_um=WAVE, sensor_distance_um=DISTANCE)
ACROSS = (np.arange(64) + 0.5) / 32 - 1
U, V = np.meshgrid(ACROSS, ACROSS)
COMA = 0.6 * math.sqrt(8) * (3 * (U**2 + V**2) - 2) * U
FINE = 7  # samples a pixel side


def light(phase_rad, x_um, y_um):
    """Focus of a pupil with this phase, by the sum over the pupil; 1 at the peak of a
    perfect one.
    """
    pupil = np.where(U**2 + V**2 <= 1, np.exp(1j * phase_rad), 0)
    k = 2 * math.pi * SINE / WAVE
    field = (
        np.exp(1j * k * np.outer(y_um, ACROSS))
        @ pupil
        @ np.exp(1j * k * np.outer(ACROSS, x_um))
    )
    return np.abs(field) ** 2 / np.abs(pupil).sum() ** 2


def pixels(phase_rad, shape, pixel_um, place_um):
    """(y, x) means over the pixels of a spot off the window's middle."""
    y, x = (((np.arange(n * FINE) + 0.5) / FINE - n / 2) * pixel_um for n in shape)
    fine = light(phase_rad, x - place_um[0], y - place_um[1])
    return fine.reshape(shape[0], FINE, shape[1], FINE).mean((1, 3))


def capture(counts, pixel_um):
    about = {"gain_e": 1.0, "offset": 40, "read_noise_e": 3.0}
    nothing = np.full(1, np.nan)
    return Capture(
        counts[None], np.array([900.0]), np.zeros((1, 2)), nothing, ("f",), 16, pixel_um, WAVE, about=about
    )  # fmt: skip


@pytest.mark.parametrize(("pixel_um", "shape"), [(1.0, (31, 36)), (1.9, (24, 27))])
@pytest.mark.parametrize("place", [(0.0, 0.0), (0.5, 0.5), (-0.31, 0.44)])
def test_a_perfect_spot_has_a_strehl_ratio_of_one_wherever_it_falls_on_the_pixels(
    pixel_um, shape, place
):
    """Brightest pixels hold up to twice as much as others by place alone. 1 %: 64
    samples across the pupil.
    """
    spot = pixels(0 * U, shape, pixel_um, np.multiply(place, pixel_um))
    counts = 40 + 30000 * spot
    (found,) = frames.measure_frames(capture(counts, pixel_um), design=DESIGN).frames
    assert found.strehl == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("place", [(11.3, 2.2), (-1.4, -12.7), (-13.6, 9.1)])
def test_a_spot_near_the_border_of_its_frame_is_found_there(place):
    """Two pixels from one border, or another: the Airy pattern is laid on from where
    the brightest pixel is.
    """
    counts = 40 + 30000 * pixels(0 * U, (31, 36), 1.0, place)
    (found,) = frames.measure_frames(capture(counts, 1.0), design=DESIGN).frames
    # less of the rings is seen: 1 % of the light
    assert found.strehl == pytest.approx(1, abs=0.02)


def test_the_strehl_ratio_of_an_aberrated_spot_is_that_of_its_peak():
    """0.6 rad of coma, a pixel of half the core: 0.03, as its peak is not quite as
    narrow as the perfect one.
    """
    fine = np.linspace(-1.5, 1.5, 121)
    want = light(COMA, fine, fine).max()
    for place in ((0.1, -0.4), (-0.45, 0.2)):
        counts = 40 + 30000 * pixels(COMA, (33, 30), 1.0, place)
        (found,) = frames.measure_frames(capture(counts, 1.0), design=DESIGN).frames
        assert found.strehl == pytest.approx(want, abs=0.03)
    assert 0.65 < want < 0.75


def test_noise_is_no_light_of_its_own():
    """80 % of the light and the efficiency in a window 60 times as wide as the spot, 3
    e of read noise, eight times.

    Light within a circle is off by 3 sqrt(4000) = 190 e of 23 000: EE80 by 3 % each
    time (its slope there is 0.4 of
    the light a radius); noise cut off at 0 would add 1.2 e a pixel, a fifth of the
    light.
    """
    rng = np.random.default_rng(3)
    shape, pixel = (61, 65), 1.7
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    spot = 2500 * np.exp(-((x - 0.3) ** 2 + (y[:, None] + 0.2) ** 2) / 2 / 1.21**2)
    found, share = [], []
    for _ in range(8):
        noisy = rng.poisson(spot) + rng.normal(0, 3.0, shape)
        found.append(metrics.measure_spot(noisy, step_um=pixel).ee80_um)
        share.append(
            metrics.focusing_efficiency(
                noisy, 1.7 * spot.sum(), step_um=pixel, aperture_um=6 * pixel
            )
        )
    # samples are taken as even over their pixels
    wide = math.hypot(1.21, 1 / math.sqrt(12))
    assert np.mean(found) == pytest.approx(
        wide * pixel * math.sqrt(2 * math.log(5)), rel=0.02
    )
    assert np.mean(share) == pytest.approx(
        (1 - math.exp(-9 / 2 / wide**2)) / 1.7, rel=0.01
    )
