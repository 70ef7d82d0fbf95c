"""Discs of the other orders: radii by the rays that an order of a lens turns, light by its share and cos⁴."""

import math
from types import SimpleNamespace

import pytest
import torch

from metalens.cell import Film, Index
from metalens.field import Layers, stray
from metalens.image.scene import Frames

GRID = SimpleNamespace(frame=(90, 120), step_um=7.0, margin=4, spare=3, samples=(76, 106))
D, FOCUS, DEPTH, RADIUS = 2000.0, 21e3, 30e3, 60.0
SHARES = {-1: 0.03, 0: 0.05, 2: 0.02, 3: 0.01}


class Wave:
    focus = SimpleNamespace(wavelength_um=0.85, source_distance_um=FOCUS)
    radius_um = RADIUS

    def orders(self, wavelength_um, orders):
        assert (wavelength_um, tuple(orders)) == (0.85, (-1, 0, 2, 3))
        return SHARES


@pytest.mark.parametrize("glass_um", [0.0, 600.0])
def test_a_source_gives_a_disc_an_order_with_the_light_of_its_share(monkeypatch, glass_um):
    """Rays of order m land at r (1 + d/z) - m d r (1/d + 1/s): one pixel of light, off the middle of the field.

    Glass of index 1.5 on the sensor counts by its thickness over its index, and d stays 2 mm.
    """
    monkeypatch.setattr(stray, "PillarWave", Wave)
    layers = Layers(behind=(Film(Index(1.5), glass_um),))
    optics = SimpleNamespace(wave=Wave(), distance_um=D + glass_um / 3, layers=layers)
    middle = (310.0, -240.0)
    made = stray.stray_of(optics, GRID, DEPTH, middle)
    assert made.shares is SHARES
    light = torch.zeros(1, 2, 90, 120)
    row, column = 40, 66
    light[0, 1, row, column] = 5.0
    frames = Frames(light, torch.ones_like(light), torch.full_like(light, DEPTH))
    image = stray.add_stray(torch.full((1, 76, 106), 0.25), frames, made, GRID)[0].numpy() - 0.25
    x = (column - 59.5) * 7 + middle[0]
    y = (row - 44.5) * 7 + middle[1]
    cosine4 = (D**2 / (D**2 + x**2 + y**2)) ** 2
    assert image.sum() == pytest.approx(5 * cosine4 * sum(SHARES.values()), rel=0.01)  # rims in steps of a pixel
    radius = {m: max(abs(RADIUS * (1 + D / DEPTH) - m * D * RADIUS * (1 / D + 1 / FOCUS)), 7.0) for m in SHARES}
    for off in ((0, 0), (0, 8), (-13, 0), (9, 12), (-20, 3)):
        away = 7 * math.hypot(*off)
        want = 5 * cosine4 * sum(s * 49 / (math.pi * radius[m] ** 2) for m, s in SHARES.items() if away < radius[m])
        assert all(abs(away - r) > 3.5 for r in radius.values())  # clear of the rims
        assert image[row - 7 + off[0], column - 7 + off[1]] == pytest.approx(want, rel=1e-3, abs=1e-6)


def test_a_smooth_phase_has_one_order_alone():
    assert stray.stray_of(SimpleNamespace(wave=object(), distance_um=D), GRID, DEPTH, (0.0, 0.0)) is None
