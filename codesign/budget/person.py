"""What no reader changes: the person who is calibrated, and where a person looks who is
told to look somewhere.
"""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from codesign.batches import EXPERIMENT, EyeScenes, SceneConfig
from codesign.budget.entry import NONE, BudgetEntry, quadrature_difference
from codesign.evaluate import AXIAL, ExperimentConfig, gaze_experiment
from codesign.eye import CameraRig, PinholeCamera, render
from codesign.gaze import NetworkReadings, SphereCalibrator, angle_deg

LABELS = 64  # pixels of renderings whose labels alone are wanted
WIDTH_UM = 1152.0  # of the sensor


def known_readings(config: ExperimentConfig, scenes: EyeScenes) -> NetworkReadings:
    """Pupil and slippage of the experiment's frames as they are."""
    pupil, slip = [], []
    pitch = scenes.camera.pitch_um * scenes.camera.pixels / LABELS
    for subject in range(config.subjects):
        states, _ = gaze_experiment.states_of(config, subject, scenes)
        labels = render(
            states, rig=scenes.rig, camera=PinholeCamera(LABELS, pitch)
        ).labels
        pupil.append((labels.pupil_px - (LABELS - 1) / 2) * (pitch * 1e-3))
        slip.append(labels.slip_um * 1e-3)
    return NetworkReadings(
        torch.cat(pupil).double().numpy(), torch.cat(slip).double().numpy()
    )


def subject_entries(config: ExperimentConfig, rig: CameraRig) -> Iterator[BudgetEntry]:
    """Subject with calibration, and fixation: the error of answers that are given the
    true pupil and slippage.
    """
    scenes = EyeScenes(
        SceneConfig(),
        WIDTH_UM / SceneConfig().pixels,
        rig.sensor_distance_um,
        0,
        EXPERIMENT,
    )
    trial = gaze_experiment.join_subjects(
        [
            gaze_experiment.states_of(config, s, scenes)[1]
            for s in range(config.subjects)
        ]
    )
    answers = []
    for one in (replace(config, fixation_deg=0.0), config):
        how = SphereCalibrator(scenes.rig, one.hidden, one.seed)
        answer, judged = gaze_experiment.calibrated_gaze(
            known_readings(one, scenes), trial, one, how
        )
        answers.append(answer)
    kept = judged & trial.group(AXIAL)
    alone, whole = (
        math.radians(float(np.mean(angle_deg(a, trial.stimulus_deg)[kept])))
        for a in answers
    )
    people = (
        f"{config.subjects} subjects, {config.share:.0%} of their stimuli calibrate"
    )
    yield BudgetEntry(
        "subject and calibration",
        NONE,
        NONE,
        alone,
        f"true pupil and slippage; {people}",
    )
    said = f"scatter of {config.fixation_deg:g} deg about the stimulus"
    yield BudgetEntry("fixation", NONE, NONE, quadrature_difference(whole, alone), said)
