"""The virtual experiment: geometry of stimuli and slippage, a regressor that is fitted
honestly, and its command.
"""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.adapt import source as finished
from codesign.batches import EyeScenes, SceneConfig
from codesign.evaluate import gaze_experiment as experiment
from codesign.evaluate.gaze_experiment import ExperimentTrials
from codesign.eye import population as eye
from codesign.eye.population import CameraRig
from codesign.gaze import personal, shared
from codesign.gaze.readings import NetworkReadings
from codesign.settings import ExperimentConfig
from metalens.cli import main
from metalens.core.errors import ConfigError
from tests.codesign import made_lens as m
from tests.command_line import call
from tests.referees.seen_pupil import pupil_of

SMALL = ExperimentConfig(subjects=2, grid=(4, 3), share=0.3, fixation_deg=0.0, people=9)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("experiment")
    m.finished_run(path / "run")
    return path


def _trial(config, subjects):
    stimuli, slips = config.stimuli_deg, config.slips_mm
    state, point = (
        g.ravel()
        for g in np.meshgrid(
            np.arange(len(slips)), np.arange(len(stimuli)), indexing="ij"
        )
    )
    one = [
        ExperimentTrials(
            np.full(len(state), s), point, state, stimuli[point], slips[state]
        )
        for s in range(subjects)
    ]
    return ExperimentTrials(
        *(
            np.concatenate([getattr(t, f) for t in one])
            for f in ExperimentTrials.__slots__
        )
    )


def test_subjects_look_at_the_stimuli_and_slip_as_told(folder):
    scenes = finished.load_finished_run(folder / "run").run.scenes(9)
    states, trial = experiment.draw_trials(SMALL, 1, scenes)
    assert np.allclose(states.slip_um.numpy() * 1e-3, trial.slip_mm)
    assert np.ptp(states.trait("size").numpy()) == 0  # one subject
    assert np.ptp(states.trait("pupil_radius_um").numpy()) > 0  # whose pupil moves
    still = replace(states, mount_rad=states.mount_rad * 0)
    _, visual = eye.eye_axes(still, scenes.rig)
    face = eye._face(scenes.rig, still)
    right, down, out = ((visual * face[i]).sum(1).numpy() for i in range(3))
    x, y = np.radians(trial.stimulus_deg).T
    wanted = np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)
    for found, want in zip((right, down, out), wanted, strict=True):
        # kappa added to the gaze alone leaves 0.4 degrees, 7e-3
        assert np.abs(found - want).max() < 1e-6
    other, _ = experiment.draw_trials(SMALL, 2, scenes)
    assert float(other.trait("size")[0]) != float(states.trait("size")[0])


def test_perfect_reading_leaves_little_gaze_error_and_slippage_unseen_leaves_much():
    """The mean eye, a sphere: the pupil's image moves with gaze and slip; only a slip
    that is read tells them apart.
    """
    config, rig = ExperimentConfig(subjects=2), CameraRig()
    trial = _trial(config, 2)
    person = personal.SphereCalibrator(rig, hidden=0).person(
        NetworkReadings(np.zeros((3, 2)), np.zeros((3, 3))), np.zeros((3, 2))
    )
    s, c = np.sin(rig.elevation_rad), np.cos(rig.elevation_rad)
    axes = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, -s, -c]])
    direction = torch.from_numpy(
        personal.gaze_direction(np.radians(trial.stimulus_deg)) @ axes
    )
    pupil = pupil_of(direction, torch.from_numpy(-trial.slip_mm), person.mean).numpy()
    for slip, low, high in ((trial.slip_mm, 0.0, 0.5), (0 * trial.slip_mm, 1.5, 20.0)):
        predicted, judged = experiment.calibrated_gaze(
            NetworkReadings(pupil, slip), trial, config, personal.SphereCalibrator(rig)
        )
        error = personal.angle_deg(predicted, trial.stimulus_deg)[judged]
        assert low <= error.mean() < high
    assert judged.mean() == pytest.approx(39 / 49)
    assert all(
        len(np.unique(trial.stimulus[~judged & (trial.subject == s)])) == 10
        for s in (0, 1)
    )


@pytest.mark.parametrize(
    "change", [{"subjects": 0}, {"grid": (1, 7)}, {"share": 0.01}, {"share": 1.0}]
)
def test_impossible_experiments_are_refused(change):
    with pytest.raises(ConfigError, match="subject"):
        replace(SMALL, **change)


def test_an_eye_that_would_slip_into_the_lens_is_refused():
    scenes = EyeScenes(SceneConfig(), 9.0, 2000.0, 0)
    with pytest.raises(
        ConfigError, match=r"axial_mm \(-21.0,\): the eye stands 21 mm before the lens"
    ):
        experiment.draw_trials(replace(SMALL, axial_mm=(-21.0,)), 0, scenes)


@pytest.mark.parametrize(
    ("axial", "words"), [((-9.5,), "11.5 to 21 mm"), ((2.5, 19.5), "21 to 40.5 mm")]
)
def test_eyes_that_slip_to_where_images_hold_no_depth_are_refused(folder, axial, words):
    source = finished.load_finished_run(folder / "run")
    with pytest.raises(
        ConfigError,
        match=rf"{words} before the lens, where the run's images hold optics.depths_mm",
    ):
        next(experiment.run_experiment([source], replace(SMALL, axial_mm=axial)))


def test_the_command_writes_numbers_and_figures_once(folder, capsys):
    run, out = str(folder / "run"), folder / "out"
    words = [
        "evaluate",
        "experiment",
        run,
        run,
        "-o",
        str(out),
        "--subjects",
        "2",
        "--grid",
        "3",
        "2",
        "--share",
        "0.5",
        "--people",
        "3",
    ]
    assert call(*words, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert [r["name"] for r in told["runs"]] == ["run 1", "run 2"]
    # the same run twice, the same noise
    assert all(r["ratio"] == 1.0 for r in told["ratios"])
    assert told["beyond_training_mm"]["run 1"] == [
        [-5, 0, 0],
        [-2.5, 0, 0],
        [0, 0, -5],
        [0, 0, 5],
    ]
    assert "(0, 0, 5) mm lie outside its training" in (out / "report.html").read_text()
    assert {p.name for p in out.iterdir()} >= {
        "experiment.json",
        "ambiguity.png",
        "errors.png",
    }
    one, two = (shared.load_people(out / f"people_{n}.h5") for n in (1, 2))
    assert np.array_equal(one.model.mean, two.model.mean)  # the same run twice
    sphere = [*words[:3], "-o", f"{folder}/sphere", *words[6:]]
    assert call(*sphere, "--calibrator", "sphere", "--json") == 0
    (by_sphere,) = json.loads(capsys.readouterr().out)["runs"]
    assert by_sphere["gaze_axial_deg"] == told["runs"][0]["sphere_gaze_axial_deg"]
    assert by_sphere["gaze_axial_deg"] != told["runs"][0]["gaze_axial_deg"]
    assert main(words) == 2
    assert "give --force" in capsys.readouterr().err
    assert call(*words[:4], f"-o {folder}/twins --names a a") == 2
    assert "names a, a: two are alike" in capsys.readouterr().err
    assert call(f"evaluate experiment {folder} -o {folder}/other") == 2
    assert "is no run folder" in capsys.readouterr().err


def test_an_axis_that_is_read_becomes_gaze_by_what_people_share():
    """All misread the axis by 0.1 deg/mm² of slippage: others tell it, where sphere and
    pupil are told nothing.
    """
    rng, config = np.random.default_rng(3), ExperimentConfig(subjects=2)
    trial = _trial(config, 2)

    def misread(gaze, slip, kappa):
        return (
            gaze + kappa + 0.1 * slip[:, [0]] * slip[:, [2]] + 0.1 * slip[:, [2]] ** 2
        )

    person = np.repeat(np.arange(12), 20)
    gaze = rng.uniform(-17, 17, (240, 2))
    slip = rng.uniform(-5, 5, (240, 3))
    pupil = rng.normal(0, 0.3, (240, 2))
    theirs = NetworkReadings(
        pupil, slip, misread(gaze, slip, rng.normal(5, 2, (12, 2))[person])
    )
    people = shared.learn_population(theirs, gaze, person)
    axis = misread(
        trial.stimulus_deg,
        trial.slip_mm,
        np.array([[3.0, -1.0], [7.0, 4.0]])[trial.subject],
    )
    read = NetworkReadings(np.zeros((len(axis), 2)), trial.slip_mm, axis)
    predicted, judged = experiment.calibrated_gaze(read, trial, config, people)
    assert personal.angle_deg(predicted, trial.stimulus_deg)[judged].mean() < 0.05
    alone, _ = experiment.calibrated_gaze(
        read, trial, config, personal.SphereCalibrator(CameraRig(), hidden=0)
    )
    # the pupil tells nothing here
    assert personal.angle_deg(alone, trial.stimulus_deg)[judged].mean() > 5


def test_people_who_calibrated_before_are_read_through_the_run_s_own_lens(folder):
    source = finished.load_finished_run(folder / "run")
    config = replace(SMALL, people=2)
    imager = experiment.prepare_run(source)
    found, again, dim = (
        experiment.run_calibrator(source, imager, c, experiment.experiment_sensors([source], c)[0])
        for c in (config, config, replace(config, snr_db=3.0))
    )  # fmt: skip
    assert found.model.mean.shape == (36, 2)
    assert np.isfinite(found.model.mean).all()
    assert np.array_equal(found.model.mean, again.model.mean)
    # in the light of the experiment
    assert not np.allclose(found.middle, dim.middle, rtol=1e-3)
