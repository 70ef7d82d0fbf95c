"""Frames of lenses on a hexagonal lattice, and of pillars turned one by one, are sums
over their pillars.
"""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
import bench_lens as b

from characterize.bench import bench
from characterize.model import ForwardModel, FrameSetting, parameter_vector
from characterize.model import as_built as as_built
from metalens.cell import Cell, Lattice
from metalens.cell.shapes import Circle, Rectangle
from metalens.lens import DiameterMap, Lens

PITCH, PIXEL, PIXELS, DEPTHS = 0.43, 1.5, 12, (310.0, 420.0, 640.0)
VALUES = {
    "bias_nm": 3.0,
    "bias_x_nm": 4.0,
    "decentre_x_um": 0.7,
    "decentre_y_um": -0.4,
    "stage_zero_um": 6.0,
}
HEX = Lattice("hexagonal")


def made(hexagonal, hand=""):
    """A lens of 19 by 24 um that focuses 400 um to 70 um, its pillars a little off;
    sites by hand: (x, y, D, turn).
    """
    random = np.random.default_rng(5)
    ny, nx = 45, 56
    step = PITCH / 2 if hexagonal else PITCH
    row = PITCH * math.sqrt(3) / 2 if hexagonal else PITCH
    x, y = np.meshgrid(
        (np.arange(nx) - (nx - 1) / 2) * step, (np.arange(ny) - (ny - 1) / 2) * row
    )
    wanted = -2 * math.pi / 0.85 * (x**2 + y**2) / 2 * (
        1 / 400 + 1 / 70
    ) + 0.3 * random.standard_normal(x.shape)
    proxy = b.proxy()
    table = np.linspace(0.1, 0.25, 400)
    off = np.angle(np.exp(1j * (proxy.phase_rad(table, 0.85) - wanted[..., None])))
    diameter = table[np.abs(off).argmin(-1)]
    turn = None
    if hand:
        turn = wanted / (2 if hand == "right" else -2)
        diameter = np.full(x.shape, 0.171)
    diameter = np.where(
        (x**2 / 12**2 + y**2 / 9.5**2 < 1) & (x + y < 14), diameter, 0.0
    )
    if hexagonal:
        diameter[np.add.outer(np.arange(ny), np.arange(nx)) % 2 == 1] = 0.0
    about = {"lattice": HEX} if hexagonal else {}
    cell = Cell(pitch_um=PITCH, shape=Rectangle(0.6) if hand else Circle(), **about)
    laid = DiameterMap(diameter, PITCH, angle_rad=turn, **about)
    lens = Lens(laid, cell, proxy, 0.85, 70.0, 400.0, "map", hand=hand)
    on = diameter > 0
    return lens, (
        x[on],
        y[on],
        diameter[on],
        np.zeros(on.sum()) if turn is None else turn[on],
    )


def summed(lens, sites, sign):
    """(frames, y, x) |sum over pillars|² in the pixels, by three Gauss points along
    each axis of one.
    """
    x, y, diameter, turn = sites
    k = 2 * math.pi / 0.85
    grown = diameter + 1e-3 * (
        VALUES["bias_nm"] + VALUES["bias_x_nm"] * x / np.hypot(x, y).max()
    )
    phase = lens.proxy.phase_rad(grown, 0.85)
    size = lens.proxy.transmission(grown, 0.85)
    t = size * np.exp(1j * (phase + sign * 2 * turn))
    gauss, weight = np.polynomial.legendre.leggauss(3)
    at = ((np.arange(PIXELS) - (PIXELS - 1) / 2)[:, None] + gauss / 2).ravel() * PIXEL
    out = []
    for depth in DEPTHS:
        z = depth + VALUES["stage_zero_um"]
        light = t * np.exp(1j * k * (np.sqrt(x**2 + y**2 + z**2) - z))
        field = np.empty((len(at), len(at)), complex)
        for row, Y in zip(field, at + VALUES["decentre_y_um"], strict=True):
            X = (at + VALUES["decentre_x_um"])[:, None]
            r = np.sqrt((X - x) ** 2 + (Y - y) ** 2 + 70.0**2)
            row[:] = (
                light
                * 70.0
                / (2 * math.pi * r**2)
                * (1 / r - 1j * k)
                * np.exp(1j * k * (r - 70.0))
            ).sum(1)
        shares = np.kron(np.eye(PIXELS), weight / 2)
        out.append(shares @ np.abs(field) ** 2 @ shares.T / z**2)
    return np.array(out)


@pytest.mark.parametrize(
    ("hexagonal", "hand", "sign"),
    [(True, "", 0), (False, "right", 1), (True, "left", -1)],
)
def test_frames_are_the_sum_over_every_pillar(hexagonal, hand, sign):
    """To 1e-3 of the peak, which the reduced model keeps of frames; and as bright, by
    the area of a site.
    """
    lens, sites = made(hexagonal, hand)
    setting = FrameSetting(
        np.array(DEPTHS), np.zeros((3, 2)), np.ones(3), PIXEL, PIXELS, PIXELS
    )
    model = ForwardModel(lens, setting, b.RESPONSE)
    got = model.images(parameter_vector(VALUES | {"crosstalk_px": 0.0}))[0]
    want = summed(lens, sites, sign)
    site = PITCH**2 * (math.sqrt(3) / 2 if hexagonal else 1.0)
    bright = site**2 * PIXEL**2 * model.reference_um**2 / (len(sites[0]) * site)
    assert abs(got - bright * want).max() < 2e-3 * bright * want.max()


@pytest.mark.parametrize(
    ("hexagonal", "hand", "sign"), [(True, "", 0), (True, "right", 1)]
)
def test_the_bench_shows_the_sum_over_every_pillar(hexagonal, hand, sign):
    lens, sites = made(hexagonal, hand)
    known = tuple(
        b.KnownValue(name, value)
        for name, value in (VALUES | {"crosstalk_px": 0.0}).items()
    )
    truth = bench.HiddenLens(
        DEPTHS, parameter=known, camera=bench.BenchCamera(pixel_um=PIXEL, pixels=PIXELS)
    )
    got = bench.bench_irradiance(lens, truth, b.RESPONSE)
    want = summed(lens, sites, sign)
    got *= (got * want).sum() / (got**2).sum()
    assert abs(got - want).max() < 2e-3 * want.max()


def test_the_lens_as_built_lies_on_the_lattice_of_its_design_and_keeps_its_turns():
    lens, _ = made(True, "left")
    grown = as_built.built_lens(
        lens, parameter_vector({"bias_nm": 3.0, "distance_um": 1.5})
    )
    assert (grown.diameters.lattice, grown.hand, grown.sensor_distance_um) == (
        HEX,
        "left",
        71.5,
    )
    assert np.array_equal(grown.diameters.angle_rad, lens.diameters.angle_rad)
    on = lens.diameters.diameter_um > 0
    assert grown.diameters.diameter_um[on] == pytest.approx(0.174)
    assert not grown.diameters.diameter_um[~on].any()
