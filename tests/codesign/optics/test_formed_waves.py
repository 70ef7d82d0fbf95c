"""Which lens planes of training have a phase beside the focusing one, and the width of
filtered light.
"""

import dataclasses
import math
from typing import Any

import pytest
import torch

from codesign.optics import formed
from codesign.optics.stack import OpticsConfig

NONE = torch.zeros(0, dtype=torch.float64)
ABOUT = {"aperture_mm": 0.3, "sensor_distance_mm": 2.0, "polynomials": 0}


def factor(coefficients, **more):
    wave = formed.wave_of(OpticsConfig(**ABOUT | more), coefficients)
    x, y = (
        torch.tensor(v, dtype=torch.float64) for v in ([[31.0, -70.0]], [[12.0, 55.0]])
    )
    return wave.factor(x, y, 0.85, 0.0)


def test_a_bare_hyperbolic_lens_has_no_phase_of_its_own():
    assert factor(NONE) is None


def test_rings_sectors_and_polynomials_have_one():
    for more in (
        {"zones": 2},
        {"parts": 3, "apart_um": 40.0},
        {"foci_mm": (18.0, 26.0)},
    ):
        made = factor(NONE, **more)
        assert made is not None
        assert float((made - 1).abs().max()) > 0.01
    assert factor(torch.full((3,), 0.4, dtype=torch.float64), polynomials=3) is not None


@dataclasses.dataclass
class Told:
    """What an imager is asked for, with energies typed in."""

    words: tuple[Any, ...]
    about: dict[str, Any]
    energy: torch.Tensor
    patches: tuple[Any, ...] = ()


@pytest.mark.parametrize(
    ("filter_nm", "width_nm", "passed"), [(40.0, 24.0, 0.8), (0.0, 30.0, 1.0)]
)
def test_the_imager_is_asked_for_the_frame_the_light_and_the_field_of_the_settings(
    monkeypatch, filter_nm, width_nm, passed
):
    """40 samples of 7 um with margins of 6; a line of 30 nm behind a filter of 40 nm is
    one of 24 nm, of
    which four fifths pass."""
    formed._still.cache_clear()

    def told(*words, **about):
        patch = Told((), {}, torch.tensor([0.4, 0.5]))
        return Told(words, about, torch.tensor([0.7, 0.2, 0.9]), (patch, patch))

    monkeypatch.setattr(formed, "field_imager", told)
    settings = OpticsConfig(
        **ABOUT, depths_mm=(16.0, 31.0), sample_um=7.0, window_samples=13, angle_deg=9.0, image="true",
        image_tolerance=0.07, wavelength_nm=843.0, fwhm_nm=30.0, filter_nm=filter_nm,
    )  # fmt: skip
    made = formed.imager(settings, NONE, 40, margin=6)
    formed._still.cache_clear()  # of what is no imager
    wave, grid = made.words
    assert (wave.radius_um, made.about["distance_um"]) == (150.0, 2000.0)
    assert (grid.samples, grid.step_um, grid.depths_um) == ((28, 28), 7.0, (16e3, 31e3))
    assert (grid.margin, grid.window) == (6, 13)
    assert made.about["field"] == (pytest.approx(math.radians(9.0)), 0.0)
    assert made.about["tolerance"] == 0.07
    assert (made.about["spectrum"].peak_nm, made.about["spectrum"].fwhm_nm) == (
        843.0,
        pytest.approx(width_nm),
    )
    assert made.energy.tolist() == pytest.approx(
        [0.7 * passed, 0.2 * passed, 0.9 * passed]
    )
    for patch in made.patches:
        assert patch.energy.tolist() == pytest.approx([0.4 * passed, 0.5 * passed])


def test_unfiltered_light_has_the_width_of_its_line_and_none_is_one_wavelength():
    assert (
        formed.source_of(OpticsConfig(**ABOUT, image="true", fwhm_nm=30.0)).fwhm_nm
        == 30.0
    )
    assert formed.source_of(OpticsConfig(**ABOUT, image="true")) is None
