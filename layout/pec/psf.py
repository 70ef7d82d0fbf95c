"""Point exposure of an electron beam as a sum of Gaussians, and the exact exposure that
discs make of it.
"""

from dataclasses import dataclass

import numpy as np

from layout.process.process import ExposureSettings
from metalens.core.arrays import Array
from metalens.core.errors import ProcessError
from metalens.fabrication import read_csv

THRESHOLD = 0.5  # exposure at the edge of a wide area of dose 1


@dataclass(frozen=True, eq=False)
class PointExposure:
    """f(r) = sum weights exp(-r^2 / widths^2) / (pi widths^2).

    widths_um, weights: (terms,), the weights sum to 1.
    fit_error: largest difference between the energy within a radius of the fit and of
    the table; 0 if exact.
    """

    widths_um: Array
    weights: Array
    fit_error: float = 0.0

    @property
    def terms(self) -> list[tuple[float, float]]:
        """[(1/e radius in um, weight)] of the Gaussians."""
        return list(zip(self.widths_um.tolist(), self.weights.tolist(), strict=True))

    def density(self, radius_um: Array) -> Array:
        """(*shape) energy density per um^2 at ``radius_um``."""
        r2 = np.asarray(radius_um, float)[..., None] ** 2
        scale = self.weights / (np.pi * self.widths_um**2)
        return np.asarray((scale * np.exp(-r2 / self.widths_um**2)).sum(-1))

    def within(self, radius_um: Array) -> Array:
        """(*shape) share of the energy within ``radius_um``."""
        r2 = np.asarray(radius_um, float)[..., None] ** 2
        return np.asarray((self.weights * -np.expm1(-r2 / self.widths_um**2)).sum(-1))


def point_exposure(exposure: ExposureSettings) -> PointExposure:
    """What the process file describes: the double or triple Gaussian, or the fit of its
    measured table.

    Args:
        exposure: settings of the process.

    Raises:
        ProcessError: it describes none, or the table cannot be used.
    """
    if exposure.csv is not None:
        radius, density = np.array(read_csv(exposure.csv)).T
        return fit_point_spread(radius, density, where=str(exposure.csv))
    if exposure.alpha_um is None or exposure.beta_um is None or exposure.eta is None:
        raise ProcessError(
            f"no point exposure is given: [exposure] needs {exposure.missing}"
        )
    widths = [exposure.alpha_um, exposure.beta_um]
    weights = [1.0, exposure.eta]
    if exposure.gamma_um is not None:
        widths.append(exposure.gamma_um)
        weights.append(exposure.nu)
    return PointExposure(np.array(widths), np.array(weights) / sum(weights))


def fit_point_spread(
    radius_um: Array, density: Array, *, where: str = "point exposure"
) -> PointExposure:
    """Gaussians of non-negative weight through a measured radial function.

    Widths are fixed, four to an octave; weights follow from non-negative least squares
    of the relative errors, weighted by the energy.

    Args:
        radius_um: (n,) rising, above 0.
        density: (n,) energy density in any unit, above 0.
        where: name of the table in errors.

    Raises:
        ProcessError: fewer than 4 samples, radii that do not rise, values that are not
            above 0.
    """
    from scipy.optimize import nnls

    radius = np.asarray(radius_um, float)
    value = np.asarray(density, float)
    is_valid = (
        np.isfinite(value).all()
        and np.isfinite(radius).all()
        and (value > 0).all()
        and (np.diff(radius) > 0).all()
    )
    if radius.size < 4 or not is_valid or radius[0] <= 0:
        raise ProcessError(
            f"{where}: need at least 4 rising radii above 0 um, each with an energy density above 0"
        )
    steps = max(8, int(np.ceil(4 * np.log2(radius[-1] / radius[0]))))
    widths = np.geomspace(radius[0], radius[-1], steps + 1)
    energy = radius**2 * value
    sample_weight = (
        0.02 + energy / energy.max()
    ) / value  # relative errors count, most where the energy is
    design = (
        np.exp(-((radius[:, None] / widths) ** 2))
        / (np.pi * widths**2)
        * sample_weight[:, None]
    )
    scale = design.max(axis=0)
    weights = nnls(design / scale, value * sample_weight)[0] / scale
    total = weights.sum()
    is_used = weights > 1e-9 * total
    fit = PointExposure(widths[is_used], weights[is_used] / total)
    return PointExposure(
        fit.widths_um, fit.weights, _fit_error(fit, radius, value / total)
    )


def _fit_error(fit: PointExposure, radius: Array, density: Array) -> float:
    """Largest error of the energy between the first radius and each other radius.

    The energy of the table is integrated with a power law between samples.

    Args:
        fit: sum of Gaussians.
        radius: (n,) um.
        density: (n,) of the table, 1 / um^2.
    """
    slope = np.diff(np.log(density)) / np.diff(np.log(radius)) + 2
    start = density[:-1] * radius[:-1] ** 2
    end = density[1:] * radius[1:] ** 2
    is_flat = abs(slope) < 1e-9
    ring = np.where(
        is_flat,
        start * np.diff(np.log(radius)),
        (end - start) / np.where(is_flat, 1, slope),
    )
    table = 2 * np.pi * np.r_[0, np.cumsum(ring)]
    return float(abs(fit.within(radius) - fit.within(radius[:1]) - table).max())


def rim_of_own_disc(diameter_um: Array | float, width_um: float) -> Array:
    """Exposure at the rim of a disc of unit dose by one Gaussian: (1 - exp(-x) I0(x)) /
    2, x = 2 R^2 / a^2.

    From the Marcum Q function at equal arguments, Q1(c, c) = (1 + exp(-c^2) I0(c^2)) /
    2. Exact.

    Args:
        diameter_um: of the disc.
        width_um: 1/e radius.
    """
    from scipy.special import i0e

    x = 2 * (np.asarray(diameter_um, float) / 2 / width_um) ** 2
    return np.asarray((1 - i0e(x)) / 2)


def slope_at_rim(diameter_um: Array | float, width_um: float) -> Array:
    """How fast that exposure falls with the radius there, per um: (2 R / a^2) exp(-x)
    I1(x). Exact.

    Args:
        diameter_um: of the disc.
        width_um: 1/e radius.
    """
    from scipy.special import i1e

    radius = np.asarray(diameter_um, float) / 2
    return np.asarray(2 * radius / width_um**2 * i1e(2 * (radius / width_um) ** 2))


def disc_exposure(
    distance_um: Array | float, diameter_um: Array | float, width_um: float
) -> Array:
    """Exposure by one Gaussian around a disc of unit dose, exact.

    It is the probability that a Gaussian displacement ends within the disc: non-central
    chi-square of 2 degrees of freedom.

    Args:
        distance_um: from the centre.
        diameter_um: of the disc.
        width_um: 1/e radius of the Gaussian.
    """
    from scipy.special import chndtr

    scale = 2 / width_um**2
    return np.asarray(
        chndtr(scale * np.square(diameter_um) / 4, 2.0, scale * np.square(distance_um))
    )
