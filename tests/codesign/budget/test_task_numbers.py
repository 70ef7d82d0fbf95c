"""The linear estimator of an eye against weighted least squares in numpy, on images
that are typed in.
"""

import math

import numpy as np
import pytest
import torch

from codesign.budget import task
from codesign.budget.task import TaskSetting
from metalens.image import Sensor

SETTING = TaskSetting(
    sensor=Sensor(exposure_e=800.0, full_well_e=5000.0, read_noise_e=3.7, bits=9),
    pitch_um=4.1,
)
RNG = np.random.default_rng(2)
IMAGE = RNG.uniform(200, 900, (2, 40))
SLOPES = (
    RNG.normal(0, 1, (2, len(task.steps()), 40))
    * 40
    / np.array(task.priors())[:-1, None]
)


@pytest.fixture
def reader():
    """The estimator of two eyes whose images move along SLOPES."""
    return task.estimator(torch.from_numpy(IMAGE), torch.from_numpy(SLOPES), SETTING)


def test_covariance_and_pull_are_those_of_weighted_least_squares(reader):
    """Noise: photons, read-out, rounding of 9 bits in a pixel of (4.1 / base)² and the
    model's own share.
    """
    sensor = SETTING.sensor
    well = sensor.full_well_e * (4.1 / sensor.base_pitch_um) ** 2
    for image, slopes, covariance, pull in zip(
        IMAGE, SLOPES, reader.covariance, reader.pull, strict=True
    ):
        noise = (
            image + 3.7**2 + (well / 511) ** 2 / 12 + (SETTING.mismatch * image) ** 2
        )
        columns = np.stack([*slopes, image])  # the last unknown is brightness
        normal = (columns / noise) @ columns.T + np.diag(
            np.array(task.priors()) ** -2.0
        )
        want = np.linalg.inv(normal)
        size = np.sqrt(np.diag(want))
        assert np.abs((covariance.numpy() - want) / np.outer(size, size)).max() < 1e-9
        assert pull.numpy() == pytest.approx(
            want @ (columns / noise), rel=1e-6, abs=1e-12
        )
    gaze = [c[0, 0] + c[1, 1] for c in reader.covariance.numpy()]
    assert reader.noise_rad == pytest.approx(math.sqrt(np.mean(gaze)), rel=1e-12)


def test_a_shift_is_the_pull_of_what_changed(reader):
    change = RNG.normal(size=IMAGE.shape)
    got = reader.shift(torch.from_numpy(IMAGE + change)).numpy()
    assert got == pytest.approx(
        np.einsum("skp,sp->sk", reader.pull.numpy(), change), rel=1e-9, abs=1e-12
    )


def test_gaze_error_is_both_angles_together():
    shift = torch.tensor([[0.3, -0.4, 9.0], [0.0, 1.2, 9.0]])
    assert task.gaze_rms(shift) == pytest.approx(math.sqrt((0.25 + 1.44) / 2))
