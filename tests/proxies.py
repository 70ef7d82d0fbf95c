"""Proxies whose phase and modulus are a line each of Chebyshev coefficients."""

import numpy as np

from metalens.library import Proxy


def proxy_of(phase, level, domain_um, waves_um, error=0.0):
    """By the diameter alone; ``waves_um`` one wavelength, or the least and largest."""
    waves = waves_um if isinstance(waves_um, tuple) else (waves_um, waves_um)
    rows = (np.array([row]) for row in (phase, level))
    return Proxy(*rows, domain_um, waves, error, error)
