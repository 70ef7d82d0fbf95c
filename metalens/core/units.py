"""Lengths are micrometres and angles radians; multiply by these to enter another unit."""

import math

um, nm, mm = 1.0, 1e-3, 1e3
deg = math.pi / 180
