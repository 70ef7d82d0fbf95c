"""Sections of pillars: Fourier factors against sums over pixels, areas, mirrors, gaps,
bias, and the TOML of a cell.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell, Lattice, Layer
from metalens.cell.shapes import (
    Circle,
    Cross,
    Ellipse,
    Polygon,
    Rectangle,
    RegularPolygon,
    Ring,
    Square,
)
from metalens.core import config
from metalens.core.errors import CellError, ConfigError

TRIANGLE = ((-0.5, -0.3), (0.5, -0.3), (0.0, 0.6))
SHAPES = (
    Circle(),
    Ellipse(0.5, 0.3),
    Ring(0.4),
    Square(0.2),
    Rectangle(2.2, 0.4),
    Cross(0.3, 0.1),
    RegularPolygon(5, 0.2),
    Polygon(TRIANGLE, 0.3),
)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind)
def test_fourier_factors_and_area_against_a_sum_over_pixels(shape):
    outline, step = shape.outline(0.2, grow_um=0.013), 0.001
    axis = (np.arange(601) - 300) * step
    x, y = np.meshgrid(axis, axis)
    solid = outline.inside(x, y)
    # pixels on the rim are right or wrong at random
    edge = 4 * outline.radius_um * step * step**0.5
    assert abs(solid.sum() * step**2 - outline.area_um2) < 10 * edge
    for gx, gy in ((7.0, -11.0), (0.0, 23.0), (-31.0, 4.0), (0.0, 0.0)):
        wave = (solid * np.exp(-1j * (gx * x + gy * y))).sum() * step**2
        assert abs(outline.fourier(np.array(gx), np.array(gy)) - wave) < 10 * edge


@pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind)
def test_mask_polygon_keeps_the_area_and_the_cell_its_toml(shape):
    outline = shape.outline(0.31)
    made = 0.0
    for sign, corners in outline.polygons(48):
        x, y = corners.T
        made += sign * float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)
    assert abs(made - outline.area_um2) < 1e-12
    cell = Cell(
        0.5,
        shape=shape,
        lattice=Lattice("hexagonal"),
        layers=(Layer(0.1, 0.02), Layer(0.6, coat_um=0.01, coat="SiO2")),
    )
    assert config.loads(config.dumps(cell), Cell) == cell


@pytest.mark.parametrize(("grow_um", "parts"), [(0.1249, 2), (0.125, 1), (0.1251, 1)])
def test_a_ring_whose_hole_is_closed_is_a_disc(grow_um, parts):
    """Inner diameter 0.125 um, to both sides of and at the growth that closes it."""
    made = Ring(0.25).outline(0.5, grow_um=grow_um)
    assert len(made.parts) == parts
    inner = max(0.125 - grow_um, 0.0)
    assert made.area_um2 == pytest.approx(
        math.pi / 4 * ((0.5 + grow_um) ** 2 - inner**2)
    )


def test_areas_in_closed_form():
    assert Ellipse(0.5).outline(0.4).area_um2 == pytest.approx(math.pi * 0.2 * 0.1)
    assert Ring(0.25).outline(0.4).area_um2 == pytest.approx(
        math.pi * (0.2**2 - 0.05**2)
    )
    assert Rectangle(2.5, 0.7).outline(0.2, grow_um=0.02).area_um2 == pytest.approx(
        0.22 * 0.52
    )
    assert Cross(0.3).outline(0.5).area_um2 == pytest.approx(2 * 0.5 * 0.15 - 0.15**2)
    assert RegularPolygon(6).outline(0.4).area_um2 == pytest.approx(
        1.5 * math.sqrt(3) * 0.2**2
    )


def test_mirrors_and_half_turns():
    assert Rectangle(2.0).outline(0.2).keeps(-1, 1)
    turned = Rectangle(2.0, 0.3).outline(0.2)
    assert not turned.keeps(-1, 1)
    assert turned.keeps(-1, -1)
    assert not Polygon(TRIANGLE).outline(0.2).keeps(1, -1)
    assert Polygon(TRIANGLE).outline(0.2).keeps(-1, 1)


def test_gap_to_the_neighbours_and_touching():
    assert Cell(0.5).gap_um(0.2) == pytest.approx(0.3, abs=0.003)
    assert Cell(0.5, shape=Rectangle(2.0)).gap_um(0.2) == pytest.approx(0.1, abs=0.003)
    assert Cell(0.5, shape=Square(math.pi / 4)).gap_um(0.3) == pytest.approx(
        0.5 - 0.3 * math.sqrt(2), abs=0.003
    )
    assert Cell(0.5, lattice=Lattice("rectangular", 0.6)).gap_um(0.2) == pytest.approx(
        0.1, abs=0.003
    )
    assert Cell(0.5, shape=Square()).gap_um(0.55) == 0.0


def test_a_cell_without_a_shape_is_a_round_pillar_and_old_text_still_reads():
    cell = config.loads('pitch_um = 0.4\npillar = "Si"\n', Cell)
    assert cell.round
    assert cell.shape == Circle()
    assert not Cell(0.4, shape=Circle(hole=True)).round


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('kind = "circel"', "did you mean 'circle'"),
        ("ratio = 2.0", "shape.kind is None"),
        ('kind = "rectangle"\nratio = 0.0', "rectangle ratio"),
        (
            'kind = "polygon"\ncorners = [[0, 0], [1, 1], [1, 0], [0, 1]]',
            "edges 0 and 2 cross",
        ),
    ],
)
def test_bad_shapes_are_refused_with_the_key(text, message):
    with pytest.raises((CellError, ConfigError), match=message):
        config.loads(f"pitch_um = 0.4\n[shape]\n{text}\n", Cell)


def test_layers_must_add_up():
    with pytest.raises(CellError, match=r"add up to 0.3 um, height_um is 0.7"):
        Cell(0.4, layers=(Layer(0.3),))


def test_bias_that_eats_the_outline_is_refused():
    with pytest.raises(CellError, match="loses an edge"):
        Cross(0.2).outline(0.1, grow_um=-0.03)
    with pytest.raises(CellError, match="nothing is left"):
        Circle().outline(0.1, grow_um=-0.1)


U = (
    (-0.5, -0.5),
    (0.5, -0.5),
    (0.5, 0.5),
    (0.2, 0.5),
    (0.2, -0.2),
    (-0.3, -0.2),
    (-0.3, 0.5),
    (-0.5, 0.5),
)


@pytest.mark.parametrize(
    ("shape", "width", "space"),
    [
        (Circle(), 0.3, math.inf),
        (
            Ellipse(0.3, 0.7),
            0.09,
            math.inf,
        ),  # its shortest chord at right angles to a rim is shorter, and no width
        (Ring(0.4), 0.09, 0.12),
        (Square(0.2), 0.3, math.inf),
        (
            Cross(0.3, 0.1),
            0.09,
            math.inf,
        ),  # sides of two arms stand at right angles and face nowhere
        (RegularPolygon(6, 0.2), 0.15 * math.sqrt(3), math.inf),
        (
            Polygon(TRIANGLE),
            0.3 * 1.0 * 0.9 / math.hypot(0.5, 0.9),
            math.inf,
        ),  # the height on its longest edge
        (Polygon(U, 0.4), 0.06, 0.15),
    ],
    ids=lambda s: getattr(s, "kind", None),
)
def test_walls_bars_holes_and_hollows_are_as_wide_as_they_are(shape, width, space):
    """Sizes of 0.3: by hand from the corners; curves are 64 edges of the same area
    (1e-3 of a radius).
    """
    found = shape.outline(0.3).spans_um
    assert found == pytest.approx((width, space), rel=1e-3)
    cell = Cell(0.5, shape=shape)
    if not cell.round:  # what a process prints: 80 nm of width, 70 of space
        assert cell.size_um(0.08, 0.07) == pytest.approx(
            0.3 * max(0.08 / width, 0.07 / space), rel=1e-3
        )
