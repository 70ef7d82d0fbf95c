"""The sections of a pillar as it is made: heights, widths and polynomials in height
against their formulas.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell, Index
from metalens.cell.record import Layer
from metalens.cell.shapes import Rectangle
from metalens.core.errors import CellError
from metalens.rcwa import made, pattern

LAYERS = (Layer(0.12, 0.03), Layer(0.4), Layer(0.08, -0.02))
STACK = Cell(0.5, 0.6, Index(3.3), Index(1.47), sidewall_rad=0.05, layers=LAYERS)
PLAIN = Cell(0.5, 0.6, Index(3.3), Index(1.47), sidewall_rad=0.05)


def test_a_tilted_wall_widens_every_section_by_its_middle():
    """Middles at 0.06, 0.32 and 0.56 um of 0.6: the foot is wider by 2 tan(tilt) for
    each um below 0.3.
    """
    slope = 2 * math.tan(0.05)
    got = made.sections_with_growth(STACK)
    assert [layer for layer, _ in got] == list(LAYERS)
    assert [grow for _, grow in got] == pytest.approx(
        [0.24 * slope, -0.02 * slope, -0.26 * slope]
    )
    assert made.sections_with_growth(PLAIN)[0][1] == pytest.approx(0.0, abs=1e-15)
    assert made.width_slope(PLAIN) == pytest.approx(-slope)


def test_sections_are_cut_at_their_share_of_the_height(monkeypatch):
    """Foot to top of a section: its own widening times half its height to both sides;
    heights times k0.
    """
    asked = []

    def slab(cell, layer, size_um, wavelength_um, *, grow_um):
        asked.append((layer, size_um, wavelength_um, grow_um))
        return grow_um

    monkeypatch.setattr(made.pattern, "pillar_section", slab)
    monkeypatch.setattr(made, "interpolate_operators", lambda sample: sample)
    walls = made.section_walls(STACK, 0.21, 0.85, lambda grow: (grow, 2 * grow))
    assert [wall.reduced_height for wall in walls] == pytest.approx(
        [2 * math.pi / 0.85 * h for h in (0.12, 0.4, 0.08)]
    )
    slope = -2 * math.tan(0.05)
    for wall, layer, middle in zip(walls, LAYERS, (-0.24, 0.02, 0.26), strict=True):
        for share in (0.0, 0.3, 1.0):
            want = slope * (middle + (share - 0.5) * layer.height_um)
            assert wall.sample(share) == pytest.approx((want, 2 * want))
            assert asked[-1][:3] == (layer, 0.21, 0.85)


def test_upright_walls_are_not_interpolated(monkeypatch):
    monkeypatch.setattr(made, "interpolate_operators", lambda sample: None)
    monkeypatch.setattr(made.pattern, "pillar_section", lambda *_, grow_um: grow_um)
    upright = Cell(0.5, 0.6, Index(3.3), layers=LAYERS)
    assert [
        w.sample(0.8)
        for w in made.section_walls(upright, 0.21, 0.85, lambda grow: (grow, grow))
    ] == [(0, 0)] * 3
    assert [
        w.sample
        for w in made.section_walls(STACK, 0.21, 0.85, lambda grow: (grow, grow))
    ] == [None] * 3


def test_polynomials_through_eight_heights_hold_what_has_degree_seven():
    """Chebyshev points of the first kind between foot and top, asked for once."""
    seen = []
    one, other = (
        np.polynomial.Polynomial(v)
        for v in ([1, -2, 0.3, 4, -1, 2, -3, 0.7], [0.5, 1, 1, -1, 0, 2, 5, -4])
    )

    def sample(share):
        seen.append(share)
        return np.array([[one(share), 2.0]]), np.array([other(share)])

    at = made.interpolate_operators(sample)
    assert seen == []
    for share in (0.0, 0.17, 0.5, 0.93, 1.0):
        first, second = at(share)
        assert first == pytest.approx(np.array([[one(share), 2.0]]), abs=1e-12)
        assert second == pytest.approx([other(share)], abs=1e-12)
    assert sorted(seen) == pytest.approx(
        (1 - np.cos(np.pi * (np.arange(8) + 0.5) / 8)) / 2
    )
    # the next power is missed by its Chebyshev part, 2 / 4^8 of the height^8
    worst = max(
        abs(
            made.interpolate_operators(lambda s: (np.array([s**8]),) * 2)(x)[0][0]
            - x**8
        )
        for x in np.linspace(0, 1, 99)
    )
    assert worst == pytest.approx(2 / 4**8, rel=1e-3)


@pytest.mark.parametrize(
    ("cell", "size", "fits"),
    [
        # foot of a plain tilted wall: size + 0.6 tan(0.05) = size + 0.03003
        (PLAIN, 0.4699, True),
        (PLAIN, 0.4701, False),
        # the pedestal: 0.03 wider, and its foot (0.24 + 0.06) x 2 tan(0.05) = 0.03003
        (STACK, 0.4398, True),
        (STACK, 0.4401, False),
        # a film of 8 nm on both sides
        (
            Cell(
                0.5,
                0.6,
                Index(3.3),
                layers=(Layer(0.6, 0.01, coat_um=0.008, coat=Index(2.0)),),
            ),
            0.4739,
            True,
        ),
        (
            Cell(
                0.5,
                0.6,
                Index(3.3),
                layers=(Layer(0.6, 0.01, coat_um=0.008, coat=Index(2.0)),),
            ),
            0.4741,
            False,
        ),
    ],
)
def test_the_widest_place_of_any_section_must_not_touch_its_neighbour(cell, size, fits):
    if fits:
        made.check_size(cell, size)
    else:
        with pytest.raises(
            CellError, match=r"touches its neighbour on a pitch of 0\.5 um"
        ):
            made.check_size(cell, size)


def test_walls_that_lean_outwards_are_widest_at_their_top():
    cell = Cell(
        0.5,
        0.6,
        Index(3.3),
        sidewall_rad=-0.05,
        layers=(Layer(0.45), Layer(0.15, 0.02)),
    )
    made.check_size(cell, 0.4498)  # 0.02 and 0.3 x 2 tan(0.05)
    with pytest.raises(CellError, match=r"0\.05003 um wider"):
        made.check_size(cell, 0.4501)
    for wrong in (0.0, -0.1, math.nan, math.inf):
        with pytest.raises(CellError, match="need a finite length above 0"):
            made.check_size(cell, wrong)


def test_a_section_s_slab_is_wider_by_its_own_and_by_what_is_asked():
    """Rectangles of 0.21 x 0.14 um grow along both edges; the film is outside of the
    pillar, inside of a hole.
    """
    layer = Layer(0.6, 0.03, Index(2.2), Index(1.3), 0.01, Index(1.9))
    for hole in (False, True):
        cell = Cell(
            0.5, 0.6, Index(3.3), shape=Rectangle(2 / 3, hole=hole), layers=(layer,)
        )
        this = pattern.pillar_section(cell, layer, 0.21, 0.85, grow_um=0.02)
        wide = (0.05 - 0.02, 0.05) if hole else (0.05, 0.05 + 0.02)
        want = [(0.21 + w) * (0.14 + w) for w in wide]
        assert [outline.area_um2 for outline in this.outlines] == pytest.approx(
            want, rel=1e-6
        )
        pillar, around = (1.3, 2.2) if hole else (2.2, 1.3)
        assert this.inside == pytest.approx((pillar**2, 1.9**2))
        assert this.outside == pytest.approx(around**2)
