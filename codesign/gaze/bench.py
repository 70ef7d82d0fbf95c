"""Gaze from a network's answers, three ways apart: population eye, the person's own
eye, and personal calibration.
"""

import math
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
from codesign.gaze import shared
from codesign.gaze.axis import EyeGeometry, angle_rad, optical_axis
from codesign.gaze.personal import SphereCalibrator, angle_deg
from codesign.gaze.readings import NetworkReadings, PersonCalibrator, face_angles
from metalens.core.arrays import Array
from metalens.core.errors import TrainingError


@dataclass(frozen=True, eq=False, slots=True)
class PeopleFrames:
    """Frames of ``people`` people, ``each`` one after the other; see
    :class:`codesign.train.inner.Scenes`.

    worn: what each frame has, with the variety of training.
    """

    scenes: EyeScenes
    states: EyeStates
    worn: DrawnAugmentations
    labels: FrameLabels
    people: int

    @property
    def margin(self) -> int:
        """Samples around the frames that are blurred in but not seen."""
        return self.scenes.margin

    @property
    def stream(self) -> int:
        """Of the noise."""
        return 7

    @property
    def each(self) -> int:
        """Frames of a person."""
        return len(self.states) // self.people

    def batch(self, step: int, size: int) -> FrameBatch:
        """Frames of a step.

        Args:
            size: frames of a batch.
        """
        rows = slice(step * size, (step + 1) * size)
        made = render_dressed(
            self.states[rows],
            self.worn[rows],
            rig=self.scenes.rig,
            camera=self.scenes.camera,
        )
        return as_batch(made, self.margin)


def simulate_people(
    scenes: EyeScenes, count: int, each: int, *, seed: int
) -> PeopleFrames:
    """``count`` people who look and slip in ``each`` ways; one mounting of the camera a
    person, no change of scale.

    Args:
        scenes: frames by number. seed: of the random generator.
    """
    subjects = eye.draw_states(count, (seed, 21), motion=scenes.settings.motion)
    moves = eye.draw_states(count * each, (seed, 22), motion=scenes.settings.motion)
    rows = torch.arange(count).repeat_interleave(each)
    mine = subjects[rows]
    states = replace(
        moves, traits=mine.traits, textures=mine.textures, mount_rad=mine.mount_rad
    )
    camera = replace(
        scenes.camera,
        pixels=32,
        pitch_um=scenes.camera.pitch_um * scenes.camera.pixels / 32,
    )
    worn = drawn_of_people(rows.numpy(), scenes.settings.variety, (seed, 23))
    labels = render(states, rig=scenes.rig, camera=camera).labels
    return PeopleFrames(scenes, states, worn, labels, count)


@dataclass(frozen=True, slots=True)
class GazeErrors:
    """Mean angles in degrees between found and true gaze, over the frames that no
    calibration saw.

    population: optical axis, mean eye. anatomy: optical axis, the person's own eye.
    personal: visual axis after a
    calibration on the person's own frames. The floors: the same by the sphere
    (:mod:`codesign.gaze.personal`) with true
    slippage and pupil, what is left to the solver and not to the network.
    """

    population_deg: float
    anatomy_deg: float
    personal_deg: float
    population_floor_deg: float
    anatomy_floor_deg: float
    personal_floor_deg: float


def read_of(
    test: PeopleFrames, centre: Tensor, slip_mm: Tensor, axis: Tensor | None = None
) -> NetworkReadings:
    """What a network found in the frames, in the units that gaze is calibrated in.

    Args:
        centre: (n, 2) pupil centre, fraction of the frame from its middle. slip_mm: (n,
            3) of the head.
        axis: (n, 3) optic axis in the camera's frame; None of a network that tells
            none.
        test: people, their frames and where they look.
    """
    edge_mm = test.scenes.settings.pixels * test.scenes.sample_um * 1e-3
    angles = (
        None
        if axis is None
        else face_angles(axis.double().numpy(), test.scenes.rig.elevation_rad)
    )
    return NetworkReadings(
        centre.double().numpy() * edge_mm, slip_mm.double().numpy(), angles
    )


def looked_deg(test: PeopleFrames) -> Array:
    """(n, 2) angles of the visual axes, across and down in the frame of the face.

    Args:
        test: people, their frames and where they look.
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
    """Mean angle between read and true visual axes, deg, over the frames that no
    calibration used.

    Args:
        how: people are calibrated; without it by the spherical-eye solver and residual
            regressor (paper Sec. 3.3).
        share: part of each person's frames that calibrates.
        test: people, their frames and where they look.
    """
    how, known = (
        how or SphereCalibrator(test.scenes.rig),
        max(3, round(share * test.each)),
    )
    looked, errors = looked_deg(test), []
    for first in range(0, test.people * test.each, test.each):
        mine = np.arange(first, first + known)
        others = np.arange(first + known, first + test.each)
        found = how.person(read[mine], looked[mine])(read[others])
        errors.append(angle_deg(found, looked[others]))
    return float(np.concatenate(errors).mean())


def gaze_errors(
    test: PeopleFrames,
    read: NetworkReadings,
    *,
    how: PersonCalibrator | None = None,
    share: float = 0.2,
) -> GazeErrors:
    """Gaze from what a network found in the frames.

    Args:
        how: people are calibrated; without it by pupil and slippage alone, as for the
            floor.
        share: part of each person's frames that calibrates.
        test: people, their frames and where they look.
        read: pupil, slippage and axis as a network reads them.

    Raises:
        TrainingError: a share that leaves less than 3 frames to calibrate or none to
            judge.
    """
    known = round(share * test.each)
    if not 3 <= known < test.each:
        raise TrainingError(
            f"{known} of {test.each} frames a person calibrate: need 3 or more, and some to judge"
        )
    camera = test.scenes.camera.pitch_um * test.scenes.camera.pixels / 32
    true = NetworkReadings(
        ((test.labels.pupil_px - 15.5) * camera * 1e-3).numpy(),
        (test.labels.slip_um * 1e-3).numpy(),
    )
    sphere = SphereCalibrator(test.scenes.rig)
    found, floor = (
        _angles(test, read, how or sphere, known),
        _angles(test, true, sphere, known),
    )
    return GazeErrors(*(math.degrees(v) for v in (*found, *floor)))


def _angles(
    test: PeopleFrames, read: NetworkReadings, how: PersonCalibrator, known: int
) -> tuple[float, float, float]:
    labels = test.labels
    pupil_mm, slip_mm = torch.from_numpy(read.pupil_mm), torch.from_numpy(read.slip_mm)
    own = (labels.centre_um - labels.slip_um) * 1e-3
    radius = (labels.pupil_um - labels.centre_um).norm(dim=1).mean().item() * 1e-3
    early = (torch.arange(len(own)) % test.each) < known
    mean = _fitted(
        test, own.mean(0), radius, torch.nonzero(early)[:, 0], pupil_mm, slip_mm
    )
    crowd = optical_axis(pupil_mm, -slip_mm, mean).direction
    looked = looked_deg(test)
    errors: list[list[Tensor]] = [[], [], []]
    for person in range(test.people):
        rows = torch.arange(person * test.each, (person + 1) * test.each)
        first, rest = rows[:known], rows[known:]
        errors[0].append(angle_rad(crowd[rest], labels.optic_axis[rest]))
        geometry = _fitted(test, own[rows[0]], radius, first, pupil_mm, slip_mm)
        axis = optical_axis(pupil_mm[rest], -slip_mm[rest], geometry).direction
        errors[1].append(angle_rad(axis, labels.optic_axis[rest]))
        mine, others = first.numpy(), rest.numpy()
        found = how.person(read[mine], looked[mine])(read[others])
        errors[2].append(torch.from_numpy(np.radians(angle_deg(found, looked[others]))))
    one, two, three = (float(torch.cat(e).mean()) for e in errors)
    return one, two, three


def _fitted(
    test: PeopleFrames,
    centre: Tensor,
    radius: float,
    rows: Tensor,
    pupil_mm: Tensor,
    slip_mm: Tensor,
) -> EyeGeometry:
    """An eye of this centre, and the radius that suits these frames best (the cornea
    magnifies).
    """
    distance = test.scenes.sensor_distance_um * 1e-3
    trials = [
        EyeGeometry(_place(centre), radius * f, distance)
        for f in np.linspace(0.9, 1.15, 26)
    ]
    truth = test.labels.optic_axis[rows]
    return min(
        trials,
        key=lambda g: float(
            angle_rad(
                optical_axis(pupil_mm[rows], -slip_mm[rows], g).direction, truth
            ).mean()
        ),
    )


def _place(centre: Tensor) -> tuple[float, float, float]:
    x, y, z = centre.tolist()
    return x, y, z
