"""Eyes as training and test frames: drawn from a seed and a number, with a margin,
depth not readable from size.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from codesign.batches.surface_frames import EyePose, FrameBatch
from codesign.eye import (
    POPULATION,
    CameraRig,
    EyeStates,
    MotionRanges,
    PinholeCamera,
    RenderedFrames,
    SubjectTrait,
    draw_augmentations,
    render_dressed,
)
from codesign.eye import population as eye
from codesign.settings import LARGEST, check_ranges

# Streams of the random generator. Training, the search's selection, the calibration of
# intervals and the test each have frames that no other one uses.
TRAINING, VALIDATION, TEST, CALIBRATION, EXPERIMENT = 0, 1, 2, 3, 9
ALBEDOS = ("iris", "sclera", "skin", "pupil", "exposure")
LOOKS = (
    *ALBEDOS, "iris_contrast", "veins", "pores", "lashes", "brow", "glint", "ambient", "fissure_upper_um",
    "fissure_lower_um", "pupil_radius_um",
)  # fmt: skip
LEAST = {
    "iris": 0.05,
    "pupil_radius_um": 700.0,
}  # 0 elsewhere: nobody could see the pupil of a black iris
MOST = {name: 0.95 for name in ALBEDOS} | {"pupil_radius_um": 4300.0}


@dataclass(frozen=True, slots=True)
class SceneConfig:
    """What the camera sees.

    pixels: of the image grid along a side, ``sample_um`` of the optics apart. margin:
    samples rendered beyond it.
    scale: spread of the scale ambiguity: depths and labels are multiplied by a factor
    of 1 +- scale at an unchanged
        pinhole image, so that size does not tell depth; see
        :func:`draw_depth_scales`.
    slip_mm: largest slippage along x, y, z. gaze_deg: largest gaze to the side and up
    or down.
    depth_sd_mm: spread of the pupil's depth between people at zero slippage; no image
    tells it from slippage.
    variety: factor on how far looks spread about the population's mean: albedos and
    texture of iris, sclera and skin,
        lashes, brow, pupil and its size, glints, ambient light, exposure, opening of
        the lids. 1 is the population as
        published, bare; from there to 2 and more come spectacles with reflections,
        make-up, uneven light, shadows
        and movement (:mod:`codesign.eye.appearance`): for faces and lamps that nobody
        modelled.
    elevation_deg: of the camera below the gaze straight ahead. azimuth_deg: of the
    camera towards the temple. eye_distance_mm: lens to pupil without slippage.
    right_eye: the mirror image of the left eye before the same camera.
    blinks: share of the frames whose lids are closed.
    pool: frames that training draws from again and again, at another scale each time; 0
    renders every frame anew.
    """

    pixels: int = 128
    margin: int = 16
    scale: float = 0.2
    slip_mm: tuple[float, float, float] = (2.0, 1.5, 3.5)
    gaze_deg: tuple[float, float] = (18.0, 13.0)
    depth_sd_mm: float = 0.0
    variety: float = 1.0
    pool: int = 0
    elevation_deg: float = 45.0
    azimuth_deg: float = 0.0
    eye_distance_mm: float = 21.0
    right_eye: bool = False
    blinks: float = field(default=0.0, metadata={"most": 1.0})

    def __post_init__(self) -> None:
        check_ranges(
            self,
            pixels=(32, LARGEST),
            margin=(0, self.pixels - 1),
            scale=(0, 0.49),
            elevation_deg=(-80, 80),
            azimuth_deg=(-80, 80),
            slip_mm=(0, self.eye_distance_mm),
            gaze_deg=(0, 59.9),  # as eyes turn
            pool=(0, LARGEST),
            depth_sd_mm=(0, LARGEST),
            variety=(0, 4),
        )

    @property
    def pupil_depths_um(self) -> tuple[float, float]:
        """Least and largest depth of the pupils before the lens, um.

        Largest slippage, and two standard deviations between people.
        """
        reach = self.slip_mm[2] * 1e3 + 2e3 * self.depth_sd_mm
        distance = self.eye_distance_mm * 1e3
        return distance - reach, distance + reach

    @property
    def motion(self) -> MotionRanges:
        """The ranges that states are drawn from, at unit scale."""
        depth = replace(POPULATION["depth_um"], sd=self.depth_sd_mm * 1e3)
        wide = widen_motion(self.variety)
        x_mm, y_mm, z_mm = self.slip_mm
        return replace(
            wide,
            population={**wide.population, "depth_um": depth},
            gaze_x_rad=math.radians(self.gaze_deg[0]),
            gaze_y_rad=math.radians(self.gaze_deg[1]),
            slip_um=(1e3 * x_mm, 1e3 * y_mm, 1e3 * z_mm),
        )


@dataclass(frozen=True, eq=False, slots=True)
class EyeScenes:
    """Frames by number; see :class:`codesign.batches.SceneSource`.

    seed, stream: choose the subjects and states.
    """

    settings: SceneConfig
    sample_um: float
    sensor_distance_um: float
    seed: int
    stream: int = TRAINING

    @property
    def margin(self) -> int:
        """Samples around the frame that are rendered to be blurred in."""
        return self.settings.margin

    @property
    def rig(self) -> CameraRig:
        """Camera and lamps."""
        return CameraRig(
            self.settings.eye_distance_mm * 1e3,
            math.radians(self.settings.elevation_deg),
            sensor_distance_um=self.sensor_distance_um,
            azimuth_rad=math.radians(self.settings.azimuth_deg),
            right_eye=self.settings.right_eye,
        )

    @property
    def depths_um(self) -> tuple[float, float]:
        """Least and largest depth of the pupil."""
        reach = self.settings.slip_mm[2] * 1e3
        return self.rig.distance_um - reach, self.rig.distance_um + reach

    @property
    def camera(self) -> PinholeCamera:
        """Image grid with its margin."""
        return PinholeCamera(self.settings.pixels + 2 * self.margin, self.sample_um)

    def states(self, step: int, size: int) -> EyeStates:
        """Subjects and states of a step, with scales that decouple depth from size.

        Args:
            step: its number. size: frames of a step.
        """
        plain = eye.draw_states(
            size, (self.seed, self.stream, step), motion=self.settings.motion
        )
        depth = self.rig.distance_um + plain.slip_um[:, 2]
        generator = np.random.default_rng((self.seed, self.stream, step, 1))
        scale = draw_depth_scales(depth, self.depths_um, self.settings.scale, generator)
        is_open = torch.from_numpy(generator.random(size) >= self.settings.blinks)
        return replace(plain, scale=scale, aperture=plain.aperture * is_open)

    def rendered(self, step: int, size: int) -> RenderedFrames:
        """Frames of a step with all labels and the augmentations of the scenes'
        variety.

        Args:
            step: its number. size: frames of a step.
        """
        seed = (self.seed, self.stream, step, 3)
        return augmented_frames(
            self.states(step, size), self.rig, self.camera, self.settings.variety, seed
        )

    def batch(self, step: int, size: int) -> FrameBatch:
        """Frames of a step, as training takes them.

        Args:
            size: frames of a step.
        """
        return as_batch(self.rendered(step, size), self.margin)


def augmented_frames(
    states: EyeStates,
    rig: CameraRig,
    camera: PinholeCamera,
    variety: float,
    seed: tuple[int, ...],
) -> RenderedFrames:
    """Rendered frames with random augmentations of :mod:`codesign.eye.appearance`.

    Without any up to variety 1.

    Args:
        states: subjects with gaze and slippage. rig: pose of camera and lamps.
        camera: pixel grid of the frames. variety: factor on the spread of looks.
        seed: of the random generator.
    """
    augmentations = draw_augmentations(
        len(states), variety, np.random.default_rng(seed)
    )
    return render_dressed(states, augmentations, rig=rig, camera=camera)


def widen_motion(variety: float) -> MotionRanges:
    """The default ranges with the spread of looks and lid aperture multiplied by a
    factor.

    Args:
        variety: factor on the spread of looks; above 1 with augmentations.
    """
    default = MotionRanges()
    aperture = max(1 - (1 - default.aperture[0]) * variety, 0.1), default.aperture[1]
    return replace(
        default, population={**POPULATION, **widen_traits(variety)}, aperture=aperture
    )


def widen_traits(variety: float) -> dict[str, SubjectTrait]:
    """Traits of :data:`LOOKS` with deviation and limits multiplied by a factor.

    Limits are scaled about the mean, and kept between :data:`LEAST` and :data:`MOST`.

    Args:
        variety: factor on the spread of looks; above 1 with augmentations.
    """
    traits = {}
    for name in LOOKS:
        trait = POPULATION[name]
        high = min(
            trait.mean + (trait.high - trait.mean) * variety, MOST.get(name, math.inf)
        )
        traits[name] = replace(
            trait,
            sd=trait.sd * variety,
            low=max(
                trait.mean - (trait.mean - trait.low) * variety, LEAST.get(name, 0.0)
            ),
            high=high,
        )
    return traits


def draw_depth_scales(
    depth_um: Tensor,
    range_um: tuple[float, float],
    spread: float,
    generator: np.random.Generator,
) -> Tensor:
    """(n,) scale factors that bring depths to random targets, uniform over
    ``range_um``.

    The target does not depend on the depth, so the scaled depth is independent of
    apparent size, as far as a factor of 1 +- ``spread`` reaches. A random factor alone
    would leave most of that cue.

    Args:
        depth_um: (n,) depth before the lens. range_um: least and largest target.
        spread: of the factors. generator: of the draws.
    """
    target_um = torch.from_numpy(generator.uniform(*range_um, len(depth_um)))
    return (target_um / depth_um).clamp(1 - spread, 1 + spread)


def as_batch(rendered: RenderedFrames, margin: int) -> FrameBatch:
    """Rendered frames as a training batch: mask without margin, slippage in mm, pose.

    Args:
        rendered: rendered frames. margin: samples around the frame.
    """
    inside = slice(margin, rendered.pupil.shape[-1] - margin)
    return FrameBatch(
        rendered.frames,
        rendered.pupil[:, inside, inside],
        (rendered.labels.slip_um * 1e-3).float(),
        pose_of(rendered, margin),
    )


def pose_of(rendered: RenderedFrames, margin: int) -> EyePose:
    """Pose labels of rendered frames: shift in mm, optic axis, landmarks and pupil
    centre.

    Points are fractions of the frame without margin, from its centre.

    Args:
        rendered: rendered frames.
        margin: samples around the frame that are imaged and then cut off.
    """
    pixels = rendered.pupil.shape[-1]
    labels = rendered.labels
    points_px = torch.cat([labels.landmarks_px, labels.pupil_px[:, None]], 1)
    points = (points_px - (pixels - 1) / 2) / (pixels - 2 * margin)
    return EyePose(
        (labels.shift_um * 1e-3).float(), labels.optic_axis.float(), points.float()
    )
