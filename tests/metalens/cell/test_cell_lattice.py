"""Lattices by counting shells, reciprocal vectors by a search, sections that grow,
polygons that cross.
"""

import itertools
import math

import numpy as np
import pytest

from metalens.cell import Cell, Lattice, Layer
from metalens.cell.orders import check_subwavelength, propagating_orders
from metalens.cell.record import Index
from metalens.cell.shapes import (
    Circle,
    Ellipse,
    Polygon,
    Rectangle,
    RegularPolygon,
    Ring,
    Square,
)
from metalens.core import config
from metalens.core.errors import CellError

LATTICES = (
    Lattice(),
    Lattice("rectangular", 1.7),
    Lattice("rectangular", 0.6),
    Lattice("hexagonal"),
)


@pytest.mark.parametrize("lattice", LATTICES, ids=lambda v: f"{v.kind}{v.ratio}")
def test_sites_around_one_fill_every_shell_that_is_near(lattice):
    """Against all sums of two basis vectors: each once, nearest first, none missing
    within two of the shorter.
    """
    pitch = 0.43
    along = np.array([pitch, 0.0])
    up = np.array([0.0, lattice.ratio * pitch])
    if lattice.kind == "hexagonal":
        up = np.array([pitch / 2, math.sqrt(0.75) * pitch])
    every = [
        i * along + j * up
        for i, j in itertools.product(range(-9, 10), repeat=2)
        if i or j
    ]
    reach = 2.001 * min(pitch, float(np.hypot(*up)))
    want = sorted(
        tuple(np.round(site, 9) + 0.0) for site in every if np.hypot(*site) < reach
    )
    made = lattice.steps_um(pitch)
    distances = np.hypot(*np.array(made).T)
    assert (np.diff(distances) > -1e-12).all()
    near = [
        tuple(np.round(site, 9) + 0.0)
        for site, d in zip(made, distances, strict=True)
        if d < reach
    ]
    assert sorted(near) == want
    assert lattice.area_um2(pitch) == pytest.approx(
        abs(along[0] * up[1] - along[1] * up[0]), rel=1e-12
    )


@pytest.mark.parametrize("lattice", LATTICES, ids=lambda v: f"{v.kind}{v.ratio}")
def test_the_least_order_is_the_shortest_reciprocal_vector(lattice):
    """Columns of 2 pi A^-1 over 2 pi / pitch, shortest of their sums."""
    rows = [
        [1.0, 0.0],
        [0.5, math.sqrt(0.75)] if lattice.kind == "hexagonal" else [0.0, lattice.ratio],
    ]
    dual = np.linalg.inv(np.array(rows)).T
    sums = [
        i * dual[0] + j * dual[1]
        for i, j in itertools.product(range(-3, 4), repeat=2)
        if i or j
    ]
    assert lattice.least_order == pytest.approx(
        min(np.hypot(*s) for s in sums), rel=1e-12
    )


def test_shapes_alike_along_x_and_y_follow_their_lattice():
    hexagonal = Lattice("hexagonal")
    assert Cell(0.5, shape=Square()).is_isotropic
    assert not Cell(0.5, shape=Rectangle(1.3)).is_isotropic
    assert not Cell(0.5, shape=RegularPolygon(5)).is_isotropic
    assert Cell(0.5, shape=RegularPolygon(6), lattice=hexagonal).is_isotropic
    # by thirds of a turn
    assert Cell(0.5, shape=RegularPolygon(3, 0.2), lattice=hexagonal).is_isotropic
    assert not Cell(0.5, shape=RegularPolygon(4), lattice=hexagonal).is_isotropic
    assert not Cell(0.5, lattice=Lattice("rectangular", 1.2)).is_isotropic


def test_sections_that_grow_in_closed_form():
    """grow is of the whole width: 0.03 on 0.4 is 0.43; a hole in the section closes by
    as much.
    """
    assert Circle().outline(0.4, grow_um=0.03).area_um2 == pytest.approx(
        math.pi / 4 * 0.43**2
    )
    assert Ellipse(0.5).outline(0.4, grow_um=0.03).area_um2 == pytest.approx(
        math.pi / 4 * 0.43 * 0.23
    )
    ring = Ring(0.25).outline(0.4, grow_um=0.03)
    assert ring.area_um2 == pytest.approx(math.pi / 4 * (0.43**2 - 0.07**2))
    assert len(Ring(0.25).outline(0.4, grow_um=0.11).parts) == 1


def test_the_widest_pillar_leaves_the_gap_that_was_asked_for():
    """A square of edge a on a pitch p leaves p - a along both axes; on its corner p - a
    sqrt(2).
    """
    assert Cell(0.61).widest_um(0.13) == pytest.approx(0.48)
    assert Cell(0.61, shape=Square()).widest_um(0.13) == pytest.approx(0.48, abs=0.004)
    assert Cell(0.61, shape=Square(math.pi / 4)).widest_um(0.13) == pytest.approx(
        0.48 / math.sqrt(2), abs=0.004
    )


def test_sizes_end_where_a_foot_a_pedestal_or_a_coat_comes_near_and_where_a_top_closes():
    """By hand: a wall of 0.1 rad over 0.7 is 0.7 tan(0.1) = 70 nm wider at its foot and
    as much less at its top, a coat
    of 20 nm adds 40; a fiftieth of the pitch is left between neighbours, and of the
    top."""
    slant, pitch = 0.7 * math.tan(0.1), 0.32
    for tilt in (0.1, -0.1):
        wall = Cell(pitch, 0.7, sidewall_rad=tilt)
        assert wall.widest_um(0.06) == pytest.approx(0.98 * pitch - slant)
        assert wall.size_um(0.05) == pytest.approx(slant + 0.02 * pitch)
        assert wall.size_um(0.09) == 0.09
    assert Cell(pitch, 0.3, sidewall_rad=0.1).widest_um(0.06) == pytest.approx(
        pitch - 0.06
    )  # the foot is 36 nm away
    pedestal = (
        Layer(0.1, grow_um=0.05, coat_um=0.02, coat=Index(1.5)),
        Layer(0.6, grow_um=-0.04),
    )
    layered = Cell(pitch, 0.7, shape=Square(), layers=pedestal)
    assert layered.widening_um == pytest.approx((-0.04, 0.09))
    # the boundary is stepped
    assert layered.widest_um(0.06) == pytest.approx(0.98 * pitch - 0.09, abs=0.002)
    assert layered.size_um(0.03) == pytest.approx(0.04 + 0.02 * pitch)


def crossing(a, b, c, d):
    """Whether segments a-b and c-d meet: a + s (b - a) = c + t (d - c) with s and t
    from 0 to 1.
    """
    matrix = np.column_stack([b - a, c - d])
    if abs(np.linalg.det(matrix)) < 1e-12:
        return False
    s, t = np.linalg.solve(matrix, c - a)
    return 0 <= s <= 1 and 0 <= t <= 1


def test_polygons_that_cross_are_those_whose_edges_share_a_point():
    random, seen = np.random.default_rng(8), set()
    for _ in range(300):
        corners = random.uniform([-1.0, 0.3], [1.7, 0.9], (5, 2))
        edges = [(corners[i], corners[(i + 1) % 5]) for i in range(5)]
        apart = [(i, j) for i in range(5) for j in range(i + 2, 5 - (i == 0))]
        crosses = any(crossing(*edges[i], *edges[j]) for i, j in apart)
        seen.add(crosses)
        if crosses:
            with pytest.raises(CellError, match="cross"):
                Polygon(tuple(map(tuple, corners)))
        else:
            Polygon(tuple(map(tuple, corners)))
    assert seen == {True, False}
    for touching in (
        ((0, 0), (4, 0), (4, 3), (2, 0), (0, 3)),
        ((4, 3), (2, 0), (0, 3), (0, 0), (4, 0)),
    ):
        with pytest.raises(CellError, match="cross"):
            Polygon(tuple((float(x), float(y)) for x, y in touching))


def test_the_pitch_named_for_light_aslant_in_azimuth_is_the_limit():
    """Light of 60 degrees at azimuth 0.6: order (-1, 0) goes out below g = kx + sqrt(n²
    - ky²), 4 % under n + kx.
    """
    angle, azimuth, wave, n = math.radians(60), 0.6, 0.85, 1.45
    kx = math.sin(angle) * math.cos(azimuth)
    ky = math.sin(angle) * math.sin(azimuth)
    true = wave / (kx + math.sqrt(n**2 - ky**2))

    def cell(pitch_um):
        return Cell(pitch_um, pillar=Index(3.6), cover=Index(n), substrate=Index(1.0))

    with pytest.raises(CellError, match="need pitch_um <") as refused:
        check_subwavelength(
            cell(true * 1.0001), wave, angle_rad=angle, azimuth_rad=azimuth
        )
    named = float(str(refused.value).rpartition("pitch_um < ")[2].partition(",")[0])
    assert named == pytest.approx(true, rel=1e-5)  # six digits
    check_subwavelength(cell(true * 0.9999), wave, angle_rad=angle, azimuth_rad=azimuth)
    assert (
        len(
            propagating_orders(
                cell(true * 1.0001), wave, angle_rad=angle, azimuth_rad=azimuth
            )
        )
        == 3
    )


def test_a_cap_narrower_than_its_pillar_is_read_and_comes_back_from_its_own_text():
    """20 nm narrower, on a pedestal 30 nm wider."""
    text = (
        "pitch_um = 0.4\nheight_um = 0.75\n[[layers]]\nheight_um = 0.05\ngrow_um = 0.03\n[[layers]]\nheight_um = 0.6\n"
        "[[layers]]\nheight_um = 0.1\ngrow_um = -0.02\nmaterial = 'SiO2'\n"
    )
    cell = config.loads(text, Cell, where="cell.toml")
    assert cell.widening_um == pytest.approx((-0.02, 0.03))
    assert config.loads(config.dumps(cell), Cell, where="again") == cell
