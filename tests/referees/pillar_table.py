"""Transmission of every pillar over diameter, height and wavelength, straight from the
modal solver's library.

``python tests/referees/pillar_table.py`` writes ``pillar_table.json``: the complex t(D)
of the default cell at five
heights and three wavelengths, and the proxy that a design would be made with. No linear
slopes are used.
"""

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from metalens import library
from metalens.core import store
from metalens.library import fit as proxies
from metalens.library.proxy import Proxy
from metalens.library.record import DEFAULT_CELL, Sweep

PATH = Path(__file__).with_name("pillar_table.json")
HEIGHTS_UM = (0.664, 0.682, 0.7, 0.718, 0.736)
WAVELENGTHS_UM = (0.842, 0.85, 0.858)
SAMPLES, TOLERANCE = 200, 3e-4


class Table:
    """t(D, height, wavelength): cubic in the diameter, polynomials through all heights
    and wavelengths.

    Accuracy: 1e-3 of t inside the proxy's domain, by the solver's own bar and a
    held-out height.
    """

    def __init__(self, stored):
        self.diameter_um = np.array(stored["diameter_um"])
        t = np.array(stored["real"]) + 1j * np.array(stored["imaginary"])
        self._spline = CubicSpline(self.diameter_um, np.moveaxis(t, -1, 0))
        about = stored["proxy"]
        self.proxy = Proxy(
            np.array(about["phase_coefficients"]),
            np.array(about["transmission_coefficients"]),
            tuple(about["domain_um"]),
            tuple(about["wavelengths_um"]),
            *about["max_error"],
            about["power"],
            about["max_angle_rad"],
        )

    def at(self, diameter_um, height_um, wavelength_um):
        """(*shape) complex t; height and wavelength may vary with the pillar."""
        values = self._spline(
            np.clip(diameter_um, self.diameter_um[0], self.diameter_um[-1])
        )
        by_height = _lagrange(HEIGHTS_UM, height_um)
        by_wave = _lagrange(WAVELENGTHS_UM, wavelength_um)
        return np.einsum("...hw,...h,...w->...", values, by_height, by_wave)


@functools.lru_cache
def load():
    """The table as stored."""
    return Table(json.loads(PATH.read_text(encoding="utf-8")))


def _lagrange(nodes, place):
    place = np.asarray(place, float)
    weights = [
        np.prod([(place - b) / (a - b) for b in nodes if b != a], axis=0) for a in nodes
    ]
    return np.stack(weights, -1)


def make():
    """Solve and write the table; some minutes."""
    sweep = Sweep(WAVELENGTHS_UM, samples=SAMPLES, tolerance=TOLERANCE)
    cells = [dataclasses.replace(DEFAULT_CELL, height_um=h) for h in HEIGHTS_UM]
    libraries = [library.sweep(cell, sweep) for cell in cells]
    even = np.linspace(*sweep.span_um(DEFAULT_CELL), SAMPLES)
    places = [np.searchsorted(made.diameter_um, even - 1e-9) for made in libraries]
    t = np.stack(
        [made.t[0, 0][:, place] for made, place in zip(libraries, places, strict=True)]
    )
    proxy = proxies.fit_proxy(libraries[2])
    stored = {
        "diameter_um": even.round(9).tolist(),
        "real": t.real.round(6).tolist(),
        "imaginary": t.imag.round(6).tolist(),
        "proxy": {
            "phase_coefficients": proxy.phase_coefficients.tolist(),
            "transmission_coefficients": proxy.transmission_coefficients.tolist(),
            "domain_um": proxy.domain_um,
            "wavelengths_um": proxy.wavelengths_um,
            "max_error": [proxy.max_phase_error_rad, proxy.max_transmission_error],
            "power": proxy.power,
            "max_angle_rad": proxy.max_angle_rad,
        },
    }
    store.write_text(PATH, json.dumps(stored) + "\n")


if __name__ == "__main__":
    make()
