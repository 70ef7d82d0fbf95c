"""Counts to electrons: photon-transfer gain, dark and flat, bad pixels masked, brackets
merged; all of it reported.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from characterize.captures.capture import Capture
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

# least noise in counts at which the mean of rounded counts errs by 1/20 count at most
_ROUNDING_NOISE = 0.3
_SIGMA_LIMIT = 3.0  # standard errors by which the noise must grow with light


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Noise model of a sensor: variance in counts = mean / gain + (read noise / gain)²
    + 1/12.

    gain_e: electrons a count. gain_sigma_e: its standard error.
    read_noise_e: read noise, electrons.
    known: False where the gain is assumed, neither stated nor measured.
    read_known: False where the read noise is neither stated nor from dark frames.
    """

    gain_e: float
    gain_sigma_e: float
    read_noise_e: float
    known: bool = True
    read_known: bool = True

    @property
    def coarse(self) -> bool:
        """Whether rounding to counts biases their mean, because the noise is small.

        At s counts of noise the bias is up to exp(-2 pi² s²) / pi of a count, equal at
        equal light.
        """
        return (
            self.known
            and self.read_known
            and self.read_noise_e < _ROUNDING_NOISE * self.gain_e
        )


@dataclass(frozen=True, eq=False, slots=True)
class ElectronFrames:
    """Frames ready for a fit, in electrons above the dark level.

    electrons: (n, y, x), flat-fielded.
    usable: (n, y, x) False for hot, dead or cropped pixels, which a fit leaves out.
    saturated: (n, y, x) True where the converter or the well is full: the light is at
    least ``electrons``.
    variance_e2: (n, y, x) variance at zero light: read noise, quantisation, dark
    subtraction.
    scale: (n, y, x) or (1, 1, 1) flat field: detected electrons per unit of
    ``electrons``, for the shot noise.
    gain: noise model of the sensor.
    corrections: every step in words.
    common_floor: share of ``variance_e2`` that is common to all frames: that of the
    dark level.
    common_light: relative error of a pixel's light that is common to all frames: that
    of the flat (not in the variance).
    """

    electrons: Array
    usable: Array
    saturated: Array
    variance_e2: Array
    scale: Array
    gain: SensorNoise
    corrections: tuple[str, ...]
    common_floor: float | Array = 0.0
    common_light: float = 0.0


def photon_transfer(flat: Array, dark: Array | None = None) -> SensorNoise:
    """Gain and read noise by photon transfer (mean-variance method, Janesick 2007).

    Differences of frames of equal exposure cancel the fixed pattern. A weighted line
    variance = mean / gain + floor is fitted to all exposures; with dark frames the
    floor is theirs.

    Args:
        flat: (k, y, x) counts, k >= 2; frames of several exposures may follow each
            other.
        dark: (k, y, x) counts; the offset, and with k >= 2 the read noise.

    Raises:
        CaptureError: fewer than two flats, flats without noise (copies of one frame),
            or saturated flats, whose noise does not grow with light by three standard
            errors.
    """
    flat = np.asarray(flat, float)
    if len(flat) < 2:
        raise CaptureError(
            f"photon transfer: {len(flat)} flat frame; need two or more of one level"
        )
    offset = float(np.mean(dark)) if dark is not None else 0.0
    floor = pair_variance(dark) if dark is not None and len(dark) > 1 else None
    level = np.array([typical_level(frame) for frame in flat]) - offset
    order = np.argsort(level, kind="stable")
    pairs = order[: len(order) // 2 * 2].reshape(-1, 2)
    mean = level[pairs].mean(1)
    variance = np.array([pair_variance(flat[pair]) for pair in pairs])
    if not (variance > 0).all() or not (mean > 0).all():
        raise CaptureError(
            "photon transfer: flats without noise or light; take them anew, in even "
            "light to half the well"
        )
    dark_part = floor or 0.0
    expected = (
        dark_part + mean * (variance - dark_part).sum() / mean.sum()
    )  # its own variance as weight would favour low variances
    has_dark = floor is not None
    inverse, sigma, floor = fit_noise_line(
        mean, variance, expected * math.sqrt(2 / flat[0].size), floor
    )
    if inverse <= (_SIGMA_LIMIT * sigma if has_dark else 0):
        raise CaptureError(
            "photon transfer: the noise does not grow with light (by "
            f"{inverse:.2g} +- {sigma:.2g} counts² a count); the flats are saturated "
            "or processed"
        )
    gain = 1 / inverse
    read_noise_e = math.sqrt(max(floor - 1 / 12, 0)) * gain
    return SensorNoise(gain, gain**2 * sigma, read_noise_e, read_known=has_dark)


def to_electrons(capture: Capture) -> ElectronFrames:
    """Frames in electrons with masks: (counts - dark) / flat * gain.

    The gain is stated, else measured in the flats, else assumed as one electron a count
    with a note. Exposure brackets stay separate frames; :func:`merge_brackets` merges
    them.

    Args:
        capture: frames in counts with their stage and camera.

    Raises:
        CaptureError: all pixels are bad, or everything is saturated.
    """
    notes = list(capture.corrections)
    raw = np.asarray(capture.frames, float)
    gain = _gain(capture, notes)
    dark, dark_error = _dark_level(capture, gain, notes)
    flat, flat_error = _flat_field(capture, dark, notes)
    bad = bad_pixels(capture)
    notes.append(
        f"{int(bad.sum())} of {bad.size} pixels hot, dead or in a dead row: masked"
    )
    level = saturation_level(capture)
    saturated = raw >= level
    if not saturated.any() and gain.known:
        well = full_well(raw - dark, gain)
        saturated = raw - dark >= well
        level = well
    if saturated.any():
        notes.append(
            f"{saturated.mean():.2%} of the pixels saturated at {level:g} counts: "
            "taken as lower bounds"
        )
    if bad.all() or (saturated | bad).all():
        raise CaptureError(
            "no usable pixel: all are saturated, hot or dead; lower the exposure"
        )
    frame_e2 = gain.read_noise_e**2 + gain.gain_e**2 / 12
    dark_e2 = (gain.gain_e * dark_error) ** 2
    return ElectronFrames(
        (raw - dark) / flat * gain.gain_e,
        np.broadcast_to(~bad, raw.shape).copy(),
        saturated,
        np.broadcast_to((frame_e2 + dark_e2) / flat**2, raw.shape),
        np.broadcast_to(flat, raw.shape),
        gain,
        tuple(notes),
        common_floor=dark_e2 / (frame_e2 + dark_e2),
        common_light=flat_error,
    )


def saturation_level(capture: Capture) -> float:
    """Count at which pixels clip: the maximum where many pixels share it (a full well),
    else full scale.

    Args:
        capture: frames in counts with their stage and camera.
    """
    frames = capture.frames
    highest = float(frames.max())
    plateau = int((frames == frames.max()).sum())
    near_top = int((frames >= 0.98 * highest).sum())
    clipped = (
        plateau >= 4
        and plateau > 0.5 * near_top
        and highest > float(np.median(frames)) + 16
    )
    clipped |= (
        plateau > 0.05 * frames.size and highest > float(np.median(frames)) + 2
    )  # no light is so even
    return highest if clipped else float(capture.full_scale)


def full_well(counts: Array, gain: SensorNoise) -> float:
    """Counts above the dark level at which wells are full; inf where no pixel is.

    Unsaturated light scatters by s = sqrt(counts / gain) or more: two pixels of equal
    light differ by less than w with probability w / (sqrt(pi) s). Full wells read
    equal. A well is full where three or more pixels lie within w = 2 counts of the
    highest, and are most of those within 1.5 s. The probability must be below 0.01, and
    they must be less than a quarter of all pixels, which would be even light.

    Args:
        counts: (n, y, x) counts above the dark level.
        gain: noise model of the sensor.
    """
    highest = float(counts.max())
    width = 2.0
    shot = math.sqrt(max(highest, 1e-9) / gain.gain_e)
    full, close = (
        int((counts >= highest - range_counts).sum())
        for range_counts in (width, 1.5 * shot)
    )
    chance = min(width / (math.sqrt(math.pi) * shot), 1.0) ** (full - 1)
    is_plateau = 3 <= full < counts.size / 4 and highest > 2 * abs(
        float(np.median(counts))
    )
    return (
        highest - width
        if is_plateau and full > 0.5 * close and chance < 0.01
        else math.inf
    )


def bad_pixels(capture: Capture) -> Array:
    """(y, x) True where a pixel is hot, stuck or dead, or lies in a dead row or column.

    Dark frames: beyond 8 robust sigma of the median. Flats: outside 0.3 to 3 of the
    median. Frames: single pixels well above their eight neighbours, and in three or
    more frames pixels that stay constant and differ from those around them, but for
    full wells in light: their neighbours are half as bright.

    Args:
        capture: frames in counts with their stage and camera.
    """
    frames = np.asarray(capture.frames, float)
    bad = isolated_pixels(frames)
    if capture.dark is not None:
        level = np.asarray(capture.dark, float).mean(0)
        bad |= np.abs(level - np.median(level)) > 8 * max(robust_sigma(level), 0.5)
    if capture.flat is not None:
        level = np.asarray(capture.flat, float).mean(0)
        bad |= ~((level > 0.3 * np.median(level)) & (level < 3 * np.median(level)))
    level = frames.mean(0)
    differs = np.abs(level - ndimage.median_filter(level, 5, mode="nearest")) > 1
    if len(frames) >= 3:
        dark, top = np.median(frames), frames.max()
        around = ndimage.uniform_filter(level, 3, mode="nearest")
        is_lit = (level >= top) & (around - dark > (top - dark) / 2)
        bad |= (np.ptp(frames, axis=0) == 0) & differs & ~is_lit
    for axis in (0, 1):
        dead = np.all(bad | ((frames.max(0) == 0) & differs), axis=1 - axis)
        bad |= dead[:, None] if axis == 0 else dead[None, :]
    return np.asarray(bad)


def merge_brackets(
    frames: ElectronFrames, exposure_s: Array, group: Array
) -> tuple[ElectronFrames, Array]:
    """One frame for each value of ``group``: the inverse-variance mean of the brackets'
    rates, without saturated pixels.

    The weights come from the light of all brackets together, not from each bracket's
    own noisy count, so that the mean is unbiased.

    Args:
        frames: (n, y, x) frames of all brackets.
        exposure_s: (n,) above 0.
        group: (n,) equal for frames of one position and angle.

    Returns:
        (frames scaled to the longest exposure of their group, (m,) index of a first
        frame of every group).
    """
    kinds, first = np.unique(group, return_index=True)
    kinds = kinds[np.argsort(first)]
    merged = [
        _merge(frames, np.flatnonzero(group == kind), exposure_s) for kind in kinds
    ]
    notes = frames.corrections
    if len(kinds) < len(group):
        notes += (
            f"{len(group)} exposures merged to {len(kinds)} frames by inverse variance",
        )
    value, usable, saturated, floor, scale = map(np.stack, zip(*merged, strict=True))
    common = frames.common_floor, frames.common_light
    return ElectronFrames(
        value, usable, saturated, floor, scale, frames.gain, notes, *common
    ), np.sort(first)


def _merge(frames: ElectronFrames, index: Array, exposure_s: Array) -> tuple[Any, ...]:
    """(y, x) electrons, usable, saturated, variance and scale of one merged frame.

    The variance of the mean, 1 / norm = floor + rate / scale, is the weighted mean of
    the brackets' own. Where no bracket is valid, the shortest stands.

    Args:
        frames: frames of all brackets.
        index: (k,) numbers of the frames to merge.
        exposure_s: (n,) exposures of all frames.
    """
    exposure = (exposure_s[index] / exposure_s[index].max())[:, None, None]
    electrons, variance_e2 = frames.electrons[index], frames.variance_e2[index]
    scale = np.broadcast_to(frames.scale, frames.electrons.shape)[index]
    valid = frames.usable[index] & ~frames.saturated[index]
    total = np.maximum((valid * exposure).sum(0), 1e-12)
    rate = np.maximum((electrons * valid).sum(0) / total, 0)
    weight = valid * exposure**2 / (variance_e2 + rate * exposure / scale)
    none = ~valid.any(0)
    weight[exposure.argmin()] += none
    norm = weight.sum(0)
    shot = (weight**2 / exposure / scale).sum(0) / norm**2
    return (
        (weight * electrons / exposure).sum(0) / norm,
        frames.usable[index].any(0),
        none & frames.saturated[index].any(0),
        (weight**2 * variance_e2 / exposure**2).sum(0) / norm**2,
        1 / shot,
    )


def _gain(capture: Capture, notes: list[str]) -> SensorNoise:
    """Gain and read noise of a capture's sensor; appends where they come from to
    ``notes``.

    Gain: stated, else by photon transfer of the flats, else 1 e a count. Read noise:
    stated, else from two or more dark frames, else from the photon-transfer line, else
    2 e.
    """
    about, dark, flat = capture.about, capture.dark, capture.flat
    measured = None
    gain, sigma = 1.0, math.inf
    if "gain_e" in about:
        gain, sigma = float(about["gain_e"]), 0.0
        notes.append(f"gain {gain:g} e/count as stated")
    elif flat is not None and len(flat) > 1:
        measured = photon_transfer(flat, dark)
        gain, sigma = measured.gain_e, measured.gain_sigma_e
        notes.append(
            f"gain {gain:.3g} +- {sigma:.1g} e/count, measured in {len(flat)} flat "
            "frames"
        )
    else:
        notes.append(
            "no flats, no stated gain: 1 e/count assumed, chi-square has no absolute "
            "meaning"
        )
    is_read_noise_known = True
    if "read_noise_e" in about:
        read_noise_e = float(about["read_noise_e"])
        origin = "as stated"
    elif dark is not None and len(dark) > 1:
        read_noise_e = gain * math.sqrt(max(pair_variance(dark) - 1 / 12, 0.0))
        origin = f"measured in {len(dark)} dark frames"
    else:
        is_read_noise_known = False
        read_noise_e = measured.read_noise_e if measured else 2.0  # of a usual sensor
        origin = "from the flats' photon-transfer line" if measured else "assumed"
    notes.append(f"read noise {read_noise_e:.2g} e, {origin}")
    return SensorNoise(
        gain,
        sigma,
        read_noise_e,
        known=math.isfinite(sigma),
        read_known=is_read_noise_known,
    )


def _dark_level(
    capture: Capture, gain: SensorNoise, notes: list[str]
) -> tuple[Array | float, float]:
    """(counts without light, their standard error): (y, x) from dark frames, else the
    stated offset, else 0; appends a note.
    """
    if capture.dark is None and "offset" in capture.about:
        notes.append(f"offset {capture.about['offset']:g} counts as stated, subtracted")
        return float(capture.about["offset"]), 0.0
    if capture.dark is None:
        notes.append(
            "no dark frame and no stated offset: counts without light are left to the "
            "fit's background and weigh as light; add dark.tif or state offset"
        )
        return 0.0, 0.0
    level = np.mean(capture.dark, axis=0)
    # the rounding of coarse counts is one error in all frames
    frames = 1 if gain.coarse else len(capture.dark)
    error = math.hypot(gain.read_noise_e / gain.gain_e, 12**-0.5) / math.sqrt(frames)
    notes.append(
        f"offset {np.mean(level):.4g} counts on average, measured pixel by pixel in "
        f"{len(capture.dark)} dark frames, subtracted"
    )
    return np.asarray(level), error


def _flat_field(
    capture: Capture, dark: Array | float, notes: list[str]
) -> tuple[Array, float]:
    """((y, x) flat of median 1, relative error of its pixels); ones of shape (1, 1)
    without a flat, or where it is even to within its noise. Appends a note.
    """
    if capture.flat is None:
        return np.ones((1, 1)), 0.0
    level = np.mean(capture.flat, axis=0) - dark
    flat = level / np.median(level)
    noise = math.inf
    if len(capture.flat) > 1:
        noise = math.sqrt(pair_variance(capture.flat) / len(capture.flat)) / float(
            np.median(level)
        )
    if robust_sigma(flat) < 1.2 * noise:
        notes.append(
            "flat is a single frame, or even to within its noise: not divided by"
        )
        return np.ones((1, 1)), 0.0
    notes.append(f"divided by the flat, {robust_sigma(flat):.2%} robust spread")
    return np.where((flat > 0.3) & (flat < 3), flat, 1.0), noise


def isolated_pixels(frames: Array) -> Array:
    """(y, x) True for single pixels far above all eight neighbours in most of three or
    more frames; False everywhere with fewer frames.

    Args:
        frames: (n, y, x) counts.
    """
    if len(frames) < 3:
        return np.zeros(frames.shape[1:], bool)
    ring = np.ones((1, 3, 3), bool)
    ring[0, 1, 1] = False
    above_median = frames - ndimage.median_filter(frames, footprint=ring)
    sigma = np.array([max(robust_sigma(frame), 0.5) for frame in above_median])
    brightest = ndimage.maximum_filter(frames, footprint=ring)
    spike = frames - brightest > 6 * sigma[:, None, None]
    spike &= frames > 1.5 * brightest
    return np.asarray(spike.mean(0) > 0.8)


def pair_variance(frames: Array) -> float:
    """Temporal variance of one frame, from successive differences, robust to a few bad
    pixels.

    Args:
        frames: (k, y, x) counts at one level of light.
    """
    steps = np.diff(np.asarray(frames, float), axis=0) / math.sqrt(2)
    steps = steps - steps.mean((1, 2), keepdims=True)
    regular = np.abs(steps) <= 6 * max(robust_sigma(steps), 0.5)
    return float(
        np.mean(steps[regular] ** 2) * frames[0].size / max(frames[0].size - 1, 1)
    )


def fit_noise_line(
    mean: Array, variance: Array, spread: Array, floor: float | None
) -> tuple[float, float, float]:
    """(slope, standard error, intercept) of a weighted line variance = slope mean +
    intercept.

    The intercept is ``floor`` where stated, and 0 where the means span less than 20 %.

    Args:
        mean: (k,) counts. variance: (k,) counts².
        spread: (k,) standard errors of ``variance``.
        floor: intercept, or None to fit it.
    """
    if floor is not None or np.ptp(mean) < 0.2 * mean.max():
        intercept = floor or 0.0
        weight = (mean / spread) ** 2
        return (
            float((weight * (variance - intercept) / mean).sum() / weight.sum()),
            float(weight.sum() ** -0.5),
            intercept,
        )
    (slope, intercept), covariance = np.polyfit(
        mean, variance, 1, w=1 / spread, cov="unscaled"
    )
    return float(slope), float(covariance[0, 0] ** 0.5), max(float(intercept), 0.0)


def typical_level(frame: Array) -> float:
    """Mean of the pixels within 8 robust sigma of the median.

    Args:
        frame: (y, x) counts.
    """
    regular = np.abs(frame - np.median(frame)) <= 8 * max(robust_sigma(frame), 0.5)
    return float(frame[regular].mean())


def robust_sigma(values: Array) -> float:
    """Standard deviation from the median absolute deviation of the values."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))
