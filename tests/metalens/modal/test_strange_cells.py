"""Cells unlike those of lenses, found by drawing any: the coarse meshes' bars hold for
t and r.

Values of the finest mesh that was tried, of the ladder's "fine" (normal incidence) and
"good": its own estimate is
``doubt``. Without a factor for such cells the bars of the meshes named were 1.3 to 6.3
times below these errors.
"""

import math

import numpy as np
import pytest

from metalens import modal, rcwa
from metalens.cell import Cell, Incidence, Index
from metalens.cell.shapes import Ellipse
from metalens.modal import RUNGS, case_of, solve_on_mesh
from metalens.modal.case import ModalCase
from metalens.modal.ladder import NEAREST

COARSE, FAIR, EVEN = RUNGS[0], RUNGS[1], RUNGS[2]


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
# thin discs in a layer that guides without them: bars of the three coarsest meshes were
# 0.45 to 0.73
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
NORMAL = [  # cell, its t and r, doubt, meshes whose bars did not hold
    (
        "narrow gap",
        NARROW_GAP,
        -0.12520389 + 0.10232487j,
        -0.30668512 - 0.93797540j,
        9e-4,
        COARSE,
    ),
    ("low", LOW, 0.24967821 + 0.66401862j, -0.43456498 - 0.02703477j, 1e-5, FAIR),
    (
        "wide hole",
        WIDE_HOLE,
        -0.82083422 + 0.46664100j,
        -0.04419096 - 0.32638094j,
        4e-5,
        FAIR,
    ),
    (
        "low hole",
        LOW_HOLE,
        0.30629106 + 0.73857015j,
        -0.52480043 + 0.29155250j,
        3e-6,
        EVEN,
    ),
    (
        "thin hole",
        THIN_HOLE,
        0.91909958 - 0.31851125j,
        -0.08151977 - 0.21716600j,
        2e-6,
        COARSE,
    ),
    (
        "resonance",
        RESONANCE,
        0.34589408 - 0.84357195j,
        -0.38868479 - 0.13292020j,
        2e-5,
        COARSE,
    ),
    (
        "many orders",
        MANY_ORDERS,
        -0.38280652 + 0.40235310j,
        -0.06895376 + 0.10798189j,
        4e-5,
        COARSE,
    ),
    (
        "guided",
        GUIDED,
        0.39696010 + 0.89700123j,
        -0.17837107 + 0.07742896j,
        3e-6,
        COARSE,
    ),
    ("guided", GUIDED, 0.39696010 + 0.89700123j, -0.17837107 + 0.07742896j, 3e-6, FAIR),
    ("guided", GUIDED, 0.39696010 + 0.89700123j, -0.17837107 + 0.07742896j, 3e-6, EVEN),
]


@pytest.mark.parametrize(
    ("name", "drawn", "t", "r", "doubt", "rung"),
    NORMAL,
    ids=[f"{one[0]}, {one[5].name}" for one in NORMAL],
)
def test_bars_of_coarse_meshes_cover_cells_unlike_those_of_lenses(
    name, drawn, t, r, doubt, rung
):
    case = case_of(*drawn)
    found = solve_on_mesh(case, rung.choice(case.rho).plan, weak=rung.weak)
    error = max(abs(found.matrix[1, 0] - t), abs(found.matrix[0, 0] - r))
    assert error < rung.error(found, case.rho) + doubt
    assert error > 5 * doubt  # the mesh is what is wrong


# Cells whose bars are nearest to their errors, so that two fifths of
# their factors would not cover them. Values of the mesh "fine", of the last one of
# "reference".
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
SHARP_HOLE = (
    cell(0.6718093377, 0.5558903487, 1.517523357, 1.3096561, 1.09357001, 3.66468821),
    0.1776699277,
    Incidence(0.9744799279),
)
# within 0.2 % of the cutoff of an order of the substrate, where bars were a fifteenth
# of the error
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
# the coarse mesh moves the answer towards a resonance: to first order its bar was 0.73
# of the error
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
TIGHT = [
    ("resonance", RESONANCE, 0.34589408 - 0.84357195j, -0.38868479 - 0.13292020j, EVEN),
    ("tall", TALL, 0.69795654 + 0.65842580j, -0.06944216 + 0.27296506j, FAIR),
    ("dark", DARK, 0.19752507 - 0.08091882j, -0.43306048 - 0.87572519j, COARSE),
    ("dark", DARK, 0.19752507 - 0.08091882j, -0.43306048 - 0.87572519j, EVEN),
    ("towards", TOWARDS, 0.47494602 - 0.74169206j, -0.37879414 - 0.28431349j, COARSE),
    (
        "forms alike",
        FORMS_ALIKE,
        0.21386131 - 0.91826247j,
        -0.31857679 - 0.09780695j,
        FAIR,
    ),
    (
        "many orders",
        MANY_ORDERS,
        -0.38280652 + 0.40235310j,
        -0.06895376 + 0.10798189j,
        EVEN,
    ),
    ("taller", TALLER, 0.21283293 + 0.65345647j, 0.17572653 + 0.16581570j, FAIR),
    (
        "sharp hole",
        SHARP_HOLE,
        0.72350856 + 0.56291204j,
        -0.17304880 + 0.36016596j,
        FAIR,
    ),
]


@pytest.mark.parametrize(
    ("name", "drawn", "t", "r", "rung"),
    TIGHT,
    ids=[f"{one[0]}, {one[4].name}" for one in TIGHT],
)
def test_bars_that_are_tight_hold_and_would_not_with_two_fifths_of_their_factors(
    name, drawn, t, r, rung
):
    case = case_of(*drawn)
    found = solve_on_mesh(case, rung.choice(case.rho).plan, weak=rung.weak)
    error = max(abs(found.matrix[1, 0] - t), abs(found.matrix[0, 0] - r))
    assert 1.1 * error < rung.error(found, case.rho) < 2.5 * error


# an order of the substrate that has just begun to propagate, 2.4e-5 of the wavelength
# beyond
BESIDE_CUTOFF = (
    cell(0.58388739, 0.53453013, 2.73798679, 1.58821564, 1.08200867, 1.18564028),
    0.31785514,
    Incidence(0.92731673),
)


@pytest.mark.parametrize(
    ("drawn", "t"),
    [(AT_CUTOFF, 0.59499749 + 0.08338888j), (BESIDE_CUTOFF, 0.16935653 + 0.76916784j)],
    ids=["at a cutoff", "beside it"],
)
@pytest.mark.parametrize("rung", RUNGS[:4], ids=[rung.name for rung in RUNGS[:4]])
def test_forms_that_err_alike_at_a_cutoff_are_told_by_every_mesh(drawn, t, rung):
    """Values of the mesh "reference". Beside the cutoff the coarse mesh errs by 1.7
    times half of what its forms differ
    by; without the factors of cutoffs its bar was 0.98 of the error."""
    case = case_of(*drawn)
    found = solve_on_mesh(case, rung.choice(case.rho).plan, weak=rung.weak)
    assert found.grazing > 0
    assert abs(found.matrix[1, 0] - t) < 0.5 * rung.error(
        found, case.rho
    )  # of other cells at cutoffs errors scatter


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


@pytest.mark.parametrize(
    ("drawn", "t", "r", "settles"),
    [
        (MANY_WAVES, -0.103976730 - 0.945579631j, -0.305278606 + 0.043278874j, True),
        (LOWER, 0.797248598 + 0.180769351j, 0.369868697 - 0.051521402j, False),
    ],
    ids=["of many waves", "at a cutoff"],
)
def test_cells_of_damped_waves_have_bars_of_three_errors_from_how_the_answer_settles(
    drawn, t, r, settles
):
    """Of 257 cells those whose bars are nearest to their errors, of their kinds; values
    of the mesh "finest". By the
    forms' difference and the change over the damping the bars are 6 and 13 times the
    error, and stay so at a cutoff."""
    case = case_of(*drawn)
    coarse, fair, found = (
        solve_on_mesh(case, rung.choice(case.rho).plan, weak=rung.weak)
        for rung in RUNGS[:3]
    )
    error = max(abs(found.matrix[1, 0] - t), abs(found.matrix[0, 0] - r))
    bar, usual = (
        EVEN.error(found, case.rho, (coarse, fair)),
        EVEN.choice(case.rho).after.bound(found, (coarse, fair)),
    )
    assert usual > 5 * error
    if settles:
        assert 2 * error < bar < 3.7 * error
    else:
        assert found.cutoff > NEAREST
        assert bar == pytest.approx(
            usual, rel=1e-9
        )  # but for what no mesh tells, 1e-12


def test_a_sharp_resonance_of_a_hole_is_told_by_the_meshes_before():
    """Both forms of the mesh "good" lie six times as near to each other as to the
    finest mesh. How the answer settles
    over the damping of the layer's waves tells it, on the mesh before too, and so does
    the climb."""
    t, r = TIGHT[-1][2:4]
    drawn, made = case_of(*SHARP_HOLE), []
    for rung in RUNGS[:4]:
        made.append(solve_on_mesh(drawn, rung.choice(drawn.rho).plan, weak=rung.weak))
    assert made[3].damping < 0.1 < made[1].damping
    for i in (2, 3):
        error = max(abs(made[i].matrix[1, 0] - t), abs(made[i].matrix[0, 0] - r))
        assert 1.1 * error < RUNGS[i].error(made[i], drawn.rho, made[:i]) < 2.6 * error
        assert i == 2 or abs(made[i].matrix[1, 0] - t) > 3 * RUNGS[i].error(
            made[i], drawn.rho
        )
    found = modal.solve(
        SHARP_HOLE[0], SHARP_HOLE[1], SHARP_HOLE[2].wavelength_um, tolerance=0.1
    )
    assert found.converged
    assert 1.1 * max(abs(found.t - t), abs(found.r - r)) < found.t_error


def case(**other):
    usual = {
        "rho": 0.5,
        "k0": 2.0,
        "height": 4.0,
        "below": 2.1,
        "above": 1.0,
        "disc": 9.0,
        "around": 1.2,
        "bloch": 0.1,
    }
    return ModalCase(**(usual | {"p": False} | other))


@pytest.mark.parametrize(
    ("other", "want"),
    [
        ({}, 0.0),
        ({"disc": 2.5}, 0.0),
        ({"disc": 2.3}, 1.0),
        ({"disc": 1.1}, 3.0),
        ({"disc": -6.0 + 4.0j}, 0.0),  # a metal
        ({"around": 9.5}, 3.0),
        ({"height": 0.49}, 1.0),
        ({"height": 16.5}, 1.0),
        ({"k0": 2 * math.pi / 3 + 0.01}, 1.0),  # two waves of index 3
        ({"below": 2.8}, 1.0),  # 1.07 waves of the substrate
        ({"above": 2.8}, 1.0),
        ({"bloch": 1.01}, 1.0),
        ({"around": 2.51}, 0.0),
        ({"around": 2.53}, 1.0),  # 1.2 times as dense as either half-space
        ({"around": 2.53, "above": 2.2}, 0.0),
    ],
)
def test_cells_outside_the_calibrated_regime(other, want):
    assert case(**other).regime_factor == want


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
