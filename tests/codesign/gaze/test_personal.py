"""Personal calibration: an eye off the mean is found from a few points, noise does not
make it wild.
"""

import math
from dataclasses import replace

import numpy as np
import torch

from codesign.eye import population as eye
from codesign.eye.population import CameraRig
from codesign.gaze import personal
from codesign.gaze.axis import EyeGeometry
from codesign.gaze.readings import NetworkReadings
from tests.referees.seen_pupil import pupil_of

RIG = CameraRig()
GRID = np.stack(
    [g.ravel() for g in np.meshgrid(np.linspace(-17, 17, 5), np.linspace(-12, 12, 5))],
    1,
)


def _person(slip_mm, *, beside=(0.6, -0.4, 0.5), larger=0.4, kappa_deg=(5.0, 1.5)):
    """Pupils on the sensor and gaze of an eye that is a sphere off the mean, looking at
    every stimulus per slip.
    """
    centre, radius = eye.mean_eye_um(RIG)
    x, y, z = np.asarray(centre) * 1e-3 + beside
    geometry = EyeGeometry(
        (x, y, z), radius * 1e-3 + larger, RIG.sensor_distance_um * 1e-3
    )
    gaze = np.tile(GRID, (len(slip_mm), 1))
    face = personal.gaze_direction(np.radians(gaze + kappa_deg))
    s, c = math.sin(RIG.elevation_rad), math.cos(RIG.elevation_rad)
    direction = face @ np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, -s, -c]])
    slips = np.repeat(slip_mm, len(GRID), 0)
    pupil = pupil_of(
        torch.from_numpy(direction), torch.from_numpy(-slips), geometry
    ).numpy()
    return pupil, slips, gaze


SLIPS = np.array(
    [
        [0, 0, 0],
        [-2.5, 0, 0],
        [-5, 0, 0],
        [0, 0, -5],
        [0, 0, -2.5],
        [0, 0, 2.5],
        [0, 0, 5],
    ],
    float,
)


def _known(gaze, every):
    return np.isin(np.unique(gaze, axis=0, return_inverse=True)[1].ravel() % every, 0)


def test_face_angles_undo_the_tilt_of_the_camera():
    s, c = math.sin(0.7), math.cos(0.7)
    tilted = CameraRig(elevation_rad=0.7)
    # out of a face that the camera sees from 0.7 rad below
    ahead = np.array([[0.0, -s, -c]])
    assert np.allclose(personal.face_angles(ahead, tilted), 0, atol=1e-12)
    turned = ahead * math.cos(0.2) + math.sin(0.2) * np.array([[1.0, 0.0, 0.0]])
    assert np.allclose(personal.face_angles(turned, tilted), [[math.degrees(0.2), 0.0]])


def test_the_sphere_of_a_person_off_the_mean_is_found_from_seven_stimuli():
    """Four parameters and kappa explain a spherical eye; what is left is the pull of
    the population: 0.1 degrees.
    """
    pupil, slip, gaze = _person(SLIPS)
    known = _known(gaze, 4)
    person = personal.SphereCalibrator(RIG).person(
        NetworkReadings(pupil[known], slip[known]), gaze[known]
    )
    error = personal.angle_deg(
        person(NetworkReadings(pupil[~known], slip[~known])), gaze[~known]
    )
    alone = personal.SphereCalibrator(RIG, hidden=0).person(
        NetworkReadings(pupil[known], slip[known]), gaze[known]
    )
    assert known.sum() == 49
    assert error.mean() < 0.15
    assert personal.angle_deg(alone.sphere(pupil, slip), gaze).mean() < 0.25
    # kappa trades with the centre to first order
    assert abs(alone.own[4:6] + np.array([5.0, 1.5])).max() < 1.5


def test_noisy_slippage_makes_the_regressor_careful():
    """0.3 mm of slippage on a sphere of 10 mm is 1.7 degrees a frame: no calibration
    may end far above that.
    """
    rng = np.random.default_rng(0)
    pupil, slip, gaze = _person(SLIPS[:1])
    read = slip + 0.3 * rng.standard_normal(slip.shape)
    known = _known(gaze, 3)
    person = personal.SphereCalibrator(RIG).person(
        NetworkReadings(pupil[known], read[known]), gaze[known]
    )
    assert (
        personal.angle_deg(
            person(NetworkReadings(pupil[~known], read[~known])), gaze[~known]
        ).mean()
        < 4.0
    )


def test_a_person_of_few_points_is_drawn_to_the_mean_by_what_people_differ_by():
    """The most likely person: what a step of one standard deviation (1 mm each way, 0.6
    mm of radius, 5 degrees, 0.05
    rad) changes of the squared misses is in one proportion to how many of them the
    person is off."""
    pupil, slip, gaze = _person(SLIPS[:1], beside=(0.9, -0.7, 0.8), larger=-0.5)
    some = np.random.default_rng(2).permutation(len(gaze))[:5]
    gaze = gaze[some] + np.random.default_rng(3).normal(0, 1.5, (5, 2))
    person = personal.SphereCalibrator(RIG, hidden=0).person(
        NetworkReadings(pupil[some], slip[some]), gaze
    )
    differ = np.array([1.0, 1.0, 1.0, 0.6, 5.0, 5.0, 0.05])

    def missed(unit):
        return (
            (replace(person, own=unit * differ).sphere(pupil[some], slip[some]) - gaze)
            ** 2
        ).sum()

    at = person.own / differ
    slope = (
        np.array([missed(at + step) - missed(at - step) for step in 1e-4 * np.eye(7)])
        / 2e-4
    )
    left = -(slope @ at) / (at @ at)
    assert left > 0
    # where the search ends: 1e-4 of it
    assert abs(slope + left * at).max() < 0.01 * left * np.abs(at).max()
    assert np.abs(at).min() > 0.02  # none is at the mean, which would say nothing
