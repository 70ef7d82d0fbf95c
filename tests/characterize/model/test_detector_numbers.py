"""Windows and parts of them in numbers that are typed in, and transfers of every cause
by differences.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from characterize.model import detector
from characterize.model.detector import DetectorGrid, SeparableBlur

GRID = DetectorGrid(7, 10, 2.4, 3, margin=4, middle_um=(5.5, -31.0), fill=0.7)


@pytest.mark.parametrize(("near", "off"), [(12.0, 19.0), (40.0, 0.0)])
def test_the_square_that_holds_all_light_grows_by_twice_what_lies_far_off(near, off):
    assert GRID.across_um(near) == pytest.approx((10 + 4) * 2.4 + 20.0 + 2 * off)
    tall = DetectorGrid(12, 10, 2.4, margin=1, middle_um=(-50.0, 3.0))
    assert tall.across_um(12.0) == pytest.approx(13 * 2.4 + 20.0 + 2 * 38.0)


def test_a_part_of_a_window_sees_the_same_places():
    """Rows 2 to 5 and columns 2 to 8; then of these rows 1 to 3: pixels and fine
    samples lie where they lay.
    """
    part = GRID.part(slice(2, 6), slice(2, 9), 2)
    assert (part.rows, part.columns, part.margin, part.oversample, part.fill) == (
        4,
        7,
        2,
        3,
        0.7,
    )
    again = part.part(slice(1, 4), slice(0, 7), 9)
    assert (again.rows, again.columns, again.margin) == (
        3,
        7,
        2,
    )  # no more room than there was
    rows, columns = (
        (np.arange(n) - (n - 1) / 2) * 2.4 + at for n, at in ((7, -31.0), (10, 5.5))
    )
    for one, r, c in (
        (part, slice(2, 6), slice(2, 9)),
        (again, slice(3, 6), slice(2, 9)),
    ):
        y, x = one.ends_um()
        assert y == pytest.approx(rows[r][[0, -1]])
        assert x == pytest.approx(columns[c][[0, -1]])
        room = one.margin * 3
        assert one.axes_um()[0][room : room + 3].mean() == pytest.approx(rows[r][0])
        assert one.axes_um()[1][room : room + 3].mean() == pytest.approx(columns[c][0])
    assert part.across_um(12.0) == pytest.approx(
        (7 + 2) * 2.4 + 20.0 + 2 * (abs(y_centre(part)) - 12.0)
    )


def y_centre(part):
    """Of the middle of the rows, um."""
    y, _ = part.ends_um()
    return y[0] + (part.rows - 1) / 2 * 2.4


def test_sums_times_a_factor_are_theirs_once():
    rng = np.random.default_rng(2)
    pairs = tuple(
        (
            rng.normal(size=(2, 5)).astype(np.float32),
            rng.normal(size=(3, 6)).astype(np.float32),
        )
        for _ in "ab"
    )
    some, light = SeparableBlur(pairs), rng.normal(size=(5, 6))
    grid = DetectorGrid(2, 3, 1.0)
    want = sum(y @ light @ x.T for y, x in pairs)
    assert grid.sample(light, some) == pytest.approx(want, rel=1e-6)
    three = some.times(3.0)
    assert grid.sample(light, three) == pytest.approx(3 * want, rel=1e-5)
    assert all(y.dtype == np.float32 for y, _ in three.pairs)


@pytest.mark.parametrize("over", [2, 3])
def test_transfers_are_pixel_blur_and_disc_and_move_with_each_of_them(over):
    """Sizes of the images in two frames; a source's diameter d has images of shrink
    times d.
    """
    grid = DetectorGrid(6, 5, 2.4, over, fill=0.7)
    shrink, diameter, crosstalk = np.array([0.7, 1.2]), 4.1, 0.4
    fy, fx = grid.frequencies()
    wide = 0.7 * 2.4

    def whole(crosstalk=crosstalk, diameter=diameter, growth=0.0):
        sizes = shrink * (diameter + growth)
        square = np.sinc(fx * wide) * np.sinc(fy * wide)
        smooth = np.exp(-2 * (np.pi * crosstalk * wide) ** 2 * (fx**2 + fy**2))
        return np.stack(
            [
                square * smooth * detector.disc_transfer(fy, fx, size)[0]
                for size in sizes
            ]
        )

    got, slopes = detector.detector_transfers(
        grid, crosstalk, shrink * diameter, shrink, sized=True
    )
    assert got == pytest.approx(whole(), abs=1e-12)
    for name, moved in (
        ("crosstalk_px", lambda x: whole(crosstalk=crosstalk + x)),
        ("pinhole_um", lambda x: whole(diameter=diameter + x)),
        ("growth", lambda x: whole(growth=x)),
    ):
        assert slopes[name] == pytest.approx(
            (moved(1e-5) - moved(-1e-5)) / 2e-5, abs=1e-8
        ), name
    assert set(slopes) == {"crosstalk_px", "pinhole_um", "growth"}


def test_a_point_that_is_sized_has_the_slope_of_three_tenths_of_a_pixel():
    """And no growth: a search sees that a disc would change the light."""
    grid, shrink = DetectorGrid(6, 5, 2.4, 2, fill=0.7), np.array([0.7, 1.2])
    fy, fx = grid.frequencies()
    got, slopes = detector.detector_transfers(grid, 0.4, 0 * shrink, shrink, sized=True)
    shared = (
        np.sinc(fx * 1.68)
        * np.sinc(fy * 1.68)
        * np.exp(-2 * (np.pi * 0.4 * 1.68) ** 2 * (fx**2 + fy**2))
    )
    assert got == pytest.approx(np.stack([shared] * 2), abs=1e-12)
    seen = detector.disc_transfer(fy, fx, 0.3 * 1.68)[1]
    assert slopes["pinhole_um"] == pytest.approx(
        np.stack([shared * seen * s for s in shrink]), abs=1e-12
    )
    assert not slopes["growth"].any()
    plain, some = detector.detector_transfers(
        grid, 0.4, 0 * shrink, shrink, sized=False, kind=np.float32
    )
    assert isinstance(plain, SeparableBlur)
    assert plain.pairs[0][0].dtype == np.float32
    assert set(some) == {"crosstalk_px"}
    assert not isinstance(
        detector.detector_transfers(grid, 0.4, 1.1 * shrink, shrink, sized=False)[0],
        SeparableBlur,
    )


def test_samples_are_as_fine_as_twice_the_highest_frequency_needs():
    """2 sine / wavelength of intensity; a lens of radius 30 at 40 um: sine 0.6, 1.41
    cycles a um.
    """
    lens = SimpleNamespace(
        diameters=SimpleNamespace(radius_um=30.0), reduced_um=40.0, wavelength_um=0.85
    )
    assert detector.required_oversampling(lens, 2.4) == math.ceil(2.4 * 2 * 1.2 / 0.85)
    assert detector.required_oversampling(lens, 0.3) == 1
    assert detector.fine_enough(2.0, 1.25) == 5
    assert (
        detector.fine_enough(2.0, 1.25 * (1 + 1e-10)) == 5
    )  # rounding asks for no more


def test_a_ball_and_a_disc_in_series_near_no_frequency():
    """1 - u² / 8 of a disc, 1 - u² / 10 of a ball, u = pi f D; a disc's slope is -u² /
    4 D.
    """
    f, size = 0.01, 3.1
    u = math.pi * f * size
    fy, fx = np.array([[0.6 * f]]), np.array([[0.8 * f]])
    value, slope = detector.disc_transfer(fy, fx, size)
    assert value[0, 0] == pytest.approx(1 - u**2 / 8 + u**4 / 192, rel=1e-8)
    assert slope[0, 0] == pytest.approx((-(u**2) / 4 + u**4 / 48) / size, rel=1e-4)
    assert detector.ball_transfer(fy, fx, size)[0, 0] == pytest.approx(
        1 - u**2 / 10 + u**4 / 280, rel=1e-8
    )
