"""From a capture to what a fit needs: brackets merged, the window about the light, and
what the capture itself states.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from characterize.captures import Capture, ElectronFrames, merge_brackets
from characterize.inference.leastsquares import FitImages
from characterize.model import FrameSetting, KnownValue, usual_parameters
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError
from metalens.lens import Lens

MOST_OF_ONE_FRAME = 8


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
    for name in ("pixel_um", "wavelength_um"):
        if math.isnan(getattr(capture, name)):
            raise CaptureError(
                f"{name} is missing: give it in capture.toml; it cannot be fitted"
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
    """(rows, columns) of a square of at most ``largest`` pixels about the light.

    The centroid of the median frame above 0.2 of its peak.
    """
    frames = np.asarray(capture.frames, float)
    light = np.median(frames, axis=0) - np.median(frames)
    light = np.maximum(light - 0.2 * np.percentile(light, 99.9), 0)
    total = max(light.sum(), 1e-9)
    slices = []
    side = min(*light.shape, largest)
    for axis, size in enumerate(light.shape):
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
    )


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
            f"one frame for {len(names)} parameters: defocus, wave front and bias "
            "cannot be distinguished in one image; need frames at two depths or more "
            "(five on both sides of focus are good), or hold all but "
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
        KnownValue(name, float(capture.about[name]), 0.0)
        for name in exact
        if name in capture.about
    ]
    if "pixel_sigma_um" in capture.about:
        # of one colour of a mosaic, ``pixel_um`` is a multiple of the sensor's pitch
        pitch_um = capture.fill * capture.pixel_um
        percent = 100 * float(capture.about["pixel_sigma_um"]) / pitch_um
        priors.append(KnownValue("pixel_percent", 0.0, percent))
    return priors
