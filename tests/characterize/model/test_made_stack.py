"""The PSFs of a lens as built are asked for at its own wavelength and distance, window
and angle.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.model import made, parameter_vector, process_state_of, thinplate
from metalens import psf
from metalens.fabrication import transmission


def test_psfs_are_those_of_the_wavelength_in_nm_and_the_distance_in_um_beside_the_design(
    monkeypatch,
):
    asked, lens = [], b.lens()
    stack = psf.PsfStack(
        np.full((1, 1, 4, 4), 1 / 16),
        np.ones((1, 1)),
        depths_um=np.array([600.0]),
        angles_rad=np.zeros((1, 2)),
        wavelengths_um=np.array([0.85]),
        weights=np.ones(1),
        step_um=1.0,
        centres_um=np.zeros((1, 2)),
        sensor_distance_um=1.0,
        tolerance=1e-3,
        error=1e-4,
        reason="typed",
    )
    monkeypatch.setattr(
        psf,
        "psf_stack",
        lambda phase, level, **about: asked.append((phase, level, about)) or stack,
    )
    x = parameter_vector({"wavelength_nm": 1.7, "distance_um": -3.1, "bias_nm": 4.0})
    view = psf.View(
        (600.0,), ((0.02, -0.01), (0.0, 0.03)), 24.0, 4, offset_um=(0.7, -0.4)
    )
    found = made.psf_stack(
        lens, b.RESPONSE, x, view, offset_um=(1.1, 2.3), tolerance=3e-3
    )
    assert found.intensity.shape == (2, 1, 4, 4)
    for (phase, level, about), angle in zip(asked, view.angles_rad, strict=True):
        t = made.as_built_transmission(
            lens, b.RESPONSE, x, angle_rad=made.incidence_rad(lens.proxy, angle)
        )
        assert level * np.exp(1j * phase) == pytest.approx(
            t, abs=1e-5
        )  # single precision
        assert about["wavelength_um"] == pytest.approx(
            lens.wavelength_um + 1.7e-3, rel=1e-12
        )
        assert about["sensor_distance_um"] == pytest.approx(
            lens.sensor_distance_um - 3.1, rel=1e-12
        )
        assert (about["angle_rad"], about["tolerance"]) == ([list(angle)], 3e-3)
        assert about["offset_um"] == pytest.approx((1.8, 1.9))
        assert about["pitch_um"] == lens.diameters.pitch_um


def test_every_pillar_passes_the_light_of_its_own_diameter_with_the_phase_of_its_place():
    """One by one, no table between: it is linear over 2^16 entries, 1e-9 where the
    phase turns by 50 rad a um.
    """
    lens, rng = b.lens(), np.random.default_rng(3)
    d, x = lens.diameters, parameter_vector(b.VALUES)
    noise = rng.normal(0, 2e-3, d.diameter_um.shape)
    got = made.as_built_transmission(lens, b.RESPONSE, x, noise_um=noise)
    known = process_state_of(x)
    u, v = np.meshgrid(d.x_um / d.radius_um, d.y_um / d.radius_um)
    stands = d.diameter_um > 0
    grown = (d.diameter_um + known.bias_um(u, v) + noise)[stands]
    t = transmission(
        lens.proxy, b.RESPONSE, grown, lens.wavelength_um + 0.4e-3, known.answers()
    )
    assert (
        np.abs(got[stands] - t * np.exp(1j * known.phase_rad(u, v)[stands])).max()
        < 1e-8
    )
    assert not got[~stands].any()


def test_a_residual_phase_lies_on_the_lens_over_its_radius():
    """Modes that nothing mirrors: each pillar with and without them, by the basis at
    its own place.
    """
    lens, x, modes = (
        b.lens(),
        parameter_vector(b.VALUES),
        np.array([0.4, -0.3, 0.25, 0.5, -0.2]),
    )
    d = lens.diameters
    u, v = np.meshgrid(d.x_um / d.radius_um, d.y_um / d.radius_um)
    plain, bent = (
        made.as_built_transmission(lens, b.RESPONSE, x, modes=m) for m in (None, modes)
    )
    stands = d.diameter_um > 0
    want = np.tensordot(modes, thinplate.thin_plate_basis(u, v, 5), 1)[stands]
    assert (
        np.abs(bent[stands] - plain[stands] * np.exp(1j * want)).max() < 1e-4
    )  # 1e-5 of some radians
    assert np.ptp(want) > 1


def test_a_lens_as_built_has_its_diameters_wavelength_and_distance():
    """Pillar by pillar, clipped to what the proxy knows; the bias varies over the lens."""
    lens = b.lens()
    d, x = (
        lens.diameters,
        parameter_vector(
            {
                "wavelength_nm": 1.7,
                "distance_um": -3.1,
                "bias_nm": 9.0,
                "bias_y_nm": 23.0,
            }
        ),
    )
    made_lens = made.built_lens(lens, x)
    assert made_lens.wavelength_um == pytest.approx(
        lens.wavelength_um + 1.7e-3, rel=1e-12
    )
    assert made_lens.sensor_distance_um == pytest.approx(
        lens.sensor_distance_um - 3.1, rel=1e-12
    )
    v = (d.y_um / d.radius_um)[:, None]
    grown = np.clip(d.diameter_um + 9e-3 + 23e-3 * v, 0.09, 0.26)
    want = np.where(d.diameter_um > 0, grown, 0)
    assert (
        np.abs(made_lens.diameters.diameter_um - want).max() < 1e-7
    )  # single precision
    assert (want == 0.09).any()
    assert (want == 0.26).any()
    wide = made.built_lens(dataclasses.replace(lens, proxy=dataclasses.replace(b.proxy(), domain_um=(0.09, 0.5))),
                           parameter_vector({"bias_nm": 200.0}))  # fmt: skip
    assert wide.diameters.diameter_um.max() == pytest.approx(
        0.999 * 0.4, rel=1e-6
    )  # what stands does not touch
