"""What pillars of several shapes give to each other's edges, against products of error
functions, pillar by pillar.
"""

import numpy as np
import pytest
from scipy.special import erf

from layout.certify import shaped
from layout.certify.shaped import Beside, Shapes
from layout.shapes.moments import along


def box(left, bottom, right, top):
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


# Outlines, with the boxes they are made of and their signs: no symmetry at all, two
# mirrors, a frame.
CORNER = np.array(
    [
        [-0.1, -0.07],
        [0.12, -0.07],
        [0.12, 0.02],
        [0.01, 0.02],
        [0.01, 0.09],
        [-0.1, 0.09],
    ]
)
UNEVEN = [
    ([CORNER], [(1, box(-0.1, -0.07, 0.12, 0.09)), (-1, box(0.01, 0.02, 0.12, 0.09))]),
    ([box(-0.13, -0.04, 0.13, 0.04)], [(1, box(-0.13, -0.04, 0.13, 0.04))]),
    (
        [box(-0.11, -0.11, 0.11, 0.11), box(-0.05, -0.05, 0.05, 0.05)[::-1]],
        [(1, box(-0.11, -0.11, 0.11, 0.11)), (-1, box(-0.05, -0.05, 0.05, 0.05))],
    ),
]
# moments alike along x and y: what a wide Gaussian leaves out is of fourth order
EVEN = [
    ([box(-0.14, -0.14, 0.14, 0.14)], [(1, box(-0.14, -0.14, 0.14, 0.14))]),
    UNEVEN[2],
    ([box(-0.03, -0.03, 0.03, 0.03)], [(1, box(-0.03, -0.03, 0.03, 0.03))]),
]


def exposed(boxes, x, y, range_um):
    """By one pillar at unit dose, at places from its middle: exact."""
    total = 0.0
    for sign, corners in boxes:
        (left, bottom), (right, top) = corners[0], corners[2]
        across = erf((right - x) / range_um) - erf((left - x) / range_um)
        total = total + sign / 4 * across * (
            erf((top - y) / range_um) - erf((bottom - y) / range_um)
        )
    return total


def by_hand(kinds, pillars, seen, range_um):
    """Mean along the edges of each of those seen, of all others."""
    x, y, dose, shape = pillars
    out = []
    for n in seen:
        edge, total = along(kinds[shape[n]][0], 800), 0.0
        for k in np.flatnonzero(np.arange(len(x)) != n):
            at = edge + np.array([x[n] - x[k], y[n] - y[k]])
            total += (
                dose[k]
                * exposed(kinds[shape[k]][1], at[:, 0], at[:, 1], range_um).mean()
            )
        out.append(total)
    return np.array(out)


def scattered(count, side_um):
    draw = np.random.default_rng(41)
    x, y = draw.uniform(-0.3, side_um, count), draw.uniform(1.1, 1.1 + side_um, count)
    return x, y, draw.uniform(0.6, 1.7, count), draw.integers(0, 3, count)


def seen_by(pillars, some):
    return tuple(v[some] for v in pillars)


@pytest.mark.parametrize("range_um", [0.05, 0.3])
def test_narrow_gaussians_by_images(range_um):
    """Straight lines over a quarter of the range: h² / 8 of f'', 0.3 % of the dose of a
    pillar that stands at the edge;
    32 places along it: less."""
    pillars, some = scattered(50, 1.7), np.arange(3, 50, 4)
    beside = Beside.of(Shapes.of([kind[0] for kind in UNEVEN]), range_um)
    assert beside.images.size
    found, want = (
        beside(seen_by(pillars, some), pillars),
        by_hand(UNEVEN, pillars, some, range_um),
    )
    assert np.ptp(want) > 0.3
    assert found == pytest.approx(want, abs=4e-3)


def test_wide_gaussians_by_second_moments():
    """Fourth moments over the range to the fourth: a few 1e-4 at eight half sides."""
    pillars, some = scattered(40, 1.9), np.arange(2, 40, 5)
    beside = Beside.of(Shapes.of([kind[0] for kind in EVEN]), 8 * 0.14)
    assert not beside.images.size
    found, want = (
        beside(seen_by(pillars, some), pillars),
        by_hand(EVEN, pillars, some, 8 * 0.14),
    )
    assert found == pytest.approx(want, rel=3e-4)
    assert beside.itself[1] == pytest.approx(
        exposed(EVEN[1][1], *along(EVEN[1][0], 800).T, 8 * 0.14).mean(), rel=3e-4
    )


APART = [(0.04, (0.24, 0.11)), (0.04, (-0.31, -0.02)), (1.2, (-2.5, 1.9))]


@pytest.mark.parametrize(("range_um", "step_um"), APART)
def test_two_pillars_as_far_as_a_range_carries(range_um, step_um):
    """A corner and a rectangle alone; straight lines of the image 5 %, moments to the
    fourth over the range 0.2 %.
    """
    kinds = UNEVEN if range_um < 1 else EVEN
    places = 0.4 + np.array([0, step_um[0]]), 2.0 + np.array([0, step_um[1]])
    pillars = *places, np.array([0.8, 1.3]), np.array([1, 0])
    beside = Beside.of(Shapes.of([kind[0] for kind in kinds]), range_um)
    found, want = beside(pillars, pillars), by_hand(kinds, pillars, (0, 1), range_um)
    assert found == pytest.approx(want, rel=0.05 if range_um < 1 else 2e-3)


def test_images_are_coarser_where_they_would_not_be_held(monkeypatch):
    shapes = Shapes.of([kind[0] for kind in UNEVEN])
    monkeypatch.setattr(shaped, "_MOST", 3 * 40**2)
    beside = Beside.of(shapes, 0.04)
    assert beside.images.shape == (3, 41, 41)
    assert beside.pixel_um == pytest.approx((0.13 + 4.5 * 0.04) / 20)
