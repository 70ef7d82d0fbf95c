"""Choices of nodes on lines of PSFs whose interpolation error is known: base + eps t⁴ ·
change, change of sum 0.
"""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.design import Focus
from metalens.field import Grid, SmoothWave, engine, forming, patches, plan, slopes
from metalens.field.patches import relative, shares
from metalens.ground.errors import SceneError
from metalens.lens import Layers, Stop
from metalens.psf import Nodes, Source, spectrum

draw = np.random.default_rng(21)
SMOOTH = SimpleNamespace(
    wave=None
)  # no pillars, which would be known for some wavelengths alone
BASE = torch.from_numpy(draw.random((7, 7)) + 0.3)
BASE /= BASE.sum()
CHANGE = torch.from_numpy(draw.random((7, 7)))
CHANGE = CHANGE / CHANGE.sum() - BASE
RATIO = float(
    relative(BASE + CHANGE, BASE)
)  # of change to base, as a 1/f texture sees them


def line(eps, length):
    """PSFs at places 0 … length: base + eps (place / length)⁴ change, brightness
    falling along the line.
    """

    def at(places):
        t = places / length
        psf = BASE + eps * (t**4)[:, None, None] * CHANGE
        return (psf * (1.7 - t)[:, None, None])[:, None]

    return at


def cubic_error(eps, intervals):
    """Of t⁴ half-way between even nodes: ∏ (t - t_i) is 0.5625 h⁴, in the first and the
    last interval 0.9375 h⁴; each
    counts by its light."""
    product = np.full(intervals, 0.5625)
    product[[0, -1]] = 0.9375
    light = 1.7 - (np.arange(intervals) + 0.5) / intervals
    return (
        eps
        * RATIO
        * np.linalg.norm(product * light)
        / np.linalg.norm(light)
        / intervals**4
    )


@pytest.mark.parametrize(
    ("between", "nodes"), [((4, 6), 7), ((6, 8), 9), ((8, 12), 13), ((16, 24), 25)]
)
def test_as_few_depths_as_the_error_of_cubics_asks_for(between, nodes):
    eps = 1e-3  # change of the norm itself: 1e-3 of the error
    few, enough = (cubic_error(eps, n) for n in between)
    assert plan._fewest(line(eps, plan.FINE), 1.01 * enough, "depths") == nodes
    assert plan._fewest(line(eps, plan.FINE), 0.99 * few, "depths") == nodes
    with pytest.raises(SceneError, match=r"25 depths leave .* of the image"):
        plan._fewest(line(eps, plan.FINE), 0.99 * cubic_error(eps, 24), "depths")


@pytest.mark.parametrize("light", [0.0, math.nan])
def test_places_that_no_light_reaches_are_refused_with_what_to_do(light):
    """As of a lens whose frame reaches to 88 degrees: windows there hold nothing, or no
    number.
    """
    dark = plan._Known(
        lambda places: torch.where(places[:, None, None, None] > 90, light, 1.0) * BASE
    )
    assert [part.shape for part in dark.psfs([12, 90])] == [(2, 1, 7, 7), (2, 1)]
    with pytest.raises(
        SceneError,
        match=r"80 degrees of field or beyond \(take fewer or smaller samples\)",
    ):
        dark.psfs([12, 91])


def test_as_few_field_points_as_the_error_of_cubics_asks_for():
    """Nodes on an axis of 192 steps, even or denser at the rim, whichever err less;
    what is tried next comes from how
    the error falls, so a few may be spared."""
    eps, span = 1e-3, (0.0, 300.0)
    for intervals in (8, 12, 16, 24):
        tolerance = 1.01 * cubic_error(eps, intervals)
        count, denser = plan._line(line(eps, plan.ALONG), span, tolerance)
        assert count <= 1.5 * intervals + 2
        known = plan._Known(line(eps, plan.ALONG))
        tried = {
            d: known.error(plan.placed(count, d, span).int().tolist())
            for d in plan.DENSER
        }
        assert denser == min(tried, key=tried.get)
        assert tried[denser] <= tolerance
    with pytest.raises(SceneError, match="field points along an axis leave"):
        plan._line(line(eps, plan.ALONG), span, 1e-12)


@pytest.mark.parametrize("sizes", [(1.0, 0.4), (0.3, 1.0)])
def test_the_error_of_a_line_is_that_of_its_worst_depth(sizes):
    nodes = list(range(0, plan.FINE + 1, 12))
    both = plan._Known(
        lambda places: torch.cat(
            [line(1e-3 * size, plan.FINE)(places) for size in sizes], 1
        )
    )
    assert both.error(nodes) == pytest.approx(
        plan._Known(line(1e-3, plan.FINE)).error(nodes), rel=1e-9
    )


def test_a_field_off_the_axis_is_tried_where_it_lies(monkeypatch):
    """No place farther from its middle than its rims, and both rims of its line; of 31
    and 9 um about (70, -40).
    """
    seen = []

    def spectral(optics, at, depths, waves, window):
        seen.append(at.reshape(-1, 2))
        return BASE.expand(len(at), len(depths), 7, 7)

    monkeypatch.setattr(plan, "spectral", spectral)
    monkeypatch.setattr(plan, "neglected", lambda *_: 0.0)
    monkeypatch.setattr(plan, "folded", lambda *_: 0.0)
    monkeypatch.setattr(plan, "polarised", lambda judged, *_, **__: judged.window)
    grid, waves = (
        Grid((10, 32), 2.0, (3e3, 9e3), window=7),
        Nodes(np.array([0.85]), np.array([1.0]), 0.0),
    )
    plan.planned(None, grid, waves, (70.0, -40.0), tolerance=0.01, folds=False)
    off = torch.cat(seen) - torch.tensor([70.0, -40.0])
    half = torch.tensor(grid.half_um[::-1])
    assert bool((off.abs() <= half + 1e-9).all())
    assert [float(off[:, 0].min()), float(off[:, 0].max())] == pytest.approx(
        [-float(half[0]), float(half[0])]
    )


def test_a_spectrum_takes_the_rule_that_the_next_one_confirms(monkeypatch):
    """A fifth power of the wavelength: three nodes of Gauss are exact, two are not; so
    three are taken, of error 0.
    """

    def spectral(optics, at, depths, waves, window):
        share = (
            (torch.from_numpy(waves.wavelengths_um) - 0.83) / 0.05
        ) ** 5 @ torch.from_numpy(waves.weights)
        return (BASE + 1e-3 * share * CHANGE).expand(len(at), len(depths), 7, 7)

    monkeypatch.setattr(plan, "spectral", spectral)
    source, grid = Source(850.0, 41.0), Grid((5, 6), 2.0, (3e3, 9e3), window=7)
    made = plan.waves_of(SMOOTH, grid, source, (0.0, 0.0), [4.0, 5.0], 1e-9)
    assert len(made.wavelengths_um) == 3
    assert made.error < 1e-12
    two, three = (plan._coarse(SMOOTH, source, n) for n in (2, 3))
    apart = [
        float(((n.wavelengths_um - 0.83) / 0.05) ** 5 @ n.weights) for n in (two, three)
    ]
    error = 1e-3 * abs(apart[0] - apart[1]) * RATIO
    loose = plan.waves_of(SMOOTH, grid, source, (0.0, 0.0), [4.0, 5.0], 1.02 * error)
    assert len(loose.wavelengths_um) <= 2
    if len(loose.wavelengths_um) == 2:
        assert loose.error == pytest.approx(error, rel=0.01)


def test_a_spectrum_is_judged_where_it_changes_an_image_most_and_by_what_lies_beside_it(
    monkeypatch,
):
    """Twice as much at the farther depth, and by the distance from the middle: 0.9 and
    0.8 of the way to the rims.
    Of a measured source what it leaves out adds to the error of any rule."""
    grid, half = Grid((5, 6), 2.0, (3e3, 9e3), window=7), (24.0, 31.0)

    def moment(waves):
        return float(((waves.wavelengths_um - 0.83) / 0.05) ** 5 @ waves.weights)

    def spectral(optics, at, depths, waves, window):
        off = (at - torch.tensor([7.0, -3.0])).abs() / torch.tensor([31.0, 24.0])
        size = (0.6 * off[:, :1] + 0.4 * off[:, 1:]) * torch.where(
            depths > 5e3, 2.0, 1.0
        )
        return BASE + 1e-3 * moment(waves) * size[..., None, None] * CHANGE

    monkeypatch.setattr(plan, "spectral", spectral)
    um = np.linspace(0.80, 0.89, 21)
    share = np.exp(-((um - 0.83) ** 2) / 2e-4) + 2 * (um - 0.8)
    source = spectrum.Measured(um, share / share.sum(), beside=1e-3 * RATIO)
    two, three = (plan._coarse(SMOOTH, source, n) for n in (2, 3))
    error = (
        1e-3 * abs(moment(two) - moment(three)) * RATIO * 2 * (0.6 * 0.9 + 0.4 * 0.8)
        + source.beside
    )
    for much, count, left in ((1.01, 2, error), (0.99, 3, source.beside)):
        made = plan.waves_of(
            SMOOTH, grid, source, (7.0, -3.0), list(half), much * error
        )
        assert len(made.wavelengths_um) == count
        assert made.error == pytest.approx(
            left, rel=5e-3
        )  # RATIO is that of a small change


@pytest.mark.parametrize(
    ("samples", "middle", "folds"),
    [((6, 6), 0.0, True), ((6, 7), 0.0, False), ((6, 6), 0.0, False)],
)
def test_a_field_folds_only_where_it_is_square(monkeypatch, samples, middle, folds):
    monkeypatch.setattr(
        plan, "spectral", lambda o, at, z, w, win: BASE.expand(len(at), len(z), 7, 7)
    )
    monkeypatch.setattr(plan, "neglected", lambda *_: 0.0)
    monkeypatch.setattr(plan, "folded", lambda *_: 0.0)
    monkeypatch.setattr(plan, "polarised", lambda judged, *_, **__: judged.window)
    grid = Grid(samples, 2.0, (3e3, 9e3), window=7)
    round_lens = folds or samples[0] != samples[1]
    waves = Nodes(np.array([0.85]), np.array([1.0]), 0.0)
    made = plan.planned(
        None, grid, waves, (middle, middle), tolerance=0.01, folds=round_lens
    )
    assert made.folds is folds
    assert [len(made.y_um), len(made.x_um)] == [5, 5]  # the least that is tried
    half = [(n - 1) / 2 * 2.0 for n in grid.frame]
    assert [float(made.y_um[-1]), float(made.x_um[-1])] == pytest.approx(half)
    assert [float(made.y_um[0]), float(made.x_um[0])] == pytest.approx(
        [-h for h in half]
    )
    assert len(made.depths_um) == 5


@pytest.mark.parametrize(
    ("samples", "counts"), [((20, 40), [4, 5]), ((40, 20), [9, 5]), ((1, 90), [2, 5])]
)
def test_nodes_lie_as_densely_along_y_as_a_line_along_x_asks_for(
    monkeypatch, samples, counts
):
    """Five along x: steps of a quarter of its length, no longer ones along y; two at
    least. Rays that err by more than
    0.36 of the tolerance are seen from every place."""
    monkeypatch.setattr(
        plan, "spectral", lambda o, at, z, w, win: BASE.expand(len(at), len(z), 7, 7)
    )
    monkeypatch.setattr(plan, "folded", lambda *_: 0.0)
    monkeypatch.setattr(plan, "polarised", lambda judged, *_, **__: judged.window)
    grid, waves = (
        Grid(samples, 2.0, (3e3, 9e3), window=7),
        Nodes(np.array([0.85]), np.array([1.0]), 0.0),
    )
    for left in (0.0035, 0.0037):
        monkeypatch.setattr(plan, "neglected", lambda *_, left=left: left)
        made = plan.planned(
            None, grid, waves, (31.0, -17.0), tolerance=0.01, folds=True
        )
        assert made.window.curved is (left > 0.0036)
    assert not made.folds
    assert [len(made.y_um), len(made.x_um)] == counts
    for nodes, middle, n in (
        (made.y_um, -17.0, grid.frame[0]),
        (made.x_um, 31.0, grid.frame[1]),
    ):
        assert [float(nodes[0]), float(nodes[-1])] == pytest.approx(
            [middle - (n - 1), middle + (n - 1)]
        )


def test_light_from_one_point_and_one_wavelength_is_drawn_evenly_and_by_weight(
    monkeypatch,
):
    """3000 draws of 12 places: 250 each, sigma 15; of weights 1 : 3."""
    seen = []

    def term(optics, made, gradient, point, wave):
        seen.append((point, wave))
        return torch.tensor(2.5)

    monkeypatch.setattr(slopes, "term", term)
    made = SimpleNamespace(
        y_um=torch.arange(4.0),
        x_um=torch.arange(3.0),
        waves=Nodes(np.array([0.84, 0.86]), np.array([0.25, 0.75]), 0.0),
    )
    generator = torch.Generator().manual_seed(4)
    assert (
        float(slopes.surrogate(None, made, None, slopes.drawn(made, 3000, generator)))
        == 2.5
    )
    counts = np.bincount([point for point, _ in seen], minlength=12)
    assert len(counts) == 12
    assert abs(counts - 250).max() < 75
    assert abs(sum(wave for _, wave in seen) - 2250) < 5 * math.sqrt(3000 * 0.25 * 0.75)


def test_patches_that_share_no_pixels_have_each_one_whole():
    made = shares(10, 3, 0)
    assert [(a, b) for a, b, _ in made] == [(0, 3), (3, 6), (6, 10)]
    assert all(torch.equal(share, torch.ones_like(share)) for _, _, share in made)


def test_patches_that_overlap_share_by_a_sine_squared():
    """Pixels 8 to 11 of 20 lie within two of the edge at 10: their middles at -3/8,
    -1/8, 1/8, 3/8 of the overlap.
    """
    (a, b, first), (c, d, second) = shares(20, 2, 4)
    assert (a, b, c, d) == (0, 12, 8, 20)
    up = [
        math.sin(math.pi / 2 * (p + 0.5)) ** 2 for p in (-0.375, -0.125, 0.125, 0.375)
    ]
    assert second[:4].tolist() == pytest.approx(up, rel=1e-12)
    assert first[8:].tolist() == pytest.approx([1 - u for u in up], rel=1e-12)
    assert first[:8].tolist() == [1.0] * 8


def test_patches_off_the_corner_give_the_psfs_of_their_own_pixels():
    """Three nodes an axis: a quadratic through them, of which patches lose nothing; 2
    by 2 patches.
    """
    random = np.random.default_rng(6)
    stack = torch.from_numpy(random.random((3, 3, 2, 5, 5)))
    stack /= stack.sum((-1, -2), keepdim=True)
    grid = Grid((9, 8), 2.0, (3e3, 9e3), margin=2, window=5)
    rows, columns = grid.frame
    y, x = (
        torch.tensor([-1.0, 0.2, 1.0], dtype=torch.float64) * (n - 1)
        for n in (rows, columns)
    )
    made = SimpleNamespace(
        y_um=y, x_um=x, depths_um=torch.tensor([3e3, 9e3], dtype=torch.float64)
    )
    between = forming.between_nodes(grid, made)
    energy = torch.ones(3, 3, 2, dtype=torch.float64)
    cut = patches.cut(stack, energy, between, patches=2, overlap=2, tolerance=1e-12)
    assert len(cut) == 4
    optics = SimpleNamespace(stack=stack.float(), plan=made, patches=cut)
    wanted = [
        (0, 0),
        (rows - 1, 3),
        (5, columns - 1),
        (rows - 2, columns - 3),
        (rows // 2, columns // 2),
    ]
    depth = 1 / (0.3 / 3e3 + 0.7 / 9e3)
    got = engine.psfs_used(
        optics, torch.tensor(wanted), torch.tensor([depth], dtype=torch.float64)
    )[:, 0]

    def through(nodes, n, at):
        place = np.linspace(-(n - 1), n - 1, n)[at]
        return [
            np.prod([(place - o) / (p - o) for o in nodes if o != p]) for p in nodes
        ]

    for (row, column), psf in zip(wanted, got, strict=True):
        wy, wx = through(y.tolist(), rows, row), through(x.tolist(), columns, column)
        want = np.einsum("a,b,c,abcyx->yx", wy, wx, [0.3, 0.7], stack.numpy())
        assert (
            np.abs(psf.numpy() - want).max() < 2e-5 * np.abs(want).max()
        )  # float32, and vectors cut at 1e-7


@pytest.mark.parametrize(
    ("middle", "folds"), [((0.0, 0.0), True), ((5.0, 0.0), False), ((0.0, -2.0), False)]
)
def test_a_lens_behind_a_hole_beside_the_axis_is_not_round(monkeypatch, middle, folds):
    seen = []

    def planned(*given, **about):
        seen.append(about["folds"])
        raise SceneError("asked")

    monkeypatch.setattr(engine, "planned", planned)
    layers = Layers(stop=Stop(30.0, 100.0, middle))
    wave = SmoothWave(Focus(0.85, 500.0, 6000.0, layers), 60.0)
    with pytest.raises(SceneError, match="asked"):
        engine.imager(
            wave, Grid((9, 9), 3.0, (3e3, 9e3), 0, 9), layers=layers, tolerance=0.1
        )
    assert seen == [folds]


def test_errors_within_their_shares_are_together_within_the_tolerance():
    """Of independent signs, so by squares; next to nothing of it is given away."""
    assert 0.995 < sum(share**2 for share in plan.SHARES.values()) <= 1


def test_folded_light_is_looked_for_all_over_a_field_and_near_its_rims():
    """Two of eight places in each quarter; along either axis no stretch of more than a
    fifth of it without one. None
    lies within 0.65 half fields of another, and no place of the field farther than that
    from the next; x to both sides
    alike."""
    x, y = np.array(plan.STREWN).T
    assert np.unique(2 * (x > 0) + (y > 0), return_counts=True)[1].tolist() == [
        2,
        2,
        2,
        2,
    ]
    for axis in (np.sort(x), np.sort(y)):
        assert np.diff(axis).max() <= 0.4 + 1e-12
        assert axis[0] == pytest.approx(-0.9, abs=0.051)
        assert axis[-1] == pytest.approx(0.95)
    assert np.sort(x) == pytest.approx(np.sort(-x))
    apart = np.hypot(x - x[:, None], y - y[:, None])[~np.eye(8, dtype=bool)]
    assert apart.min() > 0.65 - 1e-12
    across = np.linspace(-1, 1, 101)
    away = np.hypot(across - x[:, None, None], across[:, None] - y[:, None, None]).min(
        0
    )
    assert away.max() < 0.65


def test_each_question_about_a_field_is_asked_at_its_own_places(monkeypatch):
    """In half fields about the middle: a line at 0.6 of the height, depths in the
    middle and well off it, rays and
    fields at two places off it. Errors are those of their shares of the tolerance."""
    seen, judged = [], {}

    def spectral(optics, at, depths, waves, window):
        seen.append((at, depths))
        return BASE.expand(len(at), len(depths), 7, 7)

    def told(name, value):
        return lambda one, *given, **more: (
            judged.update({name: (one, given, more)}) or value or one.window
        )

    monkeypatch.setattr(plan, "spectral", spectral)
    monkeypatch.setattr(
        plan,
        "_unfolded",
        lambda o, w, window, at, most: judged.update(folded=(at, most)) or window,
    )
    monkeypatch.setattr(plan, "neglected", told("rays", 1e-9))
    monkeypatch.setattr(plan, "polarised", told("fields", None))
    grid, waves = (
        Grid((10, 32), 2.0, (3e3, 9e3), window=7),
        Nodes(np.array([0.85]), np.array([1.0]), 0.0),
    )
    plan.planned(
        None,
        grid,
        waves,
        (70.0, -40.0),
        tolerance=0.01,
        folds=False,
        polarisation="flux",
    )
    half = torch.tensor(grid.half_um[::-1])

    def units(at):
        return ((at - torch.tensor([70.0, -40.0])) / half).numpy()

    line = np.concatenate([units(at) for at, depths in seen if len(depths) == 3])
    assert line[:, 1] == pytest.approx(np.full(len(line), 0.6))
    deep = [(at, depths) for at, depths in seen if len(depths) != 3]
    assert all(
        units(at) == pytest.approx(np.array([[0.0, 0.0], [0.7, -0.4]]))
        for at, _ in deep
    )
    ends = 1 / torch.cat([depths for _, depths in deep])
    assert [float(ends.max()), float(ends.min())] == pytest.approx([1 / 3e3, 1 / 9e3])
    (places, depths), most = judged["folded"]
    assert units(places) == pytest.approx(np.array(plan.STREWN))
    assert depths.tolist() == pytest.approx([3e3, 4.5e3, 9e3])
    assert most == pytest.approx(0.01 * 0.24)
    assert units(judged["rays"][0].at[0]) == pytest.approx(
        np.array([[0.75, 0.45], [-0.3, 0.8]])
    )
    one, (kind,), more = judged["fields"]
    assert units(one.at[0]) == pytest.approx(
        np.array([[0.75, 0.45], [-0.3, 0.8], [0.0, 0.0]])
    )
    assert (kind, more["within"]) == ("flux", pytest.approx((0.01, 0.01 * 0.2)))


@pytest.mark.parametrize(
    ("first", "counts"),
    [
        (1.1, [5, 7]),  # 4.2 steps are asked for: two more at least
        (5.0, [5, 9]),  # 7.6 of them
        (
            40.0,
            [5, 9, 17, 19],
        ),  # 17.5, but no more than nine tenths of twice as many at once
        (300.0, [5, 9, 17, 31, 37, 39, 41]),  # 39.2, and nine tenths of it
    ],
)
def test_the_next_count_of_field_points_is_what_the_error_asks_for(
    monkeypatch, first, counts
):
    """An error that falls as the 2.5th power of the steps, ``first`` tolerances of
    four: odd counts until it is met.
    """
    tried = []

    class Known:
        def __init__(self, at):
            pass

        def error(self, nodes):
            tried.append(len(nodes))
            return 0.001 * first * (4 / (len(nodes) - 1)) ** 2.5

    monkeypatch.setattr(plan, "_Known", Known)
    assert plan._line(None, (0.0, 300.0), 0.001)[0] == counts[-1]
    assert tried[::2] == counts
    assert tried[1::2] == counts


def test_where_nothing_is_right_two_field_points_more_are_tried(monkeypatch):
    """An error above 0.3 tells no power; one below, as many as may be."""
    tried = []

    class Known:
        def __init__(self, at):
            pass

        def error(self, nodes):
            tried.append(len(nodes))
            return {5: 0.31, 7: 0.31, 9: 0.29, 17: 0.31}.get(len(nodes), 0.0)

    monkeypatch.setattr(plan, "_Known", Known)
    assert plan._line(None, (0.0, 300.0), 1e-3)[0] == 19
    assert tried[::2] == [5, 7, 9, 17, 19]
