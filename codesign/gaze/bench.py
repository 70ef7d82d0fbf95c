"""Gaze from a network's answers on simulated people, each calibrated on some of its
own frames.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from codesign.batches import EyeScenes, StateScenes
from codesign.eye import FrameLabels, drawn_of_people, render
from codesign.eye import population as eye
from codesign.gaze import shared
from codesign.gaze.personal import SphereCalibrator, angle_deg
from codesign.gaze.readings import NetworkReadings, PersonCalibrator, face_angles
from metalens.core.arrays import Array

STREAM = 7  # of the noise


@dataclass(frozen=True, eq=False, slots=True)
class PeopleFrames(StateScenes):
    """Frames of ``people`` people, equally many of each, one person after the other."""

    labels: FrameLabels
    people: int

    @property
    def each(self) -> int:
        """Frames of a person."""
        return len(self.states) // self.people


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
    return PeopleFrames(scenes, states, augmentations, STREAM, labels, count)


def read_of(
    test: PeopleFrames, centre: Tensor, slip_mm: Tensor, axis: Tensor | None = None
) -> NetworkReadings:
    """Predictions of a network for frames of people, in the units of gaze calibration.

    Args:
        test: people, their frames and gaze.
        centre: (n, 2) pupil centre, fraction of the frame from its centre.
        slip_mm: (n, 3) of the head.
        axis: (n, 3) optic axis in the camera's frame; None of a network without one.
    """
    edge_mm = test.scenes.settings.pixels * test.scenes.sample_um * 1e-3
    angles = None
    if axis is not None:
        angles = face_angles(axis.double().numpy(), test.scenes.rig.elevation_rad)
    return NetworkReadings(
        centre.double().numpy() * edge_mm, slip_mm.double().numpy(), angles
    )


def looked_deg(test: PeopleFrames) -> Array:
    """(n, 2) angles of the visual axes, across and down in the frame of the face, deg.

    Args:
        test: people, their frames and gaze.
    """
    return face_angles(test.labels.visual_axis.numpy(), test.scenes.rig.elevation_rad)


def learn_from_people(
    before: PeopleFrames, read: NetworkReadings
) -> shared.PopulationPrior:
    """Population prior of gaze from the frames of other people, by which a person is
    calibrated.

    Args:
        before: people who calibrated before.
        read: pupil, slippage and axis as a network reads them.

    Raises:
        TrainingError: too few people or frames, or readings without an axis.
    """
    return shared.learn_population(
        read, looked_deg(before), np.arange(len(read)) // before.each
    )


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
    how = how or SphereCalibrator(test.scenes.rig)
    calibrating = max(3, round(share * test.each))
    true_deg = looked_deg(test)
    errors = []
    for first in range(0, test.people * test.each, test.each):
        calibration = np.arange(first, first + calibrating)
        others = np.arange(first + calibrating, first + test.each)
        gaze = how.person(read[calibration], true_deg[calibration])(read[others])
        errors.append(angle_deg(gaze, true_deg[others]))
    return float(np.concatenate(errors).mean())
