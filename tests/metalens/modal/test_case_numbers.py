"""One modal case: a cell and a light in half pitches by hand, what is strange about it,
what is refused.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from metalens.cell.light import Incidence
from metalens.cell.record import Cell, Film, Index, Layer
from metalens.cell.shapes.round import Circle
from metalens.core.errors import CellError
from metalens.modal.case import (
    RARER,
    MeshSolution,
    ModalCase,
    case_of,
    check_shape,
    fresnel_scattering,
    half_spaces,
    plane_of_incidence,
)

CELL = Cell(0.4, 0.7, Index(3.0, 0.2), Index(1.5), Index(1.2), Index(1.1))
USUAL = ModalCase(
    rho=0.4,
    k0=1.2,
    height=3.0,
    below=2.1,
    above=1.4,
    disc=9.0,
    around=1.2,
    bloch=0.3,
    p=False,
)


def test_lengths_are_in_half_pitches_and_indices_are_squared():
    """Half a pitch is 0.2: k0 = 2 pi 0.2 / 0.8, height 0.7 / 0.2, kx = k0 sin 30°, (3 +
    0.2i)² = 8.96 + 1.2i.
    """
    case = case_of(CELL, 0.25, Incidence(0.8, math.pi / 6, "s"))
    assert case.rho == pytest.approx(0.625, rel=1e-12)
    assert case.k0 == pytest.approx(math.pi / 2, rel=1e-12)
    assert case.height == pytest.approx(3.5, rel=1e-12)
    assert (case.below, case.above) == pytest.approx((2.25, 1.44), rel=1e-12)
    assert case.disc == pytest.approx(8.96 + 1.2j, rel=1e-12)
    assert case.around == pytest.approx(1.21, rel=1e-12)
    assert case.bloch == pytest.approx(math.pi / 4, rel=1e-12)
    assert not case.p


def test_light_from_the_other_side_has_the_same_phase():
    there, back = (
        case_of(CELL, 0.25, Incidence(0.8, angle, "p")) for angle in (0.2, -0.2)
    )
    assert (
        there.bloch
        == back.bloch
        == pytest.approx(math.pi / 2 * math.sin(0.2), rel=1e-12)
    )


@pytest.mark.parametrize(
    ("phase", "kept"), [(0.9e-6, False), (1.1e-6, True), (-1.1e-6, True), (0.0, False)]
)
def test_a_phase_below_a_millionth_is_normal_incidence(phase, kept):
    """k0 is pi / 2 in half pitches; of so small an angle the sine is the angle."""
    case = case_of(CELL, 0.25, Incidence(0.8, phase / (math.pi / 2), "s"))
    assert case.bloch == pytest.approx(abs(phase) if kept else 0.0, rel=1e-9)


@pytest.mark.parametrize(
    ("azimuth", "axis"),
    [
        (0.0, "x"),
        (0.5, "y"),
        (-0.5, "y"),
        (1.0, "x"),
        (1.5, "y"),
        (2.5, "y"),
        (-1.0, "x"),
        (2.0, "x"),
    ],
)
def test_the_plane_of_incidence_turns_by_quarters(azimuth, axis):
    """azimuth: in parts of pi. The field along the axis of the plane is p, and across
    it s.
    """
    assert plane_of_incidence(Incidence(0.8, 0.2, "s", azimuth * math.pi)) == axis
    p = {
        name: case_of(CELL, 0.25, Incidence(0.8, 0.2, name, azimuth * math.pi)).p
        for name in "xysp"
    }
    assert p == {axis: True, "xy".replace(axis, ""): False, "s": False, "p": True}


def test_planes_off_the_axes_are_refused_where_there_is_an_angle():
    """From 1e-12 of a quarter turn on."""
    assert plane_of_incidence(Incidence(0.8, 0.0, "x", 0.7)) == "x"  # 0.45 quarters
    assert plane_of_incidence(Incidence(0.8, 0.0, "x", 0.9)) == "y"  # 0.57
    assert plane_of_incidence(Incidence(0.8, 0.2, "x", 5e-13 * math.pi / 2)) == "x"
    for off in (4e-12, -4e-12, 0.3):
        for angle in (0.2, -0.2):
            with pytest.raises(CellError, match=r"multiples of pi/2"):
                plane_of_incidence(Incidence(0.8, angle, "x", (1 + off) * math.pi / 2))


def test_half_spaces_have_their_indices_and_absorb_nothing():
    assert half_spaces(CELL, Incidence(0.8, 1.5)) == (1.5, 1.2)
    for name in ("substrate", "cover"):
        with pytest.raises(
            CellError, match=rf"{name} absorbs \(index \(1.4\+1e-06j\)\)"
        ):
            half_spaces(replace(CELL, **{name: Index(1.4, 1e-6)}), Incidence(0.8))


@pytest.mark.parametrize("name", ["substrate", "cover"])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_rarer_half_space_needs_a_zero_order(name, sign):
    """Index 0.5: up to 30 degrees, where the sine is 0.5 itself."""
    rare = replace(CELL, **{name: Index(0.5)})
    half_spaces(rare, Incidence(0.8, sign * (math.pi / 6 - 1e-6)))
    with pytest.raises(CellError, match=r"no zero order in a half-space of index 0.5"):
        half_spaces(rare, Incidence(0.8, sign * (math.pi / 6 + 1e-6)))
    exact = replace(CELL, **{name: Index(abs(math.sin(0.7)))})
    with pytest.raises(CellError, match="no zero order"):
        half_spaces(exact, Incidence(0.8, sign * 0.7))


@pytest.mark.parametrize("diameter", [0.0, -0.1, 0.4, 0.41, math.nan, math.inf])
def test_diameters_end_above_zero_and_below_the_pitch(diameter):
    check_shape(CELL, 1e-6)
    check_shape(CELL, 0.4 - 1e-9)
    with pytest.raises(CellError, match="above 0 and below the pitch"):
        check_shape(CELL, diameter)


@pytest.mark.parametrize(
    "more",
    [
        {"sidewall_rad": 0.01},
        {"sidewall_rad": -0.01},
        {"under": (Film(Index(2), 0.1),)},
        {"over": (Film(Index(2), 0.1),)},
    ],
    ids=["foot wider", "top wider", "under", "over"],
)
def test_films_and_tilted_walls_are_no_case_of_the_elements(more):
    with pytest.raises(CellError, match="upright pillar without films"):
        case_of(replace(CELL, **more), 0.2, Incidence(0.8))


def test_holes_and_layers_are_told_by_their_names():
    for more in ({"shape": Circle(hole=True)}, {"layers": (Layer(0.3), Layer(0.4))}):
        with pytest.raises(
            CellError,
            match="the modal engine takes round pillars on a square lattice, not",
        ):
            case_of(replace(CELL, **more), 0.2, Incidence(0.8))


@pytest.mark.parametrize(
    ("disc", "around"),
    [(9.0, 4.0), (4.0, 9.0), (-9.0, 4.0), (9j, 4.0), (1.0, -5.4 + 7.2j)],
)
def test_size_counts_waves_in_the_medium_of_the_larger_permittivity(disc, around):
    """A pitch is 2: k0 3 2 / 2 pi waves of index 3."""
    assert replace(USUAL, k0=0.7, disc=disc, around=around).size == pytest.approx(
        0.7 * 3 / math.pi, rel=1e-12
    )


EDGE = 1e-9
WAVES = math.pi / 3  # k0 of one wave in a pitch, in a disc of index 3


@pytest.mark.parametrize(
    ("inside", "outside"),
    [
        ({"disc": 2.4 + EDGE}, {"disc": 2.4 - EDGE}),  # twice the surroundings
        ({"height": 0.5}, {"height": 0.5 - EDGE}),
        ({"height": 16.0}, {"height": 16.0 + EDGE}),
        ({"k0": 2 * WAVES - EDGE}, {"k0": 2 * WAVES + EDGE}),
        (
            {"k0": WAVES, "below": 9.922},
            {"k0": WAVES, "below": 9.923},
        ),  # sqrt(9.9225) / 3 = 1.05 waves
        ({"k0": WAVES, "above": 9.922}, {"k0": WAVES, "above": 9.923}),
        ({"bloch": 1.0}, {"bloch": 1.0 + EDGE}),
        (
            {"around": 1.2 * 2.1 - EDGE},
            {"around": 1.2 * 2.1 + EDGE},
        ),  # of the denser half-space
        (
            {"around": 1.2 * 2.1 - EDGE, "below": 1.0, "above": 2.1},
            {"around": 1.2 * 2.1 + EDGE, "above": 1.0},
        ),
    ],
)
def test_a_cell_is_strange_from_each_of_its_bounds_on(inside, outside):
    assert replace(USUAL, **inside).strange == 0.0
    assert replace(USUAL, **outside).strange == 1.0


def test_a_disc_that_absorbs_more_than_half_of_its_size_is_told_from_any_surroundings():
    """Of permittivity 1.1 + 0.8i, size 1.36; not so 1.2 + 0.64i, of the same size."""
    assert replace(USUAL, disc=1.1 + 0.8j).strange == 0.0
    assert replace(USUAL, disc=1.2 + 0.64j).strange == 1.0


def test_a_disc_of_the_rarer_medium_is_strangest():
    assert replace(USUAL, disc=1.2 - EDGE).strange == RARER == 3.0
    assert replace(USUAL, disc=1.2).strange == 1.0
    assert replace(USUAL, disc=-1.1, height=100.0).strange == 3.0


def test_forms_are_apart_by_waves_and_rim_together():
    one = MeshSolution(
        np.eye(2), waves=0.25, rim=0.5, drift=0.1, energy=1.0, unknowns=3
    )
    assert one.spread == 0.75
    assert (one.grazing, one.beside, one.bloch, one.size, one.strange, one.damping) == (
        0,
        0,
        0,
        0,
        0,
        1,
    )


@pytest.mark.parametrize(
    ("p", "r", "t"),
    [(False, 1 / 3, 2 * math.sqrt(2) / 3), (True, 1 / 9, 4 * math.sqrt(5) / 9)],
)
def test_a_film_of_no_height_reflects_as_its_half_spaces_do(p, r, t):
    """k0 = kx = 2, permittivities 5 and 2: kz 4 and 2. Admittances in s 4 and 2; in p 5
    / 4 and 2 / 2.
    """
    found = fresnel_scattering(
        replace(USUAL, k0=2.0, bloch=2.0, below=5.0, above=2.0, p=p)
    )
    assert found == pytest.approx(np.array([[r, t], [t, -r]]), rel=1e-12)
