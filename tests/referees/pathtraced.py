"""A frame once more, path traced by Mitsuba 3 in a scene of shapes: a referee of the
renderer.

The globe, the refracting cornea, the plane iris with its hole, the lids and the skin,
the three lamps and the ambient
light stand where the model has them, with the model's albedos. What the renderer leaves
out is here: shadows, light
between surfaces, light refracted on its way in, mirror images of the surroundings.
Those of the lamps are compared
apart: the renderer draws them wider than they are.
"""

import importlib
import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from codesign.eye import (
    POPULATION,
    CameraRig,
    EyeStates,
    PinholeCamera,
    renderer,
    textures,
)
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import SceneError
from tests.codesign.eye import model, plain_eye
from tests.referees.traced_shapes import LAMP_RADIUS_MM, build

REGIONS = ("pupil", "iris", "sclera", "skin", "edges", "mirrors")
LEAST_LLVM = 17  # older ones end the process over an instruction that they do not know


@dataclass(frozen=True, eq=False, slots=True)
class Comparison:
    """A frame of the renderer beside the path tracer's.

    ours: (y, x) radiance, without mirror images of the lamps. halves: (2, y, x) traced
    with independent paths.
    regions: masks (y, x) of REGIONS, and "all", which is all but "mirrors".
    seconds: of ours and of the tracing. samples: paths a pixel, of both halves.
    variant: of Mitsuba.
    """

    ours: Array
    halves: Array
    regions: dict[str, Array]
    seconds: tuple[float, float]
    samples: int
    variant: str

    @property
    def traced(self) -> Array:
        """(y, x) radiance of all paths."""
        return np.asarray(self.halves.mean(0))

    def error(self, region: str = "all", image: Array | None = None) -> float:
        """Relative L2 error of ``image`` (ours) against the traced radiance; the noise
        of tracing cancels.
        """
        mask = self.regions[region]
        first, second = ((self.ours if image is None else image) - self.halves) * mask
        square = float((self.halves[0] * self.halves[1] * mask).sum())
        return math.sqrt(max(float((first * second).sum()), 0.0) / max(square, 1e-30))

    def ratio(self, region: str = "all") -> float:
        """Mean traced radiance over mean radiance of ours."""
        mask = self.regions[region]
        return float(self.traced[mask].sum() / max(float(self.ours[mask].sum()), 1e-30))

    def lines(self) -> list[str]:
        """What was found, a region a line."""
        found = [name for name in ("all", *REGIONS) if self.regions[name].any()]
        head = f"{'region':8} {'pixels':>7} {'error':>7} {'traced/ours':>12}"
        rows = [
            f"{name:8} {int(self.regions[name].sum()):7d} {self.error(name):7.3f} {self.ratio(name):12.3f}"
            for name in found
        ]
        ours, traced = self.seconds
        return [
            head,
            *rows,
            f"ours {1e3 * ours:.1f} ms, {self.samples} paths a pixel {traced:.1f} s ({self.variant})",
        ]


def start() -> Any:
    """Mitsuba with a variant set: compiled for vectors where a new enough LLVM is
    found, else scalar.

    Raises:
        SceneError: Mitsuba is not installed.
    """
    try:
        mitsuba = importlib.import_module("mitsuba")
        drjit = importlib.import_module("drjit")
    except ImportError as error:
        raise SceneError(
            "the path-traced referee needs Mitsuba 3, which is not installed: pip install 'metalens-toolchain[referee]'"
        ) from error
    if mitsuba.variant() is None:
        vectors = drjit.detail.llvm_version()[0] >= LEAST_LLVM
        mitsuba.set_variant("llvm_ad_rgb" if vectors else "scalar_rgb")
    return mitsuba


def compare(
    states: EyeStates,
    *,
    rig: CameraRig | None = None,
    camera: PinholeCamera | None = None,
    samples: int = 512,
) -> Comparison:
    """Render the first of the states both ways; by default 96 pixels of 15 um, about
    half a minute on one core.

    Args:
        samples: paths a pixel, in two halves of their own seeds.

    Raises:
        SceneError: Mitsuba is not installed, or fewer than two samples.
    """
    if samples < 2:
        raise SceneError(f"{samples} paths a pixel: need 2 or more, for two halves")
    mitsuba = start()
    rig, camera = rig or CameraRig(), camera or PinholeCamera(96, 15.0)
    state = _without_glints(states[:1])
    renderer.render(state, rig=rig, camera=camera)  # compiles
    begin = time.perf_counter()
    ours = renderer.render(state, rig=rig, camera=camera).pinhole()[0].double().numpy()
    middle = time.perf_counter()
    halves = np.stack(
        [
            trace(state, rig=rig, camera=camera, samples=samples // 2, seed=seed)
            for seed in (0, 1)
        ]
    )
    seconds = middle - begin, time.perf_counter() - middle
    return Comparison(
        ours,
        halves,
        _regions(state, rig, camera),
        seconds,
        2 * (samples // 2),
        mitsuba.variant(),
    )


def trace(
    states: EyeStates,
    *,
    rig: CameraRig | None = None,
    camera: PinholeCamera | None = None,
    samples: int = 64,
    seed: int = 0,
) -> Array:
    """(y, x) radiance of the first of the states, in the renderer's unit.

    Raises:
        SceneError: Mitsuba is not installed.
    """
    mitsuba = start()
    rig, camera = rig or CameraRig(), camera or PinholeCamera(96, 15.0)
    p = _parameters(states, rig, camera)
    scene = mitsuba.load_dict(build(mitsuba, p, _bank(), rig=rig, camera=camera))
    light = np.array(mitsuba.render(scene, spp=samples, seed=seed))[..., 0]
    return np.asarray(light, float) * float(p[model.GAIN])


def picture(made: Comparison, path: Path) -> None:
    """Ours, the traced frame and their difference side by side, as a PNG."""
    import cv2

    shown = np.concatenate(
        [made.ours, made.traced, abs(made.ours - made.traced)], 1
    ).clip(0, 1) ** (1 / 1.8)
    large = (255 * shown).astype(np.uint8).repeat(3, 0).repeat(3, 1)
    done, coded = cv2.imencode(".png", large)
    if not done:
        raise OSError(f"{path}: the picture could not be encoded")
    store.write_bytes(path, coded.tobytes())


def _parameters(states: EyeStates, rig: CameraRig, camera: PinholeCamera) -> Tensor:
    return model.rows_of_camera(states[:1], rig, camera)[0]


def _bank() -> Tensor:
    return torch.tensor(textures.texture_bank(0), dtype=torch.float64)


def _without_glints(states: EyeStates) -> EyeStates:
    traits = states.traits.clone()
    traits[:, list(POPULATION).index("glint")] = 0
    return replace(states, traits=traits)


def _regions(
    states: EyeStates, rig: CameraRig, camera: PinholeCamera
) -> dict[str, Array]:
    """Masks of REGIONS: pixels that show one of them alone, those that show a lamp in
    the cornea, and the others.
    """
    p = _parameters(states, rig, camera)
    t = torch.from_numpy(camera.tangents(rig))
    dx, dy, dz = plain_eye.ray(t[None], t[:, None])
    seen = plain_eye.lids(p, dx, dy, dz)[1]
    disc, pupil, *_ = plain_eye.iris(
        p, _bank(), *plain_eye.cornea(p, dx, dy, dz), dx, dy, dz
    )
    mirrors = (seen > 0) & _mirrors(p, dx, dy, dz)
    eye = (seen > 0.999) & ~mirrors
    masks = {
        "pupil": eye & (pupil > 0.999),
        "iris": eye & (disc > 0.999) & (pupil < 0.001),
        "sclera": eye & (disc < 0.001),
        "skin": seen < 0.001,
        "mirrors": mirrors,
    }
    masks |= {"edges": ~torch.stack(list(masks.values())).any(0), "all": ~mirrors}
    return {name: mask.numpy() for name, mask in masks.items()}


def _mirrors(p: Tensor, dx: Tensor, dy: Tensor, dz: Tensor) -> Tensor:
    """Where the cornea's sphere mirrors a lamp, or what is within a lamp's radius of
    it.
    """
    tc, cx, cy, cz, inside = plain_eye.cornea(p, dx, dy, dz)
    ray = torch.stack([dx, dy, dz], -1)
    normal = torch.stack([cx, cy, cz], -1)
    back = ray - 2 * (ray * normal).sum(-1, keepdim=True) * normal
    lamps = p[model.LED : model.LED + 3 * model.LED_COUNT].reshape(-1, 1, 1, 3)
    way = lamps - tc[..., None] * ray
    along = (way * back).sum(-1)
    off = (way - along[..., None] * back).norm(dim=-1)
    seen: Tensor = ((off < 2e3 * LAMP_RADIUS_MM) & (along > 0)).any(0) & (inside > 0)
    return seen
