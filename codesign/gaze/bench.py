"""Gaze from a network's predictions on simulated people, each calibrated on some of its
own frames.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from codesign.batches import EyeScenes, FrameBatch, as_batch
from codesign.eye import (
    DrawnAugmentations,
    EyeStates,
    FrameLabels,
    drawn_of_people,
    render,
    render_dressed,
)
from codesign.eye import population as eye
from codesign.gaze.personal import SphereCalibrator, angle_deg
from codesign.gaze.readings import NetworkReadings, PersonCalibrator, face_angles


@dataclass(frozen=True, eq=False, slots=True)
class PeopleFrames:
    """Frames of ``people`` people, equally many of each, one person after the other.

    scenes: rig, camera and margin. stream: of the noise.
    """

    scenes: EyeScenes
    states: EyeStates
    worn: DrawnAugmentations
    labels: FrameLabels
    people: int
    stream: int = 7

    @property
    def each(self) -> int:
        """Frames of a person."""
        return len(self.states) // self.people

    @property
    def margin(self) -> int:
        """Samples around the frame that are blurred in and then cut off."""
        return self.scenes.margin

    def batch(self, step: int, size: int) -> FrameBatch:
        """Frames of a step; fewer, or none, where the people end.

        Args:
            size: frames of a step.
        """
        rows = slice(step * size, (step + 1) * size)
        rig, camera = self.scenes.rig, self.scenes.camera
        worn = {name: values[rows] for name, values in self.worn.items()}
        rendered = render_dressed(self.states[rows], worn, rig=rig, camera=camera)
        return as_batch(rendered, self.margin)


def simulate_people(
    scenes: EyeScenes, count: int, each: int, *, seed: int
) -> PeopleFrames:
    """Frames of ``count`` people in ``each`` random states of gaze and slip.

    One mounting of the camera a person, and scale 1.

    Args:
        scenes: frames by number. count: people. each: frames of a person.
        seed: of the random generator.
    """
    subjects = eye.draw_states(count, (seed, 21), motion=scenes.settings.motion)
    moves = eye.draw_states(count * each, (seed, 22), motion=scenes.settings.motion)
    rows = torch.arange(count).repeat_interleave(each)
    own = subjects[rows]
    states = replace(
        moves, traits=own.traits, textures=own.textures, mount_rad=own.mount_rad
    )
    camera = replace(
        scenes.camera,
        pixels=32,
        pitch_um=scenes.camera.pitch_um * scenes.camera.pixels / 32,
    )
    augmentations = drawn_of_people(rows.numpy(), scenes.settings.variety, (seed, 23))
    labels = render(states, rig=scenes.rig, camera=camera).labels
    return PeopleFrames(scenes, states, augmentations, labels, count)


def read_of(test: PeopleFrames, centre: Tensor, slip_mm: Tensor) -> NetworkReadings:
    """Predictions of a network for frames of people, in the units of gaze calibration.

    Args:
        test: people, their frames and gaze.
        centre: (n, 2) pupil centre, fraction of the frame from its centre.
        slip_mm: (n, 3) of the head.
    """
    edge_mm = test.scenes.settings.pixels * test.scenes.sample_um * 1e-3
    return NetworkReadings(centre.double().numpy() * edge_mm, slip_mm.double().numpy())


def calibrated_error_deg(
    test: PeopleFrames,
    read: NetworkReadings,
    *,
    how: PersonCalibrator | None = None,
    share: float = 0.2,
) -> float:
    """Mean angle between predicted and true visual axes, deg, after personal
    calibration.

    Over the frames that no calibration used.

    Args:
        test: people, their frames and gaze. read: readings of a network.
        how: calibrates people; by default spherical-eye solver and residual regressor
            (paper Sec. 3.3).
        share: of each person's frames that calibrates, 3 frames at least.
    """
    rig = test.scenes.rig
    how = how or SphereCalibrator(rig)
    calibrating = max(3, round(share * test.each))
    true_deg = face_angles(test.labels.visual_axis.numpy(), rig)
    errors = []
    for first in range(0, test.people * test.each, test.each):
        calibration = np.arange(first, first + calibrating)
        others = np.arange(first + calibrating, first + test.each)
        gaze = how.person(read[calibration], true_deg[calibration])(read[others])
        errors.append(angle_deg(gaze, true_deg[others]))
    return float(np.concatenate(errors).mean())
