"""Gain, masks and brackets against a simulated sensor whose numbers are known."""

import numpy as np
import pytest

from characterize.captures import calibration as clean
from characterize.captures.capture import Capture
from metalens.core.errors import CaptureError

GAIN, READ, OFFSET = 2.0, 5.0, 100.0


def shoot(light_e, rng):
    electrons = rng.poisson(light_e) + rng.normal(0, READ, np.shape(light_e))
    return np.clip(np.round(electrons / GAIN + OFFSET), 0, 4095).astype(np.uint16)


def capture(frames, **more):
    n = len(frames)
    unknown = np.full(n, np.nan)
    return Capture(
        frames,
        unknown,
        np.zeros((n, 2)),
        unknown,
        tuple(map(str, range(n))),
        12,
        **more,
    )


def test_photon_transfer_finds_gain_and_read_noise():
    rng = np.random.default_rng(0)
    pattern = 1 + 0.02 * rng.standard_normal((120, 120))  # fixed pattern must cancel
    levels = np.repeat([500.0, 1500.0, 3000.0, 5000.0], 2)
    flat = np.stack([shoot(level * pattern, rng) for level in levels])
    dark = np.stack([shoot(np.zeros((120, 120)), rng) for _ in range(4)])
    found = clean.photon_transfer(flat, dark)
    assert abs(found.gain_e - GAIN) < 4 * found.gain_sigma_e
    assert found.gain_sigma_e < 0.02 * GAIN
    # sqrt(2 / 43200) of 5 e, with quantisation
    assert abs(found.read_noise_e - READ) < 0.1


def test_flats_that_are_copies_are_refused():
    one = shoot(np.full((30, 30), 1000.0), np.random.default_rng(0))
    with pytest.raises(CaptureError, match="without noise"):
        clean.photon_transfer(np.stack([one, one]))


def test_flats_of_full_wells_have_no_gain():
    """All pixels full before the converter is: their noise is that of the readout, as
    in the dark, whatever the light.

    Differences of noise that by chance are above 0 gave gains of 1e4 and more electrons
    a count.
    """
    for seed in range(6):
        rng = np.random.default_rng(seed)
        dark, flat = (
            np.round(rng.normal(level, 1.3, (8, 26, 24))) for level in (37.0, 1850.0)
        )
        with pytest.raises(CaptureError, match=r"does not grow with light.*saturated"):
            clean.photon_transfer(flat, dark)


def test_hot_dead_and_dead_row_are_masked_and_the_peak_is_not():
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:40, :40] - 20
    spot = 6000 * np.exp(-(x**2 + y**2) / (2 * 1.2**2))
    frames = np.stack([shoot(spot + 20, rng) for _ in range(5)])
    frames[:, 5, 7] = 3900
    frames[:, 30, :] = 0
    flat = np.stack([shoot(np.full((40, 40), 4000.0), rng) for _ in range(2)])
    flat[:, 11, 13] = 101
    bad = clean.bad_pixels(capture(frames, flat=flat))
    assert bad[5, 7]
    assert bad[11, 13]
    assert bad[30].all()
    assert not bad[18:23, 18:23].any()
    assert bad.sum() == 42


def test_clean_gives_electrons_and_says_what_it_did():
    rng = np.random.default_rng(3)
    flat = np.stack([shoot(np.full((64, 64), 4000.0), rng) for _ in range(8)])
    dark = np.stack([shoot(np.zeros((64, 64)), rng) for _ in range(8)])
    frames = np.stack([shoot(np.full((64, 64), 800.0), rng) for _ in range(3)])
    found = clean.to_electrons(capture(frames, dark=dark, flat=flat))
    assert (
        abs(found.electrons.mean() - 800) < 800 * 4 * found.gain.gain_sigma_e / GAIN + 2
    )
    z2 = (found.electrons - found.electrons.mean()) ** 2 / (
        found.variance_e2 + 800 / found.scale
    )
    assert abs(z2.mean() - 1) < 0.06  # sqrt(2 / 12288) is 0.013; gain known to 1-2 %
    assert any("dark" in words for words in found.corrections)
    assert any("gain" in words for words in found.corrections)


def test_full_well_plateau_is_saturation_below_full_scale():
    rng = np.random.default_rng(4)
    frames = np.minimum(
        np.stack([shoot(np.linspace(0, 9000, 900).reshape(30, 30), rng)]), 3000
    )
    found = clean.to_electrons(capture(frames))
    assert found.saturated.sum() == (frames == 3000).sum() > 50


def test_brackets_merge_to_the_true_rate_with_the_stated_variance():
    rng = np.random.default_rng(5)
    rate = np.full((50, 50), 9000.0)
    rate[:, :25] = 300.0
    times = np.array([0.1, 0.3, 1.0])
    z = []
    for _ in range(20):
        frames = np.stack([shoot(rate * t, rng) for t in times])
        ready = clean.to_electrons(
            capture(
                frames,
                dark=np.full((1, 50, 50), int(OFFSET), np.uint16),
                about={"gain_e": GAIN, "read_noise_e": READ},
            )
        )
        merged, first = clean.merge_brackets(ready, times, np.zeros(3))
        assert first.tolist() == [0]
        assert not merged.saturated.any()
        z.append(
            (merged.electrons[0] - rate)
            / np.sqrt(merged.variance_e2[0] + rate / merged.scale[0])
        )
    z = np.array(z)
    assert abs(z.mean()) < 0.03  # 1 / sqrt(50000) is 0.005, weights are estimated
    # the dark of one frame counts as noisy here, though it is exact
    assert 0.9 < z.std() < 1.05


@pytest.mark.parametrize("levels", [(700.0, 1900.0, 3300.0), (2600.0,)])
def test_gain_and_its_error_bar_cover_a_gain_of_3_7(levels):
    """Sixty small flats: the deviations from the truth are as large as stated (each
    level once: the floor is used).
    """
    rng, gain, read, offset = np.random.default_rng(11), 3.7, 9.2, 113.0

    def counts(light_e):
        electrons = rng.poisson(light_e, (40, 40)) + rng.normal(0, read, (40, 40))
        return np.round(electrons / gain + offset).astype(np.uint16)

    z, reads = [], []
    for _ in range(60):
        flat = np.stack([counts(level) for level in levels for _ in range(2)])
        found = clean.photon_transfer(flat, np.stack([counts(0.0) for _ in range(4)]))
        z.append((found.gain_e - gain) / found.gain_sigma_e)
        reads.append(found.read_noise_e)
    # 1 / sqrt(60) = 0.13, and 6 sigma of clipping in the variance
    assert abs(np.mean(z)) < 0.5
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.3  # 60 draws: 9 %
    # sqrt(1 / 9600 / 60) = 0.001; the gain's mean 0.003
    assert np.mean(reads) == pytest.approx(read, rel=0.01)


def test_noise_at_zero_light_counts_read_rounding_dark_and_flat():
    """Frames of no light, a flat of 0.6 and 1.4 halves, one dark of four: the scatter
    of the electrons is as stated.
    """
    # rounding: 3.7² / 12 = 1.14 beside 4.41
    rng, gain, read = (np.random.default_rng(13), 3.7, 2.1)
    shade = np.where(np.arange(60) < 30, 0.6, 1.4) * np.ones((60, 1))

    def counts(light_e):
        return np.round(
            (rng.poisson(light_e * shade) + rng.normal(0, read, (60, 60))) / gain + 20
        ).astype(np.uint16)

    flat = np.stack([counts(4000.0) for _ in range(40)])
    z = []
    for _ in range(12):
        dark = np.stack([counts(0.0) for _ in range(4)])
        frames = np.stack([counts(0.0) for _ in range(3)])
        about = {"gain_e": gain, "read_noise_e": read}
        found = clean.to_electrons(capture(frames, dark=dark, flat=flat, about=about))
        assert found.scale[0, 0, [0, 59]] == pytest.approx([0.6, 1.4], rel=0.02)
        z.append(found.electrons / np.sqrt(found.variance_e2))
    left, right = np.split(np.array(z), 2, axis=-1)
    for half in (left, right):
        # 65000 draws over shared darks: 0.01
        assert half.std() == pytest.approx(1, abs=0.04)


@pytest.mark.parametrize(
    ("read_e", "least", "most"),
    [(0.1, 0.15, 0.5), (0.3, 0.0, 0.055), (0.45, 0.0, 0.01)],
)
def test_rounding_is_off_on_average_where_noise_does_not_hide_it(read_e, least, most):
    """Means of 40 000 rounded counts at every twentieth of a count: to 0.003, against
    which the gain's word is held.
    """
    level = np.arange(0, 1, 0.05)[:, None]
    noise = np.random.default_rng(3).normal(0, read_e, (20, 40_000))
    off = abs(np.rint(level + noise).mean(1) - level[:, 0] - noise.mean(1)).max()
    assert least <= off <= most + 0.004
    assert clean.SensorNoise(1.0, 0.01, read_e).coarse == (off > 0.06)


def test_noise_in_the_dark_is_known_from_two_dark_frames():
    rng = np.random.default_rng(8)
    flat = np.stack([shoot(np.full((40, 40), 4000.0), rng) for _ in range(6)])
    dark = np.stack([shoot(np.zeros((40, 40)), rng) for _ in range(4)])
    known = [
        clean.photon_transfer(flat, some).read_known for some in (dark, dark[:1], None)
    ]
    assert known == [True, False, False]
    assert not clean.photon_transfer(flat, None).coarse
