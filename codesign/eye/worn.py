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
WHITE, BLACK = (
    0.99,
    1e-3,
)  # of a tone curve: share of the pixels below its white, and the least level of it
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
        parts = (
            {name: held[rows] for name, held in of.items()}
            for of in (self.size, self.draws)
        )
        return DrawnAugmentations(*parts)

    def from_one_view(self) -> "DrawnAugmentations":
        """The same before the stage's own camera: no cause of :data:`VIEWS`."""
        still = {n: 0 * v if n in VIEWS else v for n, v in self.size.items()}
        return DrawnAugmentations(still, self.draws)


def drawn_of_people(
    who: Array, variety: float, seed: tuple[int, ...]
) -> DrawnAugmentations:
    """What frames of some people have before the camera of one stage.

    One draw a person, but movement, which is drawn for every frame.

    Args:
        who: (n,) number of the person in each frame, from 0.
        variety: factor on the spread of looks; above 1 with augmentations.
        seed: of the random generator.
    """
    people = draw_augmentations(
        int(who.max()) + 1, variety, np.random.default_rng((*seed, 0))
    ).from_one_view()
    each = draw_augmentations(len(who), variety, np.random.default_rng((*seed, 1)))
    worn = people[who]
    size, draws = dict(worn.size), dict(worn.draws)
    size["movement"], draws["movement"] = each.size["movement"], each.draws["movement"]
    return DrawnAugmentations(size, draws)


def draw_augmentations(
    count: int, variety: float, generator: np.random.Generator
) -> DrawnAugmentations:
    """Causes of ``count`` frames; off everywhere up to variety 1. The same generator
    draws the same at any variety.
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
    """Frames of states with all that they have; bare ones where nothing is on.

    Args:
        worn: augmentations of every frame. rig: pose of camera and lamps.
        camera: pixel grid of the frames.
    """
    if not any(size.any() for size in worn.size.values()):
        return render(states, rig=rig, camera=camera)
    plain = render(
        augment_irises(states, worn),
        rig=rig,
        camera=camera,
        view=augmented_cameras(worn),
    )
    return apply_augmentations(plain, worn)


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
    """The states with the irises that some frames have.

    Args:
        worn: augmentations of every frame.
    """
    traits = states.traits.clone()
    size = torch.from_numpy(worn.size["iris"])
    traits[:, list(POPULATION).index("iris")] *= torch.where(size > 0, size, 1.0)
    return replace(states, traits=traits)


def apply_augmentations(
    made: RenderedFrames, worn: DrawnAugmentations
) -> RenderedFrames:
    """Rendered frames with what is worn but the causes of :func:`augmented_cameras` and
    :func:`augment_irises`: those came before.

    Light, coverage and depth of both sheets change, and the pupil's mask where
    something hides or moves it; of the
    labels the centroid and the visible share of the pupil follow.

    Args:
        made: rendered frames.
    """
    if not any(worn.size[name].any() for name in CAUSES if name not in BEFORE):
        return made
    light, cover, depth = (
        getattr(made.frames, name).clone() for name in Frames.__slots__
    )
    canvas = _Canvas(light, cover, depth, made.pupil.clone(), worn)
    _make_up(canvas)
    _darken(canvas)
    _add_glints(canvas, made.labels)
    _light_unevenly(canvas)
    _add_spectacles(canvas)
    _move(canvas)
    _record(canvas)
    return RenderedFrames(
        Frames(light, cover, depth),
        canvas.pupil,
        _labels(made.labels, made.pupil, canvas.pupil),
    )


@dataclass(frozen=True, eq=False, slots=True)
class _Canvas:
    """Frames that are painted over in place: light, cover, depth (n, 2, y, x), pupil
    (n, y, x), and what each of them has.
    """

    light: Tensor
    cover: Tensor
    depth: Tensor
    pupil: Tensor
    worn: DrawnAugmentations

    @property
    def pixels(self) -> int:
        """Along a side."""
        return int(self.light.shape[-1])

    @property
    def places(self) -> tuple[Tensor, Tensor]:
        """(1, x) and (y, 1) places in frame widths from the middle."""
        line = (torch.arange(self.pixels) + 0.5) / self.pixels - 0.5
        return line[None], line[:, None]

    def having(self, name: str) -> list[tuple[int, float, Array]]:
        """(frame, size, draws) of every frame that has a cause."""
        size, draws = self.worn.size[name], self.worn.draws[name]
        return [(int(i), float(size[i]), draws[i]) for i in np.flatnonzero(size)]


def _make_up(canvas: _Canvas) -> None:
    """Liner: skin within 1.5 to 4 % of the frame of the opening. Shadow: the skin
    above, up to 12 % of the frame.
    """
    pixels = canvas.pixels
    for i, opacity, draws in canvas.having("liner"):
        wide = max(1, round((0.015 + 0.025 * draws[0]) * pixels))
        near = _spread(canvas.cover[i, 1], up=wide, down=wide if draws[1] < 0.5 else 1)
        canvas.light[i, 0] *= 1 - opacity * near
    for i, opacity, draws in canvas.having("lid_shadow"):
        high = max(2, round((0.06 + 0.06 * draws[2]) * pixels))
        canvas.light[i, 0] *= 1 - opacity * _soft(
            _spread(canvas.cover[i, 1], up=high, down=0), high / 2
        )


def _darken(canvas: _Canvas) -> None:
    """A darker eye, light of the retina, dark places of the skin, lashes over both
    sheets; masks stay outlines.
    """
    for i, taken, _ in canvas.having("socket"):
        canvas.light[i, 1] *= 1 - taken
    for i, radiance, _ in canvas.having("retina"):
        canvas.light[i, 1] += radiance * canvas.pupil[i]
    for i, opacity, draws in canvas.having("patch"):
        canvas.light[i, 0] *= 1 - opacity * soft_patches(canvas.pixels, draws)
    for i, opacity, draws in canvas.having("overhang"):
        canvas.light[i] *= 1 - opacity * draw_lashes(canvas.cover[i, 1], draws)


def _spread(cover: Tensor, *, up: int, down: int) -> Tensor:
    """(y, x) largest coverage within ``up`` rows below each pixel and ``down`` rows
    above it.
    """
    padded = F.pad(cover[None, None], (0, 0, down, up))
    return F.max_pool2d(padded, (up + down + 1, 1), stride=1)[0, 0]


def _soft(picture: Tensor, width: float) -> Tensor:
    """(y, x) mean over a square of about this width."""
    reach = max(1, round(width / 2))
    padded = F.pad(picture[None, None], (reach,) * 4, mode="replicate")
    return F.avg_pool2d(padded, 2 * reach + 1, stride=1)[0, 0]


def _add_glints(canvas: _Canvas, labels: FrameLabels) -> None:
    """One to four spots about the pupil, 0.5 to 4 % of the frame across, on what is
    seen of the eye.
    """
    pixels, (x, y) = canvas.pixels, canvas.places
    for i, radiance, draws in canvas.having("glints"):
        px, py = ((labels.pupil_px[i] + 0.5) / pixels - 0.5).tolist()
        turn, apart = 6.283 * draws[3], 0.02 + 0.07 * draws[4]
        for k in range(1 + int(4 * draws[5])):
            at = turn + 1.7 * k
            size = 0.005 + 0.035 * ((draws[6] + 0.37 * k) % 1) ** 2
            dx = x - px - apart * np.cos(at)
            dy = y - py - apart * np.sin(at)
            canvas.light[i, 1] += (
                radiance * canvas.cover[i, 1] / (1 + ((dx**2 + dy**2) / size**2) ** 2)
            )


def _light_unevenly(canvas: _Canvas) -> None:
    """Uneven light and shadows: a factor on both sheets."""
    x, y = canvas.places
    for i, change, draws in canvas.having("gradient"):
        at = 6.283 * draws[7]
        canvas.light[i] *= (
            1 + change * 2 * (x * np.cos(at) + y * np.sin(at))
        ).clamp_min(0.1)
    for i, taken, draws in canvas.having("shade"):
        at, edge = 6.283 * draws[8], 0.02 + 0.1 * draws[9]
        away = x * np.cos(at) + y * np.sin(at) - (draws[10] - 0.5) * 0.6
        canvas.light[i] *= 1 - taken * torch.sigmoid(away / edge)


def _add_spectacles(canvas: _Canvas) -> None:
    """Mirrored windows on the glass, then the rim before all: an arc that hides what is
    behind it.
    """
    x, y = canvas.places
    for i, radiance, draws in canvas.having("reflection"):
        for k in range(1 + int(3 * draws[0])):
            at_x = (draws[1] + 0.61 * k) % 1 - 0.5
            at_y = (draws[2] + 0.43 * k) % 1 - 0.5
            half_x = 0.02 + 0.1 * ((draws[3] + 0.29 * k) % 1)
            half_y = 0.02 + 0.08 * ((draws[4] + 0.53 * k) % 1)
            lean = 0.6 * (draws[5] - 0.5)
            u = (x - at_x) + lean * (y - at_y)
            v = (y - at_y) - lean * (x - at_x)
            canvas.light[i] += (
                radiance * canvas.cover[i] / (1 + (u / half_x) ** 6 + (v / half_y) ** 6)
            )
    for i, width, draws in canvas.having("rim"):
        radius = 0.45 + 0.5 * draws[6]
        at = 6.283 * draws[7]
        gap = 0.30 + 0.17 * draws[8]
        middle_x = (radius - gap) * np.cos(at)
        middle_y = (radius - gap) * np.sin(at)
        away = (
            torch.hypot(x + middle_x, (y + middle_y) * (0.8 + 0.4 * draws[9])) - radius
        )
        band = torch.sigmoid((width / 2 - (away - width / 2).abs()) * canvas.pixels * 2)
        shine = 0.02 + 0.5 * draws[10] ** 2 * (1 + 0.6 * torch.cos(away / width * 6.0))
        eye = canvas.depth[i, 1][
            canvas.depth[i, 1] > 0
        ]  # 0 behind skin, which is most of many frames
        far = (eye if len(eye) else canvas.depth[i, 0]).median() * RIM_DEPTH
        _hide(canvas, i, band, band * shine, far)


def _hide(
    canvas: _Canvas, i: int, band: Tensor, shine: Tensor, depth_um: Tensor
) -> None:
    """Put something of coverage ``band`` before frame ``i``, on its near sheet."""
    canvas.light[i] *= 1 - band
    canvas.cover[i] *= 1 - band
    canvas.pupil[i] *= 1 - band
    canvas.light[i, 0] += shine
    canvas.cover[i, 0] += band
    canvas.depth[i, 0] = torch.where(band > 0.5, depth_um, canvas.depth[i, 0])


def _move(canvas: _Canvas) -> None:
    """Both sheets and the mask averaged along a line: what the pixels collect while the
    picture moves.
    """
    pixels = canvas.pixels
    for i, length, draws in canvas.having("movement"):
        kernel = line_kernel(length * pixels, 3.1416 * draws[11])
        kept = canvas.cover[i].clamp_min(1e-6)
        stack = torch.cat(
            [
                canvas.light[i],
                canvas.cover[i],
                kept * canvas.depth[i],
                kept,
                canvas.pupil[i][None],
            ]
        )
        reach = len(kernel) // 2
        padded = F.pad(stack[:, None], (reach,) * 4, mode="replicate")
        seen = F.conv2d(padded, kernel[None, None])[:, 0]
        canvas.light[i], canvas.cover[i], canvas.depth[i], canvas.pupil[i] = (
            seen[:2],
            seen[2:4],
            seen[4:6] / seen[6:8],
            seen[8],
        )


def _record(canvas: _Canvas) -> None:
    """As another camera gives it: stray light, darker corners, white from some level
    on, a curve from black to white.

    A factor on both sheets alike. Curves are of the light before the lens, where frames
    are dressed: blur and curve
    change places only at edges.
    """
    x, y = canvas.places
    for i, radiance, _ in canvas.having("veil"):
        canvas.light[i] += radiance * canvas.cover[i]
    for i, dark, _ in canvas.having("vignette"):
        canvas.light[i] *= 1 - dark * 2 * (x**2 + y**2)
    for i, share, _ in canvas.having("saturation"):
        level = canvas.light[i].sum(0)
        canvas.light[i] *= (
            torch.quantile(level, 1 - share) / level.clamp_min(1e-9)
        ).clamp(max=1.0)
    for i, log_gamma, _ in canvas.having("tone"):
        level = canvas.light[i].sum(0)
        white = torch.quantile(level, WHITE).clamp_min(1e-9)
        canvas.light[i] *= (level / white).clamp_min(BLACK) ** (np.exp(log_gamma) - 1)


def line_kernel(length_px: float, angle_rad: float) -> Tensor:
    """(k, k) weights, of sum 1, of a picture that moves evenly along a line of this
    length through the middle.

    Args:
        length_px: length of the motion in pixels.
        angle_rad: angle of the light to the axis, or of the line in the image.
    """
    reach = min(int(np.ceil(length_px / 2)), TAPS // 2)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for along in ((np.arange(32) + 0.5) / 32 - 0.5) * min(length_px, 2 * reach):
        x = along * np.cos(angle_rad) + reach
        y = along * np.sin(angle_rad) + reach
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


def _labels(labels: FrameLabels, before: Tensor, after: Tensor) -> FrameLabels:
    """Centroid and visible share of the pupil as its mask is now."""
    was, now = before.sum((1, 2)).double(), after.sum((1, 2)).double()
    share = torch.where(was > 1e-6, now / was.clamp_min(1e-9), torch.ones_like(was))
    place = torch.arange(after.shape[-1], dtype=torch.float64)
    sums = torch.stack([(after.sum(k).double() * place).sum(1) for k in (1, 2)], 1)
    centroid = torch.where(
        now[:, None] > 1e-6, sums / now.clamp_min(1e-9)[:, None], labels.pupil_px
    )
    return replace(
        labels, visible=(labels.visible * share).clamp(max=1.0), centroid_px=centroid
    )
