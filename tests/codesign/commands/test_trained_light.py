"""A lens file of a co-design run carries its pillars over the light of training."""

from dataclasses import replace

import pytest
import torch

from codesign.optics.stack import OpticsConfig, trained_lens
from metalens import lens
from metalens.core.store import Provenance
from tests.command_line import call

OPTICS = OpticsConfig(
    aperture_mm=0.02,
    sensor_distance_mm=0.1,
    wavelength_nm=940.0,
    focus_mm=2.0,
    depths_mm=(1.0, 4.0),
    polynomials=3,
    fwhm_nm=32.0,
    filter_nm=24.0,
)


@pytest.mark.parametrize("light_nm", [0.0, 32.0])
def test_a_run_s_lens_is_looked_at_in_the_light_it_was_trained_in(tmp_path, light_nm):
    """A line of 32 nm behind a filter of 24 is one of 32 x 24 / 40 = 19.2 nm: its
    pillars are known over 48 nm about 940. The command's PSFs then take that light.
    """
    filter_nm = OPTICS.filter_nm if light_nm else 0.0
    optics = replace(OPTICS, fwhm_nm=light_nm, filter_nm=filter_nm)
    path = tmp_path / "lens.h5"
    made = trained_lens(optics, torch.zeros(3, dtype=torch.float64), Provenance())
    lens.save(path, made)
    half = 1.25 * 19.2e-3 if light_nm else 0.0
    assert lens.load(path).proxy.wavelengths_um == pytest.approx(
        (0.94 - half, 0.94 + half)
    )
    words = f"psf {path} -o {tmp_path}/psf.h5 --led-fwhm-nm 19.2"
    window = "--window-um 30 --samples 40 --tolerance 1e-3"
    code = call(f"{words} {window} --sources-mm 2 --angles-deg 0")
    assert code == (0 if light_nm else 2)
