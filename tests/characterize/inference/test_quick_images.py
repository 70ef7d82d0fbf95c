"""A quick model put right at one lens: images of all lenses that explain the same
frames differ from the whole model's
by less than the noise can tell."""

import functools
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import leastsquares, search
from characterize.inference.arrange import FrameArrangement
from characterize.model import (
    ForwardModel,
    FrameSetting,
    KnownValue,
    moments,
    parameter_vector,
)

DEPTHS = (560.0, 600.0, 640.0)
FREE = {
    "bias_nm",
    "bias_x_nm",
    "stage_zero_um",
    "distance_um",
    "coma_x_rad",
    "log_gain",
    "background_e",
}


@functools.cache
def fitted():
    """The task of three frames near focus, its fit, and the quick model put right
    there.
    """
    data, model = b.near_focus(DEPTHS, bias_nm=6.0, stage_zero_um=4.0, coma_x_rad=0.2)
    start = parameter_vector({"crosstalk_px": 0.2})
    held = {
        p.name: KnownValue(p.name, p.start)
        for p in search.PARAMETERS
        if p.name not in FREE
    }
    found = FrameArrangement(0, 0, (0, 0), 1, np.arange(3), False, True, 0, False, ())
    about = search.SearchTask(model, data, start, held, found)
    begin = search.starting_points(about, biases_nm=(0.0,))[0]
    mode = search.refine_fit(about, begin[[search.PLACE[name] for name in about.names]])
    return about, mode, search.correct_surrogate(about, mode)


def test_it_is_the_whole_model_at_its_place_and_its_part_for_some_frames():
    about, mode, quick = fitted()
    want, slopes = about.problem()(mode.value, True)
    got, rates = quick.problem()(mode.value, True)
    assert got == pytest.approx(want, abs=1e-3)  # electrons: single precision of 6000
    assert np.abs(rates - mode.slopes).max() < 1e-3 * np.abs(slopes).max()
    some = np.array([0, 2])
    part, few = quick.problem(some)(mode.value, True)
    assert part == pytest.approx(want[some], abs=1e-3)
    assert np.abs(few - mode.slopes[:, some]).max() < 1e-3 * np.abs(slopes).max()


def test_it_leaves_out_a_percent_and_yet_differs_by_no_tenth_of_a_sigma_within_the_posterior():
    """What few terms leave out is seen in the image itself; of the change by 2.5 sigma
    of the parameters they leave out
    a few percent: less than 0.1 sigma, whose square is 0.01."""
    about, mode, quick = fitted()
    noise = np.sqrt(about.data.variance(mode.image))
    plain = about.model.quick().images(about.all_of(mode.value))[0]
    assert np.linalg.norm((plain - mode.image) / noise) > 0.3
    size, turn = np.linalg.eigh(mode.covariance)
    apart = []
    for way in np.random.default_rng(3).standard_normal((6, len(size))):
        value = mode.value + turn @ (np.sqrt(size) * 2.5 * way / np.linalg.norm(way))
        got, want = (one.problem()(value, False)[0] for one in (quick, about))
        apart.append(float((((got - want) / noise) ** 2).sum()))
    assert 1e-7 < max(apart) < 0.01


def test_its_slopes_miss_a_few_percent_where_polynomials_stand_for_smooth_factors(
    monkeypatch,
):
    """Factors that polynomials miss by up to 5 % in place of 0.5 %, and few terms; as
    on a lens of large pixels.
    """
    about, mode, _ = fitted()
    monkeypatch.setattr(moments, "_COARSE_PIXEL", 0.2)
    x, names = about.all_of(mode.value), about.names
    slopes = [
        np.asarray(model.images(x, names)[1])
        for model in (about.model, about.model.quick())
    ]
    for name, want, got in zip(names, *slopes, strict=True):
        assert np.linalg.norm(got - want) < 0.05 * np.linalg.norm(want), name


def test_a_fit_by_it_from_afar_ends_where_that_of_the_whole_model_does():
    """To a tenth of a sigma, of which the end of either fit is 0.02."""
    about, mode, quick = fitted()
    begin = mode.value + 6 * np.sqrt(np.diag(mode.covariance)) * np.where(
        np.arange(len(mode.value)) % 2, 1, -1
    )
    found = leastsquares.fit_levenberg_marquardt(
        quick.problem(), about.data, begin, prior=about.prior
    )
    assert (
        np.abs(found.value - mode.value) / np.sqrt(np.diag(mode.covariance))
    ).max() < 0.1
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(
        np.sqrt(np.diag(mode.covariance)), rel=0.03
    )


def test_terms_of_the_usual_distance_are_turned_and_as_bright_as_own_ones():
    """On the axis and at an angle, 2 % farther and 1 % longer in wavelength: the field
    of one term differs from that
    of an own one by less than half of what one term leaves out, and is as bright."""
    angles = np.array([[0.0, 0.0], [0.21, -0.13]])
    setting = FrameSetting(np.array([600.0, 600.0]), angles, np.ones(2), 1.5, 16, 16)
    model = ForwardModel(b.lens(), setting, b.RESPONSE)
    assert len(model.groups) == 2
    for group in model.groups:
        own, near = group.reduced, group.reduced.quick()
        about = {
            "wavelength_um": 0.8585,
            "distance_um": 112.2,
            "axes_um": model.grid.axes_um(),
        }
        whole = own.operators(**about).coarse(own.gathered[0])
        one, got = (
            part.operators(**about).coarse(part.gathered[0], np.inf)
            for part in (own, near)
        )
        missed = np.linalg.norm(one - whole) / np.linalg.norm(whole)
        assert 1e-3 < missed < 0.2
        assert np.linalg.norm(got - one) / np.linalg.norm(one) < 0.5 * missed
        assert np.vdot(got, got).real == pytest.approx(np.vdot(one, one).real, rel=5e-3)


def test_a_quick_model_has_fewer_samples_and_terms_and_rougher_slopes_than_its_own():
    """Samples a pixel are 4 sin / wavelength = 0.842 / um times its side at least, of a
    quick one 0.85 of that.
    """
    about = fitted()[0]
    assert (about.model.quick().cut, about.model.cut) == (0.02, 0.0)
    for pixel_um, whole, fewer in ((1.5, 2, 2), (2.6, 3, 2), (1.3, 2, 1)):
        one = ForwardModel(
            b.lens(),
            FrameSetting(
                np.array([600.0]), np.zeros((1, 2)), np.ones(1), pixel_um, 8, 8
            ),
            b.RESPONSE,
        )
        assert (one.grid.oversample, one.quick().grid.oversample) == (whole, fewer), (
            pixel_um
        )
        assert one.quick().grid.margin == one.grid.margin
