"""Pixels that are not as high as they are wide: where such frames come from is seen,
and named before anything else.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.inference import causes
from characterize.inference.missing import CHANCE, run_score_tests
from characterize.inference.search import SearchTask, refine_fit
from characterize.model import PLACE, ForwardModel, FrameSetting, parameter_vector

_DEPTHS = 420.0, 600.0, 1050.0
_WIDE_UM, _FINE = 1.5, 10  # a pixel, and how many fine ones it is wide
_PLACE = {
    "decentre_x_um": 0.8,
    "decentre_y_um": -0.4,
    "coma_x_rad": 0.3,
    "astigmatism_rad": -0.2,
}


def at_rows(share: float) -> np.ndarray:
    """(5, 17, 17) light of pixels that lie ``share`` times as far apart each way, as
    wide as ever.
    """
    setting = FrameSetting(
        np.array(b.DEPTHS),
        np.zeros((5, 2)),
        np.ones(5),
        share * _WIDE_UM,
        17,
        17,
        fill=1 / share,
    )
    x = parameter_vector(_PLACE | {"log_gain": 10.0, "crosstalk_px": 0.25})
    return np.asarray(ForwardModel(b.lens(), setting, b.RESPONSE).images(x)[0])


def test_they_lie_farther_apart_along_one_axis_alone():
    """The middle column is that of pixels farther apart both ways, the middle row the
    one of pixels as they were.

    Models of their own for each pitch: fields to 5e-4, light to twice that.
    """
    setting = FrameSetting(
        np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), _WIDE_UM, 17, 17
    )
    x = parameter_vector(_PLACE | {"log_gain": 10.0, "crosstalk_px": 0.25})
    model = ForwardModel(b.lens(), setting, b.RESPONSE)
    (tall,) = causes.seen_at(model, x, [np.diag([1.06, 1.0])])
    apart, plain = at_rows(1.06), at_rows(1.0)
    error = 2e-3 * plain.max()
    assert np.abs(tall[:, :, 8] - apart[:, :, 8]).max() < error
    assert np.abs(tall[:, 8] - plain[:, 8]).max() < error
    assert np.abs(tall[:, :, 8] - plain[:, :, 8]).max() > 20 * error


def summed(rows: int) -> np.ndarray:
    """(3, 16, 16) light of pixels as wide as 10 and as high as ``rows`` fine ones, the
    middle one about the axis.
    """
    count = 17 * max(_FINE, rows)
    setting = FrameSetting(
        np.array(_DEPTHS), np.zeros((3, 2)), np.ones(3), _WIDE_UM / _FINE, count, count
    )
    x = parameter_vector(_PLACE | {"log_gain": 10.0, "crosstalk_px": 0.25 * _FINE})
    light = ForwardModel(b.lens(), setting, b.RESPONSE).images(x)[0]
    y, x0 = ((count - 16 * side) // 2 for side in (rows, _FINE))
    part = light[:, y : y + 16 * rows, x0 : x0 + 16 * _FINE]
    return np.asarray(part.reshape(3, 16, rows, 16, _FINE).sum((2, 4)))


def test_a_fit_that_knows_of_square_pixels_names_them_first():
    """A tenth higher: sums of fine pixels, 10 wide and 11 high, of light that no
    interpolation touched; 6000 e.
    """
    light = summed(11)
    light = light * (6000 / light.max())
    electrons = light + np.random.default_rng(4).normal(0, np.sqrt(light + 9))
    data, model = b.near_focus(_DEPTHS)
    x = parameter_vector(_PLACE | {"crosstalk_px": 0.25})
    x[PLACE["log_gain"]] = np.log(6000 / model.images(x)[0].max())
    task = SearchTask(
        model, dataclasses.replace(data, electrons=electrons), x, {}, None
    )
    first = run_score_tests(
        task, refine_fit(task, x[[PLACE[name] for name in task.names]])
    ).leans[0]
    assert first.cause == "pixels that are not as high as wide"
    assert first.chance < CHANCE
