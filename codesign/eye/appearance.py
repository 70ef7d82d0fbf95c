"""Augmentations of rendered frames: spectacles, make-up, lashes, uneven light,
movement.
"""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import resources

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from codesign.eye.population import CameraRig, EyeStates
from codesign.eye.renderer import PinholeCamera, RenderedFrames, render
from metalens.core.arrays import Array
from metalens.image import Frames


@dataclass(frozen=True, slots=True)
class FrameAugmentation:
    """Something that a frame may have: in this share of them at variety 2, its size
    drawn evenly from a range.

    low, high: range of its size in ``unit``.
    """

    share: float
    low: float
    high: float
    unit: str
    what: str


_DATA = resources.files("codesign").joinpath("data", "augmentations.toml")
CAUSES: Mapping[str, FrameAugmentation] = {
    name: FrameAugmentation(**row)
    for name, row in tomllib.loads(_DATA.read_text("utf-8")).items()
}
ARC = np.linspace(0, 1, 5)  # along a lash


# of every cause and frame its size, 0 where it is off, and 12 independent draws in [0, 1)
# that place it: (n, 13)
DrawnAugmentations = Mapping[str, Array]


def drawn_of_people(
    who: Array, variety: float, seed: tuple[int, ...]
) -> DrawnAugmentations:
    """Augmentations of frames of some people.

    One draw a person, except movement, which is drawn for every frame.

    Args:
        who: (n,) number of the person in each frame, from 0.
        variety: factor on the spread of looks; above 1 with augmentations.
        seed: of the random generator.
    """
    people, frames = (
        draw_augmentations(count, variety, np.random.default_rng((*seed, stream)))
        for stream, count in enumerate((int(who.max()) + 1, len(who)))
    )
    own = {name: values[who] for name, values in people.items()}
    return own | {"movement": frames["movement"]}


def draw_augmentations(
    count: int, variety: float, generator: np.random.Generator
) -> DrawnAugmentations:
    """Augmentations of ``count`` frames, drawn independently by cause.

    A cause is on with probability share * (variety - 1), limited to [0, 1]; none is on
    up to variety 1. A ``generator`` of one seed draws the same sizes at any variety.
    """
    drawn = {}
    for name, cause in CAUSES.items():
        on = generator.random(count) < min(cause.share * max(variety - 1.0, 0.0), 1.0)
        size = np.where(on, generator.uniform(cause.low, cause.high, count), 0.0)
        drawn[name] = np.column_stack([size, generator.random((count, 12))])
    return drawn


def render_dressed(
    states: EyeStates,
    worn: DrawnAugmentations,
    *,
    rig: CameraRig,
    camera: PinholeCamera,
) -> RenderedFrames:
    """Rendered frames of states with their augmentations painted on them.

    Args:
        worn: augmentations of every frame. rig: pose of camera and lamps.
        camera: pixel grid of the frames.
    """
    return apply_augmentations(render(states, rig=rig, camera=camera), worn)


def apply_augmentations(
    rendered: RenderedFrames, worn: DrawnAugmentations
) -> RenderedFrames:
    """Rendered frames with their augmentations.

    Light, coverage and depth of both sheets change, and the pupil's mask where
    something covers or moves it. Of the labels the centroid and the visible share of
    the pupil follow.

    Args:
        rendered: rendered frames. worn: augmentations of every frame.
    """
    if not any(values[:, 0].any() for values in worn.values()):
        return rendered
    light, cover, depth = (
        getattr(rendered.frames, name).clone() for name in Frames.__slots__
    )
    pupil = rendered.pupil.clone()
    for i, place in enumerate(rendered.labels.pupil_px.tolist()):
        canvas = _Canvas(light[i], cover[i], depth[i], pupil[i], place)
        for name, paint in PAINTERS.items():
            size, *draws = worn[name][i].tolist()
            if size:
                paint(canvas, size, np.array(draws))
    before, after = (mask.sum((1, 2)).double() for mask in (rendered.pupil, pupil))
    share = torch.where(before > 1e-6, after / before.clamp_min(1e-9), 1.0)
    visible = (rendered.labels.visible * share).clamp(max=1.0)
    labels = replace(rendered.labels, visible=visible)
    return RenderedFrames(Frames(light, cover, depth), pupil, labels)


@dataclass(frozen=True, eq=False, slots=True)
class _Canvas:
    """One frame, painted over in place.

    light, cover, depth: (2, y, x). pupil: (y, x). pupil_px: x, y of the pupil's centre.
    """

    light: Tensor
    cover: Tensor
    depth: Tensor
    pupil: Tensor
    pupil_px: list[float]

    @property
    def pixels(self) -> int:
        """Pixels along a side."""
        return int(self.light.shape[-1])

    @property
    def places(self) -> tuple[Tensor, Tensor]:
        """(1, x) and (y, 1) coordinates in frame widths from the centre."""
        line = (torch.arange(self.pixels) + 0.5) / self.pixels - 0.5
        return line[None], line[:, None]


def _apply_liner(canvas: _Canvas, opacity: float, draws: Array) -> None:
    """Darken skin within 1.5 to 4 % of the frame of the lid opening.

    On the side of the lower lid on every second frame one row alone.
    """
    reach = max(1, round((0.015 + 0.025 * draws[0]) * canvas.pixels))
    below = reach if draws[1] < 0.5 else 1
    padded = F.pad(canvas.cover[1][None, None], (0, 0, below, reach))
    margin = F.max_pool2d(padded, (reach + below + 1, 1), stride=1)[0, 0]
    canvas.light[0] *= 1 - opacity * margin


def _apply_lashes(canvas: _Canvas, opacity: float, draws: Array) -> None:
    """Darken both sheets by lashes before the eye."""
    canvas.light[:] *= 1 - opacity * draw_lashes(canvas.cover[1], draws)


def draw_lashes(opening: Tensor, draws: Array) -> Tensor:
    """(y, x) opacity in [0, 1] of lashes rooted on the margins of a lid opening.

    Upper lashes sink below their root, across the eye, and then rise, by the draws of
    the frame; they lean away from the centre of the opening. Lower lashes are half as
    long. Strokes are size / 200 pixels thick.

    Args:
        opening: (y, x) coverage of the opening.
        draws: (5 or more,) uniform draws in [0, 1) of the frame.
    """
    import cv2

    size = int(opening.shape[-1])
    canvas = np.zeros((size, size), np.uint8)
    rng = np.random.default_rng(int(draws[0] * 2**32))
    is_open = opening.numpy() > 0.5
    columns = np.flatnonzero(is_open.any(0))
    if len(columns) < 4:
        return torch.from_numpy(canvas).float()
    margins = is_open.argmax(0), size - 1 - is_open[::-1].argmax(0)
    length = (0.12 + 0.2 * draws[1]) * len(columns)
    sink = 0.8 * draws[2]
    rise = 1.4 * draws[3]
    for margin, direction, share in ((margins[0], -1.0, 1.0), (margins[1], 1.0, 0.5)):
        roots = rng.choice(columns, 20 + int(80 * draws[4]))
        lengths = share * length * rng.uniform(0.4, 1.2, len(roots))
        lean = lengths * (
            1.4 * (roots - columns.mean()) / len(columns)
            + 0.3 * rng.standard_normal(len(roots))
        )
        height = margin[roots][:, None] + direction * lengths[:, None] * (
            rise * ARC**2 - sink * ARC
        )
        points = np.stack([roots[:, None] + lean[:, None] * ARC, height], 2)
        strokes = np.round(points * 16).astype(np.int32)
        thick = max(1, size // 200)
        for k, shade in enumerate((110, 160, 210, 255)):
            some = list(strokes[k::4])
            cv2.polylines(canvas, some, False, shade, thick, cv2.LINE_AA, shift=4)
    return torch.from_numpy(canvas).float() / 255


def _add_glints(canvas: _Canvas, radiance: float, draws: Array) -> None:
    """Add one to four bright spots near the pupil to the far sheet.

    Profile 1 / (1 + (r / size)⁴), size 0.5 to 4 % of the frame, times the coverage.
    """
    x, y = canvas.places
    px, py = ((place + 0.5) / canvas.pixels - 0.5 for place in canvas.pupil_px)
    distance = 0.02 + 0.07 * draws[4]
    for k in range(1 + int(4 * draws[5])):
        angle = 6.283 * draws[3] + 1.7 * k
        size = 0.005 + 0.035 * ((draws[6] + 0.37 * k) % 1) ** 2
        dx = x - px - distance * np.cos(angle)
        dy = y - py - distance * np.sin(angle)
        spot = 1 / (1 + ((dx**2 + dy**2) / size**2) ** 2)
        canvas.light[1] += radiance * canvas.cover[1] * spot


def _apply_gradient(canvas: _Canvas, change: float, draws: Array) -> None:
    """Multiply both sheets by a linear gradient."""
    x, y = canvas.places
    angle = 6.283 * draws[7]
    ramp = x * np.cos(angle) + y * np.sin(angle)
    canvas.light[:] *= (1 + change * 2 * ramp).clamp_min(0.1)


def _apply_shade(canvas: _Canvas, loss: float, draws: Array) -> None:
    """Multiply both sheets by a shadow of sigmoid edge."""
    x, y = canvas.places
    angle = 6.283 * draws[8]
    edge = 0.02 + 0.1 * draws[9]
    distance = x * np.cos(angle) + y * np.sin(angle) - (draws[10] - 0.5) * 0.6
    canvas.light[:] *= 1 - loss * torch.sigmoid(distance / edge)


def _add_reflections(canvas: _Canvas, radiance: float, draws: Array) -> None:
    """Add one to three blurred rectangles 1 / (1 + (u / a)⁶ + (v / b)⁶), as spectacle
    glass reflects.
    """
    x, y = canvas.places
    lean = 0.6 * (draws[5] - 0.5)
    for k in range(1 + int(3 * draws[0])):
        centre_x = (draws[1] + 0.61 * k) % 1 - 0.5
        centre_y = (draws[2] + 0.43 * k) % 1 - 0.5
        half_x = 0.02 + 0.1 * ((draws[3] + 0.29 * k) % 1)
        half_y = 0.02 + 0.08 * ((draws[4] + 0.53 * k) % 1)
        u = (x - centre_x) + lean * (y - centre_y)
        v = (y - centre_y) - lean * (x - centre_x)
        window = 1 + (u / half_x) ** 6 + (v / half_y) ** 6
        canvas.light[:] += radiance * canvas.cover / window


def _add_rim(canvas: _Canvas, width: float, draws: Array) -> None:
    """Add an opaque rim of spectacles before the face: a band along a circular arc at
    0.7 of the eye's median depth (some 6 mm before the face), on the near sheet.
    """
    x, y = canvas.places
    radius = 0.45 + 0.5 * draws[6]
    angle = 6.283 * draws[7]
    middle = radius - 0.30 - 0.17 * draws[8]
    squeezed_y = (y + middle * np.sin(angle)) * (0.8 + 0.4 * draws[9])
    distance = torch.hypot(x + middle * np.cos(angle), squeezed_y) - radius
    band = torch.sigmoid((width / 2 - (distance - width / 2).abs()) * canvas.pixels * 2)
    shine = 0.02 + 0.5 * draws[10] ** 2 * (1 + 0.6 * torch.cos(distance / width * 6))
    light, cover, depth = canvas.light, canvas.cover, canvas.depth
    # the far sheet's depth is 0 behind skin, most of many frames
    eye_depths = depth[1][depth[1] > 0]
    rim_depth = (eye_depths if len(eye_depths) else depth[0]).median() * 0.7
    for hidden in (light, cover, canvas.pupil):
        hidden *= 1 - band
    light[0] += band * shine
    cover[0] += band
    depth[0] = torch.where(band > 0.5, rim_depth, depth[0])


def _apply_motion_blur(canvas: _Canvas, length: float, draws: Array) -> None:
    """Average light, coverage, depth and pupil mask along a line.

    The mean of the depth is weighted by the coverage.
    """
    kernel = line_kernel(length * canvas.pixels, 3.1416 * draws[11])
    weight = canvas.cover.clamp_min(1e-6)
    sheets = (canvas.light, canvas.cover, weight * canvas.depth, weight)
    planes = torch.cat([*sheets, canvas.pupil[None]])
    padded = F.pad(planes[:, None], (len(kernel) // 2,) * 4, mode="replicate")
    blurred = F.conv2d(padded, kernel[None, None])[:, 0]
    canvas.light[:], canvas.cover[:] = blurred[:2], blurred[2:4]
    canvas.depth[:] = blurred[4:6] / blurred[6:8]
    canvas.pupil[:] = blurred[8]


# by cause, in the order that they are painted
PAINTERS: Mapping[str, Callable[[_Canvas, float, Array], None]] = {
    "liner": _apply_liner,
    "overhang": _apply_lashes,
    "glints": _add_glints,
    "gradient": _apply_gradient,
    "shade": _apply_shade,
    "reflection": _add_reflections,
    "rim": _add_rim,
    "movement": _apply_motion_blur,
}


def line_kernel(length_px: float, angle_rad: float) -> Tensor:
    """(k, k) weights of sum 1 for uniform motion blur along a centred line.

    32 points of the line, each shared bilinearly between four pixels.

    Args:
        length_px: length of the motion in pixels, limited to the kernel's 15 taps.
        angle_rad: angle of the line to the x axis.
    """
    reach = min(int(np.ceil(length_px / 2)), 7)
    along = ((np.arange(32) + 0.5) / 32 - 0.5) * min(length_px, 2 * reach)
    cells = np.arange(-reach, reach + 1)
    columns, rows = (
        np.clip(1 - np.abs(cells - along[:, None] * part), 0, None)
        for part in (np.cos(angle_rad), np.sin(angle_rad))
    )
    kernel = rows.T @ columns
    return torch.from_numpy(kernel / kernel.sum()).float()
