"""A pool of rendered eyes that training draws from again and again, each time at
another scale.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional as F

from codesign.batches.scenes import EyeScenes, draw_depth_scales, pose_of
from codesign.batches.surface_frames import (
    EyePose,
    FrameBatch,
    SingleSurfaceFrames,
    flatten_layers,
)
from metalens.core.arrays import Array

MASK = 64  # pixels along a side of the kept masks, where the frame allows it
CHUNK = 64  # frames rendered at a time


@dataclass(frozen=True, eq=False, slots=True)
class FramePool:
    """Frames at unit scale, with their labels; what :class:`PoolScenes` draws from.

    light: (n, y, x) uint8. depth_um: (n, y, x) uint16. mask: (n, y, x) uint8, pupil
    coverage without the margin.
    place_um: (n, 3) nominal position and slippage together, at unit scale.
    seen_um: (n, 3) the same as the camera sees it.
    axis: (n, 3). points: (n, points, 2); see :class:`codesign.batches.EyePose`.
    here_um: (3,) nominal position. depths_um: (2,) range of the depth.
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
    """Pool of ``count`` frames of a stream of scenes, rendered CHUNK at a time."""
    parts = [
        _render_part(scenes, number, min(CHUNK, count - start))
        for number, start in enumerate(range(0, count, CHUNK))
    ]
    arrays = [np.concatenate(rows) for rows in zip(*parts, strict=True)]
    arrays += [scenes.rig.pupil_um.numpy(), np.array(scenes.depths_um)]
    return FramePool(*arrays)


def _render_part(scenes: EyeScenes, number: int, count: int) -> tuple[Array, ...]:
    """The first seven arrays of a :class:`FramePool`, of one chunk of frames.

    Masks are averaged to MASK pixels along a side where that divides theirs.
    """
    rendered = scenes.rendered(number, count)
    states = scenes.states(number, count)
    flat = flatten_layers(rendered.frames, states.scale)
    inside = slice(scenes.margin, rendered.pupil.shape[-1] - scenes.margin)
    mask = rendered.pupil[:, None, inside, inside]
    if mask.shape[-1] % MASK == 0:
        mask = F.avg_pool2d(mask, mask.shape[-1] // MASK)
    coverage = (mask[:, 0].clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    nominal_um = scenes.rig.pupil_um
    place_um, seen_um = (
        ((nominal_um + moved) / states.scale[:, None]).numpy()
        for moved in (rendered.labels.slip_um, rendered.labels.shift_um)
    )
    pose = pose_of(rendered, scenes.margin)
    return (
        flat.light,
        flat.depth_um,
        coverage,
        place_um,
        seen_um,
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
    def frame_pool(self) -> FramePool:
        """The frames."""
        return self.pool if isinstance(self.pool, FramePool) else self.pool()

    def batch(self, step: int, size: int) -> FrameBatch:
        """``size`` frames of a step, without repetition within a pass over the pool."""
        count = len(self.frame_pool)
        batches_per_pass = count // size
        order = np.random.default_rng(
            [self.seed, step // batches_per_pass, 5]
        ).permutation(count)
        first = step % batches_per_pass * size
        return self.rows(
            np.sort(order[first : first + size]),
            np.random.default_rng([self.seed, step, 6]),
        )

    def rows(self, rows: Array, generator: np.random.Generator) -> FrameBatch:
        """The frames of these numbers, each at a random scale, with labels in mm.

        Args:
            rows: numbers of the frames. generator: of the scales.
        """
        pool = self.frame_pool
        nominal_um = torch.from_numpy(pool.here_um)
        place_um = torch.from_numpy(pool.place_um[rows])
        low, high = pool.depths_um
        scale = draw_depth_scales(
            place_um[:, 2], (float(low), float(high)), self.spread, generator
        )
        slip, shift = (
            (scale[:, None] * p - nominal_um) * 1e-3
            for p in (place_um, torch.from_numpy(pool.seen_um[rows]))
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
