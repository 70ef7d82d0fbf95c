"""Steps, areas and places of sites on unlike lattices, by hand."""

import math

import numpy as np
import pytest

from metalens.cell import Lattice
from metalens.ground.errors import LensError
from metalens.lens import diameters
from metalens.lens.diameters import DiameterMap, Grid

HEXAGONAL = Lattice("hexagonal")


def checkered(rows, columns, size=0.2):
    """Pillars where row + column is even."""
    return size * (np.indices((rows, columns)).sum(0) % 2 == 0)


def test_columns_and_rows_of_a_hexagonal_lattice():
    """Every other site of a grid of p / 2 and √3 p / 2; the cell of a pillar is √3 / 2
    p².
    """
    made = DiameterMap(checkered(3, 4), 0.5, HEXAGONAL)
    assert made.lattice_row_um == pytest.approx(0.5 * math.sqrt(3) / 2)
    assert made.steps_um == pytest.approx((0.25, 0.25 * math.sqrt(3)))
    assert made.site_um2 == pytest.approx(math.sqrt(3) / 2 * 0.25)
    assert made.grid == pytest.approx(
        Grid(0.25, 0.25 * math.sqrt(3), math.sqrt(3) / 2 * 0.25)
    )
    assert made.x_um == pytest.approx([-0.375, -0.125, 0.125, 0.375])
    assert made.y_um == pytest.approx(np.array([-1, 0, 1]) * 0.25 * math.sqrt(3))
    assert (made.pillars, DiameterMap(checkered(3, 5), 0.5, HEXAGONAL).pillars) == (
        6,
        8,
    )
    assert not made.plain


def test_rows_of_a_mask_stand_in_for_those_of_the_lattice_within_a_tenth():
    made = DiameterMap(checkered(3, 4), 0.5, HEXAGONAL, row_um=0.43)
    assert made.steps_um == (0.25, 0.43)
    assert made.site_um2 == pytest.approx(0.5 * 0.43)
    assert DiameterMap(np.full((2, 2), 0.2), 0.5, row_um=0.46).grid == pytest.approx(
        Grid(0.5, 0.46, 0.23)
    )
    with pytest.raises(LensError, match="within 10 %"):
        DiameterMap(np.full((2, 2), 0.2), 0.5, row_um=0.44)
    with pytest.raises(LensError, match="within 10 %"):
        DiameterMap(np.full((2, 2), 0.2), 0.5, row_um=0.56)
    square = DiameterMap(np.full((2, 2), 0.2), 0.5)
    assert (square.grid, square.site_um2, square.plain) == (Grid(0.5), 0.25, True)
    assert not DiameterMap(np.full((2, 2), 0.2), 0.5, angle_rad=np.zeros((2, 2))).plain
    assert not DiameterMap(np.full((2, 2), 0.2), 0.5, length_um=np.ones((2, 2))).plain


@pytest.mark.parametrize("at", [(0, 1), (1, 0), (2, 3), (3, 2)])
def test_a_pillar_between_hexagonal_sites_is_refused(at):
    sizes = checkered(4, 4)
    sizes[at] = 0.1
    with pytest.raises(LensError, match="row \\+ column is odd"):
        DiameterMap(sizes, 0.5, HEXAGONAL)


@pytest.mark.parametrize("blocks", [256, 2])
def test_the_outermost_pillar_on_unlike_axes(monkeypatch, blocks):
    """Axis at row 2, column 1.5; rows 0.6 apart, columns 0.4."""
    monkeypatch.setattr(diameters, "_BLOCK_ROWS", blocks)
    lattice = Lattice("rectangular", 1.5)
    for pillars, farthest in (
        ([(2, 2)], (0, 0.5)), ([(0, 1), (2, 3)], (2, 0.5)), ([(3, 0), (1, 2)], (1, 1.5)), ([(2, 0), (2, 1)], (0, 1.5)),
        ([(1, 3), (3, 2)], (1, 1.5)), ([(2, 1), (2, 3)], (0, 1.5)),
    ):  # fmt: skip
        sizes = np.zeros((5, 4))
        for row, column in pillars:
            sizes[row, column] = 0.2
        made = DiameterMap(sizes, 0.4, lattice)
        assert made.steps_um == pytest.approx((0.4, 0.6))
        assert made.radius_um == pytest.approx(
            math.hypot(0.6 * farthest[0], 0.4 * farthest[1])
        )


@pytest.mark.parametrize("bad", [0.5, -0.1, math.nan])
def test_the_first_diameter_that_cannot_be_is_named(monkeypatch, bad):
    monkeypatch.setattr(diameters, "_BLOCK_ROWS", 2)
    sizes = np.full((6, 3), 0.2)
    sizes[0, 0], sizes[5, 1] = 0, bad
    with pytest.raises(LensError, match=f"row 5, column 1 is {bad} um"):
        DiameterMap(sizes, 0.5)
    sizes[3, 2] = sizes[4, 0] = bad
    with pytest.raises(LensError, match=f"row 3, column 2 is {bad} um"):
        DiameterMap(sizes, 0.5)
