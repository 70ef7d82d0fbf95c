"""A lens of rectangles whose width, length, edges or turn come out wrong: every pillar
solved anew, and added up.

The cell is solved at one truncation throughout, so that what is compared is the change
and nothing else.
"""

import dataclasses
import functools
import math

import numpy as np
import pytest
from numpy.polynomial import chebyshev

from characterize import next_mask
from characterize.model import as_built, parameter_vector, pillar_slopes
from codesign.evaluate.error_budget import BudgetInputs, ErrorBudget, scatter_rad
from codesign.optics import LensErrors, MadeLens, OpticsConfig
from codesign.optics.lens_errors import DrawnLensErrors, variance_rad2
from layout.process.process import Process
from layout.study import tolerance
from metalens.cell import Cell, Index
from metalens.cell.shapes import Circle, Rectangle
from metalens.core.errors import FitError, ProcessError
from metalens.fabrication import (
    Bias,
    PrintedProcess,
    ResponseError,
    Spread,
    State,
    draw_lenses,
    inapplicable_names,
    names_of_kind,
    proxy_sensitivity,
    solved_rates,
)
from metalens.lens import DiameterMap, Lens
from metalens.library import Proxy
from metalens.rcwa import jones, permittivity

WAVE, RATIO, HARMONICS = 0.633, 0.62, 6
CELL = Cell(
    0.32,
    height_um=0.55,
    pillar=Index(2.38),
    substrate=Index(1.46),
    shape=Rectangle(RATIO),
)
SIZES = np.array([0.142, 0.167, 0.19, 0.214, 0.233])
LOW, HIGH = 0.12, 0.255


@functools.cache
def solved(width_um, length_um, turn_rad=0.0):
    """t for light along x of a rectangle of these sides."""
    cell = dataclasses.replace(CELL, shape=Rectangle(length_um / width_um, turn_rad))
    return jones(cell, width_um, WAVE, harmonics=HARMONICS).t[0, 0]


@pytest.fixture(scope="module", autouse=True)
def coarse_normals():
    """The solver's normals at half of its points along the pitch: a quarter of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(permittivity, "_GRID", 96)
        yield


@pytest.fixture(scope="module")
def lens(coarse_normals):
    unit = np.cos(np.pi * (np.arange(9) + 0.5) / 9)
    size = (LOW + HIGH) / 2 + (HIGH - LOW) / 2 * unit
    t = np.array([solved(d, RATIO * d) for d in size])
    phase = np.unwrap(np.angle(t[::-1]))[::-1]
    curves = (chebyshev.chebfit(unit, v, 8)[None] for v in (phase, np.abs(t) - 1e-6))
    proxy = Proxy(*curves, (LOW, HIGH), (WAVE, WAVE), 1e-3, 1e-3)
    site = np.random.default_rng(8).integers(0, len(SIZES), (41, 37))
    y, x = np.arange(41)[:, None] - 20, np.arange(37) - 18
    d = np.where(np.hypot(y / 20.5, x / 18.5) <= 1, SIZES[site], 0)
    return Lens(DiameterMap(d, 0.32), CELL, proxy, WAVE, 15.0, math.inf, "map")


@pytest.fixture(scope="module")
def response(lens):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(solved_rates, "_TRUNCATIONS", (HARMONICS - 1, HARMONICS))
        # walls, which no test here leans: as few steps as there can be
        patch.setattr(solved_rates, "_WALL_STEP_RAD", 5e-5)
        return proxy_sensitivity(lens)


def seen(lens, t):
    """(points,) field of a lens behind it, by the plain sum over its pillars."""
    d = lens.diameters
    x, y = np.meshgrid(d.x_um, d.y_um)
    points = [(0.0, 0.0, 15.0), (1.3, -0.6, 15.0), (-0.4, 2.2, 11.0), (3.1, 1.7, 21.0)]
    away = [np.sqrt((x - a) ** 2 + (y - b) ** 2 + c * c) for a, b, c in points]
    return np.array([(t * np.exp(2j * np.pi / WAVE * r) / r).sum() for r in away])


def anew(lens, width=0.0, length=0.0, turn_deg=0.0, bias=0.0):
    """(y, x) t of pillars that are so many um wider and longer, biased on all edges,
    and turned: each size solved.
    """
    out = np.zeros(lens.diameters.diameter_um.shape, complex)
    for d in SIZES.tolist():
        t = solved(d + bias + width, RATIO * d + bias + length, math.radians(turn_deg))
        out[lens.diameters.diameter_um == d] = t
    return out


CHANGES = [{"bias_nm": 8.0}, {"width_nm": -5.0, "length_nm": 5.0, "bias_nm": 4.0}]


@pytest.mark.parametrize("change", CHANGES)
def test_a_lens_as_made_sends_the_light_of_its_own_rectangles(lens, response, change):
    """Second order is left out: (20 rad/um x 7 nm)² / 2 = 1 % of the change and of the
    light.
    """
    amounts = {"width": "width_nm", "length": "length_nm", "bias": "bias_nm"}
    truth = anew(
        lens, **{name: 1e-3 * change.get(row, 0.0) for name, row in amounts.items()}
    )
    got = seen(
        lens, as_built.as_built_transmission(lens, response, parameter_vector(change))
    )
    before = seen(lens, anew(lens))
    want = seen(lens, truth)
    assert abs(want - before).max() > 0.1 * abs(before).max()
    assert abs(got - want).max() < 0.02 * abs(before).max()


def test_a_turn_of_a_rectangle_whose_mirrors_lie_along_the_lattice_is_of_second_order(
    lens, response
):
    still = as_built.as_built_transmission(
        lens, response, parameter_vector({"turn_deg": 1.5})
    )
    assert (
        abs(
            still - as_built.as_built_transmission(lens, response, parameter_vector())
        ).max()
        < 1e-9
    )
    assert abs(anew(lens, turn_deg=1.5) - anew(lens)).max() < 2e-3


@pytest.mark.slow
def test_the_mask_study_has_the_phase_of_too_wide_rectangles(lens, monkeypatch):
    monkeypatch.setattr(solved_rates, "_TRUNCATIONS", (HARMONICS - 1, HARMONICS))
    found = tolerance.analyse_tolerance(
        lens, Process(spread=Spread.only(width_nm=4.0)), depths_um=(90.0,), draws=10
    )
    effect = next(e for e in found.effects if e.cause == "width_nm")
    there = lens.diameters.diameter_um > 0
    base = anew(lens)[there]
    turns = [anew(lens, width=step)[there] / base for step in (4e-3, -4e-3)]
    # the worse of both signs
    want = max(np.angle(turn / turn.mean()).std() for turn in turns)
    # the second order
    assert effect.phase_rad == pytest.approx(want, rel=0.05)


def test_the_budget_has_the_phase_of_rectangles_that_are_too_long(lens, response):
    ready = MadeLens(lens, OpticsConfig(), response=response)
    base = ready.pillars(State.of())[lens.diameters.diameter_um > 0].numpy()
    phases = [
        scatter_rad(
            ready.pillars(d.state())[lens.diameters.diameter_um > 0].numpy(), base
        )
        for d in draw_lenses(Spread.only(length_nm=5.0), 60, seed=5)
    ]
    there = lens.diameters.diameter_um > 0
    up, down = (anew(lens, length=step)[there] for step in (2e-3, -2e-3))
    rate = np.angle(up / down) / 4e-3
    assert np.sqrt(np.mean(np.square(phases))) == pytest.approx(
        5e-3 * rate.std(), rel=4 / math.sqrt(2 * 60)
    )  # four sigma of 60 draws


def test_training_draws_widths_as_of_round_pillars():
    """Mean over both polarisations, of first order: a pillar wider along x by a is one
    wider all round by a / 2.
    """
    wide = DrawnLensErrors({"width_nm": 6.0}).state()
    all_round = DrawnLensErrors({"bias_nm": 3.0}).state()
    rates = OpticsConfig().phase_rates
    # the slope of the guide is that of the proxy, smoothed
    assert variance_rad2(wide, rates) == pytest.approx(
        variance_rad2(all_round, rates), rel=0.05
    )
    assert variance_rad2(
        DrawnLensErrors({"length_nm": 6.0}).state(), rates
    ) == pytest.approx(variance_rad2(wide, rates), rel=1e-12)
    assert LensErrors(width_nm=3.0).deviations[-2:] == (3.0, 0.0)


def test_the_next_mask_moves_edges_so_far_that_the_phase_is_the_designed_one(
    lens, response
):
    """Rectangles come out 5 nm too narrow, 17 nm too long; with the edges moved as
    proposed, solved anew, they answer
    as designed up to a piston."""
    x = parameter_vector({"width_nm": -10.0, "length_nm": 12.0, "bias_nm": 5.0})
    plan = next_mask.propose_correction(lens, x, response=response, old=Bias())
    off = []
    for designed in SIZES.tolist():
        drawn = float(np.interp(designed, plan.designed_um, plan.drawn_nm)) * 1e-3
        moved = drawn - designed + 5e-3
        t = solved(designed + moved - 10e-3, RATIO * designed + moved + 12e-3)
        off.append(np.angle(t / solved(designed, RATIO * designed)))
    as_is = [
        np.angle(solved(d - 5e-3, RATIO * d + 17e-3) / solved(d, RATIO * d))
        for d in SIZES.tolist()
    ]
    assert np.ptp(as_is) > 0.05
    # second order, and 13 knots
    assert np.ptp(off) < 0.15 * np.ptp(as_is), (off, as_is)


def test_what_a_shape_cannot_have_is_refused_by_name_in_every_reader(lens):
    plain = dataclasses.replace(lens, cell=dataclasses.replace(CELL, shape=Circle()))
    assert inapplicable_names(plain.cell) == (
        "width_nm",
        "length_nm",
        "turn_deg",
        "pedestal_nm",
        "cap_nm",
    )
    assert inapplicable_names(CELL) == ("pedestal_nm", "cap_nm")
    with pytest.raises(FitError, match="length_nm"):
        pillar_slopes.log_response_slopes(plain, names={"length_nm"})
    with pytest.raises(ProcessError, match=r"spread\.turn_deg"):
        tolerance.analyse_tolerance(plain, Process(spread=Spread.only(turn_deg=0.2)))
    with pytest.raises(ProcessError, match=r"spread\.width_nm"):
        ErrorBudget(
            plain, BudgetInputs(mask=PrintedProcess(spread=Spread.only(width_nm=1.0)))
        )
    assert State.of({"width_nm": 3.0}).response_amounts()[
        names_of_kind(ResponseError).index("width_nm")
    ] == pytest.approx(3e-3)
