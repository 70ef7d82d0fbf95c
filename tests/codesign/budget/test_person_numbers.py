"""What no reader changes, by answers typed in; and pupils in mm whatever they are
rendered at.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from codesign.batches import EXPERIMENT, EyeScenes, SceneConfig
from codesign.budget import person
from codesign.evaluate import ExperimentConfig, gaze_experiment
from codesign.evaluate.shown import Trial
from codesign.eye import Rig

CONFIG = ExperimentConfig(
    subjects=2, grid=(3, 2), share=0.5, axial_mm=(-2.5, 3.0), lateral_mm=(1.5,), hidden=0, people=9,
    fixation_deg=0.6, seed=4,
)  # fmt: skip
SCENES = EyeScenes(SceneConfig(), 9.0, 2200.0, 0, EXPERIMENT)


def test_pupil_and_slippage_are_in_mm_whatever_the_labels_are_rendered_at(monkeypatch):
    """The pupil lies where its middle is projected through a pinhole 2.2 mm before the
    sensor, but for the cornea: it
    bends light, by a tenth of a millimetre at most of the 1.3 that pupils cover across.
    """
    whole = person.told(CONFIG, SCENES)
    assert len(whole) == 2 * 6 * 4
    monkeypatch.setattr(person, "LABELS", 97)
    again = person.told(CONFIG, SCENES)
    assert again.pupil_mm == pytest.approx(
        whole.pupil_mm, abs=2e-6
    )  # the same place on another grid
    start = 0
    for subject in range(2):
        states, trial = gaze_experiment.states_of(CONFIG, subject, SCENES)
        rows = slice(start, start + 24)
        assert whole.slip_mm[rows] == pytest.approx(trial.slip_mm, abs=1e-9)
        camera = person.Camera(64, 20.0)
        place = person.render(
            states, rig=SCENES.rig, camera=camera
        ).labels.pupil_um.numpy()
        want = 2.2 * place[:, :2] / place[:, 2:]
        assert whole.pupil_mm[rows] == pytest.approx(want, abs=0.1)
        assert np.ptp(want, axis=0).min() > 0.25
        start += 24


def test_a_subject_s_error_comes_first_and_fixation_adds_in_quadrature(monkeypatch):
    """Answers off by 0.8 and 1.7 degrees without and with scatter: 0.8 and 1.5. Frames
    that calibrated, and those of
    lateral slippage, err by 70 degrees and take no part."""
    kept = np.array([True, True, False, True, False, True])
    judged = np.array([True, True, True, True, False, True])
    axial = np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0])
    none = np.zeros((6, 2))
    trial = Trial(
        np.zeros(6),
        np.zeros(6),
        np.zeros(6),
        none,
        np.stack([axial, 0 * axial, np.ones(6)], 1),
    )
    asked = []

    def told(config, scenes):
        asked.append(
            (config.fixation_deg, scenes.rig.sensor_distance_um, scenes.stream)
        )
        return config.fixation_deg

    def calibrated(read, found, config, how):
        assert found is trial
        asked.append(
            (
                read,
                config.fixation_deg,
                how.hidden,
                how.seed,
                how.rig.sensor_distance_um,
            )
        )
        off = np.where(kept, 1.7 if read else 0.8, 70.0)
        return np.stack([off, 0 * off], 1), judged

    monkeypatch.setattr(person, "told", told)
    monkeypatch.setattr(gaze_experiment, "calibrated", calibrated)
    monkeypatch.setattr(gaze_experiment, "joined", lambda parts: trial)
    monkeypatch.setattr(
        gaze_experiment,
        "states_of",
        lambda config, subject, scenes: (None, asked.append(subject)),
    )
    subject, fixation = person.person(
        CONFIG, SimpleNamespace(sensor_distance_um=2222.0)
    )
    assert asked == [
        0,
        1,
        (0.0, 2222.0, EXPERIMENT),
        (0.0, 0.0, 0, 4, 2222.0),
        (0.6, 2222.0, EXPERIMENT),
        (0.6, 0.6, 0, 4, 2222.0),
    ]
    assert math.degrees(subject.gaze_rad) == pytest.approx(0.8, rel=1e-6)
    assert math.degrees(fixation.gaze_rad) == pytest.approx(1.5, rel=1e-6)
    assert (
        subject.method
        == "true pupil and slippage; 2 subjects, 50% of their stimuli calibrate"
    )
    assert fixation.method == "scatter of 0.6 deg about the stimulus"
    assert math.isnan(subject.psf)
    assert math.isnan(fixation.phase_rad)
    assert Rig().sensor_distance_um != 2222.0
