"""Grids, blocks and fades of wide windows and large lenses against plain loops and
closed forms.
"""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import special, stats

from metalens.lens import Media
from metalens.propagate import PropagationCase, grids, wide
from metalens.propagate.blocks import AxisBlocks
from metalens.propagate.grids import WideAxis

CASE = PropagationCase(
    (30, 41),
    0.37,
    0.85,
    62.0,
    (0.21, -0.13),
    (1 / 400, 1 / 2500),
    (14.0, -8.5),
    0.6,
    (13, 24),
)


def axis(**numbers):
    given = {name: 0 for name in WideAxis.__dataclass_fields__}
    return WideAxis(**(given | numbers))


def test_light_between_grid_points_is_spread_by_a_sinc_under_kaisers_window():
    made = axis(count=61, first_um=-21.0, step_um=0.7, taps=7, over=1.6)
    places = np.array([-3.1, 0.13, 4.99])
    got = grids.spread_weights(made, places)
    beta = math.pi * 7 * (1 - 1 / 1.6)
    for i, place in enumerate(places):
        for m in range(61):
            t = (place - (-21.0 + 0.7 * m)) / 0.7
            window = (
                special.i0(beta * math.sqrt(1 - (t / 7) ** 2)) / special.i0(beta)
                if abs(t) < 7
                else 0.0
            )
            assert got[i, m] == pytest.approx(np.sinc(t) * window, abs=1e-14)
    grid = -21.0 + 0.7 * np.arange(61)
    for share in (
        0.0,
        0.4,
        0.97,
    ):  # waves of the band hold to what the taps were chosen for
        f = share / (2 * 0.7 * 1.6)
        off = np.abs(
            got @ np.exp(2j * np.pi * f * grid) - np.exp(2j * np.pi * f * places)
        ).max()
        assert off < 10 * math.exp(-math.pi * 6 * 0.6 / 1.6)


@pytest.mark.parametrize(
    ("pillars", "length", "nodes", "bases"),
    [(23, 8, 5, [0, 8, 15]), (16, 8, 8, [0, 8])],
)
def test_blocks_hold_every_pillar_and_their_nodes_carry_polynomials(
    pillars, length, nodes, bases
):
    made = AxisBlocks(pillars, length, nodes)
    assert made.count == len(bases)
    assert made.bases.tolist() == bases
    place = (np.arange(pillars) - (pillars - 1) / 2) * 0.37
    middles = [place[b : b + length].mean() for b in bases]
    assert made.middles_um(0.37) == pytest.approx(middles)
    at = made.nodes_um(0.37).reshape(len(bases), nodes)
    for b, row in zip(bases, at, strict=True):
        for power in range(nodes):  # as many powers as nodes
            light = np.random.default_rng(power).normal(size=length)
            own = (
                place[b : b + length] - place[b : b + length].mean()
            ) ** power @ light
            assert (row - place[b : b + length].mean()) ** power @ (
                made.weights @ light
            ) == pytest.approx(own, abs=1e-9)
    assert AxisBlocks(5, 1, 1).along.tolist() == [0.0]


def test_light_is_faded_by_the_integral_of_a_gaussian_in_the_middle_of_its_band():
    made = axis(guard=0.08, sharp=2.7)
    past = np.array([-0.02, 0.0, 0.013, 0.04, 0.071, 0.08])
    want = stats.norm.sf(past, loc=0.04, scale=0.04 / 2.7)
    assert wide._fade(made, past) == pytest.approx(want, rel=1e-9)


def test_seconds_of_three_transforms_by_their_points_and_depths(monkeypatch):
    y = axis(count=90, first=200, size=120, fine=150)
    x = axis(count=70, first=180, size=100, fine=250)
    monkeypatch.setattr(grids, "wide_axes", lambda case, tolerance: (y, x))
    points = (90 * 180 + 200 * 100) / 2 + 120 * 100 + 150 * 250
    few = 1e-3 + 2 * points * 1e-8 + 2 * 2 * 13 * 24 * 4e-10
    assert grids.expected_cost(CASE, 1e-4) == pytest.approx(few, rel=1e-12)
    many = replace(
        CASE, inverse_depths_per_um=tuple(np.linspace(1 / 2500, 1 / 400, 21))
    )
    assert grids.expected_cost(many, 1e-4) == pytest.approx(
        1e-3 + 14 * points * 1e-8 + 21 * 14 * 312 * 4e-10, rel=1e-12
    )
    monkeypatch.setattr(grids, "wide_axes", lambda case, tolerance: None)
    assert grids.expected_cost(CASE, 1e-4) == math.inf
    assert not grids.is_wide(CASE, 1e-4)


@pytest.mark.parametrize(
    ("count", "most", "wide_one"),
    [(140, 3.6, True), (138, 3.6, False), (140, 3.4, False)],
)
def test_a_window_is_wide_from_120_points_and_half_waves_on(
    monkeypatch, count, most, wide_one
):
    """Lens points beside the taps, and 4 |p| half width / wavelength: 121 of 3.9 um,
    119 and less are not.
    """
    half = 0.85 * 121 / (4 * 3.6)
    case = SimpleNamespace(wavelength_um=0.85, half_window_um=(half, 2 * half))
    made = axis(count=count, taps=9, most=most), axis(count=170, taps=9, most=most)
    monkeypatch.setattr(grids, "wide_axes", lambda case, tolerance: made)
    assert grids.is_wide(case, 1e-4) is wide_one


def rays(case, half):
    """(along y and along x) reach and direction cosine of rays in air from lens to
    window, on a fine grid.
    """
    unit = np.cos(np.pi * (np.arange(33) + 0.5) / 33)
    y, x = (
        c + unit * (w + h)
        for c, w, h in zip(case.centre_um[::-1], half, case.half_size_um, strict=True)
    )
    far = np.sqrt(y[:, None] ** 2 + x**2 + case.sensor_distance_um**2)
    return (np.broadcast_to(y[:, None], far.shape), y[:, None] / far), (
        np.broadcast_to(x, far.shape),
        x / far,
    )


def test_the_quadratic_follows_the_rays_by_least_squares():
    fits = grids._fitted(CASE, [3.0, 7.0])
    both = rays(CASE, [3.0, 7.0])
    steepest = math.sqrt(max((both[0][1] ** 2 + both[1][1] ** 2).ravel()))
    for fit, (reach, p) in zip(fits, both, strict=True):
        middle = (p.min() + p.max()) / 2
        design = np.stack([np.ones(p.size), (p - middle).ravel()], 1)
        level, slope = np.linalg.lstsq(design, reach.ravel(), rcond=None)[0]
        left = np.abs(reach.ravel() - design @ [level, slope]).max()
        want = (middle, level, slope, np.abs(p - middle).max(), left, steepest)
        got = (
            fit.middle,
            fit.reach_um,
            fit.stretch_um,
            fit.most,
            fit.extra_um,
            fit.steepest,
        )
        assert got == pytest.approx(want, rel=1e-9)
    assert (
        grids._fitted(replace(CASE, sensor_distance_um=12.0), [3.0, 7.0]) is None
    )  # beyond 0.93


def test_the_kernels_band_is_the_largest_turn_of_rays_and_of_sources_over_lens_and_window():
    """Corners, edges and middles of lens and window; sources of the extreme depths less
    the middle one, by slopes.
    """
    z, (hy, hx), (wy, wx) = 62.0, CASE.half_size_um, CASE.half_window_um
    middle = (1 / 400 + 1 / 2500) / 2

    def cosine(i, y, x):
        return (y, x)[i] / math.hypot(y, x, z)

    def source(y, x, inverse):
        d = 1 / inverse
        there = math.hypot(x + d * 0.21, y - d * 0.13, d)
        return there - d * math.sqrt(1 + 0.21**2 + 0.13**2)

    for i, extra in ((0, 0.7), (1, 0.0), (1, 1.9)):
        ends, steep, turned = (-1, 0, 1), 0.0, 0.0
        for a, b, c, d in itertools.product(ends, repeat=4):
            Y = c * wy + (np.sign(c) * extra if i == 0 else 0)
            X = d * wx + (np.sign(d) * extra if i == 1 else 0)
            y, x = -8.5 - a * hy, 14.0 - b * hx
            turned = max(turned, abs(cosine(i, y + Y, x + X) - cosine(i, y, x)))
        for a, b, inverse in itertools.product(ends, ends, (1 / 400, 1 / 2500)):
            h = 0.5e-3
            step = (h, 0.0) if i == 0 else (0.0, h)
            at = [(a * hy + s * step[0], b * hx + s * step[1]) for s in (1, -1)]
            rise = [source(*p, inverse) - source(*p, middle) for p in at]
            steep = max(steep, abs(rise[0] - rise[1]) / 1e-3)
        assert grids._band(CASE, i, extra) == pytest.approx(turned + steep, rel=1e-5)


def test_what_is_faded_goes_astray_by_what_the_quadratic_leaves_of_its_reach():
    fits = grids._fitted(CASE, list(CASE.half_window_um))
    guards = [0.04, 0.07]
    got = grids._beyond(CASE, fits, guards)
    unit = np.linspace(-1, 1, 33)
    y, x = (f.middle + unit * (f.most + g) for f, g in zip(fits, guards, strict=True))
    most = [0.0, 0.0]
    for a, b in itertools.product(y, x):
        if a * a + b * b <= (fits[0].steepest + 0.07) ** 2:
            bend = 62.0 / math.sqrt(1 - a * a - b * b)
            for i, p in enumerate((a, b)):
                fit = fits[i]
                most[i] = max(
                    most[i],
                    abs(p * bend - fit.reach_um - fit.stretch_um * (p - fit.middle)),
                )
    assert got == pytest.approx(most, rel=1e-9)


def test_the_transfer_of_plane_waves_is_the_sum_over_the_layers():
    stack = replace(CASE, behind=Media((1.5, 1.2), (20.0, 42.0)))
    assert wide._phase_path(CASE, 0.3) == pytest.approx(62 * math.sqrt(0.7))
    assert wide._phase_path(stack, 0.3) == pytest.approx(
        20 * math.sqrt(2.25 - 0.3) + 42 * math.sqrt(1.44 - 0.3)
    )


def test_nodes_of_the_depths_are_six_a_turn_and_24_more():
    grid, middle = np.linspace(-9.0, 9.0, 31), (1 / 400 + 1 / 2500) / 2

    def source(y, x, inverse):
        d = 1 / inverse
        return math.hypot(x + d * 0.21, y - d * 0.13, d) - d * math.sqrt(
            1 + 0.21**2 + 0.13**2
        )

    for i in (0, 1):
        turns = 0.0
        for beside, along, inverse in itertools.product(
            (0.0, *CASE.half_size_um), (-9.0, 9.0), (1 / 400, 1 / 2500)
        ):
            place = (along, beside) if i == 0 else (beside, along)
            turns = max(
                turns, abs(source(*place, inverse) - source(*place, middle)) / 0.85
            )
        assert wide._coarse(CASE, i, grid) == 24 + math.ceil(6 * turns)


LARGE = PropagationCase(
    (420, 540),
    0.37,
    0.85,
    640.0,
    (0.11, -0.07),
    (1 / 4e3, 1 / 9e3),
    (66.0, -51.0),
    0.9,
    (230, 170),
)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5])
def test_grids_of_a_wide_window_hold_its_light_its_fade_and_the_kernels_band(tolerance):
    """Every number of both axes by its formula, from the rays, the band and the
    tolerance alone.
    """
    found, k = grids.wide_axes(LARGE, tolerance), 2 * math.pi / 0.85
    fits = grids._fitted(LARGE, list(LARGE.half_window_um))
    for _ in range(2):  # rays to where the quadratic leaves them
        reached = [
            w + fit.extra_um for w, fit in zip(LARGE.half_window_um, fits, strict=True)
        ]
        fits = grids._fitted(LARGE, reached)
    sharp = math.sqrt(0.8 * math.log(1 / tolerance))
    fade = 2 * sharp**2 / k
    for i, axis_ in enumerate(found):
        half, lens = LARGE.half_window_um[i], LARGE.half_size_um[i]
        fit = fits[i]
        assert axis_.most == pytest.approx(fit.most, rel=1e-9)
        guard = math.sqrt(2 * fade * axis_.most / (2 * (half + fit.extra_um)))
        assert axis_.guard == pytest.approx(guard, rel=1e-9)
        assert axis_.sharp == pytest.approx(sharp, rel=1e-12)
        coarse = 0.85 / 2 / (axis_.most + axis_.guard)
        assert axis_.every == math.ceil(0.9 / coarse)
        period = axis_.fine * 0.9 / axis_.every
        beyond = grids._beyond(LARGE, fits, [a.guard for a in found])[i]
        width = 2 * (half + beyond) + 4 * sharp**2 / k / axis_.guard
        assert (
            width * (1 - 1e-9) <= period < 1.1 * width
        )  # multiples of 4 of factors 2, 3, 5 and 7 lie as close
        assert (
            min(period / coarse, axis_.fine) * (1 - 1e-9)
            <= axis_.size
            < 1.1 * period / coarse + 8
        )
        assert axis_.step_um * axis_.first == pytest.approx(
            0.85 * axis_.stretch_um * axis_.size / period, rel=1e-9
        )
        band = grids._band(LARGE, i, fit.extra_um)
        assert axis_.over == pytest.approx(0.85 / (2 * band) / axis_.step_um, rel=1e-9)
        assert axis_.over >= 1.2
        assert axis_.taps == math.ceil(
            1 + math.log(10 / tolerance) * axis_.over / (math.pi * (axis_.over - 1))
        )
        assert (
            axis_.count
            == math.ceil(2 * lens / axis_.step_um) + 2 * axis_.taps + 1
            <= axis_.first
        )
        assert axis_.first_um == pytest.approx(-(axis_.count - 1) / 2 * axis_.step_um)
        assert (axis_.middle, axis_.reach_um) == pytest.approx(
            (fit.middle, fit.reach_um), rel=1e-9
        )


def test_windows_whose_rays_no_quadratic_follows_have_no_grids():
    near = replace(LARGE, sensor_distance_um=30.0)
    assert grids.wide_axes(near, 1e-4) is None
    assert grids.expected_cost(near, 1e-4) == math.inf


@pytest.mark.parametrize(
    ("points", "size"),
    [(577.2, 588), (576.0, 576), (1801.0, 1920), (625.0, 640), (101.0, 108)],
)
def test_transforms_have_sizes_that_are_quick(points, size):
    """The next multiple of 4 whose only factors are 2, 3, 5 and 7 (1804 to 1916 hold
    one of 11 or more).
    """
    assert grids._quick(points) == size
