"""Orders by literal lists, the pitch without resonances by each material of a cell, and
how many orders are named.
"""

import math

import pytest

from metalens.cell.lattice import Lattice
from metalens.cell.orders import (
    Order,
    check_subwavelength,
    no_resonance_um,
    propagating,
)
from metalens.cell.record import Cell, Film, Index, Layer
from metalens.ground.errors import CellError

WAVE = 0.85


def test_the_zero_order_comes_first_on_each_side_and_tilts_take_orders_away_on_one_side():
    """Steps of 1.25 along x and 0.5 along y; light of sine 0.3 towards +x: (-1, 0) is
    at -0.95 in air, (1, 0) at 1.55
    nowhere; (0, 2) at (0.3, 1.0) in glass alone, as (-1, 2) at (-0.95, 1.0); (-1, 1) at
    (-0.95, 0.5) in glass."""
    cell = Cell(
        0.68,
        pillar=Index(3.1),
        substrate=Index(1.47),
        lattice=Lattice("rectangular", 2.5),
    )
    found = propagating(cell, WAVE, angle_rad=math.asin(0.3))
    assert found[0] == Order("substrate", 0, 0)
    cover = [one for one in found if one.side == "cover"]
    assert cover[0] == Order("cover", 0, 0)
    assert {(one.m, one.n) for one in cover} == {(0, 0), (0, -1), (0, 1), (-1, 0)}
    glass = {(one.m, one.n) for one in found if one.side == "substrate"}
    assert glass == {(0, n) for n in (-2, -1, 0, 1, 2)} | {
        (-1, n) for n in (-2, -1, 0, 1, 2)
    }
    mirrored = propagating(cell, WAVE, angle_rad=-math.asin(0.3))
    assert {(-one.m, one.n) for one in mirrored if one.side == "cover"} == {
        (one.m, one.n) for one in cover
    }


def test_far_orders_of_grazing_light_are_found():
    """Sine 0.9 towards -x, steps of 0.5: |-0.9 + 0.5 m| <= 1.45 from m = -1 (1.4) to m
    = 4 (1.1).
    """
    cell = Cell(2 * WAVE, substrate=Index(1.45), cover=Index(1.0))
    found = propagating(cell, WAVE, angle_rad=math.asin(0.9), azimuth_rad=math.pi)
    assert {one.m for one in found if one.n == 0 and one.side == "substrate"} == {
        -1,
        0,
        1,
        2,
        3,
        4,
    }
    assert {one.m for one in found if one.n == 0 and one.side == "cover"} == {
        0,
        1,
        2,
        3,
    }


@pytest.mark.parametrize(("sine", "more"), [(0.0, None), (0.012, 1)])
def test_eight_orders_are_named_and_the_rest_counted(sine, more):
    """Steps of 1.01: eight orders about the zero one in glass of 1.45 (√2 · 1.01 =
    1.43); light from one side brings a
    ninth, (-1, 0) at -0.998 in air."""
    cell = Cell(WAVE / 1.01, substrate=Index(1.45))
    with pytest.raises(CellError) as refused:
        check_subwavelength(cell, WAVE, angle_rad=math.asin(sine))
    text = str(refused.value)
    assert text.count(" in the substrate") + text.count(" in the cover") == 8
    assert ("more" in text) is (more is not None)
    if more:
        assert f" and {more} more propagate" in text


def test_orders_along_one_axis_alone_are_refused_too():
    """A rectangle of 1.5 times the pitch along y: (0, ±1) at 0.85 / 0.75 in glass."""
    cell = Cell(0.5, substrate=Index(1.45), lattice=Lattice("rectangular", 1.5))
    with pytest.raises(
        CellError,
        match=r"orders \(0, -1\) in the substrate, \(0, 1\) in the substrate propagate",
    ):
        check_subwavelength(cell, WAVE)
    turned = Cell(0.75, substrate=Index(1.45), lattice=Lattice("rectangular", 1 / 1.5))
    with pytest.raises(
        CellError,
        match=r"orders \(-1, 0\) in the substrate, \(1, 0\) in the substrate propagate",
    ):
        check_subwavelength(turned, WAVE)


DENSE = Index(3.7)
PLACES = {
    "pillar": {"pillar": DENSE},
    "between": {"between": DENSE},
    "substrate": {"substrate": DENSE},
    "cover": {"cover": DENSE},
    "under": {"under": (Film(Index(1.6), 0.1), Film(DENSE, 0.05))},
    "over": {"over": (Film(DENSE, 0.05),)},
    "layer": {"layers": (Layer(0.3), Layer(0.4, material=DENSE))},
    "layer between": {"layers": (Layer(0.3, between=DENSE), Layer(0.4))},
    "coat": {"layers": (Layer(0.3), Layer(0.4, coat_um=0.02, coat=DENSE))},
}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(
    ("lattice", "factor"),
    [
        (Lattice(), 1.0),
        (Lattice("rectangular", 1.6), 1 / 1.6),
        (Lattice("hexagonal"), 2 / math.sqrt(3)),
    ],
)
def test_the_densest_material_anywhere_in_a_cell_sets_the_pitch_without_resonances(
    place, lattice, factor
):
    """Its wavelength, over the longer period of a rectangle and by the rows of a
    hexagon, √3/2 apart.
    """
    rest = {
        "pillar": Index(2.2),
        "between": Index(1.1),
        "substrate": Index(1.46),
        "cover": Index(1.3),
    }
    cell = Cell(0.4, **(rest | PLACES[place]), lattice=lattice)
    assert no_resonance_um(cell, WAVE) == pytest.approx(factor * WAVE / 3.7, rel=1e-12)


@pytest.mark.parametrize("turn", [1, 3, 5, 7, 9, 11])
def test_hexagons_lit_along_a_shortest_vector_have_its_limit(turn):
    """Six of them, at odd multiples of 30 degrees, 2 / √3 of one over the pitch: |k
    sine + g| = n k.
    """
    cell = Cell(0.9, substrate=Index(1.45), lattice=Lattice("hexagonal"))
    limit = WAVE * 2 / math.sqrt(3) / (1.45 + 0.4)
    for sign in (1, -1):
        with pytest.raises(CellError, match=f"pitch_um < {limit:.6g}"):
            check_subwavelength(
                cell,
                WAVE,
                angle_rad=sign * math.asin(0.4),
                azimuth_rad=turn * math.pi / 6,
            )


@pytest.mark.parametrize(
    ("azimuth_deg", "limit"),
    [(0, 1 / 1.85), (180, 1 / 1.85), (90, 0.8 / 1.85), (270, 0.8 / 1.85)],
)
def test_rectangles_lit_along_an_axis_have_the_limit_of_the_axis_that_binds(
    azimuth_deg, limit
):
    """Period 1.25 of the pitch along y: lit along x, 1 / 1.85 there or 0.8 / √(1.45² -
    0.4²) = 1 / 1.742 along y.
    """
    cell = Cell(0.9, substrate=Index(1.45), lattice=Lattice("rectangular", 1.25))
    along = 0.8 / math.sqrt(1.45**2 - 0.4**2) if azimuth_deg % 180 == 0 else 1.0
    with pytest.raises(CellError, match=f"pitch_um < {WAVE * min(limit, along):.6g}"):
        check_subwavelength(
            cell, WAVE, angle_rad=math.asin(0.4), azimuth_rad=math.radians(azimuth_deg)
        )


def test_the_limit_of_light_along_a_diagonal_is_by_parts_along_and_across():
    """Sine 0.4 at 145 degrees on a square: |(-0.328 + g, 0.229)| = 1.45 for the order
    along x first.
    """
    along, across = 0.4 * math.cos(math.radians(145)), 0.4 * math.sin(math.radians(145))
    g = math.sqrt(1.45**2 - across**2) - along
    with pytest.raises(CellError, match=f"pitch_um < {WAVE / g:.6g}"):
        check_subwavelength(
            Cell(0.9, substrate=Index(1.45)),
            WAVE,
            angle_rad=math.asin(0.4),
            azimuth_rad=math.radians(145),
        )


def test_media_rarer_than_air_are_refused_by_name_too():
    """Light of sine 0.96 outside goes along the surface in an index of 0.9."""
    with pytest.raises(CellError, match=r"in the substrate.* need pitch_um < 0\.\d+"):
        check_subwavelength(
            Cell(2.0, substrate=Index(0.9), cover=Index(0.9)), WAVE, angle_rad=1.3
        )
