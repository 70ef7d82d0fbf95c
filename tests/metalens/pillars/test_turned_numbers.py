"""Turned pillars by the closed form of a pillar alone, error bars by hand, and turns of
a period that are solved.
"""

import cmath
import math
from types import SimpleNamespace

import numpy as np
import pytest

from metalens.cell import Cell, Index, Lattice
from metalens.cell.shapes import Circle, Cross, Ellipse, Polygon, Rectangle, Ring
from metalens.ground.errors import CellError
from metalens.pillars.circular import turned
from metalens.pillars.circular.turned import (
    Turned,
    check,
    circular,
    mirrored,
    period_rad,
)
from metalens.rcwa import SAFETY

T_X, T_Y = 0.9 * cmath.exp(0.4j), 0.7 * cmath.exp(-1.7j)
ANGLES = np.array([0.0, 0.3, 0.8])
EXACT = {"rel": 1e-13, "abs": 1e-14}  # roundings of float64


def pillar(angle):
    """R(angle) diag(T_X, T_Y) R(-angle), element by element."""
    c, s = math.cos(angle), math.sin(angle)
    mixed = (T_X - T_Y) * c * s
    return np.array(
        [[T_X * c * c + T_Y * s * s, mixed], [mixed, T_X * s * s + T_Y * c * c]]
    )


ALONE = np.array([pillar(angle) for angle in ANGLES])
KEPT, CONVERTED = (T_X + T_Y) / 2, (T_X - T_Y) / 2


def solved(t=ALONE, earlier=None):
    earlier = np.empty((len(t), 0, 2, 2)) if earlier is None else earlier
    return Turned(0.21, 0.83, ANGLES, t, np.array([0.01, 0.02, 0.03]), earlier)


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_a_pillar_alone_turns_the_converted_light_by_twice_its_angle(hand):
    kept, converted = circular(ALONE, hand)
    assert kept == pytest.approx(np.full(3, KEPT), **EXACT)
    assert converted == pytest.approx(CONVERTED * np.exp(2j * hand * ANGLES), **EXACT)
    assert solved().converted(hand) == pytest.approx(np.full(3, CONVERTED), **EXACT)
    assert solved().model_error == pytest.approx(0, abs=1e-14)


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_shares_are_means_over_the_turns_and_their_bars_seven_times_the_farthest_change(
    hand,
):
    """Amplitudes of 1, 0.8 and 0.6 times the pillar's: mean 0.8 of the one, mean square
    2/3 of the other. Earlier: all
    of them 0.85 and 1.05 times as large, so that shares are 0.7225 and 1.1025 times
    theirs; the first is farther."""
    t = ALONE * np.array([1.0, 0.8, 0.6])[:, None, None]
    found = solved(t, np.stack([0.85 * t, 1.05 * t], 1))
    assert SAFETY == 7.0  # of a solver's changes
    for share, want in (
        (found.efficiency(hand), 0.64 * abs(CONVERTED) ** 2),
        (found.unconverted(hand), 2 / 3 * abs(KEPT) ** 2),
    ):
        assert share == pytest.approx((want, 7 * 0.2775 * want), rel=1e-12)
        assert [type(value) for value in share] == [float, float]
    assert (
        solved(t).efficiency(hand)[1] == 7.0
    )  # of one truncation alone nothing is known
    assert found.model_error == pytest.approx(0.4 * abs(CONVERTED), rel=1e-12)


def test_phases_that_scatter_over_the_turns_are_no_part_of_the_efficiency_but_of_what_is_kept():
    """Phases of 0, 1.1 and -0.4 rad on the whole answer."""
    t = ALONE * np.exp(1j * np.array([0.0, 1.1, -0.4]))[:, None, None]
    mean = (1 + cmath.exp(1.1j) + cmath.exp(-0.4j)) / 3
    assert solved(t).efficiency(1.0)[0] == pytest.approx(
        abs(mean * CONVERTED) ** 2, rel=1e-12
    )
    assert solved(t).unconverted(1.0)[0] == pytest.approx(abs(KEPT) ** 2, rel=1e-12)
    assert solved(t).model_error == pytest.approx(
        2 * math.sin(0.55) * abs(CONVERTED), rel=1e-12
    )


@pytest.mark.parametrize("hand", [1, -1])
def test_the_hand_that_errs_more_makes_the_model_error(hand):
    """What is added to the second pillar converts light of one hand alone, by 0.04."""
    t = ALONE.copy()
    t[1] += 0.02 * np.array([[1.0, -1j * hand], [-1j * hand, -1.0]])
    errors = [
        float(np.abs(circular(t[1] - ALONE[1], other)[1])) for other in (hand, -hand)
    ]
    assert errors == pytest.approx([0.04, 0.0], abs=1e-12)
    assert solved(t).model_error == pytest.approx(0.04, rel=1e-9)


def test_the_mirror_image_is_the_pillar_turned_the_other_way():
    assert mirrored(pillar(0.37)) == pytest.approx(pillar(-0.37), **EXACT)


@pytest.mark.parametrize(
    ("kind", "period"), [("square", 90), ("hexagonal", 60), ("rectangular", 180)]
)
def test_a_lattice_comes_back_after_its_own_turn(kind, period):
    lattice = Lattice(kind, 1.3) if kind == "rectangular" else Lattice(kind)
    assert period_rad(Cell(0.4, lattice=lattice)) == pytest.approx(math.radians(period))


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_seven_places_of_a_period_come_from_four_solves(monkeypatch, kind):
    """Turns of 0 to half the period in thirds of that half; those between come back
    with the other sign.
    """
    asked = []

    def closed(cell, size_um, wavelength_um, *, tolerance):
        angle = cell.shape.angle_rad
        asked.append((angle, size_um, wavelength_um, tolerance))
        t = pillar(angle)
        return SimpleNamespace(
            t=t, t_error=0.01 + angle, earlier=np.stack([0.9 * t, 0.8 * t])
        )

    monkeypatch.setattr(turned, "jones", closed)
    cell = Cell(0.41, 0.5, Index(3.6), lattice=Lattice(kind), shape=Rectangle(0.5))
    found = turned.solve(cell, 0.23, 0.94, tolerance=0.02)
    step = 15.0 if kind == "square" else 10.0
    turns = np.radians(step * np.array([0, 1, 2, 3, -2, -1]))
    assert [about[0] for about in asked] == pytest.approx(turns[:4].tolist())
    assert {about[1:] for about in asked} == {(0.23, 0.94, 0.02)}
    assert found.angle_rad == pytest.approx(turns)
    want = np.array([pillar(angle) for angle in turns])
    assert found.t == pytest.approx(want, **EXACT)
    assert found.t_error == pytest.approx(0.01 + np.abs(turns))
    assert found.earlier == pytest.approx(
        np.stack([0.9 * want, 0.8 * want], 1), **EXACT
    )
    assert (found.size_um, found.wavelength_um) == (0.23, 0.94)


def test_arrays_bring_everything_back():
    back = Turned.from_arrays(solved(earlier=0.9 * ALONE[:, None]).to_arrays())
    assert (back.size_um, back.wavelength_um) == (0.21, 0.83)
    for name, want in (
        ("angle_rad", ANGLES),
        ("t", ALONE),
        ("earlier", 0.9 * ALONE[:, None]),
    ):
        assert np.array_equal(getattr(back, name), want)
    assert back.t_error.tolist() == [0.01, 0.02, 0.03]


KITE = Polygon(
    ((0.5, 0.0), (0.0, 0.3), (-0.5, 0.0), (0.0, -0.3))
)  # mirrors along both axes
DART = Polygon(((0.5, 0.0), (-0.5, 0.3), (-0.5, -0.3)))  # along x alone


@pytest.mark.parametrize("shape", [Rectangle(0.5), Ellipse(1.4), KITE])
def test_pillars_longer_along_one_axis_are_taken(shape):
    check(Cell(0.6, shape=shape), 0.2)


@pytest.mark.parametrize(
    ("shape", "told"),
    [
        (Rectangle(), "alike"),
        (Circle(), "alike"),
        (Ellipse(1.0), "alike"),
        (Cross(0.4), "alike"),
        (Ring(0.4), "alike"),
        (Rectangle(0.5, 0.2), "mirrors along x and y"),
        (DART, "mirrors along x and y"),
    ],
)
def test_pillars_without_a_geometric_phase_or_mirrors_are_refused(shape, told):
    with pytest.raises(CellError, match=told):
        check(Cell(0.6, shape=shape), 0.2)
