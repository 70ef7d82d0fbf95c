"""Closed forms of parts of the fit: power of a dipole, pixels that say nothing, samples
of a pixel.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
import bench_lens as b

from characterize.inference import leastsquares
from characterize.inference.leastsquares import FitImages, GaussianPrior
from characterize.model.detector import required_oversampling
from characterize.pupil.record import _components


def test_a_dipole_sends_the_same_power_through_every_point_of_the_pupil():
    """What x and y of the image get of a dipole along x, or it of theirs, is a unit
    field turned: 1 / cos of power.
    """
    random = np.random.default_rng(8)
    sine, azimuth = random.uniform(0.05, 0.93, 30), random.uniform(-3, 3, 30)
    sx, sy = sine * np.cos(azimuth), sine * np.sin(azimuth)
    xx, cross, zx, yy, zy = _components(sx, sy, vectorial=True)
    whole = 1 / np.sqrt(1 - sine**2)
    np.testing.assert_allclose(
        xx**2 + cross**2 / 2 + zx**2, whole, rtol=1e-13
    )  # of cosines of double precision
    np.testing.assert_allclose(yy**2 + cross**2 / 2 + zy**2, whole, rtol=1e-13)


@pytest.mark.parametrize("full_e", [41.0, 97.0])
def test_a_saturated_pixel_says_something_only_where_the_model_falls_short_of_it(
    full_e,
):
    """Four pixels of one unknown level, two of them full: these tell nothing once the
    level is above full_e.

    Sigma is that of the mean of the two others where the level lies above, and full
    pixels pull it up where it
    would lie below: then all four count, and the level is the mean of all.
    """
    seen = np.array([73.0, 71.0, full_e, full_e]).reshape(1, 2, 2)
    full = np.array([False, False, True, True]).reshape(1, 2, 2)

    def model(x, jacobian):
        return np.full((1, 2, 2), x[0]), np.ones((1, 1, 2, 2)) if jacobian else None

    data = FitImages(
        seen,
        np.ones_like(full),
        full,
        np.full(seen.shape, 9.0),
        np.full(seen.shape, 1e18),
    )
    found = leastsquares.fit_levenberg_marquardt(model, data, np.array([70.0]), prior=GaussianPrior.none(np.zeros(1)),
                             settings=leastsquares.SolverSettings(huber=1e6))  # fmt: skip
    counted = seen.ravel()[: 2 if full_e < 72 else 4]
    assert found.value[0] == pytest.approx(counted.mean(), rel=1e-6)
    assert found.covariance[0, 0] == pytest.approx(9.0 / len(counted), rel=1e-6)


def test_samples_of_a_pixel_are_twice_the_light_s_highest_frequency():
    """300 um wide, 400 um away as seen through glass: sine 0.6, 2 sine / 0.8 um = 1.5
    cycles/um: 3 samples a um.
    """
    lens = b.row(300.0, sensor_distance_um=470.0, layers=b.GLASS, wavelength_um=0.8)
    assert [required_oversampling(lens, pixel_um) for pixel_um in (0.2, 1.0, 2.1)] == [
        1,
        3,
        7,
    ]
