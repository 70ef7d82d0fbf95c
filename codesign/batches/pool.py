"""A pool of rendered eyes that training draws from again and again, each time at
another scale.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional as F

from codesign.batches.batch import EyePose, FrameBatch
from codesign.batches.flat import SingleSurfaceFrames, flatten_layers
from codesign.batches.scenes import EyeScenes, draw_depth_scales, pose_of
from metalens.core.arrays import Array
from metalens.core.errors import TrainingError

MASK = 64  # pixels along a side of the kept masks, where the frame allows it
CHUNK = 64  # frames rendered at a time


@dataclass(frozen=True, eq=False, slots=True)
class FramePool:
    """Frames at unit scale, with their labels; what :class:`PoolScenes` draws from.

    light: (n, y, x) uint8. depth_um: (n, y, x) uint16. mask: (n, y, x) uint8, pupil
    coverage without the margin.
    place_um: (n, 3) nominal place and slippage together, at unit scale. seen_um: (n, 3)
    the same as the camera sees it.
    axis: (n, 3). points: (n, points, 2); see :class:`codesign.batches.EyePose`.
    here_um:
    (3,) nominal place.
    depths_um: (2,) range of the depth.
    """

    light: Array
    depth_um: Array
    mask: Array
    place_um: Array
    seen_um: Array
    axis: Array
    points: Array
    here_um: Array
    depths_um: Array

    def __len__(self) -> int:
        return len(self.light)


def render_pool(scenes: EyeScenes, count: int) -> FramePool:
    """Render ``count`` frames of a stream of scenes."""
    parts = []
    for number, start in enumerate(range(0, count, CHUNK)):
        parts.append(_part(scenes, number, min(CHUNK, count - start)))
    here = np.array([*scenes.rig.aim_um, scenes.rig.distance_um])
    light, depth, mask, place, seen, axis, points = (
        np.concatenate(rows) for rows in zip(*parts, strict=True)
    )
    return FramePool(
        light, depth, mask, place, seen, axis, points, here, np.array(scenes.depths_um)
    )


def _part(scenes: EyeScenes, number: int, count: int) -> tuple[Array, ...]:
    """The first seven arrays of a :class:`FramePool`."""
    made = scenes.rendered(number, count)
    states = scenes.states(number, count)
    flat = flatten_layers(made.frames, states.scale)
    inside = slice(scenes.margin, made.pupil.shape[-1] - scenes.margin)
    mask = made.pupil[:, None, inside, inside]
    if mask.shape[-1] % MASK == 0:
        mask = F.avg_pool2d(mask, mask.shape[-1] // MASK)
    coverage = (mask[:, 0].clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    here = torch.tensor(
        [*scenes.rig.aim_um, scenes.rig.distance_um], dtype=torch.float64
    )
    place, seen = (
        ((here + moved) / states.scale[:, None]).numpy()
        for moved in (made.labels.slip_um, made.labels.shift_um)
    )
    pose = pose_of(made, scenes.margin)
    return (
        flat.light,
        flat.depth_um,
        coverage,
        place,
        seen,
        pose.axis.numpy(),
        pose.points.numpy(),
    )


@dataclass(frozen=True, eq=False, slots=True)
class PoolScenes:
    """Batches from a pool; see :class:`codesign.batches.SceneSource`.

    Every pass over the pool has an order of its own, and every frame a new scale each
    time it is drawn.

    seed: of orders and scales. margin: samples around the frames. spread: of the scale,
    see :func:`decoupled`.
    pool: or what gives it whenever a batch is asked for, so that many runs need not
    hold theirs at once.
    """

    pool: FramePool | Callable[[], FramePool]
    margin: int
    spread: float
    seed: int

    @property
    def held(self) -> FramePool:
        """The frames."""
        return self.pool if isinstance(self.pool, FramePool) else self.pool()

    def batch(self, step: int, size: int) -> FrameBatch:
        """``size`` frames of a step.

        Raises:
            TrainingError: the pool holds less than a batch.
        """
        count = len(self.held)
        a_pass = count // size
        if a_pass == 0:
            raise TrainingError(
                f"a pool of {count} frames is smaller than a batch of {size}: raise the pool"
            )
        order = np.random.default_rng([self.seed, step // a_pass, 5]).permutation(count)
        first = step % a_pass * size
        return self.rows(
            np.sort(order[first : first + size]),
            np.random.default_rng([self.seed, step, 6]),
        )

    def rows(self, rows: Array, generator: np.random.Generator) -> FrameBatch:
        """The frames of these numbers, at scales drawn from ``generator``.

        Args:
            rows: numbers of the frames.
        """
        pool = self.held
        here = torch.from_numpy(pool.here_um)
        place = torch.from_numpy(pool.place_um[rows])
        low, high = pool.depths_um
        scale = draw_depth_scales(
            place[:, 2], (float(low), float(high)), self.spread, generator
        )
        slip, shift = (
            (scale[:, None] * p - here) * 1e-3
            for p in (place, torch.from_numpy(pool.seen_um[rows]))
        )
        pose = EyePose(
            shift.float(),
            torch.from_numpy(pool.axis[rows]),
            torch.from_numpy(pool.points[rows]),
        )
        flat = SingleSurfaceFrames(
            pool.light[rows], pool.depth_um[rows], scale.numpy().astype(np.float32)
        )
        return FrameBatch(
            flat, torch.from_numpy(pool.mask[rows]).float() / 255, slip.float(), pose
        )
