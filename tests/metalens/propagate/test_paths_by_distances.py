"""Paths, cosines and kernels of a case by distances of points and by Snell's law,
solved for each ray alone.
"""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from metalens import propagate
from metalens.cell import Film, Index
from metalens.lens import Layers
from metalens.propagate import nodes, paths

D, WAVELENGTH, PITCH = 47.0, 0.79, 0.36
GIVEN = dict(
    pitch_um=PITCH, wavelength_um=WAVELENGTH, sensor_distance_um=D, depths_um=[310.0, 900.0, 2500.0],
    angle_rad=(0.22, -0.13), window_um=(6.0, 4.0), samples=(12, 8), offset_um=(2.3, -1.1),
)  # fmt: skip
FILMS = Layers(
    behind=(Film(Index(1.52), 12.0), Film(Index(2.1), 3.0)), cover=Index(1.31)
)
STACKS = {"air": ((1.0, D),), "films": ((1.31, D - 15.0), (1.52, 12.0), (2.1, 3.0))}
PLACES = [
    (3.1, -2.2, 0.7, -1.4),
    (-5.3, 1.9, -2.6, 0.3),
    (0.4, 6.0, 1.1, 1.8),
]  # on the lens; off the window's middle


@pytest.fixture(scope="module")
def cases():
    return {
        "air": propagate.make_case((40, 34), **GIVEN),
        "films": propagate.make_case((40, 34), **GIVEN, layers=FILMS),
    }


def ray(stack, reach):
    """(n sin θ, optical path) of the ray that goes ``reach`` sideways: Σ t p / √(n² -
    p²), Σ t n² / √(n² - p²).
    """
    least = min(n for n, _ in stack)

    def away(p):
        return sum(t * p / math.sqrt(n * n - p * p) for n, t in stack) - reach

    p = (
        0.0
        if reach == 0
        else brentq(away, 0.0, least * (1 - 1e-12), xtol=1e-16, rtol=1e-15)
    )
    return p, sum(t * n * n / math.sqrt(n * n - p * p) for n, t in stack)


def source(case, z):
    return np.array([-z * case.tangents[0], -z * case.tangents[1], -z])


@pytest.mark.parametrize("kind", STACKS)
def test_paths_to_the_sensor_are_those_of_single_rays(cases, kind):
    """To 1e-9 um of 60: what subtracting two paths of the referee leaves."""
    case, stack = cases[kind], STACKS[kind]
    cx, cy = case.centre_um
    chief = ray(stack, math.hypot(cx, cy))[1]
    assert paths.chief_path(case) == pytest.approx(chief, abs=1e-9)
    for x, y, X, Y in PLACES:
        middle = ray(stack, math.hypot(x - cx, y - cy))[1]
        assert paths.to_sensor(case, x, y) == pytest.approx(middle - chief, abs=1e-9)
        other = (
            ray(stack, math.hypot(x - 1.7, y + 0.6))[1]
            - ray(stack, math.hypot(1.7, 0.6))[1]
        )
        assert paths.to_sensor(case, x, y, (1.7, -0.6)) == pytest.approx(
            other, abs=1e-9
        )
        there = ray(stack, math.hypot(x - cx - X, y - cy - Y))[1]
        assert paths.ray_to_offset(case, x, y, X, Y)[1] == pytest.approx(
            there - middle, abs=1e-9
        )


@pytest.mark.parametrize("kind", STACKS)
def test_cosines_of_a_ray_and_what_is_left_of_its_plane_wave(cases, kind):
    """p = n sin θ cos φ from the window's middle back to the lens; L - L_w + pX + qY."""
    case, stack = cases[kind], STACKS[kind]
    cx, cy = case.centre_um
    for x, y, X, Y in PLACES:
        reach = math.hypot(x - cx, y - cy)
        sine, middle = ray(stack, reach)
        p, q = sine * (x - cx) / reach, sine * (y - cy) / reach
        assert paths.ray_cosines(case, x - cx, y - cy) == pytest.approx(p, abs=1e-12)
        assert paths.cosine_y(case, p, y) == pytest.approx(q, abs=1e-12)
        there = ray(stack, math.hypot(x - cx - X, y - cy - Y))[1]
        level, left = paths.residual_path(case, p, y, X, Y)
        assert left == pytest.approx(there - middle + p * X + q * Y, abs=1e-9)
        assert level == pytest.approx(
            paths.ray_to_offset(case, x, y, X, Y)[0], rel=1e-9
        )
        wave = level * np.exp(1j * case.wavenumber * (there - middle + p * X + q * Y))
        assert abs(paths.plane_wave_residual(case, p, y, X, Y) - wave) < 1e-7 * abs(
            wave
        )  # 2 pi 1e-9 / 0.8


@pytest.mark.parametrize("kind", STACKS)
def test_directions_hold_all_rays_from_the_lens_to_the_middle_of_the_window(
    cases, kind
):
    """Looked at over the rows that are given and the middle one; by a millionth wider."""
    case, stack = cases[kind], STACKS[kind]
    cx, cy = case.centre_um
    high_x, rows = case.half_size_um[1], np.array([-6.7, -2.0, 5.9])
    every = []
    for x in np.linspace(-high_x, high_x, 31):
        for y in (*rows, 0.0):
            reach = math.hypot(x - cx, y - cy)
            every.append(ray(stack, reach)[0] * (x - cx) / reach)
    low, high = paths.direction_range(case, rows)
    spread = max(every) - min(every)
    assert min(every) - low == pytest.approx(1e-6 * spread, rel=1e-3)
    assert high - max(every) == pytest.approx(1e-6 * spread, rel=1e-3)


def field(case, x, y, at, z):
    """d / (2 pi r²) (1/r - ik) exp(ik (r + s)), s from a source at depth z; r and s
    from point to point.
    """
    k, d = case.wavenumber, at[2]
    r = np.linalg.norm(at - np.array([x, y, 0.0]))
    s = np.linalg.norm(source(case, z) - np.array([x, y, 0.0]))
    return d / (2 * np.pi * r**2) * (1 / r - 1j * k) * np.exp(1j * k * (r + s))


def test_the_kernel_is_the_field_of_a_pillar_its_carriers_taken_off(cases):
    """exp(-ik (r_w + s of the middle depth)), and the phase of the source at the lens
    centre: 1e-9 of paths of 1e3.
    """
    case, k = cases["air"], cases["air"].wavenumber
    cx, cy = case.centre_um
    inverse = (1 / 310 + 1 / 2500) / 2
    assert paths.reference_depth(case) == pytest.approx(inverse, rel=1e-12)
    for z in (310.0, 900.0):
        for x, y, X, Y in PLACES:
            pillar = np.array([x, y, 0.0])
            carrier = np.linalg.norm(np.array([cx, cy, D]) - pillar)
            carrier += np.linalg.norm(
                source(case, 1 / inverse) - pillar
            ) - np.linalg.norm(source(case, 1 / inverse))
            carrier += np.linalg.norm(source(case, z))
            want = field(case, x, y, np.array([cx + X, cy + Y, D]), z) * np.exp(
                -1j * k * carrier
            )
            got = paths.rayleigh_sommerfeld_kernel(case, x, y, X, Y, 1 / z)
            assert abs(got - want) < 1e-8 * abs(want)
    wy, wx = case.half_window_um
    some = paths.over_blocks(case)(
        np.array([PLACES[0][1]]), np.array([PLACES[0][0]])
    ).ravel()
    want = [
        paths.rayleigh_sommerfeld_kernel(case, *PLACES[0][:2], X, Y, v)
        for X in (-wx, 0, wx) for Y in (-wy, 0, wy) for v in (1 / 2500, 1 / 310)
    ]  # fmt: skip
    assert some == pytest.approx(np.array(want), rel=1e-9)


def test_slopes_are_those_of_the_logarithm_of_the_field(cases):
    """In sensor distance, x and y of the point, by differences over 1e-4 um: (k h)² / 6
    = 1e-7 of k.
    """
    case, h = cases["air"], 1e-4
    cx, cy = case.centre_um
    for x, y, X, Y in PLACES:
        r_w = math.sqrt((x - cx) ** 2 + (y - cy) ** 2 + D**2)
        found = paths.kernel_derivatives(case, (x - cx) / r_w, y, X, Y)
        at = np.array([cx + X, cy + Y, D])
        for slope, axis in zip(found, (2, 0, 1), strict=True):
            step = h * np.eye(3)[axis]
            ratio = field(case, x, y, at + step, 900.0) / field(
                case, x, y, at - step, 900.0
            )
            assert slope == pytest.approx(
                np.log(ratio) / (2 * h), abs=1e-5 * case.wavenumber
            )


def test_what_nodes_are_counted_by_is_the_kernel_along_a_line_at_the_ends_and_the_middle_of_all_else(
    cases,
):
    """Direct distances: d / (2π r²) (1/r - ik) exp(ik (r - r_w)) from (x, e) to a place
    of the window, where p is the
    cosine along x towards the window's middle; less plane waves exp(-ik (pX + qY)) of
    it where that is asked."""
    case, k = cases["air"], 2 * math.pi / WAVELENGTH
    (hy, hx), (wy, wx), (cx, cy) = (
        case.half_size_um,
        case.half_window_um,
        case.centre_um,
    )
    ends = np.array([-1.0, 0.0, 1.0])

    def field(x, y, X, Y):
        away, middle = (
            math.dist((x, y, 0.0), (cx + s * X, cy + s * Y, D)) for s in (1, 0)
        )
        return (
            D
            / (2 * math.pi * away**2)
            * (1 / away - 1j * k)
            * np.exp(1j * k * (away - middle))
        )

    p = np.array([[-0.08, 0.05, 0.11]])
    found = nodes._over_directions(case, p)
    places = [(e, X, Y) for e in 0.9 * ends * hy for X in ends * wx for Y in ends * wy]
    want = np.empty((27, 3), complex)
    for i, (e, X, Y) in enumerate(places):
        for j, sine in enumerate(p[0]):
            across = math.hypot(e - cy, D) * sine / math.sqrt(1 - sine**2)
            want[i, j] = field(cx + across, e, X, Y)
    assert np.abs(found - want).max() < 1e-7 * np.abs(want).max()  # 2 pi 1e-9 / 0.8
    low, high = -0.08, 0.14
    line = nodes._over_window(case, (low, high), Y=np.array([[-0.7, 1.3]]))
    rows = [
        (X, sine, e)
        for X in ends * wx
        for sine in 0.03 + 0.11 * ends
        for e in ends * hy
    ]
    for i, (X, sine, e) in enumerate(rows):
        for j, Y in enumerate((-0.7, 1.3)):
            across = math.hypot(e - cy, D) * sine / math.sqrt(1 - sine**2)
            q = (e - cy) / math.hypot(across, e - cy, D)
            wave = field(cx + across, e, X, Y) * np.exp(1j * k * (sine * X + q * Y))
            assert abs(line[i, j] - wave) < 1e-7 * abs(wave)
    columns = nodes._over_lens(case, np.array([[-3.1, 2.4]]), None)
    inverse = (min(case.inverse_depths_per_um), max(case.inverse_depths_per_um))
    at = [
        (o, X, Y, v)
        for o in 0.9 * ends * hy
        for X in ends * wx
        for Y in ends * wy
        for v in inverse
    ]
    for i, (o, X, Y, v) in enumerate(at):
        for j, x in enumerate((-3.1, 2.4)):
            assert columns[i, j] == pytest.approx(
                complex(paths.rayleigh_sommerfeld_kernel(case, x, o, X, Y, v)), rel=1e-9
            )
    assert hx > 3.1
