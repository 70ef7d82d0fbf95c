"""Pieces of marks: they tile their boxes on the grid, and are short only where the
background changes.
"""

import numpy as np
import pytest
from scipy.special import erf

from layout.pec import fracture
from layout.pec.psf import PointExposure

STEP_UM = 1e-3
CROSS = np.array(
    [
        [0, 0, 10_003, 45_001],
        [-44_000, 45_001, 55_007, 55_011],
        [0, 55_011, 10_003, 100_009],
    ]
)
NOTHING = np.empty((0, 4))


def beam(beta_um, eta=0.7):
    return PointExposure(np.array([0.01, beta_um]), np.array([1.0, eta]) / (1 + eta))


@pytest.mark.parametrize("beta_um", [5.0, 31.0])
def test_pieces_tile_their_boxes(beta_um):
    made, of = fracture.fracture_boxes(
        CROSS, NOTHING, step_um=STEP_UM, point=beam(beta_um), tolerance=0.01
    )
    for n, box in enumerate(CROSS):
        mine = made[of == n]
        assert (mine[:, :2] >= box[:2]).all()
        assert (mine[:, 2:] <= box[2:]).all()
        area = ((mine[:, 2] - mine[:, 0]) * (mine[:, 3] - mine[:, 1])).sum()
        assert area == (box[2] - box[0]) * (box[3] - box[1])


def test_the_number_of_pieces_goes_with_corners_and_not_with_area():
    count = [
        len(
            fracture.fracture_boxes(
                CROSS, NOTHING, step_um=STEP_UM, point=beam(b), tolerance=0.01
            )[0]
        )
        for b in (20.0, 10.0, 5.0)
    ]
    assert (
        count[2] < 3 * count[0]
    )  # squares of a 16th of the range would be sixteen times as many


def by_boxes(at_um, boxes_um, point):
    """(n,) exposure at points by boxes of dose 1: for each Gaussian the product of two
    differences of erf, halved.
    """
    total = np.zeros(len(at_um))
    for width, weight in zip(point.widths_um, point.weights, strict=True):
        sides = [
            erf((boxes_um[:, axis + 2] - at_um[:, None, axis]) / width)
            - erf((boxes_um[:, axis] - at_um[:, None, axis]) / width)
            for axis in (0, 1)
        ]
        total += weight * (sides[0] * sides[1] / 4).sum(-1)
    return total


def test_the_background_hardly_changes_along_the_outer_side_of_a_piece():
    point = beam(8.0)
    made, _ = fracture.fracture_boxes(
        CROSS, NOTHING, step_um=STEP_UM, point=point, tolerance=0.01
    )
    box = made * STEP_UM
    far = PointExposure(point.widths_um[1:], point.weights[1:])
    bottom = box[(made[:, 1] == 45_001) & (made[:, 0] < -500)]  # of the left arm
    ends = [by_boxes(bottom[:, [k, 1]], CROSS * STEP_UM, far) for k in (0, 2)]
    long = bottom[:, 2] - bottom[:, 0] > 2 * 8.0 / 64
    assert long.any()
    assert np.abs(ends[0] - ends[1])[long].max() <= 2 * 0.2 * 0.01 * 0.5 * (1 + 1e-9)


def test_next_to_a_lens_pieces_stay_short():
    lens = np.array([[60.0, -20.0, 90.0, 20.0]])
    near, _ = fracture.fracture_boxes(
        CROSS, lens, step_um=STEP_UM, point=beam(12.0), tolerance=0.01
    )
    right = near[near[:, 2] > 50_000]
    assert ((right[:, 2:] - right[:, :2]).max() * STEP_UM) <= 12.0 / 8


def test_a_middle_range_of_little_weight_does_not_cut_whole_marks():
    """A measured point exposure has a ladder of ranges; pieces of the narrowest would
    be millions.
    """
    point = PointExposure(
        np.array([0.01, 0.1, 0.4, 1.6, 30.0]),
        np.array([0.6, 0.002, 0.002, 0.03, 0.366]),
    )
    made, _ = fracture.fracture_boxes(
        CROSS, NOTHING, step_um=STEP_UM, point=point, tolerance=0.01
    )
    area_um2 = (
        (CROSS[:, 2] - CROSS[:, 0]) * (CROSS[:, 3] - CROSS[:, 1])
    ).sum() * STEP_UM**2
    assert len(made) < 3000
    assert len(made) < area_um2 / 0.4**2 / 4  # squares of a range


@pytest.mark.parametrize("widths", [[0.4], [0.4, 1.59], [1.5, 0.4]])
def test_ranges_within_four_of_the_core_cut_nothing(widths):
    """They belong to the edge: 1.59 is less than four times 0.4."""
    point = PointExposure(np.array(widths), np.full(len(widths), 1 / len(widths)))
    made, of = fracture.fracture_boxes(
        CROSS, NOTHING, step_um=STEP_UM, point=point, tolerance=0.01
    )
    assert made.tolist() == CROSS.tolist()
    assert of.tolist() == [0, 1, 2]


@pytest.mark.parametrize(("core_um", "shortest"), [(0.01, 8 / 64), (0.3, 0.6)])
def test_the_shortest_pieces_are_a_64th_of_the_narrowest_range_or_two_of_the_core(
    core_um, shortest
):
    """At a tolerance that nothing keeps, near the corners: halved until another half
    would be shorter than that.
    """
    point = PointExposure(np.array([core_um, 8.0, 300.0]), np.array([0.6, 0.3, 0.1]))
    box = np.array([[0, 0, 1024, 999]])
    made, _ = fracture.fracture_boxes(
        box, NOTHING, step_um=STEP_UM * 4, point=point, tolerance=1e-7
    )
    least = float((made[:, 2:] - made[:, :2]).min()) * STEP_UM * 4
    assert (
        shortest - STEP_UM * 4 < least < 2 * shortest
    )  # halves of an odd number of grid steps


def test_no_boxes_are_no_pieces():
    made, of = fracture.fracture_boxes(
        np.empty((0, 4), int), NOTHING, step_um=STEP_UM, point=beam(8.0), tolerance=0.01
    )
    assert (made.shape, of.shape) == ((0, 4), (0,))


@pytest.mark.parametrize("turn", [[0, 1, 2, 3], [1, 0, 3, 2]])
def test_a_bar_drawn_as_two_is_not_cut_along_for_the_side_between_them(turn):
    """From its edge to its middle the background changes by more than a piece may have,
    but no edge is there.
    """
    bars = np.array([[0, 0, 120_000, 6_000], [0, 6_000, 120_000, 13_000]])
    point = beam(16.0)
    far = PointExposure(point.widths_um[1:], point.weights[1:])
    ends = by_boxes(
        np.array([[60.0, 0.0], [60.0, 6.0], [60.0, 13.0]]), bars * STEP_UM, far
    )
    assert np.abs(np.diff(ends)).min() / 2 > 0.2 * 0.01 * 0.5
    made, of = fracture.fracture_boxes(
        bars[:, turn], NOTHING, step_um=STEP_UM, point=point, tolerance=0.01
    )
    made = made[:, turn]
    middle = (made[:, 0] <= 60_000) & (made[:, 2] >= 60_000)
    for n, (_, bottom, _, top) in enumerate(bars):
        assert {
            tuple(piece) for piece in made[middle & (of == n)][:, [1, 3]].tolist()
        } == {(bottom, top)}
