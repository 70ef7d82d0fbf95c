"""Compiled sums through films and in air: Snell and Fresnel written out for each ray,
plain loops over nodes.

A ray of p = n sin θ through films t of index n reaches Σ t tan θ sideways, its optical
path is Σ n t / cos θ.
"""

import cmath
import math

import numpy as np
import pytest

from metalens.lens import Media, saddle_correction
from metalens.propagate import layered

N, T = (1.31, 1.52, 2.1), (31.0, 12.0, 3.0)
SQUARED, THICK = np.array([n * n for n in N]), np.array(T)
ORDER = (1.31, 2.1, 1.52)  # of the faces that the light meets
P = np.array([0.0, 0.1, 0.55, 0.9, 1.2])
K = 2 * math.pi / 0.79


def angles(p):
    """θ in every medium."""
    return [math.asin(p / n) for n in N]


def reach(p):
    return sum(t * math.tan(a) for t, a in zip(T, angles(p), strict=True))


def length(p):
    return sum(n * t / math.cos(a) for n, t, a in zip(N, T, angles(p), strict=True))


def level(p):
    """√(passed / spread): half of s and half of p light that Fresnel's reflections
    leave, over the area on the sensor
    per area of p, (reach / p) d reach / dp with d tan θ / dp = 1 / (n cos³ θ)."""
    through = [1.0, 1.0]
    for a, b in ((1.31, 2.1), (2.1, 1.52)):
        ca, cb = math.cos(math.asin(p / a)), math.cos(math.asin(p / b))
        through[0] *= 1 - ((a * ca - b * cb) / (a * ca + b * cb)) ** 2
        through[1] *= 1 - ((b * ca - a * cb) / (b * ca + a * cb)) ** 2
    far = sum(t / (n * math.cos(a)) for n, t, a in zip(N, T, angles(p), strict=True))
    slope = sum(
        t / (n * math.cos(a) ** 3) for n, t, a in zip(N, T, angles(p), strict=True)
    )
    return math.sqrt(sum(through) / 2 / (far * slope))


def test_products_of_complex_rows_are_summed_without_a_conjugate():
    """(2 + 3i)(5 - 1i) = 13 + 13i, (-1 + 0.5i)(4 + 2i) = -5, together 8 + 13i."""
    got = layered.complex_product(
        np.array([2.0, -1.0]),
        np.array([3.0, 0.5]),
        np.array([5.0, 4.0]),
        np.array([-1.0, 2.0]),
    )
    assert got == pytest.approx(8 + 13j)
    assert (
        layered.complex_product(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0)) == 0
    )


def test_rays_are_those_of_snell_from_any_start():
    """From straight ahead and from tan² of other rays; tan² in the rarest medium is
    left for the next row.
    """
    reach2 = np.array([reach(p) ** 2 for p in P])
    tan2 = np.array([math.tan(angles(p)[0]) ** 2 for p in P])
    for start in (np.zeros(5), tan2[::-1].copy(), 30 * tan2 + 2):
        work, s = np.full((6, 5), np.nan), start.copy()
        layered.solve_rays(reach2, SQUARED, THICK, s, work)
        assert work[0] == pytest.approx(P**2, rel=1e-12, abs=1e-15)
        assert s == pytest.approx(tan2, rel=1e-12, abs=1e-15)


def test_rays_that_are_far_off_take_more_than_a_few_steps():
    """One of a thousand times the thickness, begun at none and at ten thousand times
    its tan².
    """
    want = 1.31 * math.sin(math.atan(1000.0))
    far = np.array([reach(want) ** 2])
    for start in (0.0, 1e10):
        work = np.empty((6, 1))
        layered.solve_rays(far, SQUARED, THICK, np.array([start]), work)
        assert 1.31**2 - work[0, 0] == pytest.approx(
            1.31**2 / (1 + 1e6), rel=1e-8
        )  # 1e6 ulp of rounding


def test_paths_and_levels_of_rays_are_those_of_their_angles():
    w, work, far, out = P**2, np.full((6, 5), np.nan), np.full(5, 7.0), np.full(5, 9.0)
    layered.ray_path_lengths(w, SQUARED, THICK, far)
    assert far == pytest.approx([length(p) for p in P], rel=1e-14)
    layered.ray_amplitudes(w, SQUARED, THICK, np.array(ORDER), out, work)
    assert out == pytest.approx([level(p) for p in P], rel=1e-13)


def test_light_straight_ahead_loses_what_two_faces_reflect():
    """R = (0.79 / 3.41)² and (0.58 / 3.62)²; the level is its root over Σ t / n."""
    out = np.empty(1)
    layered.ray_amplitudes(
        np.zeros(1), SQUARED, THICK, np.array(ORDER), out, np.empty((6, 1))
    )
    passed = (1 - (0.79 / 3.41) ** 2) * (1 - (0.58 / 3.62) ** 2)
    assert out[0] == pytest.approx(
        math.sqrt(passed) / (31 / 1.31 + 12 / 1.52 + 3 / 2.1), rel=1e-13
    )
    alone = np.empty(1)  # a single medium has no face
    layered.ray_amplitudes(
        np.zeros(1), SQUARED, THICK, np.array(ORDER[:1]), alone, np.empty((6, 1))
    )
    assert alone[0] == pytest.approx(1 / (31 / 1.31 + 12 / 1.52 + 3 / 2.1), rel=1e-13)


SERIES = np.array(
    [[1.1, 0.4], [0.7, -0.2], [0.3, 0.9], [-0.6, 0.05]]
)  # (middle, half), then real and imaginary


def beside(p):
    """C = real + i imaginary, cubes written out in u = (√(n² - p²) - 1.1) / 0.4."""
    u = (math.sqrt(1.31**2 - p * p) - 1.1) / 0.4
    return 0.7 + 0.3 * u - 0.6 * u * u, -0.2 + 0.9 * u + 0.05 * u * u


def test_what_is_beside_a_ray_is_a_power_series_in_the_cosine_of_the_rarest_medium():
    work = np.full((6, 5), np.nan)
    layered.ray_corrections(P**2, SQUARED, SERIES, work)
    want = np.array([beside(p) for p in P])
    assert work[1] == pytest.approx(want[:, 0], rel=1e-13)
    assert work[2] == pytest.approx(want[:, 1], rel=1e-13)


def test_arrays_of_media_are_squares_thicknesses_faces_and_the_series():
    media = Media((2.1, 1.0, 1.52, 1.0), (3.0, 20.0, 0.0, 5.0))
    squared, thick, order, series = layered.media_arrays(media, K, 40.0)
    assert squared == pytest.approx(
        [1.0, 2.1**2]
    )  # the rarest first, equal ones together
    assert thick.tolist() == [25.0, 3.0]
    assert thick.dtype == float
    assert order.tolist() == [2.1, 1.0, 1.0]
    made = saddle_correction(media, K, 40.0)
    assert series.shape == (1 + len(made.real), 2)
    assert series[0].tolist() == [made.middle, made.half]
    assert series[1:, 0].tolist() == list(made.real)
    assert series[1:, 1].tolist() == list(made.imaginary)
    assert made.half > 0


FILMS = (K, SQUARED, THICK, np.array(ORDER), SERIES)


def p_of(far):
    """By bisection of the reach."""
    low, high = 0.0, 1.31 * (1 - 1e-12)
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if reach(middle) < far else (low, middle)
    return (low + high) / 2


def wave(dx, dy):
    """(amplitude, path) -i k/2π level (1 + iC/(kL)) of the ray that goes (dx, dy)
    sideways.
    """
    p = p_of(math.hypot(dx, dy))
    real, imaginary = beside(p)
    c = complex(real, imaginary)
    return -1j * K / (2 * math.pi) * level(p) * (1 + 1j * c / (K * length(p))), length(
        p
    )


def test_light_of_pillars_through_films_is_the_sum_of_their_rays():
    """Two depths, two rows of three columns, three points; added to what is there, each
    pillar worth its area. Phases
    of 2π 60 um / 0.79 um, bisected to 1e-15 of them: 1e-11."""
    x, y, area = np.array([-2.2, 0.7, 3.1]), np.array([-1.4, 5.3]), 0.23
    points = np.array(
        [[4.0, -3.0], [-11.0, 0.5], [0.7, -1.4]]
    )  # the last straight above a pillar
    rng = np.random.default_rng(5)
    light = rng.normal(size=(2, 2, 3)) + 1j * rng.normal(size=(2, 2, 3))
    want = np.full((2, 3), 0.5 - 0.25j)
    for n, (px, py) in enumerate(points):
        for i, j in np.ndindex(2, 3):
            size, path = wave(px - x[j], py - y[i])
            want[:, n] += area * light[:, i, j] * size * cmath.exp(1j * K * path)
    out = np.full((2, 3), 0.5 - 0.25j)
    parts = np.ascontiguousarray(light.real), np.ascontiguousarray(light.imag)
    layered.add_rays(*parts, x, y, points, (area, FILMS), out)
    assert out == pytest.approx(want, rel=1e-10, abs=1e-12)


def test_light_on_nodes_through_films_holds_its_path_to_the_middle_of_the_window():
    """Rows lead here, then depths; offsets are from (6.0, -2.5)."""
    x, e = np.array([-2.2, 0.7, 3.1]), np.array([-1.4, 5.3])
    cx, cy = 6.0, -2.5
    points = np.array([[0.8, -0.3], [-1.9, 1.5]])
    rng = np.random.default_rng(6)
    light = rng.normal(size=(2, 4, 3)) + 1j * rng.normal(size=(2, 4, 3))
    want = np.full((4, 2), 0.125j)
    for n, (px, py) in enumerate(points):
        for i, j in np.ndindex(2, 3):
            size, path = wave(cx + px - x[j], cy + py - e[i])
            less = wave(cx - x[j], cy - e[i])[1]
            want[:, n] += light[i, :, j] * size * cmath.exp(1j * K * (path - less))
    out = np.full((4, 2), 0.125j)
    parts = np.ascontiguousarray(light.real), np.ascontiguousarray(light.imag)
    layered.sum_rays(*parts, e, x, points, (cx, cy, FILMS), out)
    assert out == pytest.approx(want, rel=1e-10, abs=1e-12)


# tangents, reference of the depths, middle of the window, distance, wavelength
NUMBERS = np.array([0.21, -0.13, 1 / 700, 6.0, -2.5, 47.0, 0.79])


def from_source(x, y, inverse):
    """Path from (-z tx, -z ty, -z) less that to the lens centre; at infinity a plane
    wave.
    """
    tx, ty = 0.21, -0.13
    if inverse == 0:
        return (x * tx + y * ty) / math.sqrt(1 + tx * tx + ty * ty)
    z = 1 / inverse
    return math.dist((x, y, 0.0), (-z * tx, -z * ty, -z)) - z * math.sqrt(
        1 + tx * tx + ty * ty
    )


def test_light_takes_the_phase_of_every_depth_less_that_of_the_reference():
    """2π (s_z - s_700) / 0.79 at depths of 300 um, 700 um and infinity; nothing is
    written where it is dark.
    """
    e, x = np.array([-3.5, 0.4, 7.0, 8.0]), np.array([-6.0, -1.0, 2.5, 4.4, 9.0])
    spans = np.array([[0, 5], [2, 4], [1, 5], [0, 0]])
    inverse = np.array([1 / 300, 1 / 700, 0.0])
    rng = np.random.default_rng(7)
    light = rng.normal(size=(4, 5)) + 1j * rng.normal(size=(4, 5))
    re, im = np.full((4, 3, 5), 7.5), np.full((4, 3, 5), -7.5)
    layered.node_phases(light, e, x, NUMBERS, inverse, spans, re, im)
    for i, z, j in np.ndindex(4, 3, 5):
        if spans[i, 0] <= j < spans[i, 1]:
            path = from_source(x[j], e[i], inverse[z]) - from_source(
                x[j], e[i], 1 / 700
            )
            want = light[i, j] * cmath.exp(2j * math.pi * path / 0.79)
            assert complex(re[i, z, j], im[i, z, j]) == pytest.approx(want, rel=1e-11)
        else:
            assert (re[i, z, j], im[i, z, j]) == (7.5, -7.5)
    assert np.abs(im[0, 0] - light[0].imag).max() > 0.1  # the phase is no small one


def test_light_on_nodes_is_summed_with_the_kernel_of_one_medium_over_the_lit_columns():
    """d / (2π r²) (1/r - ik) exp(ik (r - r_w)), r and r_w from point to point; columns
    beyond the spans hold NaN.
    """
    e, x = np.array([-3.5, 0.4, 7.0]), np.array([-6.0, -1.0, 2.5, 4.4])
    spans = np.array([[0, 4], [0, 0], [1, 3]])
    points = np.array([[0.8, -0.3], [-1.9, 1.5], [14.0, -9.0]])
    rng = np.random.default_rng(8)
    light = rng.normal(size=(3, 2, 4)) + 1j * rng.normal(size=(3, 2, 4))
    for i in range(3):
        light[i, :, : spans[i, 0]] = np.nan
        light[i, :, spans[i, 1] :] = np.nan
    want, size = np.full((2, 3), -0.5 + 0.0j), 0.0
    for n, (px, py) in enumerate(points):
        for i in range(3):
            for j in range(*spans[i]):
                r = math.dist((x[j], e[i], 0.0), (6.0 + px, -2.5 + py, 47.0))
                middle = math.dist((x[j], e[i], 0.0), (6.0, -2.5, 47.0))
                kernel = (
                    47.0
                    / (2 * math.pi * r * r)
                    * (1 / r - 1j * K)
                    * cmath.exp(1j * K * (r - middle))
                )
                want[:, n] += light[i, :, j] * kernel
                size = max(size, abs(kernel))
    assert size > 0.02
    out = np.full((2, 3), -0.5 + 0.0j)
    parts = np.ascontiguousarray(light.real), np.ascontiguousarray(light.imag)
    layered.sum_nodes(*parts, e, x, points, NUMBERS, spans, out)
    assert out == pytest.approx(want, rel=1e-11, abs=1e-13)
