"""Test frames on which only the blur tells depth: the pupil stays where it is, and size
means nothing.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from codesign.batches import EyeScenes, FrameBatch, as_batch, draw_depth_scales
from codesign.eye import (
    DrawnAugmentations,
    EyeStates,
    ambiguity_pairs,
    draw_augmentations,
    render_dressed,
)
from metalens.core.errors import TrainingError


@dataclass(frozen=True, eq=False, slots=True)
class AmbiguityScenes:
    """The two states of every pair, one after the other; see
    :class:`codesign.train.inner.Scenes`.

    scenes: rig, camera, ranges and margin. states: (2 pairs), with their scales. worn:
    what each frame has, as in training, before the one camera that pairs need.
    """

    scenes: EyeScenes
    states: EyeStates
    worn: DrawnAugmentations

    @property
    def margin(self) -> int:
        """Samples around the frame that are blurred in but not seen."""
        return self.scenes.margin

    @property
    def stream(self) -> int:
        """Of the random generator: noise of its own."""
        return self.scenes.stream

    def __len__(self) -> int:
        return len(self.states)

    def rows(self, step: int, size: int) -> slice:
        """States of a step.

        Args:
            size: frames of a batch.

        Raises:
            TrainingError: there are fewer.
        """
        if (step + 1) * size > len(self.states):
            raise TrainingError(
                f"{len(self.states)} ambiguous frames hold no batch {step} of {size}: take fewer"
            )
        return slice(step * size, (step + 1) * size)

    def batch(self, step: int, size: int) -> FrameBatch:
        """Frames of a step.

        Args:
            size: frames of a batch.
        """
        rows = self.rows(step, size)
        made = render_dressed(
            self.states[rows],
            self.worn[rows],
            rig=self.scenes.rig,
            camera=self.scenes.camera,
        )
        return as_batch(made, self.margin)


def ambiguous_pairs(scenes: EyeScenes, pairs: int, seed: int) -> AmbiguityScenes:
    """``pairs`` pairs with scales of spread ``scenes.settings.scale``, from a seed.

    Raises:
        SceneError: the ranges of ``scenes`` hold hardly any pair.
    """
    found = ambiguity_pairs(
        pairs, seed, rig=scenes.rig, camera=scenes.camera, motion=scenes.settings.motion
    )
    joined = EyeStates(
        *(
            torch.stack([getattr(found.first, n), getattr(found.second, n)], 1).flatten(
                0, 1
            )
            for n in EyeStates.__slots__
        )
    )
    depth = scenes.rig.distance_um + joined.slip_um[:, 2]
    scale = draw_depth_scales(
        depth, scenes.depths_um, scenes.settings.scale, np.random.default_rng((seed, 8))
    )
    generator = np.random.default_rng((seed, scenes.stream, 10))
    worn = draw_augmentations(
        len(joined), scenes.settings.variety, generator
    ).from_one_view()
    return AmbiguityScenes(scenes, replace(joined, scale=scale), worn)
