"""Orders of lattices that are no squares, by every order's own wave vector."""

import dataclasses
import math
import re

import pytest

from metalens.cell.lattice import Lattice
from metalens.cell.orders import (
    check_subwavelength,
    no_resonance_um,
    propagating_orders,
)
from metalens.cell.record import Cell, Film, Index
from metalens.core.errors import CellError


@pytest.mark.parametrize(
    "lattice",
    [Lattice("rectangular", 1.63), Lattice("rectangular", 0.71), Lattice("hexagonal")],
)
@pytest.mark.parametrize(
    ("angle_rad", "azimuth_rad"), [(0.0, 0.0), (0.31, 0.83), (-0.44, 2.2)]
)
def test_orders_are_those_whose_wave_vector_fits_the_medium(
    lattice, angle_rad, azimuth_rad
):
    """|k0 sin(angle) + m 2π/Px + n 2π/Py| <= n k0, all m and n tried; of a centred
    rectangle m + n is even.
    """
    pitch, wavelength = 0.93, 0.85
    cell = Cell(pitch, pillar=Index(3.1), substrate=Index(1.47), lattice=lattice)
    side_y = {"hexagonal": math.sqrt(3), "rectangular": lattice.ratio}[
        lattice.kind
    ] * pitch
    want = set()
    for side, index in (("substrate", 1.47), ("cover", 1.0)):
        for m in range(-9, 10):
            for n in range(-9, 10):
                x = math.sin(angle_rad) * math.cos(azimuth_rad) + m * wavelength / pitch
                y = (
                    math.sin(angle_rad) * math.sin(azimuth_rad)
                    + n * wavelength / side_y
                )
                if x * x + y * y <= index**2 and (
                    lattice.kind != "hexagonal" or (m + n) % 2 == 0
                ):
                    want.add((side, m, n))
    found = propagating_orders(
        cell, wavelength, angle_rad=angle_rad, azimuth_rad=azimuth_rad
    )
    assert {(one.side, one.m, one.n) for one in found} == want
    assert len(found) == len(want) > 2


@pytest.mark.parametrize(
    "lattice", [Lattice(), Lattice("rectangular", 1.3), Lattice("hexagonal")]
)
def test_below_the_pitch_without_resonances_the_densest_material_carries_no_other_order(
    lattice,
):
    """Were it a half-space, orders other than zero would graze in it at that pitch and
    none below.
    """
    cell = Cell(0.3, pillar=Index(2.7), substrate=Index(1.5), lattice=lattice)
    for above, count in ((0.999, 2), (1.001, None)):
        pitch = above * no_resonance_um(cell, 0.62)
        found = propagating_orders(
            Cell(pitch, substrate=Index(2.7), lattice=lattice), 0.62
        )
        assert (len(found) == count) if count else len(found) > 2
    film = Film(Index(3.1), 0.05)
    assert no_resonance_um(
        dataclasses.replace(cell, under=(film,)), 0.62
    ) == pytest.approx(2.7 / 3.1 * no_resonance_um(cell, 0.62))


@pytest.mark.parametrize(
    "lattice",
    [
        Lattice(),
        Lattice("rectangular", 1.3),
        Lattice("rectangular", 0.71),
        Lattice("hexagonal"),
    ],
)
@pytest.mark.parametrize(
    ("angle_rad", "azimuth_rad"),
    [(0.0, 0.0), (0.5, 0.0), (0.5, math.pi / 6), (-0.9, 0.7), (1.2, math.pi / 2)],
)
def test_the_pitch_that_a_refusal_names_is_the_limit_for_any_lattice_and_light(
    lattice, angle_rad, azimuth_rad
):
    """Other orders propagate from that pitch on and none below it; six digits are told."""
    light = {"angle_rad": angle_rad, "azimuth_rad": azimuth_rad}
    coarse = Cell(1.3, substrate=Index(1.2), cover=Index(1.45), lattice=lattice)
    with pytest.raises(CellError) as refused:
        check_subwavelength(coarse, 0.85, **light)
    limit = float(re.search(r"need pitch_um < ([\d.]+),", str(refused.value))[1])
    fine, above = (
        dataclasses.replace(coarse, pitch_um=limit * (1 + off)) for off in (-1e-5, 1e-5)
    )
    assert len(propagating_orders(fine, 0.85, **light)) == 2
    assert len(propagating_orders(above, 0.85, **light)) > 2
