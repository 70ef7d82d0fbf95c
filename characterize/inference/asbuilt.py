"""The lens that was made, as a record and as a file: values, covariance, what can and what cannot be known.

For those who build on it (retraining, mask correction)::

    built = AsBuilt.load("asbuilt.h5")             # built.save(path) writes it
    built.names, built.value, built.covariance     # (p,), (p,), (p, p) of the fitted parameters; built.sigma
    built.trusted, built.problems                  # whether the fit passed its own checks
    built.lens()                                   # Lens with the as-built diameters, wavelength and distance
    built.diameters                                # its DiameterMap
    built.pillars()                                # (y, x) complex t of every pillar: process and wave front too
    built.psf()                                    # PsfStack at the depths and angles of the captures
    built.psf_stack(View(depths_um, angles_rad, window_um, samples))   # PsfStack anywhere else
    draws = built.samples(16, seed=0)              # (16, p) from the posterior
    built.psf_stack(view, draws[3])                # ... and the lens, pillars and PSFs of each:
    built.lens(draws[3]), built.pillars(draws[3])

PSFs hold all that belongs to the lens (pillars, process, aberrations, distance, wavelength), nothing of the bench.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from characterize.model import PLACE, Setting, made, oversampling, true_depth, vector
from metalens import lens as lenses
from metalens.ground import store
from metalens.ground.arrays import Array
from metalens.ground.reading import reader
from metalens.ground.store import Provenance
from metalens.lens import DiameterMap, Lens
from metalens.made import Sensitivity, Solved
from metalens.psf import PsfStack, View


@dataclass(frozen=True, eq=False, slots=True)
class AsBuilt:
    """Result of :func:`characterize.fit`.

    design: the lens as designed. response: what height, index and sidewall do to its pillars.
    names, value, covariance: of the fitted parameters, priors included.
    held: {name: value} of parameters that were not fitted.
    information: Fisher information of the frames alone.
    depth_um, angle_rad: stated, of every frame in the order used. pixel_um: of the sensor.
    measured, predicted, nominal: (n, y, x) electrons: seen, as built, as designed (with fitted gain and background).
    residual_sigma: (n, y, x), 0 where masked.
    identifiable: combinations of parameters that the frames alone fix, with their 1 sigma, best first, in words.
    degeneracies: what cannot be told apart, in words. cautions: everything that was put right or assumed.
    trusted: every check passed; problems: those that did not.
    residual_modes: of a smooth phase beyond the parameters (:mod:`thinplate`); empty where none was kept.
    low, high: (p,) 95 % intervals by profile over all valleys; draws: (m, p) of the posterior where it is no parabola.
    verdicts: how well the PSF is known, and how well the process, in words.
    causes, by_cause, unstated: what the captures cannot tell apart and nobody stated: names (c,), (c, p) shift of every
        parameter by each of plausible size, (p,) by all of them together, standard deviations.
    curves: {name: (2, points)} values of a parameter, and the rise of -2 ln L there with all others fitted.
    """

    design: Lens
    response: Sensitivity
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
    residual_modes: Array = field(default_factory=lambda: np.empty(0))
    low: Array = field(default_factory=lambda: np.empty(0))
    high: Array = field(default_factory=lambda: np.empty(0))
    draws: Array = field(default_factory=lambda: np.empty((0, 0)))
    verdicts: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    by_cause: Array = field(default_factory=lambda: np.empty((0, 0)))
    unstated: Array = field(default_factory=lambda: np.empty(0))
    curves: dict[str, Array] = field(default_factory=dict)
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
        """95 % interval of a parameter within the model: by its profile where there is one, else 1.96 sigma each way.

        It holds where what the model lacks is absent, or stated; see :meth:`outer` for where that is not known.
        """
        i = self.names.index(name)
        if len(self.low):
            return float(self.low[i]), float(self.high[i])
        reach = 1.959964 * float(self.sigma[i])
        return float(self.value[i]) - reach, float(self.value[i]) + reach

    def outer(self, name: str) -> tuple[float, float]:
        """95 % interval of a parameter with what the captures cannot tell: :meth:`interval`, and 1.96 ``unstated`` in
        quadrature."""
        low, high = self.interval(name)
        i = self.names.index(name)
        value, more = float(self.value[i]), 1.959964 * float(self.unstated[i]) if len(self.unstated) else 0.0
        return value - math.hypot(value - low, more), value + math.hypot(high - value, more)

    def most(self, name: str) -> tuple[str, ...]:
        """Causes that nobody stated and that widen the interval of a parameter, the most telling first.

        Those that alone move it by a quarter of its standard error and by a third of what the worst does.
        """
        i = self.names.index(name)
        own = self.by_cause[:, i] if len(self.causes) else np.empty(0)
        low, high = self.interval(name)
        least = max(0.25 * (high - low) / 3.92, float(own.max(initial=0.0)) / 3)
        return tuple(self.causes[k] for k in np.argsort(-own) if own[k] > least)

    def parameters(self, value: Array | None = None) -> Array:
        """All parameters in the order of ``parameters.NAMES``; ``value``: of the fitted ones, the best without it."""
        fitted = self.value if value is None else value
        return vector(self.held | dict(zip(self.names, np.asarray(fitted, float).tolist(), strict=True)))

    def samples(self, count: int, seed: int = 0) -> Array:
        """(count, p) draws of the fitted parameters from their posterior, for training under uncertainty.

        Those of ``draws`` where the posterior is bent or double (again from the first where more are asked for), else
        Gaussian.
        """
        random = np.random.default_rng(seed)
        if len(self.draws):
            order = [random.permutation(len(self.draws)) for _ in range(-(-count // len(self.draws)))]
            return np.asarray(self.draws[np.concatenate(order)[:count]])
        values, vectors = np.linalg.eigh(self.covariance)
        draws = random.standard_normal((count, len(self.value))) * np.sqrt(np.maximum(values, 0))
        return np.asarray(self.value + draws @ vectors.T)

    def lens(self, value: Array | None = None) -> Lens:
        """The lens with as-built diameters and distance; ``value`` as one row of :meth:`samples`."""
        return made.built_lens(self.design, self.parameters(value))

    @property
    def diameters(self) -> DiameterMap:
        """The as-built diameter map."""
        return self.lens().diameters

    def pillars(self, value: Array | None = None) -> Array:
        """(y, x) complex transmission of every as-built pillar at normal incidence, wave-front errors included."""
        return made.pillars(self.design, self.response, self.parameters(value), modes=self.residual_modes)

    def psf(self) -> PsfStack:
        """PSFs (angle, depth, y, x) at the true depths of the captures, as fine as the light, on the fitted window.

        Computed anew by each call: seconds for a lens of a millimetre.
        """
        side = max(self.measured.shape[1:])
        setting = Setting(self.depth_um, self.angle_rad, np.ones(len(self.depth_um)), self.pixel_um, side, side)
        depths = np.unique(np.round(true_depth(self.parameters(), setting, float(self.depth_um.mean())), 3))
        angles = tuple((float(a), float(b)) for a, b in np.unique(self.angle_rad, axis=0))
        samples = side * oversampling(self.design, self.pixel_um)
        view = View(tuple(depths.tolist()), angles, side * self.pixel_um, samples)
        return self.psf_stack(view, tolerance=1e-3)

    def psf_stack(self, view: View, value: Array | None = None, *, tolerance: float = 1e-4) -> PsfStack:
        """PSFs (angle, depth, y, x) of the lens as built; ``value`` as one row of :meth:`samples`.

        Windows are centred on the chief ray of the best fit. A draw's own is moved by the difference of the two
        decentres, so that draws differ by what the frames leave open and not by a gradient of the bias that
        the decentre makes up for.

        Raises:
            PropagationError: as :func:`metalens.psf.psf_stack`.
        """
        x, best = self.parameters(value), self.parameters()
        dx, dy = (float(x[PLACE[name]] - best[PLACE[name]]) for name in ("decentre_x_um", "decentre_y_um"))
        more: dict[str, Any] = {"modes": self.residual_modes, "offset_um": (dx, dy), "tolerance": tolerance}
        return made.psf_stack(self.design, self.response, x, view, **more)

    def save(self, path: str | Path) -> None:
        """Write the file; see :func:`save`."""
        save(path, self)

    @staticmethod
    def load(path: str | Path) -> "AsBuilt":
        """Read the file; see :func:`load`."""
        return load(path)


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
_WORDS = ("names", "identifiable", "degeneracies", "cautions", "problems", "verdicts", "causes")


def save(path: str | Path, result: AsBuilt) -> None:
    """Write an as-built file (kind ``asbuilt``); the design lies inside, so that it can be used alone."""
    arrays: dict[str, Array] = {name: getattr(result, name) for name in _ARRAYS}
    arrays |= {name: np.array(getattr(result, name) or ("",)) for name in _WORDS}
    arrays["held_names"] = np.array(list(result.held))
    arrays["held"] = np.array(list(result.held.values()), float)
    for name in ("low", "high", "draws", "by_cause", "unstated"):
        if len(getattr(result, name)):
            arrays[name] = getattr(result, name)
    if len(result.residual_modes):
        arrays["residual_modes"] = result.residual_modes
    arrays |= {f"curves/{name}": curve for name, curve in result.curves.items()}
    arrays |= {"response/coefficients": result.response.coefficients}
    if result.response.solved is not None:
        solved = result.response.solved
        arrays |= {"response/diameter_um": solved.diameter_um, "response/powers": solved.powers}
        arrays |= {"response/wavelength_um": np.array(solved.wavelength_um)}
    arrays["diameter_um"] = np.asarray(result.diameters.diameter_um, float)
    design, about = lenses.parts(result.design, group="design/")
    arrays |= design | {"design/diameter_um": np.asarray(result.design.diameters.diameter_um, float)}
    about |= {
        "pixel_um": result.pixel_um,
        "chi2_per_dof": result.chi2_per_dof,
        "converged": result.converged,
        "reason": result.reason,
        "response_center_um": result.response.center_um,
        "response_error": result.response.error,
        "response_low_um": result.response.low_um,
        "response_high_um": result.response.high_um,
    }
    store.save(path, "asbuilt", arrays, attributes=about, provenance=result.provenance)


@reader
def load(path: str | Path) -> AsBuilt:
    """Read an as-built file.

    Raises:
        StoreError: not an as-built file.
    """
    stored = store.load(path, "asbuilt")
    a, about = stored.arrays, stored.attributes
    design = lenses.from_parts(a, about, where=str(path), group="design/")
    fields: dict[str, Any] = {name: a[name] for name in _ARRAYS}
    fields |= {name: tuple(w for w in _text(a.get(name, np.empty(0))) if w) for name in _WORDS}
    fields |= {name: a[name] for name in ("low", "high", "draws", "by_cause", "unstated") if name in a}
    return AsBuilt(
        design=design,
        response=_response(a, about),
        residual_modes=a.get("residual_modes", np.empty(0)),
        curves={name.removeprefix("curves/"): a[name] for name in a if name.startswith("curves/")},
        held=dict(zip(_text(a["held_names"]), a["held"].tolist(), strict=True)),
        pixel_um=about["pixel_um"],
        chi2_per_dof=about["chi2_per_dof"],
        converged=bool(about["converged"]),
        reason=about["reason"],
        provenance=stored.provenance,
        **fields,
    )


def _response(arrays: dict[str, Array], about: dict[str, Any]) -> Sensitivity:
    ends = about.get("response_low_um", -math.inf), about.get("response_high_um", math.inf)
    solved = None
    if "response/powers" in arrays:
        wave = float(arrays["response/wavelength_um"])
        solved = Solved(wave, arrays["response/diameter_um"], arrays["response/powers"])
    return Sensitivity(
        arrays["response/coefficients"], about["response_center_um"], about["response_error"], *ends, solved
    )


def _text(array: Array) -> list[str]:
    return [w.decode() if isinstance(w, bytes) else str(w) for w in array.tolist()]
