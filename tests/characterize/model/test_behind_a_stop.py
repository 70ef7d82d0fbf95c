"""Lenses behind an aperture stop: frames of the model beside those of the bench, whose
engine sums over every pillar at
every depth and is judged by plane waves through the glass
(tests/metalens/psf/test_aperture_stop.py)."""

import dataclasses
import functools
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.bench import bench
from characterize.bench.bench import BenchCamera, HiddenLens
from characterize.inference import causes
from characterize.inference.causes import model_behind_stop
from characterize.inference.search import SearchTask
from characterize.model import forward
from characterize.model.forward import ForwardModel, FrameSetting
from characterize.model.parameters import (
    NAMES,
    KnownValue,
    parameter_vector,
    unfitted_sizes,
)
from metalens import design, profiles
from metalens.cell import Cell, Film, Index
from metalens.core.errors import ConfigError, PropagationError
from metalens.lens import Layers, Stop

DEPTHS = (470.0, 640.0, 910.0)
FACE = Stop(13.0, 63.0, (1.5, -2.0))  # on the other face of 63 um of glass


@functools.lru_cache
def open_lens():
    """40 um wide, focused from 600 um through its substrate on its sensor."""
    focus = profiles.Focus(
        0.85, 117.0, 600.0, layers=Layers(front=(Film(Index(1.45), 63.0),))
    )
    phase = design.phase_of(None, focus, radius_um=20.0)
    return design.make(
        phase, focus, aperture_um=40.0, cell=Cell(pitch_um=0.4), proxy=b.proxy()
    )[0]


def lens(stop=FACE):
    """The same behind a stop."""
    return dataclasses.replace(
        open_lens(), layers=dataclasses.replace(open_lens().layers, stop=stop)
    )


def setting(angles=((0.0, 0.0),), depths=DEPTHS, **about):
    n = len(depths)
    every = np.repeat(np.array(angles), n, 0)
    tight = {"tolerance": 2e-5} | about
    return FrameSetting(
        np.tile(depths, len(angles)),
        every,
        np.ones(n * len(angles)),
        1.5,
        12,
        12,
        **tight,
    )


def shown(made, angle_deg):
    """Frames of the bench at two depths, in units of its own."""
    known = tuple(KnownValue(name, value) for name, value in VALUES.items())
    truth = HiddenLens(
        DEPTHS[:2],
        (angle_deg,),
        parameter=known,
        camera=BenchCamera(pixel_um=1.5, pixels=8),
    )
    return bench.bench_irradiance(made, truth, b.RESPONSE)


def expected(made, angle_deg):
    """The same by the model."""
    angle = np.radians(angle_deg), 0.0
    at = FrameSetting(
        np.array(DEPTHS[:2]),
        np.array([angle] * 2),
        np.ones(2),
        1.5,
        8,
        8,
        tolerance=2e-5,
    )
    return ForwardModel(made, at, b.RESPONSE).images(parameter_vector(VALUES))[0]


VALUES = {
    "distance_um": 3.0,
    "crosstalk_px": 0.25,
    "bias_nm": 3.0,
    "coma_x_rad": 0.2,
    "background_e": 0.0,
}
CASES = [
    (FACE, 5.0),
    (Stop(9.0, 0.0, (0.0, 1.0)), 0.0),
    (Stop(11.0, 120.0), -4.0),
]  # the last one before the glass


@pytest.mark.parametrize(("stop", "angle_deg"), CASES)
def test_the_bench_shows_what_the_model_expects_behind_a_stop(stop, angle_deg):
    """By the gain of the lens without its stop, so that the light that it keeps counts
    too: 2e-5 is asked of the field
    twice, of both lenses. A stop half a micrometre off is told."""
    open_, want = shown(lens(None), angle_deg), expected(lens(None), angle_deg)
    seen = shown(lens(stop), angle_deg) * (np.vdot(open_, want) / np.vdot(open_, open_))
    got = expected(lens(stop), angle_deg)
    assert got.sum() < 0.6 * want.sum()
    assert np.linalg.norm(got - seen) < 8e-5 * np.linalg.norm(seen)
    beside = expected(
        lens(
            dataclasses.replace(
                stop, centre_um=(0.5 + stop.centre_um[0], stop.centre_um[1])
            )
        ),
        angle_deg,
    )
    assert np.linalg.norm(beside - seen) > 5e-4 * np.linalg.norm(seen)


def test_derivatives_behind_a_stop_are_differences_of_images(monkeypatch):
    """The shadow stays with the stated depths and angles: of both model and
    differences.
    """
    monkeypatch.setattr(forward, "_SLOPE_TOLERANCE", 1e-4)
    model = ForwardModel(
        lens(), setting(((0.09, -0.05),), DEPTHS[:2], tolerance=1e-7), b.RESPONSE
    )
    base = parameter_vector(VALUES | {"pinhole_um": 4.0, "log_gain": 5.0})
    steps = {
        "distance_um": 0.02, "stage_zero_um": 0.2, "decentre_y_um": 0.02, "tilt_x_deg": 0.01, "bias_nm": 0.05,
        "bias_x_nm": 0.05, "coma_x_rad": 1e-3, "pinhole_um": 0.1,
    }  # fmt: skip
    slopes = model.images(base, list(steps))[1]
    for (name, step), slope in zip(steps.items(), slopes, strict=True):
        way = step * (np.array(NAMES) == name)
        want = (model.images(base + way)[0] - model.images(base - way)[0]) / (2 * step)
        assert np.linalg.norm(slope - want) < 2e-3 * np.linalg.norm(want), name


def test_quick_models_of_all_depths_share_their_operators():
    """They miss a per cent of the light, as without a stop; a part of the frames is the
    part of all.
    """
    model = ForwardModel(
        lens(), setting(((0.0, 0.0), (0.07, 0.0)), tolerance=5e-4), b.RESPONSE
    )
    x = parameter_vector(VALUES)
    whole, quick = model.images(x)[0], model.quick()
    assert np.linalg.norm(quick.images(x)[0] - whole) < 0.02 * np.linalg.norm(whole)
    assert [[one.index.tolist() for one in group.lit] for group in quick.groups] == [
        [[0], [1], [2]],
        [[3], [4], [5]],
    ]
    kept = [{id(one.reduced._operators) for one in group.lit} for group in quick.groups]
    assert len(kept[0]) == len(kept[1]) == 1
    assert kept[0] != kept[1]
    some = np.array([1, 3, 4])
    assert np.array_equal(model.only(some).images(x)[0], whole[some])


def test_a_stop_at_the_pillars_shades_all_depths_alike():
    (group,) = ForwardModel(lens(Stop(9.0)), setting(), b.RESPONSE).groups
    assert [one.index.tolist() for one in group.lit] == [[0, 1, 2]]


def test_the_model_behind_another_stop_is_that_of_the_other_lens():
    """What is held of a model stays: its window, its cut, a phase of its own."""
    at, other, x = (
        setting(depths=DEPTHS[:1], tolerance=5e-4),
        Stop(10.0, 63.0, (-1.0, 0.5)),
        parameter_vector(VALUES),
    )
    model = ForwardModel(lens(), at, b.RESPONSE)
    want = ForwardModel(lens(other), at, b.RESPONSE).images(x)[0]
    assert model_behind_stop(model, other).images(x)[0] == pytest.approx(want, rel=1e-6)
    held = model_behind_stop(model.about((2.0, -1.0)).rough(0.01), other)
    assert (held.grid.middle_um, held.cut) == ((2.0, -1.0), 0.01)


def test_a_stop_off_its_place_is_a_cause_of_its_own():
    """3 um each way where nobody says more; what it does is what another lens shows.
    Light that it takes, it takes.
    """
    model, x = (
        ForwardModel(lens(), setting(depths=DEPTHS[:2], tolerance=5e-4), b.RESPONSE),
        parameter_vector(VALUES),
    )
    image = model.images(x)[0]
    for stated, sigma in (({}, 1.0), ({"stop_um": 0.75}, 0.25)):
        task = SearchTask(model, None, x, {}, None, (), stated)
        found = list(causes._of_stop(task, x, image))
        assert [one.cause for one in found] == [
            "an aperture stop off along x",
            "an aperture stop off along y",
        ]
        assert [one.sigma for one in found] == pytest.approx([sigma] * 2)
    for one, centre in zip(found, ((4.5, -2.0), (1.5, 1.0)), strict=True):
        moved = ForwardModel(
            lens(Stop(13.0, 63.0, centre)), model.setting, b.RESPONSE
        ).images(x)[0]
        assert one.images[0] == pytest.approx(moved - image, abs=1e-6 * image.max())
        assert np.abs(one.images).max() > 0.02 * image.max()
    plain = SearchTask(
        ForwardModel(lens(None), model.setting, b.RESPONSE), None, x, {}, None
    )
    assert not list(causes._of_stop(plain, x, image))


def test_a_source_behind_the_stop_is_refused():
    with pytest.raises(PropagationError, match="lies behind the stop"):
        ForwardModel(lens(), setting(depths=(50.0, 640.0)), b.RESPONSE)


def test_the_place_of_a_stop_is_stated_of_lenses_that_have_one():
    known = {
        "stop_um": KnownValue("stop_um", 0.0, 0.7),
        "bias_nm": KnownValue("bias_nm", 1.0),
    }
    assert unfitted_sizes(known, lens()) == {"stop_um": 0.7}
    assert list(known) == ["bias_nm"]
    with pytest.raises(ConfigError, match="no aperture stop"):
        unfitted_sizes({"stop_um": KnownValue("stop_um", 0.0, 0.7)}, lens(None))


@pytest.mark.slow
def test_a_hidden_lens_is_found_behind_its_stop():
    """Frames by the engine that designs; each value within 4 sigma of the model, whose
    stop lies as designed.
    """
    found, off, _ = b.found_again(lens())
    assert max(map(abs, off.values())) < 4, off
    assert found.chi2_per_dof == pytest.approx(1.0, abs=0.15)
