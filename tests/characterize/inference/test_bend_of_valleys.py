"""How far a valley is from a parabola, in closed form: two sigma either way, of what is
left when another is held.
"""

import numpy as np
import pytest

from characterize.inference.leastsquares import FitImages, GaussianPrior
from characterize.inference.posterior import LocalMode

RNG = np.random.default_rng(13)
SIGMA, BENT, SHAPE = 0.37, 0.07, (2, 5, 7)
PICTURES = RNG.normal(size=(3, *SHAPE)) + 0.6 * RNG.normal(
    size=SHAPE
)  # overlap: parameters are correlated
CURVE = RNG.normal(size=SHAPE)
MODE = np.array([0.0, 1.7, -0.4])


def model(x, jacobian):
    image = 50.0 + SIGMA * (np.tensordot(x, PICTURES, 1) + BENT * x[0] ** 2 * CURVE)
    slopes = SIGMA * PICTURES.copy()
    slopes[0] += SIGMA * 2 * BENT * x[0] * CURVE
    return image, slopes if jacobian else None


def valley(**bounds):
    everywhere = np.ones(SHAPE, bool)
    seen = model(MODE, False)[0] + SIGMA * RNG.uniform(-2, 2, SHAPE)
    data = FitImages(
        seen, everywhere, ~everywhere, np.full(SHAPE, SIGMA**2), np.full(SHAPE, 1e15)
    )
    free = GaussianPrior.none(MODE)
    return LocalMode(
        model,
        data,
        MODE,
        GaussianPrior(free.mean, free.sigma, bounds.get("low", free.low), free.high),
    )


def test_a_quadratic_term_is_missed_by_four_times_itself_at_two_sigma():
    """BENT (2 s)² of its picture on either side; s from the information of all three."""
    flat = PICTURES.reshape(3, -1)
    sigma = np.sqrt(np.linalg.inv(flat @ flat.T)[0, 0])
    want = BENT * (2 * sigma) ** 2 * np.linalg.norm(CURVE)
    assert valley().bend(0) == pytest.approx(want, rel=1e-6)


def test_a_bound_between_is_told():
    flat = PICTURES.reshape(3, -1)
    spread = np.linalg.inv(flat @ flat.T)
    reach = 2 * np.sqrt(spread[0, 0])
    assert valley(low=np.array([-0.99 * reach, -99.0, -99.0])).bend(0) == np.inf
    assert np.isfinite(valley(low=np.array([-1.01 * reach, -99.0, -99.0])).bend(0))
