"""What shapes expose by themselves: polygons of circles against closed forms,
rectangles against error functions.
"""

import math

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import erf

from layout.pec.pillar_exposure import DrawnDiscs, DrawnOutlines
from layout.pec.psf import PointExposure

POINT = PointExposure(np.array([0.014, 0.31, 9.0]), np.array([0.6, 0.1, 0.3]))
D = 0.231
ONE = np.array([False, True])
OFF = np.array([0.3517, -0.2109])


def round_ones(count=256):
    """The polygon of a circle's area, off the middle, and the circle."""
    turn = 2 * math.pi * np.arange(count) / count
    swell = math.sqrt(2 * math.pi / count / math.sin(2 * math.pi / count))
    corners = swell * D / 2 * np.stack([np.cos(turn), np.sin(turn)], -1)
    return DrawnOutlines([(), [corners + OFF]]), DrawnDiscs(np.array([0.0, D]))


def test_the_polygon_of_a_circle_exposes_as_the_disc_does():
    """Level and slope on pixels of a sixth of the core: 2e-3 and 1 %; moments of 256
    corners: 1e-4.
    """
    polygon, disc = round_ones()
    (own, slope), (want, fall) = (
        polygon.edge_exposure(ONE, POINT),
        disc.edge_exposure(ONE, POINT),
    )
    assert own[1] == pytest.approx(want[1], rel=2e-3)
    assert slope[1] == pytest.approx(fall[1], rel=1e-2)
    assert polygon.area_um2[1] == pytest.approx(disc.area_um2[1], rel=1e-9)
    assert polygon.wider_um2[1] == pytest.approx(disc.wider_um2[1], rel=1e-4)
    at = np.array([[0.13, 0.04], [0.02, -0.1], [-0.4, 0.2]])
    for width in POINT.widths_um:
        assert polygon.exposure_at(1, at + OFF, width) == pytest.approx(
            disc.exposure_at(1, at, width), abs=1e-4
        )


def test_a_rectangle_and_its_hole_are_products_of_error_functions():
    def box(a, b):
        return np.array([[-a, -b], [a, -b], [a, b], [-a, b]])

    shape = DrawnOutlines([(), [box(0.13, 0.06), box(0.05, 0.021)[::-1]]])
    at = np.array([[0.13, 0.03], [0.01, 0.02], [0.2, -0.07]])
    width = 0.03

    def plain(a, b):
        x, y = at.T
        return np.prod(
            [
                (erf((s + v) / width) + erf((s - v) / width)) / 2
                for s, v in ((a, x), (b, y))
            ],
            axis=0,
        )

    want = plain(0.13, 0.06) - plain(0.05, 0.021)
    # four Gauss points on 0.8 widths
    assert shape.exposure_at(1, at, width) == pytest.approx(want, abs=1e-6)


def level_of_a_rectangle(a, b):
    """What the exposure of a rectangle of half sides a, b exceeds on its own area: rays
    from its middle, by halving.

    Products of error functions fall along every ray; the area is the mean of r^2 / 2
    over the angles.
    """
    angle = 2 * math.pi * (np.arange(4000) + 0.5) / 4000

    def exposure(r):
        sides = ((a, r * np.cos(angle)), (b, r * np.sin(angle)))
        parts = [
            [erf((s + v) / w) + erf((s - v) / w) for s, v in sides]
            for w in POINT.widths_um
        ]
        return sum(
            share / 4 * x * y
            for share, (x, y) in zip(POINT.weights, parts, strict=True)
        )

    def excess(level):
        low = np.zeros_like(angle)
        high = np.full_like(angle, 2 * (a + b))
        for _ in range(30):
            middle = (low + high) / 2
            above = exposure(middle) > level
            low = np.where(above, middle, low)
            high = np.where(above, high, middle)
        return math.pi * float((low**2).mean()) - 4 * a * b

    return brentq(excess, 0.1, 0.6, xtol=1e-6)


@pytest.mark.parametrize(
    "turn_deg", [0.0, 17.2, math.degrees(math.atan(0.5)), 45.0, 63.0, 90.0, 135.0]
)
@pytest.mark.parametrize("sides", [(0.132, 0.066), (0.1201, 0.0243)])
def test_a_turn_leaves_the_level_of_a_shape_as_it_is(sides, turn_deg):
    """At 45 degrees all pixels along an edge are cut alike: errors of their shares do
    not average out, and doses are
    promised to 1e-2. Pixels of a sixth and of a tenth of the core see the bend of the
    exposure: 5e-4 of the level."""
    a, b = sides
    c = math.cos(math.radians(turn_deg))
    s = math.sin(math.radians(turn_deg))
    corners = np.array([[-a, -b], [a, -b], [a, b], [-a, b]]) @ np.array(
        [[c, s], [-s, c]]
    )
    want = level_of_a_rectangle(a, b)
    assert DrawnOutlines([(), [corners + OFF]]).edge_exposure(ONE, POINT)[0][
        1
    ] == pytest.approx(want, rel=5e-4)
