"""A point exposure whose core is as narrow as the first sample of its table."""

import numpy as np
import pytest

from layout.pec.psf import PointExposure, fit_point_spread


def test_the_narrowest_gaussian_may_be_as_wide_as_the_first_radius():
    """Coarse samples: half of the energy lies in a core of which only the first radius
    tells the width.
    """
    truth = PointExposure(np.array([0.02, 5.0]), np.array([0.5, 0.5]))
    radius = np.geomspace(0.02, 20.0, 31)
    found = fit_point_spread(radius, 3.0 * truth.density(radius))
    assert found.widths_um.min() == pytest.approx(0.02, rel=1e-9)
    probe = np.array([0.015, 0.02, 0.04, 1.0])
    assert np.abs(found.within(probe) - truth.within(probe)).max() < 0.02
