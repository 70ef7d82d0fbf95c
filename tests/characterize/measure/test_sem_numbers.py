"""Pillars of a micrograph, number by number: circles through typed edges, what counts
as fallen, plateaus, shades.
"""

import math

import numpy as np
import pytest
from scipy import ndimage

from characterize.measure import radial, sem
from characterize.measure.lattice import ImageLattice

LATTICE = ImageLattice(
    np.array([3.0, 4.0]), np.array([0.0, 50.0]), np.array([50.0, 0.0])
)


def test_diameters_are_twice_the_radii_less_twice_the_bias_of_an_edge(monkeypatch):
    """Steps of 1, 0.41 and 0.39 of the usual one: the last site holds no pillar. Pixels
    of 3.5 nm, edges 1.2 nm out.
    """
    place = np.array(
        [[30.0, 40.0], [31.0, 90.0], [32.0, 140.0], [80.0, 41.0], [81.0, 91.0]]
    )
    site = np.array([[0, 0], [0, 1], [0, 2], [1, 0], [1, 1]])
    steps = dict(zip(place[:, 1], (1.1, 1.0, 0.41, 0.39, 1.0), strict=True))
    asked = []

    def pillar(flat, row, column, pitch, *, there):
        asked.append(there)
        return row + 0.2, column - 0.3, 20.0 + row / 10, 0.05, not there, column == 90.0

    pitches = []
    monkeypatch.setattr(
        sem, "find_lattice", lambda flat, pitch: pitches.append(pitch) or LATTICE
    )
    monkeypatch.setattr(ImageLattice, "sites", lambda self, shape: (place, site))
    monkeypatch.setattr(sem, "_step", lambda flat, row, column, pitch: steps[column])
    monkeypatch.setattr(sem, "_pillar", pillar)
    got = sem.measure_diameters(
        np.random.default_rng(1).normal(size=(160, 180)),
        sem.Micrograph(3.5, 175.0, 1.2),
    )
    assert asked == [True, True, True, False, True]
    assert pitches == [50.0]
    want = 2 * (20 + place[:, 0] / 10) * 3.5 - 2 * 1.2
    want[[1, 3]] = np.nan
    assert got.diameter_nm == pytest.approx(want, nan_ok=True)
    assert got.sigma_nm == pytest.approx(np.full(5, 2 * 0.05 * 3.5))
    assert got.missing.tolist() == [False, False, False, True, False]
    assert got.collapsed.tolist() == [False, True, False, False, False]
    assert got.row == pytest.approx(place[:, 0] + 0.2)
    assert got.column == pytest.approx(place[:, 1] - 0.3)


@pytest.mark.parametrize(
    ("radius", "scatter", "collapsed"),
    [
        (20.0, 2.9, False),
        (20.0, 3.1, True),
        (6.0, 1.4, False),
        (6.0, 1.6, True),
        (10.0, 1.51, True),
    ],
)
def test_a_pillar_far_from_round_has_collapsed(monkeypatch, radius, scatter, collapsed):
    """Edges scatter by more than 15 % of the radius, or by 1.5 pixels where that is
    more.
    """
    monkeypatch.setattr(
        sem, "_edges", lambda flat, y, x, pitch: (0.0, 0.0, radius, 0.07, scatter)
    )
    got = sem._pillar(np.zeros((90, 95)), 40.0, 47.0, 50.0, there=True)
    assert got == (40.0, 47.0, radius, 0.07, False, collapsed)


@pytest.mark.parametrize(("off", "collapsed"), [(9.9, False), (10.1, True)])
def test_a_pillar_a_fifth_of_the_pitch_off_its_site_has_collapsed(
    monkeypatch, off, collapsed
):
    """Found in three steps along a direction of 3 to -4."""
    steps = iter(
        [
            (0.6 * off / 2, -0.8 * off / 2),
            (0.6 * off / 2, -0.8 * off / 2),
            (5e-4, 5e-4),
            (7.0, 7.0),
        ]
    )
    monkeypatch.setattr(
        sem, "_edges", lambda flat, y, x, pitch: (*next(steps), 12.0, 0.07, 0.3)
    )
    row, column, radius, sigma, missing, fallen = sem._pillar(
        np.zeros((90, 95)), 40.0, 47.0, 50.0, there=True
    )
    assert (row, column) == pytest.approx((40 + 0.6 * off, 47 - 0.8 * off), abs=1e-3)
    assert (radius, sigma, missing, fallen) == (12.0, 0.07, False, collapsed)


def test_a_site_without_edges_has_collapsed_and_one_without_a_pillar_is_missing_or_lies_beside(
    monkeypatch,
):
    monkeypatch.setattr(sem, "_edges", lambda *_: None)
    flat = np.zeros((90, 95))
    assert sem._pillar(flat, 40.0, 47.0, 50.0, there=True)[4:] == (False, True)
    assert sem._pillar(flat, 40.0, 47.0, 50.0, there=False)[4:] == (True, False)
    for side, lies in (
        (19, True),
        (12, False),
    ):  # of a cell of 51 pixels a side: (19 - 2)² is 11 %, (12 - 2)² is 4 %
        flat[20 : 20 + side, 40 : 40 + side] = 1.0
        assert sem._pillar(flat, 40.0, 47.0, 50.0, there=False)[4:] == (not lies, lies)
        flat[:] = 0
    # flush with an edge of the cell, rows 15 to 65 and columns 22 to 72: 14 x 15 pixels
    # above 0.6 of 2601 are 8.07 %
    for rows, columns in ((slice(20, 37), slice(58, 73)), (slice(20, 37), slice(22, 37)),
                          (slice(15, 30), slice(40, 57)), (slice(51, 66), slice(40, 57))):  # fmt: skip
        flat[rows, columns] = 1.0
        assert sem._pillar(flat, 40.0, 47.0, 50.0, there=False)[4:] == (False, True)
        flat[:] = 0


# of rays smoothed by a Gaussian of one: 72 / (2 sqrt pi), and between pixels (1/6) of
# steps of 1.25
INDEPENDENT = 72 / (
    2 * math.sqrt(math.pi) * math.sqrt(1 + 1 / 6 / (2 * math.pi * 14.3 / 72) ** 2)
)


def test_a_circle_goes_through_the_half_rise_places_and_knows_its_error():
    """From a place 1.3 beside and 0.8 below the middle: the step there, the radius, and
    the scatter of 72 rays.
    """
    y, x = np.indices((81, 85))
    away = np.hypot(y - 40.8, x - 43.3)
    flat = np.clip(0.5 + (14.3 - away) / 3, 0, 1)  # half at the radius
    dy, dx, radius, sigma, scatter = sem._edges(flat, 40.0, 42.0, 50.0)
    assert (dy, dx) == pytest.approx(
        (0.8, 1.3), abs=0.05
    )  # first order of the offset; its square over 4 R: 0.04
    assert radius == pytest.approx(14.3, abs=0.1)
    dy, dx, radius, sigma, scatter = sem._edges(flat, 40.8, 43.3, 50.0)
    bent = (
        3**2 / 12 / (2 * 14.3)
    )  # a ramp of 3 pixels is as wide as a blur, which would have drawn a disc in by this
    assert (dy, dx, radius) == pytest.approx(
        (0, 0, 14.3 + bent), abs=0.03
    )  # linear interpolation of a cone
    assert scatter < 0.05
    assert sem._edges(0.2 + 0.7 * flat, 40.8, 43.3, 50.0)[2] == pytest.approx(
        radius, abs=1e-6
    )  # half of the step
    wavy = np.clip(
        0.5 + (14.3 + 0.6 * np.cos(5 * np.arctan2(y - 40.8, x - 43.3)) - away) / 3, 0, 1
    )
    *_, sigma, scatter = sem._edges(wavy, 40.8, 43.3, 50.0)
    across = math.exp(
        -(math.radians(5 * 5) ** 2) / 2
    )  # smoothed over rays 5 degrees apart
    assert scatter == pytest.approx(0.6 / math.sqrt(2) * across, rel=0.03)
    noise = scatter**2 / (1 - 5 / INDEPENDENT)
    shared = 0.25 / (0.95 * INDEPENDENT) + 0.25 / (
        1.02 * INDEPENDENT
    )  # of rim and gap, nearer and farther than edges
    assert sigma == pytest.approx(
        math.sqrt(noise * (1 / INDEPENDENT + shared)), rel=0.02
    )
    assert sem._edges(0.19 * flat, 40.8, 43.3, 50.0) is None  # too faint a step


def test_edges_far_from_the_middle_one_are_left_out():
    """A neighbour touches on one side: those rays see their edge beyond a fifth of the
    radius.
    """
    y, x = np.indices((81, 85))
    away = np.hypot(y - 40.0, x - 42.0)
    flat = np.clip(0.5 + (12.0 - away) / 2, 0, 1)
    flat[38:43, 50:] = 1.0
    _, _, radius, sigma, scatter = sem._edges(flat, 40.0, 42.0, 50.0)
    assert radius == pytest.approx(12.0, abs=0.1)
    assert scatter < 0.4
    assert sigma > scatter * math.sqrt(
        1 / (INDEPENDENT - 3) + 0.25 / INDEPENDENT
    )  # of fewer rays


@pytest.mark.parametrize("radius", [5.3, 17.1])
def test_diameters_of_noisy_discs_scatter_as_their_errors_say(radius):
    """Blurred discs with a bright rim in white noise: 250 radii about their mean, in
    units of the errors told.
    """
    random = np.random.default_rng(31)
    y, x = np.indices((61, 61))
    away = np.hypot(y - 30.2, x - 29.7) - radius
    top = 0.7 + 0.4 * np.exp(np.minimum(away, 0) / 2.5)
    disc = 0.1 + ndimage.gaussian_filter(top * np.clip(0.5 - away, 0, 1), 1.2)
    noisy = (disc + 0.07 * random.standard_normal(disc.shape) for _ in range(250))
    radii, errors = np.array(
        [sem._edges(image, 30.2, 29.7, 56.0)[2:4] for image in noisy]
    ).T
    told = (radii - radii.mean()) / errors
    assert 0.85 < told.std() < 1.15  # of 250: 4.5 % from chance, three times that
    assert np.abs(told).max() < 4.5


def test_noise_about_the_middle_is_not_taken_for_an_edge():
    """There all rays cross the same few pixels: a bright one falls more steeply than a
    blurred, noisy rim.
    """
    y, x = np.indices((81, 85))
    away = np.hypot(y - 40.0, x - 42.0)
    flat = np.clip(0.5 + (21.0 - away) / 4, 0, 1)
    flat[40, 42] = 3.1
    assert sem._edges(flat, 40.0, 42.0, 60.0)[2] == pytest.approx(21.0, abs=0.1)


def test_the_gap_of_crowded_pillars_is_dark_where_it_is_narrow():
    """Rows of discs 6 pixels apart: half of the step lies where it lies for a disc
    alone.
    """
    y, x = np.indices((121, 121))
    near, alone = (
        np.hypot((y - 60 + h) % p - h, (x - 60 + h) % p - h)
        for p, h in ((50, 25), (400, 200))
    )
    crowded, lonely = (
        ndimage.gaussian_filter((a < 22.0).astype(float), 1.2) for a in (near, alone)
    )
    radius = [sem._edges(flat, 60.0, 60.0, 50.0)[2] for flat in (crowded, lonely)]
    assert radius[0] == pytest.approx(
        radius[1], abs=0.03
    )  # the neighbours' blur is 3e-3 of the step half-way


@pytest.mark.parametrize(("wide", "round_"), [(1.0, True), (1.7, False), (2.2, False)])
def test_bars_and_long_ellipses_are_not_taken_for_discs(wide, round_):
    """Of an ellipse of 1.7 to 1 nearly three rays of four lie within a fifth of their
    median, of a bar one of three.
    """
    y, x = np.indices((121, 121)) - 60.0
    ellipse = np.clip(0.5 + 15 * (1 - np.hypot(x / wide, y) / 15), 0, 1)
    bar = np.clip(0.5 + 15 - np.maximum(np.abs(x) / wide, np.abs(y)), 0, 1)
    fallen = [
        sem._pillar(flat, 60.0, 60.0, 96.0, there=True)[5] for flat in (ellipse, bar)
    ]
    assert fallen == ([False, False] if round_ else [wide > 2, True])


REACH = 12.0 + 0.25 * np.arange(200)  # rays a pixel apart and more


def test_plateaus_are_the_brightest_rim_and_the_darkest_third_beyond_it():
    """A dark top of 0.5, a rim of 0.9 at 30, gaps of 0.1 with one darker ring: by the
    mean over rays.
    """
    mean = np.concatenate(
        [np.full(28, 0.5), [0.6, 0.8, 0.9, 0.85], [0.3], np.full(40, 0.1)]
    )
    mean[60] = 0.02
    rays = mean[:, None] + np.array([0.03, -0.03, 0.0])
    inner, outer, rim = radial.rim_and_gap_levels(REACH[: len(rays)], rays)
    assert rim == 30
    assert inner == pytest.approx(0.9)
    assert outer == pytest.approx(
        (12 * 0.1 + 0.02) / 13
    )  # of 41 beyond the fall, its foot among them
    far = np.concatenate(
        [[0.65], np.full(29, 0.5), [0.7], np.full(30, 0.5), [0.6], np.full(40, 0.1)]
    )  # bright beyond 16 samples of the fall
    assert radial.rim_and_gap_levels(REACH[: len(far)], far[:, None])[2] == 61
    wide = np.concatenate([np.full(70, 0.5), [0.9], np.full(17, 0.6), np.full(40, 0.1)])
    assert (
        radial.rim_and_gap_levels(REACH[: len(wide)], wide[:, None])[2] == 70
    )  # a fifth of 87: 17 samples


def test_rays_run_from_a_place_in_all_directions():
    y, x = np.indices((60, 70))
    reach, angle, rays = sem._rays(0.02 * x - 0.05 * y, 31.0, 36.0, 40.0)
    assert len(angle) == 72
    assert angle[0] == pytest.approx(math.pi / 72)
    assert (reach[1], reach[-1]) == (pytest.approx(0.25), pytest.approx(20.75))
    for k in (0, 19, 50):
        want = 0.02 * (36 + 10 * math.cos(angle[k])) - 0.05 * (
            31 + 10 * math.sin(angle[k])
        )
        got = np.interp(10, reach, rays[:, k])
        # across the rays a plane keeps its mean but for exp(-(5°)² / 2), 0.4 % of what
        # it changes
        assert got == pytest.approx(want, abs=0.004 * 0.55)
    assert sem._rays(np.zeros((60, 70)), 31.0, 36.0, 18.0)[0][1] == pytest.approx(0.15)


def test_charging_of_rows_and_slow_shades_come_off_and_contrast_is_one():
    y, x = np.indices((240, 200))
    pillars = ((y % 20 - 10) ** 2 + (x % 20 - 10) ** 2 < 49).astype(float)
    shade = 3 * np.exp(-((x - 30) ** 2 + (y - 300) ** 2) / 2e4) + 0.01 * y
    one, other = (
        sem._flattened(v, 20.0) for v in (pillars, 40 * (pillars + shade) + 7)
    )
    low, high = np.percentile(one, [10, 90])
    assert (low, high) == pytest.approx((0, 1))
    inside = slice(45, -45)
    assert (
        np.abs(one - other)[inside, inside].max() < 0.2
    )  # of a shade of 4; its bend over 30 pixels is left


def test_levels_are_less_row_medians_and_a_shade_over_their_percentiles():
    """Medians of rows smoothed over two pitches, the rest over one and a half; 0 and 1
    at 10 and 90 %.
    """
    image = np.random.default_rng(9).normal(size=(90, 70)) + 0.02 * np.arange(70)
    rows = ndimage.gaussian_filter1d(np.median(image, axis=1), 16.0)
    rest = image - rows[:, None]
    rest = rest - ndimage.gaussian_filter(rest, 12.0)
    low, high = np.percentile(rest, [10, 90])
    assert sem._flattened(image, 8.0) == pytest.approx((rest - low) / (high - low))


def test_uniformity_is_three_standard_deviations_of_the_good_pillars():
    found = object.__new__(sem.MeasuredDiameters)
    object.__setattr__(
        found, "diameter_nm", np.array([151.0, math.nan, 163.0, 148.0, 155.5])
    )
    good = np.array([151.0, 163.0, 148.0, 155.5])
    assert found.three_sigma_nm == pytest.approx(
        3 * math.sqrt(((good - good.mean()) ** 2).mean()), rel=1e-12
    )
    assert found.mean_nm == pytest.approx(good.mean(), rel=1e-12)
