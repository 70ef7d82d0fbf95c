"""Studies of pillars of two sizes: against the plain sum with every pillar changed, and
derivatives by differences.
"""

import functools

import numpy as np
import pytest

from layout.mask import fields
from layout.process.process import Process, WriteField
from layout.study import focus, page, stitching, tolerance
from layout.study.spread_model import reduce_spread, reduction_error
from metalens.cell import Cell, Index
from metalens.cell.shapes import Rectangle
from metalens.core.report import Table
from metalens.fabrication import ResponseRates, Spread, draw_lenses
from metalens.lens import DiameterMap, Lens, TwoSizeTable
from tests.referees import plain_sum

X_UM, Y_UM = np.linspace(0.1, 0.3, 51), np.linspace(0.12, 0.28, 41)  # one step of 4 nm
# rad per um of width and of length, |t| of the thinnest
LIGHTS = {"x": (19.0, 9.0, 0.93), "y": (8.0, 21.0, 0.97)}


def formula(width_um, length_um, light):
    """t of the pillars, a closed form that bends."""
    wide, long, level = LIGHTS[light]
    phase = (
        wide * width_um
        + long * length_um
        + 15 * (width_um - 0.1) * (length_um - 0.1)
        - 12 * (width_um - 0.2) ** 2
    )
    return (level - 0.8 * (width_um - 0.1) ** 2) * np.exp(1j * phase)


def rates(width_um, length_um):
    """d ln t by height, index and wall."""
    height = -0.9 + 8j + 21j * (width_um - 0.1) + 9j * (length_um - 0.1)
    return np.array(
        [height, 0.2j + 17j * width_um * length_um, 0.3 + 4j * (length_um - 0.2)]
    )


def two_sizes(n=71):
    """Light along x has its focus 150 um behind, light along y 170 um; every pair is of
    the table.
    """
    x = (np.arange(n) - (n - 1) / 2) * 0.4
    r = np.hypot(x, x[:, None])
    places = [np.hypot(r, z) + np.hypot(r, 1500.0) for z in (150.0, 170.0)]
    wanted = [np.exp(-2j * np.pi / 0.85 * place) for place in places]
    grid = np.meshgrid(X_UM[::5], Y_UM[::4], indexing="ij")
    kinds = np.stack([formula(*grid, light).ravel() for light in "xy"])
    off = sum(
        abs(want[..., None] - t) ** 2 for want, t in zip(wanted, kinds, strict=True)
    )
    best = off.argmin(-1)
    there = r < n * 0.2
    width, length = (np.where(there, axis.ravel()[best], 0.0) for axis in grid)
    table = np.stack(
        [formula(*np.meshgrid(X_UM, Y_UM, indexing="ij"), light) for light in "xy"], -1
    )[None]
    pairs = TwoSizeTable(np.array([0.85]), X_UM, Y_UM, table, (170.0, 1500.0))
    cell = Cell(0.4, 0.6, Index(2.7), shape=Rectangle())
    diameters = DiameterMap(width, 0.4, length_um=length)
    return Lens(
        diameters, cell, pairs.proxy, 0.85, 150.0, 1500.0, "hyperbolic", pairs=pairs
    )


def told(lens):
    """The closed form's answers at every pair that the lens has."""
    d = lens.diameters
    pairs = np.unique(
        np.stack([d.diameter_um[d.diameter_um > 0], d.length_um[d.diameter_um > 0]], 1),
        axis=0,
    )
    return ResponseRates(pairs, rates(*pairs.T), 0.02, np.zeros(len(pairs)))


@pytest.mark.parametrize("light", ["x", "y"])
def test_a_drawn_lens_sends_the_light_of_pairs_changed_one_by_one(light):
    """Basis and sums leave 2e-3, splines over steps of 4 nm and answers held at the
    designed sizes less.
    """
    lens = two_sizes().for_polarization(light)
    away = {"x": 150.0, "y": 170.0}[light]
    where = focus.FocusWindow(
        np.linspace(-2, 3, 3),
        np.linspace(-1, 4, 3),
        away,
        0.85,
        np.array([1500.0, 1200.0]),
    )
    model = reduce_spread(
        lens, told(lens), focus.prepare_focus(lens, where), Spread(), seed=0
    )
    lenses = draw_lenses(Spread(), 3, seed=9)
    fast = model.focus.light(model.drawn([each.state() for each in lenses]))
    x, y = (
        axis / lens.diameters.radius_um
        for axis in (lens.diameters.x_um, lens.diameters.y_um[:, None])
    )
    wide, long = lens.diameters.diameter_um, lens.diameters.length_um
    for draw, seen in zip(lenses, fast, strict=True):
        a = draw.amounts
        along = x * np.cos(draw.turn_rad) + y * np.sin(draw.turn_rad)
        bias_um = 1e-3 * (
            a["bias_nm"]
            + a["gradient_nm"] / 2 * along
            + a["bow_nm"] * (x**2 + y**2 - 0.5)
        )
        height, index, wall = rates(wide, long)
        change = (
            height * a["height_nm"] * 1e-3
            + index * a["index"]
            + wall * np.deg2rad(a["sidewall_deg"])
        )
        t = formula(wide + bias_um, long + bias_um, light) * np.exp(change)
        exact = plain_sum.field(lens, np.where(wide > 0, t, 0), where)
        assert abs(seen - exact).max() < 2.5e-3 * abs(exact).max()
    assert reduction_error(model, lenses) < 2e-3


def test_the_report_has_both_lights_each_where_it_focuses(monkeypatch):
    lens = two_sizes(31)
    process = Process(write_field=WriteField(size_um=6.0))
    monkeypatch.setattr(
        page, "pair_sensitivities", lambda lens: {light: told(lens) for light in "xy"}
    )
    seen = []
    for module, name, most in (
        (tolerance, "analyse_tolerance", 10),
        (stitching, "simulate_stitching", 20),
    ):
        whole = getattr(module, name)

        def few(lens, *args, whole=whole, most=most, **about):
            seen.append((lens.light, lens.sensor_distance_um))
            return whole(lens, *args, draws=most, **about)

        monkeypatch.setattr(module, name, functools.wraps(whole)(few))
    made = page.study_sections(
        lens,
        process,
        fields.split_write_fields(lens.diameters, process),
        page.rates_by_light(lens),
    )
    titles = [
        f"{what}, light along {light}"
        for light in "xy"
        for what in ("Stitching", "Tolerance")
    ]
    assert [section.title for section in made] == titles
    assert seen == [("x", 150.0)] * 2 + [("y", 170.0)] * 2
    tables = [
        item for section in made for item in section.items if isinstance(item, Table)
    ]
    assert all(
        np.isfinite(v)
        for table in tables
        for row in table.rows
        for v in row
        if isinstance(v, float)
    )
