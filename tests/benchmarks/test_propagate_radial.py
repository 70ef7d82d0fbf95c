"""Hankel path against the exact sum over the pixelated lens."""

import numpy as np
import pytest

from benchmarks.rivals.radial import Radial, field_radial
from metalens import propagate
from metalens.ground.errors import PropagationError

K = 2 * np.pi / 0.85


def radial(radius, distance, source, taper=0.0):
    def phase(r):
        return -K * (
            r * r / (np.hypot(r, distance) + distance)
            + r * r / (np.hypot(r, source) + source)
        )

    return Radial(phase, lambda r: np.exp(-taper * (r / radius) ** 2), radius)


@pytest.mark.parametrize("n", [250, 251])
def test_agrees_with_the_pixelated_lens_and_says_how_well(n):
    lens = radial(45.0, 200.0, 2000.0)
    case = propagate.case(
        (n, n),
        pitch_um=0.4,
        wavelength_um=0.85,
        sensor_distance_um=200.0,
        depths_um=[1700, 2300.0],
        window_um=20,
        samples=16,
    )
    got = field_radial(lens, case, 1e-5)
    a, b = (
        np.abs(f) ** 2
        for f in (got.field, propagate.field_exact(*lens.maps(case.shape, 0.4), case))
    )
    a, b = (i / i.sum((1, 2), keepdims=True) for i in (a, b))
    error = np.linalg.norm(a - b) / np.linalg.norm(b)
    assert error < 1e-3
    assert (
        error < got.error < 5 * error
    )  # a rough rim of 350 cells, judged at a few samples


@pytest.mark.parametrize(
    ("radius", "n", "depths_um", "distance"),
    [
        (50.0, 252, [2500.0, np.inf], 200.0),
        (50.0, 252, [2500.0, np.inf], 120.0),
        (100.0, 502, [2500.0, np.inf], 400.0),
    ],
)
@pytest.mark.parametrize("samples", [16, 32])
def test_the_estimate_is_never_below_the_error_where_the_rim_scatters_beyond_the_band(
    radius, n, depths_um, distance, samples
):
    """Depths out of focus, whose light lies far from the axis: what the rim scatters
    counts most.
    """
    lens = radial(radius, distance, 2000.0)
    case = propagate.case(
        (n, n),
        pitch_um=0.4,
        wavelength_um=0.85,
        sensor_distance_um=distance,
        depths_um=depths_um,
        window_um=20,
        samples=samples,
    )
    got = field_radial(lens, case, 1e-5)
    a, b = (
        np.abs(f) ** 2
        for f in (got.field, propagate.field_exact(*lens.maps(case.shape, 0.4), case))
    )
    a, b = (i / i.sum((1, 2), keepdims=True) for i in (a, b))
    error = np.linalg.norm(a - b) / np.linalg.norm(b)
    assert error <= got.error <= 3 * error


def test_a_soft_rim_agrees_far_better():
    """With the light gone at the rim, what is left is the method's own tolerance."""
    lens = radial(45.0, 200.0, 2000.0, taper=12.0)
    case = propagate.case(
        (228, 228),
        pitch_um=0.4,
        wavelength_um=0.85,
        sensor_distance_um=200.0,
        depths_um=[1700.0, np.inf],
        window_um=20,
        samples=12,
    )
    got = field_radial(lens, case, 1e-7).field
    want = propagate.field_exact(*lens.maps(case.shape, 0.4), case)
    assert np.linalg.norm(got - want) < 1e-5 * np.linalg.norm(want)


def test_off_axis_is_refused():
    case = propagate.case(
        (9, 9),
        pitch_um=0.4,
        wavelength_um=0.85,
        sensor_distance_um=99.0,
        depths_um=9e3,
        window_um=9,
        samples=4,
        angle_rad=0.1,
    )
    with pytest.raises(PropagationError, match="axis"):
        field_radial(radial(2.0, 99.0, 9e3), case, 1e-4)
