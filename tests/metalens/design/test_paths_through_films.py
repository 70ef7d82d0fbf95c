"""The path that a focus asks for, through films on both sides: by the ray that reaches
the ring, found by halves.
"""

import math

import pytest

from metalens.cell import Film, Index
from metalens.design import Focus
from metalens.optics import Layers


def longer(layers, radius):
    """Path of the ray through (index, thickness) from the axis to a radius, less that
    along the axis.
    """
    low, high = 0.0, min(n for n, _ in layers)

    def lands(p):
        return sum(t * p / math.sqrt(n * n - p * p) for n, t in layers)

    for _ in range(200):
        middle = (low + high) / 2
        low, high = (middle, high) if lands(middle) < radius else (low, middle)
    path = sum(n * n * t / math.sqrt(n * n - low * low) for n, t in layers)
    return path - sum(n * t for n, t in layers)


@pytest.mark.parametrize(
    ("front_um", "behind_um", "radius"),
    [(700.0, 250.0, 41.0), (0.0, 310.0, 230.0), (520.0, 0, 97.0)],
)
def test_both_sides_are_longer_by_their_own_rays(front_um, behind_um, radius):
    layers = Layers(
        front=(Film(Index(1.52), front_um),), behind=(Film(Index(1.83), behind_um),)
    )
    focus = Focus(0.85, 640.0, 1900.0, layers)
    before = longer([(1.52, front_um), (1.0, 1900.0 - front_um)], radius)
    after = longer([(1.83, behind_um), (1.0, 640.0 - behind_um)], radius)
    assert focus.path_um(radius**2) == pytest.approx(before + after, rel=1e-9)
    far = Focus(0.85, 640.0, math.inf, layers)
    assert far.path_um(radius**2) == pytest.approx(after, rel=1e-9)
