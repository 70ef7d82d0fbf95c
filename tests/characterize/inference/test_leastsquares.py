"""The loss by which fits from several starts are compared is the one that each of them lowers."""

import numpy as np
import pytest
from scipy import special

from characterize.inference.leastsquares import Data, Settings, fit


@pytest.mark.parametrize("huber", [6.0, 2.6])
def test_starts_are_ranked_by_the_loss_that_is_minimised(huber):
    """Residuals of 9 and 15 sigma, a masked pixel of 40, one saturated pixel; Huber's loss from scipy."""
    rng = np.random.default_rng(4)
    shape, sigma = rng.uniform(0.5, 1.5, (1, 5, 7)), 3.1
    noise = sigma * rng.standard_normal(shape.shape)
    noise[0, 1, 2], noise[0, 3, 3], noise[0, 4, 4], noise[0, 0, 6] = 9 * sigma, -15 * sigma, 40 * sigma, -11.0
    usable, saturated = np.ones(shape.shape, bool), np.zeros(shape.shape, bool)
    usable[0, 4, 4], saturated[0, 0, 6] = False, True
    data = Data(
        170.0 * shape + noise, usable, saturated, np.full(shape.shape, sigma**2), np.full(shape.shape, 1e12), 0.0
    )

    def model(x, slopes):
        return x[0] * shape, shape[None] if slopes else None

    found = fit(model, data, np.array([150.0]), settings=Settings(huber=huber))
    left = (data.electrons - found.value[0] * shape) / sigma
    left = np.where(saturated, np.maximum(left, 0), left)[usable]
    # scipy halves the square; the light's own noise, 170 / 1e12 of a variance, is left out
    want = 2 * special.huber(huber, left).sum() + 2 * np.log(sigma) * (usable & ~saturated).sum()
    assert found.merit == pytest.approx(want, rel=1e-9)
