"""Discs of the other orders: radii by the rays that an order of a lens turns, light by
its share and cos⁴.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from metalens.image import Grid, stray
from metalens.optics import Layers, Stop

GRID = Grid((76, 106), 7.0, (20e3, 90e3), margin=4, window=15)  # a frame of 90 x 120
D, FOCUS, DEPTH, RADIUS = 2000.0, 21e3, 30e3, 60.0
SHARES = {-1: 0.03, 0: 0.05, 2: 0.02, 3: 0.01}


class Wave:
    focus = SimpleNamespace(wavelength_um=0.85, source_distance_um=FOCUS)
    radius_um = RADIUS

    def orders(self, wavelength_um, orders):
        assert (wavelength_um, tuple(orders)) == (0.85, (-1, 0, 2, 3))
        return SHARES


def test_a_smooth_phase_has_one_order_alone():
    assert (
        stray.stray_of(
            SimpleNamespace(wave=object(), distance_um=D), GRID, DEPTH, (0.0, 0.0)
        )
        is None
    )


HOLE, THICK, MIDDLE = 25.0, 80.0, (6.0, -4.0)


def _traced(field_um, order, rng):
    """(x, y) places on the sensor of rays that pass a hole before the lens, over those
    that are on the hole.
    """
    tangents = [a / D for a in field_um]
    across = rng.uniform(-1, 1, (2, 200_000))
    across = across[:, np.hypot(*across) < 1] * HOLE + np.array(MIDDLE)[:, None]
    source = -DEPTH * np.array(tangents)[:, None]
    pillar = source + (across - source) * DEPTH / (DEPTH - THICK)
    landed = np.array(field_um)[:, None] + pillar * (
        1 + D / DEPTH - order * (1 + D / FOCUS)
    )
    on_lens = np.hypot(*pillar) < RADIUS
    return landed[:, on_lens], on_lens.mean()


@pytest.mark.parametrize("order", [0, 2])
@pytest.mark.parametrize(
    "field_um", [(310.0, -240.0), (-1450.0, -250.0), (-2150.0, 20.0)]
)
def test_behind_a_stop_a_disc_is_what_rays_through_the_hole_light(
    monkeypatch, order, field_um
):
    """Rays drawn on the hole: 36 % of its light misses the lens from one of these
    fields, 95 % from another.
    """
    monkeypatch.setattr(stray, "PillarWave", Wave)
    monkeypatch.setattr(stray, "ORDERS", (order,))
    monkeypatch.setattr(Wave, "orders", lambda *_: {order: 0.04})
    layers = Layers(stop=Stop(HOLE, THICK, MIDDLE))
    made = stray.stray_of(
        SimpleNamespace(wave=Wave(), distance_um=D, layers=layers),
        GRID,
        DEPTH,
        field_um,
    )
    light = torch.zeros(1, 2, 90, 120)
    light[0, 1, 44:46, 59:61] = 1.25  # about the middle
    image = (
        stray.add_stray(torch.zeros(1, 76, 106), light.sum(1), made, GRID)[0]
        .double()
        .numpy()
    )
    (x, y), taken = _traced(field_um, order, np.random.default_rng(3))
    slope2 = (
        sum((a * DEPTH / D + m) ** 2 for a, m in zip(field_um, MIDDLE, strict=True))
        / (DEPTH - THICK) ** 2
    )
    assert image.sum() == pytest.approx(
        5 * 0.04 * taken / (1 + slope2) ** 2, rel=0.02, abs=2e-4
    )  # rims in steps
    columns, rows = (np.arange(n) - (n - 1) / 2 for n in (106, 76))
    if taken > 0.5:  # a sliver is taken for a disc
        found = (
            (image.sum(0) @ columns, image.sum(1) @ rows) / image.sum() * GRID.step_um
        )
        assert found == pytest.approx(
            [(x - field_um[0]).mean(), (y - field_um[1]).mean()], abs=0.7
        )
