"""A camera module by its sums: where each part begins, how much of it there is, and
what a wider lens widens.
"""

import math
from types import SimpleNamespace

import pytest

from layout.process.process import Die, Process
from layout.solid import module
from layout.solid.module import Module

SIZES = {
    "filter_mm": 0.45,
    "substrate_mm": 0.33,
    "spacing_mm": 1.7,
    "sensor_mm": 0.6,
    "flex_mm": 0.25,
    "side_mm": 2.1,
    "filter_side_mm": 1.75,
    "die_side_mm": 1.4,
    "sensor_side_mm": 1.55,
    "aperture_mm": 0.9,
    "clearance_mm": 0.03,
    "ledge_mm": 0.22,
    "film_mm": 0.0003,
    "height_mm": 0.0009,
}


def test_the_stack_is_the_sum_of_its_thicknesses():
    assert Module(**SIZES).stack_mm == pytest.approx(
        0.45 + 0.33 + 1.7 + 0.6 + 0.25, rel=1e-15
    )
    assert Module().stack_mm == pytest.approx(3.5, rel=1e-15)  # the paper's, Sec. 6


def test_the_defaults_are_the_paper_s_stack():
    """0.5 mm filter, 0.3 mm substrate, 2 mm to the sensor, a package of 0.5 mm, a flex
    of 0.2 mm, below 2 mm wide.
    """
    made = Module()
    stack = (
        made.filter_mm,
        made.substrate_mm,
        made.spacing_mm,
        made.sensor_mm,
        made.flex_mm,
    )
    assert stack == (0.5, 0.3, 2.0, 0.5, 0.2)
    assert (
        made.side_mm,
        made.filter_side_mm,
        made.die_side_mm,
        made.sensor_side_mm,
    ) == (1.9, 1.8, 1.5, 1.5)
    assert (made.aperture_mm, made.clearance_mm, made.ledge_mm) == (1.0, 0.02, 0.2)
    assert (made.film_mm, made.height_mm) == (0.00015, 0.0007)


def lens(radius_um, distance_um):
    """Of a lens what a module is built around."""
    return SimpleNamespace(
        diameters=SimpleNamespace(radius_um=radius_um, pitch_um=0.8),
        sensor_distance_um=distance_um,
        cell=SimpleNamespace(height_um=1.3),
    )


def test_a_wider_lens_widens_all_that_is_around_it():
    """741.6 um to the outermost pillar, and half a pitch: 1.484 mm across, 0.484 more
    than the paper's.
    """
    made = module.around(lens(741.6, 2310.0), Process(die=Die(thickness_um=275.0)))
    assert made.aperture_mm == pytest.approx(1.484, rel=1e-12)
    assert (made.spacing_mm, made.height_mm) == (
        pytest.approx(2.31, rel=1e-12),
        pytest.approx(0.0013, rel=1e-12),
    )
    assert (made.ledge_mm, made.substrate_mm) == (0.2, pytest.approx(0.275, rel=1e-12))
    sides = made.side_mm, made.filter_side_mm, made.die_side_mm, made.sensor_side_mm
    assert sides == pytest.approx((2.384, 2.284, 1.984, 1.984), rel=1e-12)
    small = module.around(lens(99.6, 480.0), Process(die=Die(thickness_um=475.0)))
    assert small.aperture_mm == pytest.approx(0.2, rel=1e-12)
    assert (
        small.side_mm,
        small.die_side_mm,
        small.sensor_side_mm,
        small.filter_side_mm,
    ) == (1.9, 1.5, 1.5, 1.8)
    assert (small.ledge_mm, small.substrate_mm) == (pytest.approx(0.12, rel=1e-12), 0.3)


def test_every_part_begins_where_the_one_before_it_ends_and_has_its_volume():
    """The mount is a block less the room of the die and its film, a ledge with a hole
    half as wide as aperture and die
    together, and the room of the sensor."""
    pytest.importorskip("build123d")
    parts = {part.label: part for part in module.assemble(Module(**SIZES)).children}
    ledge = math.pi * ((0.9 + 1.4) / 4) ** 2 * 0.22
    mount = (
        2.1**2 * (0.33 + 1.7 + 0.6)
        - 1.46**2 * (0.33 + 0.0003)
        - ledge
        - 1.61**2 * (1.7 + 0.6 - 0.2203)
    )
    lens_mm2 = math.pi * 0.45**2
    want = {
        "nir_filter": (-0.78, -0.33, 1.75**2 * 0.45),
        "die": (-0.33, 0.0, 1.4**2 * 0.33),
        "aperture": (0.0, 0.0003, (1.4**2 - lens_mm2) * 0.0003),
        "metalens": (0.0, 0.0009, lens_mm2 * 0.0009),
        "mount": (-0.33, 2.3, mount),
        "sensor": (1.7, 2.3, 1.55**2 * 0.6),
        "flex": (2.3, 2.55, 2.1**2 * 0.25),
    }
    assert list(parts) == list(want)
    for name, (low, high, volume) in want.items():
        box = parts[name].bounding_box()
        ends = [box.min.Z, box.max.Z]
        assert ends == pytest.approx(
            [low, high], abs=1e-6
        )  # the kernel's boxes are wider by 1e-7 mm
        assert parts[name].volume == pytest.approx(volume, rel=1e-9)
        assert tuple(parts[name].color)[:3] == pytest.approx(
            module.COLOURS[name][:3], abs=1e-6
        )
