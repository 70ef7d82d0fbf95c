"""Pillars of two sizes in the fit: against a closed form of t, and the sum over every
pillar in double precision.
"""

import dataclasses
import functools
import math

import numpy as np
import pytest
from scipy import special

from characterize.inference import asbuilt, prepare
from characterize.model import (
    ForwardModel,
    FrameSetting,
    made,
    parameter_vector,
    pillar_slopes,
)
from characterize.model.pillars import PillarChange, of_lens, pillar_change_of
from metalens.cell import Cell, Index
from metalens.cell.shapes import Rectangle
from metalens.core.errors import LensError
from metalens.fabrication import (
    Kinds,
    PairSensitivities,
    ResponseError,
    Sensitivity,
    named,
)
from metalens.lens import DiameterMap, Lens, TwoSizeTable

X_UM, Y_UM = (
    np.linspace(0.06, 0.34, 71),
    np.linspace(0.08, 0.32, 61),
)  # steps of 4 nm, room for a bias on all sides
WAVE_UM, SENSOR_UM, DEPTH_UM = 0.85, 60.0, np.array([210.0, 330.0])
CAUSES = named(ResponseError)
MADE = {
    "bias_nm": 5.0,
    "bias_x_nm": -3.0,
    "bias_r_nm": 2.0,
    "height_nm": -6.0,
    "coma_y_rad": 0.15,
    "trefoil_x_rad": 0.1,
}
BENCH = {
    "decentre_x_um": 0.7,
    "decentre_y_um": -0.4,
    "distance_um": 1.5,
    "stage_zero_um": 4.0,
    "crosstalk_px": 0.25,
}


def formula(width_um, length_um, light):
    """t of the pillars, a closed form that bends; light along y turns by other rates."""
    wide, long, level = {"x": (21.0, 9.0, 0.93), "y": (8.0, 23.0, 0.97)}[light]
    phase = (
        wide * width_um
        + long * length_um
        + 15 * (width_um - 0.1) * (length_um - 0.1)
        - 12 * (width_um - 0.2) ** 2
    )
    return (level - 0.8 * (width_um - 0.1) ** 2) * np.exp(1j * phase)


def by_height(width_um, length_um):
    """d ln t by um of height: a plane over both sizes."""
    return -0.9 + 8j + 21j * (width_um - 0.1) + 9j * (length_um - 0.1)


@functools.lru_cache
def two_sizes(n=46):
    """Light along x has its focus 60 um behind, light along y 75 um; sizes are between
    100 and 300 nm.
    """
    x = (np.arange(n) - (n - 1) / 2) * 0.4
    r = np.hypot(x, x[:, None])
    wanted = [
        np.exp(-2j * np.pi / WAVE_UM * (np.hypot(r, z) + np.hypot(r, 260.0)))
        for z in (SENSOR_UM, 75.0)
    ]
    grid = np.meshgrid(X_UM[10:61:5], Y_UM[5:56:5], indexing="ij")
    kinds = np.stack([formula(*grid, light).ravel() for light in "xy"])
    best = sum(
        abs(want[..., None] - t) ** 2 for want, t in zip(wanted, kinds, strict=True)
    ).argmin(-1)
    there = r < n * 0.2
    width, length = (np.where(there, axis.ravel()[best], 0.0) for axis in grid)
    table = np.stack(
        [formula(*np.meshgrid(X_UM, Y_UM, indexing="ij"), light) for light in "xy"], -1
    )[None]
    pairs = TwoSizeTable(np.array([WAVE_UM]), X_UM, Y_UM, table, (75.0, 260.0))
    diameters = DiameterMap(width, 0.4, length_um=length)
    cell = Cell(0.4, 0.6, Index(2.7), shape=Rectangle())
    return Lens(
        diameters,
        cell,
        pairs.proxy,
        WAVE_UM,
        SENSOR_UM,
        260.0,
        "hyperbolic",
        pairs=pairs,
    )


def response(lens):
    """The closed form's answers at every pair that the lens has."""
    kinds = Kinds.of(lens.diameters)
    rates = np.zeros((len(CAUSES), len(kinds.count)), complex)
    rates[CAUSES.index("height_nm")] = by_height(kinds.width_um, kinds.length_um)
    return Sensitivity.of_pairs(
        PairSensitivities(kinds.width_um, kinds.length_um, rates, 0.02)
    )


def truth(lens, light):
    """(y, x) t of every pillar as made: all edges moved by the bias, then height and
    wave front.
    """
    d = lens.diameters
    u, v = np.meshgrid(d.x_um / d.radius_um, d.y_um / d.radius_um)
    bias_um = 1e-3 * (
        MADE["bias_nm"]
        + MADE["bias_x_nm"] * u
        + MADE["bias_r_nm"] * (u * u + v * v - 0.5)
    )
    front = MADE["coma_y_rad"] * math.sqrt(8) * (3 * (u * u + v * v) - 2) * v
    front = front + MADE["trefoil_x_rad"] * math.sqrt(8) * (u**3 - 3 * u * v * v)
    higher = by_height(d.diameter_um, d.length_um) * MADE["height_nm"] * 1e-3
    t = formula(d.diameter_um + bias_um, d.length_um + bias_um, light) * np.exp(
        higher + 1j * front
    )
    return np.where(d.diameter_um > 0, t, 0)


@pytest.mark.parametrize("light", ["x", "y"])
def test_a_bias_moves_both_sizes_of_every_pillar(light):
    """Cubic splines over steps of 4 nm leave 2e-6, sizes are told apart to 0.05 nm:
    1e-3 of a radian.
    """
    lens = two_sizes().seen(light)
    found = made.as_built_transmission(lens, response(lens), parameter_vector(MADE))
    assert np.abs(found - truth(lens, light)).max() < 2e-3
    assert np.abs(found - truth(lens, "yx"["xy".index(light)])).max() > 0.5


def test_kinds_are_told_apart_by_both_sizes():
    d = DiameterMap(
        np.array([[0.2, 0.1], [0.2, 0.0]]),
        0.4,
        length_um=np.array([[0.3, 0.15], [0.12, 0.0]]),
    )
    kinds = Kinds.of(d)
    assert kinds.width_um.tolist() == pytest.approx([0.1, 0.2, 0.2])
    assert kinds.length_um.tolist() == pytest.approx([0.15, 0.12, 0.3])
    assert kinds.count.tolist() == [1, 1, 1]
    assert kinds.index(d).tolist() == [[2, 0], [1, 3]]
    assert kinds.index(d, slice(1, 2), slice(0, 1)).tolist() == [[1]]


def test_the_basis_holds_every_kind_of_pillar_under_change():
    """Its error on changes that it was not made from, and that of a table's entry,
    against the closed form.
    """
    lens = two_sizes()
    pillars, kinds = of_lens(lens, response(lens)), Kinds.of(lens.diameters)
    assert pillars.error < 1e-3
    x = parameter_vector({"height_nm": 9.0})
    for bias_um in (-0.017, 0.0, 0.0123):
        want = formula(kinds.width_um + bias_um, kinds.length_um + bias_um, "x")
        want = want * np.exp(by_height(kinds.width_um, kinds.length_um) * 9e-3)
        assert np.abs(pillars.exact(bias_um, pillar_change_of(x)) - want).max() < 1e-4
        series = pillars.weights(np.array(bias_um)) @ pillars.coefficients(
            pillar_change_of(x)
        )
        entries = pillars.entries(lens.diameters, slice(3, 20), slice(5, 9))
        found, place = series @ pillars.table()[:, entries.ravel()], entries.ravel()
        assert np.abs(found - np.append(want, 0)[place]).max() < 1e-3


def summed(lens, setting):
    """(n, y, x) light of every pillar in double precision, by samples of 0.4 um: it has
    no waves below 2.8.
    """
    d, k, n, pixel = lens.diameters, 2 * np.pi / WAVE_UM, setting.rows, setting.pixel_um
    there = d.diameter_um > 0
    x, y = (g[there] for g in np.meshgrid(d.x_um, d.y_um))
    t = truth(lens, "x")[there]
    fine = 0.4 * np.arange(-22, 23)
    away = SENSOR_UM + BENCH["distance_um"]
    out = []
    for depth in DEPTH_UM + BENCH["stage_zero_um"]:
        path = np.sqrt(x * x + y * y + depth**2)
        lit = t * np.exp(1j * k * path) / path
        field = np.empty((len(fine), len(fine)), complex)
        for i, row in enumerate(fine + BENCH["decentre_y_um"]):
            r = np.sqrt(
                (fine[:, None] + BENCH["decentre_x_um"] - x) ** 2
                + (row - y) ** 2
                + away**2
            )
            field[i] = (np.exp(1j * k * r) * (away / r**2) * (1 / r - 1j * k)) @ lit
        apart = (fine[None] / pixel - (np.arange(n) - (n - 1) / 2)[:, None]) / (
            math.sqrt(2) * BENCH["crosstalk_px"]
        )
        half = 0.5 / (math.sqrt(2) * BENCH["crosstalk_px"])
        weight = special.erf(apart + half) - special.erf(apart - half)
        out.append(weight @ np.abs(field) ** 2 @ weight.T)
    return np.array(out)


def test_frames_are_those_of_the_sum_over_every_pillar():
    """1e-3 of the peak is what the model is held to for pillars of one size; light is
    compared up to its strength.
    """
    lens = two_sizes()
    setting = FrameSetting(DEPTH_UM, np.zeros((2, 2)), np.ones(2), 1.0, 8, 8)
    found = ForwardModel(lens, setting, response(lens)).images(
        parameter_vector(MADE | BENCH | {"background_e": 0.0})
    )[0]
    want = summed(lens, setting)
    found *= (found * want).sum() / (found**2).sum()
    assert np.abs(found - want).max() < 1.5e-3 * want.max()


def test_answers_of_both_sizes_are_kept_as_they_are_and_refused_over_one():
    lens = two_sizes()
    told = response(lens)
    again = pillar_slopes._unpacked(pillar_slopes._packed(told))
    assert again.error == 0.02
    for name in ("width_um", "length_um", "rates"):
        assert np.array_equal(getattr(again.pairs, name), getattr(told.pairs, name))
    with pytest.raises(LensError, match="two sizes"):
        told.at(np.array([0.2]))


def test_the_made_map_has_both_sizes_moved():
    lens = two_sizes()
    found = made.built_lens(lens, parameter_vector({"bias_nm": 4.0})).diameters
    there = lens.diameters.diameter_um > 0
    assert found.diameter_um[there] == pytest.approx(
        lens.diameters.diameter_um[there] + 4e-3
    )
    assert found.length_um[there] == pytest.approx(
        lens.diameters.length_um[there] + 4e-3
    )
    assert not found.length_um[~there].any()


def test_changes_of_the_wavelength_leave_t_as_the_table_has_it():
    lens = two_sizes()
    pillars = of_lens(lens, response(lens))
    for off in (0.0, 2e-3):
        found = pillars._at_nodes(PillarChange(wavelength_um=off))
        assert np.array_equal(found, pillars._at_nodes(PillarChange()))


def test_slopes_of_the_frames_are_their_differences():
    """Slopes are formed to 8e-3; steps of 0.1 nm leave 1e-4 of the second order."""
    lens = two_sizes(30)
    setting = FrameSetting(
        DEPTH_UM, np.zeros((2, 2)), np.ones(2), 1.0, 8, 8, tolerance=1e-7
    )
    model, x = (
        ForwardModel(lens, setting, response(lens)),
        parameter_vector(MADE | BENCH),
    )
    names = ("bias_nm", "bias_x_nm", "height_nm")
    slopes = model.images(x, names)[1]
    for name, slope in zip(names, slopes, strict=True):
        ends = [
            model.images(parameter_vector(MADE | BENCH | {name: MADE[name] + step}))[0]
            for step in (0.1, -0.1)
        ]
        want = (ends[0] - ends[1]) / 0.2
        assert np.abs(slope - want).max() < 1e-2 * np.abs(want).max(), name


def test_a_fit_is_kept_with_the_answers_of_both_sizes(tmp_path):
    lens = two_sizes()
    one, frames = np.ones(2), np.ones((2, 4, 4))
    fit = asbuilt.AsBuilt(
        design=lens, response=response(lens), names=("bias_nm", "height_nm"), value=np.array([4.0, -3.0]),
        covariance=np.eye(2), information=np.eye(2), held={"index": 0.0}, depth_um=one, angle_rad=np.zeros((2, 2)),
        pixel_um=3.0, measured=frames, predicted=frames, nominal=frames, residual_sigma=frames, chi2_per_dof=1.0,
        converged=True, reason="made up",
    )  # fmt: skip
    asbuilt.save(tmp_path / "asbuilt.h5", fit)
    again = asbuilt.load(tmp_path / "asbuilt.h5")
    assert np.array_equal(again.pillars(), fit.pillars())
    assert (
        np.abs(
            again.pillars()
            - made.as_built_transmission(lens, fit.response, parameter_vector())
        ).max()
        > 0.1
    )


def test_pillars_that_a_bias_leads_beyond_their_table_are_told_of():
    """Three pillars of four lie 4 nm off an end, 10 nm one of 81 and one of 121, which
    is below a hundredth.
    """
    lens = two_sizes()
    told = response(lens)
    assert prepare.roughly_known(lens, told) == []
    width, length = np.full((2, 2), 0.2), np.array([[0.2, 0.316], [0.084, 0.2]])
    width[1, 1] = 0.336
    few = dataclasses.replace(lens, diameters=DiameterMap(width, 0.4, length_um=length))
    (words,) = prepare.roughly_known(few, told)
    assert "75% of the pillars are within 15 nm of the ends" in words
    for n, many in ((9, 1), (11, 0)):
        width = np.full((n, n), 0.2)
        width[0, 0] = 0.07
        some = DiameterMap(width, 0.4, length_um=np.full((n, n), 0.2))
        assert (
            len(prepare.roughly_known(dataclasses.replace(lens, diameters=some), told))
            == many
        )
    assert prepare.roughly_known(lens, dataclasses.replace(told, error=0.098)) == []
    (words,) = prepare.roughly_known(lens, dataclasses.replace(told, error=0.102))
    assert words == "slopes of the pillars by height and index are known to 10% only"
    rough = dataclasses.replace(told, error=0.24)
    assert prepare.roughly_known(lens, rough) == [
        "slopes of the pillars by height and index are known to 24% only"
    ]
