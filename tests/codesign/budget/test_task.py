"""The linear estimator: moves of the eye are read as themselves, other optics as
nothing but an error.
"""

import math

import pytest
import torch

from codesign.budget import task
from codesign.budget.task import TaskSetting
from metalens.image import scene

SETTING = TaskSetting(scenes=2, pixels=48, margin=4, pitch_um=24.0, seed=3)


def _optics(sigma_px):
    """Gaussian PSFs, the same at every depth."""
    grid = torch.arange(9) - 4
    line = torch.exp(-(grid**2) / (2 * sigma_px**2))
    psf = line[:, None] * line
    stack = torch.stack([psf / psf.sum()] * 3)
    return scene.basis(
        stack, torch.tensor([10e3, 20e3, 40e3], dtype=torch.float64), tolerance=1e-6
    )


@pytest.fixture(scope="module")
def eyes():
    return task.render_views(SETTING)


@pytest.fixture(scope="module")
def reader(eyes):
    return task.linear_estimator(eyes, _optics(0.8), SETTING)


def test_the_same_image_is_no_error(eyes, reader):
    assert float(reader.shift(reader.image).abs().max()) == 0.0
    assert 0 < math.degrees(reader.noise_rad) < 1


@pytest.mark.parametrize(
    ("unknown", "amount"), [(0, math.radians(0.1)), (1, math.radians(-0.1)), (4, 80.0)]
)
def test_a_moved_eye_is_read_as_moved(eyes, reader, unknown, amount):
    """The answer to an image of the moved eye is the move, less what the prior and the
    other unknowns hold back.
    """
    states = SETTING.states
    moved = task.render_views(
        SETTING, task.shift_states(states, unknown, amount), exposed=states
    ).anchor
    image = task.expected_electrons(moved, _optics(0.8), SETTING)
    if (
        unknown < 2
    ):  # slip along the axis is confounded with size and anatomy, the gaze is not
        assert reader.shift(image)[:, unknown].tolist() == pytest.approx(
            [amount] * 2, rel=0.35
        )
    assert (reader.shift(image)[:, unknown] * amount > 0).all()


def test_every_unknown_has_a_step_a_prior_and_an_answer(eyes, reader):
    assert reader.pull.shape == (2, len(task.NAMES), 48 * 48)
    assert len(eyes.moved) == len(task.NAMES) - 1
    spread = reader.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert (spread[:, :2] < task.PRIOR[0]).all()  # the image tells more than the prior


def test_brighter_light_is_not_read_as_gaze(reader):
    found = reader.shift(reader.image * 1.01)
    assert found[:, -1].tolist() == pytest.approx([0.01] * 2, rel=0.3)
    assert task.gaze_rms(found) < math.radians(0.01)


def test_other_optics_shift_the_answer_in_proportion(eyes, reader):
    """First order: twice the change of blur, twice the error."""
    small, large = (
        reader.shift(task.expected_electrons(eyes.anchor, _optics(s), SETTING))
        for s in (0.8 * 1.005, 0.8 * 1.01)
    )
    assert task.gaze_rms(large) == pytest.approx(2 * task.gaze_rms(small), rel=0.1)
    assert task.gaze_rms(small) > 0
