"""Phase and transmission of a lens by its table or its proxy, for both lights, of some
rows, with turns and gaps.
"""

import math

import numpy as np
import pytest

from metalens.cell import Cell
from metalens.cell.shapes import Rectangle
from metalens.lens import DiameterMap, Lens, TwoSizeTable
from metalens.library import Proxy

DRAW = np.random.default_rng(23)
X = 0.1 + 0.02 * np.arange(4)
Y = 0.15 + 0.05 * np.arange(3)
WAVES = np.array([0.78, 0.85])
T = DRAW.uniform(0.3, 1.6, (2, 4, 3, 2)) * np.exp(
    1j * DRAW.uniform(-3, 3, (2, 4, 3, 2))
)
ROW, COLUMN = DRAW.integers(0, 4, (5, 6)), DRAW.integers(0, 3, (5, 6))
GAP = (3, 1)


def two_sizes(light):
    x, y = X[ROW], Y[COLUMN]
    x[GAP] = y[GAP] = 0
    diameters = DiameterMap(x, 0.4, length_um=y)
    pairs = TwoSizeTable(WAVES, X, Y, T, (210.0, 900.0))
    cell = Cell(0.4, shape=Rectangle())
    return Lens(
        diameters,
        cell,
        pairs.proxy,
        0.85,
        170.0,
        700.0,
        "map",
        pairs=pairs,
        light=light,
    )


@pytest.mark.parametrize("light", ["x", "y"])
@pytest.mark.parametrize(("wave", "number"), [(None, 1), (0.78, 0)])
def test_pillars_of_two_sizes_have_phase_and_level_of_their_entries(
    light, wave, number
):
    """Some entries are above 1 by what a table may err: no pillar sends on more light
    than it gets.
    """
    lens = two_sizes(light)
    t = T[number, ROW, COLUMN, "xy".index(light)]
    t[GAP] = 0
    assert (np.abs(t) > 1).any()
    level = lens.transmission(wave)
    assert level.dtype == float
    assert np.array_equal(level, np.minimum(np.abs(t), 1.0))
    assert lens.phase_rad(wave) == pytest.approx(np.angle(t), abs=1e-15)
    assert lens.phase_rad(wave, rows=slice(1, 4)) == pytest.approx(
        np.angle(t[1:4]), abs=1e-15
    )


def test_a_lens_seen_in_its_other_light_focuses_where_that_does_and_comes_back():
    lens = two_sizes("x")
    assert lens.for_polarization("x") is lens
    other = lens.for_polarization("y")
    assert (other.light, other.sensor_distance_um, other.source_distance_um) == (
        "y",
        210.0,
        900.0,
    )
    assert np.array_equal(other.transmission(), two_sizes("y").transmission())
    back = other.for_polarization("x")
    assert (
        back.sensor_distance_um,
        back.source_distance_um,
        back.pairs.focus_y_um,
    ) == (170.0, 700.0, (210.0, 900.0))


@pytest.mark.parametrize(("hand", "turns"), [("left", -2), ("right", 2)])
def test_a_turned_pillar_adds_twice_its_turn_by_the_hand_of_the_light(hand, turns):
    """Phase 0.4 + 3.1 D at 0.85 um, level 0.93; a site without a pillar has neither,
    nor a turn's phase.
    """
    proxy = Proxy(
        np.array([[0.4], [3.1]]),
        np.array([[0.93]]),
        (0.05, 0.32),
        (0.85, 0.85),
        0.01,
        0.01,
    )
    size = DRAW.uniform(0.08, 0.3, (5, 6))
    turn = DRAW.uniform(0, math.pi, (5, 6))
    size[GAP] = 0
    cell = Cell(0.4, shape=Rectangle(0.6))
    lens = Lens(
        DiameterMap(size, 0.4, angle_rad=turn),
        cell,
        proxy,
        0.85,
        77.0,
        math.inf,
        "map",
        hand=hand,
    )
    there = size > 0
    unturned = Lens(DiameterMap(size, 0.4), cell, proxy, 0.85, 77.0, math.inf, "map")
    assert unturned.geometric_rad(slice(None)) == 0.0
    assert lens.geometric_rad(slice(2, 5)) == pytest.approx(turns * turn[2:5])
    assert lens.phase_rad() == pytest.approx(
        np.where(there, unturned.phase_rad() + turns * turn, 0), abs=1e-12
    )
    assert (unturned.phase_rad()[there] != 0).all()
    assert lens.transmission() == pytest.approx(
        np.where(there, proxy.transmission(np.maximum(size, 0.08), 0.85), 0)
    )
