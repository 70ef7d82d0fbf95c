"""What real frames have and the model of the eye has not: spectacles, make-up, uneven
light, movement, other cameras.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from codesign.eye.hair import draw_lashes, soft_patches
from codesign.eye.population import POPULATION, CameraRig, EyeStates
from codesign.eye.renderer import FrameLabels, PinholeCamera, RenderedFrames, render
from codesign.eye.view import CameraView
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


CAUSES: Mapping[str, FrameAugmentation] = {
    "tilt": FrameAugmentation(
        0.7,
        -30.0,
        50.0,
        "deg",
        "the camera sees the face from below or above its usual place",
    ),
    "liner": FrameAugmentation(
        0.25,
        0.3,
        0.9,
        "opacity",
        "dark line along the lids' margins: liner, mascara, dense lashes",
    ),
    "lid_shadow": FrameAugmentation(
        0.25, 0.15, 0.6, "opacity", "darkened upper lid: eye shadow, a deep socket"
    ),
    "rim": FrameAugmentation(
        0.2, 0.03, 0.10, "frame widths", "band of a spectacle frame before the face"
    ),
    "reflection": FrameAugmentation(
        0.25, 0.15, 0.8, "radiance", "windows and lamps mirrored in spectacle glass"
    ),
    "glints": FrameAugmentation(
        0.4, 0.4, 1.2, "radiance", "mirror images of lamps on the cornea and the tears"
    ),
    "gradient": FrameAugmentation(
        0.6,
        0.1,
        0.7,
        "of the mean light",
        "light that falls off from one side to the other",
    ),
    "shade": FrameAugmentation(
        0.25,
        0.2,
        0.7,
        "of the light",
        "shadow with a soft edge, of brow, nose or frame",
    ),
    "movement": FrameAugmentation(
        0.3,
        0.008,
        0.04,
        "frame widths",
        "the eye or the camera moves during the exposure",
    ),
    "vignette": FrameAugmentation(
        0.4,
        0.1,
        0.8,
        "of the light",
        "another camera's corners are darker than its middle",
    ),
    "saturation": FrameAugmentation(
        0.25,
        0.01,
        0.15,
        "of the pixels",
        "the brightest part of the frame is at the camera's white",
    ),
    "tone": FrameAugmentation(
        0.5,
        -0.6,
        0.6,
        "logarithm of gamma",
        "another camera's curve: dark parts lifted or crushed",
    ),
    "side": FrameAugmentation(
        0.6, -40.0, 40.0, "deg", "the camera sees the face from its left or right"
    ),
    "roll": FrameAugmentation(
        0.5, -25.0, 25.0, "deg", "the camera is turned about its axis"
    ),
    "wide": FrameAugmentation(
        0.7,
        1.1,
        2.2,
        "times the field",
        "a wider field: the whole opening of the lids, lashes and brow",
    ),
    "iris": FrameAugmentation(
        0.35,
        0.08,
        0.5,
        "of the albedo",
        "irises little brighter than the pupil, as some are beyond 900 nm",
    ),
    "overhang": FrameAugmentation(
        0.5,
        0.5,
        1.0,
        "opacity",
        "dark lashes from the lids' margins, across the eye and its lids",
    ),
    "socket": FrameAugmentation(
        0.3,
        0.2,
        0.75,
        "of the light",
        "the eye lies darker than the skin: deep sockets, lamps from the side",
    ),
    "patch": FrameAugmentation(
        0.4,
        0.4,
        0.95,
        "opacity",
        "dark places of the skin: brow, hair, nostril, socket",
    ),
    "retina": FrameAugmentation(
        0.2,
        0.02,
        0.25,
        "radiance",
        "light from the retina, of lamps near the camera's axis",
    ),
    "veil": FrameAugmentation(
        0.4,
        0.02,
        0.2,
        "radiance",
        "stray light and black level: dark parts lifted by as much everywhere",
    ),
}
VIEWS = ("tilt", "side", "roll", "wide")  # of the view that frames are rendered from
BEFORE = (*VIEWS, "iris")  # what frames are rendered with; all else is put on them
RIM_DEPTH = 0.7  # of the pupil's depth: some 6 mm before the face
# of a tone curve: fraction of the pixels below white, and the least relative level
WHITE, BLACK = 0.99, 1e-3
TAPS = 15  # of the kernel of a movement, at most its length


@dataclass(frozen=True, eq=False, slots=True)
class DrawnAugmentations:
    """What each of n frames has: ``size`` by cause, 0 where it is off.

    draws: by cause, (n, 12) independent draws in [0, 1) that place it.
    """

    size: Mapping[str, Array]
    draws: Mapping[str, Array]

    def __getitem__(self, rows: Array | slice) -> "DrawnAugmentations":
        """Those of some frames."""
        size, draws = (
            {name: values[rows] for name, values in record.items()}
            for record in (self.size, self.draws)
        )
        return DrawnAugmentations(size, draws)

    def from_one_view(self) -> "DrawnAugmentations":
        """Copy for the stage's own camera: sizes of the causes in :data:`VIEWS` set
        to 0.
        """
        size = {n: 0 * v if n in VIEWS else v for n, v in self.size.items()}
        return DrawnAugmentations(size, self.draws)


def drawn_of_people(
    who: Array, variety: float, seed: tuple[int, ...]
) -> DrawnAugmentations:
    """Augmentations of frames of some people, before the fixed camera of one stage.

    One draw a person, except movement, which is drawn for every frame.

    Args:
        who: (n,) number of the person in each frame, from 0.
        variety: factor on the spread of looks; above 1 with augmentations.
        seed: of the random generator.
    """
    people = draw_augmentations(
        int(who.max()) + 1, variety, np.random.default_rng((*seed, 0))
    ).from_one_view()
    per_frame = draw_augmentations(len(who), variety, np.random.default_rng((*seed, 1)))
    per_person = people[who]
    size, draws = dict(per_person.size), dict(per_person.draws)
    size["movement"], draws["movement"] = (
        per_frame.size["movement"],
        per_frame.draws["movement"],
    )
    return DrawnAugmentations(size, draws)


def draw_augmentations(
    count: int, variety: float, generator: np.random.Generator
) -> DrawnAugmentations:
    """Augmentations of ``count`` frames, drawn independently by cause.

    A cause is on with probability share * (variety - 1), limited to [0, 1]; none is on
    up to variety 1. A ``generator`` of one seed draws the same sizes at any variety.
    """
    size, draws = {}, {}
    for name, cause in CAUSES.items():
        on = generator.random(count) < min(cause.share * max(variety - 1.0, 0.0), 1.0)
        size[name] = np.where(on, generator.uniform(cause.low, cause.high, count), 0.0)
        draws[name] = generator.random((count, 12))
    return DrawnAugmentations(size, draws)


def render_dressed(
    states: EyeStates,
    worn: DrawnAugmentations,
    *,
    rig: CameraRig,
    camera: PinholeCamera,
) -> RenderedFrames:
    """Rendered frames of states with their augmentations; plain frames where none is
    on.

    View and iris are set before rendering, all others painted on the frames.

    Args:
        worn: augmentations of every frame. rig: pose of camera and lamps.
        camera: pixel grid of the frames.
    """
    if not any(size.any() for size in worn.size.values()):
        return render(states, rig=rig, camera=camera)
    rendered = render(
        augment_irises(states, worn),
        rig=rig,
        camera=camera,
        view=augmented_cameras(worn),
    )
    return apply_augmentations(rendered, worn)


def augmented_cameras(worn: DrawnAugmentations) -> CameraView:
    """The cameras that the frames are rendered from.

    Args:
        worn: augmentations of every frame.
    """
    tilt, side, roll, wide = (torch.from_numpy(worn.size[name]) for name in VIEWS)
    return CameraView(
        torch.deg2rad(tilt),
        torch.deg2rad(side),
        torch.deg2rad(roll),
        torch.where(wide > 0, wide, 1.0),
    )


def augment_irises(states: EyeStates, worn: DrawnAugmentations) -> EyeStates:
    """States with the iris albedo multiplied by the size of cause "iris", where it is
    on.

    Args:
        states: of the frames. worn: augmentations of every frame.
    """
    traits = states.traits.clone()
    factor = torch.from_numpy(worn.size["iris"])
    traits[:, list(POPULATION).index("iris")] *= torch.where(factor > 0, factor, 1.0)
    return replace(states, traits=traits)


def apply_augmentations(
    rendered: RenderedFrames, worn: DrawnAugmentations
) -> RenderedFrames:
    """Rendered frames with all causes that are painted on them.

    Those are all but :data:`BEFORE`, which :func:`augmented_cameras` and
    :func:`augment_irises` apply. Light, coverage and depth of both sheets change, and
    the pupil's mask where something covers or moves it. Of the labels the centroid and
    the visible share of the pupil follow.

    Args:
        rendered: rendered frames. worn: augmentations of every frame.
    """
    if not any(worn.size[name].any() for name in CAUSES if name not in BEFORE):
        return rendered
    light, cover, depth = (
        getattr(rendered.frames, name).clone() for name in Frames.__slots__
    )
    canvas = _Canvas(light, cover, depth, rendered.pupil.clone(), worn)
    _apply_make_up(canvas)
    _darken(canvas)
    _add_glints(canvas, rendered.labels)
    _apply_uneven_light(canvas)
    _add_spectacles(canvas)
    _apply_motion_blur(canvas)
    _apply_camera_response(canvas)
    return RenderedFrames(
        Frames(light, cover, depth),
        canvas.pupil,
        _updated_labels(rendered.labels, rendered.pupil, canvas.pupil),
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Canvas:
    """Frames that are painted over in place, and the augmentations of each.

    light, cover, depth: (n, 2, y, x). pupil: (n, y, x).
    """

    light: Tensor
    cover: Tensor
    depth: Tensor
    pupil: Tensor
    worn: DrawnAugmentations

    @property
    def pixels(self) -> int:
        """Pixels along a side."""
        return int(self.light.shape[-1])

    @property
    def places(self) -> tuple[Tensor, Tensor]:
        """(1, x) and (y, 1) coordinates in frame widths from the centre."""
        line = (torch.arange(self.pixels) + 0.5) / self.pixels - 0.5
        return line[None], line[:, None]

    def having(self, name: str) -> list[tuple[int, float, Array]]:
        """(frame number, size, draws) of every frame that has the cause ``name``."""
        size, draws = self.worn.size[name], self.worn.draws[name]
        return [(int(i), float(size[i]), draws[i]) for i in np.flatnonzero(size)]


def _apply_make_up(canvas: _Canvas) -> None:
    """Darken skin near the lid opening in place: liner and lid shadow.

    Liner: within 1.5 to 4 % of the frame of the opening. Shadow: the skin above, up to
    12 % of the frame.
    """
    pixels = canvas.pixels
    for i, opacity, draws in canvas.having("liner"):
        reach = max(1, round((0.015 + 0.025 * draws[0]) * pixels))
        margin = _vertical_dilation(
            canvas.cover[i, 1], up=reach, down=reach if draws[1] < 0.5 else 1
        )
        canvas.light[i, 0] *= 1 - opacity * margin
    for i, opacity, draws in canvas.having("lid_shadow"):
        reach_up = max(2, round((0.06 + 0.06 * draws[2]) * pixels))
        canvas.light[i, 0] *= 1 - opacity * _box_blur(
            _vertical_dilation(canvas.cover[i, 1], up=reach_up, down=0), reach_up / 2
        )


def _darken(canvas: _Canvas) -> None:
    """Darken eyes, skin patches and lashes in place, and add the light of the retina.

    Coverage and pupil mask do not change.
    """
    for i, loss, _ in canvas.having("socket"):
        canvas.light[i, 1] *= 1 - loss
    for i, radiance, _ in canvas.having("retina"):
        canvas.light[i, 1] += radiance * canvas.pupil[i]
    for i, opacity, draws in canvas.having("patch"):
        canvas.light[i, 0] *= 1 - opacity * soft_patches(canvas.pixels, draws)
    for i, opacity, draws in canvas.having("overhang"):
        canvas.light[i] *= 1 - opacity * draw_lashes(canvas.cover[i, 1], draws)


def _vertical_dilation(cover: Tensor, *, up: int, down: int) -> Tensor:
    """(y, x) largest coverage within ``up`` rows below each pixel and ``down`` rows
    above it.
    """
    padded = F.pad(cover[None, None], (0, 0, down, up))
    return F.max_pool2d(padded, (up + down + 1, 1), stride=1)[0, 0]


def _box_blur(picture: Tensor, width: float) -> Tensor:
    """(y, x) mean over a square of about ``width`` pixels, edges replicated."""
    radius = max(1, round(width / 2))
    padded = F.pad(picture[None, None], (radius,) * 4, mode="replicate")
    return F.avg_pool2d(padded, 2 * radius + 1, stride=1)[0, 0]


def _add_glints(canvas: _Canvas, labels: FrameLabels) -> None:
    """Add one to four bright spots near the pupil to the far sheet, in place.

    Profile 1 / (1 + (r / size)⁴), size 0.5 to 4 % of the frame, times the coverage.
    """
    x, y = canvas.places
    for i, radiance, draws in canvas.having("glints"):
        px, py = ((labels.pupil_px[i] + 0.5) / canvas.pixels - 0.5).tolist()
        first_angle = 6.283 * draws[3]
        distance = 0.02 + 0.07 * draws[4]
        for k in range(1 + int(4 * draws[5])):
            angle = first_angle + 1.7 * k
            size = 0.005 + 0.035 * ((draws[6] + 0.37 * k) % 1) ** 2
            dx = x - px - distance * np.cos(angle)
            dy = y - py - distance * np.sin(angle)
            canvas.light[i, 1] += (
                radiance * canvas.cover[i, 1] / (1 + ((dx**2 + dy**2) / size**2) ** 2)
            )


def _apply_uneven_light(canvas: _Canvas) -> None:
    """Multiply both sheets by a linear gradient, and by a shadow of sigmoid edge, in
    place.
    """
    x, y = canvas.places
    for i, change, draws in canvas.having("gradient"):
        angle = 6.283 * draws[7]
        ramp = x * np.cos(angle) + y * np.sin(angle)
        canvas.light[i] *= (1 + change * 2 * ramp).clamp_min(0.1)
    for i, loss, draws in canvas.having("shade"):
        angle = 6.283 * draws[8]
        edge = 0.02 + 0.1 * draws[9]
        distance = x * np.cos(angle) + y * np.sin(angle) - (draws[10] - 0.5) * 0.6
        canvas.light[i] *= 1 - loss * torch.sigmoid(distance / edge)


def _add_spectacles(canvas: _Canvas) -> None:
    """Add reflections on spectacle glass, then an opaque rim before the face, in place.

    Reflections: one to three blurred rectangles 1 / (1 + (u / a)⁶ + (v / b)⁶). Rim: a
    band along a circular arc at RIM_DEPTH of the median depth.
    """
    x, y = canvas.places
    for i, radiance, draws in canvas.having("reflection"):
        for k in range(1 + int(3 * draws[0])):
            centre_x = (draws[1] + 0.61 * k) % 1 - 0.5
            centre_y = (draws[2] + 0.43 * k) % 1 - 0.5
            half_x = 0.02 + 0.1 * ((draws[3] + 0.29 * k) % 1)
            half_y = 0.02 + 0.08 * ((draws[4] + 0.53 * k) % 1)
            lean = 0.6 * (draws[5] - 0.5)
            u = (x - centre_x) + lean * (y - centre_y)
            v = (y - centre_y) - lean * (x - centre_x)
            canvas.light[i] += (
                radiance * canvas.cover[i] / (1 + (u / half_x) ** 6 + (v / half_y) ** 6)
            )
    for i, width, draws in canvas.having("rim"):
        radius = 0.45 + 0.5 * draws[6]
        angle = 6.283 * draws[7]
        gap = 0.30 + 0.17 * draws[8]
        middle_x = (radius - gap) * np.cos(angle)
        middle_y = (radius - gap) * np.sin(angle)
        distance = (
            torch.hypot(x + middle_x, (y + middle_y) * (0.8 + 0.4 * draws[9])) - radius
        )
        band = torch.sigmoid(
            (width / 2 - (distance - width / 2).abs()) * canvas.pixels * 2
        )
        shine = 0.02 + 0.5 * draws[10] ** 2 * (
            1 + 0.6 * torch.cos(distance / width * 6.0)
        )
        # the far sheet's depth is 0 behind skin, most of many frames
        eye_depths = canvas.depth[i, 1][canvas.depth[i, 1] > 0]
        rim_depth = (
            eye_depths if len(eye_depths) else canvas.depth[i, 0]
        ).median() * RIM_DEPTH
        _cover(canvas, i, band, band * shine, rim_depth)


def _cover(
    canvas: _Canvas, i: int, coverage: Tensor, shine: Tensor, depth_um: Tensor
) -> None:
    """Put an object of (y, x) ``coverage`` before frame ``i``, on its near sheet, in
    place.

    shine: (y, x) its light. depth_um: its depth.
    """
    canvas.light[i] *= 1 - coverage
    canvas.cover[i] *= 1 - coverage
    canvas.pupil[i] *= 1 - coverage
    canvas.light[i, 0] += shine
    canvas.cover[i, 0] += coverage
    canvas.depth[i, 0] = torch.where(coverage > 0.5, depth_um, canvas.depth[i, 0])


def _apply_motion_blur(canvas: _Canvas) -> None:
    """Average light, coverage, depth and pupil mask along a line, in place.

    The mean of the depth is weighted by the coverage.
    """
    for i, length, draws in canvas.having("movement"):
        kernel = line_kernel(length * canvas.pixels, 3.1416 * draws[11])
        weight = canvas.cover[i].clamp_min(1e-6)
        planes = torch.cat(
            [
                canvas.light[i],
                canvas.cover[i],
                weight * canvas.depth[i],
                weight,
                canvas.pupil[i][None],
            ]
        )
        reach = len(kernel) // 2
        padded = F.pad(planes[:, None], (reach,) * 4, mode="replicate")
        blurred = F.conv2d(padded, kernel[None, None])[:, 0]
        canvas.light[i] = blurred[:2]
        canvas.cover[i] = blurred[2:4]
        canvas.depth[i] = blurred[4:6] / blurred[6:8]
        canvas.pupil[i] = blurred[8]


def _apply_camera_response(canvas: _Canvas) -> None:
    """Stray light, vignetting, saturation and tone curve of another camera, in place.

    A factor on both sheets. Curves act on the light before the lens, where frames are
    augmented: exchanging blur and curve matters only at edges.
    """
    x, y = canvas.places
    for i, radiance, _ in canvas.having("veil"):
        canvas.light[i] += radiance * canvas.cover[i]
    for i, dark, _ in canvas.having("vignette"):
        canvas.light[i] *= 1 - dark * 2 * (x**2 + y**2)
    for i, share, _ in canvas.having("saturation"):
        level = canvas.light[i].sum(0)
        white = torch.quantile(level, 1 - share)
        canvas.light[i] *= (white / level.clamp_min(1e-9)).clamp(max=1.0)
    for i, log_gamma, _ in canvas.having("tone"):
        level = canvas.light[i].sum(0)
        white = torch.quantile(level, WHITE).clamp_min(1e-9)
        canvas.light[i] *= (level / white).clamp_min(BLACK) ** (np.exp(log_gamma) - 1)


def line_kernel(length_px: float, angle_rad: float) -> Tensor:
    """(k, k) weights of sum 1 for uniform motion blur along a centred line.

    Args:
        length_px: length of the motion in pixels, limited to the kernel's TAPS.
        angle_rad: angle of the line to the x axis.
    """
    reach = min(int(np.ceil(length_px / 2)), TAPS // 2)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    # 32 points of the line, each shared bilinearly between four pixels
    for position in ((np.arange(32) + 0.5) / 32 - 0.5) * min(length_px, 2 * reach):
        x = position * np.cos(angle_rad) + reach
        y = position * np.sin(angle_rad) + reach
        column, row = (min(int(v), 2 * reach - 1) if reach else 0 for v in (x, y))
        s, t = (x - column, y - row) if reach else (0.0, 0.0)
        for dy, dx, weight in (
            (0, 0, (1 - s) * (1 - t)),
            (0, 1, s * (1 - t)),
            (1, 0, (1 - s) * t),
            (1, 1, s * t),
        ):
            if weight > 0:
                kernel[row + dy, column + dx] += weight
    return torch.from_numpy(kernel / kernel.sum()).float()


def _updated_labels(labels: FrameLabels, before: Tensor, after: Tensor) -> FrameLabels:
    """Labels with centroid and visible share of the pupil recomputed for its new mask.

    before, after: (n, y, x) masks. An empty mask has the centroid ``pupil_px``.
    """
    area_before, area_after = before.sum((1, 2)).double(), after.sum((1, 2)).double()
    share = torch.where(
        area_before > 1e-6,
        area_after / area_before.clamp_min(1e-9),
        torch.ones_like(area_before),
    )
    index = torch.arange(after.shape[-1], dtype=torch.float64)
    sums = torch.stack([(after.sum(k).double() * index).sum(1) for k in (1, 2)], 1)
    centroid = torch.where(
        area_after[:, None] > 1e-6,
        sums / area_after.clamp_min(1e-9)[:, None],
        labels.pupil_px,
    )
    return replace(
        labels, visible=(labels.visible * share).clamp(max=1.0), centroid_px=centroid
    )
