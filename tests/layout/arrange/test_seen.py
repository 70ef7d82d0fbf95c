"""The die as a coarse microscope sees it: areas are kept, wherever and however parts
stand.
"""

import numpy as np
import pytest

from layout.arrange import Placement, joined, parts, seen
from layout.formats import CellContent, CellPlacements, PillarSites
from layout.mask import PillarLattice
from layout.process.process import Process

AREA = 90.0 * 80 / 2


def lens(block):
    """A lattice of triangles of 90 by 80 nm that is never all in memory, placed by the
    part's own cell.
    """
    cells = {
        "TRI": CellContent("TRI", {(1, 0): [np.array([[0, 0], [90, 0], [0, 80]])]}),
        "LENS": CellContent("LENS"),
    }
    cells["TOP"] = CellContent("TOP", placed=PLACED)
    sites = PillarSites(
        PillarLattice.of("OWN", block, pitch=400, x0=-2000, y0=3000), ("TRI",)
    )
    return parts.DieComponent(
        "A",
        "TOP",
        cells,
        {(1, 0): 1.0},
        {},
        {},
        np.array([-2000, -9000, 6000, 3000]),
        sites={"LENS": sites},
    )


PLACED = CellPlacements(
    ("LENS",), *(np.array([v], np.int32) for v in (0, 700, -300)), np.zeros(1, np.uint8)
)


def pads():
    shape = np.array([[0, 0], [50_000, 0], [50_000, 20_000], [0, 20_000]])
    return parts.DieComponent(
        "P",
        "PAD",
        {"PAD": CellContent("PAD", {(2, 0): [shape]})},
        {(2, 0): 1.0},
        {},
        {},
        np.zeros(4),
    )


def test_every_area_is_seen_once_and_where_it_stands():
    block = np.zeros((31, 21), np.uint8)
    block[4:, 3:] = np.random.default_rng(2).integers(0, 2, (27, 18))
    at = (
        Placement(x_um=20.0, y_um=-15.0, turn_deg=90.0),
        Placement(x_um=-40.0, y_um=12.0, columns=2, step_um=(15.0, 3.0)),
    )
    placed = [
        joined.PartPlacement(lens(block), at),
        joined.PartPlacement(pads(), (Placement(x_um=-10.0, y_um=20.0),)),
    ]
    view = seen.DensityView.over(np.array([-70_000, -60_000, 80_000, 60_000]), 75)
    found = seen.coverage_map(placed, Process(), view)
    assert set(found) == {parts.PILLARS, parts.APERTURE}
    assert found[parts.PILLARS].sum() * view.side**2 == pytest.approx(
        3 * block.sum() * AREA, rel=1e-9
    )
    pad = found[parts.APERTURE]
    assert pad.sum() * view.side**2 == pytest.approx(50e6 * 20, rel=1e-9)
    row, column = int((30_000 + 60_000) / view.side), int((10_000 + 70_000) / view.side)
    assert pad[row, column] == pytest.approx(1, abs=0.02)  # in the middle of the pad
    rows, columns = np.nonzero(found[parts.PILLARS])
    share = found[parts.PILLARS][rows, columns]
    x, y = (
        (k + 0.5) * view.side + low
        for k, low in ((columns, view.left), (rows, view.bottom))
    )
    r, c = np.nonzero(block)
    u, v = (
        -2000 + 400 * c + 700 + 40,
        3000 - 400 * r - 300 + 40,
    )  # box middles; their shares weigh alike
    want_x = np.mean([20_000 - v.mean(), -40_000 + u.mean(), -25_000 + u.mean()])
    want_y = np.mean([-15_000 + u.mean(), 12_000 + v.mean(), 12_000 + v.mean()])
    assert np.average(x, weights=share) == pytest.approx(
        want_x, abs=60
    )  # the triangle's own middle
    assert np.average(y, weights=share) == pytest.approx(want_y, abs=60)


@pytest.mark.parametrize(
    ("box", "side", "shape"),
    [
        ((-7, -31, 13, 69), 4.0, (26, 6)),
        ((-31, -7, 69, 13), 4.0, (6, 26)),
        ((5, 7, 5, 7), 1 / 25, (1, 1)),
    ],
)
def test_a_picture_has_the_points_of_its_longer_side_and_one_for_the_rest(
    box, side, shape
):
    """100 by 20 units by 25 points of 4; a box of nothing has the point at its corner."""
    view = seen.DensityView.over(np.array(box), 25)
    assert (view.left, view.bottom, view.side) == (box[0], box[1], side)
    assert (view.rows, view.columns) == shape


def test_area_on_four_points_keeps_its_sum_and_its_middle_of_mass():
    """Linear shares: the sums of area, area x and area y over the points' middles are
    those of the spots.
    """
    view = seen.DensityView(-7.0, 3.0, 2.5, 9, 13)
    rng = np.random.default_rng(5)
    area = rng.uniform(0.1, 2.0, 40)
    x, y = (
        rng.uniform(-5.5, 23.5, 40),
        rng.uniform(4.5, 23.5, 40),
    )  # half a point and more from the edges
    image = np.zeros((9, 13))
    view.add((x, y, area), image)
    held = image * 2.5**2
    across, up = -7 + 2.5 * (np.arange(13) + 0.5), 3 + 2.5 * (np.arange(9) + 0.5)
    assert held.sum() == pytest.approx(area.sum(), rel=1e-12)
    assert held.sum(0) @ across == pytest.approx(area @ x, rel=1e-12)
    assert held.sum(1) @ up == pytest.approx(area @ y, rel=1e-12)
    edge = np.zeros((9, 13))
    view.add((np.array([-7.0]), np.array([26.0]), np.array([5.0])), edge)
    assert edge[8, 0] * 2.5**2 == pytest.approx(
        5.0
    )  # beyond the last middles: of the last


def test_a_large_shape_is_points_of_one_share_within_it_and_a_small_one_its_middle():
    """A bar of 100 by 10 at 20: five points on its middle line; an L has no point where
    it has no area.
    """
    x, y, area = seen._sampled(np.array([[3.0, 7], [103, 7], [103, 17], [3, 17]]), 20.0)
    assert (x.tolist(), y.tolist(), area.tolist()) == (
        [13.0, 33, 53, 73, 93],
        [12.0] * 5,
        [200.0] * 5,
    )
    x, y, area = seen._sampled(
        np.array([[0.0, 0], [60, 0], [60, 20], [20, 20], [20, 40], [0, 40]]), 20.0
    )
    assert set(zip(x, y, strict=True)) == {(10, 10), (30, 10), (50, 10), (10, 30)}
    assert area.tolist() == [400.0] * 4
    x, y, area = seen._sampled(np.array([[3.0, 7], [23, 7], [23, 13], [3, 13]]), 20.0)
    assert (x.tolist(), y.tolist(), area.tolist()) == ([13.0], [10.0], [120.0])


def test_spots_within_a_third_of_a_point_are_one_in_their_middle_of_mass():
    """Cells of 2 from the least x and y: (10, 20) and (11, 21) weigh 3 and 1; the
    others stand alone, none has none.
    """
    spots = [
        (10.0, 20.0, 3.0),
        (11.0, 21.0, 1.0),
        (12.5, 20.0, 7.0),
        (10.5, 22.5, 2.0),
        (15.0, 25.0, 0.0),
    ]
    x, y, area = seen._merged(tuple(np.array(spots).T), 6.0)
    assert x == pytest.approx([10.25, 12.5, 10.5], rel=1e-12)
    assert y == pytest.approx([20.25, 20.0, 22.5], rel=1e-12)
    assert area.tolist() == [4.0, 7.0, 2.0]
