"""A state of the eye as shapes for Mitsuba 3: what the renderer finds along rays, as
surfaces in space (mm).
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.eye import CameraRig, PinholeCamera
from metalens.core.arrays import Array
from tests.codesign.eye import model, plain_eye

LAMP_RADIUS_MM = (
    2.0  # of the emitting spheres, large enough to be met by chance through the cornea
)


def build(
    mitsuba: Any, p: Tensor, bank: Tensor, *, rig: CameraRig, camera: PinholeCamera
) -> dict[str, Any]:
    """The scene of parameters ``p`` (COUNT,) as Mitsuba's dictionary; the camera at the
    origin.

    ``bank``: textures in the dtype of ``p``.
    """
    transform = mitsuba.ScalarTransform4f
    half = math.degrees(
        math.atan(camera.pixels * camera.pitch_um / 2 / rig.sensor_distance_um)
    )
    centre = p[model.CENTRE : model.CENTRE + 3]
    axis = p[model.AXIS : model.AXIS + 3]
    cornea = ((centre + p[model.CORNEA_D] * axis) * 1e-3).tolist()
    out: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 10},
        "camera": {
            "type": "perspective", "fov": 2 * half, "near_clip": 0.5, "far_clip": 500.0,
            "to_world": transform().look_at(origin=[0, 0, 0], target=[0, 0, 1], up=[0, -1, 0]),
            "film": {
                "type": "hdrfilm", "width": camera.pixels, "height": camera.pixels, "pixel_format": "rgb",
                "rfilter": {"type": "box"},
            },
        },
        "cornea": {
            "type": "sphere", "center": cornea, "radius": 1e-3 * float(p[model.CORNEA_R]),
            "bsdf": {"type": "dielectric", "int_ior": float(p[model.INDEX]), "ext_ior": 1.0},
        },
        "ambient": _ambient(mitsuba, p),
        "face": _mesh(mitsuba, "face", *_face(p, bank, rig, camera)),
        "globe": _mesh(mitsuba, "globe", *_globe(p, bank)),
        "iris": _mesh(mitsuba, "iris", *_iris(p, bank)),
    }  # fmt: skip
    fold = _fold(p, bank, rig, camera)
    if len(fold[1]):
        out["fold"] = _mesh(mitsuba, "fold", *fold)
    for k in range(model.LED_COUNT):
        place = (p[model.LED + 3 * k : model.LED + 3 * k + 3] * 1e-3).tolist()
        # irradiance pi at 20 mm: radiance 1 of white
        emitter = {"type": "area", "radiance": 400 / LAMP_RADIUS_MM**2}
        out[f"lamp{k}"] = {
            "type": "sphere",
            "center": place,
            "radius": LAMP_RADIUS_MM,
            "emitter": emitter,
        }
    return out


def _sky(p: Tensor, above: Array) -> Array:
    """Radiance from directions at this cosine from straight above; over any hemisphere
    it adds to ``model.ambient``.
    """
    return np.asarray(0.6 * float(p[model.AMBIENT]) * (1 + above))


def _ambient(mitsuba: Any, p: Tensor) -> dict[str, Any]:
    angle = (np.arange(64) + 0.5) / 64 * math.pi
    rows = _sky(p, np.cos(angle))
    picture = np.repeat(np.repeat(rows[:, None, None], 128, 1), 3, 2).astype(np.float32)
    frame = np.eye(4)
    right, down = (p[k : k + 3].numpy() for k in (model.FACE_X, model.FACE_Y))
    frame[:3, :3] = np.stack([right, -down, np.cross(right, -down)], 1)
    return {
        "type": "envmap", "bitmap": mitsuba.Bitmap(picture), "to_world": mitsuba.ScalarTransform4f(frame.tolist()),
    }  # fmt: skip


def _rays(
    rig: CameraRig, camera: PinholeCamera, p: Tensor
) -> tuple[int, tuple[Tensor, Tensor, Tensor]]:
    """A square grid of rays, twice as fine as the pixels and 1.6 times as wide: its
    side, and their directions.
    """
    t = torch.linspace(-1, 1, int(3.2 * camera.pixels) + 1, dtype=p.dtype) * (
        1.6 * float(camera.tangents(rig)[-1])
    )
    return len(t), plain_eye.ray(t[None], t[:, None])


def _face(
    p: Tensor, bank: Tensor, rig: CameraRig, camera: PinholeCamera
) -> tuple[Array, Array, Array]:
    """Lids and skin: the near sheet without the opening."""
    side, (dx, dy, dz) = _rays(rig, camera, p)
    s, seen, gx, gy, upper, lower, nx, ny, nz = plain_eye.lids(p, dx, dy, dz)
    light = plain_eye.lamps(p, s * dx, s * dy, s * dz, nx, ny, nz, 0.35)
    albedo = plain_eye.skin(
        p, bank, s, gx, gy, upper, lower, dx, dy, dz, nx, ny, nz
    ) / (light * p[model.GAIN])
    points = torch.stack([s * dx, s * dy, s * dz], -1)
    faces = _grid(side, side)
    open_ = seen.flatten().numpy()[faces].mean(1) > 0.5
    return points.reshape(-1, 3).numpy() * 1e-3, faces[~open_], albedo.flatten().numpy()


def _globe(p: Tensor, bank: Tensor) -> tuple[Array, Array, Array]:
    """The sclera behind the limbus, with the albedo that the model gives the ray
    through each point.
    """
    edge = math.asin(float(p[model.LIMBUS_R] / p[model.SCLERA_R]))
    angle = torch.linspace(edge, 2.2, 240, dtype=p.dtype)[:, None]
    unit = _about(p, torch.cos(angle), torch.sin(angle), 513)
    points = p[model.CENTRE : model.CENTRE + 3] + p[model.SCLERA_R] * unit
    dx, dy, dz = (points / points.norm(dim=-1, keepdim=True)).unbind(-1)
    _, _, gx, gy, _, lower, *_ = plain_eye.lids(p, dx, dy, dz)
    zero = torch.zeros_like(gx)
    mx, my, mz = unit.unbind(-1)
    albedo = plain_eye.sclera(p, bank, gx, gy, lower, mx, my, mz, zero, zero)
    return (
        points.reshape(-1, 3).numpy() * 1e-3,
        _grid(240, 513),
        albedo.flatten().numpy(),
    )


def _fold(
    p: Tensor, bank: Tensor, rig: CameraRig, camera: PinholeCamera
) -> tuple[Array, Array, Array]:
    """The far sheet where rays through the opening pass beside the globe: conjunctiva,
    as the model continues it.
    """
    side, (dx, dy, dz) = _rays(rig, camera, p)
    ts, mx, my, mz = plain_eye.globe(p, dx, dy, dz)
    _, seen, gx, gy, _, lower, *_ = plain_eye.lids(p, dx, dy, dz)
    zero = torch.zeros_like(gx)
    albedo = plain_eye.sclera(p, bank, gx, gy, lower, mx, my, mz, zero, zero)
    passes = (seen > 0) & (mx * mx + my * my + mz * mz > 1 + 1e-9)
    faces = _grid(side, side)
    points = torch.stack([ts * dx, ts * dy, ts * dz], -1)
    return (
        points.reshape(-1, 3).numpy() * 1e-3,
        faces[passes.flatten().numpy()[faces].any(1)],
        albedo.flatten().numpy(),
    )


def _iris(p: Tensor, bank: Tensor) -> tuple[Array, Array, Array]:
    """A dark floor 0.2 mm behind the pupil, the iris from its margin outwards, and the
    wall up to the limbus.

    The model's albedos are those that are seen from outside; tissue in water must be
    brighter by Saunderson's formula
    (1942), which takes the light that the surface keeps inside.
    """
    hole, rim = float(p[model.PUPIL_R]), float(p[model.LIMBUS_R])
    rings = torch.linspace(hole, rim, 120, dtype=p.dtype)
    radius = torch.cat(
        [
            torch.tensor([0.0, hole, hole], dtype=p.dtype),
            rings,
            torch.tensor([rim], dtype=p.dtype),
        ]
    )
    plane = float(p[model.PUPIL_D])
    height = torch.full_like(radius, plane)
    height[:2], height[-1] = plane - 200, float(p[model.LIMBUS_D])
    points = p[model.CENTRE : model.CENTRE + 3] + _about(
        p, height[:, None], radius[:, None], 513
    )
    turn = torch.linspace(0, 2 * math.pi, 513, dtype=p.dtype)
    x = radius[:, None] * torch.cos(turn)
    y = radius[:, None] * torch.sin(turn)
    albedo = plain_eye.pigment(p, bank, x, y, torch.sqrt(x * x + y * y + 1))
    albedo[:3] = p[model.PUPIL]
    # of diffuse light from inside; 6 % of that from outside
    kept = 1 - 0.94 / p[model.INDEX] ** 2
    lost = ((p[model.INDEX] - 1) / (p[model.INDEX] + 1)) ** 2
    albedo = albedo / ((1 - lost) * (1 - kept) + kept * albedo)
    return (
        points.reshape(-1, 3).numpy() * 1e-3,
        _grid(len(radius), 513),
        albedo.flatten().numpy(),
    )


def _about(p: Tensor, along: Tensor, across: Tensor, turns: int) -> Tensor:
    """(rows, turns, 3) rings about the optic axis, ``along`` it and ``across`` it
    (rows, 1).
    """
    turn = torch.linspace(0, 2 * math.pi, turns, dtype=p.dtype)
    axis, right, down = (p[k : k + 3] for k in (model.AXIS, model.IRIS_X, model.IRIS_Y))
    ring = torch.cos(turn)[:, None] * right + torch.sin(turn)[:, None] * down
    return along[..., None] * axis + across[..., None] * ring


def _grid(rows: int, columns: int) -> Array:
    """(2 (rows - 1) (columns - 1), 3) triangles of a grid of points."""
    k = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (
        part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, :-1], k[1:, 1:])
    )
    return np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def _mesh(mitsuba: Any, name: str, points: Array, faces: Array, albedo: Array) -> Any:
    """Triangles that scatter diffusely on both sides, with an albedo at every point."""
    colour = {"type": "mesh_attribute", "name": "vertex_albedo"}
    properties = mitsuba.Properties()
    properties["bsdf"] = mitsuba.load_dict(
        {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour}}
    )
    mesh = mitsuba.Mesh(name, len(points), len(faces), props=properties)
    values = mitsuba.traverse(mesh)
    values["vertex_positions"] = points.astype(np.float32).ravel()
    values["faces"] = faces.astype(np.uint32).ravel()
    values.update()
    mesh.add_attribute(
        "vertex_albedo", 3, np.repeat(albedo.clip(0, 0.98), 3).astype(np.float32)
    )
    return mesh
