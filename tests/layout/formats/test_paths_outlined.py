"""Outlines of paths: corners by hand, and every place by its distance from the line."""

import math

import numpy as np
import pytest

from layout.formats import paths

RNG = np.random.default_rng(17)


def wound(polygon, places):
    """How often a polygon goes around each place: crossings of the ray to +x, upwards
    less downwards.
    """
    a = polygon.astype(float)
    b = np.roll(polygon, -1, axis=0).astype(float)
    y = places[:, 1, None]
    up = (a[:, 1] <= y).astype(int) - (b[:, 1] <= y)
    rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
    right = a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0]) > places[:, 0, None]
    return (up * right).sum(1)


def away(line, places):
    """(arm, place) distance from each arm, and how far along it the foot lies, with the
    arms' lengths.
    """
    arm = np.diff(line, axis=0)
    long = np.hypot(*arm.T)
    u = arm / long[:, None]
    off = places[None] - line[:-1, None]
    along = (off * u[:, None]).sum(-1)
    near = off - np.clip(along, 0, long[:, None])[..., None] * u[:, None]
    return np.hypot(near[..., 0], near[..., 1]), along, long[:, None]


def test_a_right_angle_is_mitred_and_the_ends_go_on():
    """Right, then down; 140 wide; 30 before its first point and 11 beyond its last: the
    left edge, then the right.
    """
    made = paths.path_outline(
        np.array([[0, 0], [700, 0], [700, 0], [700, -500]]), 70.0, begin=30, end=11
    )
    assert made.tolist() == [
        [-30, 70],
        [770, 70],
        [770, -511],
        [630, -511],
        [630, -70],
        [-30, -70],
    ]


def test_beyond_a_right_angle_each_arm_goes_on_by_half_its_width():
    """From +x to (-0.6, 0.8): inside the edges meet 2 half widths before the corner;
    outside at (1050, -50) and
    (1000, 0) - 50 (-0.6, 0.8) + 50 (0.8, 0.6)."""
    made = paths.path_outline(np.array([[0, 0], [1000, 0], [400, 800]]), 50.0)
    left = [[0, 50], [900, 50], [360, 770]]
    right = [[440, 830], [1070, -10], [1050, -50], [0, -50]]
    assert made.tolist() == left + right
    mirrored = paths.path_outline(np.array([[0, 0], [1000, 0], [400, -800]]), 50.0)
    assert mirrored.tolist() == [[x, -y] for x, y in (left + right)[::-1]]


def test_a_path_is_what_lies_within_half_its_width_of_its_arms():
    """Turns of any size, a way back among them, arms three to eight times as long as
    the path is wide: all that lies
    beside an arm is in it, and nothing that is farther from the line than a square
    corner; a unit and a half of
    rounding."""
    half = 60.0
    for n in range(30):
        turn = RNG.uniform(0, 2 * math.pi, 3)
        turn[2] = turn[1] + math.pi if n % 5 == 0 else turn[2]
        steps = RNG.uniform(400, 950, (3, 1)) * np.column_stack(
            [np.cos(turn), np.sin(turn)]
        )
        line = np.rint(np.cumsum(np.vstack([[0, 0], steps]), axis=0))
        places = RNG.uniform(line.min(0) - 2 * half, line.max(0) + 2 * half, (900, 2))
        inside = wound(paths.path_outline(line, half), places) != 0
        distance, along, long = away(line, places)
        beside = ((distance < half - 1.5) & (along > 1.5) & (along < long - 1.5)).any(0)
        assert inside[beside].all()
        assert (distance.min(0)[inside] < math.sqrt(2) * half + 1.5).all()


def test_round_ends_are_half_of_a_polygon_around_their_circle():
    """32 tan(pi / 32) r² of both together; lengths at the ends are not added."""
    half, line = 4e5, np.array([[1e5, -3e5], [1.9e6, 2.1e6]])
    made = paths.path_outline(line, half, begin=77.0, end=99.0, rounded=True).astype(
        float
    )
    assert len(made) == 32
    x, y = made.T
    area = 0.5 * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    assert abs(area) == pytest.approx(
        2 * half * 3e6 + 32 * math.tan(math.pi / 32) * half**2, rel=1e-6
    )
    ahead = (line[1] - line[0]) / 3e6
    for end, way, corners in (
        (line[1], ahead, made[:16]),
        (line[0], -ahead, made[16:]),
    ):
        assert np.hypot(*(corners - end).T) == pytest.approx(
            half / math.cos(math.pi / 32), abs=1
        )
        assert ((corners - end) @ way > 0).all()
        first = np.array([-way[1], way[0]]) * math.cos(math.pi / 32) + way * math.sin(
            math.pi / 32
        )
        assert corners[0] - end == pytest.approx(
            first * half / math.cos(math.pi / 32), abs=1
        )  # from its left
