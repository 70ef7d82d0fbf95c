"""The generic pupil: Airy pattern in closed form, exact derivatives, recovery inside
its interval.
"""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy import special

from characterize.captures import capture
from characterize.pupil import fit as pupilfit
from characterize.pupil.model import PupilModel, PupilSpec
from metalens.core.errors import CaptureError, FitError
from tests.command_line import call

SPEC = PupilSpec(
    0.3,
    0.5,
    0.4,
    window=16,
    phase_order=4,
    amplitude_order=1,
    drift_order=1,
    model_error=0.0,
)
Z = np.linspace(-8, 8, 5)
BEADS = Path(__file__).parents[4] / "shared" / "captures" / "bead_stack"


def truth(model):
    rng = np.random.default_rng(0)
    x = rng.normal(0, 0.15, sum(model.sizes.values()))
    parts = model.unpack(x)
    parts["blur"][:], parts["gain"][:] = 0.2, math.log(3e4)
    parts["background"][:], parts["gradient"][:] = 20, 0
    return x


def make(spec=SPEC):
    return PupilModel(spec, Z)


def test_in_focus_without_aberration_it_is_the_airy_pattern():
    spec = dataclasses.replace(
        SPEC,
        numerical_aperture=0.05,
        wavelength_um=0.5,
        pixel_um=1.0,
        window=24,
        model="scalar",
    )
    model = PupilModel(spec, np.array([-1e-6, 0.0, 1e-6]))
    x = np.zeros(sum(model.sizes.values()))
    model.unpack(x)["blur"][:] = 1e-3  # none
    image = model.images(x, False)[0][1]
    r = np.hypot(np.arange(24) - 11.5, 0.5)  # row 12 lies half a pixel below the axis
    v = 2 * math.pi / 0.5 * 0.05 * r
    want = (2 * special.j1(v) / v) ** 2
    # rim of the disc on 30 nodes
    assert abs(image[12] / image[12, 12] - want / want[12]).max() < 4e-3
    assert abs(image.sum() - 0.93) < 0.06  # the window holds about 93 % of the light


def test_vector_and_scalar_agree_at_low_aperture():
    images = [
        make(dataclasses.replace(SPEC, numerical_aperture=0.05, pixel_um=2.0, model=m))
        for m in ("vector", "scalar")
    ]
    a, b = (m.images(truth(m), False)[0] for m in images)
    assert abs(a - b).max() < 3e-3 * b.max()  # (NA)² terms


@pytest.mark.parametrize("kind", ["vector", "scalar"])
def test_derivatives_match_finite_differences(kind):
    model = make(dataclasses.replace(SPEC, model=kind))
    x = truth(model)
    _, jacobian = model.images(x, True)
    for j, row in enumerate(jacobian):
        h = 1e-4 * max(abs(x[j]), 0.1)
        step = np.eye(len(x))[j] * h
        want = (model.images(x + step, False)[0] - model.images(x - step, False)[0]) / (
            2 * h
        )
        # complex64 columns
        assert abs(row - want).max() < 3e-5 * np.abs(want).max(), j


def noisy(model, x, seed=1):
    counts = np.random.default_rng(seed).poisson(model.images(x, False)[0])
    n = len(counts)
    return capture.Capture(
        counts.astype(np.uint16),
        Z - Z[0],
        np.zeros((n, 2)),
        np.full(n, np.nan),
        ("",) * n,
        16,
        about={"gain_e": 1.0, "read_noise_e": 0.1},
    )


def test_a_known_pupil_is_found_within_its_interval():
    model = make()
    x = truth(model)
    fit = pupilfit.fit_pupil(noisy(model, x), SPEC, judge=False)
    assert fit.converged
    assert 0.9 < fit.chi2_per_dof < 1.1
    bright = model.images(x, False)[0]
    assert np.linalg.norm(fit.predicted - bright) < 0.02 * np.linalg.norm(bright - 20)


def wide(side=64, place=(40, 20)):
    """The stack of a known pupil inside a larger frame, as a microscope gives it, in
    electrons.
    """
    model = make()
    small = 2 * (model.images(truth(model), False)[0] - 20)
    frames = np.full((len(Z), side, side), 300.0)
    first = [p - SPEC.window // 2 for p in place]
    frames[:, first[0] : first[0] + SPEC.window, first[1] : first[1] + SPEC.window] += (
        small
    )
    return frames


def shots_of(frames, gain_e=20.0):
    n = len(frames)
    counts = np.round(np.random.default_rng(5).poisson(frames * gain_e) / gain_e)
    about = {"gain_e": gain_e, "read_noise_e": 0.1}
    return capture.Capture(
        counts,
        np.arange(n) * 4.0,
        np.zeros((n, 2)),
        np.full(n, np.nan),
        ("",) * n,
        16,
        about=about,
    )


@pytest.mark.parametrize("slope", [0.3, -0.5])
def test_a_bead_on_a_steep_background_is_found_and_fitted(slope):
    """Across the window the background changes by a share of the peak; across the frame
    by more than the peak.
    """
    frames = wide()
    light = frames.max() - 300
    ramp = slope * light * (np.arange(64) - 31.5) / SPEC.window
    found = pupilfit.fit_pupil(shots_of(frames + 3 * light + ramp[:, None]), SPEC)
    assert found.held_out.ncc > 0.97
    bright = found.measured - np.median(found.measured)
    assert np.linalg.norm(found.predicted - found.measured) < 0.2 * np.linalg.norm(
        bright
    )


def test_shuffled_planes_are_refused():
    model = PupilModel(SPEC, np.linspace(-8, 8, 9))
    x = pupilfit.transfer_parameters(truth(make()), make(), model)
    model.unpack(x)["stage"][:] = 0
    frames = model.images(x, False)[0]
    assert (
        pupilfit.fit_pupil(
            shots_of(frames), dataclasses.replace(SPEC, step_um=2.0)
        ).held_out.ncc
        > 0.97
    )
    with pytest.raises(FitError, match=r"planes (are missing or )?out of order"):
        pupilfit.fit_pupil(
            shots_of(frames[[4, 0, 7, 2, 8, 5, 1, 6, 3]]),
            dataclasses.replace(SPEC, step_um=2.0),
        )


def test_a_wrong_aperture_is_refused_with_the_share_of_light_missed():
    with pytest.raises(FitError, match="of the light beyond noise"):
        pupilfit.fit_pupil(
            shots_of(wide()), dataclasses.replace(SPEC, numerical_aperture=0.12)
        )


def test_missing_wavelength_pixel_or_positions_are_refused():
    model = make()
    shots = noisy(model, truth(model))
    for key in ("wavelength_um", "pixel_um"):
        with pytest.raises(CaptureError, match=f"{key} is missing"):
            pupilfit.fit_pupil(shots, dataclasses.replace(SPEC, **{key: math.nan}))
    lost = dataclasses.replace(shots, position_um=np.full(5, np.nan))
    with pytest.raises(CaptureError, match="stage positions are missing"):
        pupilfit.fit_pupil(lost, SPEC)
    with pytest.raises(FitError, match="numerical_aperture"):
        PupilSpec(1.2, 0.5, 0.1)


@pytest.mark.skipif(not BEADS.is_dir(), reason="real captures are not here")
def test_a_stack_without_metadata_is_refused():
    shots = capture.load(BEADS / "BIL113_zstack_z300nm_current.tif")
    assert shots.bits == 12
    with pytest.raises(CaptureError, match="wavelength_um is missing"):
        pupilfit.fit_pupil(shots, PupilSpec(0.85, step_um=0.3))


@pytest.mark.slow
@pytest.mark.skipif(not BEADS.is_dir(), reason="real captures are not here")
def test_real_beads_predict_the_planes_left_out():
    shots = capture.load(BEADS / "psf_wl520nm_z300nm_x130nm_na0.85_n1.0.tif")
    fit = pupilfit.fit_pupil(shots, PupilSpec(0.85, 0.52, 0.13, step_um=0.3))
    assert fit.held_out.ncc >= 0.975
    assert fit.held_out.nrmse <= 0.20
    assert fit.held_out.plane_ncc >= 0.975


def test_command_writes_a_pupil_file_and_a_page(tmp_path, fine_pictures):
    from metalens.core import store

    model = make()
    tifffile.imwrite(tmp_path / "stack.tif", noisy(model, truth(model)).frames)
    (tmp_path / "pupil.toml").write_text(
        "numerical_aperture = 0.3\nwavelength_um = 0.5\npixel_um = 0.4\nstep_um = 4.0\nwindow = 16\nphase_order = 4\n"
        "amplitude_order = 1\ndrift_order = 1\n"
    )
    words = f"fit {tmp_path}/stack.tif --pupil {tmp_path}/pupil.toml -o {tmp_path}/p.h5"
    assert call(f"{words} --quiet") == 0
    assert store.load(tmp_path / "p.h5", "pupil").attributes["agreement_ncc"] > 0.99
    assert (tmp_path / "p.html").stat().st_size > 10000
    assert call(words) == 2  # exists, no --force


def test_command_ends_with_1_where_a_fit_is_refused(tmp_path, capsys):

    random = np.random.default_rng(0)
    frames = random.poisson(200, (9, 32, 32)).astype(np.uint16)  # no bead anywhere
    tifffile.imwrite(tmp_path / "stack.tif", frames, photometric="minisblack")
    (tmp_path / "pupil.toml").write_text(
        "numerical_aperture = 0.3\nwavelength_um = 0.5\npixel_um = 0.4\nstep_um = 4.0\nwindow = 16\nphase_order = 4\n"
        "amplitude_order = 1\ndrift_order = 1\n"
    )
    words = f"fit {tmp_path}/stack.tif --pupil {tmp_path}/pupil.toml -o {tmp_path}/p.h5"
    assert call(f"{words} --quiet") == 1
    assert not (tmp_path / "p.h5").exists()
    capsys.readouterr()
    assert call(f"{words} --json --insist") == 1
    told = json.loads(capsys.readouterr().out)
    assert told["failures"] == told["problems"] != []
    assert (tmp_path / "p.h5").exists()
