"""Fourier tables of normals over any reach, and operators of pillars without a
symmetry.
"""

import numpy as np
import pytest

from metalens.cell import Cell, Index
from metalens.cell.shapes import Polygon
from metalens.rcwa import pattern, problem
from metalens.rcwa.orders import mirrors
from metalens.rcwa.orders.mirrors import IDENTITY

CELL = Cell(
    0.4,
    height_um=0.5,
    pillar=Index(2.6),
    substrate=Index(1.45),
    shape=Polygon(
        ((-0.5, -0.3), (0.5, -0.35), (0.1, 0.6)), 0.2
    ),  # no half turn keeps it
)


def test_a_longer_table_holds_the_shorter_one_in_its_middle():
    """Coefficients belong to their orders, whatever the truncation asks for besides."""
    outlines = (CELL.outline(0.24),)
    few, many = (
        pattern.normal_tables(outlines, CELL, (2, 3)),
        pattern.normal_tables(outlines, CELL, (17, 5)),
    )
    for short, long in zip(few, many, strict=True):
        assert long.shape == (69, 21)
        assert np.abs(long[30:39, 4:17] - short).max() < 1e-12
        assert (
            np.abs(short[::-1, ::-1].conj() - short).max() < 1e-12
        )  # of real functions


@pytest.mark.parametrize("angle_rad", [0.0, 0.3])
def test_without_loss_the_operator_is_hermitian(angle_rad):
    """Q is eps less kappa² in orders: real permittivities make it its own adjoint,
    however complex its entries.
    """
    space = mirrors.reduced_orders(3, pattern.lattice_frame(CELL, (IDENTITY,)))
    light = problem.tangential_wave(0.633, angle_rad, 0.4)
    ways, _ = problem.waves_of(space, CELL, light)
    slab = pattern.PillarSection((CELL.outline(0.24),), (2.6**2,), 1.1**2)
    Q = pattern.section_operators(space, ways, slab, CELL)[1]
    assert np.abs(Q.imag).max() > 0.01
    assert np.abs(Q - Q.conj().T).max() < 1e-12 * np.abs(Q).max()
