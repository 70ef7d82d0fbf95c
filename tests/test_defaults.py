"""What a tolerance is when nobody says: the documented defaults of the public functions."""

import inspect

import pytest

from metalens import propagate, psf, rcwa

DEFAULTS = [
    (rcwa.solve, {"tolerance": 1e-3, "angle_rad": 0.0, "azimuth_rad": 0.0}),
    (psf.psf_stack, {"tolerance": 1e-4, "angle_rad": 0.0}),
    (propagate.windowed, {"tolerance": 1e-4}),
    (propagate.angular_spectrum, {"pad": 2, "band_limited": False, "single": False}),
]


@pytest.mark.parametrize(("function", "defaults"), DEFAULTS, ids=lambda v: getattr(v, "__name__", ""))
def test_documented_defaults_hold(function, defaults):
    told = inspect.signature(function).parameters
    assert {name: told[name].default for name in defaults} == defaults
