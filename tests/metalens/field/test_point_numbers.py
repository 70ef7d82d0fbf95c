"""Nodes, rays and samples of one field point by their formulas, typed here, and how the
field is cut into patches.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.fft
import torch

from metalens.design import Focus
from metalens.field import (
    Grid,
    Layers,
    Optics,
    SmoothWave,
    Window,
    engine,
    patches,
    points,
)
from metalens.field.rays import bending, rays, source_paths
from metalens.ground.errors import PropagationError
from metalens.lens import Media

R, D, WAVE = 45.0, 400.0, 0.85
LENS = Optics(SmoothWave(Focus(WAVE, D, 2e3), R), Layers(), D)
AIR = Media((1.0,), (D,))
CPU = torch.device("cpu")


@pytest.mark.parametrize("finest", [math.inf, 0.81])
@pytest.mark.parametrize(("samples", "period"), [(31, 1.3), (9, 2.7)])
def test_nodes_fill_the_aperture_and_harmonics_the_samples(samples, period, finest):
    """Steps of wavelength over period; a second zero at 2 / sample. Beyond h falls c /
    h, c = 4√2 / (π² k p): the
    window lacks ∫ (1 - sinc²(X / period)) c dX / X² to h = half its width, at first π²
    c h / 3 period²."""
    found = points.sampling(LENS, Window(samples, 2.0, period=period), WAVE, finest)
    edge, wide = R / math.hypot(R, D), samples * 2.0
    step = min(WAVE, finest) / (wide * period)
    assert found.step == pytest.approx(step, rel=1e-12)
    assert found.period_um == pytest.approx(WAVE / step, rel=1e-12)
    assert (found.nodes - 2) % 2 == 0
    assert edge <= (found.nodes - 2) / 2 * step < edge + step
    assert found.harmonics == math.floor(2 * found.period_um / 2.0)
    least = max(
        found.nodes + math.ceil(0.7 * found.harmonics) + 1, 2 * found.harmonics + 2
    )
    assert found.size == 16 * scipy.fft.next_fast_len(math.ceil(least / 16))
    c = 4 * math.sqrt(2) / (math.pi**2 * 2 * math.pi / WAVE * edge)
    assert found.beyond == pytest.approx(c / (wide / 2 * period / 1.06), rel=1e-12)
    assert found.dimmed == pytest.approx(
        math.pi**2 / 3 * c * (wide / 2) / (wide * period) ** 2, rel=1e-12
    )


def test_apertures_of_na_0_9_are_taken_and_none_beyond():
    for na, taken in ((0.899, True), (0.901, False)):
        optics = Optics(
            SmoothWave(Focus(WAVE, D, 2e3), D * math.tan(math.asin(na))), Layers(), D
        )
        if taken:
            points.sampling(optics, Window(9, 2.0), WAVE)
        else:
            with pytest.raises(
                PropagationError,
                match=r"aperture of NA 0\.90: the image engine takes up to 0\.9",
            ):
                points.sampling(optics, Window(9, 2.0), WAVE)


def test_rays_of_a_field_point_leave_the_lens_where_their_direction_points_back_to():
    """d p / √(1 - p²) aside in air; a node is as wide as √(d²/(1 - p²)²) times its
    step; the middle of the pupil lies
    between the rays of the rim, exactly where the point lies on an axis."""
    step = 0.011
    found = rays(AIR, R, (170.0, 0.0), (24, step), CPU)
    ends = [(170.0 + s * R) / math.hypot(170.0 + s * R, D) for s in (-1, 1)]
    assert float(found.middle[0]) == pytest.approx(sum(ends) / 2, rel=1e-12)
    assert float(found.middle[1]) == pytest.approx(0.0, abs=1e-12)
    aside = (np.arange(24) - 11.5) * step
    assert found.aside.numpy() == pytest.approx(aside, abs=1e-12)
    px, py = np.meshgrid(aside + float(found.middle[0]), aside)
    p2 = px**2 + py**2
    x, y = 170 - D * px / np.sqrt(1 - p2), -D * py / np.sqrt(1 - p2)
    wide, r = D / (1 - p2), np.hypot(x, y)
    assert found.x_um.numpy() == pytest.approx(x, rel=1e-9)
    assert found.y_um.numpy() == pytest.approx(y, rel=1e-9, abs=1e-9)
    assert found.width_um.numpy() == pytest.approx(wide * step, rel=1e-9)
    assert found.away_um.numpy() == pytest.approx(D / np.sqrt(1 - p2) - D, rel=1e-9)
    part = np.clip((R - r) / (wide * step) + 0.5, 0, 1)
    assert 0 < np.count_nonzero((part > 0) & (part < 1)) < np.count_nonzero(part)
    assert found.whole.numpy() == pytest.approx(part * wide, abs=1e-6)
    assert found.passed.numpy() == pytest.approx(np.ones((24, 24)))


def test_how_directions_turn_as_a_window_moves_bends_with_the_direction():
    """H = √(1 - p²)/d (1 - p pᵀ), the derivative of X / √(X² + d²); its differences in
    closed form of smaller steps.
    """

    def turning(p):
        return math.sqrt(1 - p @ p) / D * (np.eye(2) - np.outer(p, p))

    p, unit = np.array([0.31, -0.17]), np.eye(2) * 1e-4
    slope, curvature = bending(AIR, torch.from_numpy(p))
    for j in range(2):
        want = (turning(p + unit[j]) - turning(p - unit[j])) / 2e-4
        assert slope[j].numpy() == pytest.approx(
            want, abs=1e-5 / D
        )  # of differences of 1e-3
        for i in range(2):
            ends = [
                turning(p + a * unit[i] + b * unit[j])
                for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
            ]
            want = (ends[0] - ends[1] - ends[2] + ends[3]) / 4e-8
            assert curvature[i, j].numpy() == pytest.approx(want, abs=3e-5 / D)


def test_paths_of_many_depths_are_mixtures_of_five():
    seen = rays(AIR, R, (50.0, 20.0), (8, 0.03), CPU)
    for depths, few in (
        ((700.0, 900.0, 1500.0), 3),
        (tuple(np.linspace(700, 1500, 5)), 5),
        ((*range(700, 1600, 100),), 5),
    ):
        found = source_paths(
            Layers(), torch.tensor([0.1, 0.05]), seen, torch.tensor(depths), WAVE
        )
        assert (len(found.few_um), found.mix.shape) == (few, (len(depths), few))


@pytest.mark.parametrize(("view", "shift"), [(0.0, 0.0), (9.0, 0.0), (-3.7, 1.9)])
def test_points_of_a_transform_are_summed_on_samples_as_squares_of_squares(view, shift):
    """Σ sinc²(h step / period) cos(2π h (place / period + m / size)) over all
    harmonics, of either sign; dark where a
    sample lies more than half a period from where light lands. Below it the slope by
    the place."""
    window = Window(7, 2.0, period=1.4)
    grid = points.sampling(LENS, window, WAVE)
    made = points._to_samples(grid, window, view, shift, CPU)
    place = (np.arange(7) - 3) * 2.0 - view
    lit = np.where(np.abs(place) <= 7 * 2.0 * 1.4 / 2, 1.0, 1e-6)
    h, m = np.arange(-grid.harmonics, grid.harmonics + 1), np.arange(grid.size)
    angle = (
        2
        * np.pi
        * h
        * ((place - shift)[:, None, None] / grid.period_um + m[:, None] / grid.size)
    )
    box = np.sinc(h * 2.0 / grid.period_um) ** 2
    scale = 2.0 / grid.period_um
    light = scale * lit[:, None] * (box * np.cos(angle)).sum(-1)
    slope = (
        -scale
        * lit[:, None]
        * (box * 2 * np.pi * h / grid.period_um * np.sin(angle)).sum(-1)
    )
    most = np.abs(light).max(), np.abs(slope).max()
    assert made.both.numpy()[:7] == pytest.approx(light, abs=1e-6 * most[0])
    assert made.both.numpy()[7:] == pytest.approx(slope, abs=1e-6 * most[1])
    assert made.place_um.numpy() == pytest.approx(place - shift, abs=1e-6)
    assert (lit < 1).sum() == {0.0: 0, 9.0: 3, -3.7: 0}[view]


@pytest.mark.parametrize(
    ("samples", "count"),
    [((20, 40), 1), ((39, 90), 1), ((41, 80), 2), ((98, 97), 4), ((95, 98), 3)],
)
def test_a_field_is_cut_into_patches_of_28_samples_that_share_four(
    monkeypatch, samples, count
):
    """As many along each axis as the shorter one has, to the nearest number; a quarter
    of the kernels' share of the
    tolerance is theirs."""
    asked = {}
    monkeypatch.setattr(
        engine.cutting, "cut", lambda *given, **more: asked.update(more) or []
    )
    monkeypatch.setattr(engine, "between_nodes", lambda *_: None)
    monkeypatch.setattr(engine, "with_psfs", lambda made, *_: made)
    made = engine.patched(
        Grid(samples, 2.0, (3e3, 9e3), margin=1, window=3),
        SimpleNamespace(),
        None,
        None,
        tolerance=0.02,
    )
    assert asked == {
        "patches": count,
        "overlap": 4,
        "tolerance": pytest.approx(0.02 * 0.6 / 4),
    }
    assert made.parts == {"kernels": pytest.approx(0.003)}


def test_a_patch_knows_its_nodes_and_the_places_that_its_kernels_are_made_of():
    """Five from its first pixel to its last, and as many as it has nodes whose weights
    are interpolated; all of few.
    """
    nodes = torch.linspace(0, 40, 9, dtype=torch.float64)
    grid = patches.dense(torch.arange(41, dtype=torch.float64), nodes)
    line = patches._line(grid, 11, 34, torch.ones(23))
    assert line.nodes.tolist() == [
        1,
        2,
        3,
        4,
        5,
        6,
        7,
        8,
    ]  # two beyond the patch at either side, five pixels apart
    assert line.at.tolist() == np.round(np.linspace(0, 22, 8)).tolist()
    assert torch.equal(line.few, grid[11:34][[0, 6, 11, 16, 22]][:, 1:])
    assert torch.equal(line.many, grid[11:34][line.at][:, 1:])
    few = patches._line(grid, 11, 14, torch.ones(3))
    assert len(few.few) == len(few.at) == 3


def test_errors_of_a_dark_patch_count_by_the_light_of_its_brightest_pixel():
    """Light falls along x from 5 to 0.5; over 30 pixels a straight line is interpolated
    exactly.
    """
    draw = np.random.default_rng(3)
    stack = torch.from_numpy(draw.random((4, 5, 2, 3, 3)))
    stack /= stack.sum((-1, -2), keepdim=True)
    between = [
        patches.dense(
            torch.linspace(0, 1, n, dtype=torch.float64),
            torch.linspace(0, 1, k, dtype=torch.float64),
        )
        for n, k in ((20, 4), (30, 5))
    ]
    fall = torch.linspace(5.0, 0.5, 5).double()[None, :, None].expand(4, 5, 2)
    made = [
        patches.cut(stack, light, between, patches=2, overlap=2, tolerance=1e-12)
        for light in (torch.ones_like(fall), fall)
    ]
    lit = np.linspace(5.0, 0.5, 30)
    for even, dark in zip(*made, strict=True):
        share = lit[slice(*dark.columns)].max() / 5
        assert dark.missing[:-1].numpy() == pytest.approx(
            even.missing[:-1].numpy() * share, rel=1e-9
        )
    assert len({dark.columns for dark in made[1]}) == 2
