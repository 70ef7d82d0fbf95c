"""What stop and edge are made of: Fresnel's integrals of scipy, rays followed forwards,
similar triangles.
"""

import math

import numpy as np
import pytest
import torch
from scipy.special import fresnel

from metalens.lens import Stop, edge, stop
from metalens.lens.media import Media

WAVE = 0.79
BEFORE = Media(
    (1.0, 1.3, 1.7), (1830.0, 50.0, 120.0)
)  # 150 um before the pillars: 30 um of 1.3 and the glass
BETWEEN = Media((1.7, 1.3), (120.0, 30.0))


def bend(media, p):
    """Lateral way over p, by Snell."""
    return sum(
        t / np.sqrt(n * n - p * p)
        for n, t in zip(media.index, media.thickness_um, strict=True)
    )


def amplitude(x, y, *, ray, along, across, radius):
    """S by scipy: a straight edge across the line to (x, y), and how far a round one
    bends away along it.
    """
    far = np.hypot(x, y)
    cosine2 = ((x * ray[0] + y * ray[1]) / far) ** 2
    length = along * cosine2 + across * (1 - cosine2)
    slope = np.sqrt(2 / (WAVE * length))
    w = slope * (radius - far)
    sines, cosines = fresnel(w)
    straight = 0.5 + np.exp(-0.25j * np.pi) / math.sqrt(2) * (cosines + 1j * sines)
    rate = slope * np.exp(-0.25j * np.pi + 0.5j * np.pi * w * w) / math.sqrt(2)
    # L' along the edge, where phases are those of 1 / along and 1 / across turned:
    # along across / length
    return straight - 1j * WAVE * along * across / length / (4 * np.pi * radius) * rate


def test_places_behind_an_edge_have_the_mean_of_fresnels_integrals_over_their_width():
    """From 9 Fresnel lengths in the light to 9 in the dark, in, across and askew to the
    plane of the light.
    """
    ray, along, across, radius = (0.6, -0.8), 340.0, 210.0, 170.0
    s = np.linspace(9.0, -9.0, 181) * math.sqrt(WAVE * across / 2)
    turn = np.resize([0.0, 0.5 * np.pi, 0.7, 2.2, -2.5], 181)
    far = radius - s
    x, y = (
        far * np.cos(turn - math.atan2(0.8, 0.6)),
        far * np.sin(turn - math.atan2(0.8, 0.6)),
    )
    width = np.resize([0.4, 1.7, 3.1], 181)
    got = edge.behind((x, y), width, ray, (along, across), radius, WAVE)
    node, weight = np.polynomial.legendre.leggauss(24)
    out = (
        far + node[:, None] * width / 2
    )  # through the middle of a place, from the axis
    about = {"ray": ray, "along": along, "across": across, "radius": radius}
    want = weight @ amplitude(x / far * out, y / far * out, **about) / 2
    assert (
        np.abs(got - want).max() < 2e-5
    )  # table and series, 1e-7, times w of up to 9 over half widths of 0.02
    some = edge.behind(
        (x[6:8, None], y[6]), width[6], ray, (along, across), radius, WAVE
    )
    assert some.shape == (2, 1)
    assert abs(some[0, 0] - got[6]) < 1e-12  # rounding of phases of up to 130 rad


def test_the_wave_of_an_edge_and_its_integral():
    """E(w) by scipy on both sides of the table's end, and w E(w) less the integral of v
    E'(v).
    """
    w = np.array(
        [-7.3, -5.01, -4.99, -2.031, -0.4, 0.0, 0.013, 1.27, 4.999, 5.001, 11.0]
    )
    sines, cosines = fresnel(w)
    want = 0.5 + np.exp(-0.25j * np.pi) / math.sqrt(2) * (cosines + 1j * sines)
    wave = getattr(edge._wave, "py_func", edge._wave)  # as it is written
    got = np.array([wave(a, edge.TABLE) for a in w])
    assert np.abs(got[:, 0] - want).max() < 2e-7
    by_parts = w * want + 1j / np.pi * np.exp(
        -0.25j * np.pi + 0.5j * np.pi * w * w
    ) / math.sqrt(2)
    assert np.abs(got[:, 1] - by_parts).max() < 2e-6  # E times w up to 11


def test_rays_of_every_direction_cross_the_stop_where_they_are_followed():
    """Forwards: from the source to the stop and on to the pillars, up to 45 degrees off
    the axis.
    """
    tangents = (0.21, -0.13)
    slope = math.hypot(*tangents)
    p0 = slope / math.hypot(1, slope)
    source = [-p0 * bend(BEFORE, p0) * t / slope for t in tangents]
    p, turn = np.linspace(0.0, 0.707, 40), np.linspace(-2.0, 3.0, 40)
    ways = [(source[0] + p * b * np.cos(turn), source[1] + p * b * np.sin(turn)) for b in
            (bend(BEFORE, p), bend(BEFORE, p) - bend(BETWEEN, p))]  # fmt: skip
    got = stop.crossing(BEFORE, BETWEEN, tangents, *ways[0])
    assert np.abs(np.stack(got) - np.stack(ways[1])).max() < 1e-6
    there = torch.from_numpy(ways[0][0]), torch.from_numpy(ways[0][1])
    assert stop.crossing(BEFORE, BETWEEN, tangents, *there)[1].numpy() == pytest.approx(
        ways[1][1], abs=1e-6
    )
    x, y = np.array([3.0, -41.0]), np.array([17.0, 5.0])
    shift = p0 * bend(BETWEEN, p0) / slope
    even = stop.crossing(None, BETWEEN, tangents, x, y)
    assert np.stack(even) == pytest.approx(
        np.stack([x - shift * 0.21, y + shift * 0.13]), abs=1e-9
    )
    assert stop.crossing(BEFORE, None, tangents, x, y) == (x, y)


def test_fresnel_lengths_are_how_rays_from_a_place_of_the_stop_spread():
    """Rays from one place of the stop spread over the pillars by d reach / d p in the
    plane and reach / p across it;
    of a source at a finite distance an edge has 1/L = 1/a + 1/b of the ways from stop
    and to it."""
    tangents = (0.27, 0.36)
    p = 0.45 / math.hypot(1, 0.45)

    def lengths(media):
        step = 1e-5
        return (
            (p + step) * bend(media, p + step) - (p - step) * bend(media, p - step)
        ) / (2 * step), bend(media, p)

    after, whole = lengths(BETWEEN), lengths(BEFORE)
    assert stop.fresnel_um(None, BETWEEN, tangents) == pytest.approx(after, rel=1e-8)
    want = [1 / (1 / a + 1 / (b - a)) for a, b in zip(after, whole, strict=True)]
    assert stop.fresnel_um(BEFORE, BETWEEN, tangents) == pytest.approx(want, rel=1e-8)
    assert want[0] > 1.05 * want[1]


def test_a_shadow_lies_where_rays_cross_and_is_as_soft_as_light_spreads_from_the_stop():
    """Places are a row and a column, across which the plane of the light is askew."""
    tangents, hole, x, y = (
        (0.27, 0.36),
        Stop(300.0, 150.0),
        np.array([10.0, 301.0, -280.0]),
        np.array([[-95.0], [57.0]]),
    )
    got = stop.shadow(hole, (BEFORE, BETWEEN), tangents, WAVE, (x, y), 0.7)
    at = np.broadcast_arrays(*stop.crossing(BEFORE, BETWEEN, tangents, x, y))
    lengths = stop.fresnel_um(BEFORE, BETWEEN, tangents)
    assert got == pytest.approx(
        edge.behind((at[0], at[1]), 0.7, (0.6, 0.8), lengths, 300.0, WAVE), rel=1e-12
    )
    assert got.shape == (2, 3)
    on_axis = stop.shadow(hole, (None, BETWEEN), (0.0, 0.0), WAVE, (x, y), 0.7)
    length = BETWEEN.reduced_um
    assert on_axis == pytest.approx(
        edge.behind(
            np.broadcast_arrays(x, y), 0.7, (0.0, 1.0), (length, length), 300.0, WAVE
        )
    )


def test_what_a_shadow_leaves_out_goes_by_its_fresnel_number():
    """N = 90² / (0.79 · 250): half a per cent over N at the edge, 5.5 % for each zone
    of blur about the axis.
    """
    air = Media((1.0,), (250.0,))
    hole, number = Stop(90.0, 250.0), 90.0**2 / (WAVE * 250.0)
    assert stop.left_out(hole, (None, air), (0.0, 0.0), WAVE) == pytest.approx(
        0.005 / number
    )
    assert stop.left_out(hole, (None, air), (0.0, 0.0), WAVE, 3.2) == pytest.approx(
        (0.005 + 0.055 * 3.2) / number
    )
    slanted = 90.0**2 / (
        WAVE * 250.0 * math.hypot(1, 0.5) ** 3
    )  # 250 / cos³ in the plane: the longer one counts
    assert stop.left_out(hole, (None, air), (0.4, -0.3), WAVE) == pytest.approx(
        0.005 / slanted
    )
    assert stop.left_out(hole, (None, None), (0.4, -0.3), WAVE, 3.2) == 0.0


def test_light_of_a_hole_by_similar_triangles():
    hole = Stop(90.0, 250.0)
    air, way = Media((1.0,), (250.0,)), Media((1.0,), (1100.0,))
    assert stop.lit_um(hole, way, air) == pytest.approx(90 * 1100 / 850)
    assert stop.lit_um(hole, None, air) == stop.lit_um(hole, way, None) == 90.0
    glass = Media((1.0, 1.5), (850.0, 250.0))  # as 250 / 1.5 of air
    assert stop.lit_um(hole, glass, Media((1.5,), (250.0,))) == pytest.approx(
        90 * (850 + 250 / 1.5) / 850
    )


def test_a_place_on_the_edge_lets_pass_what_lies_inside():
    x, y = (
        np.array([3.0, 54.0, 53.7, 54.6]),
        np.array([4.0, 72.0, 71.6, 72.8]),
    )  # 5, 90, 89.5, 91 from the axis
    for got in (
        stop.passed(Stop(90.0), (x, y), 1.6),
        stop.passed(
            Stop(90.0), (torch.from_numpy(x), torch.from_numpy(y)), 1.6
        ).numpy(),
        stop.shadow(Stop(90.0), (None, None), (0.1, 0.2), WAVE, (x, y), 1.6),
    ):
        assert got == pytest.approx([1.0, 0.5, 0.5 + 0.5 / 1.6, 0.0])
