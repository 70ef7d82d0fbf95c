"""How the transmission of a pillar answers to height, wall angle and index, beside its diameter."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Index
from metalens.lens import Lens
from metalens.proxy import Proxy
from metalens.store import Array
from metalens.units import deg

Solver = Callable[[Cell, Array, float, bool], Array]
HEIGHT_STEP_UM, SIDEWALL_STEP_RAD, INDEX_STEP = 0.01, 1 * deg, 0.02


@dataclass(frozen=True, eq=False, slots=True)
class Sensitivities:
    """Logarithmic derivatives of t: the real part changes |t|, the imaginary part is a phase in rad.

    diameter_um: (n,) rising; height: (n,) complex, per um; sidewall: per rad; index: per unit of n.
    error: largest relative change (rms over the diameters) of one of them from a coarser truncation.
    """

    diameter_um: Array
    height: Array
    sidewall: Array
    index: Array
    error: float

    def log_change(self, diameter_um: Array, height_um: Array, sidewall_rad: Array, index: Array) -> Array:
        """ln t(changed) / t(nominal), to first order; shapes broadcast. Beyond the ends the end value holds."""
        return np.asarray(
            self._at(self.height, diameter_um) * height_um
            + self._at(self.sidewall, diameter_um) * sidewall_rad
            + self._at(self.index, diameter_um) * index
        )

    def _at(self, values: Array, diameter_um: Array) -> Array:
        return np.asarray(np.interp(diameter_um, self.diameter_um, values))


def sensitivities(lens: Lens, *, count: int = 15, solver: Solver | None = None) -> Sensitivities:
    """Central differences of the solver at ``count`` diameters over the proxy's domain.

    Args:
        solver: (cell, diameters, wavelength, finer) to t of each; left out: RCWA of a fixed truncation, whose error
            all but cancels in the differences.

    Accuracy: ``error`` of the result, the change from a coarser truncation: a few percent.

    Raises:
        CellError, MaterialError: from the solver.
    """
    from metalens import materials

    cell, solve = lens.cell, _rcwa if solver is None else solver
    n = materials.index(cell.pillar, lens.wavelength_um)

    def changed(sign: int, what: str) -> Cell:
        if what == "height":
            return dataclasses.replace(cell, height_um=cell.height_um + sign * HEIGHT_STEP_UM)
        if what == "sidewall":
            return dataclasses.replace(cell, sidewall_rad=cell.sidewall_rad + sign * SIDEWALL_STEP_RAD)
        return dataclasses.replace(cell, pillar=Index(n.real + sign * INDEX_STEP, n.imag))

    diameters = np.linspace(*lens.proxy.domain_um, count)
    steps = {"height": HEIGHT_STEP_UM, "sidewall": SIDEWALL_STEP_RAD, "index": INDEX_STEP}
    found, worst = {}, 0.0
    for what, step in steps.items():
        some = diameters[:: 2 if what == "sidewall" else 1]
        rates = []
        for finer in (False, True):
            less, more = (solve(changed(sign, what), some, lens.wavelength_um, finer) for sign in (-1, 1))
            rates.append(np.log(more / less) / (2 * step))
        scale = max(float(np.linalg.norm(rates[1])), 1e-9)
        worst = max(worst, float(np.linalg.norm(rates[1] - rates[0])) / scale)
        found[what] = np.interp(diameters, some, rates[1])
    return Sensitivities(diameters, found["height"], found["sidewall"], found["index"], worst)


def amplitude(proxy: Proxy, diameter_um: Array, wavelength_um: float) -> Array:
    """Complex t of pillars; beyond the proxy's domain the phase goes on with the slope at its end, |T| stays."""
    low, high = proxy.domain_um
    inside = np.clip(np.asarray(diameter_um, float), low, high)
    beyond = diameter_um - inside
    phase = proxy.phase_rad(inside, wavelength_um)
    if np.any(beyond):
        phase = phase + beyond * proxy.dphase_ddiameter(inside, wavelength_um)
    return np.asarray(proxy.transmission(inside, wavelength_um) * np.exp(1j * phase))


def _rcwa(cell: Cell, diameter_um: Array, wavelength_um: float, finer: bool) -> Array:
    """Tapered pillars are cut in slices and cost more: they get fewer harmonics."""
    from metalens.rcwa import solve_many

    harmonics = (4 if finer else 3) if cell.sidewall_rad else (8 if finer else 6)
    return np.array([each.t for each in solve_many(cell, diameter_um, wavelength_um, harmonics=harmonics)])
