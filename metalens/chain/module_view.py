"""The camera module around a lens, drawn to be turned with a finger: no library, no
network, any browser.
"""

import json
import math
from importlib import resources
from typing import Any

from metalens.core.report import Markup

Box = dict[str, Any]


def draw_module(*, aperture_mm: float, sensor_distance_mm: float) -> Markup:
    """The stack of the paper's Sec. 6: 0.5 mm filter, 0.3 mm substrate, air to the 0.5
    mm sensor, 0.2 mm flex.

    Args:
        aperture_mm: diameter of the lens; wider lenses get wider parts.
        sensor_distance_mm: lens to sensor.
    """
    die = max(1.5, aperture_mm + 0.5)
    parts = [
        _box("NIR filter", "#8b2942", die + 0.3, 0.5, 0.5, 0.55),
        _box("substrate", "#8fc1e8", die, 0.0, 0.3, 0.6),
        _disc("metalens", "#7a45c0", aperture_mm / 2, -0.001),
        *_frame(
            "mount",
            "#6a7280",
            die + 0.4,
            die + 0.04,
            -sensor_distance_mm,
            sensor_distance_mm,
            0.28,
        ),
        _box("sensor", "#2f6b52", die, -sensor_distance_mm - 0.5, 0.5, 1.0),
        _box("flex", "#e08a1e", die + 0.4, -sensor_distance_mm - 0.7, 0.2, 1.0),
    ]
    source = (
        resources.files("metalens")
        .joinpath("data/module_view.html")
        .read_text(encoding="utf-8")
    )
    return Markup(source.replace("/*PARTS*/", json.dumps(parts)))


def _box(
    name: str, colour: str, side: float, bottom: float, height: float, opacity: float
) -> Box:
    h = side / 2
    return _prism(
        name,
        colour,
        opacity,
        [(-h, -h), (h, -h), (h, h), (-h, h)],
        (bottom, bottom + height),
    )


def _frame(
    name: str,
    colour: str,
    outer: float,
    inner: float,
    bottom: float,
    height: float,
    opacity: float,
) -> list[Box]:
    """Four walls; only the first carries the name."""
    o, i, z = outer / 2, inner / 2, (bottom, bottom + height)
    walls = [[(-o, -o), (o, -o), (o, -i), (-o, -i)], [(-o, i), (o, i), (o, o), (-o, o)]]
    walls += [
        [(-o, -i), (-i, -i), (-i, i), (-o, i)],
        [(i, -i), (o, -i), (o, i), (i, i)],
    ]
    return [
        _prism(name if k == 0 else "", colour, opacity, wall, z)
        for k, wall in enumerate(walls)
    ]


def _disc(name: str, colour: str, radius: float, z: float) -> Box:
    ring = [
        (radius * math.cos(math.pi * k / 20), radius * math.sin(math.pi * k / 20))
        for k in range(40)
    ]
    return {
        "name": name,
        "colour": colour,
        "opacity": 0.95,
        "faces": [[[x, y, z] for x, y in ring]],
    }


def _prism(
    name: str,
    colour: str,
    opacity: float,
    base: list[tuple[float, float]],
    z: tuple[float, float],
) -> Box:
    low, high = ([[x, y, level] for x, y in base] for level in z)
    sides = [[low[k], low[(k + 1) % 4], high[(k + 1) % 4], high[k]] for k in range(4)]
    return {
        "name": name,
        "colour": colour,
        "opacity": opacity,
        "faces": [low, high, *sides],
    }
