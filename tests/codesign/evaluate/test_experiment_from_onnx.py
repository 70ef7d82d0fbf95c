"""A device that holds the exported graph, the people's file and a person's few points
answers as the experiment.
"""

from dataclasses import replace

import numpy as np
import pytest

from codesign.adapt import train as retraining
from codesign.commands import onnx_file
from codesign.evaluate import gaze_experiment as experiment
from codesign.evaluate.shown import ExperimentConfig
from codesign.eye import render
from codesign.gaze import NetworkReadings, angle_deg, people_file
from tests.codesign import made_lens as m

CONFIG = ExperimentConfig(
    subjects=2,
    people=3,
    grid=(4, 3),
    share=0.3,
    axial_mm=(-2.5, 3.0),
    lateral_mm=(1.5,),
)


@pytest.mark.parametrize(
    "pitch_um", [3.0, 3.13]
)  # 48 pixels, and 46.01 of an image: 47
def test_gaze_from_the_graph_is_that_of_the_experiment(tmp_path, pitch_um):
    """Frames as the sensor gives them, through onnxruntime, calibrated by what three
    other people tell.

    The graph's readings differ by 1e-4 mm and degrees, rounding; squares of them in
    units of their spread, which an
    untrained network makes small, raise that a hundred times in the gaze.
    """
    onnxruntime = pytest.importorskip("onnxruntime")
    m.finished_run(
        tmp_path / "run", m.TINY.replace("pitch_um = 3.0", f"pitch_um = {pitch_um}")
    )
    source = retraining.load_finished_run(tmp_path / "run")
    *_, (_, (found,)) = experiment.run_experiment([source], CONFIG)
    onnx_file.write_network_file(
        tmp_path / "n.onnx",
        source.run,
        source.run.trainer.model.net,
        source.architecture,
    )
    session = onnxruntime.InferenceSession(tmp_path / "n.onnx")
    imager, scenes = (
        experiment.prepare_run(source),
        source.run.scenes(experiment.EXPERIMENT),
    )
    trials, read = [], []
    for subject in range(CONFIG.subjects):
        states, trial = experiment.states_of(CONFIG, subject, scenes)
        made = render(states, rig=scenes.rig, camera=scenes.camera)
        seen = experiment.image_frames(
            source, made, imager, seed=experiment.NOISE + subject
        )
        levels = (300 + 41 * seen.frames.detach()).numpy()
        names = [value.name for value in session.get_outputs()]
        read.append(
            dict(zip(names, session.run(None, {"frames": levels}), strict=True))
        )
        trials.append(trial)
    told = NetworkReadings(
        *(
            np.concatenate([r[n] for r in read]).astype(float)
            for n in NetworkReadings.__slots__
        )
    )
    whole = experiment.join_subjects(trials)
    read_there = found.centre * source.run.window_um * 1e-3
    assert np.abs(told.pupil_mm - read_there).max() < 3e-4 * np.abs(read_there).max()
    assert (
        np.abs(told.slip_mm - found.slip_mm).max() < 3e-4 * np.abs(found.slip_mm).max()
    )
    people_file.save_people(tmp_path / "people.h5", found.how)
    how = people_file.load_people(tmp_path / "people.h5")
    gaze, judged = experiment.calibrated_gaze(told, whole, CONFIG, how)
    assert angle_deg(gaze, found.predicted_deg).max() < 0.05
    assert np.array_equal(judged, np.isfinite(found.gaze_deg))
    without, _ = experiment.calibrated_gaze(
        replace(told, axis_deg=told.axis_deg[::-1]), whole, CONFIG, how
    )
    assert (
        angle_deg(without, found.predicted_deg).max() > 0.5
    )  # the axis is what it is told by
