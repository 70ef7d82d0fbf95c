"""Outlines by hand: distances to the circle, the cost that vertices are moved by, the
octagon that is nearest.
"""

import itertools
import math

import numpy as np
import pytest

from layout.shapes import polygon, rectilinear


def dense_error(points, radius):
    """Distance of 4001 points of every edge from the circle."""
    share = np.linspace(0, 1, 4001)[:, None, None]
    along = points + share * (np.roll(points, -1, axis=0) - points)
    return float(np.abs(np.hypot(along[..., 0], along[..., 1]) - radius).max())


LOPSIDED = np.array(
    [[-3, -2], [41, -5], [37, 8], [12, 31], [-4, 9]]
)  # feet of three edges lie beyond their ends


@pytest.mark.parametrize(
    "points",
    [LOPSIDED, LOPSIDED[::-1], np.array([[30, 20], [-30, 20], [-30, -20], [30, -20]])],
)
@pytest.mark.parametrize("radius", [4.0, 21.0, 25.5, 33.0])
def test_distance_of_an_outline_from_the_circle_is_that_of_its_farthest_point(
    points, radius
):
    found = polygon.edge_error(points, radius)
    assert found == pytest.approx(
        dense_error(points, radius), abs=2e-5
    )  # feet missed by 1/8000 of an edge: squared
    assert polygon.PillarShape(points, 2 * radius).edge_error == found


def test_rectangle_in_closed_form():
    box = np.array([[30, 20], [-30, 20], [-30, -20], [30, -20]])
    made = polygon.PillarShape(box, 50.0)
    assert made.area == 2400
    assert made.area_error == pytest.approx(2400 / (math.pi * 625) - 1, rel=1e-12)
    assert made.edge_error == pytest.approx(
        math.hypot(30, 20) - 25, rel=1e-12
    )  # the corners; the feet miss by 5
    assert made.shots == 1
    assert polygon.edge_error(box, 33.0) == pytest.approx(
        13.0, rel=1e-12
    )  # now the middle of the long sides


def area(eighth):
    return polygon.twice_area(polygon.mirrored(np.array(eighth))) / 2


@pytest.mark.parametrize(
    "eighth",
    [
        [(40, 5), (36, 19)],
        [(40, 9), (31, 31)],
        [(52, 6), (47, 20), (36, 35)],
        [(19, 8)],
    ],
)
@pytest.mark.parametrize("share", [0.97, 1.0004, 1.02])
def test_cost_is_area_beyond_the_free_share_and_scatter_of_the_vertices(eighth, share):
    """Area from the whole outline; vertices of an equal-area n-gon stand outside by (2π
    / n)² / 12 = 3.29 / n².
    """
    diameter = 2 * math.sqrt(area(eighth) / share / math.pi)
    error, lean = abs(share - 1), 1 + 3.3 / (8 * len(eighth)) ** 2
    out = [math.hypot(x, y) - diameter / 2 * lean for x, y in eighth]
    want = 4 * max(error / 5e-4 - 1, 0) ** 2 + 100 * error + np.mean(np.square(out))
    found = polygon._cost(np.stack([eighth, eighth], -1), diameter)
    assert found == pytest.approx([want, want], rel=1e-9)


@pytest.mark.parametrize(
    "wrong",
    [
        [(40, 0), (36, 19)],  # on the axis: its mirror image is itself
        [(40, 5), (41, 19)],  # x grows
        [(40, 9), (36, 8)],  # y falls
        [(40, 5), (40, 5)],  # twice the same
        [
            (30, 5),
            (29, 25),
        ],  # a dent at the first vertex's image would be none; this one crosses nothing
        [(40, 5), (26, 29)],  # beyond the diagonal
        [(40, 5), (28, 28), (27, 27)],  # off the hull
        [(40, 5), (30, 10), (28, 26)],  # a dent
    ],
)
def test_outlines_with_dents_doubles_or_crossings_are_not_sound(wrong):
    points = polygon.mirrored(np.array(wrong))
    before, after = (
        points - np.roll(points, 1, axis=0),
        np.roll(points, -1, axis=0) - points,
    )
    turn = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    fair = (turn > 0).all() and len(points) == 8 * len(wrong)
    last = wrong[-1]
    assert polygon._sound(np.array(wrong)[..., None], last[0] == last[1])[0] == fair
    assert fair == (wrong == [(30, 5), (29, 25)])


@pytest.mark.parametrize("diameter", [37.0, 61.3, 80.0, 117.9, 255.0])
@pytest.mark.parametrize("vertices", [12, 16, 20, 32, 48])
def test_no_single_step_of_a_vertex_makes_an_outline_better(diameter, vertices):
    eighth = polygon._round(diameter, vertices)
    here = polygon._cost(eighth[..., None], diameter)[0]
    diagonal = eighth[-1, 0] == eighth[-1, 1]
    assert diagonal == (vertices % 8 != 0)
    assert polygon._sound(eighth[..., None], diagonal)[0]
    for i, axis, step in itertools.product(range(len(eighth)), (0, 1), (-1, 1)):
        moved = eighth.copy()
        moved[i, axis] += step
        if diagonal and i == len(eighth) - 1:
            moved[i] = eighth[i] + step
        if polygon._sound(moved[..., None], diagonal)[0]:
            assert polygon._cost(moved[..., None], diameter)[0] >= here - 1e-12


@pytest.mark.parametrize(
    "diameter", [4.9, 21.0, 38.4, *np.arange(47.0, 260.0, 11.3).tolist()]
)
def test_octagon_is_the_cheapest_of_all_near_the_regular_one(diameter):
    """Half width a within 4 %, cut corner c = a - b; area from the outline. Regular: 8
    (√2 - 1) a², c = (2 - √2) a.
    """
    goal = math.pi * diameter**2 / 4
    regular = math.sqrt(goal / 8 / (math.sqrt(2) - 1))
    best = (math.inf, 0, 0)
    for a in range(math.floor(0.96 * regular), math.ceil(1.04 * regular) + 1):
        for b in range(
            max(1, int(0.41 * regular) - 16), min(a, int(0.41 * regular) + 17)
        ):
            error = abs(area([(a, b)]) / goal - 1)
            off = (a - regular) ** 2 + ((a - b - (2 - math.sqrt(2)) * regular) / 2) ** 2
            best = min(
                best, (4 * max(error / 5e-4 - 1, 0) ** 2 + 100 * error + off, a, b)
            )
    assert polygon._octagon(diameter).tolist() == [[best[1], best[2]]]
    made = polygon.pillar(diameter, shape="shot")
    assert made.points[:, 0].max() == best[1]
    assert len(made.points) == 8


@pytest.mark.parametrize("diameter", [9.0, 12.5, 17.0, 24.2])
def test_on_a_coarse_grid_fewer_vertices_are_taken_where_their_area_is_far_better(
    diameter,
):
    """From the most down; the next is taken where its error is below 0.7 of the best so
    far, to one below 1e-3.
    """
    best = None
    for count in (64, 48, 32, 24, 20, 16, 12):
        points = polygon.mirrored(polygon._round(diameter, count))
        made = polygon.PillarShape(points, diameter)
        if best is None or abs(made.area_error) < 0.7 * abs(best.area_error):
            best = made
        if abs(best.area_error) <= 1e-3:
            break
    assert np.array_equal(polygon.pillar(diameter, vertices=64).points, best.points)


def test_frontier_is_the_worst_error_and_the_mean_count_over_the_diameters():
    sizes, grid = (225.0, 232.5, 391.0), 2.5  # both shapes are too small by most
    shot, round_ = polygon.frontier(sizes, grid_nm=grid, vertices=(24,))
    for found, shape, n in ((shot, "shot", 8), (round_, "round", 24)):
        made = [polygon.pillar(s / grid, vertices=n, shape=shape) for s in sizes]
        circles = [math.pi * (s / grid) ** 2 / 4 for s in sizes]
        areas = [polygon.twice_area(m.points) / 2 for m in made]
        errors = [abs(a / c - 1) for a, c in zip(areas, circles, strict=True)]
        edges = [
            dense_error(m.points, s / grid / 2)
            for m, s in zip(made, sizes, strict=True)
        ]
        assert (found.vertices, found.shape) == (n, shape)
        assert found.area_error == pytest.approx(max(errors), rel=1e-9)
        assert found.edge_error_nm == pytest.approx(grid * max(edges), abs=1e-4)
        assert found.corners == pytest.approx(np.mean([len(m.points) for m in made]))
        assert found.shots == pytest.approx(
            np.mean([len(set(m.points[:, 1].tolist())) - 1 for m in made])
        )


@pytest.mark.parametrize(
    ("count", "diagonal"), [(5, False), (5, True), (4, False), (2, True), (1, False)]
)
def test_trial_moves_are_small_steps_of_one_or_two_coordinates_or_all_of_few(
    count, diagonal
):
    """Up to four free coordinates: all steps to 2; up to eight: to 1; beyond, one or
    two steps by 1.
    """
    free = 2 * count - diagonal
    if free <= 8:
        reach = 2 if free <= 4 else 1
        want = set(itertools.product(range(-reach, reach + 1), repeat=free))
    else:
        unit = [
            tuple(s * (i == k) for i in range(free))
            for k in range(free)
            for s in (1, -1)
        ]
        pairs = {
            tuple(np.add(a, b).tolist()) for a, b in itertools.combinations(unit, 2)
        }
        want = set(unit) | pairs
    found = polygon._moves(count, diagonal).reshape(2 * count, -1).T
    if diagonal:
        assert np.array_equal(found[:, -1], found[:, -2])  # it stays on the diagonal
        found = found[:, :-1]
    assert set(map(tuple, found.tolist())) == want


def test_boxes_around_a_slanted_shape_are_as_wide_as_it_is_in_their_slice():
    """A triangle that leans; its x at any height by the lines between its corners, its
    middle corner within a slice.
    """
    corners = np.array([[-41_000, 7_000], [3_000, 31_500], [-12_500, 62_000]])
    boxes = rectilinear.covering(corners)
    assert len(boxes) == 11
    assert (boxes[0, 1], boxes[-1, 3]) == (7_000, 62_000)
    sides = list(zip(corners, np.roll(corners, -1, axis=0), strict=True))
    for left, bottom, right, top in boxes.tolist():
        x = [float(c[0]) for c in corners if bottom <= c[1] <= top]
        for (x0, y0), (x1, y1) in sides:
            x += [
                x0 + (y - y0) * (x1 - x0) / (y1 - y0)
                for y in (bottom, top)
                if min(y0, y1) <= y <= max(y0, y1)
            ]
        assert left == pytest.approx(
            min(x), abs=2
        )  # outwards to whole units, and a unit of the slice's height
        assert right == pytest.approx(max(x), abs=2)
