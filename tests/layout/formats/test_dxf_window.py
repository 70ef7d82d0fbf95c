"""Pillars of a window of a mask: every site looked at by itself."""

import dataclasses

import numpy as np
import pytest

from layout.formats.dxf import DxfWindow, sites_in
from layout.mask.plan import MaskPlan, PillarClass, PillarLattice

SQUARE = np.array([[-60, -60], [60, -60], [60, 60], [-60, 60]])
RNG = np.random.default_rng(7)


@pytest.mark.parametrize(
    ("x_um", "y_um", "size_um"),
    [
        (0.9, -0.7, 1.3),
        (2.6, -1.2, 0.85),
        (0.0, 0.0, 60.0),
        (2.04, -0.3, 1.0),
        (-9.0, -0.7, 1.3),
        (0.9, 9.0, 1.3),
    ],
)
def test_sites_in_a_window_are_those_between_its_sides(x_um, y_um, size_um):
    """Units of 2 nm, rows of another distance than columns; left and upper sides belong
    to the window.
    """
    lattice = PillarLattice.of(
        "LENS", RNG.integers(0, 3, (9, 13)).astype(np.uint8), pitch=170, x0=-230, y0=205
    )
    lattice = dataclasses.replace(lattice, row_pitch=145)
    made = tuple(PillarClass(name, 240.0, 120, (1, 0), SQUARE) for name in "AB")
    plan = MaskPlan("TOP", made, (lattice,), unit_nm=2.0)
    half, want = size_um * 250, []
    for row, column in np.argwhere(lattice.array).tolist():
        x, y = -230 + 170 * column, 205 - 145 * row
        if -half <= x - x_um * 500 < half and -half < y - y_um * 500 <= half:
            want.append((int(lattice.array[row, column]), x, y))
    assert sorted(sites_in(plan, lattice, DxfWindow(x_um, y_um, size_um))) == sorted(
        want
    )
