"""The rough terms of a PSF's error budget against solved rows and tilted light of the
default cell.
"""

import math

import numpy as np
import pytest

from metalens import library, rcwa
from metalens.design.neighbours import neighbours
from metalens.lens import DiameterMap, Lens
from metalens.psf import budget


@pytest.mark.slow
def test_the_rough_terms_are_those_of_the_default_cell():
    """Rows of 12 and 8 pillars: amplitude and phase to 0.01, what a few more harmonics
    change. Tilt: to 5 %.
    """
    cell = library.DEFAULT_CELL
    proxy = library.proxy_of(library.sweep(cell, wavelengths_um=(0.85,)))
    sizes = np.linspace(*proxy.domain_um, 36).reshape(6, 6).astype(np.float32)
    lens = Lens(
        DiameterMap(sizes, cell.pitch_um), cell, proxy, 0.85, 2000.0, 20_000.0, "map"
    )
    found = neighbours(lens, counts=(12, 8), diagonal=False)
    a, b = budget.NEIGHBOURS
    assert found.sine == pytest.approx(
        [0.85 / (12 * cell.pitch_um), 0.85 / (8 * cell.pitch_um)]
    )
    assert (
        np.abs(1 + a * found.sine + b * found.sine**2 - found.factor.mean(0)).max()
        < 0.01
    )
    angle, worst = math.radians(20), 0.0
    sizes = tuple(
        np.linspace(proxy.domain_um[0], 0.19, 6).tolist()
    )  # wider ones are near a resonance at this angle
    for polarization in ("s", "p"):
        flat, tilted = (
            np.array(
                [
                    one.t
                    for one in rcwa.solve_many(
                        cell,
                        sizes,
                        0.85,
                        angle_rad=tilt,
                        polarization=polarization,
                        tolerance=1e-2,
                    )
                ]
            )
            for tilt in (0.0, angle)
        )
        worst = max(worst, float((np.abs(tilted - flat) / np.abs(flat)).max()))
    assert budget.ANGLE * math.sin(angle) ** 2 == pytest.approx(worst, rel=0.05)
