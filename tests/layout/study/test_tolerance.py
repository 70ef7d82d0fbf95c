"""Tolerance: the reduced model against the plain sum with every pillar changed, limits."""

import dataclasses
import functools
import math

import numpy as np
import pytest

from layout.mask import fields
from layout.process.process import Process, WriteField
from layout.study import focus, stitching, tolerance
from layout.study import page as study_page
from layout.study.sensitivity import compute_sensitivities
from layout.study.spread_model import reduce_spread, reduction_error
from metalens import modal
from metalens.cell.lattice import Lattice
from metalens.cell.record import Cell, Index, Layer
from metalens.cell.shapes import Circle, Rectangle, Square
from metalens.core.errors import ProcessError
from metalens.fabrication import (
    ResponseError,
    ResponseRates,
    Spread,
    draw_lenses,
    names_of_kind,
    perturbed_transmission,
    solved_rates,
)
from metalens.lens.record import DiameterMap, Lens
from tests.proxies import proxy_of
from tests.referees import plain_sum

PROXY = proxy_of([4.6, 4.2, 0.5, 0.3], [0.9, 0.02, 0.04], (0.1, 0.3), 0.85)
DIAMETERS = np.linspace(0.1, 0.3, 9)
SENS = ResponseRates(
    DIAMETERS[:, None],
    np.array(
        [
            8j + 30j * (DIAMETERS - 0.1) - 1.0,
            0.3j + 25j * (DIAMETERS - 0.1),
            0.2 + 5j * (DIAMETERS - 0.2),
        ]
    ),
    0.01,
    np.zeros(9),
)


def hyperbolic(n=161, distance_um=150.0, source_um=1500.0):
    x = (np.arange(n) - (n - 1) / 2) * 0.4
    r = np.hypot(x, x[:, None])
    path = np.sqrt(r**2 + distance_um**2) + np.sqrt(r**2 + source_um**2)
    table = np.arange(0.1, 0.3, 0.002)
    phase = PROXY.phase_rad(table, 0.85)
    table = table[phase < phase[0] + 2 * np.pi]
    phase = phase[phase < phase[0] + 2 * np.pi]
    wanted = np.remainder(-2 * np.pi / 0.85 * path - phase[0], 2 * np.pi)
    diameter = table[
        np.clip(np.searchsorted(phase - phase[0], wanted), 0, len(table) - 1)
    ]
    diameters = DiameterMap(np.where(r < n * 0.2, diameter, 0), 0.4)
    return Lens(diameters, Cell(0.4), PROXY, 0.85, distance_um, source_um, "hyperbolic")


def hexagonal():
    """The hyperbolic lens with its pillars on the sites of a hexagonal lattice,
    squares.
    """
    made = hyperbolic()
    cell = Cell(0.44, lattice=Lattice("hexagonal"), shape=Square())
    d = made.diameters.diameter_um.copy()
    d[np.add.outer(*map(np.arange, d.shape)) % 2 == 1] = 0
    return dataclasses.replace(
        made, cell=cell, diameters=DiameterMap(d, 0.44, cell.lattice)
    )


def turned(n=161):
    """Rectangles, each turned so that left circular light, whose phase falls by twice
    the turn, has a focus.
    """
    made, cell = hyperbolic(n), Cell(0.4, shape=Rectangle(0.5))
    d = made.diameters.diameter_um
    x, y = made.diameters.x_um, made.diameters.y_um[:, None]
    turn = (
        np.pi
        / 0.85
        * (np.hypot(np.hypot(x, y), 150.0) + np.hypot(np.hypot(x, y), 1500.0))
        % np.pi
    )
    sizes = np.where(d > 0, 0.2 + 0.0005 * x, 0.0)
    return dataclasses.replace(
        made, cell=cell, hand="left", diameters=DiameterMap(sizes, 0.4, angle_rad=turn)
    )


@pytest.mark.parametrize("made", [hyperbolic, hexagonal, turned])
def test_a_drawn_lens_sends_the_light_of_pillars_changed_one_by_one(made):
    lens = made()
    turn = lens.diameters.angle_rad
    swung = 1.0 if turn is None else np.exp(-2j * turn)
    where = focus.FocusWindow(
        np.linspace(-2, 3, 3),
        np.linspace(-1, 4, 3),
        150.0,
        0.85,
        np.array([1500.0, 1200.0]),
    )
    model = reduce_spread(
        lens, SENS, focus.prepare_focus(lens, where), Spread(), seed=0
    )
    lenses = draw_lenses(Spread(), 4, seed=9)
    fast = model.focus.light(model.drawn([each.state() for each in lenses]))
    x, y = (
        axis / lens.diameters.radius_um
        for axis in (lens.diameters.x_um, lens.diameters.y_um[:, None])
    )
    for draw, light in zip(lenses, fast, strict=True):
        d, a = lens.diameters.diameter_um, draw.amounts
        along = x * np.cos(draw.turn_rad) + y * np.sin(draw.turn_rad)
        bias_nm = (
            a["bias_nm"]
            + a["gradient_nm"] / 2 * along
            + a["bow_nm"] * (x**2 + y**2 - 0.5)
        )
        made = np.where(d > 0, d + bias_nm * 1e-3, 0.2)
        height, index, wall = SENS.at(made)[:3]
        change = (
            height * a["height_nm"] * 1e-3
            + index * a["index"]
            + wall * np.deg2rad(a["sidewall_deg"])
        )
        t = perturbed_transmission(
            PROXY, SENS, made, 0.85, np.zeros(len(names_of_kind(ResponseError)))
        ) * np.exp(change)
        exact = plain_sum.field(lens, np.where(d > 0, t * swung, 0), where)
        assert abs(light - exact).max() < 2e-3 * abs(exact).max()
    assert reduction_error(model, lenses) < 2e-3
    assert len(model.basis) <= 12


def test_no_spread_leaves_the_lens_as_it_is():
    still = Process(spread=Spread.only())
    report = tolerance.analyse_tolerance(
        hyperbolic(), still, sens=SENS, depths_um=(1200.0,), draws=10
    )
    assert report.draws.strehl == pytest.approx(np.ones(10), abs=1e-5)
    assert report.draws.psf_change == pytest.approx(np.zeros(10), abs=1e-5)
    assert all(effect.phase_rad < 1e-12 for effect in report.effects)


def test_effects_and_bands_of_a_lens():
    report = tolerance.analyse_tolerance(
        hyperbolic(), Process(), sens=SENS, depths_um=(1200.0, 2000.0), draws=40, seed=3
    )
    assert [effect.cause for effect in report.effects] == list(Spread().stated)
    low, middle, high = report.band("information")
    assert low.shape == (2,)
    assert (low < middle).all()
    assert (middle < high).all()
    # a phase spread s costs exp(-s^2) of the peak; height changes phase and, by its
    # real part, the level
    height = report.effects[list(Spread().stated).index("height_nm")]
    assert height.strehl == pytest.approx(
        1 - np.exp(-(height.phase_rad**2) - 2 * 1.0 * 0.007), abs=0.004
    )
    assert report.error < 2e-3
    assert 0.4 < report.nominal.efficiency[0] < 1


def test_the_effect_of_a_bias_on_the_phase_is_the_slope_of_the_proxy():
    lens = hyperbolic()
    small = Process(spread=dataclasses.replace(Spread(), bias_nm=0.1))
    report = tolerance.analyse_tolerance(
        lens, small, sens=SENS, depths_um=(1200.0,), draws=10
    )
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    slope = PROXY.dphase_ddiameter(d, 0.85)
    assert report.effects[0].phase_rad == pytest.approx(1e-4 * slope.std(), rel=0.02)


def test_axial_information_is_equation_11_of_the_direct_psf():
    lens = hyperbolic()
    report = tolerance.analyse_tolerance(
        lens, Process(), sens=SENS, depths_um=(1200.0,), draws=10
    )
    # the rim 1.75 waves out; beyond: ten times as far
    near = 1 / (1 / 1500 + 3.5 * 0.85 / lens.diameters.radius_um**2)
    # both ends rounded to two digits
    assert report.step_um == pytest.approx(9 * near / 50, rel=0.02)
    where = dataclasses.replace(
        report.window, depths_um=np.array([1200.0, 1200.0 + report.step_um])
    )
    t = lens.transmission() * np.exp(1j * lens.phase_rad())
    few = dataclasses.replace(where, x_um=where.x_um[::2], y_um=where.y_um[::2])
    psf = abs(plain_sum.field(lens, t, few)) ** 2
    ready = focus.prepare_focus(lens, where)
    fast = abs(ready.light(ready.project(t[None]))[0]) ** 2
    assert abs(fast[:, ::2, ::2] - psf).max() < 1e-4 * psf.max()
    unit = fast / fast.sum((1, 2), keepdims=True)
    want = ((unit[1] - unit[0]) ** 2).sum() / report.step_um**2
    assert report.nominal.information[0, 0] == pytest.approx(want, rel=2e-3)


FILM = Layer(0.2, material=Index(1.0))  # has no part in what the pillar's index does


@pytest.mark.parametrize(
    ("shape", "lattice", "share", "layers"),
    [
        (Circle(), Lattice(), np.pi / 4 * 5 / 7, (Layer(0.3), FILM, Layer(0.2))),
        (Rectangle(0.6), Lattice("hexagonal"), 0.6 / (math.sqrt(3) / 2), ()),
    ],
)
def test_sensitivities_of_a_film_of_air_are_its_optical_path(
    shape, lattice, share, layers, monkeypatch
):
    """Of any shape on any lattice: an index change counts by the share of the volume
    that the pillar's own material fills.
    """
    monkeypatch.setattr(solved_rates, "_TRUNCATIONS", (1, 2))  # t is exact at any
    # pillars of the index of what is between them do not exist: t = exp(ik n h) up to a
    # constant
    film = Cell(
        0.3, pillar="air", substrate="air", shape=shape, lattice=lattice, layers=layers
    )
    narrow = dataclasses.replace(PROXY, domain_um=(0.1, 0.25))
    lens = dataclasses.replace(hyperbolic(), cell=film, proxy=narrow)
    found = compute_sensitivities(lens, count=2)
    assert found.rates[0] == pytest.approx(np.full(2, 2j * np.pi / 0.85), abs=1e-6)
    assert found.rates[2] == pytest.approx(np.zeros(2), abs=1e-6)
    # to first order in the contrast (and no coupling)
    filled = share * found.sizes_um[:, 0] ** 2 / 0.3**2
    assert found.rates[1].imag == pytest.approx(
        2 * np.pi / 0.85 * 0.7 * filled, rel=0.03
    )


def test_too_few_draws_are_refused():
    with pytest.raises(ProcessError, match="10 or more"):
        tolerance.analyse_tolerance(hyperbolic(), Process(), sens=SENS, draws=5)


def _drawn(study, most, *given, **more):
    """A study of few draws."""
    return study(*given, **more | {"draws": most})


def test_a_turned_lens_has_its_study(monkeypatch):
    for module, name, most in (
        (tolerance, "analyse_tolerance", 10),
        (stitching, "simulate_stitching", 20),
    ):
        monkeypatch.setattr(
            module, name, functools.partial(_drawn, getattr(module, name), most)
        )
    lens = turned(51)
    process = Process(write_field=WriteField(size_um=10.0))
    made = study_page.study_sections(
        lens, process, fields.split_write_fields(lens.diameters, process), {"": SENS}
    )
    assert [section.title for section in made] == ["Stitching", "Tolerance"]
    assert "what keeps its hand has no focus" in made[1].text
    assert "walls" not in made[1].text


@pytest.mark.slow
def test_sensitivities_agree_with_an_independent_solver():
    cell = Cell(0.3, pillar=Index(3.6), substrate=Index(1.45))
    narrow = dataclasses.replace(PROXY, domain_um=(0.13, 0.16))
    found = compute_sensitivities(
        dataclasses.replace(hyperbolic(21), cell=cell, proxy=narrow), count=1
    )

    def rate(low, high, step, tolerance=1e-4):
        less, more = (
            modal.solve(each, 0.13, 0.85, tolerance=tolerance).t for each in (low, high)
        )
        return np.log(more / less) / (2 * step)

    height = rate(
        dataclasses.replace(cell, height_um=0.69),
        dataclasses.replace(cell, height_um=0.71),
        0.01,
    )
    index = rate(
        dataclasses.replace(cell, pillar=Index(3.58)),
        dataclasses.replace(cell, pillar=Index(3.62)),
        0.02,
    )
    # a wall acts in second order, of a twentieth of the height's size at 8 mrad:
    # differences are exact
    lean = 0.008
    leans = (dataclasses.replace(cell, sidewall_rad=sign * lean) for sign in (-1, 1))
    wall = rate(*leans, lean, 3e-4)  # 1.3 % from that at 1e-4, at a quarter of its cost
    # truncation of the plane waves: 1 to 2 % here
    assert abs(found.rates[0, 0] / height - 1) < 0.03
    assert abs(found.rates[1, 0] / index - 1) < 0.05
    # and 4 %; differences at four harmonics had the other sign
    assert abs(found.rates[2, 0] / wall - 1) < 0.08
    # between air and bulk
    assert 2 * np.pi / 0.85 < found.rates[0, 0].imag < 2 * np.pi / 0.85 * 3.6
