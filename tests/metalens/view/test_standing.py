"""Pillars drawn as they stand: every site of a hexagonal lens once, where the lattice
has it, and every turn.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes import Rectangle
from metalens.lens import DiameterMap, Lens, save
from metalens.proxy import Proxy
from metalens.view import artefacts, standing

ABOUT = {
    "wavelength_um": 0.85,
    "sensor_distance_um": 30.0,
    "source_distance_um": math.inf,
    "profile": "hyperbolic",
}
PROXY = Proxy(
    np.array([[1.3, 2.9]]), np.array([[0.9, 0.0]]), (0.08, 0.24), (0.85, 0.85), 0.0, 0.0
)


def hexagonal(rows=9, columns=13):
    row, column = np.indices((rows, columns))
    size = np.where((row + column) % 2 == 0, 0.09 + 0.003 * row + 0.007 * column, 0.0)
    size[0, 0] = 0.0
    made = DiameterMap(
        size.astype(np.float32), 0.336, Lattice("hexagonal"), row_um=0.291
    )
    cell = Cell(0.336, 0.7, Index(3.6), lattice=Lattice("hexagonal"))
    return Lens(made, cell, PROXY, **ABOUT)


def test_every_pillar_of_a_hexagonal_lens_is_drawn_on_its_site():
    lens = hexagonal()
    d = lens.diameters
    panel = standing.draw_pillars(lens)
    places = np.concatenate([o.places for o in panel.outlines])
    there = d.diameter_um > 0
    want = np.stack(np.meshgrid(d.x_um, d.y_um), axis=-1)[there]
    assert sorted(map(tuple, places.tolist())) == sorted(
        map(tuple, np.rint(1e3 * want).astype(int).tolist())
    )
    for outline in (
        panel.outlines
    ):  # each has the area of its disc, to the rounding of its size to 1 nm
        x, y = outline.corners.T
        area = abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2
        assert area == pytest.approx(
            math.pi / 4 * outline.notes["size / nm"] ** 2, rel=1e-6
        )
    far = places[:, None] - places[None]
    apart = np.hypot(far[..., 0], far[..., 1])
    assert apart[apart > 0].min() == pytest.approx(
        336, abs=1
    )  # rows on a grid of 1 nm: 336.0 along x and 60 deg off


def test_a_pixel_shows_the_phase_of_the_nearest_site_of_the_lattice():
    lens = hexagonal()
    d = lens.diameters
    sites = np.argwhere(np.add.outer(np.arange(9), np.arange(13)) % 2 == 0)
    at = np.random.default_rng(11).uniform(
        (-1.2, -1.0), (1.2, 1.0), (300, 2)
    )  # inside the outermost sites
    row, column = standing.nearest_site(d, at[:, 0], at[:, 1])
    assert ((row + column) % 2 == 0).all()
    found = np.hypot(d.y_um[row] - at[:, 0], d.x_um[column] - at[:, 1])
    best = np.hypot(
        d.y_um[sites[:, 0], None] - at[:, 0], d.x_um[sites[:, 1], None] - at[:, 1]
    ).min(axis=0)
    assert np.abs(found - best).max() < 1e-12
    image = standing.draw_phase(lens)
    turns = np.mod(lens.phase_rad() / (2 * np.pi), 1)
    assert set(np.round(np.unique(image.values), 9)) <= set(
        np.round(np.unique(turns), 9)
    ) | {0.0}


def test_turned_rectangles_are_drawn_turned_and_coloured_by_their_turn(tmp_path):
    angle = np.radians([[10.0, 75.0], [140.0, 33.0]]).astype(np.float32)
    made = DiameterMap(np.full((2, 2), 0.23, np.float32), 0.41, angle_rad=angle)
    lens = Lens(
        made,
        Cell(0.41, 0.5, Index(3.6), shape=Rectangle(0.5)),
        PROXY,
        **ABOUT,
        hand="right",
    )
    save(tmp_path / "lens.h5", lens)
    panel = artefacts.lens_panels(tmp_path / "lens.h5")[0]
    for outline in panel.outlines:
        side = outline.corners[1] - outline.corners[0]
        longest = (
            side if np.hypot(*side) > 200 else outline.corners[2] - outline.corners[1]
        )
        assert np.degrees(np.arctan2(longest[1], longest[0])) % 180 == pytest.approx(
            outline.notes["turn / deg"]
        )
        x, y = outline.places[0]
        column, row = int(x > 0), int(y > 0)
        assert np.degrees(angle[row, column]) == pytest.approx(
            outline.notes["turn / deg"], abs=1e-4
        )
    assert len({o.layer for o in panel.outlines}) == 4


def test_of_a_lens_too_large_for_a_page_the_square_about_its_middle_is_drawn(
    monkeypatch,
):
    """40 sites of 0.3 um by 0.3 um: those within 0.95 um of the axis along x and along
    y; an oblong lens.
    """
    size = np.full((31, 18), 0.15, np.float32)
    lens = Lens(DiameterMap(size, 0.3), Cell(0.3, 0.7, Index(3.6)), PROXY, **ABOUT)
    monkeypatch.setattr(standing, "MOST_DRAWN", 40)
    places = np.concatenate([o.places for o in standing.draw_pillars(lens).outlines])
    x, y = np.meshgrid(lens.diameters.x_um, lens.diameters.y_um)
    inside = (np.abs(x) <= 0.949) & (np.abs(y) <= 0.949)
    want = np.rint(1e3 * np.stack([x[inside], y[inside]], axis=-1)).astype(int)
    assert sorted(map(tuple, places.tolist())) == sorted(map(tuple, want.tolist()))
    assert len(want) == 7 * 6
