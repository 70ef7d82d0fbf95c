"""Likeness, shifts, orders and turns of typed pictures."""

from types import SimpleNamespace

import numpy as np
import pytest

from characterize.captures import (
    FrameSpectra,
    above_rim,
    normalized_cross_correlation,
    orient_frames,
)
from characterize.inference import arrange
from characterize.inference.arrange import FrameArrangement
from characterize.inference.leastsquares import FitImages
from characterize.model import PLACE, parameter_vector

RNG = np.random.default_rng(23)


def laid(**more):
    usual = {
        "stage_zero_um": 0.0, "distance_um": 0.0, "shift_px": (0.0, 0.0), "likeness": 1.0,
        "order": np.array([2, 0, 1]), "reordered": True, "order_seen": True, "orientation": 5, "clearly": True,
        "alike": (),
    }  # fmt: skip
    return FrameArrangement(**(usual | more))


@pytest.mark.parametrize("shift", [(2, -3), (-1, 4), (0, 0)])
def test_a_shifted_picture_is_alike_at_its_shift(shift):
    picture = np.zeros((11, 14))
    picture[4:8, 5:9] = RNG.uniform(1, 3, (4, 4))
    moved = np.roll(picture, shift, (0, 1))
    score, found = normalized_cross_correlation(1.7 * moved, picture, 0.0)
    assert score == pytest.approx(1, rel=1e-9)
    assert found == shift
    assert arrange._distance(moved, picture) == pytest.approx(0, abs=1e-9)
    off = moved.copy()
    off[0, 0] += 0.5
    assert arrange._distance(off, picture) == pytest.approx(0.25, rel=1e-6)


def test_noise_is_taken_off_the_norm_and_never_more_than_nine_tenths():
    picture = np.zeros((9, 9))
    picture[3:6, 3:7] = RNG.uniform(1, 2, (3, 4))
    other = np.zeros((9, 9))
    other[3:6, 3:7] = RNG.uniform(1, 2, (3, 4))
    power, cross = (picture**2).sum(), (picture * other).sum()
    for noise, left in (
        (0.3 * power**0.5, 0.91 * power),
        (5 * power**0.5, 0.1 * power),
    ):
        want = min(cross / np.sqrt(left * (other**2).sum()), 1.0)
        assert normalized_cross_correlation(picture, other, noise)[0] == pytest.approx(
            want, rel=1e-9
        )
    assert normalized_cross_correlation(picture, 0 * other, 0.0) == (0.0, (0.0, 0.0))


def test_a_scan_sees_the_likeness_of_frames_in_their_order():
    """The plain form, frame by frame: of pictures with noise, one dark, taken end to
    end.
    """
    light, expected = RNG.normal(0, 1, (2, 3, 7, 10)) ** 3
    expected[2] = 0
    noise, back = np.array([0.3, 60.0, 1.1]), np.array([2, 1, 0])
    plain = [
        normalized_cross_correlation(light[j], expected[i], noise[j])[0]
        for i, j in enumerate(back)
    ]
    spectra = FrameSpectra.of(light, noise), FrameSpectra.of(expected, np.zeros(3))
    assert spectra[0].alike(spectra[1], back) == pytest.approx(np.mean(plain), rel=1e-9)


@pytest.mark.parametrize(
    ("stated", "back", "way"),
    [
        (
            (0.95, 0.7, 0.954, 0.6),
            (0.96, 0.5, 0.96, 0.5),
            (0, False),
        ),  # end to end is little better
        (
            (0.77, 0.73, 0.954, 0.956),
            (0.925, 0.6, 0.72, 0.7),
            (2, False),
        ),  # mirrored; of equals the plainer
        (
            (0.72, 0.73, 0.953, 0.95),
            (0.954, 0.955, 0.7, 0.6),
            (0, True),
        ),  # its twin, end to end
        ((0.5, 0.5, 0.5, 0.5), (0.6, 0.6, 0.97, 0.6), (2, True)),  # both
        (
            (0.93, 0.955, 0.93, 0.93),
            (0.9, 0.9, 0.9, 0.9),
            (0, False),
        ),  # turned is better, not beyond doubt
    ],
)
def test_ways_are_weighed_each_at_its_best(stated, back, way):
    assert arrange._way(np.array(stated), np.array(back)) == way


def test_frames_lose_the_plane_of_their_rim_and_holes_take_the_median():
    y, x = np.mgrid[-1:1:9j, -1:1:12j]
    frame = 30 + 2.0 * x - 5 * y
    frame[4, 5:8] += 70.0
    frame[3, 3] = np.nan
    got = above_rim(np.stack([frame, 2 * frame]))
    want = np.zeros((9, 12))
    want[4, 5:8] = 70.0
    want[3, 3] = np.nanmedian(frame) - (30 + 2 * x - 5 * y)[3, 3]
    assert got == pytest.approx(np.stack([want, 2 * want]), abs=1e-9)


@pytest.mark.parametrize("orientation", range(8))
def test_turned_pictures_are_turned_back(orientation):
    """The turn that is found brings the frames onto what is expected."""
    expected = RNG.uniform(0, 1, (3, 12, 12)) ** 4
    expected[:, :3] = expected[:, -3:] = expected[:, :, :3] = expected[:, :, -3:] = 0
    back = {
        k: next(
            j
            for j in range(8)
            if np.array_equal(
                arrange.orient_frames(arrange.orient_frames(expected, k), j), expected
            )
        )
        for k in range(8)
    }
    light = arrange.orient_frames(expected, back[orientation])
    found, clearly = arrange._orientation(light, (expected, expected), np.zeros(3))
    assert (found, clearly) == (orientation, orientation != 0)
    upright, aside = (
        np.pad(expected, ((0, 0), (y, y), (x, x))) for y, x in ((0, 2), (2, 0))
    )
    wide = arrange.orient_frames(
        aside if orientation % 2 else upright, back[orientation]
    )
    assert wide.shape == upright.shape
    assert arrange._orientation(wide, (upright, aside), np.zeros(3)) == (
        orientation,
        orientation != 0,
    )


@pytest.mark.parametrize("way", [(True, False), (False, True), (True, True)])
def test_of_order_and_turn_the_least_is_said_that_explains_the_frames(way):
    """Four frames that differ, in another order, turned, or both: nothing less brings
    them back.
    """
    expected, order, turned = np.zeros((4, 14, 14)), np.array([2, 0, 3, 1]), 5
    expected[:, 4:10, 4:10] = RNG.uniform(0, 1, (4, 6, 6)) ** 4
    back = next(
        k
        for k in range(8)
        if np.array_equal(
            arrange.orient_frames(arrange.orient_frames(expected, turned), k), expected
        )
    )
    light = arrange.orient_frames(expected, turned) if way[1] else expected
    light = light[np.argsort(order)] if way[0] else light
    assert (
        arrange._plainest(light, (expected, expected), np.zeros(4), order, back) == way
    )


def test_of_ways_that_explain_frames_alike_the_order_is_said():
    """Frames that all are one round spot: order and turn change nothing."""
    y, x = np.mgrid[-6:7, -6:7]
    expected = np.repeat(np.exp(-(x**2 + y**2) / 8.0)[None], 4, 0)
    assert arrange._plainest(
        expected, (expected, expected), np.zeros(4), np.array([2, 0, 3, 1]), 5
    ) == (True, False)


def test_turns_by_hand():
    frame = np.array([[[1, 2, 3], [4, 5, 6]]])
    assert arrange.orient_frames(frame, 1)[0].tolist() == [[3, 6], [2, 5], [1, 4]]
    assert arrange.orient_frames(frame, 4)[0].tolist() == [[3, 2, 1], [6, 5, 4]]
    assert arrange.orient_frames(frame, 5)[0].tolist() == [[1, 4], [2, 5], [3, 6]]
    assert arrange.orient_frames(frame, 3)[0].tolist() == [[4, 1], [5, 2], [6, 3]]
    stack = np.concatenate([frame, frame + 10, frame + 20])
    both = arrange.rearrange_frames(stack, laid())
    assert both[0].tolist() == [[21, 24], [22, 25], [23, 26]]
    assert (
        arrange.rearrange_frames(stack, laid(clearly=False))[1].tolist()
        == frame[0].tolist()
    )
    assert arrange.rearrange_frames(stack, laid(reordered=False))[0].tolist() == [
        [1, 4],
        [2, 5],
        [3, 6],
    ]


def spots(widths, level=40.0):
    y, x = np.mgrid[:15, :17] - np.array([7.0, 8.0])[:, None, None]
    return np.array(
        [level * np.exp(-(y**2 + 1.6 * x**2) / (2 * w**2)) / w**2 for w in widths]
    )


def groups(*members):
    return SimpleNamespace(groups=[SimpleNamespace(index=np.array(m)) for m in members])


def test_shuffled_frames_are_put_where_they_are_expected():
    """Widths tell depths; frames of two field angles are not exchanged."""
    expected = spots([1.0, 1.3, 1.7, 2.2, 2.9, 3.6])
    shuffle = np.array([3, 0, 2, 1, 5, 4])  # within 0 to 3, and 4 to 5
    light = (
        0.7 * expected[np.argsort(shuffle)]
    )  # frame k is that of depth where shuffle is k
    noise = np.full(6, 0.5)
    order, reordered, seen = arrange._order(
        light, expected, noise, groups([0, 1, 2, 3], [4, 5])
    )
    assert (reordered, seen) == (True, True)
    assert light[order] == pytest.approx(0.7 * expected)
    order, reordered, seen = arrange._order(
        0.7 * expected, expected, noise, groups([0, 1, 2, 3], [4, 5])
    )
    assert order.tolist() == [0, 1, 2, 3, 4, 5]
    assert not reordered
    alike = spots([1.5] * 6)
    _, reordered, seen = arrange._order(
        alike[::-1], alike, noise, groups([0, 1, 2, 3], [4, 5])
    )
    assert (reordered, seen) == (False, False)


def test_the_other_end_of_the_stage_is_at_each_angle():
    model = groups([0, 2, 4], [1, 3])
    model.setting = SimpleNamespace(depth_um=np.array([5.0, 9.0, 7.0, 8.0, 6.0]))
    assert arrange._reversed(model).tolist() == [2, 3, 0, 1, 4]


class _Stack:
    """Images whose width goes with depth; a longer lens-sensor distance moves the whole
    stack, 25 um by one frame.
    """

    def __init__(self, index=range(9)):
        self.index = np.array(index)
        angles = np.zeros((len(self.index), 2))
        self.setting = SimpleNamespace(
            depth_um=100.0 * (5 + self.index), angle_rad=angles, rows=15, columns=17
        )
        self.groups = groups(range(len(self.index))).groups

    def only(self, index):
        return _Stack(self.index[index])

    def quick(self, *_part):
        return self

    def exchanged(self):
        return SimpleNamespace(images=lambda x: (self.images(x)[0].swapaxes(1, 2),))

    def images(self, x):
        at = self.index + x[PLACE["distance_um"]] / 25 + x[PLACE["stage_zero_um"]] / 1e4
        return (spots(1.1 + 0.24 * np.abs(at - 3.0) + 0.06 * (at > 3), level=4e4),)


def _seen(frames):
    shape = frames.shape
    return FitImages(
        frames,
        np.ones(shape, bool),
        np.zeros(shape, bool),
        np.full(shape, 4e-4),
        np.ones(shape),
    )


@pytest.mark.parametrize("distance_um", [75.0, -50.0])
def test_a_wrong_distance_is_not_taken_for_another_order(distance_um):
    model = _Stack()
    frames = model.images(parameter_vector({"distance_um": distance_um}))[0]
    blind = arrange.find_arrangement(model, _seen(frames), scan_um=30.0)
    assert blind.reordered  # by the stage alone the stack seems shuffled
    found = arrange.find_arrangement(model, _seen(frames), scan_um=30.0, reach_um=200.0)
    assert (found.reordered, found.clearly) == (False, False)
    assert found.distance_um == pytest.approx(distance_um)
    assert found.likeness > 0.999


def test_frames_that_are_shuffled_are_put_in_order_at_any_distance():
    model = _Stack()
    shuffle = np.array([4, 7, 1, 0, 8, 2, 6, 3, 5])
    found = arrange.find_arrangement(
        model,
        _seen(model.images(parameter_vector())[0][shuffle]),
        scan_um=30.0,
        reach_um=200.0,
    )
    assert found.reordered
    assert shuffle[found.order].tolist() == list(range(9))
    assert found.distance_um == 0.0


@pytest.mark.parametrize("way", range(8))
def test_turned_frames_are_held_against_those_of_a_camera_on_its_side_where_it_lies_so(
    way,
):
    upright, aside = RNG.uniform(0, 1, (2, 3, 9, 9)) ** 4
    wanted = aside if way % 2 else upright
    (back,) = [
        k
        for k in range(8)
        if np.array_equal(orient_frames(orient_frames(wanted, k), way), wanted)
    ]
    assert arrange._orientation(
        1.9 * orient_frames(wanted, back), (upright, aside), np.zeros(3)
    ) == (way, way > 0)


def test_orientations_are_apart_by_squares_over_the_noise_of_every_frame():
    """Of noise per frame, shared out to its 25 pixels; frames as bright as the light."""
    expected = RNG.uniform(0, 1, (2, 2, 5, 5))
    noise = np.array([0.7, 3.1])
    light = 1.6 * expected[0]
    bright = np.sqrt(((light**2).sum() - (noise**2).sum()) / (expected[0] ** 2).sum())
    for way, other in (
        (2, np.rot90(expected[0], 2, (1, 2))),
        (1, np.rot90(expected[0], 1, (1, 2))),
    ):
        against = expected[way % 2]
        each = ((bright * (other - against)) ** 2).sum((1, 2)) / (noise**2 / 25)
        assert arrange._apart(way, tuple(expected), light, noise) == pytest.approx(
            each.sum(), rel=1e-9
        )
