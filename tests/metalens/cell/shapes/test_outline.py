"""Sections by theorems of Gauss and Steiner: normals, offsets, gaps, symmetries,
factors near zero frequency.
"""

import math

import numpy as np
import pytest

from metalens.cell.shapes import outline
from metalens.cell.shapes.outline import EllipseArc, Outline, PolygonLoop
from metalens.core.errors import CellError

TRIANGLE = ((0.31, -0.12), (-0.05, 0.27), (-0.2, -0.18))
BENT = Outline((PolygonLoop(TRIANGLE), EllipseArc(0.04, 0.02, 0.5, -1)))


@pytest.mark.parametrize(
    "part",
    [
        PolygonLoop(TRIANGLE),
        PolygonLoop(TRIANGLE[::-1]),
        EllipseArc(0.3, 0.17, 0.6),
        EllipseArc(0.2, 0.4, -1.1, -1),
    ],
)
def test_normals_leave_a_part_everywhere(part):
    """Gauss: the integral of n over a closed line is 0, of x n_x and of y n_y the area,
    of x n_y nothing.
    """
    made = Outline((part,))
    step = 0.004
    points, normals = made.boundary(step)
    assert np.hypot(*normals.T) == pytest.approx(1, rel=1e-12)
    corners = part.vertices(max(32, math.ceil(2 * math.pi * made.radius_um / step)))
    lengths = np.hypot(*(np.roll(corners, -1, axis=0) - corners).T)
    pieces = np.maximum(1, np.ceil(lengths / step)).astype(int)
    ds = np.repeat(lengths / pieces, pieces)
    assert ds.max() <= step
    assert len(points) == pieces.sum()
    area = abs(part.area_um2)
    assert (normals * ds[:, None]).sum(0) == pytest.approx(np.zeros(2), abs=1e-9)
    flux = points.T @ (normals * ds[:, None])
    assert flux == pytest.approx(area * np.eye(2), rel=1e-9, abs=1e-9 * area + 1e-12)


def test_an_ellipse_is_drawn_with_its_area_and_turn():
    corners = EllipseArc(0.3, 0.1, 0.4).vertices(40)
    x, y = corners.T
    assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2 == pytest.approx(
        math.pi * 0.03, rel=1e-12
    )
    far = corners[np.hypot(x, y).argmax()]
    assert abs(math.remainder(math.atan2(far[1], far[0]) - 0.4, math.pi)) < 1e-9
    assert EllipseArc(0.3, 0.1, sign=-1).area_um2 == pytest.approx(-math.pi * 0.03)
    assert BENT.area_um2 == pytest.approx(
        PolygonLoop(TRIANGLE).area_um2 - math.pi * 0.04 * 0.02
    )
    assert Outline((EllipseArc(0.3, 0.1, 0.4),)).radius_um == pytest.approx(
        0.3, rel=2e-3
    )  # 64 points of equal area


@pytest.mark.parametrize(
    "part",
    [PolygonLoop(TRIANGLE), PolygonLoop(TRIANGLE, -1), EllipseArc(0.3, 0.17, 0.6)],
)
def test_factors_near_zero_are_area_and_centroid(part):
    """f(g) = A (1 - i g c) + O(g²), also where another formula takes over (|g| size
    1e-4; 1e-6 for ellipses).
    """
    centre = np.mean(TRIANGLE, axis=0) if isinstance(part, PolygonLoop) else np.zeros(2)
    for size in (2e-6, 2e-4, 4e-4, 1e-3):
        gx, gy = size * 0.8, -size * 0.6
        want = part.area_um2 * (1 - 1j * (gx * centre[0] + gy * centre[1]))
        assert abs(complex(part.fourier(np.array(gx), np.array(gy))) - want) < abs(
            part.area_um2
        ) * (size**2 + 1e-11 / size)


@pytest.mark.parametrize("grow", [0.06, -0.03])
def test_an_outline_moved_out_grows_as_steiner_says(grow):
    """A' = A + P t + t² Σ tan(turn / 2) with mitred corners, t = grow / 2; edges stay
    parallel.
    """
    corners = np.array(TRIANGLE)
    edge = np.roll(corners, -1, axis=0) - corners
    lengths = np.hypot(*edge.T)
    along = np.arctan2(edge[:, 1], edge[:, 0])
    turn = np.mod(along - np.roll(along, 1), 2 * math.pi)
    t = grow / 2
    want = (
        PolygonLoop(TRIANGLE).area_um2
        + lengths.sum() * t
        + t**2 * np.tan(turn / 2).sum()
    )
    made = np.array(outline.offset_corners(corners, grow))
    assert PolygonLoop(tuple(map(tuple, made))).area_um2 == pytest.approx(
        want, rel=1e-9
    )
    after = np.roll(made, -1, axis=0) - made
    assert edge[:, 0] * after[:, 1] - edge[:, 1] * after[:, 0] == pytest.approx(
        np.zeros(3), abs=1e-12
    )
    # clockwise corners are turned round first
    other = np.array(sorted(outline.offset_corners(corners[::-1], grow)))
    assert other == pytest.approx(np.array(sorted(made.tolist())), rel=1e-9)
    with pytest.raises(CellError, match="loses an edge"):
        outline.offset_corners(corners, -0.5)


def test_corners_are_turned_from_x_towards_y():
    assert outline.rotate_corners(
        np.array([[2.0, 0.0], [0.0, 1.0]]), 0.3
    ) == pytest.approx(
        np.array(
            [[2 * math.cos(0.3), 2 * math.sin(0.3)], [-math.sin(0.3), math.cos(0.3)]]
        )
    )


def test_gaps_between_copies_are_distances():
    """Ellipses of half width 0.3 and 0.1 at 1 along x and 0.5 along y; touching ones
    have none.
    """
    made = Outline((EllipseArc(0.3, 0.1),))
    assert made.gap_um(((1.0, 0.0),)) == pytest.approx(0.4, rel=0.02)
    assert made.gap_um(((0.0, 0.5),)) == pytest.approx(0.3, rel=0.02)
    assert made.gap_um(((1.0, 0.0), (0.0, 0.5), (9.0, 9.0))) == pytest.approx(
        0.3, rel=0.02
    )
    assert made.gap_um(((0.55, 0.0),)) == 0
    assert Outline((EllipseArc(0.3, 0.1, math.pi / 2),)).gap_um(
        ((1.0, 0.0),)
    ) == pytest.approx(0.8, rel=0.02)
    diagonal = Outline((EllipseArc(0.2, 0.2),))
    assert diagonal.gap_um(((0.6, 0.45),)) == pytest.approx(0.75 - 0.4, rel=0.02)


def test_symmetries_are_those_of_the_section():
    assert Outline((EllipseArc(0.3, 0.1),)).keeps(-1, 1)
    assert Outline((EllipseArc(0.3, 0.1),)).keeps(1, -1)
    leaning = Outline((EllipseArc(0.3, 0.1, 0.4),))
    assert not leaning.keeps(-1, 1)
    assert not leaning.keeps(1, -1)
    assert leaning.keeps(-1, -1)
    assert not BENT.keeps(-1, -1)
    arrow = Outline((PolygonLoop(((0.3, 0.0), (-0.1, 0.2), (-0.1, -0.2))),))
    assert arrow.keeps(1, -1)
    assert not arrow.keeps(-1, 1)


def test_a_hole_is_not_inside():
    x = np.array([0.0, 0.1, 0.4, -0.12])
    y = np.array([0.0, -0.05, 0.0, -0.1])
    assert BENT.inside(x, y).tolist() == [False, True, False, True]
    assert [sign for sign, _ in BENT.polygons()] == [1, -1]
