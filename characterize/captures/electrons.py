"""Counts to electrons: photon-transfer gain, dark and flat, bad pixels masked, brackets
merged; all of it reported.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from characterize.captures.capture import Capture
from characterize.captures.rounding import DarkStatistics
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError

# counts of noise from which on rounding is off by a twentieth of a count at most
_HIDES = 0.3
# counts²: variance between dark frames up to which noise may be below that, wherever
# their level lies
_ROUGH = 0.35
_SURE = 3.0  # standard errors from which on noise is taken to grow with light
# of a camera that nobody describes, where no two dark frames tell


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Noise model of a sensor: variance in counts = mean / gain + (read noise / gain)²
    + 1/12.

    gain_e: electrons a count. gain_sigma_e: standard error of it.
    read_noise_e: electrons; read_known: False where nobody says so and no two dark
    frames do.
    known: False where the gain was assumed, not measured.
    """

    gain_e: float
    gain_sigma_e: float
    read_noise_e: float
    known: bool = True
    read_known: bool = True

    @property
    def coarse(self) -> bool:
        """Whether counts are too coarse for their noise to hide it.

        With s counts of noise rounding is off by up to exp(-2 pi² s²) / pi of a count
        on average, alike wherever light
        is alike.
        """
        return (
            self.known and self.read_known and self.read_noise_e < _HIDES * self.gain_e
        )


@dataclass(frozen=True, eq=False, slots=True)
class ElectronFrames:
    """Frames ready for a fit, in electrons above the dark level.

    electrons: (n, y, x), flat-fielded.
    usable: (n, y, x) False where a pixel is hot, dead or cropped: it takes no part in a
    fit.
    saturated: (n, y, x) True where the converter or the well is full: the light is at
    least ``electrons``.
    variance_e2: (n, y, x) variance at zero light: read noise, quantisation, dark
    subtraction.
    scale: (n, y, x) or (1, 1, 1): electrons counted for each electron given here (flat
    field), for the shot noise.
    corrections: every step in words.
    common_floor: share of ``variance_e2`` that is the same error in all frames, that of
    the dark level.
    common_light: relative error of a pixel's light that is the same in all frames, that
    of the flat (not in the
        variance).
    count_e: electrons of a count where pixels are rounded counts, ``count_e / scale``
    apart; 0 where they are means.
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
    count_e: float = 0.0


def photon_transfer(flat: Array, dark: Array | None = None) -> SensorNoise:
    """Gain and read noise from repeated flat frames (mean-variance method, Janesick
    2007).

    Differences of frames of like exposure cancel the fixed pattern; a line variance =
    mean / gain + floor goes
    through the levels. With one level the floor comes from the dark frames.

    Args:
        flat: (k, y, x) counts, k >= 2; frames of several exposures may follow each
            other.
        dark: (k, y, x) counts; the offset, and with k >= 2 the read noise.

    Raises:
        CaptureError: fewer than two flats, flats without noise (one frame copied), or
            saturated ones: their noise
            does not grow with light, or is above that of the dark by less than three
            standard errors.
    """
    flat = np.asarray(flat, float)
    if len(flat) < 2:
        raise CaptureError(
            f"photon transfer: {len(flat)} flat frame; need two or more of one level"
        )
    offset = float(np.mean(dark)) if dark is not None else 0.0
    floor = _floor(dark) if dark is not None and len(dark) > 1 else None
    order = np.argsort([_middle(f) for f in flat], kind="stable")
    pairs = [
        (flat[a], flat[b]) for a, b in zip(order[:-1:2], order[1::2], strict=False)
    ]
    mean = np.array([(_middle(a) + _middle(b)) / 2 - offset for a, b in pairs])
    variance = np.array([_pair_variance(np.stack(pair)) for pair in pairs])
    if not (variance > 0).all() or not (mean > 0).all():
        raise CaptureError(
            "photon transfer: flats without noise or light; take them anew, evenly lit to half the well"
        )
    base = floor or 0.0
    expected = (
        base + mean * (variance - base).sum() / mean.sum()
    )  # of the variance: its own would favour low ones
    dark_known = floor is not None
    inverse, sigma, floor = _line(
        mean, variance, expected * math.sqrt(2 / flat[0].size), floor
    )
    if inverse <= (_SURE * sigma if dark_known else 0):
        raise CaptureError(
            "photon transfer: the noise does not grow with light (by "
            f"{inverse:.2g} +- {sigma:.2g} counts² a count); the flats are saturated or processed"
        )
    gain = 1 / inverse
    read = math.sqrt(max(floor - 1 / 12, 0)) * gain
    return SensorNoise(gain, gain**2 * sigma, read, read_known=dark_known)


def to_electrons(capture: Capture) -> ElectronFrames:
    """Frames in electrons with masks; the gain from the flats, else one electron a
    count, and so said.

    Brackets (frames of one position and angle with different exposure) are merged by
    :func:`merge_brackets`
    beforehand by whoever wants one frame a position; without that every exposure is
    fitted as its own frame.

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
    top = saturation_level(capture)
    saturated = raw >= top
    if not saturated.any() and gain.known:
        well = full_well(raw - dark, gain)
        saturated = raw - dark >= well
        top = well
    if saturated.any():
        notes.append(
            f"{saturated.mean():.2%} of the pixels saturated at {top:g} counts: taken as lower bounds"
        )
    if bad.all() or (saturated | bad).all():
        raise CaptureError(
            "no usable pixel: all are saturated, hot or dead; lower the exposure"
        )
    once = gain.read_noise_e**2 + gain.gain_e**2 / 12
    dark_e2 = (gain.gain_e * dark_error) ** 2
    return ElectronFrames(
        (raw - dark) / flat * gain.gain_e,
        np.broadcast_to(~bad, raw.shape).copy(),
        saturated,
        np.broadcast_to((once + dark_e2) / flat**2, raw.shape),
        np.broadcast_to(flat, raw.shape),
        gain,
        tuple(notes),
        common_floor=dark_e2 / (once + dark_e2),
        common_light=flat_error,
        count_e=gain.gain_e,
    )


def saturation_level(capture: Capture) -> float:
    """Count at which pixels clip: full scale, or a lower plateau at the maximum shared
    by many pixels (full well).

    Args:
        capture: frames in counts with their stage and camera.
    """
    frames = capture.frames
    highest = float(frames.max())
    plateau = int((frames == frames.max()).sum())
    near = int((frames >= 0.98 * highest).sum())
    clipped = (
        plateau >= 4
        and plateau > 0.5 * near
        and highest > float(np.median(frames)) + 16
    )
    clipped |= (
        plateau > 0.05 * frames.size and highest > float(np.median(frames)) + 2
    )  # no light is so even
    return highest if clipped else float(capture.full_scale)


def full_well(counts: Array, gain: SensorNoise) -> float:
    """Counts above the dark level from which on pixels are full; inf where none shows
    it.

    Light that fills no well scatters by s = sqrt(counts / gain) at least, so that two
    pixels alike are within w of each
    other by a chance of w / (sqrt(pi) s); wells that are full all read the same, to
    within rounding and the error of
    the dark level. So: three pixels or more within w = 2 counts, most of those within
    1.5 s of the highest, by a chance
    below a hundredth; not a quarter of all, which is even light and no image.
    """
    highest, width = float(counts.max()), 2.0
    shot = math.sqrt(max(highest, 1e-9) / gain.gain_e)
    alike, near = (
        int((counts >= highest - reach).sum()) for reach in (width, 1.5 * shot)
    )
    chance = min(width / (math.sqrt(math.pi) * shot), 1.0) ** (alike - 1)
    some = 3 <= alike < counts.size / 4 and highest > 2 * abs(float(np.median(counts)))
    return (
        highest - width if some and alike > 0.5 * near and chance < 0.01 else math.inf
    )


def bad_pixels(capture: Capture) -> Array:
    """(y, x) True where a pixel is hot, stuck or dead, or lies in a dead row or column.

    From dark (8 robust sigma above the rest) and flat (outside 0.3 to 3 of the median)
    where there are any; always
    from the frames: the same single pixel far above its eight neighbours, or constant,
    in every one of >= 3 frames.
    Constant pixels count where they differ from those around them: a dark background of
    few bits is constant too.

    Args:
        capture: frames in counts with their stage and camera.
    """
    frames = np.asarray(capture.frames, float)
    bad = _lonely(frames)
    if capture.dark is not None:
        level = np.asarray(capture.dark, float).mean(0)
        bad |= np.abs(level - np.median(level)) > 8 * max(_robust_sigma(level), 0.5)
    if capture.flat is not None:
        level = np.asarray(capture.flat, float).mean(0)
        bad |= ~((level > 0.3 * np.median(level)) & (level < 3 * np.median(level)))
    level = frames.mean(0)
    apart = np.abs(level - ndimage.median_filter(level, 5, mode="nearest")) > 1
    if len(frames) >= 3:
        bad |= (np.ptp(frames, axis=0) == 0) & apart
    for axis in (0, 1):
        dead = np.all(bad | ((frames.max(0) == 0) & apart), axis=1 - axis)
        bad |= dead[:, None] if axis == 0 else dead[None, :]
    return np.asarray(bad)


def merge_brackets(
    frames: ElectronFrames, exposure_s: Array, group: Array
) -> tuple[ElectronFrames, Array]:
    """One frame for each value of ``group``: the brackets' rates averaged by inverse
    variance, saturated ones left out.

    The weights come from the light of all brackets together, not from each one's own
    noisy count, so that the mean
    is unbiased.

    Args:
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
    value, usable, saturated, floor, scale = (
        np.stack(part) for part in zip(*merged, strict=True)
    )
    note = f"{len(group)} exposures merged to {len(kinds)} frames by inverse variance"
    notes = (
        (*frames.corrections, note) if len(kinds) < len(group) else frames.corrections
    )
    common = frames.common_floor, frames.common_light
    return ElectronFrames(
        value, usable, saturated, floor, scale, frames.gain, notes, *common
    ), np.sort(first)


def _merge(frames: ElectronFrames, index: Array, exposure_s: Array) -> list[Array]:
    time = exposure_s[index][:, None, None] / exposure_s[index].max()
    open_ = frames.usable[index] & ~frames.saturated[index]
    total = np.maximum((open_ * time).sum(0), 1e-12)
    rate = np.maximum((frames.electrons[index] * open_).sum(0) / total, 0)
    noise = frames.variance_e2[index] + rate * time / frames.scale[index]
    weight = open_ * time**2 / noise
    some = weight.sum(0) > 0
    shortest = index[np.argmin(exposure_s[index])]
    norm = np.where(some, weight.sum(0), 1)
    value = np.where(some, (weight * frames.electrons[index] / time).sum(0) / norm, 0)
    value = np.where(some, value, frames.electrons[shortest] / time.min())
    # the merged noise is 1 / norm = floor + rate / scale: both parts are weighted means
    # of the brackets' own
    floor = (weight**2 * frames.variance_e2[index] / time**2).sum(0) / norm**2
    shot = (weight**2 / time / frames.scale[index]).sum(0) / norm**2
    floor = np.where(some, floor, frames.variance_e2[shortest] / time.min() ** 2)
    clipped = ~some & frames.saturated[index].any(0)
    return [
        np.asarray(a)
        for a in (
            value,
            frames.usable[index].any(0),
            clipped,
            floor,
            1 / np.where(some, shot, 1),
        )
    ]


def _gain(capture: Capture, notes: list[str]) -> SensorNoise:
    """Gain and read noise as stated, else as measured, else assumed; notes say which.

    Read noise comes from the description, else from two dark frames or more, else from
    the photon-transfer line of the flats.
    """
    stated, dark = capture.about, capture.dark
    flats = 0 if capture.flat is None else len(capture.flat)
    measured = None
    if "gain_e" in stated:
        gain, sigma, known = float(stated["gain_e"]), 0.0, True
        notes.append(f"gain {gain:g} e/count as stated")
    elif capture.flat is not None and flats > 1:
        measured = photon_transfer(capture.flat, dark)
        gain = measured.gain_e
        sigma = measured.gain_sigma_e
        known = True
        notes.append(
            f"gain {gain:.3g} +- {sigma:.1g} e/count, measured in {flats} flat frames"
        )
    else:
        gain, sigma, known = 1.0, math.inf, False
        notes.append(
            "no flats, no stated gain: 1 e/count assumed, chi-square has no absolute "
            "meaning"
        )
    read_known = True
    if "read_noise_e" in stated:
        read, origin = float(stated["read_noise_e"]), "as stated"
    elif dark is not None and len(dark) > 1:
        read = gain * math.sqrt(max(_floor(dark) - 1 / 12, 0.0))
        origin = f"measured in {len(dark)} dark frames"
    elif measured is not None:
        read = measured.read_noise_e
        origin = "from the flats' photon-transfer line"
        read_known = False
    else:
        read, origin, read_known = 2.0, "assumed", False  # electrons, of a usual sensor
    notes.append(f"read noise {read:.2g} e, {origin}")
    return SensorNoise(gain, sigma, read, known=known, read_known=read_known)


def _dark_level(
    capture: Capture, gain: SensorNoise, notes: list[str]
) -> tuple[Array | float, Array | float]:
    """(counts without light, their standard error), of every pixel where there are dark
    frames.
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
    error = math.hypot(gain.read_noise_e / gain.gain_e, 12**-0.5)
    offset = level
    errors = np.full_like(level, error / math.sqrt(len(capture.dark)))
    if gain.coarse:
        rounded = DarkStatistics.of(capture.dark)
        offset, errors = rounded.level, rounded.error
    notes.append(
        f"offset {np.mean(offset):.4g} counts on average, measured pixel by pixel in "
        f"{len(capture.dark)} dark frames, subtracted"
    )
    return np.asarray(offset), errors


def _flat_field(
    capture: Capture, dark: Array | float, notes: list[str]
) -> tuple[Array, float]:
    """(flat, relative error of one of its pixels); ones where there is none to divide
    by.
    """
    if capture.flat is None:
        return np.ones((1, 1)), 0.0
    level = np.mean(capture.flat, axis=0) - dark
    flat = level / np.median(level)
    noise = math.inf
    if len(capture.flat) > 1:
        noise = math.sqrt(_pair_variance(capture.flat) / len(capture.flat)) / float(
            np.median(level)
        )
    if _robust_sigma(flat) < 1.2 * noise:
        notes.append(
            "flat is a single frame, or even to within its noise: not divided by"
        )
        return np.ones((1, 1)), 0.0
    notes.append(f"divided by the flat, {_robust_sigma(flat):.2%} robust spread")
    return np.where((flat > 0.3) & (flat < 3), flat, 1.0), noise


def _lonely(frames: Array) -> Array:
    ring = np.ones((3, 3), bool)
    ring[1, 1] = False
    around = np.stack([ndimage.median_filter(f, footprint=ring) for f in frames])
    spread = np.stack(
        [
            np.full(f.shape, max(_robust_sigma(f - a), 0.5))
            for f, a in zip(frames, around, strict=True)
        ]
    )
    brightest = np.stack([ndimage.maximum_filter(f, footprint=ring) for f in frames])
    spike = (frames - brightest > 6 * spread) & (frames > 1.5 * brightest)
    return np.asarray(spike.mean(0) > (0.8 if len(frames) >= 3 else 2))


def _floor(dark: Array) -> float:
    """Variance of a count without light where noise hides rounding: 1/12 more than
    before rounding.
    """
    variance = _pair_variance(dark)
    return (
        variance if variance > _ROUGH else DarkStatistics.of(dark).noise ** 2 + 1 / 12
    )


def _pair_variance(frames: Array) -> float:
    """Temporal variance of one frame, from successive differences, robust to a few bad
    pixels.
    """
    steps = np.diff(np.asarray(frames, float), axis=0) / math.sqrt(2)
    steps = steps - steps.mean((1, 2), keepdims=True)
    keep = np.abs(steps) <= 6 * max(_robust_sigma(steps), 0.5)
    return float(
        np.mean(steps[keep] ** 2) * frames[0].size / max(frames[0].size - 1, 1)
    )


def _line(
    mean: Array, variance: Array, spread: Array, floor: float | None
) -> tuple[float, float, float]:
    """Weighted line through (mean, variance): (slope, its error, intercept); a known or
    zero intercept if one level.
    """
    if floor is not None or np.ptp(mean) < 0.2 * mean.max():
        base = floor or 0.0
        weight = (mean / spread) ** 2
        return (
            float((weight * (variance - base) / mean).sum() / weight.sum()),
            float(weight.sum() ** -0.5),
            base,
        )
    design = np.stack([mean, np.ones_like(mean)], 1) / spread[:, None]
    covariance = np.linalg.inv(design.T @ design)
    slope, base = covariance @ design.T @ (variance / spread)
    return float(slope), float(covariance[0, 0] ** 0.5), max(float(base), 0.0)


def _middle(frame: Array) -> float:
    keep = np.abs(frame - np.median(frame)) <= 8 * max(_robust_sigma(frame), 0.5)
    return float(frame[keep].mean())


def _robust_sigma(values: Array) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values))))
