"""Known masks and optics that are known roughly: formulas, recovery inside the
interval, refusals by name.
"""

import dataclasses
import math

import numpy as np
import pytest

from characterize.captures import capture
from characterize.pupil.fit import fit_pupil
from characterize.pupil.record import PupilModel, PupilSpec, phase_mask
from metalens.core.errors import CaptureError, FitError

SPEC = PupilSpec(
    0.32,
    0.5,
    0.4,
    window=20,
    phase_order=4,
    amplitude_order=1,
    drift_order=1,
    model_error=0.0,
)
Z = np.linspace(-9, 9, 9)


def square(n):
    """Places of the middles of n x n pixels about the aperture: x, y over the radius."""
    axis = (np.arange(n) + 0.5) * 2 / n - 1
    return np.meshgrid(axis, axis)


def shots(model, seed=1):
    """A bead with coma, through focus, with photon noise."""
    layout = model.layout()
    x, n = np.zeros(layout.size), layout.frames
    x[1:4] = 0.3, -0.2, 0.15
    x[-2 * n - 1], x[-2 * n : -n], x[-n:] = 0.2, math.log(6e4), 20
    counts = np.random.default_rng(seed).poisson(model.images(x, False)[0])
    names = ("",) * n
    return capture.Capture(
        counts.astype(np.uint16), Z - Z[0], np.zeros((n, 2)), np.full(n, np.nan), names, 16,
        about={"gain_e": 1.0, "offset": 0, "read_noise_e": 0.0},
    )  # fmt: skip


def test_a_mask_is_read_where_it_is_turned_to_and_jumps_by_two_pi_are_none(tmp_path):
    x, y = square(400)
    np.save(tmp_path / "m.npy", np.mod(9.0 * x + 2.0 * y * y, 2 * np.pi))
    u, v = np.array([0.31, -0.52, 0.7]), np.array([-0.44, 0.23, 0.6])
    found = phase_mask(tmp_path / "m.npy", u, v)
    assert (
        np.abs(found - np.exp(1j * (9 * u + 2 * v * v))).max() < 2e-3
    )  # curvature over a pixel: 40 * 0.005² / 8
    turned = phase_mask(
        tmp_path / "m.npy", u, v, turn_rad=math.pi / 2
    )  # what lay along +x lies along +y
    assert np.abs(turned - np.exp(1j * (9 * v + 2 * u * u))).max() < 2e-3


def test_a_known_mask_explains_what_few_orders_do_not(tmp_path):
    """A vortex, which no Zernike polynomial is: with it chi-square is that of noise."""
    x, y = square(256)
    np.save(tmp_path / "v.npy", np.arctan2(y, x))
    known = dataclasses.replace(SPEC, mask=tmp_path / "v.npy")
    seen = shots(PupilModel(known, Z, phase_order=4, amplitude_order=1))
    found = fit_pupil(seen, known, judge=False)
    assert found.chi2_per_dof == pytest.approx(1, abs=0.12)
    blind = fit_pupil(seen, SPEC, judge=False, insist=True)
    assert blind.chi2_per_dof > 3


@pytest.mark.parametrize(
    ("free", "wrong"),
    [
        (("numerical_aperture",), {"numerical_aperture": 0.29}),
        (("step_um",), {"step_um": 2.0}),
    ],
)
def test_optics_known_roughly_are_found_within_three_sigma(free, wrong):
    truth = {"numerical_aperture": 0.32, "step_um": Z[1] - Z[0]}
    seen = shots(PupilModel(SPEC, Z, phase_order=4, amplitude_order=1))
    found = fit_pupil(seen, dataclasses.replace(SPEC, free=free, **wrong))
    ((name, value, sigma),) = found.optics
    assert name == free[0]
    assert abs(value - truth[name]) < max(3 * sigma, 0.004 * truth[name])
    assert (
        sigma < 0.015 * truth[name]
    )  # of the step 1.3 %: nine planes that each stand off by a tenth of it
    assert abs(value - wrong[name]) > 0.05 * truth[name]
    assert found.held_out.ncc > found.between.ncc
    assert any(f"{name} = " in words for words in found.cautions)


def test_masks_and_names_that_are_none_are_refused(tmp_path):
    np.save(tmp_path / "flat.npy", np.zeros((9, 12)))
    with pytest.raises(CaptureError, match=r"flat.npy: a mask of \(9, 12\)"):
        phase_mask(tmp_path / "flat.npy", np.zeros(2), np.zeros(2))
    (tmp_path / "text.npy").write_text("no array")
    with pytest.raises(CaptureError, match="no mask can be read"):
        phase_mask(tmp_path / "text.npy", np.zeros(2), np.zeros(2))
    with pytest.raises(FitError, match="need some of numerical_aperture"):
        dataclasses.replace(SPEC, free=("aperture",))
