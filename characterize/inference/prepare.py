"""From a capture to what a fit needs: brackets merged, the window about the light, what
the capture itself states, and
how little of the model is enough."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from characterize.captures import (
    Capture,
    ElectronFrames,
    merge_brackets,
    quantization_score,
)
from characterize.inference.leastsquares import FitImages
from characterize.model import ForwardModel, FrameSetting, KnownValue, usual_parameters
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError
from metalens.fabrication import PillarKinds, Sensitivity
from metalens.lens import Lens

MOST_OF_ONE_FRAME = 8
_STILL = 0.05  # counts of noise at least that levels of pixels add, whatever is stated
_FEW_BEYOND, _ROUGH = 0.01, 0.1  # share of the pillars, of slopes
_CUTS, _NOTHING = (2e-2, 8e-3, 3e-3, 1e-3), 0.02


def merge_exposures(
    capture: Capture, frames: ElectronFrames
) -> tuple[Capture, ElectronFrames]:
    """Exposures of one depth and angle merged into one frame, by inverse variance.

    Unchanged where exposures are unknown, or where they differ and the dark level is
    unknown.

    Args:
        capture: frames in counts with their stage and camera.
        frames: the same in electrons.
    """
    place = np.column_stack([capture.position_um, capture.angle_rad])
    group = np.unique(place, axis=0, return_inverse=True)[1].ravel()
    exposure = np.asarray(capture.exposure_s, float)
    numbers = set(group.tolist())
    complete = _timed(capture) and np.isfinite(place).all()
    if not complete or len(numbers) == len(group):
        return capture, frames
    differ = any(np.ptp(exposure[group == number]) for number in numbers)
    if differ and not _dark_known(capture):
        said = "exposures of one depth are fitted one by one: no dark frame tells what is added to all of them"
        return capture, dataclasses.replace(
            frames, corrections=(*frames.corrections, said)
        )
    merged, first = merge_brackets(frames, exposure, group)
    longest = np.array([exposure[group == group[i]].max() for i in first])
    single = dataclasses.replace(
        capture,
        frames=capture.frames[first],
        position_um=capture.position_um[first],
        angle_rad=capture.angle_rad[first],
        exposure_s=longest,
        names=tuple(capture.names[i] for i in first),
    )
    return single, merged


def setting_of(
    capture: Capture, largest: int
) -> tuple[FrameSetting, tuple[slice, slice]]:
    """The frames to predict, and the window (rows, columns) of at most ``largest``
    pixels that is fitted.

    Args:
        capture: frames in counts with their stage and camera.

    Raises:
        CaptureError: depths, pixel or wavelength missing; windows at field angles that
            stand still on the sensor.
    """
    if not np.isfinite(capture.position_um).all():
        raise CaptureError(
            "source depths are missing: list every frame in stage.csv with depth_um (or depth_mm)"
        )
    if math.isnan(capture.pixel_um):
        raise CaptureError(
            "pixel_um is missing: give the sensor's pixel in capture.toml; it cannot be fitted"
        )
    if math.isnan(capture.wavelength_um):
        raise CaptureError(
            "wavelength_um is missing: give the light's wavelength in capture.toml; it cannot be fitted"
        )
    if capture.about.get("window") == "fixed" and capture.angle_rad.any():
        raise CaptureError(
            'window = "fixed" in capture.toml: at a field angle the middle pixel stands for the chief ray; cut the '
            "frames there (distance times tan(angle) off the axis) and leave window out, or fit those of angle 0 alone"
        )
    window = _window(capture, largest)
    exposure = capture.exposure_s / capture.exposure_s.max() if _timed(capture) else 1.0
    n = len(capture.frames)
    rows, columns = (s.stop - s.start for s in window)
    return FrameSetting(
        np.asarray(capture.position_um, float),
        np.asarray(capture.angle_rad, float),
        np.broadcast_to(np.asarray(exposure, float), n).copy(),
        capture.pixel_um,
        rows,
        columns,
        fill=capture.fill,
        dark_known=_dark_known(capture),
    ), window


def _timed(capture: Capture) -> bool:
    """Whether the exposure of every frame is known."""
    return bool((np.isfinite(capture.exposure_s) & (capture.exposure_s > 0)).all())


def _dark_known(capture: Capture) -> bool:
    """Whether the counts without light are known, and so subtracted."""
    return capture.dark is not None or "offset" in capture.about


def _window(capture: Capture, largest: int) -> tuple[slice, slice]:
    """(rows, columns) of at most ``largest`` pixels about the centre of the light.

    The centroid of the median frame above 0.2 of its peak.
    """
    frames = np.asarray(capture.frames, float)
    light = np.median(frames, axis=0) - np.median(frames)
    light = np.maximum(light - 0.2 * np.percentile(light, 99.9), 0)
    total = max(light.sum(), 1e-9)
    slices = []
    for axis, size in enumerate(light.shape):
        side = min(size, largest)
        place = (light.sum(1 - axis) * np.arange(size)).sum() / total
        first = int(np.clip(round(place) - side // 2, 0, size - side))
        slices.append(slice(first, first + side))
    return slices[0], slices[1]


def data_of(frames: ElectronFrames, window: tuple[slice, slice]) -> FitImages:
    """What is fitted, cut to the window.

    Args:
        frames: frames in electrons.
    """
    shape = frames.electrons.shape
    cut = (slice(None), *window)
    wide = frames.variance_e2, frames.scale, frames.common_floor
    floor, scale, dark = (np.broadcast_to(a, shape)[cut] for a in wide)
    return FitImages(
        frames.electrons[cut],
        frames.usable[cut],
        frames.saturated[cut],
        floor,
        scale,
        common_floor=dark,
        common_light=frames.common_light,
        count_e=frames.count_e,
    )


def correct_quantization(data: FitImages, image: Array) -> FitImages:
    """Rounded counts as means and variances of equal information about ``image``.

    Fisher scoring in each pixel: mean I + score / information, variance 1 over the
    information. A fit to them ends at the greatest likelihood of the counts
    (:mod:`characterize.captures.rounding`), once ``image`` is that of the fit.

    Args:
        data: frames, masks and noise that are fitted.
        image: (n, y, x) expected electrons.
    """
    step = data.count_e / data.scale
    variance = data.variance(image)
    noise = np.sqrt(np.maximum(variance / step**2 - 1 / 12, _STILL**2))
    score, information = quantization_score((data.electrons - image) / step, noise)
    floor = np.where(
        data.saturated,
        data.variance_e2,
        data.variance_e2 + step**2 / information - variance,
    )
    return dataclasses.replace(
        data,
        electrons=np.where(
            data.saturated, data.electrons, image + step * score / information
        ),
        variance_e2=floor,
        common_floor=data.common_floor * data.variance_e2 / floor,
        count_e=0.0,
    )


def quick_enough(model: ForwardModel, data: FitImages, x: Array) -> ForwardModel:
    """The model with the fewest terms of its fields that does not change the misfit.

    At parameters ``x`` chi-square against all terms rises by less than ``_NOTHING``.

    Args:
        model: the full model.
        data: frames and their noise.
        x: all parameters.
    """
    exact = model.images(x)[0]
    noise = np.sqrt(data.variance(exact))
    for cut in _CUTS:
        rough = model.rough(cut)
        residual = ((rough.images(x)[0] - exact) / noise)[data.usable]
        if float((residual**2).sum()) < _NOTHING:
            return rough
    return model


def check_enough(data: FitImages, names: Sequence[str]) -> None:
    """Refuse frames that cannot determine the parameters, whatever their quality.

    Args:
        data: frames, masks and noise that are fitted.
        names: (p,) names of the fitted parameters.

    Raises:
        CaptureError: one frame for more parameters than one image can distinguish, or
            fewer than three pixels a parameter.
    """
    lens = [
        name
        for name in names
        if not name.startswith(("log_gain", "background", "crosstalk", "decentre"))
    ]
    frames = len(data.electrons)
    pixels = int((data.usable & ~data.saturated).sum())
    if frames < 2 and len(lens) > MOST_OF_ONE_FRAME:
        raise CaptureError(
            f"one frame for {len(names)} parameters: defocus, wave front and bias look alike in one image; need frames "
            "at two depths or more (five on both sides of focus are good), or hold all but "
            f"{MOST_OF_ONE_FRAME} parameters with [[known]] (sigma = 0)"
        )
    if pixels < 3 * len(names):
        raise CaptureError(
            f"{pixels} usable pixels for {len(names)} parameters; need three each: a larger window"
        )


def check_depths(depth_um: Array, lens: Lens) -> None:
    """Refuse depths in another unit: a thousandth or a thousand times the design's.

    Args:
        depth_um: (n,) stated source depths, um. lens: the design.

    Raises:
        CaptureError: with the column that would be right.
    """
    middle = float(np.median(depth_um))
    focus_um = lens.source_distance_um
    if not math.isfinite(focus_um):
        focus_um = 10 * lens.sensor_distance_um
    for factor, column in ((1e3, "depth_mm"), (1e-3, "depth_nm")):
        if abs(math.log10(max(middle, 1e-9) * factor / focus_um)) < 0.7:
            raise CaptureError(
                f"depths about {middle:g} um, the design is focused on {focus_um:g} um: they look like "
                f"{column.removeprefix('depth_')}; rename the column depth_um of stage.csv to {column}"
            )


def stated_priors(capture: Capture, lens: Lens) -> list[KnownValue]:
    """Priors that the capture itself states: wavelength (as usual unless
    wavelength_sigma_nm), pinhole, glass, and pitch of the sensor's pixels.

    Args:
        lens: the design.
    """
    offset = (capture.wavelength_um - lens.wavelength_um) * 1e3
    usual_nm = usual_parameters(["wavelength_nm"], lens)[0].sigma
    sigma_nm = float(capture.about.get("wavelength_sigma_nm", usual_nm))
    priors = [KnownValue("wavelength_nm", offset, sigma_nm)]
    exact = ("pinhole_um", "glass_um", "glass_tilt_x_deg", "glass_tilt_y_deg")
    priors += [
        KnownValue(name, _number(capture, name), 0.0)
        for name in exact
        if name in capture.about
    ]
    if "pixel_sigma_um" in capture.about:
        # of one colour of a mosaic, ``pixel_um`` is a multiple of the sensor's pitch
        pitch_um = capture.fill * capture.pixel_um
        percent = 100 * _number(capture, "pixel_sigma_um") / pitch_um
        priors.append(KnownValue("pixel_percent", 0.0, percent))
    return priors


def _number(capture: Capture, name: str) -> float:
    value = capture.about[name]
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not math.isfinite(value)
    ):
        raise CaptureError(f"capture.toml: {name} = {value!r}; need a finite number")
    return float(value)


def roughly_known(lens: Lens, response: Sensitivity) -> list[str]:
    """What is known of the pillars to a tenth of it at best, or to a bias less than is
    assumed, in words.

    Args:
        lens: the design.
        response: slopes of the pillars by height and index.
    """
    rough = f"slopes of the pillars by height and index are known to {response.error:.0%} only"
    return [*_beyond_table(lens), *([rough] if response.error > _ROUGH else [])]


def _beyond_table(lens: Lens) -> list[str]:
    """Whether the bias to be expected leads pillars of two sizes beyond the table
    of their lens, in words.
    """
    if lens.pairs is None:
        return []
    kinds = PillarKinds.of(lens.diameters)
    reach_um = usual_parameters(("bias_nm",), lens)[0].sigma * 1e-3
    at_ends = np.zeros(len(kinds.count), bool)
    for size, axis in (
        (kinds.width_um, lens.pairs.x_um),
        (kinds.length_um, lens.pairs.y_um),
    ):
        at_ends |= (size < axis[0] + reach_um) | (size > axis[-1] - reach_um)
    share = float(kinds.count[at_ends].sum() / kinds.count.sum())
    if share < _FEW_BEYOND:
        return []
    return [
        f"{share:.0%} of the pillars are within {reach_um * 1e3:.0f} nm of the ends of their table, beyond which t is "
        "followed along its tangents: sweep the library that much wider than the sizes the design may use"
    ]
