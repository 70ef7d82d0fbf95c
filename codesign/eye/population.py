"""The eye and face as numbers: a documented population, subjects drawn from it, and
their states of gaze and slip.
"""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources

import numpy as np
import torch
from torch import Tensor

from codesign.eye import model
from codesign.eye.textures import KINDS, VARIANTS
from metalens.core.errors import SceneError


@dataclass(frozen=True, slots=True)
class SubjectTrait:
    """A number of a subject: normal with this mean and deviation, cut at the limits."""

    mean: float
    sd: float
    low: float
    high: float
    source: str = ""


_DATA = resources.files("codesign").joinpath("data", "population.toml")
POPULATION: Mapping[str, SubjectTrait] = {
    name: SubjectTrait(**row)
    for name, row in tomllib.loads(_DATA.read_text("utf-8")).items()
}
TEXTURES = ("iris", "vein", "skin", "fine", "lash", "offset_x", "offset_y", "turn")


@dataclass(frozen=True, slots=True)
class CameraRig:
    """Camera and lamps on the glasses.

    distance_um: lens to pupil when nothing slipped. The paper's bench sits 2 cm below
    the eye at 45 degrees, whose
        axis meets the pupil at 28 mm, outside the 16-26 mm of its own simulation; we
        keep angle and depth range.
    elevation_rad: of the face's normal above the direction to the camera; the camera
    looks up.
    aim_um: (x, y) of the nominal pupil beside the camera's axis.
    sensor_distance_um: lens to sensor.
    lamps_um: positions of the flood LEDs in the camera's frame.
    """

    distance_um: float = 21_000.0
    elevation_rad: float = math.radians(45.0)
    aim_um: tuple[float, float] = (2400.0, -300.0)
    sensor_distance_um: float = 2000.0
    lamps_um: tuple[tuple[float, float, float], ...] = (
        (9e3, -5e3, 0.0),
        (-9e3, -5e3, 0.0),
        (0.0, -12e3, 3e3),
    )

    def __post_init__(self) -> None:
        if not (
            self.distance_um > 0
            and math.isfinite(self.distance_um)
            and abs(self.elevation_rad) < 1.4
        ):
            raise SceneError(
                f"rig at {self.distance_um} um, {self.elevation_rad} rad: need a distance above 0 and |angle| < 1.4"
            )
        if len(self.lamps_um) != model.LED_COUNT:
            raise SceneError(f"{len(self.lamps_um)} lamps, need {model.LED_COUNT}")


def face_axes(elevation_rad: float) -> Tensor:
    """(3, 3) rows right, down and out of the face in the frame of a camera below it.

    Args:
        elevation_rad: of the face's normal above the camera's direction.
    """
    s, c = math.sin(elevation_rad), math.cos(elevation_rad)
    return torch.tensor(
        [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, -s, -c]], dtype=torch.float64
    )


@dataclass(frozen=True, eq=False, slots=True)
class EyeStates:
    """Subjects and what their eyes and glasses do: gaze (phi, theta), torsion omega,
    slip t (paper Sec. 3.6).

    traits: (n, len(POPULATION)) in its order. textures: (n, len(TEXTURES)).
    gaze_rad: (n, 2) turn of the optic axis from straight ahead, to +x and to +y (down);
    its length is the angle.
    torsion_rad: (n,) beyond Listing's law, which gives 0.
    slip_um: (n, 3) displacement of the head in the camera's frame, +z away from the
    lens.
    mount_rad: (n, 2) small turns of the camera about its x and y axes.
    aperture: (n,) opening of the lids, 1 relaxed, 0 closed.
    scale: (n,) factor of every depth and label at an unchanged pinhole image (scale
    ambiguity).
    """

    traits: Tensor
    textures: Tensor
    gaze_rad: Tensor
    torsion_rad: Tensor
    slip_um: Tensor
    mount_rad: Tensor
    aperture: Tensor
    scale: Tensor

    def __post_init__(self) -> None:
        n = len(self.traits)
        shapes = {
            "traits": (n, len(POPULATION)),
            "textures": (n, len(TEXTURES)),
            "gaze_rad": (n, 2),
            "torsion_rad": (n,),
        }
        shapes |= {
            "slip_um": (n, 3),
            "mount_rad": (n, 2),
            "aperture": (n,),
            "scale": (n,),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            if tuple(value.shape) != shape:
                raise SceneError(f"{name} has shape {tuple(value.shape)}, need {shape}")
            if not bool(torch.isfinite(value).all()):
                row = int(torch.nonzero(~torch.isfinite(value))[0, 0])
                raise SceneError(f"{name} of state {row} is not finite")

    def __len__(self) -> int:
        return len(self.traits)

    def __getitem__(self, rows: slice | Tensor) -> "EyeStates":
        return EyeStates(*(getattr(self, name)[rows] for name in self.__slots__))

    def trait(self, name: str) -> Tensor:
        """(n,) values of one trait.

        Args:
            name: of the trait.
        """
        return self.traits[:, list(POPULATION).index(name)]


@dataclass(frozen=True, slots=True)
class MotionRanges:
    """Ranges that states are drawn from, uniform within +- each value.

    slip_um: along the camera's x, y and z. tilt: of the small mounting turns.
    """

    gaze_x_rad: float = math.radians(18.0)
    gaze_y_rad: float = math.radians(13.0)
    torsion_rad: float = math.radians(
        1.0
    )  # thickness of Listing's plane: Straumann et al. 1996
    slip_um: tuple[float, float, float] = (2000.0, 1500.0, 3500.0)
    mount_rad: float = math.radians(1.0)
    aperture: tuple[float, float] = (0.75, 1.1)
    scale: float = 0.0
    population: Mapping[str, SubjectTrait] = field(default_factory=lambda: POPULATION)


def draw_states(
    count: int, seed: int | tuple[int, ...], *, motion: MotionRanges | None = None
) -> EyeStates:
    """Random subjects in random states; the same seed gives the same states.

    Traits are normal, clipped to their limits; gaze, torsion, slip, mount and lid
    aperture are uniform in their ranges. ``motion.scale`` s > 0 draws the scale factor
    of each state uniformly in 1 +- s.

    Args:
        count: number of states. seed: of the random generator.
        motion: ranges of the states; the defaults without it.
    """
    rng = np.random.default_rng(seed)
    motion = motion or MotionRanges()
    columns = []
    for trait in motion.population.values():
        value = trait.mean + trait.sd * rng.standard_normal(count)
        columns.append(np.clip(value, trait.low, trait.high))
    pictures = [
        kind * VARIANTS + rng.integers(0, VARIANTS, count) for kind in range(len(KINDS))
    ]
    offsets = [
        rng.uniform(0, 256, count),
        rng.uniform(0, 256, count),
        rng.uniform(-math.pi, math.pi, count),
    ]
    gaze = rng.uniform(-1, 1, (count, 2)) * [motion.gaze_x_rad, motion.gaze_y_rad]
    values = (
        np.stack(columns, 1),
        np.stack([*pictures, *offsets], 1),
        gaze,
        rng.uniform(-1, 1, count) * motion.torsion_rad,
        rng.uniform(-1, 1, (count, 3)) * motion.slip_um,
        rng.uniform(-1, 1, (count, 2)) * motion.mount_rad,
        rng.uniform(*motion.aperture, count),
        1 + rng.uniform(-1, 1, count) * motion.scale,
    )
    return EyeStates(*(torch.from_numpy(np.asarray(value, float)) for value in values))


def model_parameters(
    states: EyeStates,
    rig: CameraRig,
    *,
    pixel_rad: float,
    exposed: EyeStates | None = None,
) -> Tensor:
    """(n, COUNT) renderer parameters of :mod:`codesign.eye.model`, float64.

    Differentiable in gaze, torsion, slip and mount. The lids follow the vertical gaze
    by half the motion of the sclera. Exposure gain grows with the square of the face's
    depth.

    Args:
        states: subjects with gaze and slippage. rig: pose of camera and lamps.
        pixel_rad: angle of a pixel, which sets the softness of edges.
        exposed: states that the automatic exposure was set at; by default these,
            without following their derivatives.
    """
    t = dict(zip(POPULATION, states.traits.unbind(1), strict=True))
    size = t["size"]
    cornea = t["cornea_radius_um"] * size
    limbus = t["limbus_radius_um"] * size
    sclera = t["sclera_radius_um"] * size
    limbus_plane, cornea_centre = _limbus_and_cornea_um(sclera, cornea, limbus)
    pupil_plane = cornea_centre + cornea - t["pupil_behind_um"] * size
    face = _face(rig, states)
    axis, across, down = _rotated_axes(face, states)
    centre = (
        _turn(_nominal_centre(rig, t["depth_um"], pupil_plane), states.mount_rad)
        + states.slip_um
    )
    plane = centre + face[2] * (cornea_centre + cornea - t["plane_um"])[:, None]
    lamps = (
        torch.tensor(rig.lamps_um, dtype=torch.float64)
        .flatten()
        .expand(len(states), -1)
    )
    lid_shift = 0.5 * sclera * torch.sin(states.gaze_rad[:, 1].clamp(-1.2, 1.2))
    lower = t["fissure_lower_um"] * size + 0.9 * lid_shift
    upper = (
        states.aperture * (t["fissure_upper_um"] * size - lid_shift)
        - (1 - states.aperture) * lower
    )
    half_width = t["fissure_half_um"] * size
    exposed_states = states if exposed is None else exposed
    depth = _exposure_depth(rig, t["depth_um"], pupil_plane, exposed_states)
    gain = t["exposure"] * (depth.clamp_min(3000.0) / 20e3) ** 2 / 1.6
    edge = 0.6 * pixel_rad * depth.clamp_min(2000.0) + 25.0
    parameters = {
        model.CENTRE: centre, model.FACE_X: face[0], model.FACE_Y: face[1], model.FACE_Z: face[2], model.AXIS: axis,
        model.IRIS_X: across, model.IRIS_Y: down, model.PLANE: plane, model.LED: lamps,
        model.SCLERA_R: sclera, model.CORNEA_R: cornea, model.CORNEA_D: cornea_centre, model.LIMBUS_R: limbus,
        model.LIMBUS_D: limbus_plane, model.PUPIL_D: pupil_plane, model.LID_R: sclera + t["lid_thickness_um"],
        model.EDGE: edge, model.UPPER: upper, model.LOWER: lower, model.SKEW: t["fissure_skew_um"] * size,
        model.HALF: half_width, model.GAIN: gain, model.AMBIENT: t["ambient"] / (depth.clamp_min(3000.0) / 20e3) ** 2,
        model.CARUNCLE: t["fissure_middle_um"] - 0.93 * half_width,
    }  # fmt: skip
    return _row(parameters | _copied_traits(t) | _texture_parameters(states.textures))


BLEND_UM = 1600.0  # over which lid shell and face plane run into each other
AS_THEY_ARE = {  # traits that are renderer parameters unchanged
    model.PUPIL_R: "pupil_radius_um", model.INDEX: "index", model.MIDDLE: "fissure_middle_um",
    model.CREASE: "crease_um", model.IRIS: "iris", model.IRIS_CONTRAST: "iris_contrast",
    model.SCLERA: "sclera", model.VEINS: "veins", model.SKIN: "skin",
    model.PORES: "pores", model.LASHES: "lashes", model.PUPIL: "pupil", model.GLINT: "glint",
    model.BROW: "brow",
}  # fmt: skip
PICTURES = {
    model.T_IRIS: "iris", model.T_VEIN: "vein", model.T_SKIN: "skin", model.T_FINE: "fine", model.T_LASH: "lash",
    model.OFFSET_X: "offset_x", model.OFFSET_Y: "offset_y",
}  # fmt: skip


def _copied_traits(traits: Mapping[str, Tensor]) -> dict[int, Tensor]:
    """Renderer parameters by index that are traits unchanged, and the blend of the
    face.
    """
    return {model.BLEND: torch.full_like(traits["size"], BLEND_UM)} | {
        index: traits[name] for index, name in AS_THEY_ARE.items()
    }


def _texture_parameters(textures: Tensor) -> dict[int, Tensor]:
    """Renderer parameters by index of texture numbers, offsets and iris rotation."""
    columns = dict(zip(TEXTURES, textures.unbind(1), strict=True))
    turn = {
        model.TURN_X: torch.cos(columns["turn"]),
        model.TURN_Y: torch.sin(columns["turn"]),
    }
    return turn | {index: columns[name] for index, name in PICTURES.items()}


def _row(places: Mapping[int, Tensor]) -> Tensor:
    """(n, COUNT) parameters of frames from their values by first column index.

    Each value is (n,) or (n, columns).

    Raises:
        SceneError: an index is left out, or filled twice.
    """
    columns = []
    filled = 0
    for place in sorted(places):
        if place != filled:
            raise SceneError(
                f"parameter {filled} of a frame is {'left out' if place > filled else 'filled twice'}"
            )
        values = places[place]
        columns.append(values if values.ndim == 2 else values[:, None])
        filled += columns[-1].shape[1]
    if filled != model.COUNT:
        raise SceneError(
            f"a frame has {filled} parameters, the picture reads {model.COUNT}"
        )
    return torch.cat(columns, 1)


def mean_eye_um(rig: CameraRig) -> tuple[tuple[float, float, float], float]:
    """Rotation centre (x, y, z) of the population's mean eye, and its distance to the
    pupil.

    Both in um, in the camera's frame.

    Args:
        rig: pose of camera and lamps.
    """
    mean = {
        name: torch.tensor([trait.mean], dtype=torch.float64)
        for name, trait in POPULATION.items()
    }
    _, cornea_centre = _limbus_and_cornea_um(
        *(mean[f"{name}_radius_um"] for name in ("sclera", "cornea", "limbus"))
    )
    radius = cornea_centre + mean["cornea_radius_um"] - mean["pupil_behind_um"]
    x, y, z = _nominal_centre(rig, mean["depth_um"], radius)[0].tolist()
    return (x, y, z), float(radius)


def _limbus_and_cornea_um(
    sclera: Tensor, cornea: Tensor, limbus: Tensor
) -> tuple[Tensor, Tensor]:
    """(n,) distances from the sclera's centre to the limbus plane and the cornea's
    centre.

    In um along the optic axis. The limbus circle lies on both spheres:
    z_limbus = sqrt(sclera² - limbus²), z_cornea = z_limbus - sqrt(cornea² - limbus²).
    """
    ring = torch.sqrt((sclera**2 - limbus**2).clamp_min(1e6))
    return ring, ring - torch.sqrt((cornea**2 - limbus**2).clamp_min(1e6))


def eye_axes(states: EyeStates, rig: CameraRig) -> tuple[Tensor, Tensor]:
    """(n, 3) optic axis and (n, 3) visual axis in the camera's frame, unit vectors.

    The visual axis is the optic axis tilted by the angles kappa, nasal and upwards.

    Args:
        states: subjects with gaze and slippage. rig: pose of camera and lamps.
    """
    axis, across, down = _rotated_axes(_face(rig, states), states)
    tan_x = torch.tan(states.trait("kappa_x_rad"))
    tan_y = torch.tan(states.trait("kappa_y_rad"))
    visual = (
        axis - tan_x[:, None] * across - tan_y[:, None] * down
    )  # nose to -x, up to -y
    return axis, visual / visual.norm(dim=1, keepdim=True)


def _face(rig: CameraRig, states: EyeStates) -> tuple[Tensor, Tensor, Tensor]:
    """(n, 3) axes right, down and out of the face in the camera's frame, after the
    mount.
    """
    right, down, out = (
        _turn(row.expand(len(states), 3), states.mount_rad)
        for row in face_axes(rig.elevation_rad)
    )
    return right, down, out


def _nominal_centre(rig: CameraRig, depth_um: Tensor, behind_um: Tensor) -> Tensor:
    """(n, 3) rotation centre of each eye without slip or mounting turn, um.

    ``behind_um``: distance of the pupil before the centre.
    """
    out = face_axes(rig.elevation_rad)[2]
    aim = torch.tensor([*rig.aim_um, rig.distance_um], dtype=torch.float64)
    along = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return aim + depth_um[:, None] * along - behind_um[:, None] * out


def _exposure_depth(
    rig: CameraRig, depth_um: Tensor, behind_um: Tensor, states: EyeStates
) -> Tensor:
    """(n,) depth in um of the eye's front for exposure and edge width, without
    gradient.
    """
    centre = (
        _turn(_nominal_centre(rig, depth_um, behind_um), states.mount_rad)
        + states.slip_um
    )
    return (centre[:, 2] - 0.7 * behind_um).detach().clamp_min(1000.0)


def _rotated_axes(
    face: tuple[Tensor, Tensor, Tensor], states: EyeStates
) -> tuple[Tensor, Tensor, Tensor]:
    """Optic axis, iris x and iris y axis, (n, 3) each, of eyes at a gaze and torsion.

    Rodrigues rotation by the gaze angle about an axis in the face plane (Listing's
    law), then torsion about the optic axis. Smooth up to a rotation of pi: no gimbal
    lock.

    Args:
        face: right, down and out axes of the face.
    """
    right, down, out = face
    gx, gy = states.gaze_rad[:, :1], states.gaze_rad[:, 1:]
    angle = torch.sqrt(gx**2 + gy**2 + 1e-24)
    sinc = torch.sin(angle) / angle
    versine = 2 * (torch.sin(angle / 2) / angle) ** 2
    gaze = gx * right + gy * down
    axis = torch.cos(angle) * out + sinc * gaze
    across = right - gx * (versine * gaze + sinc * out)
    lower = down - gy * (versine * gaze + sinc * out)
    c = torch.cos(states.torsion_rad)[:, None]
    s = torch.sin(states.torsion_rad)[:, None]
    return axis, c * across + s * lower, c * lower - s * across


def _turn(vector: Tensor, mount_rad: Tensor) -> Tensor:
    """(n, 3) vectors in the frame of a camera rotated about x, then about y.

    Args:
        vector: (n, 3). mount_rad: (n, 2) angles.
    """
    cx, sx = torch.cos(mount_rad[:, 0]), torch.sin(mount_rad[:, 0])
    cy, sy = torch.cos(mount_rad[:, 1]), torch.sin(mount_rad[:, 1])
    x, y, z = vector.unbind(1)
    y, z = cx * y + sx * z, cx * z - sx * y
    x, z = cy * x - sy * z, cy * z + sy * x
    return torch.stack([x, y, z], 1)
