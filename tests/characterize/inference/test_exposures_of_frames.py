"""Frames of unlike exposures: light behind them grows with the exposure, what nobody
subtracted does not.
"""

import dataclasses
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.captures import to_electrons
from characterize.inference import prepare, search
from characterize.inference.search import SearchTask, refine_fit
from characterize.model import (
    PLACE,
    ForwardModel,
    FrameSetting,
    background_planes,
    parameter_vector,
)

DEPTHS, EXPOSURE = (420.0, 600.0, 1050.0), np.array([0.4, 1.0, 0.25])
SETTING = FrameSetting(np.array(DEPTHS), np.zeros((3, 2)), EXPOSURE, 1.5, 16, 16)
PLANE = {"background_e": 60.0, "background_x_e": 9.0, "background_y_e": -14.0}


@pytest.mark.parametrize(
    ("dark_known", "glow"), [(True, EXPOSURE), (False, np.ones(3))]
)
def test_the_background_is_a_plane_times_the_exposure_where_the_dark_level_is_subtracted(
    dark_known, glow
):
    """Pixel (3, 11) lies 7/16 of the way to the right edge, 9/16 to the upper one. Slopes
    by finite differences, which
    are exact of what is linear: to rounding of float64 differences of 60 electrons."""
    setting = dataclasses.replace(SETTING, dark_known=dark_known)
    model, x = (
        ForwardModel(b.lens(), setting, b.RESPONSE),
        parameter_vector(PLANE | {"log_gain": 12.0}),
    )
    assert background_planes(x, setting)[:, 3, 11] == pytest.approx(
        glow * (60 + 9 * 7 / 16 + 14 * 9 / 16)
    )
    slopes = model.images(x, list(PLANE))[1]
    for name, slope in zip(PLANE, slopes, strict=True):
        step = np.zeros_like(x)
        step[PLACE[name]] = 2.0
        told = (
            background_planes(x + step, setting) - background_planes(x - step, setting)
        ) / 4
        assert slope == pytest.approx(told, abs=1e-9)


def shot(model):
    """(x, data): 6000 electrons at the peak of the longest exposure, each frame by its
    own, shot and read noise.
    """
    x = parameter_vector(b.VALUES | PLANE | {"log_gain": 1.0})
    longest = dataclasses.replace(model.setting, exposure=np.ones(3))
    light = ForwardModel(b.lens(), longest, b.RESPONSE).images(x)[
        0
    ] - background_planes(x, longest)
    scale = 6000 / light.max()
    y, across = ((np.arange(16) - 7.5) / 8 for _ in range(2))
    electrons = EXPOSURE[:, None, None] * (
        scale * light + 60 + 9 * across - 14 * y[:, None]
    )
    electrons = electrons + np.random.default_rng(5).normal(0, np.sqrt(electrons + 9))
    everywhere = np.ones(electrons.shape, bool)
    data = b.FitImages(
        electrons,
        everywhere,
        ~everywhere,
        np.full(electrons.shape, 9.0),
        np.ones(electrons.shape),
    )
    x[PLACE["log_gain"]] = 1.0 + np.log(scale)
    return x, data


def test_a_fit_of_them_explains_the_frames_and_begins_at_their_background():
    """Chi-square of 768 pixels is 1 to 0.05; of a background that is one for all frames
    it is 4.7.
    """
    model = ForwardModel(b.lens(), SETTING, b.RESPONSE)
    x, data = shot(model)
    found = SimpleNamespace(shift_px=np.zeros(2), stage_zero_um=0.0, distance_um=0.0)
    task = SearchTask(model, data, x, {}, found)
    first = search.starting_points(task, biases_nm=(0.0,))[0]
    assert first[PLACE["background_e"]] == pytest.approx(
        60, abs=12
    )  # a median: the blur's rim is in it
    end = refine_fit(task, x[[PLACE[name] for name in task.names]])
    assert end.chi2_per_dof == pytest.approx(1, abs=0.2)
    for name, value in PLANE.items():
        i = task.names.index(name)
        assert end.value[i] == pytest.approx(value, abs=4 * end.covariance[i, i] ** 0.5)


def test_exposures_of_one_depth_are_not_made_one_where_nobody_says_what_is_counted_in_the_dark():
    """Counts of 64 without light would count for 128 of a frame at half the exposure."""
    one = b.capture(b.electrons())
    frames = np.concatenate([one.frames, one.frames])
    twice = dataclasses.replace(
        one, frames=frames, position_um=np.tile(b.DEPTHS, 2), angle_rad=np.zeros((10, 2)),
        exposure_s=np.repeat([2.0, 0.5], 5), names=tuple(map(str, range(10))),
    )  # fmt: skip
    blind = dataclasses.replace(twice, about={"gain_e": 2.0})
    for capture, count, known in ((twice, 5, True), (blind, 10, False)):
        after, merged = prepare.merge_exposures(capture, to_electrons(capture))
        assert len(after.frames) == len(merged.electrons) == count
        assert any("fitted one by one" in words for words in merged.corrections) == (
            not known
        )
        assert prepare.setting_of(after, 16)[0].dark_known == known
    alike = dataclasses.replace(blind, exposure_s=np.full(10, 2.0))
    assert len(prepare.merge_exposures(alike, to_electrons(alike))[0].frames) == 5
