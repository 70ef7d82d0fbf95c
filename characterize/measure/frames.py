"""Image quality of captured frames: MTF, Strehl ratio, encircled energy, widths;
distortion, field curvature.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, special

from characterize.captures import Capture, to_electrons
from characterize.measure import metrics
from characterize.model import aperture_sine
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError
from metalens.lens import Lens
from metalens.psf import find_peak

# weights of the second and first neighbours that interpolate a pixel
_CUBIC = np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6
Field = tuple[float, float]  # angle along x and y, degrees


@dataclass(frozen=True, slots=True)
class FrameMetrics:
    """Image quality of one frame.

    name, depth_um: of the frame. angle_deg, angle_y_deg: field angles along x and y.
    fwhm_um, ee80_um, d4sigma, centroid: as :class:`metrics.SpotMetrics`.
    mtf50_x_per_um, mtf50_y_per_um: frequencies of half modulation, pixel included.
    strehl: against the Airy pattern of the lens's aperture, nan without a design.
    circle_um: diameter of the efficiency's circle, three times the FWHM.
    efficiency: light within the circle over that of the reference, nan without it.
    peak_e: highest pixel above background, electrons.
    """

    name: str
    depth_um: float
    angle_deg: float
    angle_y_deg: float
    fwhm_um: float
    ee80_um: float
    d4sigma_major_um: float
    d4sigma_minor_um: float
    centroid_x_um: float
    centroid_y_um: float
    mtf50_x_per_um: float
    mtf50_y_per_um: float
    strehl: float
    circle_um: float
    efficiency: float
    peak_e: float

    @property
    def field(self) -> Field:
        """Field angles along x and y in degrees, rounded so that equal ones compare
        equal.
        """
        return round(self.angle_deg, 6), round(self.angle_y_deg, 6)


@dataclass(frozen=True, eq=False, slots=True)
class CaptureQuality:
    """Image quality of all frames, field curvature and distortion.

    frames: metrics of every frame.
    best_depth_um: {(x, y) field angles in degrees: source depth of the sharpest spot}.
    distortion: {field angles: image height / (d tan(angle)) - 1}, relative to the
    smallest angle. Empty with one angle, or where the window moves with the chief ray.
    light: (n, y, x) electrons above background. step_um: side of a pixel.
    notes: cautions in words.
    """

    frames: tuple[FrameMetrics, ...]
    best_depth_um: dict[Field, float]
    distortion: dict[Field, float]
    light: Array
    step_um: float
    notes: tuple[str, ...]


def measure_frames(
    capture: Capture, *, design: Lens | None = None, reference_e: float = math.nan
) -> CaptureQuality:
    """Image quality of captured frames: spot widths, MTF, Strehl ratio, efficiency,
    best depth, distortion.

    Args:
        capture: frames in counts with their stage and camera.
        design: gives the aperture for the Strehl ratio.
        reference_e: electrons of the same beam through an empty aperture of the lens's
            size, for the efficiency.

    Raises:
        CaptureError: pixel unknown, or a frame without light above its background.
    """
    if math.isnan(capture.pixel_um):
        raise CaptureError(
            "pixel_um is missing: give the sensor's pixel in capture.toml; of a "
            "micrograph, --pixel-nm or --bar-nm"
        )
    frames = to_electrons(capture)
    step = capture.pixel_um
    light = np.stack(
        [
            _above_border(*shot)
            for shot in zip(
                frames.electrons,
                frames.usable,
                capture.names,
                capture.position_um.tolist(),
                strict=True,
            )
        ]
    )
    notes = [*frames.corrections, *_masked_words(light, frames.usable)]
    if frames.saturated.any():
        notes.append(
            "saturated pixels: Strehl ratio, widths and MTF of their frames are too good or too bad"
        )
    rows = [
        _metrics_row(capture, i, image, design, reference_e)
        for i, image in enumerate(light)
    ]
    sharpest = _sharpest_depths(rows, notes)
    return CaptureQuality(
        tuple(rows),
        sharpest,
        _distortion(rows, capture, design),
        light,
        step,
        tuple(notes),
    )


def _metrics_row(
    capture: Capture, i: int, image: Array, design: Lens | None, reference_e: float
) -> FrameMetrics:
    """Metrics of frame ``i``, whose light above background is ``image``."""
    step = capture.pixel_um
    spot = metrics.measure_spot(image, step_um=step)
    circle = 3 * spot.fwhm_um
    share = math.nan
    if math.isfinite(reference_e) and math.isfinite(circle):
        share = metrics.focusing_efficiency(
            image, reference_e, step_um=step, aperture_um=circle
        )
    return FrameMetrics(
        capture.names[i],
        float(capture.position_um[i]),
        float(np.degrees(capture.angle_rad[i, 0])),
        float(np.degrees(capture.angle_rad[i, 1])),
        spot.fwhm_um,
        spot.ee80_um,
        *spot.d4sigma_um,
        *spot.centroid_um,
        metrics.mtf_of_psf(image, step_um=step, axis="x").mtf50_per_um,
        metrics.mtf_of_psf(image, step_um=step, axis="y").mtf50_per_um,
        math.nan if design is None else _strehl(image, design, capture),
        circle,
        share,
        float(image.max()),
    )


def airy_pattern(
    design: Lens,
    capture: Capture,
    shape: tuple[int, ...],
    *,
    place_px: Array,
    fine: int = 15,
) -> Array:
    """(y, x) Airy pattern (2 J1(u) / u)² of the lens's aperture, averaged over the
    pixels of a capture.

    u = 2 pi sin(theta) r / wavelength, with the half aperture angle theta.

    Args:
        design: the lens whose aperture it is.
        capture: gives the pixel, its fill factor and the wavelength.
        shape: (rows, columns).
        place_px: (row, column) of the pattern's middle from that of the window.
        fine: samples along a pixel's side.
    """
    wavelength_um = (
        capture.wavelength_um
        if math.isfinite(capture.wavelength_um)
        else design.wavelength_um
    )
    offsets = capture.fill * ((np.arange(fine) + 0.5) / fine - 0.5)
    y, x = (
        (np.arange(size)[:, None] - (size - 1) / 2 - place + offsets).ravel()
        for size, place in zip(shape, place_px.tolist(), strict=True)
    )
    per_pixel = 2 * math.pi * aperture_sine(design) / wavelength_um * capture.pixel_um
    u = np.maximum(per_pixel * np.hypot(x[None], y[:, None]), 1e-9)
    samples = (2 * special.j1(u) / u) ** 2
    return np.asarray(samples.reshape(shape[0], fine, shape[1], fine).mean((1, 3)))


def _strehl(
    image: Array, design: Lens, capture: Capture, *, alignments: int = 6
) -> float:
    """Strehl ratio of a spot against the Airy pattern of equal peak position.

    The position is that of the peaks of splines through the pixels, iterated until that
    of the pattern is that of the spot; its distance shrinks to a half or less in each
    of the ``alignments``.
    """
    peak = np.array(find_peak(image)[:2])
    place = peak - (np.array(image.shape) - 1) / 2
    for _ in range(alignments):
        ideal = airy_pattern(design, capture, image.shape, place_px=place)
        place = place + peak - find_peak(ideal)[:2]
    return metrics.strehl_ratio(image, ideal - np.median(_rim(ideal)))


def _above_border(electrons: Array, usable: Array, name: str, depth_um: float) -> Array:
    """The frame above the median of its border; masked pixels by :func:`_filled`.

    Raises:
        CaptureError: none of its light stands out; name and depth are given.
    """
    border = _rim(electrons)
    light = _filled(electrons - np.median(border), usable)
    noise = 1.4826 * float(np.median(np.abs(border - np.median(border))))
    if light.max() < 5 * max(noise, 1e-9):
        raise CaptureError(
            f"{name} at {depth_um:g} um: no spot above five times the noise of the "
            "frame's border; where defocus spreads the light so far, leave the frame "
            "out or take a wider one; else expose longer, or crop around the spot"
        )
    return np.asarray(light)


def _filled(light: Array, usable: Array) -> Array:
    """The frame with masked pixels interpolated by the cubic
    (4 (f₁ + f₋₁) - f₂ - f₋₂) / 6.

    It is the mean along rows and columns where all four neighbours are usable, else the
    mean of the usable pixels among the eight neighbours, or 0 without any.
    """
    light_known = np.where(usable, light, 0.0)
    is_usable = usable.astype(float)
    cubic = np.zeros_like(light_known)
    line_count = np.zeros_like(light_known)
    for axis in (0, 1):
        complete = (
            ndimage.correlate1d(is_usable, [1, 1, 0, 1, 1], axis, mode="constant") > 3.5
        )
        cubic += complete * ndimage.correlate1d(
            light_known, _CUBIC, axis, mode="constant"
        )
        line_count += complete
    neighbour_sum, count = (
        ndimage.correlate(part, np.ones((3, 3)), mode="constant")
        for part in (light_known, is_usable)
    )
    filled = np.where(
        line_count > 0,
        cubic / np.maximum(line_count, 1),
        neighbour_sum / np.maximum(count, 1),
    )
    return np.where(usable, light, filled)


def _masked_words(light: Array, usable: Array) -> list[str]:
    """Caution on masked pixels above a tenth of a spot's peak; empty without any."""
    inside = (~usable & (light > 0.1 * light.max((1, 2), keepdims=True))).sum((1, 2))
    if not inside.any():
        return []
    return [
        f"masked pixels lie within {int((inside > 0).sum())} spots ({int(inside.max())} at most): filled from their "
        "neighbours, so that Strehl ratio, widths and MTF there are less sure"
    ]


def _rim(image: Array) -> Array:
    """Border pixels, each once."""
    return np.concatenate([image[0], image[-1], image[1:-1, 0], image[1:-1, -1]])


def _sharpest_depths(rows: list[FrameMetrics], notes: list[str]) -> dict[Field, float]:
    """{field angles: depth in um of the sharpest spot}; appends to ``notes`` where it
    is the first or last of an angle.

    Sharpness is 1 / EE80², averaged over frames of equal depth. Its maximum is that of
    a parabola through the three depths about the sharpest: in 1/z for distances from
    the lens, in z for a stage that passes 0. Angles with fewer than three depths are
    left out.
    """
    depths = {}
    for field in sorted({row.field for row in rows}):
        of_field = [row for row in rows if row.field == field]
        z = np.array([row.depth_um for row in of_field])
        are_distances = z.min() > 0
        places, frame = np.unique(1 / z if are_distances else z, return_inverse=True)
        if len(places) < 3 or not np.isfinite(z).all():
            continue
        total = np.bincount(frame, [row.ee80_um**-2 for row in of_field])
        sharpness = total / np.bincount(frame)
        best = int(sharpness.argmax())
        k = min(max(best, 1), len(places) - 2)
        near = slice(k - 1, k + 2)
        a, b, _ = np.polyfit(places[near] - places[k], sharpness[near], 2)
        vertex = places[k] - b / (2 * a) if a < 0 else places[best]
        sharpest = float(np.clip(vertex, places[0], places[-1]))
        depths[field] = 1 / sharpest if are_distances else sharpest
        if not places[0] < vertex < places[-1]:
            notes.append(
                f"sharpest at {field[0]:g}, {field[1]:g} deg at an end of the captured "
                f"depths, {depths[field]:.5g} um: focus may lie beyond it"
            )
    return depths


def _distortion(
    rows: list[FrameMetrics], capture: Capture, design: Lens | None
) -> dict[Field, float]:
    """{field angles: distortion} relative to the smallest angle.

    Distortion: image height along the field over d tan(angle), less 1. Empty without a
    design, or where the window is not fixed (``window = "fixed"`` in capture.toml).
    """
    if design is None or capture.about.get("window") != "fixed":
        return {}
    places: dict[Field, list[Field]] = {}
    for row in rows:
        place = row.centroid_x_um, row.centroid_y_um
        places.setdefault(row.field, []).append(place)
    axis_place = np.mean(places.get((0.0, 0.0), [(0.0, 0.0)]), axis=0)
    ratio = {}
    for field in sorted(places, key=lambda angles: math.hypot(*angles)):
        ideal_um = design.reduced_um * np.tan(np.radians(field))
        if ideal_um.any():
            image_um = np.mean(places[field], axis=0) - axis_place
            ratio[field] = float(image_um @ ideal_um / (ideal_um @ ideal_um))
    reference = next(iter(ratio.values()), 1.0)
    return {field: value / reference - 1 for field, value in sorted(ratio.items())}
