"""The drawn camera module: the parts of the paper's stack by their volumes (Gauss),
each on the one before.
"""

import json
import math
import re

import numpy as np
import pytest

from metalens.chain import module_view

APERTURE, DISTANCE = 1.7, 2.3
DIE = APERTURE + 0.5


@pytest.fixture(scope="module")
def parts():
    text = str(
        module_view.draw_module(aperture_mm=APERTURE, sensor_distance_mm=DISTANCE)
    )
    return json.loads(re.search(r"\[\{\"name\".*\}\]", text)[0])


def volume(part):
    """Sum over faces of area times height over z, from the two level faces: base area
    by the shoelace formula.
    """
    low, high = np.array(part["faces"][0]), np.array(part["faces"][1])
    x, y, _ = low.T
    area = abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    for k, side in enumerate(
        part["faces"][2:]
    ):  # walls join the level faces edge by edge
        corners = {tuple(p) for p in side}
        assert corners == {tuple(v[(k + j) % 4]) for v in (low, high) for j in (0, 1)}
    return area * (high[0, 2] - low[0, 2])


def extent(part):
    """(least, largest) z."""
    z = [p[2] for face in part["faces"] for p in face]
    return min(z), max(z)


def test_every_part_has_its_size_and_place(parts):
    """Filter 0.5 mm, substrate 0.3, air to the sensor of 0.5, flex 0.2; the mount fills
    the height of the air.
    """
    boxes = {
        "NIR filter": (DIE + 0.3, 0.5, 1.0),
        "substrate": (DIE, 0.0, 0.3),
        "sensor": (DIE, -DISTANCE - 0.5, -DISTANCE),
        "flex": (DIE + 0.4, -DISTANCE - 0.7, -DISTANCE - 0.5),
    }
    named = {part["name"]: part for part in parts if part["name"]}
    for name, (side, low, high) in boxes.items():
        assert volume(named[name]) == pytest.approx(side**2 * (high - low))
        assert extent(named[name]) == pytest.approx((low, high))
    walls = [part for part in parts if part["name"] in ("mount", "")]
    assert len(walls) == 4
    assert sum(map(volume, walls)) == pytest.approx(
        ((DIE + 0.4) ** 2 - (DIE + 0.04) ** 2) * DISTANCE
    )
    for wall in walls:
        assert extent(wall) == pytest.approx((-DISTANCE, 0.0))
        base = np.array(wall["faces"][0])[:, :2]
        beside = np.maximum(
            base.min(0), -base.max(0)
        ).max()  # how far it stays off the axis: none reaches into the air
        assert beside == pytest.approx((DIE + 0.04) / 2)
    middles = np.array([np.mean(wall["faces"][0], axis=0)[:2] for wall in walls])
    assert middles.sum(0) == pytest.approx([0, 0])


def test_the_lens_is_a_disc_of_its_aperture_under_the_substrate(parts):
    ring = np.array(
        next(part for part in parts if part["name"] == "metalens")["faces"][0]
    )
    assert np.hypot(ring[:, 0], ring[:, 1]) == pytest.approx(APERTURE / 2)
    x, y, z = ring.T
    area = (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
    assert area == pytest.approx(
        20 * math.sin(math.pi / 20) * (APERTURE / 2) ** 2
    )  # forty corners
    assert -0.01 < z.max() < 0


def test_a_small_lens_still_has_a_die_of_one_and_a_half_millimetres():
    text = str(module_view.draw_module(aperture_mm=0.2, sensor_distance_mm=1.1))
    found = json.loads(re.search(r"\[\{\"name\".*\}\]", text)[0])
    substrate = next(part for part in found if part["name"] == "substrate")
    assert volume(substrate) == pytest.approx(1.5**2 * 0.3)
