"""Sizes and heights of layered, tilted and coated pillars, by hand."""

import math

import pytest

from metalens.cell.lattice import Lattice
from metalens.cell.record import Cell, Index, Layer
from metalens.cell.shapes import Circle, Ellipse, Polygon, Ring, Square
from metalens.core.errors import CellError

SLOPE = 2 * math.tan(0.05)  # of the width, for each um that it is lower
PEDESTAL = Layer(0.1, grow_um=0.05, material=Index(1.9))
OWN = Layer(0.4, coat_um=0.03, coat=Index(1.5))
MASK = Layer(0.3, grow_um=-0.02)


def layered(**about):
    return Cell(0.5, 0.8, layers=(PEDESTAL, OWN, MASK), **about)


def test_ends_of_sections_count_from_the_middle_of_the_height():
    """The pedestal is widest at its foot, 0.4 um below the middle; the mask narrowest
    at its top, 0.4 um above; the
    coat of the section between adds twice its thickness, from 0.3 um below the middle
    on."""
    assert layered(sidewall_rad=0.05).widening_um == pytest.approx(
        (-0.02 - 0.4 * SLOPE, max(0.05 + 0.4 * SLOPE, 0.06 + 0.3 * SLOPE)), rel=1e-12
    )
    thick = Cell(
        0.5,
        0.8,
        layers=(PEDESTAL, Layer(0.4, coat_um=0.09, coat=Index(1.5)), MASK),
        sidewall_rad=0.05,
    )
    assert thick.widening_um == pytest.approx(
        (-0.02 - 0.4 * SLOPE, 0.18 + 0.3 * SLOPE), rel=1e-12
    )
    leaning = layered(
        sidewall_rad=-0.05
    )  # wider upwards: least at the foot of what is narrow
    ends = [
        0.05 - 0.4 * SLOPE,
        0.05 - 0.3 * SLOPE,
        -0.3 * SLOPE,
        0.1 * SLOPE,
        -0.02 + 0.1 * SLOPE,
        -0.02 + 0.4 * SLOPE,
    ]
    assert leaning.widening_um == pytest.approx(
        (min(ends), 0.06 + 0.1 * SLOPE), rel=1e-12
    )
    assert Cell(0.5, 0.8, sidewall_rad=0.05).widening_um == pytest.approx(
        (-0.4 * SLOPE, 0.4 * SLOPE), rel=1e-12
    )
    assert Cell(0.5, 0.8).widening_um == (0.0, 0.0)


def test_a_change_of_height_goes_to_the_sections_of_the_pillars_own_material():
    """0.4 and 0.3 of 0.7 um; the pedestal stays."""
    assert layered().height_shares == pytest.approx((0, 4 / 7, 3 / 7))
    higher = layered().at_height(1.01)
    assert [each.height_um for each in higher.layers] == pytest.approx(
        [0.1, 0.4 + 0.12, 0.3 + 0.09]
    )
    assert higher.height_um == 1.01
    assert [each.grow_um for each in higher.layers] == [0.05, 0.0, -0.02]
    assert sum(
        each.height_um for each in layered().at_height(0.11).layers
    ) == pytest.approx(0.11)
    with pytest.raises(
        CellError,
        match=r"height_um = 0\.1 of a pillar in layers, 0\.1 um of it of other films",
    ):
        layered().at_height(0.1)
    films = Cell(
        0.5,
        0.3,
        layers=(Layer(0.1, material=Index(1.9)), Layer(0.2, material=Index(2.2))),
    )
    assert films.height_shares == pytest.approx(
        (1 / 3, 2 / 3)
    )  # none is the pillar's own: all share
    assert Cell(0.5, 0.8).height_shares == (1.0,)
    assert Cell(0.5, 0.8).at_height(0.35).height_um == 0.35


def test_sizes_by_least_width_and_least_space():
    """A ring's wall and hole, an ellipse's lesser axis; of a narrowed top a fiftieth of
    the pitch is left.
    """
    ring = Cell(0.5, shape=Ring(0.3))
    wall, hole = ring.outline(1.0).spans_um
    assert (wall, hole) == pytest.approx(
        (0.35, 0.3), rel=1e-2
    )  # the circles as polygons
    assert ring.size_um(0.07) == pytest.approx(0.07 / wall, rel=1e-9)
    assert ring.size_um(0.07, 0.09) == pytest.approx(0.09 / hole, rel=1e-9)
    assert ring.size_um(0.14, 0.09) == pytest.approx(0.14 / wall, rel=1e-9)
    oblong = Cell(
        0.5, shape=Ellipse(0.6), layers=(Layer(0.5, grow_um=-0.04), Layer(0.2))
    )
    assert oblong.size_um(0.03) == pytest.approx((0.01 + 0.04) / 0.6, rel=1e-3)
    assert oblong.size_um(0.09) == pytest.approx(0.09 / 0.6, rel=1e-3)


def test_gaps_and_widest_sizes_of_squares():
    """Edges a on a pitch p leave p - a; the search ends within a ten-thousandth of the
    pitch.
    """
    cell = Cell(0.5, shape=Square())
    assert cell.gap_um(0.31) == pytest.approx(0.19)
    assert cell.gap_um(0.31, grow_um=0.04) == pytest.approx(0.15)
    assert cell.gap_um(0.5) == pytest.approx(0, abs=1e-12)
    wide = Cell(0.5, 0.7, shape=Square(), layers=(Layer(0.7, grow_um=0.12),))
    assert wide.widest_um(0.05) == pytest.approx(
        0.98 * 0.5 - 0.12, abs=1.1e-4
    )  # what is wider leaves a fiftieth


def test_round_pillars_end_at_the_gap_or_where_a_foot_comes_near():
    """A foot is 0.4 SLOPE = 40 nm wider than the size, and keeps a fiftieth of 0.5 um:
    50 nm in all.
    """
    tilted = Cell(0.5, 0.8, sidewall_rad=0.05)
    assert tilted.widest_um(0.07) == pytest.approx(0.43)
    assert tilted.widest_um(0.03) == pytest.approx(0.49 - 0.4 * SLOPE)
    assert tilted.size_um(0.08) == 0.08
    assert tilted.size_um(0.03) == pytest.approx(0.01 + 0.4 * SLOPE)
    upright = Cell(0.5, 0.8)
    assert (upright.widest_um(0.003), upright.size_um(0.003)) == (
        pytest.approx(0.497),
        0.003,
    )  # nothing is wider


def regular(sides):
    """Corners of a regular polygon about the middle, the first off both axes."""
    return Polygon(
        tuple(
            (math.cos(a), math.sin(a))
            for a in (0.3 + 2 * math.pi * k / sides for k in range(sides))
        )
    )


@pytest.mark.parametrize(
    ("shape", "square", "hexagonal"),
    [
        (Circle(), True, True), (Square(0.2), True, False), (Ellipse(0.6), False, False), (regular(3), False, True),
        (regular(6), False, True), (regular(4), True, False), (regular(5), False, False), (regular(12), True, True),
    ],
    ids=["circle", "square", "ellipse", "3", "6", "4", "5", "12"],
)  # fmt: skip
def test_light_along_x_and_y_meets_the_same_cell_where_shape_and_lattice_share_a_turn(
    shape, square, hexagonal
):
    """By a quarter on a square lattice, by a third or a sixth on a hexagonal one, by
    none on a rectangular one.
    """
    assert Cell(0.5, shape=shape).alike is square
    assert Cell(0.5, shape=shape, lattice=Lattice("hexagonal")).alike is hexagonal
    assert not Cell(0.5, shape=shape, lattice=Lattice("rectangular", 1.2)).alike


def test_a_plain_round_pillar_is_a_circle_in_one_piece_on_a_square_lattice():
    assert Cell(0.5, sidewall_rad=0.05).round
    assert not Cell(0.5, shape=Square()).round
    assert not Cell(0.5, shape=Circle(hole=True)).round
    assert not Cell(0.5, lattice=Lattice("hexagonal")).round
    assert not Cell(0.5, lattice=Lattice("rectangular", 1.2)).round
    assert not layered().round
    assert layered().described == "circle on a square lattice in 3 layers"
    assert (
        Cell(0.5, shape=Circle(hole=True)).described
        == "circle (hole) on a square lattice"
    )
