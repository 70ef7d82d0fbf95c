"""Which lens planes of training have a phase beside the focusing one, and the width of filtered light."""

import torch

from codesign.optics import formed
from codesign.optics.stack import OpticsConfig

NONE = torch.zeros(0, dtype=torch.float64)
ABOUT = {"aperture_mm": 0.3, "sensor_distance_mm": 2.0, "polynomials": 0}


def factor(coefficients, **more):
    wave = formed.wave_of(OpticsConfig(**ABOUT | more), coefficients)
    x, y = (torch.tensor(v, dtype=torch.float64) for v in ([[31.0, -70.0]], [[12.0, 55.0]]))
    return wave.factor(x, y, 0.85, 0.0)


def test_a_bare_hyperbolic_lens_has_no_phase_of_its_own():
    assert factor(NONE) is None


def test_rings_sectors_and_polynomials_have_one():
    for more in ({"zones": 2}, {"parts": 3, "apart_um": 40.0}, {"foci_mm": (18.0, 26.0)}):
        made = factor(NONE, **more)
        assert made is not None
        assert float((made - 1).abs().max()) > 0.01
    assert factor(torch.full((3,), 0.4, dtype=torch.float64), polynomials=3) is not None
