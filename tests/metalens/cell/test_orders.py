"""Propagating orders: the grating equation by hand, and the refusal that names them."""

import math

import pytest

from metalens import rcwa
from metalens.cell.orders import (
    DiffractionOrder,
    check_subwavelength,
    propagating_orders,
    substrate_orders,
)
from metalens.cell.record import Cell, Index
from metalens.core.errors import CellError

GLASS = Index(1.45)


def cell(pitch_um):
    return Cell(pitch_um, pillar=Index(3.6), substrate=GLASS)


def immersed(pitch_um):
    """The same with glass as the cover: its orders are the refused ones."""
    return Cell(pitch_um, pillar=Index(3.6), substrate=GLASS, cover=GLASS)


def test_only_the_zero_orders_below_cutoff():
    assert propagating_orders(cell(0.4), 0.85) == (
        DiffractionOrder("substrate", 0, 0),
        DiffractionOrder("cover", 0, 0),
    )
    check_subwavelength(cell(0.4), 0.85)


def test_exactly_at_cutoff_four_orders_graze_in_the_substrate():
    at_cutoff = cell(1.0)
    assert len(propagating_orders(at_cutoff, 1.45)) == 6
    assert len(propagating_orders(at_cutoff, 1.45 * (1 + 1e-12))) == 2
    with pytest.raises(CellError, match=r"\(0, -1\).* in the cover; need pitch_um < 1"):
        check_subwavelength(immersed(1.0), 1.45)
    check_subwavelength(at_cutoff, 1.45)  # orders of the substrate are a loss
    assert len(substrate_orders(at_cutoff, 1.45)) == 4


@pytest.mark.parametrize("angle_deg", [0.0, 10.0, -10.0])
@pytest.mark.parametrize("pitch_um", [0.5, 0.6, 0.95])
def test_orders_are_those_that_carry_power_in_the_solver(pitch_um, angle_deg):
    """With all orders but zero taken away, energy is missing exactly where other orders
    propagate.
    """
    angle_rad = math.radians(angle_deg)
    orders = propagating_orders(cell(pitch_um), 0.85, angle_rad=angle_rad)
    got = rcwa.solve(
        cell(pitch_um), 0.25, 0.85, harmonics=4, angle_rad=angle_rad, polarization="s"
    )
    missing = got.energy - abs(got.t) ** 2 - abs(got.r) ** 2
    assert (missing > 1e-9) == (len(orders) > 2)


def test_the_pitch_that_the_refusal_names_is_the_limit():
    angle_rad = math.radians(12)
    limit = 0.85 / (1.45 + math.sin(angle_rad))
    check_subwavelength(immersed(limit * (1 - 1e-9)), 0.85, angle_rad=angle_rad)
    with pytest.raises(CellError, match=f"pitch_um < {limit:.6g}"):
        check_subwavelength(immersed(limit * (1 + 1e-9)), 0.85, angle_rad=angle_rad)


def test_many_orders_are_counted_not_listed():
    with pytest.raises(CellError, match=r"and [0-9]+ more propagate"):
        check_subwavelength(cell(5.0), 0.85)
