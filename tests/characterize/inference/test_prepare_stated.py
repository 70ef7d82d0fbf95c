"""What capture.toml says of the bench becomes the fit's priors, in the units of its
parameters.
"""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference.prepare import stated_priors


def said(**about):
    capture = SimpleNamespace(
        wavelength_um=0.8523, fill=1.0, pixel_um=0.75, about=about
    )
    return {one.name: (one.value, one.sigma) for one in stated_priors(capture, b.row())}


def test_words_of_a_capture_are_priors_in_units_of_the_parameters():
    found = said(
        wavelength_sigma_nm=0.3, pixel_sigma_um=0.003, pinhole_um=12.5, glass_um=700
    )
    assert found == {
        "wavelength_nm": (pytest.approx(2.3), 0.3),
        "pinhole_um": (12.5, 0.0),
        "glass_um": (700.0, 0.0),
        "pixel_percent": (0.0, pytest.approx(0.4)),  # 0.003 of 0.75 um
    }


def test_half_a_nanometre_of_wavelength_where_nothing_is_said_and_as_much_of_a_long_one():
    assert said() == {"wavelength_nm": (pytest.approx(2.3), 0.5)}
    capture = SimpleNamespace(wavelength_um=10.603, fill=1.0, pixel_um=12.0, about={})
    (one,) = stated_priors(capture, b.row(wavelength_um=10.6))
    assert (one.value, one.sigma) == (
        pytest.approx(3.0),
        pytest.approx(0.5 * 10.6 / 0.85),
    )
