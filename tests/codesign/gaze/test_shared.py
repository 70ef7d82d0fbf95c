"""What people share: variances in closed form, shrunk offsets, a person found from
fewer points than terms.
"""

from dataclasses import replace

import numpy as np
import pytest

from codesign.gaze import shared
from codesign.gaze.readings import NetworkReadings
from metalens.core.errors import StoreError, TrainingError


def test_variances_of_a_balanced_layout_are_those_of_the_analysis_of_variance():
    """Offsets alone, m frames of each of k people: greatest likelihood is σ² = MSW and
    τ² = (SSB / k - MSW) / m.
    """
    rng = np.random.default_rng(4)
    k, m = 7, 5
    person = np.repeat(np.arange(k), m)
    answers = (
        np.array([3.0, -1.0])
        + rng.normal(0, [2.0, 0.9], (k, 2))[person]
        + rng.normal(0, [0.7, 0.4], (k * m, 2))
    )
    found = shared.fit_mixed_model(
        np.ones((k * m, 1)), answers, person, first=np.array([4.0]), rounds=400
    )
    means = answers.reshape(k, m, 2).mean(1)
    within = ((answers - means[person]) ** 2).sum(0) / (k * (m - 1))
    between = m * ((means - means.mean(0)) ** 2).sum(0) / k
    assert found.noise == pytest.approx(within, rel=1e-5)
    assert found.variance[0] == pytest.approx((between - within) / m, rel=1e-5)
    assert found.mean[0] == pytest.approx(answers.mean(0), rel=1e-9)
    # of another person: drawn to the mean by σ² / (σ² + 3 τ²)
    new = np.array([[1.0, 2.0], [1.8, 0.4], [2.9, 1.1]])
    pull = within / (within + 3 * found.variance[0])
    want = (1 - pull) * new.mean(0) + pull * found.mean[0]
    assert found.own(np.ones((3, 1)), new)[0] == pytest.approx(want, rel=1e-6)


def test_unlike_answers_keep_their_own_variances_and_terms():
    """Two slopes, unequal numbers of frames: against the likelihood itself, which no
    step away may raise.
    """
    rng = np.random.default_rng(8)
    sizes = (9, 4, 12, 6, 8, 5)
    person = np.repeat(np.arange(6), sizes)
    design = np.stack([np.ones(len(person)), rng.normal(0, 1, len(person))], 1)
    truth = rng.normal([[1.0, 0.5]], [[1.5, 1.1]], (2, 6, 2))
    answers = np.stack([(design * truth[k][person]).sum(1) for k in range(2)], 1)
    answers += rng.normal(0, [0.3, 0.8], answers.shape)
    found = shared.fit_mixed_model(
        design, answers, person, first=np.ones(2), rounds=1000
    )

    def likelihood(k, mean, variance, noise):
        total = 0.0
        for p in range(6):
            x = design[person == p]
            y = answers[person == p, k] - design[person == p] @ mean
            cov = noise * np.eye(len(x)) + x @ np.diag(variance) @ x.T
            total -= 0.5 * (np.linalg.slogdet(cov)[1] + y @ np.linalg.solve(cov, y))
        return total

    for k in range(2):
        given = found.mean[:, k], found.variance[:, k], found.noise[k]
        best = likelihood(k, *given)
        for place in range(5):
            for way in (0.98, 1.02):
                tried = [np.array(v, dtype=float, ndmin=1) for v in given]
                which, inside = (
                    (0, place) if place < 2 else (1, place - 2) if place < 4 else (2, 0)
                )
                tried[which][inside] *= way
                assert likelihood(k, tried[0], tried[1], tried[2][0]) < best + 1e-6


def _read(rng, people, each, common):
    """Gaze of people whose axis is misread by kappa, a gain, and by what a slippage of
    each does to all alike.
    """
    person = np.repeat(np.arange(people), each)
    gaze = rng.uniform(-17, 17, (len(person), 2))
    slip = rng.uniform(-5, 5, (len(person), 3))
    kappa = rng.normal([5.0, -1.5], 2.0, (people, 2))[person]
    gain = rng.normal(1.0, 0.05, people)[person]
    axis = (
        gain[:, None] * gaze
        + kappa
        + common * np.stack([slip[:, 0] * slip[:, 2], slip[:, 2] ** 2], 1)
    )
    pupil = 0.03 * gaze + 0.1 * slip[:, :2] + 0.01 * rng.normal(0, 1, gaze.shape)
    return (
        NetworkReadings(pupil, slip, axis + 0.2 * rng.normal(0, 1, gaze.shape)),
        gaze,
        person,
    )


def test_a_person_of_ten_frames_is_read_as_well_as_noise_allows():
    """36 terms, ten frames: what all misread alike is known from others, kappa and gain
    are found. 0.2 degrees each way
    are noise, 0.25 in the mean angle; ten points leave sqrt(1 + 4 / 10) of that, and
    twice that is the bar."""
    rng = np.random.default_rng(1)
    people = shared.learn_population(*_read(rng, 32, 40, 0.2))
    read, gaze, _ = _read(rng, 1, 210, 0.2)
    own = people.person(read[:10], gaze[:10])
    error = np.linalg.norm(own(read[10:]) - gaze[10:], axis=1).mean()
    assert error < 2 * 0.25 * np.sqrt(1.4)
    off = read.axis_deg - gaze
    raw = off[10:] - off[:10].mean(0)
    # 0.2 deg/mm² of products up to 25 mm²
    assert np.linalg.norm(raw, axis=1).mean() > 2.0


def test_people_are_read_from_a_file_as_they_were_and_odd_ones_are_refused(tmp_path):
    people = shared.learn_population(*_read(np.random.default_rng(6), 5, 20, 0.1))
    shared.save_people(tmp_path / "p.h5", people)
    again = shared.load_people(tmp_path / "p.h5")
    read, gaze, _ = _read(np.random.default_rng(7), 1, 8, 0.1)
    assert np.array_equal(
        again.person(read[:5], gaze[:5])(read), people.person(read[:5], gaze[:5])(read)
    )
    for odd in (
        replace(people, spread=0 * people.spread),
        replace(people, middle=people.middle[:3]),
    ):
        shared.save_people(tmp_path / "odd.h5", odd)
        with pytest.raises(
            StoreError, match=r"(spread|middle) of a shape or value that no people have"
        ):
            shared.load_people(tmp_path / "odd.h5")


def test_too_few_people_frames_or_points_are_refused():
    rng = np.random.default_rng(2)
    with pytest.raises(TrainingError, match="40 frames of 1 people"):
        shared.learn_population(*_read(rng, 1, 40, 0.0))
    with pytest.raises(
        TrainingError,
        match="36 frames of 4 people tell not how people differ in 36 terms",
    ):
        shared.learn_population(*_read(rng, 4, 9, 0.0))
    people = shared.learn_population(*_read(rng, 6, 20, 0.0))
    read, gaze, _ = _read(rng, 1, 2, 0.0)
    with pytest.raises(TrainingError, match="2 points"):
        people.person(read, gaze)
    blind = replace(_read(rng, 1, 12, 0.0)[0], axis_deg=None)
    with pytest.raises(TrainingError, match="no optic axis"):
        people.person(blind, np.zeros((12, 2)))
