"""What `metalens psf` computes where nothing is said, and what its settings come to:
closed forms of the lens.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell
from metalens.commands.psf_settings import Settings
from metalens.lens import DiameterMap, Lens, reach
from metalens.pillars import Proxy

PROXY = Proxy(
    np.array([[3.0, 2.8, 0.3]]),
    np.array([[0.9, 0.05]]),
    (0.1, 0.3),
    (0.85, 0.85),
    0.0,
    0.0,
)


def lens(sites=2501, source_um=20e3, sensor_um=3000.0):
    """One row of pillars, 1 mm wide at 2501 sites of 0.4 um."""
    return Lens(
        DiameterMap(np.full((1, sites), 0.2), 0.4),
        Cell(0.4),
        PROXY,
        0.85,
        sensor_um,
        source_um,
        "map",
    )


def test_depths_left_out_are_21_over_the_range_of_the_lens():
    made = Settings().about(lens())
    near, far = (z * 1e-3 for z in reach.depth_range_um(lens()))
    assert made.depths_mm == pytest.approx((near, far, (far - near) / 20))
    seen = made.view.depths_um
    assert len(seen) == 21
    assert (seen[0], seen[-1]) == pytest.approx((16e3, 26e3))
    kept = Settings(depths_mm=(11.0, 13.0, 0.7)).about(lens())
    assert kept.view.depths_um == pytest.approx(
        tuple(np.linspace(11e3, 13e3, 4))
    )  # steps of at most 0.7 mm


def test_a_window_left_out_is_28_airy_units_or_8_blurs_of_the_worst_depth():
    """lambda / NA is 0.85 x 3000 / 500 = 5.1 um; a blur's radius 500 x 3000 |1/z -
    1/z0|.
    """
    near = 500 * 3000 * (1 / 19e3 - 1 / 20e3)
    assert 8 * near < 28 * 5.1
    assert Settings(depths_mm=(19.0, 21.0, 1.0)).about(lens()).window_um == float(
        f"{28 * 5.1:.3g}"
    )
    far = 500 * 3000 * (1 / 20e3 - 1 / 37e3)
    assert 8 * far > 28 * 5.1
    assert Settings(depths_mm=(19.0, 37.0, 1.0)).about(lens()).window_um == float(
        f"{8 * far:.3g}"
    )
    close = 500 * 3000 * (1 / 12e3 - 1 / 20e3)
    assert Settings(sources_mm=(21.0, 12.0, 25.0)).about(lens()).window_um == float(
        f"{8 * close:.3g}"
    )
    assert Settings(window_um=77.0).about(lens()).window_um == 77.0


def test_a_view_is_in_micrometres_and_radians_with_samples_as_far_apart_along_y():
    made = Settings(
        depths_mm=(9.0, 12.0, 1.5), window_um=60.0, height_um=24.0, samples=20, angles_deg=(3.0, -7.0),
        angles_y_deg=(1.0, 5.0), offset_um=(1.5, -2.5), source_um=30.0, source_shape="square",
    )  # fmt: skip
    view = made.view
    assert view.depths_um == pytest.approx((9e3, 10.5e3, 12e3))
    assert (view.window_um, view.samples, view.offset_um) == (
        (60.0, 24.0),
        (20, 8),
        (1.5, -2.5),
    )
    want = [np.radians([3.0, 1.0]), np.radians([-7.0, 5.0])]
    assert [tuple(a) for a in view.angles_rad] == [
        pytest.approx(tuple(w)) for w in want
    ]
    assert (view.source.shape, view.source.size_um, view.source.size_rad) == (
        "square",
        30.0,
        0.0,
    )
    wide = Settings(depths_mm=(9.0, 12.0, 1.5), window_um=60.0, source_deg=8.0).view
    assert wide.samples == (Settings().samples, Settings().samples)
    assert wide.source.size_rad == pytest.approx(2 * math.tan(math.radians(4.0)))
    assert Settings(sources_mm=(15.0, math.inf), window_um=60.0).view.depths_um == (
        15e3,
        math.inf,
    )


def test_wavelengths_have_their_weights_or_equal_ones():
    made = Settings(
        wavelengths_nm=(820.0, 850.0, 870.0), weights=(1.0, 4.0, 3.0)
    ).spectrum_of(lens())
    assert made.wavelengths_um == pytest.approx([0.82, 0.85, 0.87])
    assert made.weights == pytest.approx([0.125, 0.5, 0.375])
    assert Settings(wavelengths_nm=(820.0, 850.0)).spectrum_of(
        lens()
    ).weights == pytest.approx([0.5, 0.5])
    assert Settings().spectrum_of(lens()) is None
