"""The Rayleigh-Sommerfeld sum over pillars in float64, one pillar and one point at a
time; in one medium.
"""

import math

import numpy as np


def field(lens, amplitude, where, *, shift_um=None):
    """(depths, y, x) light on a window of the sensor.

    amplitude: (y, x) complex transmission of each site; where: has x_um, y_um,
    distance_um, wavelength_um, depths_um.
    shift_um: (x, y) of each pillar off its site. A source counts as 1 at all pillars;
    its phase is 0 at the middle.
    """
    rows, columns = np.nonzero(lens.diameters.diameter_um)
    x = lens.diameters.x_um[columns]
    y = lens.diameters.y_um[rows]
    t = amplitude[rows, columns]
    if shift_um is not None:
        x = x + shift_um[0][rows, columns]
        y = y + shift_um[1][rows, columns]
    k, d = 2 * np.pi / where.wavelength_um, where.distance_um
    step = (axis[1] - axis[0] for axis in (lens.diameters.x_um, lens.diameters.y_um))
    site_um2 = math.prod(step) * (
        2 if lens.diameters.lattice.kind == "hexagonal" else 1
    )
    lit = [
        t
        * (
            np.exp(1j * k * (np.hypot(np.hypot(x, y), z) - z))
            if np.isfinite(z)
            else 1.0
        )
        for z in where.depths_um
    ]
    result = np.zeros((len(lit), len(where.y_um), len(where.x_um)), complex)
    for i, v in enumerate(where.y_um):
        for j, u in enumerate(where.x_um):
            r = np.sqrt((u - x) ** 2 + (v - y) ** 2 + d**2)
            kernel = (
                site_um2
                * d
                / (2 * np.pi * r**2)
                * (1 / r - 1j * k)
                * np.exp(1j * k * (r - d))
            )
            result[:, i, j] = [(each * kernel).sum() for each in lit]
    return result
