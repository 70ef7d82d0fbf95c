"""Fourier tables of the normal field of a disc, whose nearest wall lies on the ray from
its own axis.
"""

import numpy as np
import pytest

from metalens.cell import Cell, Index, Lattice
from metalens.rcwa.permittivity import normal_tables

PITCH, DIAMETER = 0.4, 0.23
ABOUT = {"height_um": 0.5, "pillar": Index(2.6), "substrate": Index(1.45)}


@pytest.mark.parametrize("ratio", [1.0, 1.3])
def test_tables_of_a_disc_are_those_of_its_rays(ratio):
    """w nx², w ny², w nx ny with n = r / |r| and w = 1 / (1 + (d / half the largest
    d)⁴), summed in plain numpy.

    The wall is drawn in steps of pitch / 200, which turns a normal by up to 0.2 / 115
    and moves a distance by less.
    """
    lattice = Lattice("rectangular", ratio)
    cell = Cell(PITCH, **ABOUT, lattice=lattice)
    wide, high = lattice.periods_um(PITCH)
    reach = (2, 3)
    found = normal_tables((cell.outline(DIAMETER),), cell, reach)
    counts = [int(np.ceil(192 * edge / PITCH)) for edge in (wide, high)]
    x, y = ((np.arange(n) / n + 0.5) % 1 - 0.5 for n in (c + c % 2 for c in counts))
    x, y = np.meshgrid(x * wide, y * high, indexing="ij")
    radius = np.maximum(np.hypot(x, y), 1e-12)
    # the nearest of all discs: of equal ones it is that of the nearest axis, the cell's
    # own
    distance = np.abs(radius - DIAMETER / 2)
    weight = 1 / (1 + (distance / (distance.max() / 2)) ** 4)
    m, k = np.arange(-4, 5), np.arange(-6, 7)
    turns = (
        np.exp(-2j * np.pi * m[:, None] * x.ravel() / wide),
        np.exp(-2j * np.pi * k[:, None] * y.ravel() / high),
    )
    for table, part in zip(found, (x * x, y * y, x * y), strict=True):
        values = (weight * part / radius**2).ravel()
        want = (turns[0] * values) @ turns[1].T / values.size
        assert np.abs(table - want).max() < 2e-3
    trace = found[0] + found[1]
    assert trace[4, 6] == pytest.approx(weight.mean(), rel=2e-3)
