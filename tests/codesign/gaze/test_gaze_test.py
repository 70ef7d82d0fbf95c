"""Gaze tests: with true slippage and one's own eye little is left, with the
population's eye anatomy rules.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch

from codesign.batches.scenes import TEST, EyeScenes, SceneConfig
from codesign.gaze import bench
from codesign.gaze.bench import gaze_errors, simulate_people
from metalens.core.errors import TrainingError

SCENES = EyeScenes(SceneConfig(pixels=64, margin=8), 18.0, 2000.0, 0, TEST)


@pytest.fixture(scope="module")
def group():
    return simulate_people(SCENES, 6, 60, seed=1)


def _truth(group):
    edge = 64 * 18.0
    camera = SCENES.camera.pitch_um * SCENES.camera.pixels / 32
    return bench.read_of(
        group,
        (group.labels.pupil_px - 15.5) * camera / edge,
        group.labels.slip_um * 1e-3,
    )


def test_each_person_has_one_eye_and_many_gazes(group):
    traits = group.states.traits.reshape(6, 60, -1)
    assert bool((traits == traits[:, :1]).all())
    assert float(group.states.gaze_rad.reshape(6, 60, 2).std(1).min()) > 0.1
    assert torch.equal(
        group.batch(1, 4).slip_mm.double(),
        (group.labels.slip_um[4:8] * 1e-3).float().double(),
    )


def test_with_true_answers_anatomy_rules_until_it_is_known(group):
    found = gaze_errors(group, _truth(group))
    assert found.population_deg == pytest.approx(found.population_floor_deg, abs=1e-6)
    assert found.anatomy_floor_deg < 0.8  # refraction that no sphere follows
    assert 1.2 < found.population_floor_deg < 6.0
    assert (
        found.personal_floor_deg < 0.3 * found.population_floor_deg
    )  # twelve frames teach a person's own eye


def test_wrong_slippage_turns_the_gaze_as_geometry_says(group):
    """1 mm of lateral error moves the pupil by 1 mm on a sphere of 9.5 mm: 6 degrees,
    less for the slanted view.
    """
    true = _truth(group)
    off = replace(true, slip_mm=np.add(true.slip_mm, (1.0, 0.0, 0.0)))
    assert 4.0 < gaze_errors(group, off).anatomy_deg < 9.0


def test_an_axis_that_is_read_is_calibrated_by_what_other_people_s_tells(group):
    """Read to 0.3 degrees each way, 0.38 in the mean: kappa is a person's own, found
    from twelve frames, and what turns
    kappa with the gaze is common. Pupil and slippage read to 0.3 mm leave the sphere
    1.8 degrees a frame."""
    before = simulate_people(SCENES, 32, 60, seed=8)
    found = []
    for seed, who in enumerate((before, group)):
        true, rng = _truth(who), torch.Generator().manual_seed(seed)
        axis = who.labels.optic_axis + 5.2e-3 * torch.randn(len(true), 3, generator=rng)
        slip = torch.from_numpy(true.slip_mm) + 0.3 * torch.randn(
            len(true), 3, generator=rng
        )
        centre = torch.from_numpy(true.pupil_mm / (64 * 18e-3))
        found.append(bench.read_of(who, centre, slip, 1.7 * axis))
    theirs, read = found
    told = gaze_errors(group, read, how=bench.learn_from_people(before, theirs))
    assert (
        told.personal_deg < 0.38 * 1.3
    )  # twelve points for a dozen terms of one's own
    by_sphere = gaze_errors(group, read)
    assert by_sphere.personal_deg > 1.2
    assert told.personal_floor_deg == by_sphere.personal_floor_deg


def test_too_few_frames_to_calibrate_are_refused(group):
    with pytest.raises(TrainingError, match="2 of 60 frames a person calibrate"):
        gaze_errors(group, _truth(group), share=0.03)
