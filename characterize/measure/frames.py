"""Image quality of captured frames: MTF, Strehl ratio, encircled energy, widths;
distortion, field curvature.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, optimize, special

from characterize.captures import Capture, to_electrons
from characterize.measure import metrics
from characterize.measure.metrics import SpotMetrics
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError
from metalens.lens import Lens

_FINE = 15  # samples a pixel side under the ideal spot
_CUBIC = (
    np.array([-1.0, 4.0, 0.0, 4.0, -1.0]) / 6
)  # to a pixel from its second and first neighbours
# pixels on each side of the brightest one, over which the ideal spot is laid on a
# frame's
_CORE = 5
_SAME = 1e-9  # of a depth, which went through its inverse
Field = tuple[float, float]  # angle along x and y, degrees


@dataclass(frozen=True, slots=True)
class FrameMetrics:
    """One frame. strehl: against the Airy pattern of the lens's aperture, nan without a
    design. peak_e: background off.

    angle_deg, angle_y_deg: of the field along x and y.
    mtf50_x_per_um, mtf50_y_per_um: of the spot, pixel included. efficiency: share of
    the reference's light within
    ``circle_um`` (three times the FWHM) about the centroid, nan without a reference.
    """

    name: str
    depth_um: float
    angle_deg: float
    angle_y_deg: float
    spot: SpotMetrics
    mtf50_x_per_um: float
    mtf50_y_per_um: float
    strehl: float
    circle_um: float
    efficiency: float
    peak_e: float

    @property
    def field(self) -> Field:
        """Angles along x and y that one position of the source has in all frames."""
        return round(self.angle_deg, 6), round(self.angle_y_deg, 6)


@dataclass(frozen=True, eq=False, slots=True)
class CaptureQuality:
    """All frames, and what they say together.

    best_depth_um: {field angles (x, y) in degrees: source depth of the sharpest spot}:
    field curvature.
    distortion: {field angles: (place on the sensor along the field over d tan(angle)) -
    1}, relative to the smallest
    angle; empty where frames were taken at one angle, or windows move with the chief
    ray (``window`` in the capture's
    description).
    light: (n, y, x) electrons above background. step_um: of a pixel.
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
    """Quality of the frames as they are.

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
            "pixel_um is missing: give the sensor's pixel in capture.toml"
        )
    frames = to_electrons(capture)
    step = capture.pixel_um
    shots = zip(frames.electrons, frames.usable, _places(capture), strict=True)
    light = np.stack([_above(*shot) for shot in shots])
    notes = [*frames.corrections, *_masked_words(light, frames.usable)]
    if frames.saturated.any():
        notes.append(
            "saturated pixels: Strehl ratio, widths and MTF of their frames are too good or too bad"
        )
    rows = [
        _row(capture, i, image, design, reference_e) for i, image in enumerate(light)
    ]
    best = _best(rows)
    notes += [
        _open_end(field, depth)
        for field, depth in best.items()
        if _at_an_end(rows, field, depth)
    ]
    return CaptureQuality(
        tuple(rows), best, _distortion(rows, capture, design), light, step, tuple(notes)
    )


def _row(
    capture: Capture, i: int, image: Array, design: Lens | None, reference_e: float
) -> FrameMetrics:
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
        spot,
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
    place_px: Field = (0.0, 0.0),
) -> Array:
    """(y, x) Airy pattern of the lens's aperture at its sensor, in the capture's
    pixels.

    place_px: (x, y) of its middle from the window's.

    Args:
        design: the lens whose aperture it is.
        shape: (rows, columns).
    """
    wave = (
        capture.wavelength_um
        if math.isfinite(capture.wavelength_um)
        else design.wavelength_um
    )
    sine = design.diameters.radius_um / math.hypot(
        design.diameters.radius_um, design.reduced_um
    )
    within = capture.fill * ((np.arange(_FINE) + 0.5) / _FINE - 0.5)
    y, x = (
        (np.arange(n)[:, None] - (n - 1) / 2 - p + within).ravel()
        for n, p in zip(shape, place_px[::-1], strict=True)
    )
    u = 2 * math.pi * sine / wave * capture.pixel_um * np.hypot(x[None], y[:, None])
    safe = np.maximum(u, 1e-9)
    fine = np.where(u > 1e-9, (2 * special.j1(safe) / safe) ** 2, 1.0)
    return np.asarray(fine.reshape(shape[0], _FINE, shape[1], _FINE).mean((1, 3)))


def _strehl(image: Array, design: Lens, capture: Capture) -> float:
    """Strehl ratio against the Airy pattern where it is most like the spot (largest
    normalised correlation).
    """
    peak = [int(i) for i in np.unravel_index(int(image.argmax()), image.shape)]
    half = min(_CORE, (min(image.shape) - 1) // 2)
    middle = [
        min(max(i, half), n - 1 - half) for i, n in zip(peak, image.shape, strict=True)
    ]
    core = image[tuple(slice(i - half, i + half + 1) for i in middle)]

    def unlike(at: Array) -> float:
        ideal = airy_pattern(
            design, capture, core.shape, place_px=(float(at[0]), float(at[1]))
        )
        return -float((ideal * core).sum() / np.linalg.norm(ideal))

    start = np.array([peak[1] - middle[1], peak[0] - middle[0]], float)
    simplex = start + np.array([[0.0, 0.0], [0.4, 0.0], [0.0, 0.4]])
    options = {
        "initial_simplex": simplex,
        "xatol": 2e-3,
        "fatol": 1e-9 * float(np.abs(core).sum()),
    }
    found = optimize.minimize(unlike, start, method="Nelder-Mead", options=options).x
    x, y = (
        float(f) + m - (n - 1) / 2
        for f, m, n in zip(found, middle[::-1], image.shape[::-1], strict=True)
    )
    ideal = airy_pattern(design, capture, image.shape, place_px=(x, y))
    return metrics.strehl_ratio(image, ideal - np.median(_rim(ideal)))


def _places(capture: Capture) -> list[str]:
    """Name and depth of every frame."""
    depths = (
        f" at {depth:g} um" if math.isfinite(depth) else ""
        for depth in capture.position_um
    )
    return [f"{name}{depth}" for name, depth in zip(capture.names, depths, strict=True)]


def _above(electrons: Array, usable: Array, place: str) -> Array:
    """The frame above the median of its border; masked pixels by :func:`_filled`.

    Raises:
        CaptureError: none of its light stands out; the frame's place is named.
    """
    rim = _rim(electrons)
    light = _filled(electrons - np.median(rim), usable)
    noise = 1.4826 * float(np.median(np.abs(rim - np.median(rim))))
    if light.max() < 5 * max(noise, 1e-9):
        raise CaptureError(
            f"{place}: no spot above five times the noise of the frame's border; where defocus spreads "
            "the light so far, leave the frame out or take a wider one; else expose longer, or crop around the spot"
        )
    return np.asarray(light)


def _filled(light: Array, usable: Array) -> Array:
    """Masked pixels by the cubic through two pixels on either side, (4 (f₁ + f₋₁) - f₂
    - f₋₂) / 6.

    Mean of that along rows and along columns where all four are usable, else mean of
    the usable ones of the eight
    neighbours (0 without any). A hole in the core of a spot would narrow it.
    """
    known, some = np.where(usable, light, 0.0), usable.astype(float)
    cubic, lines = np.zeros_like(known), np.zeros_like(known)
    for axis in (0, 1):
        whole = ndimage.correlate1d(some, [1, 1, 0, 1, 1], axis, mode="constant") > 3.5
        cubic += whole * ndimage.correlate1d(known, _CUBIC, axis, mode="constant")
        lines += whole
    near, count = (
        ndimage.correlate(part, np.ones((3, 3)), mode="constant")
        for part in (known, some)
    )
    filled = np.where(
        lines > 0, cubic / np.maximum(lines, 1), near / np.maximum(count, 1)
    )
    return np.where(usable, light, filled)


def _masked_words(light: Array, usable: Array) -> list[str]:
    """What masked pixels in the core of a spot, above a tenth of its peak, mean for its
    numbers.
    """
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


def _best(rows: list[FrameMetrics]) -> dict[Field, float]:
    """Depth of the highest peak share at each angle, by a parabola in 1/z through the
    best three.
    """
    out = {}
    for field in sorted({r.field for r in rows}):
        own = sorted((r for r in rows if r.field == field), key=lambda r: r.depth_um)
        if len(own) < 3 or not all(math.isfinite(r.depth_um) for r in own):
            continue
        sharp = np.array([1 / r.spot.ee80_um**2 for r in own])
        place = 1 / np.array([r.depth_um for r in own])
        k = int(np.clip(np.argmax(sharp), 1, len(own) - 2))
        a, b, _ = np.polyfit(place[k - 1 : k + 2], sharp[k - 1 : k + 2], 2)
        top = -b / (2 * a) if a < 0 else place[int(np.argmax(sharp))]
        out[field] = float(1 / np.clip(top, place.min(), place.max()))
    return out


def _at_an_end(rows: list[FrameMetrics], field: Field, depth_um: float) -> bool:
    """Whether the sharpest depth of an angle is the first or last of its frames."""
    depths = [r.depth_um for r in rows if r.field == field]
    return min(abs(depth_um / end - 1) for end in (min(depths), max(depths))) < _SAME


def _open_end(field: Field, depth_um: float) -> str:
    x, y = field
    return f"sharpest at {x:g}, {y:g} deg at an end of the captured depths, {depth_um:.5g} um: focus may lie beyond it"


def _distortion(
    rows: list[FrameMetrics], capture: Capture, design: Lens | None
) -> dict[Field, float]:
    """Only where the window stands still (``window = "fixed"`` in capture.toml) and the
    design gives the distance.
    """
    if design is None or capture.about.get("window") != "fixed":
        return {}
    places: dict[Field, list[Field]] = {}
    for row in rows:
        places.setdefault(row.field, []).append(row.spot.centroid_um)
    zero = np.mean(places.get((0.0, 0.0), [(0.0, 0.0)]), axis=0)
    ratio, least = {}, math.inf
    for field in sorted(places, key=lambda f: math.hypot(*f)):
        tangent = np.tan(np.radians(field))
        if not tangent.any():
            continue
        straight = design.reduced_um * tangent
        ratio[field] = float(
            (np.mean(places[field], axis=0) - zero) @ straight / (straight @ straight)
        )
        least = ratio[field] if math.isinf(least) else least
    return {field: value / least - 1 for field, value in sorted(ratio.items())}
