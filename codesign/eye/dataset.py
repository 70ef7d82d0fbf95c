"""Sets of states: by number, moved ones for the Fisher matrix, and shards of frames on
disk.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from codesign.eye import population as eye
from codesign.eye.population import EyeStates, MotionRanges
from codesign.eye.renderer import RenderedFrames
from metalens.core import store
from metalens.core.arrays import Array
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
