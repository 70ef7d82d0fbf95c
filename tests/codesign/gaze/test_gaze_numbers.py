"""Errors of gaze and the fit of a person, number by number: eyes that are spheres,
least squares typed in again.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from codesign.batches.scenes import TEST, EyeScenes, SceneConfig
from codesign.eye.population import Rig
from codesign.gaze import bench, personal
from codesign.gaze.axis import EyeGeometry, optical_axis
from codesign.gaze.readings import Readings
from metalens.ground.errors import TrainingError
from tests.referees.seen_pupil import pupil_of

EACH, KNOWN, SENSOR_UM = 9, 3, 1700.0
CENTRES = np.array([[1.1, -13.2, 26.0], [0.3, -14.9, 28.5]])  # mm, of two people
RADIUS = 9.4


def group():
    """Two people of ``EACH`` frames each with eyes that are spheres: labels in um, 32
    pixels of 30 um.
    """
    rng = np.random.default_rng(5)
    yaw, pitch = rng.uniform(-0.3, 0.3, (2, 2 * EACH))
    look = np.stack(
        [np.sin(yaw) * np.cos(pitch), np.sin(pitch), -np.cos(yaw) * np.cos(pitch)], 1
    )
    slip = rng.uniform(-1.5, 1.5, (2 * EACH, 3))
    own = np.repeat(CENTRES, EACH, 0)
    kappa = rng.normal(0, 0.03, look.shape)
    visual = (look + kappa) / np.linalg.norm(look + kappa, axis=1, keepdims=True)
    pupil = own + slip + RADIUS * look
    seen = pupil[:, :2] / pupil[:, 2:] * SENSOR_UM
    labels = SimpleNamespace(
        centre_um=torch.from_numpy(1e3 * (own + slip)),
        slip_um=torch.from_numpy(1e3 * slip),
        pupil_um=torch.from_numpy(1e3 * pupil),
        optic_axis=torch.from_numpy(look),
        visual_axis=torch.from_numpy(visual),
        pupil_px=torch.from_numpy(seen / 30.0 + 15.5),
    )
    scenes = SimpleNamespace(
        settings=SimpleNamespace(pixels=53),
        sample_um=17.0,
        sensor_distance_um=SENSOR_UM,
        camera=SimpleNamespace(pitch_um=12.0, pixels=80),
        rig=Rig(elevation_rad=0.31),
    )
    test = SimpleNamespace(scenes=scenes, labels=labels, people=2, each=EACH)
    return test, torch.from_numpy(1e-3 * seen), torch.from_numpy(slip)


def degrees_between(a, b):
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_places_go_to_mm_by_the_frame_s_edge_and_the_labels_pixel(monkeypatch):
    """53 samples of 17 um a frame; labels in pixels of 12 x 80 / 32 = 30 um from 15.5;
    the floor is the truth's.
    """
    test, pupil, slip = group()
    asked = []

    def angles(test, read, how, known):
        asked.append((read.pupil_mm, read.slip_mm, known))
        return tuple(
            math.radians(v)
            for v in ((1.0, 2.0, 3.0) if len(asked) == 1 else (0.4, 0.5, 0.6))
        )

    monkeypatch.setattr(bench, "_angles", angles)
    centre = torch.linspace(-0.2, 0.3, 36).reshape(18, 2)
    read = bench.read_of(test, centre, (slip + 0.25).float())
    got = bench.gaze_errors(test, read, share=0.3)
    (found, off, known), (true, real, again) = asked
    assert (known, again) == (3, 3)  # 0.3 of 9 frames: 2.7
    assert found == pytest.approx(centre.double().numpy() * 53 * 17e-3, rel=1e-6)
    assert off == pytest.approx(slip.numpy() + 0.25, rel=1e-6)
    assert true == pytest.approx(pupil.numpy(), rel=1e-9)
    assert real == pytest.approx(slip.numpy(), rel=1e-9)
    assert [got.population_deg, got.anatomy_deg, got.personal_deg] == pytest.approx(
        [1.0, 2.0, 3.0]
    )
    assert [
        got.population_floor_deg,
        got.anatomy_floor_deg,
        got.personal_floor_deg,
    ] == pytest.approx([0.4, 0.5, 0.6])
    with pytest.raises(TrainingError, match="2 of 9"):
        bench.gaze_errors(test, read, share=0.25)
    with pytest.raises(TrainingError, match="9 of 9"):
        bench.gaze_errors(test, read, share=1.0)


def test_angles_are_means_over_the_frames_that_no_calibration_saw():
    test, pupil, slip = group()
    labels, later = test.labels, (np.arange(2 * EACH) % EACH) >= KNOWN
    fits = []

    def calibrated(read, gaze_deg):
        fits.append((read.pupil_mm, read.slip_mm, gaze_deg))
        return lambda later: np.tile([4.0, -1.5], (len(later), 1))

    read, how = (
        Readings(pupil.numpy(), slip.numpy()),
        SimpleNamespace(person=calibrated),
    )
    crowd, own, taught = (
        math.degrees(v) for v in bench._angles(test, read, how, KNOWN)
    )
    assert (
        own < 1e-6
    )  # a sphere of the person's centre and of 1.00 of the mean radius gives every gaze
    # the mean eye, of the radius between 0.9 and 1.15 of the mean one that suits the
    # calibrating frames best
    mean = tuple(CENTRES.mean(0))
    best = []
    for f in np.linspace(0.9, 1.15, 26):
        axis = optical_axis(
            pupil, -slip, EyeGeometry(mean, RADIUS * f, SENSOR_UM * 1e-3)
        ).direction.numpy()
        off = degrees_between(axis, labels.optic_axis.numpy())
        best.append((off[~later].mean(), off[later].mean()))
    assert crowd == pytest.approx(min(best)[1], rel=1e-6)
    assert crowd > 1
    looked = personal.face_angles(labels.visual_axis.numpy(), 0.31)
    told = personal.direction(np.radians(np.tile([4.0, -1.5], (2 * EACH, 1))))
    off = degrees_between(told, personal.direction(np.radians(looked)))
    assert taught == pytest.approx(off[later].mean(), rel=1e-6)
    for person, (p, s, g) in enumerate(fits):
        rows = slice(person * EACH, person * EACH + KNOWN)
        assert (
            np.array_equal(p, pupil[rows].numpy()),
            np.array_equal(s, slip[rows].numpy()),
        ) == (True, True)
        assert g == pytest.approx(looked[rows])


def noisy():
    """(pupil, slip, gaze) of one person beside the mean with a turn and a roll, read
    with 0.8 degrees of noise.
    """
    rig, rng = Rig(), np.random.default_rng(2)
    mean = personal.mean_geometry(rig)
    yaw, pitch = rng.uniform(-0.25, 0.25, (2, 14))
    s, c = math.sin(rig.elevation_rad), math.cos(rig.elevation_rad)
    face = personal.direction(np.stack([yaw, pitch], 1))
    look = torch.from_numpy(
        face @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, -s, -c]])
    )
    x, y, z = np.add(mean.centre_mm, (0.9, -0.7, 1.2))
    eye = EyeGeometry((x, y, z), mean.radius_mm + 0.5, mean.sensor_distance_mm)
    slip = rng.uniform(-2, 2, (14, 3))
    pupil = pupil_of(look, torch.from_numpy(-slip), eye).numpy()
    gaze = (
        np.degrees(np.stack([yaw, pitch], 1))
        - (4.0, -2.0)
        + rng.normal(0, 0.8, (14, 2))
    )
    return rig, pupil, slip, gaze


@pytest.mark.parametrize("clean", [False, True])
def test_a_person_is_the_least_of_misses_over_their_scatter_and_of_what_people_differ_by(
    clean,
):
    """Misses over 1 degree first, then over sqrt(sum / (2 n - 7)) of what that leaves,
    0.3 degrees at least.
    """
    rig, pupil, slip, gaze = noisy()
    mean = personal.mean_geometry(rig)
    if clean:
        gaze = np.add(
            personal.PersonalGaze(mean, rig.elevation_rad, np.zeros(7), None).sphere(
                pupil, slip
            ),
            [2.0, -1.0],
        )
    differ = np.array([1.0, 1.0, 1.0, 0.6, 5.0, 5.0, 0.05])

    def miss(own):
        return (
            personal.PersonalGaze(mean, rig.elevation_rad, own, None).sphere(
                pupil, slip
            )
            - gaze
        ).ravel()

    def least(reading):
        made = least_squares(
            lambda own: np.concatenate([miss(own) / reading, own / differ]),
            np.zeros(7),
            x_scale=differ,
        )
        return made.x

    left = math.sqrt((miss(least(1.0)) ** 2).sum() / (28 - 7))
    assert (left < 0.3) == clean
    person = personal.fit(pupil, slip, gaze, rig=rig, hidden=0)
    assert person.rest is None
    # both stop where the sum falls by less than 1e-8 of itself: 1e-4 of its root a
    # parameter
    assert person.own / differ == pytest.approx(
        least(max(left, 0.3)) / differ, abs=2e-3
    )
    assert np.abs(person.own).min() > (0 if clean else 1e-3)


def test_a_sphere_s_gaze_is_turned_by_its_angles_and_rolled():
    rig = Rig()
    mean = personal.mean_geometry(rig)
    own = np.array([0.7, -0.3, 1.1, 0.4, 3.0, -2.0, 0.06])
    pupil, slip = (
        np.array([[0.1, -0.8], [-0.2, -1.1]]),
        np.array([[0.5, 0.2, -1.0], [0.0, -0.4, 0.8]]),
    )
    x, y, z = np.asarray(mean.centre_mm) + own[:3]
    eye = EyeGeometry((x, y, z), mean.radius_mm + 0.4, mean.sensor_distance_mm)
    ray = optical_axis(
        torch.from_numpy(pupil), torch.from_numpy(-slip), eye
    ).direction.numpy()
    across, down = np.add(personal.face_angles(ray, rig.elevation_rad), [3.0, -2.0]).T
    c, s = math.cos(0.06), math.sin(0.06)
    want = np.stack([c * across - s * down, s * across + c * down], 1)
    got = personal.PersonalGaze(mean, rig.elevation_rad, own, None)
    assert got.sphere(pupil, slip) == pytest.approx(want, rel=1e-12)
    rest = personal.PersonalGaze(
        mean, rig.elevation_rad, own, lambda f: 0.1 * f[:, [2, 4]] + 0.01 * f[:, :2]
    )
    assert rest(Readings(pupil, slip)) == pytest.approx(
        want + 0.1 * slip[:, [0, 2]] + 0.01 * want, rel=1e-12
    )


def test_the_penalty_is_the_one_that_foretells_points_left_out(monkeypatch):
    """Stimuli in turn in four folds, frames of one together; told by a stand-in that
    errs least at 0.1.
    """
    gaze = np.array(
        [
            [3.0, 1.0],
            [0.0, 2.0],
            [3.0, 1.0],
            [5.0, 0.0],
            [1.0, 1.0],
            [7.0, 2.0],
            [0.0, 2.0],
        ]
    )
    # in order: (0, 2) (1, 1) (3, 1) (5, 0) (7, 2): folds 0 1 2 3 0
    fold = np.array([2, 0, 2, 3, 1, 0, 0])
    features, missed = (
        np.arange(14.0).reshape(7, 2),
        np.full((7, 2), 2.0) + np.arange(7)[:, None],
    )
    asked, tell = [], {0.01: 1.9, 0.1: 3.5, 1.0: 9.0, 10.0: 20.0}

    def fit(seen, target, *, hidden, penalty, seed, steps):
        asked.append((seen, target, hidden, penalty, seed, steps))
        return lambda f: np.full((len(f), 2), tell[penalty])

    monkeypatch.setattr(personal.regressor, "fit", fit)
    sums = {p: ((missed - v) ** 2).sum() for p, v in tell.items()}
    want = min(sums, key=sums.get)
    assert want == 0.1
    assert personal._penalty(features, missed, gaze, hidden=4, seed=3) == want
    assert len(asked) == 16
    assert {one[2] for one in asked} == {4}
    assert {one[4:] for one in asked} == {(3, 40)}
    for (seen, target, _, penalty, _, _), (number, of) in zip(
        asked, [(n, p) for p in (0.01, 0.1, 1.0, 10.0) for n in range(4)], strict=True
    ):
        assert penalty == of
        assert np.array_equal(seen, features[fold != number])
        assert np.array_equal(target, missed[fold != number])


@pytest.mark.parametrize(("count", "fitted"), [(3, 0), (4, 4)])
def test_folds_that_leave_fewer_than_three_points_are_not_tried(
    monkeypatch, count, fitted
):
    asked = []

    def fit(seen, *_, **__):
        asked.append(len(seen))
        return lambda f: np.zeros((len(f), 2))

    monkeypatch.setattr(personal.regressor, "fit", fit)
    gaze = np.stack([np.arange(count), np.zeros(count)], 1)
    personal._penalty(np.zeros((count, 5)), np.ones((count, 2)), gaze, hidden=2, seed=0)
    assert asked == [3] * (4 * fitted)


def test_directions_and_angles_of_the_face():
    """Across and down of 0.5 and -0.3 rad: right sin x cos y, down sin y, out cos x cos
    y; back through the camera.
    """
    angles = np.array([[0.5, -0.3], [-0.2, 0.7]])
    got = personal.direction(angles)
    want = [
        [math.sin(x) * math.cos(y), math.sin(y), math.cos(x) * math.cos(y)]
        for x, y in angles
    ]
    assert got == pytest.approx(np.array(want), rel=1e-12)
    s, c = math.sin(0.31), math.cos(0.31)
    camera = got @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, -s, -c]])
    assert personal.face_angles(camera, 0.31) == pytest.approx(
        np.degrees(angles), rel=1e-9
    )
    assert personal.angle_deg(
        np.degrees(angles[:1]), np.degrees(angles[1:])
    ) == pytest.approx(degrees_between(got[:1], got[1:]), rel=1e-9)


def test_people_keep_their_eyes_and_move_anew():
    """Three people of four frames: traits of each, twelve gazes, frames of a step one
    after the other.
    """
    scenes = EyeScenes(SceneConfig(pixels=32, margin=4), 36.0, 2000.0, 0, TEST)
    group = bench.people(scenes, 3, 4, seed=5)
    assert (len(group.states), group.each, group.people) == (12, 4, 3)
    for one in (group.states.traits, group.states.mount_rad):
        rows = one.reshape(3, 4, -1)
        assert bool((rows == rows[:, :1]).all())
        assert not torch.equal(rows[0, 0], rows[1, 0])
    assert len(torch.unique(group.states.gaze_rad, dim=0)) == 12
    batch = group.batch(1, 4)
    assert batch.slip_mm.double().numpy() == pytest.approx(
        group.labels.slip_um[4:8].numpy() * 1e-3, rel=1e-6
    )
    assert (group.margin, group.stream) == (4, 7)
