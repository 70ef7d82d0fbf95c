"""What a change of the pillars does to their transmission, as few functions of the designed diameter.

t(D + b; height, index, sidewall, wavelength) for all small changes lies close to a space of a few functions u_k(D);
summing the lens once for each u_k makes every change of process act on coarse nodes (see :mod:`reduced`).
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import polynomial

from characterize.parameters import PLACE
from metalens.cell import Index
from metalens.errors import FitError
from metalens.lens import Lens
from metalens.proxy import Proxy
from metalens.store import Array

_ENTRIES = 20001  # half a step is 2e-4 rad of phase at most
CHANGES = ("height_um", "index", "sidewall_rad")


@dataclass(frozen=True, eq=False, slots=True)
class Sensitivity:
    """First-order change of ln t with the process, as polynomials of the diameter.

    coefficients: (3, degree + 1) complex power series in (D - center_um) of d ln t / d(height_um, index of the
        pillar, sidewall_rad); a row of zeros switches a parameter off.
    error: of the slopes, relative to their change across the lens; nan where not known.
    low_um, high_um: diameters that the polynomials were made for; beyond them they go on along their tangents.
    """

    coefficients: Array
    center_um: float
    error: float = math.nan
    low_um: float = -math.inf
    high_um: float = math.inf

    def at(self, diameter_um: Array) -> Array:
        """(3, *shape) derivatives of ln t."""
        inside = np.clip(diameter_um, self.low_um, self.high_um)
        offset, beyond = inside - self.center_um, np.asarray(diameter_um - inside)
        values = [polynomial.polyval(offset, row) for row in self.coefficients]
        if beyond.any():
            slopes = [polynomial.polyval(offset, polynomial.polyder(row)) for row in self.coefficients]
            values = [value + beyond * slope for value, slope in zip(values, slopes, strict=True)]
        return np.stack(values)


def sensitivity(lens: Lens, *, degree: int = 5) -> Sensitivity:
    """Derivatives from the effective index of the pillars that the proxy's phase implies.

    phase(D) = k n_eff(D) h, anchored at the thinnest pillar by the effective medium of thin cylinders across the field
    (Rayleigh 1892, two dimensions). Then d ln t / dh = ik n_eff; with b = (n_eff² - 1) / (n² - 1) a function of
    D sqrt(n² - 1) alone (step-index fibre), d n_eff / dn = (b n + n D b' / 2) / n_eff. Pillars are measured at half
    height, so a sidewall acts in second order: k n_eff'' s h³ / 3 about the design's angle s.

    Accuracy: of an effective index, 10 % of the slopes by height, 50 % of those by index; interference between
    foot and top is left out. :func:`characterize.slopes.slopes` asks the cell solvers and is better.
    """
    from metalens import materials

    cell, wave = lens.cell, lens.wavelength_um
    d = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
    diameter = np.linspace(
        max(float(d.min()), lens.proxy.domain_um[0]), min(float(d.max()), lens.proxy.domain_um[1]), 61
    )
    index, outer = (m.n if isinstance(m, Index) else materials.index(m, wave).real for m in (cell.pillar, cell.between))
    k, h = 2 * math.pi / wave, cell.height_um
    fill = math.pi * diameter[0] ** 2 / 4 / cell.pitch_um**2
    inside, around = index**2, outer**2
    thin = around * (inside * (1 + fill) + around * (1 - fill)) / (inside * (1 - fill) + around * (1 + fill))
    phase = lens.proxy.phase_rad(diameter, wave)
    center = float(diameter.mean())
    effective = math.sqrt(thin) + (phase - phase[0]) / (k * h)
    fit = np.polynomial.Polynomial.fit(diameter - center, effective, degree)
    n_eff = fit(diameter - center)
    b = (n_eff**2 - around) / (inside - around)
    slope = 2 * n_eff * fit.deriv()(diameter - center) / (inside - around)
    by_index = (b * index + index * diameter * slope / 2) / n_eff
    by_wall = fit.deriv(2)(diameter - center) * cell.sidewall_rad * h**3 / 3
    rows = [polynomial.polyfit(diameter - center, v, degree) for v in (n_eff, by_index * h, by_wall)]
    return Sensitivity(1j * k * np.array(rows), center, 0.5, float(diameter[0]), float(diameter[-1]))


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
        self,
        lens: Lens,
        response: Sensitivity,
        *,
        span: Range | None = None,
        tolerance: float = 3e-5,
        angle_rad: float = 0.0,
    ) -> None:
        span = span or Range()
        self.lens, self.response, self.span, self.angle_rad = lens, response, span, angle_rad
        built = lens.diameters.diameter_um[lens.diameters.diameter_um > 0]
        self.diameter_um = np.linspace(float(built.min()), float(built.max()) + 1e-9, 193)
        b = max(7, 2 * math.ceil(span.bias_um / 0.006) + 1)
        self.nodes_um = np.cos(np.pi * (np.arange(b) + 0.5) / b) * span.bias_um
        self._slopes = response.at(self.diameter_um + self.nodes_um[:, None])
        self._designed: dict[float, Array] = {}
        columns = np.concatenate([self._at_nodes(p) for p in self._training()])
        u, size, _ = np.linalg.svd(columns.T, full_matrices=False)
        tail = np.sqrt(np.cumsum(size[::-1] ** 2)[::-1] / len(columns) / len(self.diameter_um))
        self.basis = np.ascontiguousarray(u[:, : max(1, int((tail > tolerance).sum()))].T.conj())
        self.error = self._measure()

    def exact(self, bias_um: Array | float, change: Process) -> Array:
        """(..., grid) complex t at ``diameter_um`` + bias (a number, or (..., 1)) under a change."""
        d = self.diameter_um + bias_um
        wave = self.lens.wavelength_um + change.wavelength_um
        return transmission(self.lens.proxy, self.response, d, wave, change, angle_rad=self.angle_rad)

    def coefficients(self, change: Process) -> Array:
        """(b, r) coefficients of t in the basis at the bias nodes."""
        return np.asarray(self._at_nodes(change) @ self.basis.T)

    def slopes(self, change: Process) -> Array:
        """(3, b, r) derivatives of :meth:`coefficients` by height, index and sidewall."""
        return np.asarray((self._slopes * self._at_nodes(change)) @ self.basis.T)

    def _at_nodes(self, change: Process) -> Array:
        """:meth:`exact` at the bias nodes; what the last few wavelengths made of the design is kept."""
        wave = self.lens.wavelength_um + change.wavelength_um
        if wave not in self._designed:
            bias = self.nodes_um[:, None]
            if len(self._designed) >= 8:
                self._designed.pop(next(iter(self._designed)))
            self._designed[wave] = self.exact(bias, Process(wavelength_um=change.wavelength_um))
        amounts = [getattr(change, name) for name in CHANGES]
        return np.asarray(self._designed[wave] * np.exp(np.tensordot(amounts, self._slopes, 1)))

    def table(self) -> Array:
        """(r, entries) complex64: the conjugate basis on a fine grid of diameters; the last entry is no pillar."""
        place = np.linspace(0, len(self.diameter_um) - 1, _ENTRIES)
        rows = [_cubic(row.conj(), place) for row in self.basis]
        return np.concatenate([rows, np.zeros((len(rows), 1))], axis=1).astype(np.complex64)

    def place(self, diameter_um: Array) -> Array:
        """Entry of :meth:`table` nearest to designed diameters (any shape)."""
        low, high = self.diameter_um[0], self.diameter_um[-1]
        entry = np.rint((diameter_um - low) * ((_ENTRIES - 1) / (high - low))).astype(np.int32)
        return np.where(diameter_um > 0, entry, _ENTRIES)

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


def process(x: Array) -> Process:
    """The pillars' change that the parameters mean."""
    return Process(
        x[PLACE["height_nm"]] * 1e-3,
        x[PLACE["index"]],
        math.radians(x[PLACE["sidewall_deg"]]),
        x[PLACE["wavelength_nm"]] * 1e-3,
    )


def incidence_rad(proxy: Proxy, angle_rad: Iterable[float]) -> float:
    """Angle of incidence for a field angle (x, y): 0 where the proxy holds at normal incidence only."""
    tilt = math.atan(math.hypot(*(math.tan(a) for a in angle_rad)))
    return tilt if proxy.max_angle_rad > 0 else 0.0


def transmission(
    proxy: Proxy,
    response: Sensitivity,
    d_um: Array,
    wavelength_um: float,
    change: Process,
    *,
    angle_rad: float = 0.0,
) -> Array:
    """Complex t of pillars of diameter ``d_um`` (any shape) under a change of process, at an angle of incidence.

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
    phase = proxy.phase_rad(inside, wave, angle_rad) + beyond * proxy.dphase_ddiameter(inside, wave, angle_rad)
    level = np.clip(
        proxy.transmission(inside, wave, angle_rad) + beyond * proxy.dtransmission_ddiameter(inside, wave, angle_rad),
        0,
        1,
    )
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
