"""The virtual experiment part by part: who looks where in which state, who calibrates,
and what is asked of whom.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from codesign.batches import EyeScenes, SceneConfig
from codesign.evaluate import gaze_experiment as ge
from codesign.evaluate.shown import ExperimentConfig, Trial
from codesign.eye import POPULATION
from codesign.eye import population as eye
from codesign.gaze import Readings, Sphere, face_angles
from metalens.ground.errors import ConfigError
from metalens.image.sensor import Sensor

CONFIG = ExperimentConfig(
    subjects=3, grid=(3, 4), field_deg=(24.0, 18.0), axial_mm=(-2.5, 3.0), lateral_mm=(1.5,), share=0.34,
    fixation_deg=0.7, pupil_sd=0.08, seed=6, people=3,
)  # fmt: skip
SCENES = EyeScenes(SceneConfig(pixels=32, margin=4), 31.0, 2100.0, 3, 9)
RADIUS = list(POPULATION).index("pupil_radius_um")


def test_a_subject_looks_at_every_stimulus_in_every_state_with_its_own_scatter():
    """12 stimuli within 4 states; draws of the stream (seed, subject, 20): fixation,
    then pupil, then lids.
    """
    states, trial = ge.states_of(CONFIG, 2, SCENES)
    assert trial.subject.tolist() == [2] * 48
    assert trial.state.tolist() == [k for k in range(4) for _ in range(12)]
    assert trial.stimulus.tolist() == list(range(12)) * 4
    assert trial.stimulus_deg[4].tolist() == pytest.approx(
        [0.0, -3.0]
    )  # of columns -12, 0, 12 and rows -9, -3, 3, 9
    assert trial.slip_mm[12].tolist() == [1.5, 0, 0]
    assert states.slip_um[-1].tolist() == [0, 0, 3000.0]
    draw = np.random.default_rng([6, 2, 20])
    looks = trial.stimulus_deg + 0.7 * draw.standard_normal((48, 2))
    straight = replace(states, mount_rad=torch.zeros_like(states.mount_rad))
    seen = face_angles(
        eye.directions(straight, SCENES.rig)[1].numpy(), SCENES.rig.elevation_rad
    )
    assert seen == pytest.approx(looks, abs=1e-5)
    base = eye.draw(1, (6, 555, 2), motion=replace(SCENES.settings.motion, scale=0.0))
    pupil = base.traits[0, RADIUS].item() * np.clip(
        1 + 0.08 * draw.standard_normal(48), 0.7, 1.3
    )
    assert states.traits[:, RADIUS].numpy() == pytest.approx(pupil, rel=1e-12)
    others = [k for k in range(states.traits.shape[1]) if k != RADIUS]
    assert torch.equal(states.traits[:, others], base.traits[:, others].expand(48, -1))
    lids = np.clip(1 + 0.05 * draw.standard_normal(48), 0.8, 1.15)
    assert states.aperture.numpy() == pytest.approx(lids, rel=1e-12)
    assert not states.torsion_rad.any()
    assert torch.equal(states.mount_rad, base.mount_rad.expand_as(states.mount_rad))


def test_wide_scatter_of_pupil_and_lids_is_held_at_its_ends(monkeypatch):
    """Normal numbers of the frames' stream ten times as wide: every end is met."""
    plain = np.random.default_rng

    def wide(seed):
        made = plain(seed)
        if seed != [6, 0, 20]:
            return made
        return SimpleNamespace(
            standard_normal=lambda shape: 10 * made.standard_normal(shape)
        )

    monkeypatch.setattr(np.random, "default_rng", wide)
    states, _ = ge.states_of(replace(CONFIG, fixation_deg=0.0), 0, SCENES)
    base = (
        eye.draw(1, (6, 555, 0), motion=replace(SCENES.settings.motion, scale=0.0))
        .traits[0, RADIUS]
        .item()
    )
    share = states.traits[:, RADIUS].numpy() / base
    assert (share.min(), share.max()) == pytest.approx((0.7, 1.3), rel=1e-12)
    assert (float(states.aperture.min()), float(states.aperture.max())) == (0.8, 1.15)


def test_an_eye_at_the_lens_is_refused():
    """The eye stands some 21 mm before the lens: a micrometre is left, or nothing."""
    at = 1e-3 * SCENES.rig.distance_um
    assert ge.states_of(replace(CONFIG, axial_mm=(1e-3 - at,)), 0, SCENES)
    for slip in (-at, -at - 1.0):
        with pytest.raises(ConfigError, match=f"stands {at:g} mm before the lens"):
            ge.states_of(replace(CONFIG, axial_mm=(slip,)), 0, SCENES)


def trial_of(subjects, points=12, states=2):
    """Frames of subjects, one after the other: states outermost."""
    n = points * states
    stimulus = np.tile(np.tile(np.arange(points), states), len(subjects))
    return Trial(
        np.repeat(subjects, n), stimulus, np.tile(np.repeat(np.arange(states), points), len(subjects)),
        np.zeros((n * len(subjects), 2)), np.zeros((n * len(subjects), 3)),
    )  # fmt: skip


def test_a_share_of_the_stimuli_calibrates_in_every_state():
    """0.34 of 12 is 4 stimuli, 8 frames of 24 a subject, drawn by the stream (seed,
    subject, 21).
    """
    trial = trial_of([0, 5])
    known = ge.calibrating(trial, CONFIG)
    assert len(known) == 16
    for k, subject in enumerate((0, 5)):
        chosen = np.random.default_rng([6, subject, 21]).choice(12, 4, replace=False)
        rows = [
            24 * k + 12 * state + point
            for state in range(2)
            for point in sorted(chosen)
        ]
        assert known[8 * k : 8 * k + 8].tolist() == rows


def test_spread_stimuli_begin_with_one_that_is_drawn():
    trial = trial_of([5], states=1)
    known = ge.calibrating(trial, replace(CONFIG, points="spread"))
    first = int(np.random.default_rng([6, 5, 21]).integers(12))
    assert sorted(ge.spread(CONFIG.stimuli_deg, 4, first=first)) == known.tolist()


def test_each_next_place_is_the_farthest_from_all_before():
    """From (0, 0): (9, 0), then (4, 7) whose nearest is 8.06 away, then (2, -3) 3.6,
    before (8, 1) 1.4.
    """
    places = np.array([[0.0, 0.0], [8.0, 1.0], [2.0, -3.0], [4.0, 7.0], [9.0, 0.0]])
    assert ge.spread(places, 5, first=0).tolist() == [0, 4, 3, 2, 1]
    assert ge.spread(places, 1, first=3).tolist() == [3]
    assert ge.spread(places, 2, first=3).tolist() == [
        3,
        2,
    ]  # (2, -3): 10.2; (9, 0): 8.6


class Offset:
    """Calibrates by the mean of what is missed: a person is an offset."""

    def __init__(self):
        self.asked = []

    def person(self, read, gaze_deg):
        off = (gaze_deg - read.pupil_mm).mean(0)
        self.asked.append(len(read))
        return lambda seen: seen.pupil_mm + off


def test_every_subject_answers_by_its_own_calibration():
    """Subject 0 misses by (1, -2), 5 by (-3, 4): its own offset mends all its frames,
    those never seen as well.
    """
    trial, how = trial_of([0, 5]), Offset()
    gaze = np.random.default_rng(0).normal(size=(48, 2))
    off = np.where(trial.subject[:, None] == 0, [1.0, -2.0], [-3.0, 4.0])
    trial = Trial(trial.subject, trial.stimulus, trial.state, gaze, trial.slip_mm)
    told, judged = ge.calibrated(
        Readings(gaze - off, np.zeros((48, 3))), trial, CONFIG, how
    )
    assert told == pytest.approx(gaze, abs=1e-12)
    assert how.asked == [8, 8]
    assert judged.sum() == 32
    assert not judged[ge.calibrating(trial, CONFIG)].any()
    both = ge.joined([trial, trial])
    assert len(both.state) == 96
    assert both.stimulus_deg[50].tolist() == gaze[2].tolist()


def answers(n, axis=None):
    draw = torch.Generator().manual_seed(n)
    return SimpleNamespace(
        centre=torch.rand(n, 2, generator=draw), slip_mm=torch.rand(n, 3, generator=draw) - 0.4, axis=axis,
        iou=torch.rand(n, generator=draw),
    )  # fmt: skip


def source(window_um=2300.0):
    run = SimpleNamespace(window_um=window_um, scenes=lambda stream: SCENES)
    settings = SimpleNamespace(
        scenes=SimpleNamespace(slip_mm=(1.0, 2.0, 3.0), pixels=32, margin=4)
    )
    return SimpleNamespace(run=run, settings=settings, row={"mmacs": 7})


def test_answers_are_lengths_on_the_sensor_and_angles_of_the_face():
    """A window of 2.3 mm; axes that point straight at the camera are the face's
    elevation away from its normal.
    """
    toward = torch.tensor([[0.0, 0.0, -1.0]]).expand(5, 3)
    parts = [answers(3), answers(5)]
    read = ge.read_from(parts, source())
    assert read.pupil_mm == pytest.approx(
        2.3 * np.concatenate([p.centre.numpy() for p in parts]), rel=1e-6
    )
    assert read.slip_mm == pytest.approx(
        np.concatenate([p.slip_mm.numpy() for p in parts]), rel=1e-6
    )
    assert read.axis_deg is None
    turned = ge.read_from([answers(5, toward)], source())
    assert turned.axis_deg == pytest.approx(
        face_angles(toward.numpy().astype(float), SCENES.rig.elevation_rad), abs=1e-9
    )


def test_errors_are_of_frames_that_calibrated_nobody_and_beside_them_those_of_true_slippage(
    monkeypatch,
):
    """An answer that is off by 0.3 across where it is read, by 0.5 down where slippage
    is told.
    """
    _, trial = ge.states_of(CONFIG, 0, SCENES)
    parts = [answers(20), answers(28)]
    asked = []

    def calibrated(read, trial, config, how):
        told = np.array_equal(read.slip_mm, trial.slip_mm)
        asked.append((how, told))
        judged = np.ones(48, bool)
        judged[[3, 17]] = False
        return trial.stimulus_deg * 0 + ([0.0, 0.5] if told else [0.3, 0.0]), judged

    monkeypatch.setattr(ge, "calibrated", calibrated)
    flat = Trial(
        trial.subject,
        trial.stimulus,
        trial.state,
        0 * trial.stimulus_deg,
        trial.slip_mm,
    )
    made = ge._result("name", source(), parts, flat, CONFIG, "how")
    assert asked[0] == ("how", False)
    assert asked[1] == (Sphere(SCENES.rig, 10, 6), True)
    assert np.isnan(made.gaze_deg[[3, 17]]).all()
    assert np.isnan(made.told_deg[[3, 17]]).all()
    rest = np.delete(np.arange(48), [3, 17])
    assert made.gaze_deg[rest] == pytest.approx([0.3] * 46, rel=1e-6)
    assert made.told_deg[rest] == pytest.approx([0.5] * 46, rel=1e-6)
    assert (made.name, made.mmacs, made.reach_mm, made.how) == (
        "name",
        7.0,
        (1.0, 2.0, 3.0),
        "how",
    )
    assert made.iou == pytest.approx(np.concatenate([p.iou.numpy() for p in parts]))


def test_who_tells_an_axis_is_calibrated_by_people_on_a_stage_of_the_same_reach(
    monkeypatch,
):
    """Three people with at most 30 of their frames each; places between the ends of the
    axial and lateral ones, 0
    included; noise of twice the stream."""
    assert ge.EACH == 120  # of a person's frames, as many of them as there are
    monkeypatch.setattr(ge, "EACH", 30)
    shown, looked, learned = [], [], []
    whole = ge.states_of

    def states_of(config, subject, scenes):
        shown.append((subject, config.axial_mm, config.lateral_mm))
        return whole(config, subject, scenes)

    def through(source, made, imager, *, seed, snr_db):
        looked.append((made, imager, seed, snr_db))
        return made

    monkeypatch.setattr(ge, "states_of", states_of)
    monkeypatch.setattr(ge, "render", lambda states, rig, camera: len(states.slip_um))
    monkeypatch.setattr(ge, "through", through)
    monkeypatch.setattr(
        ge,
        "_answers",
        lambda source, seen: answers(seen, torch.eye(3)[:1].expand(seen, 3)),
    )
    monkeypatch.setattr(
        ge.shared, "learn", lambda *about: learned.append(about) or "people"
    )
    dim = replace(CONFIG, snr_db=15.0)
    assert ge.calibrator(source(), "imager", dim) == "people"
    assert [one for one, _, _ in shown] == [100_000, 100_001, 100_002]
    for person, axial, lateral in shown:
        draw = np.random.default_rng([6, person, 21])
        assert axial == pytest.approx(-2.5 + 5.5 * draw.random(2), rel=1e-12)
        assert lateral == pytest.approx(1.5 * draw.random(1), rel=1e-12)
    assert looked == [(30, "imager", 2_000_006 + k, 15.0) for k in range(3)]
    ((read, gaze, who),) = learned
    assert who.tolist() == [0] * 30 + [1] * 30 + [2] * 30
    assert len(read) == len(gaze) == 90
    shown.clear()
    monkeypatch.setattr(ge, "_answers", lambda source, seen: answers(seen))
    assert ge.calibrator(source(), "imager", CONFIG) == Sphere(SCENES.rig, 10, 6)
    assert len(shown) == 1


def checked(*, axial, held, sample=31.0):
    one = source()
    one.settings.optics = SimpleNamespace(
        sample_um=sample, sensor_distance_mm=2.1, depths_mm=held
    )
    ge._check([one, one], replace(CONFIG, axial_mm=axial))


def test_eyes_stay_within_the_depths_of_the_images():
    at = 1e-3 * SCENES.rig.distance_um
    checked(axial=(-2.5, 3.0), held=(at - 2.5, at + 3.0))
    for held in ((at - 2.4, at + 3.0), (at - 2.5, at + 2.9)):
        with pytest.raises(ConfigError, match="let them slip less, or train on more"):
            checked(axial=(-2.5, 3.0), held=held)
    with pytest.raises(ConfigError, match="no run to evaluate"):
        ge._check([], CONFIG)


def test_subjects_are_seen_one_by_one_and_results_come_with_the_last(monkeypatch):
    """Two runs, three subjects; noise of each subject's own; displacements in mm."""
    asked = []
    monkeypatch.setattr(ge, "_check", lambda sources, config: None)
    monkeypatch.setattr(
        ge, "ready", lambda source, *, image: f"imager of {source.name}, {image}"
    )
    monkeypatch.setattr(
        ge, "calibrator", lambda source, imager, config: f"how of {source.name}"
    )
    monkeypatch.setattr(
        ge, "states_of", lambda config, subject, scenes: (subject, f"trial {subject}")
    )

    def render(states, *, rig, camera):
        return SimpleNamespace(
            labels=SimpleNamespace(
                shift_um=torch.full((2, 3), 1000.0 * (states + 1), dtype=torch.float64)
            )
        )

    def through(source, made, imager, *, seed, snr_db):
        asked.append((source.name, imager, seed, snr_db))
        return seed

    def result(label, source, kept, whole, config, how):
        made = ge.Result(
            label, 1.0, whole, None, None, None, None, None, None, (0.0, 0.0, 0.0), how
        )
        return replace(made, slip_mm=kept)

    monkeypatch.setattr(ge, "render", render)
    monkeypatch.setattr(ge, "through", through)
    monkeypatch.setattr(ge, "_answers", lambda source, seen: seen)
    monkeypatch.setattr(ge, "joined", list)
    monkeypatch.setattr(ge, "_result", result)
    monkeypatch.setattr(ge.formed, "above", lambda settings, image: f"above of {image}")

    def run(name):
        one = source()
        one.name, one.run.trainer = name, SimpleNamespace(optics="optics")
        return one

    dim = replace(CONFIG, snr_db=15.0, image="trained")
    *before, (done, results) = ge.experiment([run("a"), run("b")], dim)
    assert before == [(1, []), (2, [])]
    assert done == 3
    seeds = [1_000_003, 1_000_004, 1_000_005]
    assert asked == [
        (name, f"imager of {name}, trained", seed, 15.0)
        for seed in seeds
        for name in "ab"
    ]
    assert [one.name for one in results] == ["run 1", "run 2"]
    assert [one.slip_mm for one in results] == [seeds, seeds]
    assert results[1].how == "how of b"
    assert results[1].above == "above of imager of b, trained"
    assert results[0].trial == ["trial 0", "trial 1", "trial 2"]
    assert results[0].visible_mm[:, 1].tolist() == pytest.approx(
        [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    )
    (*_, (_, named)) = ge.experiment(
        [run("a"), run("b")], dim, names=("mine", "theirs")
    )
    assert [one.name for one in named] == ["mine", "theirs"]


@pytest.mark.parametrize(("batches", "measured"), [(3, 3), (8, 8), (11, 8)])
@pytest.mark.parametrize("made", [None, "made lens"])
def test_a_run_is_imaged_with_the_margin_on_either_side(
    monkeypatch, batches, measured, made
):
    """32 and twice 4 samples; statistics of eight batches at most, of a retraining
    those of its own lenses.
    """
    asked = []
    one = source()
    one.made, one.architecture, one.settings.test_batches = made, "member", batches
    model = SimpleNamespace(net="net", coefficients_rad="phase")
    one.run.trainer = SimpleNamespace(
        optics=ge.ExperimentConfig(image="trained"), model=model, scenes="scenes"
    )
    monkeypatch.setattr(ge.assess, "frames", lambda trainer, scenes, count: count)
    monkeypatch.setattr(ge.assess, "parts", lambda seen: f"{seen} parts")
    monkeypatch.setattr(ge, "recalibrate", lambda *about: asked.append(about))
    monkeypatch.setattr(
        ge.retraining, "settle", lambda trainer, source: asked.append("settled")
    )
    monkeypatch.setattr(
        ge.formed,
        "imager",
        lambda seen, phase, size, *, margin, made: (
            seen.image,
            phase,
            size,
            margin,
            made,
        ),
    )
    assert ge.ready(one) == ("true", "phase", 40, 4, made)
    assert asked == (["settled"] if made else [("net", "member", f"{measured} parts")])
    assert ge.ready(one, image="trained")[0] == "trained"


@pytest.mark.parametrize("snr_db", [None, 15.0])
def test_frames_go_through_lens_and_sensor_with_noise_of_their_seed(
    monkeypatch, snr_db
):
    """The dimmed sensor keeps the pitch that training moves; the mask is cut to what
    the pixels see.
    """
    asked = []
    one = source()
    sensor = Sensor(7.0)
    pitch = torch.tensor(5.5)
    one.run.trainer = SimpleNamespace(
        sensor=sensor, model=SimpleNamespace(pitch_um=pitch), optics=SimpleNamespace(sample_um=3.0),
        inner=SimpleNamespace(batch=12),
    )  # fmt: skip
    light = torch.full((2, 24, 24), 0.3)
    batch = SimpleNamespace(frames="frames", mask="mask", slip_mm="slip")
    monkeypatch.setattr(
        ge, "as_batch", lambda made, margin: batch if margin == 4 else None
    )
    monkeypatch.setattr(
        ge,
        "irradiance",
        lambda frames, prepared, *, margin: light if margin == 4 else None,
    )

    def low(at, mean, *, snr_db):
        asked.append((at.pitch_um, mean, snr_db))
        return at

    def read_out(light, sample_um, pitch, sensor, *, generator, quiet):
        asked.append(
            (sample_um, float(pitch), sensor.pitch_um, generator.initial_seed(), quiet)
        )
        return "pixels"

    monkeypatch.setattr(ge, "low_snr", low)
    monkeypatch.setattr(ge, "read_out", read_out)
    monkeypatch.setattr(ge.losses, "framed", lambda mask, wide: (mask, wide))
    seen = ge.through(one, "made", "imager", seed=77, snr_db=snr_db, quiet=True)
    dimmed = [(5.5, pytest.approx(0.3), 15.0)] if snr_db else []
    assert asked == [*dimmed, (3.0, 5.5, 7.0, 77, True)]
    assert (seen.frames, seen.batch) == ("pixels", 12)
    wide = ge.frame_wide(24, 3.0, 5.5)
    assert seen.mask == ("mask", wide)
    assert (seen.slip_mm, seen.wide) == ("slip", wide)
