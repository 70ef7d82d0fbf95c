"""How far distances are looked at before a fit: two sigma of what is known, no farther
than the bounds.
"""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import estimate
from characterize.model import KnownValue


@pytest.mark.parametrize(
    ("sigma", "reach"), [(37.0, 74.0), (None, 200.0), (310.0, 400.0)]
)
def test_distances_are_scanned_over_two_sigma_within_the_bounds(sigma, reach):
    """Unknown to 100 um where nobody says; the bounds lie 400 um to either side."""
    known = (
        {} if sigma is None else {"distance_um": KnownValue("distance_um", 12.0, sigma)}
    )
    lens = b.row(sensor_distance_um=5200.0, wavelength_um=0.83)
    assert estimate._reach_um(known, lens) == pytest.approx(reach)
