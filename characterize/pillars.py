"""What a change of the pillars does to their transmission, as few functions of the designed diameter.

t(D + b; height, index, sidewall, wavelength) for all small changes lies close to a space of a few functions u_k(D);
summing the lens once for each u_k makes every change of process act on coarse nodes (see :mod:`reduced`).
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from metalens.cell import Cell, Index
from metalens.errors import FitError
from metalens.lens import Lens
from metalens.proxy import Proxy
from metalens.store import Array

CHANGES = ("height_um", "index", "sidewall_rad")


@dataclass(frozen=True, eq=False, slots=True)
class Sensitivity:
    """First-order change of ln t with the process, as polynomials of the diameter.

    coefficients: (3, degree + 1) complex power series in (D - center_um) of d ln t / d(height_um, index of the
        pillar, sidewall_rad); a row of zeros switches a parameter off.
    """

    coefficients: Array
    center_um: float

    def at(self, diameter_um: Array) -> Array:
        """(3, *shape) derivatives of ln t."""
        offset = np.asarray(diameter_um) - self.center_um
        return np.stack([np.polynomial.polynomial.polyval(offset, row) for row in self.coefficients])


def sensitivity(cell: Cell, wavelength_um: float, within_um: tuple[float, float], *, degree: int = 4) -> Sensitivity:
    """Derivatives by central differences of rigorous solves of the cell, smoothed over the diameter.

    Accuracy: differences of 1 % in height, 1 % in index, 1 degree of sidewall; resonances narrower than the fit of
    ``degree`` are averaged over.
    """
    from metalens import materials, rcwa

    diameters = np.linspace(*within_um, 3 * degree + 1)
    pillar = cell.pillar
    index = complex(pillar.n, pillar.k) if isinstance(pillar, Index) else materials.index(pillar, wavelength_um)
    pairs = [
        [dataclasses.replace(cell, height_um=cell.height_um * (1 + s)) for s in (0.01, -0.01)],
        [dataclasses.replace(cell, pillar=Index(index.real * (1 + s), index.imag)) for s in (0.01, -0.01)],
        [dataclasses.replace(cell, sidewall_rad=cell.sidewall_rad + s) for s in (math.pi / 180, 0.0)],
    ]
    steps = (0.02 * cell.height_um, 0.02 * index.real, math.pi / 180)
    rows = []
    center = sum(within_um) / 2
    for (up, down), step in zip(pairs, steps, strict=True):
        high, low = ([rcwa.solve(c, d, wavelength_um, tolerance=3e-3).t for d in diameters] for c in (up, down))
        slope = np.log(np.array(high) / np.array(low)) / step
        fit = [np.polynomial.polynomial.polyfit(diameters - center, part, degree) for part in (slope.real, slope.imag)]
        rows.append(fit[0] + 1j * fit[1])
    return Sensitivity(np.array(rows), center)


@dataclass(frozen=True, slots=True)
class Process:
    """Change of the pillars that is the same all over the lens; zeros are the design."""

    height_um: float = 0.0
    index: float = 0.0
    sidewall_rad: float = 0.0
    wavelength_um: float = 0.0


@dataclass(frozen=True, slots=True)
class Range:
    """Largest change of each kind that a low-rank basis must hold; beyond it the fit is refused."""

    bias_um: float = 0.03
    height_um: float = 0.03
    index: float = 0.08
    sidewall_rad: float = 0.03
    wavelength_um: float = 0.006


class Pillars:
    """Transmission of pillars under change, exact and in its low-rank basis.

    basis: (r, grid) orthonormal functions on ``diameter_um`` (grid,). nodes_um: (b,) biases where coefficients are
    formed. error: largest |t - low-rank| met on random changes inside the range, that the basis was not made from.
    """

    def __init__(
        self, lens: Lens, response: Sensitivity, *, span: Range | None = None, tolerance: float = 3e-5
    ) -> None:
        span = span or Range()
        self.lens, self.response, self.span = lens, response, span
        built = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
        self.diameter_um = np.linspace(float(built.min()), float(built.max()) + 1e-9, 193)
        b = max(7, 2 * math.ceil(span.bias_um / 0.006) + 1)
        self.nodes_um = np.cos(np.pi * (np.arange(b) + 0.5) / b) * span.bias_um
        columns = [self.exact(bias, p) for bias in self.nodes_um for p in self._training()]
        u, size, _ = np.linalg.svd(np.array(columns).T, full_matrices=False)
        tail = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1] / len(columns) / len(self.diameter_um))
        self.basis = np.ascontiguousarray(u[:, : max(1, int((tail > tolerance).sum()))].T.conj())
        self.error = self._measure()

    def exact(self, bias_um: float, change: Process) -> Array:
        """(grid,) complex t at ``diameter_um`` + bias under a change."""
        d = self.diameter_um + bias_um
        wave = self.lens.wavelength_um + change.wavelength_um
        return transmission(self.lens.proxy, self.response, d, wave, change)

    def coefficients(self, change: Process) -> Array:
        """(b, r) coefficients of t in the basis at the bias nodes."""
        return np.array([self.basis @ self.exact(bias, change) for bias in self.nodes_um])

    def slopes(self, change: Process) -> Array:
        """(3, b, r) derivatives of :meth:`coefficients` by height, index and sidewall."""
        out = []
        for bias in self.nodes_um:
            t = self.exact(bias, change)
            out.append((self.response.at(self.diameter_um + bias) * t) @ self.basis.T)
        return np.array(out).transpose(1, 0, 2)

    def functions(self, diameter_um: Array) -> Array:
        """(r, *shape) complex: the conjugate basis at designed diameters, 0 where there is no pillar."""
        safe = np.where(diameter_um > 0, diameter_um, self.diameter_um[0])
        place = (safe - self.diameter_um[0]) / (self.diameter_um[1] - self.diameter_um[0])
        return np.stack([_cubic(row.conj(), place) * (diameter_um > 0) for row in self.basis])

    def weights(self, bias_um: Array) -> tuple[Array, Array]:
        """(b, *shape) Lagrange weights of the bias nodes at ``bias_um``, and their derivatives."""
        n = self.nodes_um
        value = np.ones((len(n), *np.shape(bias_um)))
        slope = np.zeros_like(value)
        for i in range(len(n)):
            for j in range(len(n)):
                if i != j:
                    factor = (bias_um - n[j]) / (n[i] - n[j])
                    slope[i] = slope[i] * factor + value[i] / (n[i] - n[j])
                    value[i] = value[i] * factor
        return value, slope

    def _training(self) -> list[Process]:
        s = self.span
        singles = [{"height_um": s.height_um}, {"index": s.index}, {"sidewall_rad": s.sidewall_rad}]
        if self._waves():
            singles.append({"wavelength_um": s.wavelength_um})
        both = [Process(**{k: sign * v for k, v in one.items()}) for one in singles for sign in (1, -1)]
        return [Process(), *both, *(_draw(np.random.default_rng(i), s, self._waves()) for i in range(6))]

    def _waves(self) -> bool:
        return bool(np.ptp(self.lens.proxy.wavelengths_um) > 0)

    def _measure(self) -> float:
        random = np.random.default_rng(99)
        worst = 0.0
        for _ in range(40):
            change, bias = _draw(random, self.span, self._waves()), random.uniform(-0.7, 0.7) * self.span.bias_um
            c = self.weights(np.array(bias))[0] @ self.coefficients(change)
            worst = max(worst, float(np.abs(self.basis.conj().T @ c - self.exact(bias, change)).max()))
        return worst


def transmission(proxy: Proxy, response: Sensitivity, d_um: Array, wavelength_um: float, change: Process) -> Array:
    """Complex t of pillars of diameter ``d_um`` (any shape) under a change of process.

    Beyond the ends of the proxy's domain phase and |T| go on along their tangents (held within 0 to 1).

    Raises:
        FitError: a wavelength where the proxy says nothing.
    """
    low, high = proxy.wavelengths_um
    if high > low and not low <= wavelength_um <= high:
        raise FitError(f"wavelength {wavelength_um:.4f} um outside the proxy's {low:.4f} to {high:.4f} um")
    wave = low if high == low else wavelength_um
    inside = np.clip(d_um, *proxy.domain_um)
    beyond = d_um - inside
    phase = proxy.phase_rad(inside, wave) + beyond * proxy.dphase_ddiameter(inside, wave)
    level = np.clip(proxy.transmission(inside, wave) + beyond * proxy.dtransmission_ddiameter(inside, wave), 0, 1)
    amounts = [getattr(change, name) for name in CHANGES]
    return np.asarray(level * np.exp(1j * phase + np.tensordot(amounts, response.at(d_um), 1)))


def _draw(random: np.random.Generator, span: Range, waves: bool) -> Process:
    h, n, s, w = random.uniform(-0.7, 0.7, 4)
    return Process(h * span.height_um, n * span.index, s * span.sidewall_rad, w * span.wavelength_um * waves)


def _cubic(values: Array, place: Array) -> Array:
    """Catmull-Rom interpolation on an even grid; error of order h³, 1e-6 here."""
    i = np.clip(place.astype(int), 1, len(values) - 3)
    t = place - i
    a, b, c, d = values[i - 1], values[i], values[i + 1], values[i + 2]
    inner = c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a))
    return np.asarray(b + 0.5 * t * inner)
