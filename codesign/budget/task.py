"""What an error of the optics costs in gaze: the linearised estimator of gaze, slip and
size that sees whole images.

An image I of an eye in state theta, formed by optics that differ a little from those
the estimator knows, is read as
the state theta + (D'WD + P)^-1 D'W dI: D the derivative of the known image, W the
inverse noise variance, P the prior.
Unknown are also the size (all depths and labels scaled at an unchanged pinhole image,
paper Sec. 3.6), the brightness,
and every trait of the subject within its population, so that depth is read from blur
and not from a known anatomy. What
the model of a subject cannot describe counts as noise in proportion to the light
(``mismatch``).
"""

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from codesign.eye import (
    POPULATION,
    CameraRig,
    EyeStates,
    MotionRanges,
    PinholeCamera,
    render,
)
from codesign.eye import population as eye
from metalens.image import Frames, Imager, PsfBasis, Sensor, scene, sensor

MOTIONS = ("gaze_x", "gaze_y", "slip_x", "slip_y", "slip_z", "scale")
STEPS = (
    math.radians(0.02),
    math.radians(0.02),
    5.0,
    5.0,
    5.0,
    1e-3,
)  # rad, um, 1: half the central difference
PRIOR = (
    0.18,
    0.13,
    1200.0,
    900.0,
    2000.0,
    0.12,
)  # standard deviations before the image is seen
TRAITS = tuple(
    n for n, trait in POPULATION.items() if trait.sd > 0 and n != "depth_um"
)  # a depth is a slip along z
TRAIT_STEP = 0.005  # of a trait's standard deviation
# rays along a side of a pixel: edges of the eye move smoothly, as they do on a sensor
FINE = 3
NAMES = (*MOTIONS, *TRAITS, "brightness")
BRIGHTNESS = 0.3  # standard deviation before the image is seen
SCENES = 77  # stream of the random generator


@dataclass(frozen=True, slots=True)
class TaskSetting:
    """What the estimator looks at.

    scenes: eyes, from ``seed``. pixels: along a side, of ``pitch_um``; margin: rendered
    beyond them.
    sensor: noise and exposure; its own pitch is replaced by ``pitch_um``.
    mismatch: share of the light of a pixel by which no subject of the population looks
    like the one that is seen.
    sensor_distance_um: of the lens, behind films the reduced one.
    pitch_um: of the sensor's pixels. seed: of the eyes.
    """

    scenes: int = field(default=6, metadata={"above": 0})
    pixels: int = field(default=64, metadata={"above": 0})
    margin: int = 8
    pitch_um: float = field(default=18.0, metadata={"above": 0})
    seed: int = 0
    sensor: Sensor = field(default_factory=Sensor)
    mismatch: float = 0.03
    sensor_distance_um: float = field(default=2000.0, metadata={"above": 0})

    @property
    def rig(self) -> CameraRig:
        """Camera and lamps."""
        return CameraRig(sensor_distance_um=self.sensor_distance_um)

    @property
    def size(self) -> int:
        """Pixels along a side with the margin."""
        return self.pixels + 2 * self.margin

    @property
    def states(self) -> EyeStates:
        """The eyes: subjects, gazes and slips drawn from the seed."""
        return eye.draw_states(
            self.scenes, (self.seed, SCENES), motion=MotionRanges(scale=0.2)
        )


@dataclass(frozen=True, eq=False, slots=True)
class RenderedViews:
    """Renderings of every eye: as it is, and moved to both sides along every unknown
    but the brightness.
    """

    anchor: Frames
    moved: tuple[tuple[Frames, Frames], ...]

    @property
    def depths_um(self) -> tuple[float, float]:
        """Nearest and farthest surface that is seen."""
        seen = self.anchor.depth_um[self.anchor.coverage > 0]
        return max(float(seen.min()), 5e3), max(float(seen.max()), 6e3)


def render_views(
    setting: TaskSetting,
    states: EyeStates | None = None,
    *,
    exposed: EyeStates | None = None,
) -> RenderedViews:
    """Render everything that the linear estimator needs; two frames an unknown and eye.

    Args:
        states: instead of those of the setting. exposed: that the exposure was set at,
            by default these.
    """
    still = setting.states if states is None else states
    lit = still if exposed is None else exposed

    def frames(unknown: int, step: float) -> Frames:
        return _frames(shift_states(still, unknown, step), lit, setting)

    pairs = [
        (frames(k, step), frames(k, -step)) for k, step in enumerate(view_derivatives())
    ]
    return RenderedViews(_frames(still, lit, setting), tuple(pairs))


def _frames(states: EyeStates, exposed: EyeStates, setting: TaskSetting) -> Frames:
    """Renderings averaged over each pixel."""
    camera = PinholeCamera(FINE * setting.size, setting.pitch_um / FINE)
    return pixels_of(
        render(states, rig=setting.rig, camera=camera, exposed=exposed).frames
    )


def pixels_of(fine: Frames) -> Frames:
    """Means over FINE x FINE rays; a depth is that of what covers the pixel, or of
    nothing where nothing does.
    """
    radiance, coverage, deep, plain = (
        avg_pool2d(v, FINE)
        for v in (
            fine.radiance,
            fine.coverage,
            fine.coverage * fine.depth_um,
            fine.depth_um,
        )
    )
    return Frames(
        radiance,
        coverage,
        torch.where(coverage > 0, deep / coverage.clamp_min(1e-9), plain),
    )


def view_derivatives() -> tuple[float, ...]:
    """Half the central difference of every unknown but the brightness."""
    return (*STEPS, *(TRAIT_STEP * POPULATION[name].sd for name in TRAITS))


def unknown_priors() -> tuple[float, ...]:
    """Standard deviations of all unknowns before the image is seen."""
    return (*PRIOR, *(POPULATION[name].sd for name in TRAITS), BRIGHTNESS)


def prior_information() -> Tensor:
    """(unknowns, unknowns) information before the image is seen."""
    return torch.diag(1 / torch.tensor(unknown_priors(), dtype=torch.float64) ** 2)


def shift_states(states: EyeStates, unknown: int, amount: float | Tensor) -> EyeStates:
    """States moved along one of :data:`NAMES` but the last."""
    if unknown < 2:
        gaze = states.gaze_rad.clone()
        gaze[:, unknown] += amount
        return replace(states, gaze_rad=gaze)
    if unknown < 5:
        slip = states.slip_um.clone()
        slip[:, unknown - 2] += amount
        return replace(states, slip_um=slip)
    if unknown == 5:
        return replace(states, scale=states.scale + amount)
    traits = states.traits.clone()
    traits[:, list(POPULATION).index(NAMES[unknown])] += amount
    return replace(states, traits=traits)


def expected_electrons(
    frames: Frames, optics: PsfBasis | Imager, setting: TaskSetting
) -> Tensor:
    """(scenes, pixels) expected electrons through these optics, float64: one PSF a
    depth, or the true image.
    """
    if isinstance(optics, PsfBasis):
        prepared = scene.uniform_imager(
            optics, (setting.size, setting.size), margin=setting.margin
        )
        light = scene.image(frames, prepared, margin=setting.margin)
    else:
        light = optics(frames)
    chip = replace(setting.sensor, pitch_um=setting.pitch_um)
    return (
        sensor.mean_electrons(light, setting.pitch_um, sensor=chip).flatten(1).double()
    )


@dataclass(frozen=True, eq=False, slots=True)
class LinearEstimator:
    """The estimator about each eye.

    image: (scenes, pixels) electrons that it expects. pull: (scenes, unknowns, pixels)
    change of its answer by a
    change of the image, unknowns in the order of NAMES. covariance: (scenes, unknowns,
    unknowns) of its answer under
    the noise of one frame.
    """

    image: Tensor
    pull: Tensor
    covariance: Tensor

    def shift(self, image: Tensor) -> Tensor:
        """(scenes, unknowns) error of the answer to images (scenes, pixels) of the same
        eyes by other optics.
        """
        return torch.einsum("skp,sp->sk", self.pull, image - self.image)

    @property
    def noise_rad(self) -> float:
        """Gaze error (rms over eyes, both angles) that the noise of one frame leaves."""
        return float(
            self.covariance[:, :2, :2].diagonal(dim1=1, dim2=2).sum(1).mean().sqrt()
        )


def linear_estimator(
    seen: RenderedViews, optics: PsfBasis | Imager, setting: TaskSetting
) -> LinearEstimator:
    """The estimator that knows these optics."""
    image = expected_electrons(seen.anchor, optics, setting)
    slopes = [
        (
            expected_electrons(more, optics, setting)
            - expected_electrons(less, optics, setting)
        )
        / (2 * step)
        for (more, less), step in zip(seen.moved, view_derivatives(), strict=True)
    ]
    return estimator_of_slopes(image, torch.stack(slopes, 1), setting)


def estimator_of_slopes(
    image: Tensor, slopes: Tensor, setting: TaskSetting
) -> LinearEstimator:
    """The estimator of eyes whose images (scenes, pixels) move by slopes (scenes,
    unknowns but brightness, pixels).
    """
    derivative = torch.cat([slopes, image[:, None]], 1)
    chip = replace(setting.sensor, pitch_um=setting.pitch_um)
    noise = sensor.variance(image, sensor=chip) + (setting.mismatch * image) ** 2
    weighted = derivative / noise[:, None]
    prior = prior_information()
    normal = weighted @ derivative.mT + prior
    unit = normal.diagonal(
        dim1=1, dim2=2
    ).rsqrt()  # the unknowns differ by powers of ten in size
    inverse = (
        torch.linalg.inv(normal * unit[:, :, None] * unit[:, None, :])
        * unit[:, :, None]
        * unit[:, None, :]
    )
    return LinearEstimator(image, inverse @ weighted, inverse)


def gaze_rms(shift: Tensor) -> float:
    """Root mean square over eyes (and draws) of the gaze error, rad, from shifts (...,
    unknowns).
    """
    return float(shift[..., :2].pow(2).sum(-1).mean().sqrt())


def gaze_mean(shift: Tensor) -> float:
    """Mean over eyes (and draws) of the gaze error, rad, from shifts (..., unknowns)."""
    return float(shift[..., :2].pow(2).sum(-1).sqrt().mean())
