"""Cells whose error is hard to estimate, from random draws: narrow gaps, holes, sharp
resonances, orders at their cutoff, many waves in a pitch.

Reference values of t and r come from finer meshes with other rings, degrees and
exponents; ``doubt`` is what two of them differ by.
"""

import math

import numpy as np
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
LOW = (
    cell(
        0.5459148916960734,
        0.052882004823371416,
        2.7898093817704117,
        1.26799596,
        1.03693486,
        1.81642935,
    ),
    0.24177454050838318,
    Incidence(0.5293950834131094),
)
WIDE_HOLE = (
    cell(
        0.8150270231314243,
        1.6946108585781772,
        1.8692275718805345,
        1.84115453,
        1.39318307,
        3.75606134,
    ),
    0.5139929458275264,
    Incidence(1.7352906649295703),
)
LOW_HOLE = (
    cell(
        0.5719601618263312,
        0.04227850459311263,
        1.0638745606272648,
        2.00461361,
        1.40103268,
        3.5682959427,
    ),
    0.1787102889704651,
    Incidence(0.8806399780818054),
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
# a thin disc in a layer that guides without it
GUIDED = (
    cell(
        0.5279752941817,
        1.6047678068795,
        2.7167073594087,
        1.422637354039,
        1.4323186819593,
        1.7535734634407,
    ),
    0.0750219081185,
    Incidence(0.8912474407872),
)
TALL = (
    cell(0.4018070723, 1.869884332, 3.376210251, 1.66570934, 1.09029881, 1.21034073),
    0.1843747312,
    Incidence(0.8402593739),
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
FORMS_ALIKE = (
    cell(0.4364, 1.8514, 2.9316, 1.302, 1.0744, 1.1737),
    0.2165,
    Incidence(0.8488),
)
# an order of the substrate that has just begun to propagate, 2.4e-5 of the wavelength
# beyond
BESIDE_CUTOFF = (
    cell(0.58388739, 0.53453013, 2.73798679, 1.58821564, 1.08200867, 1.18564028),
    0.31785514,
    Incidence(0.92731673),
)


MANY_WAVES = (
    cell(
        0.55042954205541,
        1.53029894103568,
        3.51819048263958,
        1.3393922268467,
        1.0360996419115,
        1.16126448325698,
    ),
    0.18680812157690393,
    Incidence(0.9255815809035152),
)
LOWER = (
    cell(
        0.53452483009903,
        0.64028033386564,
        2.46307144719115,
        1.74956478318425,
        1.28268146737654,
        1.28469392918809,
    ),
    0.3523400660475739,
    Incidence(0.6859730438764974),
)


# cell, t, r
CELLS = {
    "narrow gap": (NARROW_GAP, -0.12423948 + 0.10111273j, -0.30361978 - 0.93923149j),
    "low": (LOW, 0.24978720 + 0.66387770j, -0.43444158 - 0.02717638j),
    "wide hole": (WIDE_HOLE, -0.82087407 + 0.46652082j, -0.04417332 - 0.32645491j),
    "low hole": (LOW_HOLE, 0.30626170 + 0.73856191j, -0.52483380 + 0.29154021j),
    "thin hole": (THIN_HOLE, 0.91909972 - 0.31850873j, -0.08152017 - 0.21716894j),
    "resonance": (RESONANCE, 0.34590110 - 0.84357231j, -0.38867830 - 0.13291864j),
    "many orders": (MANY_ORDERS, -0.38286211 + 0.40229133j, -0.06889916 + 0.10795977j),
    "guided": (GUIDED, 0.39695824 + 0.89700154j, -0.17837335 + 0.07742957j),
    "tall": (TALL, 0.69795555 + 0.65842701j, -0.06944253 + 0.27296458j),
    "taller": (TALLER, 0.21294563 + 0.65339321j, 0.17541121 + 0.16606997j),
    "dark": (DARK, 0.19739637 - 0.08082639j, -0.43286338 - 0.87586019j),
    "towards": (TOWARDS, 0.47494622 - 0.74169177j, -0.37879426 - 0.28431378j),
    "forms alike": (FORMS_ALIKE, 0.21386370 - 0.91826191j, -0.31857649 - 0.09780801j),
    "at a cutoff": (AT_CUTOFF, 0.59498633 + 0.08336805j, 0.68132592 + 0.41813399j),
    "beside a cutoff": (
        BESIDE_CUTOFF,
        0.16935637 + 0.76916801j,
        -0.45823608 + 0.36125745j,
    ),
    "many waves": (MANY_WAVES, -0.10397674 - 0.94557963j, -0.30527861 + 0.04327788j),
    "lower": (LOWER, 0.79724860 + 0.18076934j, 0.36986870 - 0.05152140j),
}
DOUBT = 2e-5  # of degree 6 with rings; "many orders" is known to this at degree 5


@pytest.mark.parametrize("tolerance", [0.1, 1e-2, 1e-3])
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
    assert np.abs(general.r - finer.r).max() < general.t_error
