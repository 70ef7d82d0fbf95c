"""Lengths in micrometres and angles in radians, by what they are of each other."""

import math

import pytest

from metalens.ground import units


def test_units_are_those_of_micrometres_and_radians():
    assert (
        25.4 * units.mm
        == pytest.approx(25_400 * units.um)
        == pytest.approx(25_400_000 * units.nm)
    )
    assert units.um == 1.0
    assert math.sin(30 * units.deg) == pytest.approx(0.5)
