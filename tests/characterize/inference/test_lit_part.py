"""A quick model looks at the part of a window where there is light, on fewer nodes;
beside it images go straight on.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.bench import bench
from characterize.inference.leastsquares import FitImages
from characterize.inference.prepare import LeftOut, lit_part
from characterize.model import PLACE, ForwardModel, FrameSetting, parameter_vector

ROWS, COLUMNS = slice(9, 22), slice(6, 20)
ANGLES = np.array([[0.0, 0.0], [0.11, -0.07]])
SETTING = FrameSetting(
    np.array([560.0, 650.0]), ANGLES, np.array([1.0, 1.3]), 1.5, 29, 28
)
HIDDEN = b.VALUES | {
    "background_e": 7.0,
    "background_x_e": 3.0,
    "distance_um": 1.3,
    "log_gain": 13.0,
}


@pytest.fixture(scope="module")
def model():
    return ForwardModel(b.lens(), SETTING, b.RESPONSE).about((1.4, -2.2))


@pytest.fixture(scope="module")
def part(model):
    return model.quick(ROWS, COLUMNS)


@pytest.mark.parametrize(
    ("lit", "most"), [((), 41), ((slice(4, 13), slice(4, 12)), 33)]
)
def test_few_nodes_show_light_of_every_depth_where_the_sum_over_every_pillar_has_it(
    lit, most
):
    """Defocus to either side: its light lands elsewhere, and would be shown again where
    nodes are fewer yet.

    Few terms leave 2 % of the field out where that is dim, and less than a percent of
    the brightest light.
    """
    setting = FrameSetting(
        np.array(b.DEPTHS), np.zeros((5, 2)), np.ones(5), 1.5, 16, 16
    )
    whole = ForwardModel(b.lens(), setting, b.RESPONSE)
    few = whole.quick(*lit)
    want = bench.bench_irradiance(b.lens(), b.truth(), b.RESPONSE)
    got = few.images(
        parameter_vector(b.VALUES | {"background_e": 0.0, "background_x_e": 0.0})
    )[0]
    seen = (slice(None), *(lit or (slice(None), slice(None))))
    want, got = want[seen], got[seen]
    got = got * (got * want).sum() / (got**2).sum()
    assert np.abs(got - want).max() < 0.01 * want.max()
    assert few.groups[0].reduced.nodes < most < whole.groups[0].reduced.nodes == 42


def test_derivatives_of_a_part_are_differences_of_its_own_images(part):
    names, x = (
        ("bias_x_nm", "coma_y_rad", "decentre_x_um", "distance_um"),
        parameter_vector(HIDDEN),
    )
    slopes = part.images(x, names)[1]
    for name, step, got in zip(names, (0.2, 5e-3, 1e-2, 5e-2), slopes, strict=True):
        way = step * (np.arange(len(x)) == PLACE[name])
        want = (part.images(x + way)[0] - part.images(x - way)[0]) / (2 * step)
        assert np.linalg.norm(got - want) < 0.06 * np.linalg.norm(want), (
            name
        )  # slopes of a quick model: 5 %


def test_the_lit_part_is_what_light_tells_over_its_noise_but_for_thirty_parts_in_a_million(
    model,
):
    """Two frames of a bright pixel, 900 electrons over 90, and of dim ones that tell
    1e-6 and 1e-3 of what it does.
    """
    x = parameter_vector({"background_e": 5.0, "background_x_e": 2.0})
    plane = (
        np.broadcast_to(5.0 + 2.0 * (np.arange(28) - 14) / 14, (2, 29, 28))
        * SETTING.exposure[:, None, None]
    )
    light = np.zeros((2, 29, 28))
    light[0, 12, 9], light[1, 14, 11] = 900.0, 900.0
    light[0, 20, 25] = 900.0 * 1e-3  # 1e-6 of what the bright one tells
    light[1, 8, 7] = 900.0 * 0.03
    noise = np.full(light.shape, 90.0)
    data = FitImages(
        light,
        np.ones(light.shape, bool),
        np.zeros(light.shape, bool),
        noise,
        np.full(light.shape, 1e9),
    )
    assert lit_part(model, data, x, light + plane) == (slice(8, 15), slice(7, 12))
    usable = np.ones(light.shape, bool)
    usable[1, 8, 7] = False
    masked = dataclasses.replace(data, usable=usable)
    assert lit_part(model, masked, x, light + plane) == (slice(12, 15), slice(9, 12))


@pytest.mark.parametrize(
    ("share", "taken"),
    [(7e-6, (slice(12, 15), slice(9, 12))), (8e-6, (slice(3, 26), slice(2, 25)))],
)
def test_each_of_four_sides_may_hold_a_quarter_of_thirty_parts_in_a_million(
    model, share, taken
):
    """One dim pixel beyond each side of two bright ones, each with this share of all
    that light tells.
    """
    light = np.zeros((2, 29, 28))
    light[0, 12, 9], light[1, 14, 11] = 900.0, 900.0
    dim = 900.0 * np.sqrt(
        2 * share / (1 - 4 * share)
    )  # of all is told (1 - 4 share) by the two
    light[0, 3, 10], light[1, 25, 10], light[1, 13, 2], light[0, 13, 24] = (
        dim,
        dim,
        dim,
        dim,
    )
    noise = np.full(light.shape, 1e4)  # beside which the noise of the light is none
    data = FitImages(
        light,
        np.ones(light.shape, bool),
        np.zeros(light.shape, bool),
        noise,
        np.full(light.shape, 1e9),
    )
    assert lit_part(model, data, parameter_vector({}), light) == taken


def test_beside_the_part_images_go_straight_on_and_within_it_what_is_left_out_stays():
    rng = np.random.default_rng(4)
    value, image, slopes = (
        np.array([1.0, -2.0]),
        rng.normal(size=(3, 4, 5)),
        rng.normal(size=(2, 3, 4, 5)),
    )
    beside = np.zeros((4, 5), bool)
    beside[0], beside[2, 3] = True, True
    left = LeftOut(value, image, slopes, beside)

    def plain(x, jacobian):
        rates = np.broadcast_to(
            np.array([2.0, -1.0])[:, None, None, None], (2, 3, 4, 5)
        )
        return np.full((3, 4, 5), 2 * x[0] - x[1]), rates if jacobian else None

    x = np.array([1.3, -1.4])
    got, rates = left.added(plain, None)(x, True)
    want = 4.0 + image
    want[:, beside] += 0.3 * slopes[0][:, beside] + 0.6 * slopes[1][:, beside]
    assert got == pytest.approx(want, abs=1e-12)
    assert rates == pytest.approx(np.array([2.0, -1.0])[:, None, None, None] + slopes)
    some = np.array([2, 0])
    few, none = left.added(lambda *a: (plain(*a)[0][some], None), some)(x, False)
    assert few == pytest.approx(want[some], abs=1e-12)
    assert none is None
