"""The lens that was made, as a record and as a file: values, covariance, what can and what cannot be known."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from characterize.parameters import PLACE, bias_um, vector
from metalens import lens as lenses
from metalens import store
from metalens.lens import DiameterMap, Lens
from metalens.store import Array, Provenance


@dataclass(frozen=True, eq=False, slots=True)
class AsBuilt:
    """Result of :func:`characterize.fit`.

    design: the lens as designed. names, value, covariance: of the fitted parameters, priors included.
    held: {name: value} of parameters that were not fitted.
    information: Fisher information of the frames alone.
    depth_um, angle_rad: stated, of every frame in the order used. pixel_um: of the sensor.
    measured, predicted, nominal: (n, y, x) electrons: seen, as built, as designed (with fitted gain and background).
    residual_sigma: (n, y, x), 0 where masked.
    identifiable: combinations of parameters that the frames alone fix, with their 1 sigma, best first, in words.
    degeneracies: what cannot be told apart, in words. cautions: everything that was put right or assumed.
    trusted: every check passed; problems: those that did not.
    """

    design: Lens
    names: tuple[str, ...]
    value: Array
    covariance: Array
    information: Array
    held: dict[str, float]
    depth_um: Array
    angle_rad: Array
    pixel_um: float
    measured: Array
    predicted: Array
    nominal: Array
    residual_sigma: Array
    chi2_per_dof: float
    converged: bool
    reason: str
    identifiable: tuple[str, ...] = ()
    degeneracies: tuple[str, ...] = ()
    cautions: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()
    provenance: Provenance = field(default_factory=Provenance)

    @property
    def trusted(self) -> bool:
        """Whether all checks passed."""
        return not self.problems

    @property
    def sigma(self) -> Array:
        """(p,) standard errors."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def correlation(self) -> Array:
        """(p, p) correlation matrix."""
        sigma = self.sigma
        return np.asarray(self.covariance / np.outer(sigma, sigma))

    def interval(self, name: str) -> tuple[float, float]:
        """95 % interval of a parameter."""
        i = self.names.index(name)
        reach = 1.959964 * float(self.sigma[i])
        return float(self.value[i]) - reach, float(self.value[i]) + reach

    def parameters(self, value: Array | None = None) -> Array:
        """All parameters in the order of ``parameters.NAMES``; ``value``: of the fitted ones, the best without it."""
        fitted = self.value if value is None else value
        return vector(self.held | dict(zip(self.names, np.asarray(fitted, float).tolist(), strict=True)))

    def samples(self, count: int, *, seed: int) -> Array:
        """(count, p) draws of the fitted parameters from their (Gaussian) posterior, for training under uncertainty."""
        random = np.random.default_rng(seed)
        values, vectors = np.linalg.eigh(self.covariance)
        draws = random.standard_normal((count, len(self.value))) * np.sqrt(np.maximum(values, 0))
        return np.asarray(self.value + draws @ vectors.T)

    def lens(self, value: Array | None = None) -> Lens:
        """The lens with as-built diameters and distance; ``value`` as one row of :meth:`samples`."""
        return built_lens(self.design, self.parameters(value))

    @property
    def diameters(self) -> DiameterMap:
        """The as-built diameter map."""
        return self.lens().diameters


def built_lens(design: Lens, x: Array) -> Lens:
    """The design with the diameter bias and distance of a full parameter vector."""
    d = design.diameters
    radius = d.radius_um
    u, v = np.meshgrid(d.x_um / radius, d.y_um / radius)
    bias, _ = bias_um(x, u, v)
    low, high = design.proxy.domain_um
    grown = np.clip(d.diameter_um + bias, low, min(high, 0.999 * d.pitch_um))
    return Lens(
        diameters=DiameterMap(np.where(d.diameter_um > 0, grown, 0.0), d.pitch_um),
        cell=design.cell,
        proxy=design.proxy,
        wavelength_um=design.wavelength_um + x[PLACE["wavelength_nm"]] * 1e-3,
        sensor_distance_um=design.sensor_distance_um + x[PLACE["distance_um"]],
        source_distance_um=design.source_distance_um,
        profile="as-built",
        provenance=design.provenance,
    )


_ARRAYS = (
    "value",
    "covariance",
    "information",
    "depth_um",
    "angle_rad",
    "measured",
    "predicted",
    "nominal",
    "residual_sigma",
)
_WORDS = ("names", "identifiable", "degeneracies", "cautions", "problems")


def save(path: str | Path, result: AsBuilt) -> None:
    """Write an as-built file (kind ``asbuilt``); the design lies inside, so that it can be used alone."""
    arrays: dict[str, Array] = {name: getattr(result, name) for name in _ARRAYS}
    arrays |= {name: np.array(getattr(result, name) or ("",)) for name in _WORDS}
    arrays["held_names"] = np.array(list(result.held))
    arrays["held"] = np.array(list(result.held.values()), float)
    arrays["diameter_um"] = np.asarray(result.diameters.diameter_um, float)
    design, about = lenses.parts(result.design, group="design/")
    arrays |= design | {"design/diameter_um": np.asarray(result.design.diameters.diameter_um, float)}
    about |= {
        "pixel_um": result.pixel_um,
        "chi2_per_dof": result.chi2_per_dof,
        "converged": result.converged,
        "reason": result.reason,
    }
    store.save(path, "asbuilt", arrays, attributes=about, provenance=result.provenance)


def load(path: str | Path) -> AsBuilt:
    """Read an as-built file.

    Raises:
        StoreError: not an as-built file.
    """
    stored = store.load(path, "asbuilt")
    a, about = stored.arrays, stored.attributes
    design = lenses.from_parts(a, about, where=str(path), group="design/")
    fields: dict[str, Any] = {name: a[name] for name in _ARRAYS}
    fields |= {name: tuple(w for w in _text(a[name]) if w) for name in _WORDS}
    return AsBuilt(
        design=design,
        held=dict(zip(_text(a["held_names"]), a["held"].tolist(), strict=True)),
        pixel_um=about["pixel_um"],
        chi2_per_dof=about["chi2_per_dof"],
        converged=bool(about["converged"]),
        reason=about["reason"],
        provenance=stored.provenance,
        **fields,
    )


def _text(array: Array) -> list[str]:
    return [w.decode() if isinstance(w, bytes) else str(w) for w in array.tolist()]
