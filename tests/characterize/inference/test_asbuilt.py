"""The reduced model against the sum over every pillar, its derivatives, and the fit of
a hidden lens.
"""

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

import characterize
from characterize.inference import asbuilt
from characterize.inference.asbuilt import AsBuilt
from characterize.inference.estimate import FitOptions
from characterize.model import as_built
from characterize.model.forward import ForwardModel, FrameSetting
from characterize.model.parameters import (
    NAMES,
    PARAMETERS,
    PLACE,
    KnownValue,
    parameter_vector,
)
from characterize.model.pillars import PillarResponse
from metalens import psf
from metalens.cell import Cell
from metalens.cell.shapes import Rectangle
from metalens.core.errors import CaptureError, ConfigError, FitError
from metalens.psf.lens_psfs import View
from tests.command_line import call

SETTING = FrameSetting(np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), 1.5, 16, 16)
USUAL = FitOptions(scan_um=60.0)
GLASS = {"glass_um": 40.0, "glass_tilt_x_deg": 5.0, "glass_tilt_y_deg": -3.0}


@pytest.fixture(scope="module")
def model():
    return ForwardModel(b.lens(), SETTING, b.RESPONSE)


def fit_usual(shots=None):
    known = dataclasses.replace(b.RESPONSE, error=0.08)
    shots = shots or b.capture(b.electrons())
    return characterize.fit(shots, b.lens(), USUAL, response=known)


@pytest.fixture(scope="module")
def fitted():
    return fit_usual()


@pytest.mark.slow
def test_a_fit_is_the_same_bytes_for_any_number_of_threads(fitted):
    before = torch.get_num_threads()
    torch.set_num_threads(3 if before == 1 else 1)
    try:
        other = fit_usual()
    finally:
        torch.set_num_threads(before)
    for name in ("value", "covariance", "low", "high", "draws", "predicted"):
        assert np.array_equal(getattr(other, name), getattr(fitted, name)), name


def against_all_pillars(model, **more):
    x = parameter_vector(b.VALUES | more | {"background_e": 0.0, "background_x_e": 0.0})
    found, want = model.images(x)[0], b.light(**more)
    scale = (found * want).sum() / (found**2).sum()
    return abs(scale * found - want).max() / want.max()


def test_reduced_model_agrees_with_the_sum_over_every_pillar(model):
    # low-rank pillars 5e-4 in t, window operators 5e-4
    assert against_all_pillars(model) < 1e-3


def test_tilt_and_source_beside_the_axis_agree_too(model):
    assert (
        against_all_pillars(
            model, tilt_x_deg=0.3, source_x_um=5.0, source_y_um=-3.0, pinhole_um=6.0
        )
        < 2e-3
    )


def test_uneven_light_agrees_with_the_sum_over_every_pillar(model):
    """30 % more light at one rim, 20 % less at another: amplitudes, one by one, on the
    bench.
    """
    assert against_all_pillars(model, light_x=0.26, light_y=-0.22, light_r=0.15) < 1e-3


def test_low_rank_pillars_know_their_error():
    pillars = PillarResponse(b.lens(), b.RESPONSE)
    assert len(pillars.basis) < 16
    assert pillars.error < 1e-3


# of rectangles, below: round pillars have none
SIDES = ("width_nm", "length_nm", "turn_deg")
FILMS = ("pedestal_nm", "cap_nm")  # of pillars in layers


@pytest.mark.parametrize(
    "name", [n for n in NAMES if n not in ("bandwidth_nm", *SIDES, *FILMS)]
)
def test_derivatives_match_finite_differences(model, name):
    x = parameter_vector(
        b.VALUES
        | {"pinhole_um": 8.0, "tilt_x_deg": 0.3, "source_x_um": 6.0, "log_gain": 10.0}
        | GLASS
    )
    slopes_are_differences(model, name, x)


def slopes_are_differences(model, name, x):
    # images are in single precision: of a wall, that acts little, its rounding would be
    # 2 % of so small a difference
    h = (0.3 if name == "sidewall_deg" else 0.1) * PARAMETERS[PLACE[name]].scale
    up, down = x.copy(), x.copy()
    up[PLACE[name]] += h
    down[PLACE[name]] -= h
    want = (model.images(up)[0] - model.images(down)[0]) / (2 * h)
    slope = model.images(x, [name])[1][0]
    # operators of derivatives are cut at 3e-3 of all
    assert abs(slope - want).max() < 2e-2 * np.abs(want).max()


@pytest.fixture(scope="module")
def of_rectangles():
    """Slopes by sides and turn, and by edges beyond the size, as of some rectangle."""
    lens = dataclasses.replace(b.lens(), cell=Cell(0.4, shape=Rectangle(0.7)))
    rows = np.vstack(
        [
            b.RESPONSE.coefficients,
            [[0.1 + 12j, 70j], [0.2 + 7j, 30j], [-0.5 + 0.8j, 4j]],
        ]
    )
    response = dataclasses.replace(
        b.RESPONSE, coefficients=rows, edges=np.array([[0.1 + 6j, 40j]])
    )
    return ForwardModel(lens, SETTING, response)


@pytest.mark.parametrize("name", [*SIDES, "bias_nm", "bias_x_nm"])
def test_derivatives_by_sides_edges_and_turn_match_finite_differences(
    of_rectangles, name
):
    x = parameter_vector(
        b.VALUES
        | {"log_gain": 10.0, "width_nm": 3.0, "length_nm": -2.0, "turn_deg": 0.7}
    )
    slopes_are_differences(of_rectangles, name, x)


def test_a_point_source_has_a_slope_by_its_size(model):
    """Light changes as the square of the size: no slope at 0. That of 0.3 pixels is
    taken, twice the chord to there.
    """
    x = parameter_vector(b.VALUES)
    slope = model.images(x, ["pinhole_um"])[1][0]
    for i, depth in enumerate(b.DEPTHS):
        size = 0.3 * 1.5 * depth * 1.004 / 112.0
        chord = (
            model.images(parameter_vector(b.VALUES | {"pinhole_um": size}))[0]
            - model.images(x)[0]
        )[i] / size
        assert abs(slope[i] - 2 * chord).max() < 0.1 * abs(2 * chord).max()


def test_a_point_source_is_not_thrown_to_the_bound_of_its_size():
    """Without a slope at 0 a search jumps to 2 mm, and the size comes back with a sigma
    of 1e36.
    """
    free = dataclasses.replace(USUAL, free=("pinhole_um",))
    found = characterize.fit(
        b.capture(b.electrons(), seed=1), b.lens(), free, response=b.RESPONSE
    )
    i = found.names.index("pinhole_um")
    assert found.trusted
    assert found.value[i] < 4
    # 0.45 um on the sensor, where a pixel of 1.5 um and its crosstalk blur too
    assert 0.3 < found.sigma[i] < 10


def test_hidden_lens_is_found_within_its_intervals(fitted):
    assert fitted.trusted
    assert fitted.converged
    assert 0.93 < fitted.chi2_per_dof < 1.07  # sqrt(2 / 1250) is 0.04
    names = [n for n in fitted.names if n != "log_gain"]
    z = [
        (fitted.value[fitted.names.index(n)] - b.VALUES.get(n, 0.0))
        / fitted.sigma[fitted.names.index(n)]
        for n in names
    ]
    z = np.array(z) * fitted.sigma[[fitted.names.index(n) for n in names]]
    z /= np.sqrt(np.diag(fitted.within_covariance))[
        [fitted.names.index(n) for n in names]
    ]
    assert np.abs(z).max() < 4
    assert np.sqrt(np.mean(np.square(z))) < 1.5


def test_mirrored_frames_have_the_opposite_decentre(fitted):
    """The axis lies at (n - 1) / 2: 16 pixels have no middle one. Both fits see the
    same noise, so that only the search differs: a tenth of a standard error, 0.03 um.
    """
    plain = b.capture(b.electrons())
    mirrored = dataclasses.replace(plain, frames=plain.frames[..., ::-1].copy())
    other = fit_usual(mirrored)
    for name, sign in (("decentre_x_um", -1), ("decentre_y_um", 1)):
        i = fitted.names.index(name)
        assert other.value[i] == pytest.approx(sign * fitted.value[i], abs=0.06), name


def test_predicted_frames_are_nearer_the_truth_than_the_noise(fitted):
    want = b.electrons()
    assert np.linalg.norm(fitted.predicted - want) < 0.02 * np.linalg.norm(want - 20)


def test_degeneracies_are_named(fitted):
    words = " ".join(fitted.degeneracies)
    assert "bias_x_nm and decentre_x_um" in words
    assert "wavelength_nm comes from prior knowledge" in words
    assert fitted.identifiable


def test_nothing_is_found_where_nothing_is(fitted):
    assert "residuals lean" not in " ".join(fitted.cautions)
    assert "slopes of the pillars" not in " ".join(fitted.cautions)  # known to 8 %


def test_orientation_of_a_symmetric_design_is_declared_unobservable(fitted):
    assert any(
        "orientation of the frames cannot be seen" in words for words in fitted.cautions
    )


def test_what_cannot_be_told_is_reckoned_with_beside_the_model(fitted):
    """A plate of glass moves the stage zero, a source of some size the blur; the
    interval holds that of the model.
    """
    assert "a plate of glass in the beam" in fitted.most("stage_zero_um")
    assert "a source of finite size" in fitted.most("crosstalk_px")
    for name in fitted.names:
        low, high = fitted.within_model(name)
        least, most = fitted.interval(name)
        assert least <= low < high <= most
    low, high = fitted.within_model("crosstalk_px")
    least, most = fitted.interval("crosstalk_px")
    assert most - least > 2 * (high - low)  # 5 um of source blur by a third of a pixel


def test_saved_result_comes_back(fitted, tmp_path):
    fitted.save(tmp_path / "a.h5")
    again = AsBuilt.load(tmp_path / "a.h5")
    assert again.names == fitted.names
    assert np.array_equal(again.covariance, fitted.covariance)
    assert again.degeneracies == fitted.degeneracies
    assert again.causes == fitted.causes
    assert again.interval("bias_nm") == fitted.interval("bias_nm")
    assert again.within_model("bias_nm") == fitted.within_model("bias_nm")
    assert np.array_equal(again.lens_samples(3, seed=1), fitted.lens_samples(3, seed=1))
    assert np.array_equal(again.diameters.diameter_um, fitted.diameters.diameter_um)
    assert again.samples(3, seed=1).shape == (3, len(fitted.names))
    fitted.save(tmp_path / "b.h5")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_psfs_of_the_as_built_lens_hold_process_and_wave_front(fitted, tmp_path):
    """The PSFs of a file are those of the fit, and of the hidden lens; a draw of the
    posterior gives others.
    """
    fitted.save(tmp_path / "a.h5")
    again = AsBuilt.load(tmp_path / "a.h5")
    stack = again.psf()
    assert np.array_equal(stack.intensity, fitted.psf().intensity)
    true = b.truth().vector()
    want = psf.psf_stack(
        *(
            f(as_built.as_built_transmission(b.lens(), b.RESPONSE, true))
            for f in (np.angle, np.abs)
        ),
        pitch_um=0.4,
        wavelength_um=0.85 + 0.4e-3,
        sensor_distance_um=112.0,
        depths_um=stack.depths_um,
        window_um=24.0,
        samples=stack.intensity.shape[-1],
        offset_um=[
            b.VALUES[n] - fitted.value[fitted.names.index(n)]
            for n in ("decentre_x_um", "decentre_y_um")
        ],
    )
    found = stack.intensity[0]
    assert np.linalg.norm(found - want.intensity) < 0.03 * np.linalg.norm(
        want.intensity
    )  # intervals of the fit
    view = View((600.0,), ((0.0, 0.0), (0.05, 0.0)), 24.0, 48)
    draw = again.psf_stack(view, again.lens_samples(1, seed=2)[0])
    best = again.psf_stack(view)
    assert draw.intensity.shape == (2, 1, 48, 48)
    assert (
        1e-4
        < np.linalg.norm(draw.intensity - best.intensity)
        / np.linalg.norm(best.intensity)
        < 0.05
    )


def clipped(low, high):
    """Standard deviation of a normal number that is set to ``low`` below it, and to
    ``high`` above it.
    """
    below, above = stats.norm.cdf(low), stats.norm.sf(high)
    mean = low * below + high * above + stats.norm.pdf(low) - stats.norm.pdf(high)
    inner = 1 - below - above + low * stats.norm.pdf(low) - high * stats.norm.pdf(high)
    return np.sqrt(low**2 * below + high**2 * above + inner - mean**2)


def test_samples_have_the_posterior_covariance_but_for_what_bounds_cut_off(fitted):
    """A bias along x may be 2 sigma from its bound: 3 % of its spread lies on it."""
    count = 20000
    rows = asbuilt.usual_parameters(fitted.names, fitted.design)
    low, high = (
        np.array([getattr(row, side) for row in rows]) - fitted.value
        for side in ("low", "high")
    )
    # no infinity times 0
    reach = np.clip([low / fitted.sigma, high / fitted.sigma], -1e3, 1e3)
    draws = fitted.samples(count, seed=0)
    want = fitted.sigma * clipped(*reach)
    # 4 sigma of a standard deviation
    assert draws.std(0) == pytest.approx(want, rel=4 / np.sqrt(2 * count))
    far = np.abs(reach).min(0) > 3  # there bounds take less than 0.005 of the variance
    assert far.sum() > 15
    # what the mask takes along is not drawn anew
    own = fitted.within_covariance + fitted.bench
    for drawn, covariance in (
        (draws, fitted.covariance),
        (fitted.lens_samples(count, seed=3), own),
    ):
        sigma = np.sqrt(np.diag(covariance))
        unlike = (np.cov(drawn.T) - covariance) / np.outer(sigma, sigma)
        # 4 sigma of a variance
        assert np.abs(unlike[np.ix_(far, far)]).max() < 0.005 + 4 * np.sqrt(2 / count)
    sigma = fitted.sigma
    assert (
        np.linalg.eigvalsh((fitted.covariance - own) / np.outer(sigma, sigma)) > -1e-9
    ).mean() > 0.5


def test_captures_of_another_lens_are_refused():
    random = np.random.default_rng(0)
    other = np.zeros((5, 16, 16))
    for frame in other:
        frame[tuple(random.integers(0, 16, (2, 30)))] = 3000.0
    with pytest.raises(FitError, match="another lens"):
        characterize.fit(b.capture(other + 20), b.lens(), USUAL, response=b.RESPONSE)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"pixel_um": np.nan}, "pixel_um is missing"),
        ({"wavelength_um": np.nan}, "wavelength_um is missing"),
        ({"position_um": np.full(5, np.nan)}, "source depths are missing"),
    ],
)
def test_missing_numbers_are_refused(change, words):
    shots = dataclasses.replace(b.capture(b.electrons()), **change)
    with pytest.raises(CaptureError, match=words):
        characterize.fit(shots, b.lens(), USUAL, response=b.RESPONSE)


def test_what_is_never_fitted_is_stated_by_its_size_alone():
    assert KnownValue("stitching_nm", 0.0, 8.0).sigma == 8.0
    with pytest.raises(ConfigError, match="value = 0"):
        KnownValue("stitching_nm", 3.0, 8.0)
    with pytest.raises(ConfigError, match="never fitted"):
        parameter_vector({"stitching_nm": 0.0})


def test_what_is_stated_is_not_reckoned_with():
    """No glass, a point source, a mask of one field, a measured pixel: none of them
    widens an interval any more.
    """
    stated = {"glass_um": 0.0, "pinhole_um": 0.0, "pixel_sigma_um": 0.0}
    shots = b.capture(b.electrons())
    shots = dataclasses.replace(shots, about=shots.about | stated)
    options = dataclasses.replace(
        USUAL, known=(KnownValue("stitching_nm", 0.0), KnownValue("sidewall_deg", 0.0))
    )
    found = characterize.fit(
        shots, b.lens(), options, response=dataclasses.replace(b.RESPONSE, error=0.23)
    )
    assert (
        "slopes of the pillars by height and index are known to 23% only"
        in found.cautions
    )
    assert found.causes
    for word in ("glass", "source of finite", "write field", "pixel", "side wall"):
        assert not any(word in cause for cause in found.causes), word


def test_psfs_of_a_fitted_lens_hold_its_posterior_in_their_error(
    fitted, tmp_path, capsys
):
    """A lens known but for 3 um of its distance: its PSFs are off by 3 um times their
    slope, relative L2, to the scatter of 8 draws (a quarter, at 2.5 sigma 0.6). The
    command takes the angles of the captures.
    """
    i = fitted.names.index("distance_um")
    covariance = np.zeros_like(fitted.covariance)
    covariance[i, i] = 3.0**2
    within = dataclasses.replace(
        fitted.within, covariance=covariance, draws=np.empty((0, 0))
    )
    bench = np.zeros_like(covariance)
    known = dataclasses.replace(
        fitted,
        covariance=covariance,
        draws=np.empty((0, 0)),
        within=within,
        bench=bench,
    )
    known.save(tmp_path / "asbuilt.h5")
    words = f"psf {tmp_path}/asbuilt.h5 -o {tmp_path}/psf.h5"
    more = "--sources-mm 2 --window-um 24 --samples 48 --json"
    assert call(f"{words} {more}") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["angles_rad"] == pytest.approx(np.unique(fitted.angle_rad, axis=0))
    view = View((2e3,), ((0.0, 0.0),), window_um=24.0, samples=48)
    ends = []
    for step in (-1.0, 1.0):
        value = fitted.value.copy()
        value[i] += step
        ends.append(fitted.psf_stack(view, value).intensity)
    slope = (ends[1] - ends[0]) / 2
    want = 3 * np.linalg.norm(slope) / np.linalg.norm(ends[0] + ends[1]) * 2
    assert said["error"] == pytest.approx(want, rel=0.6)
    assert said["budget"]["posterior"] == pytest.approx(said["error"], rel=0.01)
    assert said["computed_error"] < 1e-4
