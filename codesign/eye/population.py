"""The eye and face as numbers: a documented population, subjects drawn from it, and
their states of gaze and slip.
"""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from codesign.eye.textures import KINDS, VARIANTS


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
TEXTURES = (
    "t_iris", "t_vein", "t_skin", "t_fine", "t_lash", "offset_x", "offset_y", "turn",
)  # fmt: skip


Record = TypeVar("Record")


def select_rows(record: Record, rows: Any) -> Record:
    """The same rows of every array of a record.

    Args:
        record: dataclass of arrays alone. rows: their numbers, a slice or a mask.
    """
    names = type(record).__slots__  # type: ignore[attr-defined]
    return type(record)(*(getattr(record, name)[rows] for name in names))


@dataclass(frozen=True, slots=True)
class CameraRig:
    """Camera and lamps on the glasses.

    distance_um: lens to pupil when nothing slipped. The paper's bench sits 2 cm below
    the eye at 45 degrees, whose axis meets the pupil at 28 mm, outside the 16-26 mm of
    its own simulation; we keep angle and depth range.
    elevation_rad: of the face's normal above the direction to the camera; the camera
    looks up.
    azimuth_rad: of the camera from the face's normal towards the temple.
    right_eye: the mirror image of a left eye.
    aim_um: (x, y) of the nominal pupil from the camera's axis, x towards the temple.
    sensor_distance_um: lens to sensor.
    lamps_um: positions of the flood LEDs in the camera's frame, x towards the temple.
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
    azimuth_rad: float = 0.0
    right_eye: bool = False

    @property
    def temple(self) -> float:
        """Direction of the temple along x: 1 for a left eye, -1 for a right eye."""
        return -1.0 if self.right_eye else 1.0

    @property
    def pupil_um(self) -> Tensor:
        """(3,) nominal position of the pupil in the camera's frame."""
        x, y = self.aim_um
        return torch.tensor([self.temple * x, y, self.distance_um], dtype=torch.float64)

    @property
    def face_axes(self) -> Tensor:
        """(3, 3) rows right, down and out of the face in the camera's frame."""
        s, c = math.sin(self.elevation_rad), math.cos(self.elevation_rad)
        azimuth = self.temple * self.azimuth_rad
        sa, ca = math.sin(azimuth), math.cos(azimuth)
        rows = [[ca, -sa * s, -sa * c], [0.0, c, -s], [-sa, -ca * s, -ca * c]]
        return torch.tensor(rows, dtype=torch.float64)


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

    def __len__(self) -> int:
        return len(self.traits)

    def __getitem__(self, rows: slice | Tensor) -> "EyeStates":
        return select_rows(self, rows)

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
) -> dict[str, Tensor]:
    """Renderer parameters by name, float64: (n,) numbers and (n, 3) vectors.

    Differentiable in gaze, torsion, slip and mount. The lids follow the vertical gaze
    by half the motion of the sclera. Exposure gain grows with the square of the face's
    depth.

    Args:
        states: subjects with gaze and slippage. rig: pose of camera and lamps.
        pixel_rad: angle of a pixel, which sets the softness of edges.
        exposed: states that the automatic exposure was set at; by default these,
            without following their derivatives.

    Returns:
        traits and textures of the states, and what
        :data:`codesign.eye.kernel.Parameters` needs in addition.
    """
    t = dict(zip(POPULATION, states.traits.unbind(1), strict=True))
    t |= dict(zip(TEXTURES, states.textures.unbind(1), strict=True))
    size = t["size"]
    cornea = t["cornea_radius_um"] * size
    limbus = t["limbus_radius_um"] * size
    sclera = t["sclera_radius_um"] * size
    limbus_plane, cornea_centre = _limbus_and_cornea_um(sclera, cornea, limbus)
    pupil_plane = cornea_centre + cornea - t["pupil_behind_um"] * size
    face = _face(rig, states)
    axis, across, down = _rotated_axes(face, rig, states)

    def centre_of(some: EyeStates) -> Tensor:
        nominal = _nominal_centre(rig, t["depth_um"], pupil_plane)
        return _turn(nominal, some.mount_rad) + some.slip_um

    centre = centre_of(states)
    lamps = torch.tensor(rig.lamps_um, dtype=torch.float64)
    lamps = lamps * torch.tensor([rig.temple, 1.0, 1.0], dtype=torch.float64)
    lid_shift = 0.5 * sclera * torch.sin(states.gaze_rad[:, 1].clamp(-1.2, 1.2))
    lower = t["fissure_lower_um"] * size + 0.9 * lid_shift
    upper = (
        states.aperture * (t["fissure_upper_um"] * size - lid_shift)
        - (1 - states.aperture) * lower
    )
    half_width = t["fissure_half_um"] * size
    # of the eye's front, for exposure and the softness of edges
    front = centre_of(states if exposed is None else exposed)[:, 2] - 0.7 * pupil_plane
    depth = front.detach().clamp_min(1000.0)
    brightness = (depth.clamp_min(3000.0) / 20e3) ** 2
    return t | {
        "centre": centre,
        "face_x": face[0],
        "face_y": face[1],
        "face_z": face[2],
        "axis": axis,
        "iris_x": across,
        "iris_y": down,
        "plane": centre + face[2] * (cornea_centre + cornea - t["plane_um"])[:, None],
        "lamp_a": lamps[0].expand(len(states), 3),
        "lamp_b": lamps[1].expand(len(states), 3),
        "lamp_c": lamps[2].expand(len(states), 3),
        "sclera_r": sclera,
        "cornea_r": cornea,
        "cornea_d": cornea_centre,
        "limbus_r": limbus,
        "limbus_d": limbus_plane,
        "pupil_r": t["pupil_radius_um"],
        "pupil_d": pupil_plane,
        "lid_r": sclera + t["lid_thickness_um"],
        # over which lid shell and face plane run into each other
        "blend": torch.full_like(size, 1600.0),
        "edge": 0.6 * pixel_rad * depth.clamp_min(2000.0) + 25.0,
        "upper": upper,
        "lower": lower,
        "skew": t["fissure_skew_um"] * size,
        "middle": t["fissure_middle_um"],
        "half": half_width,
        "crease": t["crease_um"],
        "ambient": t["ambient"] / brightness,
        "gain": t["exposure"] * brightness / 1.6,
        "turn_x": torch.cos(t["turn"]),
        "turn_y": torch.sin(t["turn"]),
        "caruncle": t["fissure_middle_um"] - 0.93 * half_width,
    }


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
    axis, across, down = _rotated_axes(_face(rig, states), rig, states)
    tan_x = torch.tan(states.trait("kappa_x_rad"))
    tan_y = torch.tan(states.trait("kappa_y_rad"))
    # towards the nose, and up
    visual = axis - tan_x[:, None] * across - tan_y[:, None] * down
    return axis, visual / visual.norm(dim=1, keepdim=True)


def _face(rig: CameraRig, states: EyeStates) -> tuple[Tensor, Tensor, Tensor]:
    """(n, 3) axes of the face, to the temple, down and out, in the camera's frame,
    after the mount.
    """
    right, down, out = (
        _turn(row.expand(len(states), 3), states.mount_rad) for row in rig.face_axes
    )
    return rig.temple * right, down, out


def _nominal_centre(rig: CameraRig, depth_um: Tensor, behind_um: Tensor) -> Tensor:
    """(n, 3) rotation centre of each eye without slip or mounting turn, um.

    ``behind_um``: distance of the pupil before the centre.
    """
    along = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return (
        rig.pupil_um + depth_um[:, None] * along - behind_um[:, None] * rig.face_axes[2]
    )


def _rotated_axes(
    face: tuple[Tensor, Tensor, Tensor], rig: CameraRig, states: EyeStates
) -> tuple[Tensor, Tensor, Tensor]:
    """Optic axis, iris x (to the temple) and iris y axis, (n, 3) each, of eyes at a
    gaze and torsion.

    Rodrigues rotation by the gaze angle about an axis in the face plane (Listing's
    law), then torsion about the optic axis. Smooth up to a rotation of pi: no gimbal
    lock.

    Args:
        face: axes of the face to the temple, down and out.
    """
    temple, down, out = face
    gx, gy = rig.temple * states.gaze_rad[:, :1], states.gaze_rad[:, 1:]
    angle = torch.sqrt(gx**2 + gy**2 + 1e-24)
    sinc = torch.sin(angle) / angle
    versine = 2 * (torch.sin(angle / 2) / angle) ** 2
    gaze = gx * temple + gy * down
    axis = torch.cos(angle) * out + sinc * gaze
    across = temple - gx * (versine * gaze + sinc * out)
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


def states_at(
    indices: Tensor, seed: int, *, motion: MotionRanges | None = None
) -> EyeStates:
    """States of given numbers from the endless sequence of a seed.

    State i is the same alone or together with others.

    Args:
        indices: (n,) numbers of the states. seed: of the sequence.
        motion: ranges of the states; the defaults without it.
    """
    parts = [draw_states(1, (seed, int(i)), motion=motion) for i in indices]
    return EyeStates(
        *(
            torch.cat([getattr(part, name) for part in parts])
            for name in EyeStates.__slots__
        )
    )


def moved_states(
    states: EyeStates, motions: Sequence[tuple[str, int, float]]
) -> list[EyeStates]:
    """The states, then the same moved along every motion: the differences of their
    frames, rendered at one exposure, are those of the Fisher matrix (paper Sec. 3.6).

    Args:
        states: subjects with gaze and slippage.
        motions: (field of the state, axis, step in rad or um) each.
    """
    out = [states]
    for name, axis, step in motions:
        values = getattr(states, name).clone()
        values[:, axis] += step
        out.append(replace(states, **{name: values}))
    return out
