"""Test frames on which only the blur tells depth: the pupil stays where it is, and size
means nothing.

Pairs of states share the place of the pupil at different slips
(:func:`codesign.eye.dataset.ambiguity_pairs`, paper
Sec. 3.6); then every frame gets a scale that brings its depth to one that has nothing
to do with its picture.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from codesign.batches import Batch, EyeScenes, as_batch, decoupled
from codesign.eye import Labels, States, ambiguity_pairs, render
from metalens.ground.errors import TrainingError


@dataclass(frozen=True, eq=False, slots=True)
class AmbiguityScenes:
    """The two states of every pair, one after the other; see
    :class:`codesign.train.inner.Scenes`.

    scenes: rig, camera, ranges and margin. states: (2 pairs), with their scales.
    """

    scenes: EyeScenes
    states: States

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

        Raises:
            TrainingError: there are fewer.
        """
        if (step + 1) * size > len(self.states):
            raise TrainingError(
                f"{len(self.states)} ambiguous frames hold no batch {step} of {size}: take fewer"
            )
        return slice(step * size, (step + 1) * size)

    def batch(self, step: int, size: int) -> Batch:
        """Frames of a step."""
        made = render(
            self.states[self.rows(step, size)],
            rig=self.scenes.rig,
            camera=self.scenes.camera,
        )
        return as_batch(made, self.margin)

    def labels(self, step: int, size: int) -> Labels:
        """All that is true of the frames of a step."""
        return render(
            self.states[self.rows(step, size)],
            rig=self.scenes.rig,
            camera=self.scenes.camera,
        ).labels


def ambiguous(scenes: EyeScenes, pairs: int, seed: int) -> AmbiguityScenes:
    """``pairs`` pairs with scales of spread ``scenes.settings.scale``, from a seed.

    Raises:
        SceneError: the ranges of ``scenes`` hold hardly any pair.
    """
    found = ambiguity_pairs(
        pairs, seed, rig=scenes.rig, camera=scenes.camera, motion=scenes.settings.motion
    )
    joined = States(
        *(
            torch.stack([getattr(found.first, n), getattr(found.second, n)], 1).flatten(
                0, 1
            )
            for n in States.__slots__
        )
    )
    depth = scenes.rig.distance_um + joined.slip_um[:, 2]
    scale = decoupled(
        depth, scenes.depths_um, scenes.settings.scale, np.random.default_rng((seed, 8))
    )
    return AmbiguityScenes(scenes, replace(joined, scale=scale))
