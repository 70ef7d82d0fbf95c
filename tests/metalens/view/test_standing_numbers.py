"""Pillars of small oblong lenses as they are drawn: places, nearest sites, bands and
pixels, counted by hand.
"""

import dataclasses
import math

import numpy as np
import pytest

from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes import Rectangle
from metalens.lens import DiameterMap, Lens
from metalens.proxy import Proxy
from metalens.view import standing

ABOUT = {
    "wavelength_um": 0.85,
    "sensor_distance_um": 30.0,
    "source_distance_um": math.inf,
    "profile": "hyperbolic",
}
PROXY = Proxy(
    np.array([[1.3, 2.9]]), np.array([[0.9, 0.0]]), (0.08, 0.24), (0.85, 0.85), 0.0, 0.0
)
SIZES = np.array(
    [[0.101, 0.0, 0.152, 0.101], [0.203, 0.152, 0.101, 0.0], [0.0, 0.203, 0.101, 0.239]]
)


def lens(sizes=SIZES, cell=None, **more):
    return Lens(
        DiameterMap(sizes, 0.4, **more),
        cell or Cell(0.4, 0.7, Index(3.6)),
        PROXY,
        **ABOUT,
    )


def test_pillars_of_one_kind_are_drawn_together_where_they_stand():
    """Columns at -600, -200, 200, 600 nm, rows at -400, 0, 400."""
    found = standing.drawn(lens())
    places = {o.notes["size / nm"]: o.places.tolist() for o in found.outlines}
    assert places == {
        101: [[-600, -400], [600, -400], [200, 0], [200, 400]],
        152: [[200, -400], [-200, 0]],
        203: [[-600, 0], [-200, 400]],
        239: [[600, 400]],
    }
    for outline in found.outlines:
        assert set(outline.notes) == {"size / nm"}
        assert np.hypot(*outline.corners.T).max() == pytest.approx(
            outline.notes["size / nm"] / 2, rel=0.02
        )
        assert len(outline.corners) == 24
    assert found.unit_um == 1e-3
    assert found.caption.startswith("9 pillars, each a ")
    assert "middle of a larger" not in found.caption


def test_bands_share_out_the_range_of_whole_numbers_and_say_their_ends():
    """From 7 to 130: six steps of 20.67, at 7, 28, 48, 69, 90, 110 and 131, padded to
    three digits.
    """
    values = np.array([7, 27, 28, 47, 48, 68, 69, 89, 90, 109, 110, 130])
    want = [
        "007 to 027",
        "028 to 047",
        "048 to 068",
        "069 to 089",
        "090 to 109",
        "110 to 130",
    ]
    assert standing._bands(values, "nm") == [
        f"{name} nm" for name in want for _ in range(2)
    ]
    assert standing._bands(np.array([5, 5]), "deg") == ["5 to 5 deg"] * 2
    assert standing._bands(np.array([9, 11, 10]), "nm") == [
        "09 to 09 nm",
        "11 to 11 nm",
        "10 to 10 nm",
    ]


def test_turned_rectangles_of_two_sizes_carry_turn_and_length():
    angle = np.radians(np.array([[10.4, 75.0], [140.0, 10.3]]))
    sizes = np.full((2, 2), 0.2301)
    cell = Cell(0.41, 0.5, Index(3.6), shape=Rectangle(0.5))
    made = Lens(
        DiameterMap(sizes, 0.41, angle_rad=angle), cell, PROXY, **ABOUT, hand="right"
    )
    found = standing.drawn(made)
    assert {o.notes["turn / deg"]: len(o.places) for o in found.outlines} == {
        10: 2,
        75: 1,
        140: 1,
    }
    assert {o.notes["size / nm"] for o in found.outlines} == {230}
    for outline in found.outlines:
        turn = math.radians(outline.notes["turn / deg"])
        x, y = outline.corners.T
        along = (
            x * math.cos(turn) + y * math.sin(turn),
            y * math.cos(turn) - x * math.sin(turn),
        )
        assert np.ptp(along[0]) == pytest.approx(230, rel=1e-9)
        assert np.ptp(along[1]) == pytest.approx(115, rel=1e-9)


@pytest.mark.parametrize("kind", ["rectangular", "hexagonal"])
def test_places_belong_to_the_site_that_is_nearest_of_all(kind):
    """Of 5 x 8 sites, or of every other one, by all distances; far outside too."""
    sizes = np.full((5, 8), 0.15)
    if kind == "hexagonal":
        sizes[np.add.outer(np.arange(5), np.arange(8)) % 2 == 1] = 0.0
    d = DiameterMap(
        sizes, 0.4, Lattice(kind, *([1.3] if kind == "rectangular" else []))
    )
    rng = np.random.default_rng(3)
    y, x = rng.uniform(-1.6, 1.6, 300), rng.uniform(-1.9, 1.9, 300)
    row, column = standing.nearest(d, y, x)
    sites = np.argwhere(sizes > 0)
    away = np.hypot(d.y_um[sites[:, 0]] - y[:, None], d.x_um[sites[:, 1]] - x[:, None])
    got = np.hypot(d.y_um[row] - y, d.x_um[column] - x)
    inside = (np.abs(y) < d.y_um[-1]) & (np.abs(x) < d.x_um[-1])
    assert inside.sum() > 50
    assert got[inside] == pytest.approx(away.min(1)[inside], abs=1e-12)
    assert sizes[row, column].min() > 0
    if kind == "rectangular":
        assert got == pytest.approx(away.min(1), abs=1e-12)


def test_the_phase_is_shown_on_pixels_of_the_finer_step_about_the_axis():
    """Rows 0.52 um apart, columns 0.4: pixels of 0.4, two to either side; nothing where
    no pillar is.
    """
    made = lens(lattice=Lattice("rectangular", 1.3))
    found = standing.phase(made)
    assert found.step_um == pytest.approx(0.4)
    assert found.values.shape == (1, 5, 5)
    d = made.diameters
    turns = np.mod(made.phase_rad() / (2 * np.pi), 1)
    for i, y in enumerate((np.arange(5) - 2) * 0.4):
        for j, x in enumerate((np.arange(5) - 2) * 0.4):
            row = int(np.argmin(np.abs(d.y_um - y)))
            near = np.flatnonzero(
                np.abs(np.abs(d.x_um - x) - np.abs(d.x_um - x).min()) < 1e-9
            )
            want = [
                turns[row, c] if d.diameter_um[row, c] > 0 else 0.0 for c in near
            ]  # columns lie half-way between
            assert min(abs(found.values[0, i, j] - w) for w in want) < 1e-12
    assert [list(axis.values) for axis in found.axes] == [["any"]]
    handed = dataclasses.replace(made, hand="left", diameters=dataclasses.replace(
        made.diameters, angle_rad=np.zeros((3, 4))), cell=Cell(0.4, 0.7, Index(3.6), shape=Rectangle(0.5),
                                                                lattice=Lattice("rectangular", 1.3)))  # fmt: skip
    assert [list(axis.values) for axis in standing.phase(handed).axes] == [["left"]]


def test_the_phase_of_a_large_lens_has_five_hundred_and_twelve_pixels_along_its_longer_side():
    """1201 sites of 0.4 um along x: 480 um, in steps of 0.9375; 256 to either side, and
    7 of 6 um along y.
    """
    found = standing.phase(lens(np.full((31, 1201), 0.15)))
    assert found.step_um == pytest.approx(480 / 512)
    assert found.values.shape == (1, 2 * 7 + 1, 2 * 256 + 1)
    tall = standing.phase(lens(np.full((1201, 31), 0.15)))
    assert tall.step_um == pytest.approx(480 / 512)
    assert tall.values.shape == (1, 2 * 256 + 1, 2 * 7 + 1)
