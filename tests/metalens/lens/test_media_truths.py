"""Rays through plates by Snell's law with angles, plate by plate, and what bundles of
them spread and pass.
"""

import itertools
import math

import numpy as np
import pytest

from metalens.lens import Media, media

INDEX, THICK = (1.46, 1.0, 1.72, 1.0), (130.0, 410.0, 55.0, 90.0)
STACK = Media(INDEX, THICK)


def by_angles(p):
    """(reach, optical path) of a ray with n sin θ = p."""
    angles = [math.asin(p / n) for n in INDEX]
    reach = sum(t * math.tan(a) for t, a in zip(THICK, angles, strict=True))
    return reach, sum(
        n * t / math.cos(a) for n, t, a in zip(INDEX, THICK, angles, strict=True)
    )


def test_equal_media_count_together_and_the_order_of_the_faces_is_kept():
    assert STACK.layers == [(1.0, 500.0), (1.46, 130.0), (1.72, 55.0)]
    assert Media((1.5, 1.3, 1.0), (0.0, 0.0, 7.0)).order == (1.5, 1.0)
    assert STACK.reduced_um == pytest.approx(130 / 1.46 + 500 + 55 / 1.72)


@pytest.mark.parametrize("p", [0.03, 0.41, 0.93])
def test_reach_and_path_are_those_of_snells_angles(p):
    reach, path = by_angles(p)
    along = sum(n * t for n, t in zip(INDEX, THICK, strict=True))
    assert media.reach(STACK, p) == pytest.approx(reach, rel=1e-12)
    assert media.path(STACK, p) == pytest.approx(path - along, rel=1e-9)
    assert media.direction(STACK, reach) == pytest.approx(p, rel=1e-12)
    assert media.chord(STACK, reach) == pytest.approx(path - along, rel=1e-9)
    assert media.whole_path(STACK.layers, p * p) == pytest.approx(path, rel=1e-12)
    h = 1e-5
    near = [by_angles(p + s * h) for s in (1, -1)]
    assert (near[0][1] - near[1][1]) / (near[0][0] - near[1][0]) == pytest.approx(
        p, rel=1e-6
    )  # Fermat
    want = reach / p * (near[0][0] - near[1][0]) / (2 * h)
    assert media.spread(STACK, p) == pytest.approx(want, rel=1e-6)


def test_faces_pass_the_mean_of_both_polarisations_by_fresnel():
    p = 0.62
    s_power = p_power = 1.0
    for a, b in itertools.pairwise(INDEX):
        ca, cb = math.cos(math.asin(p / a)), math.cos(math.asin(p / b))
        s_power *= 4 * a * ca * b * cb / (a * ca + b * cb) ** 2
        p_power *= 4 * a * ca * b * cb / (b * ca + a * cb) ** 2
    assert media.passed(STACK.order, p) == pytest.approx(
        (s_power + p_power) / 2, rel=1e-12
    )


def test_a_ray_whose_other_direction_is_known():
    """p² = along² + q², reach along q alone: q and its reach as of one ray in space."""
    q, along = 0.37, 0.52
    w = q * q + along * along
    bend = sum(t / math.sqrt(n * n - w) for n, t in zip(INDEX, THICK, strict=True))
    assert media.square(STACK.layers, (q * bend) ** 2, along**2) == pytest.approx(
        w, rel=1e-12
    )


def test_a_little_longer_reach_is_a_little_longer_path_without_loss_of_digits():
    p0 = 0.44
    reach0, path0 = by_angles(p0)
    w, more = media.longer(STACK.layers, p0 * p0, reach0**2, 2500.0)
    reach = math.sqrt(reach0**2 + 2500.0)
    p = media.direction(STACK, reach)
    assert w == pytest.approx(p * p, rel=1e-12)
    assert more == pytest.approx(by_angles(p)[1] - path0, rel=1e-9)
    tiny = media.longer(STACK.layers, p0 * p0, reach0**2, 2 * reach0 * 1e-9)[1]
    assert tiny == pytest.approx(p0 * 1e-9, rel=1e-6)  # d path = p d reach
    assert np.isfinite(tiny)
