"""Cells whose error is hard to estimate, from random draws: narrow gaps, holes, sharp
resonances, orders at their cutoff, many waves in a pitch.

Reference values of t and r come from finer meshes with other rings, degrees and
exponents; ``doubt`` is what two of them differ by.
"""

import math

import pytest

from metalens import modal, rcwa
from metalens.cell import Cell, Incidence, Index
from metalens.cell.shapes import Ellipse


def cell(pitch_um, height_um, pillar, substrate, cover, between, k=0.0):
    return Cell(
        pitch_um,
        height_um,
        Index(pillar, k),
        Index(substrate),
        Index(cover),
        Index(between),
    )


NARROW_GAP = (
    cell(
        0.4450006524813945,
        0.7107471686299986,
        4.226887694594547,
        1.29768228,
        1.68157799,
        1.89605793,
    ),
    0.42349186308834735,
    Incidence(0.8425811917203626),
)
THIN_HOLE = (
    cell(
        0.5304071193871596,
        0.31346717187325385,
        1.0026346497618828,
        1.27022822,
        1.28622723,
        3.11705012,
    ),
    0.032166565817817065,
    Incidence(1.0136164975151287),
)
RESONANCE = (
    cell(
        0.5463962392579549,
        1.3817243586259316,
        2.481663279675403,
        1.01162122,
        1.19402703,
        1.21686081,
    ),
    0.22674369678315753,
    Incidence(0.7687960094226736, 0.1487341598591234, "p"),
)
MANY_ORDERS = (
    cell(
        0.8338409221257648,
        0.5851030706653144,
        2.774972994147054,
        1.75325295,
        1.13529047,
        1.88695666,
    ),
    0.28321358022201676,
    Incidence(0.8349581637443448, 0.2001742614769124, "s"),
)
TALLER = (
    cell(0.7948552376, 11.0175124, 1.89818664, 2.04340399, 1.32803376, 1.42092133),
    0.4767121087,
    Incidence(0.8253536),
)
# within 0.2 % of the cutoff of an order of the substrate
AT_CUTOFF = (
    cell(0.520574852, 0.381721476, 2.747248786, 1.60065034, 1.0, 1.0),
    0.351280652,
    Incidence(0.834092407),
)
DARK = (
    cell(0.4, 0.7, 3.6, 1.4525, 1.0, 1.0),
    0.272,
    Incidence(0.85, math.radians(5), "p"),
)  # a sharp oblique resonance
# coarse meshes move the answer towards a resonance
TOWARDS = (
    cell(0.4, 0.531554632, 3.733563396, 1.380462079, 1.242016263, 1.158479481),
    0.266161189,
    Incidence(0.86002158, 0.106500461, "p"),
)


# cell, t, r
CELLS = {
    "narrow gap": (NARROW_GAP, -0.12423948 + 0.10111273j, -0.30361978 - 0.93923149j),
    "thin hole": (THIN_HOLE, 0.91909972 - 0.31850873j, -0.08152017 - 0.21716894j),
    "resonance": (RESONANCE, 0.34590110 - 0.84357231j, -0.38867830 - 0.13291864j),
    "many orders": (MANY_ORDERS, -0.38286211 + 0.40229133j, -0.06889916 + 0.10795977j),
    "taller": (TALLER, 0.21294563 + 0.65339321j, 0.17541121 + 0.16606997j),
    "dark": (DARK, 0.19739637 - 0.08082639j, -0.43286338 - 0.87586019j),
    "towards": (TOWARDS, 0.47494622 - 0.74169177j, -0.37879426 - 0.28431378j),
    "at a cutoff": (AT_CUTOFF, 0.59498633 + 0.08336805j, 0.68132592 + 0.41813399j),
}
DOUBT = 2e-5  # of degree 6 with rings; "many orders" is known to this at degree 5


@pytest.mark.parametrize("tolerance", [0.1, 1e-3])
@pytest.mark.parametrize("name", CELLS)
def test_error_estimates_hold_for_cells_unlike_those_of_lenses(name, tolerance):
    """Whatever level the tolerance ends at."""
    (cell, diameter, light), t, r = CELLS[name]
    got = modal.solve(
        cell,
        diameter,
        light.wavelength_um,
        angle_rad=light.angle_rad,
        polarization=light.polarization,
        tolerance=tolerance,
    )
    assert abs(got.t - t) <= got.t_error + DOUBT
    assert abs(got.r - r) <= got.t_error + DOUBT


def test_the_bar_of_coupled_waves_holds_for_what_a_black_layer_reflects():
    """Nothing passes, so that t does not move between truncations; r does (modal
    method, to 3e-6).
    """
    black = Cell(
        0.66876337,
        3.23221424,
        Index(3.35928142, 0.79602031),
        Index(1.71932542),
        Index(1.0771968663),
    )
    got = rcwa.solve(black, 0.58922201, 1.03929592, harmonics=8)
    want = modal.solve(black, 0.58922201, 1.03929592, tolerance=1e-3)
    assert abs(got.t - want.t) < 1e-4
    assert 1e-4 < abs(got.r - want.r) < got.t_error + want.t_error
    oval = Cell(0.4, 2.0, Index(3.4, 0.8), shape=Ellipse(0.8))
    general, finer = (
        rcwa.jones(oval, 0.3, 0.85, harmonics=orders) for orders in (7, 10)
    )
    assert abs(general.r - finer.r).max() < general.t_error
