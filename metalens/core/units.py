"""Lengths are micrometres and angles radians; multiply by these to enter another unit."""

import math

um, nm, mm, m = 1.0, 1e-3, 1e3, 1e6
rad, deg = 1.0, math.pi / 180
