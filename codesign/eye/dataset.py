"""Sets of states: moved ones for the Fisher matrix, pairs that share a pupil position,
and shards of frames on disk.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from codesign.eye import population as eye
from codesign.eye.population import CameraRig, EyeStates, MotionRanges
from codesign.eye.renderer import PinholeCamera, RenderedFrames, render
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import SceneError
from metalens.core.store import Provenance


def states_at(
    indices: Tensor, seed: int, *, motion: MotionRanges | None = None
) -> EyeStates:
    """States of given numbers from the endless sequence of a seed.

    State i is the same alone or together with others.

    Args:
        indices: (n,) numbers of the states. seed: of the sequence.
        motion: ranges of the states; the defaults without it.
    """
    parts = [eye.draw_states(1, (seed, int(i)), motion=motion) for i in indices]
    return _joined(parts)


def _joined(parts: Sequence[EyeStates]) -> EyeStates:
    """States one after the other."""
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


def ambiguity_pairs(
    count: int,
    seed: int,
    *,
    rig: CameraRig | None = None,
    camera: PinholeCamera | None = None,
    motion: MotionRanges | None = None,
) -> EyeStates:
    """Pairs of states of one subject whose visible pupils have one centroid (Sec. 3.6).

    Slip and gaze of a pair differ; centroids agree within 0.1 pixels. The second state
    has a new slip, 0.8 mm or more away; its gaze is solved on the rendered masks to
    restore the centroid. Pairs that need a gaze outside the range, or whose pupil is
    cut by lid or frame, are left out.

    Args:
        count: number of pairs. seed: of the random generator.
        rig: pose of camera and lamps; the default without it.
        camera: pixel grid; the default without it.
        motion: ranges of the states; the defaults without it.

    Returns:
        2 ``count`` states, the two of a pair consecutive.

    Raises:
        SceneError: fewer than one pair in fifty is possible in these ranges.
    """
    rig = rig or CameraRig()
    camera = camera or PinholeCamera()
    motion = motion or MotionRanges()
    states: list[EyeStates] = []
    pairs = tried = 0
    while pairs < count:
        if tried > 50 * max(pairs, 64):
            raise SceneError(
                f"{pairs} pairs in {tried} tries: widen the gaze range or narrow the slip range"
            )
        batch = max(32, count - pairs)
        first, second = (
            eye.draw_states(batch, (seed, tried, part), motion=motion)
            for part in (0, 1)
        )
        tried += batch
        second = replace(first, slip_um=second.slip_um)
        second, good = _with_matching_gaze(first, second, rig=rig, camera=camera)
        limits = torch.tensor([motion.gaze_x_rad, motion.gaze_y_rad])
        good &= (second.gaze_rad.abs() <= limits).all(1)
        good &= (second.slip_um - first.slip_um).norm(dim=1) >= 800.0
        for row in torch.nonzero(good)[: count - pairs]:
            states += [first[row], second[row]]
        pairs = len(states) // 2
    return _joined(states)


def _with_matching_gaze(
    first: EyeStates,
    second: EyeStates,
    *,
    rig: CameraRig,
    camera: PinholeCamera,
    tolerance_px: float = 0.1,
) -> tuple[EyeStates, Tensor]:
    """``second`` with the gaze whose pupil centroid is that of ``first``, and where it
    is.

    Newton steps on rendered masks with a Jacobian by central differences, computed once
    and regularised where nearly singular.

    Returns:
        states, and (n,) whether centroids agree and both pupils are visible.
    """
    goal = render(first, rig=rig, camera=camera).labels
    gaze, step = second.gaze_rad, 2e-3
    jacobian = torch.stack(
        [
            (
                _centroids(second, gaze + step * way, rig, camera)[0]
                - _centroids(second, gaze - step * way, rig, camera)[0]
            )
            / (2 * step)
            for way in torch.eye(2, dtype=torch.float64)
        ],
        2,
    )
    determinant = (
        jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
    )
    jacobian = jacobian + torch.where(determinant.abs() < 1.0, 1e3, 0.0)[
        :, None, None
    ] * torch.eye(2, dtype=torch.float64)
    for _ in range(6):
        centroid, visible = _centroids(second, gaze, rig, camera)
        error = goal.centroid_px - centroid
        if bool((error.norm(dim=1) < 0.3 * tolerance_px).all()):
            break
        gaze = gaze + torch.linalg.solve(jacobian, error[..., None])[..., 0].clamp(
            -0.25, 0.25
        )
    centroid, visible = _centroids(second, gaze, rig, camera)
    distance = (goal.centroid_px - centroid).norm(dim=1)
    matches = (distance <= tolerance_px) & (visible > 0.97) & (goal.visible > 0.97)
    return replace(second, gaze_rad=gaze), matches


def _centroids(
    states: EyeStates, gaze_rad: Tensor, rig: CameraRig, camera: PinholeCamera
) -> tuple[Tensor, Tensor]:
    """(n, 2) pupil centroid in pixels and (n,) visible share, of states at a gaze."""
    labels = render(replace(states, gaze_rad=gaze_rad), rig=rig, camera=camera).labels
    return labels.centroid_px, labels.visible


def write_shard(
    path: str | Path,
    rendered: RenderedFrames,
    *,
    seed: int,
    provenance: Provenance | None = None,
) -> None:
    """One HDF5 file (kind ``scene``) of frames, masks and labels: light and coverage in
    8 bits, depth in um.

    Args:
        path: of the file. rendered: frames to write. seed: of the random generator.
        provenance: of the file.

    Accuracy: light to 1/510, coverage to 1/510, depth to 1 um (16 bits up to 65 mm).
    """
    f, labels = rendered.frames, rendered.labels
    arrays: dict[str, Array] = {
        "radiance": _bytes(f.radiance),
        "coverage": _bytes(f.coverage[:, 1]),
        "depth_um": f.depth_um.clamp(0, 65535).round().numpy().astype(np.uint16),
        "pupil": _bytes(rendered.pupil),
    }
    arrays |= {
        f"labels/{name}": getattr(labels, name).numpy()
        for name in type(labels).__slots__
    }
    store.save(
        path, "scene", arrays, provenance=replace(provenance or Provenance(), seed=seed)
    )


def _bytes(values: Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return (values.clamp(0, 1) * 255 + 0.5).numpy().astype(np.uint8)
