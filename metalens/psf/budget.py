"""What the error of a PSF is made of: what was computed, and what the model leaves out.

The model's terms are relative L2 errors of the PSF of a perfect lens of the same aperture, from radial integrals

    U(ρ) = ∫ √spread(p) c(p) J0(k p ρ) p dp        (scalar; c = 1 for pillars that do not feel their neighbours)

and, for both polarisations, Ex, Ey, Ez of rays turned by the lens (Richards and Wolf 1959) with |E|² cos θ kept.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.special import jv

from metalens.ground.arrays import Array

# pillars among unlike neighbours, solved rows of 12 and 8 of the default cell: amplitude 0.986, -0.066 rad at sine
# 0.236, and 0.959, -0.100 rad at 0.354; another cell's own factor is metalens.design.neighbours.neighbours
NEIGHBOURS = (0.057 - 0.289j, -0.523 + 0.054j)
ANGLE = 2.5  # change of t over sin² of the incidence: 0.29 at 20 degrees, the default cell's worst pillar off resonance


@dataclass(frozen=True, slots=True)
class LeftOut:
    """What is known of pillars that the model of a lens leaves out; by default rough, of another cell.

    neighbours: (a, b) of the factor 1 + a s + b s² on light that unlike neighbours turn by the sine s.
    angle: relative change of t over sin² of the incidence. of: whose numbers they are.
    """

    neighbours: tuple[complex, complex] = NEIGHBOURS
    angle: float = ANGLE
    of: str = ""

    @property
    def words(self) -> str:
        """For a person."""
        return f"neighbours and angle: of {self.of or 'the default cell, rough'}"


ROUGH = LeftOut()


@dataclass(frozen=True, slots=True)
class Budget:
    """Relative L2 errors of the PSFs by cause, the worst over angles; nan where it is not known.

    numerical: of the propagation, measured on the result. sampling: of the integration over the cells of the window.
    spectrum: of the quadrature over wavelengths. source: of a source of finite size, whose points are taken as alike.
    polarisation: of one scalar in place of both polarisations. neighbours: of pillars taken as if each stood among its
        like. angle: of pillars that answer as at normal incidence. glass: of light that goes twice between two faces.
    outside: share of the light that falls beside the window, worst over angles and depths; a PSF of sum 1 does not
        show it, so it is in no total.
    """

    numerical: float
    sampling: float = 0.0
    spectrum: float = 0.0
    source: float = 0.0
    polarisation: float = math.nan
    neighbours: float = math.nan
    angle: float = math.nan
    glass: float = math.nan
    outside: float = math.nan

    @property
    def computed(self) -> float:
        """What the tolerance is about: numerical, sampling, spectrum and source together."""
        return math.hypot(self.numerical, self.sampling, self.spectrum, self.source)

    @property
    def model(self) -> float:
        """What the model leaves out, as far as it is known."""
        return _together(self.polarisation, self.neighbours, self.angle, self.glass)

    @property
    def total(self) -> float:
        """Error to expect of the PSF of the device."""
        return _together(self.computed, self.model)

    @property
    def text(self) -> str:
        """One line for a person."""
        terms = [(f.name, getattr(self, f.name)) for f in fields(self) if f.name != "outside"]
        known = [f"{name} {value:.1e}" if value else f"{name} 0" for name, value in terms if not math.isnan(value)]
        lost = "" if math.isnan(self.outside) else f"; {self.outside:.1%} of the light falls beside the window"
        return f"error by cause: {', '.join(known)}; of the device {self.total:.1e}{lost}"


def _together(*terms: float) -> float:
    return math.hypot(*(term for term in terms if not math.isnan(term)))


def worst(budgets: list[Budget]) -> Budget:
    """The largest of every term."""
    names = [f.name for f in fields(Budget)]
    return Budget(**{n: _largest([getattr(b, n) for b in budgets]) for n in names})


def _largest(values: list[float]) -> float:
    known = [v for v in values if not math.isnan(v)]
    return max(known) if known else math.nan


def with_model(
    budget: Budget,
    *,
    aperture: float,
    vector: bool,
    incidence_rad: float,
    has_angles: bool,
    ghost: float,
    uneven: float = 0.0,
    left_out: LeftOut = ROUGH,
) -> Budget:
    """The budget with what the model of a lens leaves out.

    Args:
        aperture: half the spread in sin θ of the rays to the sensor. uneven: as in :func:`scalar_error`.
        vector: whether both polarisations were computed. has_angles: whether the pillars answer at the light's angle.
    """
    return replace(
        budget,
        polarisation=0.0 if vector else scalar_error(aperture, uneven),
        neighbours=_difference(_scalar(aperture, left_out.neighbours), _scalar(aperture)),
        angle=0.0 if has_angles else min(1.0, left_out.angle * math.sin(incidence_rad) ** 2),
        glass=ghost,
    )


def scalar_error(aperture: float, uneven: float = 0.0) -> float:
    """Relative L2 difference between the scalar PSF and |E|² of both polarisations.

    In focus it is that of a perfect lens of this aperture. Out of it rays fall apart, and the scalar's power is weighed
    by 1/cos θ alone: the difference is how uneven that is over the aperture. Light from the side and aberrated light
    have of both and lie below the two together (36 of 36 lenses drawn, NA 0.1 to 0.6, up to 25 degrees: 0.25 to 0.87).

    A pixel counts flux, which has no 1/cos θ: the scalar is that to 7e-5 at NA 0.24 and 4e-3 at NA 0.6
    (:mod:`metalens.field.polarised`).

    Args:
        uneven: standard deviation of 1/cos θ over the aperture, over its mean (:func:`metalens.psf.of_lens.uneven`).
    """
    return math.hypot(_difference(_scalar(aperture), _vectorial(aperture)), uneven)


def _nodes(aperture: float) -> tuple[Array, Array, Array]:
    """(p,) nodes, (p,) weights p dp, (ρ,) k ρ up to some ten rings."""
    t, w = np.polynomial.legendre.leggauss(64)
    edge = min(aperture, 0.999)
    p = edge * (t + 1) / 2
    return p, w * p * edge / 2, np.linspace(0, 30 / edge, 240)


def _scalar(aperture: float, factor: tuple[complex, complex] = (0, 0)) -> Array:
    """(ρ,) |U|² through a factor 1 + a p + b p²."""
    p, weight, at = _nodes(aperture)
    level = weight / (1 - p * p) * (1 + factor[0] * p + factor[1] * p * p)
    return np.asarray(np.abs(level @ jv(0, np.outer(p, at))) ** 2)


def _vectorial(aperture: float) -> Array:
    """(ρ,) |Ex|² + |Ey|² + |Ez|², unpolarised."""
    p, weight, at = _nodes(aperture)
    cosine = np.sqrt(1 - p * p)
    level, x = weight / (1 - p * p) / np.sqrt(cosine), np.outer(p, at)
    parts = ((level * (1 + cosine)) @ jv(0, x), (level * p) @ jv(1, x), (level * (1 - cosine)) @ jv(2, x))
    return np.asarray(parts[0] ** 2 + 2 * parts[1] ** 2 + parts[2] ** 2)


def _difference(one: Array, other: Array) -> float:
    """Relative L2 distance over the plane of two radial PSFs of sum 1."""
    ring = np.arange(len(one))
    one, other = one / (one @ ring), other / (other @ ring)
    return float(np.sqrt((one - other) ** 2 @ ring / (other**2 @ ring)))
