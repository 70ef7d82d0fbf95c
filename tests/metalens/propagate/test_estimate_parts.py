"""The parts of an error estimate and of a choice of method, each against its formula;
direct sums in plain loops.
"""

import functools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.core import legendre
from metalens.lens import Media
from metalens.propagate import PropagationCase, choice, estimate
from metalens.propagate.estimate import ErrorSample
from tests.referees import films

CASE = PropagationCase(
    (30, 41),
    0.37,
    0.85,
    62.0,
    (0.21, -0.13),
    (1 / 400, 1 / 900, 1 / 2500),
    (14.0, -8.5),
    0.6,
    (3, 4),
)
RNG = np.random.default_rng(17)


def sample(case=CASE, *, weight=1.0, noise=0.0, parts=1, orders=(5, 6)):
    moments = RNG.normal(size=orders) + 1j * RNG.normal(size=orders)
    return ErrorSample(case, weight, moments, noise, parts)


def light_on_nodes(moments):
    """Σ_m P̂_m(t_a) w_a times the moments, along both axes."""
    (ty, wy), (tx, wx) = (legendre.gauss_legendre_nodes(n) for n in moments.shape)
    left, right = (
        legendre.legendre_values(len(ty), ty),
        legendre.legendre_values(len(tx), tx),
    )
    return (left * wy[:, None]) @ moments @ (right * wx[:, None]).T


@pytest.mark.parametrize("plated", [False, True])
def test_the_direct_field_is_a_sum_of_wavelets_over_the_nodes(plated):
    """Every node a source whose light has the phase of its depth less the middle
    depth's; in air and under a plate.
    """
    case = CASE
    if plated:
        case = replace(CASE, behind=Media((1.5, 1.0), (20.0, 42.0)))
    one = sample(case)
    depths, at = np.array([0, 2]), (np.array([0, 2, 1]), np.array([3, 1, 0]))
    got = estimate._direct(one, depths, at)[0]
    light, k = light_on_nodes(one.moments), 2 * np.pi / 0.85
    (ty, _), (tx, _) = (
        legendre.gauss_legendre_nodes(5),
        legendre.gauss_legendre_nodes(6),
    )
    ey, ex = ty * 14.5 * 0.37, tx * 20 * 0.37
    middle = (1 / 400 + 1 / 2500) / 2

    def from_source(x, y, inverse):
        z = 1 / inverse
        source = -z * 0.21, z * 0.13, -z
        there = math.sqrt((x - source[0]) ** 2 + (y - source[1]) ** 2 + z**2)
        return there - math.sqrt(source[0] ** 2 + source[1] ** 2 + z**2)

    def kernel(dx, dy):
        if not plated:
            r = math.sqrt(dx**2 + dy**2 + 62.0**2)
            return 62.0 / (2 * np.pi * r**2) * (1 / r - 1j * k), r
        return plate(math.hypot(dx, dy), k)

    for n, depth in enumerate(depths):
        inverse = case.inverse_depths_per_um[depth]
        for p, (row, column) in enumerate(zip(*at, strict=True)):
            X, Y = 14.0 + (column - 1.5) * 0.6, -8.5 + (row - 1) * 0.6
            total = 0
            for i, y in enumerate(ey):
                for j, x in enumerate(ex):
                    turn = k * (from_source(x, y, inverse) - from_source(x, y, middle))
                    size, path = kernel(X - x, Y - y)
                    middle_path = kernel(14.0 - x, -8.5 - y)[
                        1
                    ]  # to the window's centre: the moments hold it
                    total += (
                        light[i, j]
                        * np.exp(1j * (turn + k * (path - middle_path)))
                        * size
                    )
            assert got[n, p] == pytest.approx(
                total * 0.37**2, rel=1e-9
            )  # paths of 1e5 rad in float64


@functools.lru_cache
def plate(reach, k):
    """(field / exp(ikL), L) of a point under a plate: all its plane waves, and the
    ray's path by bisection.
    """
    layers = ((1.5, 20.0), (1.0, 42.0))

    def lands(p):
        return sum(t * p / math.sqrt(n * n - p * p) for n, t in layers)

    low, high = 0.0, 1.0 - 1e-15
    for _ in range(200):
        p = (low + high) / 2
        low, high = (p, high) if lands(p) < reach else (low, p)
    length = sum(n * n * t / math.sqrt(n * n - p * p) for n, t in layers)
    (wave,) = films.point_wave(
        layers, (1.5, 1.0), wavelength=2 * math.pi / k, reach=[reach], panels=300
    )
    return wave * np.exp(-1j * k * length), length


def test_a_film_in_front_changes_the_phase_of_the_depths():
    """By its own rays: what the operators take off too. A plate in front is as thin air
    to first order.
    """
    case = replace(
        CASE, tangents=(0.0, 0.0), centre_um=(0.0, 0.0), front=((1.5, 90.0),)
    )
    air = replace(
        case,
        front=(),
        inverse_depths_per_um=tuple(1 / (z - 30.0) for z in (400, 900, 2500)),
    )
    one = sample(case)
    got = estimate._direct(one, np.arange(3), (np.array([0, 2]), np.array([1, 3])))[0]
    near = estimate._direct(
        replace(one, case=air), np.arange(3), (np.array([0, 2]), np.array([1, 3]))
    )[0]
    plain = estimate._direct(
        replace(one, case=replace(case, front=())),
        np.arange(3),
        (np.array([0, 2]), np.array([1, 3])),
    )[0]

    def apart(
        a, b
    ):  # the middle depths differ, a common factor of the node: compared are ratios of depths
        return np.abs(a[0] / a[2] - b[0] / b[2]).max()

    assert apart(got, near) < 0.2 * apart(got, plain)


def test_weights_of_places_rise_to_ten_at_the_edges_of_a_tile():
    assert estimate._within(6, 2) == pytest.approx([-2 / 3, 0, 2 / 3, -2 / 3, 0, 2 / 3])
    assert estimate._within(2, 5) == pytest.approx([0, 0])  # no more tiles than samples
    got = estimate._edges((3, 4, 6), 2).reshape(4, 6)
    y, x = [-0.5, 0.5, -0.5, 0.5], [-2 / 3, 0, 2 / 3, -2 / 3, 0, 2 / 3]
    want = [[1 + 9 * max(abs(a), abs(b)) ** 8 for b in x] for a in y]
    assert got == pytest.approx(np.array(want))
    assert estimate._edges((3, 1, 4), 1) == pytest.approx(
        [1 + 9 * v**8 for v in (0.75, 0.25, 0.25, 0.75)]
    )


def test_components_are_sums_of_maps_with_their_factors_on_the_nodes():
    """Two maps, three components of signs of their own: each alone is a map whose light
    is the sum.
    """
    one = sample()
    maps = np.stack([one.moments, 0.3j * one.moments[::-1]])
    rng = np.random.default_rng(6)
    signs, factors = np.array([1.0, -1.0, 1.0]), rng.normal(size=(3, 2, 5, 6))
    (ty, _), (tx, _) = (
        legendre.gauss_legendre_nodes(5),
        legendre.gauss_legendre_nodes(6),
    )
    nodes = ty * 14.5 * 0.37, tx * 20 * 0.37
    at = (np.array([0, 2]), np.array([1, 3]))
    both = replace(one, moments=maps, pupils=(signs, factors))
    got = estimate._direct(both, np.arange(3), at)
    light = np.stack([light_on_nodes(m) for m in maps])
    alone = [
        estimate._direct(
            replace(one, moments=(f * light).sum(0), nodes_um=nodes), np.arange(3), at
        )[0]
        for f in factors
    ]
    assert got == pytest.approx(np.stack(alone), rel=1e-9)
    flat = at[0] * 4 + at[1]
    want = one.weight * sum(
        sign * np.abs(field) ** 2 for sign, field in zip(signs, alone, strict=True)
    )
    assert estimate._direct_light([[both]], np.arange(3), flat) == pytest.approx(
        want, rel=1e-9
    )


def test_light_on_nodes_of_the_lens_needs_no_polynomials():
    """The same field whether the light is given by its moments or on nodes of its own."""
    one = sample()
    (ty, _), (tx, _) = (
        legendre.gauss_legendre_nodes(5),
        legendre.gauss_legendre_nodes(6),
    )
    nodes = ty * 14.5 * 0.37, tx * 20 * 0.37
    other = replace(one, moments=light_on_nodes(one.moments), nodes_um=nodes)
    at = (np.array([0, 2]), np.array([1, 3]))
    want = estimate._direct(one, np.arange(3), at)
    assert estimate._direct(other, np.arange(3), at) == pytest.approx(want, rel=1e-9)
    assert one.shape == (3, 3, 4)


def test_fewer_points_are_looked_at_where_each_takes_a_sum_over_many_nodes():
    """128 for each of up to four parts at 8 depths; 1e7 nodes times points, 32 points
    at least, at 4 depths.
    """
    few = [[sample()]]
    assert estimate._effort(few) == (128, 8)
    assert estimate._effort(3 * few) == (384, 8)
    assert estimate._effort(6 * few) == (512, 8)
    for size, points in ((78_000, 128), (80_000, 125), (200_000, 50), (900_000, 32)):
        many = replace(
            sample(),
            moments=np.zeros((size // 100, 100)),
            nodes_um=(np.zeros(1), np.zeros(1)),
        )
        want = (points, 8 if size == 78_000 else 4)
        assert estimate._effort([[many]]) == want
        assert estimate._effort([[replace(many, nodes_um=None)]]) == (128, 8)


def test_differences_are_of_the_drawn_pixels_of_every_part(monkeypatch):
    """Two parts of 3 x 4 and 2 x 5 pixels; the second part's pixels begin at 12."""
    second = replace(CASE, samples=(2, 5))
    parts = [[sample(weight=0.7), sample(weight=0.4)], [sample(second, weight=0.9)]]
    asked = []

    def direct(one, depths, at):
        asked.append((one, at))
        return np.full((1, len(depths), len(at[0])), 1 + 2j) * (1 + one.weight)

    monkeypatch.setattr(estimate, "_direct", direct)
    points = np.array([5, 11, 12, 18, 21])
    got = estimate._direct_light(parts, np.array([0, 2]), points)
    first = 5 * (0.7 * 1.7**2 + 0.4 * 1.4**2)
    last = 5 * 0.9 * 1.9**2
    assert got == pytest.approx(np.tile([first, first, last, last, last], (2, 1)))
    assert [v.tolist() for v in asked[0][1]] == [[1, 2], [1, 3]]
    assert [v.tolist() for v in asked[2][1]] == [[0, 1, 1], [0, 1, 4]]


def test_the_error_of_few_pixels_is_the_sum_itself_with_the_noise_of_the_pillars(
    monkeypatch,
):
    """All pixels are looked at: Σ (δ/S - (I/S) Σδ/S)² and 2 w σ² / S of each
    wavelength, over Σ (I/S)²; 1.7 for all.
    """
    parts = [[sample(weight=0.7, noise=0.03), sample(weight=0.4, noise=0.05)]]
    off = RNG.normal(size=(3, 12)) * 0.02
    light = RNG.uniform(0.5, 2.0, (3, 12))
    monkeypatch.setattr(
        estimate,
        "_direct_light",
        lambda windows, depths, points: (light + off)[np.ix_(depths, points)],
    )
    energy = light.sum(1, keepdims=True)
    share, delta = light / energy, off / energy
    square = ((delta - share * delta.sum(1, keepdims=True)) ** 2).sum()
    noise = 2 * (0.7 * 0.03**2 + 0.4 * 0.05**2) * (1 / energy).sum()
    want = 1.7 * math.sqrt((square + noise) / (share**2).sum())
    assert estimate.relative_error(parts, [light.reshape(3, 3, 4)]) == pytest.approx(
        want, rel=1e-9
    )


def test_depths_that_are_judged_spread_over_all(monkeypatch):
    """Eight of twelve, ends included."""
    many = replace(CASE, inverse_depths_per_um=tuple(1 / np.linspace(400, 900, 12)))
    seen = []

    light = RNG.uniform(0.5, 2.0, (12, 12))

    def direct(windows, depths, points):
        seen.append(depths.tolist())
        return light[np.ix_(depths, points)]

    monkeypatch.setattr(estimate, "_direct_light", direct)
    assert estimate.relative_error([[sample(many)]], [light.reshape(12, 3, 4)]) == 0
    assert seen == [[0, 2, 3, 5, 6, 8, 9, 11]]


@pytest.fixture
def plans(monkeypatch):
    """Windows planned as typed in: seconds and tiles by their samples; None where none
    is.
    """
    known = {}
    monkeypatch.setattr(
        choice, "_layout", lambda case, tolerance: known.get(case.samples)
    )
    choice.choose_method.cache_clear()
    yield known
    choice.choose_method.cache_clear()


def test_the_exact_sum_takes_its_time_by_pillars_points_and_depths():
    """4 ns a pillar and point, 1.5 ns more for each depth; 500 ns through films; a
    tenth of a millisecond to begin.
    """
    assert choice.exact_seconds(CASE) == pytest.approx(
        30 * 41 * 12 * (4e-9 + 3 * 1.5e-9) + 1e-4
    )
    films = replace(CASE, behind=Media((1.5, 1.0), (20.0, 42.0)))
    assert choice.exact_seconds(films) == pytest.approx(
        30 * 41 * 12 * (504e-9 + 3 * 1.5e-9) + 1e-4
    )


def test_the_cheaper_method_is_taken(plans):
    """A plan costs 20 ms a tile, and 3 ns a pillar in every window."""
    wide = replace(CASE, shape=(700, 900), samples=(30, 40))
    exact = choice.exact_seconds(wide)
    for seconds, method in (
        (exact - 4 * 0.02 - 630_000 * 3e-9 - 1e-3, "windowed"),
        (exact - 4 * 0.02, "exact"),
    ):
        plans[(30, 40)] = SimpleNamespace(seconds=seconds, parts=2, nodes=(11, 12))
        made = choice.choose_method(wide, 1e-4)
        assert made.method == method
        assert made.seconds == pytest.approx(
            seconds + 0.08 + 630_000 * 3e-9 if method == "windowed" else exact
        )
        choice.choose_method.cache_clear()
    forced = choice.choose_method(wide, 1e-4, differentiable=True)
    assert (forced.method, forced.tiles) == ("windowed", ((wide,),))


def test_a_window_that_has_no_plan_is_cut_until_its_corners_have_one(plans):
    """Quarters have none, sixteenths do: 16 tiles of 0.05 s, a plan each."""
    wide = replace(CASE, shape=(9000, 9000), samples=(40, 48))
    plans[(10, 12)] = SimpleNamespace(seconds=0.05, parts=1, nodes=(5, 6))
    made = choice.choose_method(wide, 1e-4)
    assert made.method == "tiled"
    assert [len(row) for row in made.tiles] == [4, 4, 4, 4]
    assert made.seconds == pytest.approx(16 * (0.05 + 0.02 + 81e6 * 3e-9))


def test_dark_ends_of_rows_are_passed_over_and_change_no_sum():
    """Light of two components from the first column of either to the last of either;
    the direct sum of a lens whose
    corners are dark is that over its whole square."""
    light = np.zeros((2, 4, 7), complex)
    light[0, 0, 3], light[1, 0, 5], light[0, 1], light[1, 3, 6] = 1j, -2.0, 0.5, 1e-30
    np.testing.assert_array_equal(
        estimate._lit(light), [[3, 6], [0, 7], [0, 0], [6, 7]]
    )
    e, x = np.linspace(-5, 5, 9), np.linspace(-7, 7, 12)
    round_ = np.where(
        e[:, None] ** 2 / 25 + x**2 / 49 < 0.8, RNG.normal(size=(9, 12)) + 0.3j, 0
    )
    at = np.array([0, 2]), np.array([3, 1])
    some = ErrorSample(CASE, 1.0, round_, 0.0, 1, (e, x))
    faint = replace(
        some, moments=np.where(round_ == 0, 1e-40, round_)
    )  # no end is dark
    got, want = (estimate._direct(one, np.array([0, 2]), at) for one in (some, faint))
    np.testing.assert_allclose(got, want, rtol=1e-13)
