"""From a capture to what is fitted: brackets as one frame, the window about the light's
centre, refusals at limits.
"""

import dataclasses
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.captures import Capture, ElectronFrames, SensorNoise
from characterize.inference import prepare
from characterize.inference.leastsquares import FitImages
from metalens.core.errors import CaptureError

RNG = np.random.default_rng(67)


def capture(frames, depth_um, exposure_s, *, angle_rad=None, **more):
    n = len(frames)
    angle = np.zeros((n, 2)) if angle_rad is None else angle_rad
    names = tuple(f"frame {i}" for i in range(n))
    told = {"pixel_um": 1.7, "wavelength_um": 0.85} | more
    return Capture(
        frames, np.array(depth_um), angle, np.array(exposure_s), names, 12, **told
    )


def electrons(shape):
    every = np.ones(shape, bool)
    return ElectronFrames(
        RNG.uniform(50, 90, shape), every, ~every, RNG.uniform(2, 3, shape), np.ones((1, 1, 1)),
        SensorNoise(1.0, 0.01, 2.0), (), common_floor=0.3, common_light=0.02,
    )  # fmt: skip


def test_exposures_of_one_place_and_angle_are_one_frame_in_the_order_of_the_first():
    """Places a, b, a, b at another angle, a: three are left, each worth the longest
    exposure of its own.
    """
    angle = np.array([[0.0, 0.1]] * 3 + [[0.1, 0.0], [0.0, 0.1]])
    depth, exposure = [27e3, 22e3, 27e3, 22e3, 27e3], [0.2, 0.7, 0.8, 0.3, 0.4]
    counted = np.array(exposure)[:, None, None] * np.full((5, 4, 6), 100.0)
    counts = np.arange(5.0)[:, None, None] + counted
    before = capture(counts, depth, exposure, angle_rad=angle, about={"offset": 0.0})
    every = np.ones(counted.shape, bool)
    frames = ElectronFrames(
        counted,
        every,
        ~every,
        2.0 + 0 * counted,
        np.ones((1, 1, 1)) + 0 * counted,
        SensorNoise(1, 0, 2),
        (),
    )
    after, merged = prepare.merge_exposures(before, frames)
    assert after.names == ("frame 0", "frame 1", "frame 3")
    assert after.position_um.tolist() == [27e3, 22e3, 22e3]
    assert after.exposure_s.tolist() == [0.8, 0.7, 0.3]
    assert np.array_equal(after.angle_rad, angle[[0, 1, 3]])
    assert np.array_equal(after.frames, before.frames[[0, 1, 3]])
    assert merged.electrons == pytest.approx(
        np.array([80.0, 70.0, 30.0])[:, None, None] + np.zeros((3, 4, 6))
    )


@pytest.mark.parametrize(
    ("depth", "exposure"),
    [([1.0, 2.0, 3.0], [0.1, 0.2, 0.3]), ([1.0, 1.0, 2.0], [0.1, np.nan, 0.3]), ([1.0, 1.0, 2.0], [0.1, 0.0, 0.3]),
     ([1.0, 1.0, np.nan], [0.1, 0.2, 0.3])],
)  # fmt: skip
def test_frames_stay_where_each_has_its_place_or_time_or_place_is_not_known(
    depth, exposure
):
    before, frames = capture(np.ones((3, 4, 6)), depth, exposure), electrons((3, 4, 6))
    assert prepare.merge_exposures(before, frames) == (before, frames)


def pictured(places):
    """Three frames of 40 x 50 on a background of 60: squares of 3 x 3 about places, in
    the middle frame as given; a
    reflection that is in the last one only."""
    light = np.full((3, 40, 50), 60.0)
    for (y, x), height in places.items():
        light[:, y - 1 : y + 2, x - 1 : x + 2] += (
            height * np.array([0.2, 1.0, 3.0])[:, None, None]
        )
    light[2, 3:7, 41:46] += 900.0
    return light


@pytest.mark.parametrize(
    ("places", "largest", "corner"),
    [
        (
            {(10, 12): 100.0, (22, 30): 60.0, (36, 45): 15.0},
            16,
            (6, 10),
        ),  # 80 and 40 are left: centre (14, 18)
        ({(10, 12): 100.0, (22, 30): 60.0, (36, 45): 15.0}, 15, (7, 11)),
        ({(10, 12): 100.0}, 32, (0, 0)),
        ({(33, 38): 100.0}, 16, (24, 30)),
        ({(33, 44): 100.0}, 16, (24, 34)),
    ],
)
def test_the_window_is_about_the_centre_of_what_stands_a_fifth_of_the_peak_above_the_background(
    places, largest, corner
):
    one = capture(
        pictured(places),
        [3e4, 2e4, 1e4],
        [2.0, 0.5, 1.0],
        angle_rad=RNG.normal(size=(3, 2)),
    )
    setting, window = prepare.setting_of(one, largest)
    assert [(s.start, s.stop) for s in window] == [(c, c + largest) for c in corner]
    assert setting.depth_um.tolist() == [3e4, 2e4, 1e4]
    assert np.array_equal(setting.angle_rad, one.angle_rad)
    assert setting.exposure.tolist() == [1.0, 0.25, 0.5]
    assert (setting.pixel_um, setting.rows, setting.columns) == (1.7, largest, largest)


def test_a_small_frame_is_the_window_and_frames_of_unknown_times_are_alike():
    one = capture(pictured({(10, 12): 100.0}), [3e4, 2e4, 1e4], [2.0, np.nan, 1.0])
    setting, window = prepare.setting_of(one, 45)
    assert window == (slice(0, 40), slice(0, 45))
    assert (setting.rows, setting.columns) == (40, 45)
    assert setting.exposure.tolist() == [1.0, 1.0, 1.0]


@pytest.mark.parametrize("angle", [[0.0, 0.0], [0.0, -0.02], [0.03, 0.0]])
def test_frames_cut_at_one_place_of_the_sensor_are_refused_at_field_angles(angle):
    angles = np.array([[0.0, 0.0], [0.0, 0.0], angle])
    shots = capture(
        pictured({(10, 12): 100.0}), [3e4, 2e4, 1e4], [2.0, 0.5, 1.0], angle_rad=angles
    )
    prepare.setting_of(shots, 16)
    fixed = dataclasses.replace(shots, about={**shots.about, "window": "fixed"})
    if any(angle):
        with pytest.raises(
            CaptureError, match=r'window = "fixed".*cut the frames there'
        ):
            prepare.setting_of(fixed, 16)
    else:
        prepare.setting_of(fixed, 16)


def test_what_is_fitted_is_cut_to_rows_and_columns():
    frames = electrons((3, 8, 9))
    frames.usable[1, 2, 4], frames.saturated[2, 5, 7] = False, True
    got = prepare.data_of(frames, (slice(1, 6), slice(3, 9)))
    assert np.array_equal(got.electrons, frames.electrons[:, 1:6, 3:9])
    assert np.argwhere(~got.usable).tolist() == [[1, 1, 1]]
    assert np.argwhere(got.saturated).tolist() == [[2, 4, 4]]
    assert np.array_equal(got.variance_e2, frames.variance_e2[:, 1:6, 3:9])
    assert np.array_equal(got.scale, np.ones((3, 5, 6)))
    assert np.array_equal(got.common_floor, np.full((3, 5, 6), 0.3))
    assert (got.common_light, got.count_e) == (0.02, 0.0)


def refused(work, *given):
    try:
        work(*given)
    except CaptureError as error:
        return str(error)
    return ""


def test_one_frame_fixes_eight_parameters_of_the_lens_and_three_pixels_one():
    names = [f"cause_{i}_nm" for i in range(8)]
    bench = ["log_gain", "background_e", "crosstalk_px", "decentre_x_um"]
    shape = (1, 6, 7)
    data = SimpleNamespace(
        electrons=np.zeros(shape),
        usable=np.ones(shape, bool),
        saturated=np.zeros(shape, bool),
    )
    assert refused(prepare.check_enough, data, names + bench) == ""
    assert "one frame for 13 parameters" in refused(
        prepare.check_enough, data, [*names, *bench, "one_more_rad"]
    )
    data.usable[0, 0, :5], data.saturated[0, 1, 0] = False, True
    assert refused(prepare.check_enough, data, names + bench) == ""  # 36 pixels for 12
    data.saturated[0, 1, 1] = True
    assert "35 usable pixels for 12 parameters" in refused(
        prepare.check_enough, data, names + bench
    )


@pytest.mark.parametrize(("source", "sensor"), [(26e3, 2e3), (np.inf, 2.6e3)])
def test_depths_a_thousand_times_off_are_told_their_column(source, sensor):
    """Within a factor of 5 of it; the middle of the depths counts. A lens for infinity:
    ten image distances.
    """
    lens = b.row(source_distance_um=source, sensor_distance_um=sensor)

    def said(middle):
        return refused(
            prepare.check_depths, np.array([0.3 * middle, middle, 9 * middle]), lens
        )

    assert [said(factor * 26e3) for factor in (0.1, 1.0, 10.0)] == [""] * 3
    assert ["depth_mm" in said(factor * 26) for factor in (0.19, 0.21, 4.9, 5.1)] == [
        False,
        True,
        True,
        False,
    ]
    assert ["depth_nm" in said(factor * 26e6) for factor in (0.19, 0.21, 4.9, 5.1)] == [
        False,
        True,
        True,
        False,
    ]


@pytest.mark.parametrize(
    ("size", "kept"),
    [(1.2, None), (0.5, 1e-3), (0.26, 3e-3), (0.09, 8e-3), (0.03, 2e-2)],
)
def test_terms_are_left_out_while_chi_square_rises_by_less_than_a_fiftieth(size, kept):
    """Of differences up and down that add up to none, over the noise of 40 and of 90
    electrons; 7 pixels count not.
    """
    up = np.where(np.indices((2, 6, 9)).sum(0) % 2, 1.0, -1.0)
    exact = np.stack([np.full((6, 9), 40.0), np.full((6, 9), 90.0)])
    usable = np.ones(exact.shape, bool)
    usable[0, 2, :7] = False

    def model(cut):
        moved = exact + 100 * cut * size * up + np.where(usable, 0, 1e3 * cut)
        return SimpleNamespace(images=lambda x: (moved, None), rough=model, cut=cut)

    data = FitImages(
        exact,
        usable,
        np.zeros(exact.shape, bool),
        np.zeros(exact.shape),
        np.ones(exact.shape),
    )
    cuts = {
        cut: (100 * cut * size) ** 2 * (47 / 40 + 54 / 90)
        for cut in (2e-2, 8e-3, 3e-3, 1e-3)
    }
    want = next((cut for cut, rise in cuts.items() if rise < 0.02), 0.0)
    assert (want or None) == kept
    assert prepare.quick_enough(model(0.0), data, None).cut == want
