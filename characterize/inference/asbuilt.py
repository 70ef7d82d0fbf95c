"""The as-built lens as a record and as a file: values, covariance, intervals, texts."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from characterize.inference.leastsquares import REACH, gaussian_draws
from characterize.model import (
    PLACE,
    as_built,
    parameter_vector,
    required_oversampling,
    true_depth,
    usual_parameters,
)
from metalens import psf as psfs
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.store import Provenance, typed_reader
from metalens.fabrication import Sensitivity
from metalens.lens import DiameterMap, Lens


@dataclass(frozen=True, eq=False, slots=True)
class PosteriorMoments:
    """Covariance, intervals and draws of the fitted parameters; empty where not
    computed.

    covariance: (p, p). low, high: (p,) 95 % intervals by profile over all modes.
    draws: (m, p) of the posterior where it is no parabola.
    """

    covariance: Array = field(default_factory=lambda: np.empty((0, 0)))
    low: Array = field(default_factory=lambda: np.empty(0))
    high: Array = field(default_factory=lambda: np.empty(0))
    draws: Array = field(default_factory=lambda: np.empty((0, 0)))

    def interval(self, i: int, value: float) -> tuple[float, float]:
        """95 % interval of parameter ``i``: that of its profile if there is one, else
        ``value`` +- 1.96 sigma.
        """
        if len(self.low):
            return float(self.low[i]), float(self.high[i])
        reach = REACH * math.sqrt(float(self.covariance[i, i]))
        return value - reach, value + reach

    def samples(self, rng: np.random.Generator, count: int, value: Array) -> Array:
        """(count, p) draws: ``draws`` in random order, repeated as needed, else Gaussian
        about ``value`` (p,).
        """
        if not len(self.draws):
            return np.asarray(value + gaussian_draws(rng, count, self.covariance))
        repeats = math.ceil(count / len(self.draws))
        order = [rng.permutation(len(self.draws)) for _ in range(repeats)]
        return np.asarray(self.draws[np.concatenate(order)[:count]])


@dataclass(frozen=True, eq=False, slots=True)
class AsBuilt:
    """Result of :func:`characterize.fit`.

    ``covariance``, ``sigma``, ``interval``, ``draws`` and ``samples`` allow for what
    the captures cannot tell and
    nobody stated (glass, source, side wall ...): they hold on a bench that is not
    known. ``within`` does not.

    design: the lens as designed. response: what height, index and sidewall do to its
    pillars.
    names, value, covariance: of the fitted parameters, with priors and unstated effects.
    fixed: {name: value} of parameters that were not fitted.
    information: Fisher information of the frames alone.
    depth_um, angle_rad: stated, of every frame in the order used. pixel_um: of the
    sensor.
    measured, predicted, nominal: (n, y, x) electrons: measured, as built, as designed (with
    fitted gain and background).
    residual_sigma: (n, y, x), 0 where masked.
    identifiable: combinations of parameters that the frames alone fix, with their 1
    sigma, best first, in words.
    degeneracies: parameters that are not identifiable, in words. cautions: everything
    that was corrected or assumed.
    trusted: every check passed; problems: those that did not.
    low, high: (p,) 95 % intervals; draws: (m, p) of the posterior where it is no
    parabola.
    within: statistical (conditional) covariance, intervals and draws: all that is not
    fitted is as stated; empty where not computed.
    verdicts: how well the PSF is known, and how well the process, in words.
    causes, by_cause: effects that nobody stated: names (c,), (c, p) standard deviation
    of the shift of every parameter by each. bench: (p, p) second moment of the shifts
    by those of the bench alone, which the lens leaves behind.
    curves: {name: (2, points)} values of a parameter, and the rise of -2 ln L there
    with all others fitted.
    """

    design: Lens
    response: Sensitivity
    names: tuple[str, ...]
    value: Array
    covariance: Array
    information: Array
    fixed: dict[str, float]
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
    low: Array = field(default_factory=lambda: np.empty(0))
    high: Array = field(default_factory=lambda: np.empty(0))
    draws: Array = field(default_factory=lambda: np.empty((0, 0)))
    verdicts: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    by_cause: Array = field(default_factory=lambda: np.empty((0, 0)))
    bench: Array = field(default_factory=lambda: np.empty((0, 0)))
    within: PosteriorMoments = field(default_factory=PosteriorMoments)
    curves: dict[str, Array] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=Provenance)

    @property
    def trusted(self) -> bool:
        """Whether all checks passed."""
        return not self.problems

    @property
    def sigma(self) -> Array:
        """(p,) total (Type A and B) standard errors."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    @property
    def _total(self) -> PosteriorMoments:
        """Total (marginal) covariance, intervals and draws."""
        return PosteriorMoments(self.covariance, self.low, self.high, self.draws)

    @property
    def _statistical(self) -> PosteriorMoments:
        """``within``; the total ones where it was not computed."""
        return self.within if len(self.within.covariance) else self._total

    @property
    def within_covariance(self) -> Array:
        """(p, p) statistical covariance; the total one where it was not computed."""
        return self._statistical.covariance

    @property
    def correlation(self) -> Array:
        """(p, p) correlation matrix."""
        sigma = self.sigma
        return np.asarray(self.covariance / np.outer(sigma, sigma))

    def interval(self, name: str) -> tuple[float, float]:
        """Total (marginal) 95 % interval of a parameter.

        Profile interval and the spread of shifts by unstated effects, in quadrature,
        about the value less their expected shift. It contains the statistical interval.
        """
        i = self.names.index(name)
        return self._total.interval(i, float(self.value[i]))

    def within_model(self, name: str) -> tuple[float, float]:
        """Statistical 95 % interval, if the model is complete; too narrow if it is not."""
        i = self.names.index(name)
        return self._statistical.interval(i, float(self.value[i]))

    def most(self, name: str) -> tuple[str, ...]:
        """Unstated causes that widen the interval of a parameter, the largest first.

        Those that alone shift it by a quarter of its standard error, and by a third of
        the shift of the largest.
        """
        i = self.names.index(name)
        own = self.by_cause[:, i] if len(self.causes) else np.empty(0)
        low, high = self.within_model(name)
        sigma = (high - low) / (2 * REACH)
        least = max(0.25 * sigma, float(own.max(initial=0.0)) / 3)
        return tuple(self.causes[k] for k in np.argsort(-own) if own[k] > least)

    def parameters(self, value: Array | None = None) -> Array:
        """All parameters in the order of ``parameters.NAMES``; ``value``: of the fitted
        ones, the best without it.
        """
        fitted = np.asarray(self.value if value is None else value, float).tolist()
        return parameter_vector(self.fixed | dict(zip(self.names, fitted, strict=True)))

    def samples(self, count: int, seed: int = 0) -> Array:
        """(count, p) draws of the fitted parameters from their posterior.

        Of the process, for the next mask. Resampled from ``draws`` where the
        posterior is not Gaussian.
        """
        rng = np.random.default_rng(seed)
        return self._bounded(self._total.samples(rng, count, self.value))

    def lens_samples(self, count: int, seed: int = 0) -> Array:
        """(count, p) draws of what the lens does to light: for training and PSF errors.

        Narrower than :meth:`samples`. A tilted wall or displaced write field that was
        taken for height or trefoil stays with the lens, and acts on light as it did on
        the bench. What belonged to the bench (glass, source, light) does not.
        """
        if not len(self.within.covariance):
            return self.samples(count, seed)
        rng = np.random.default_rng(seed)
        own = self.within.samples(rng, count, self.value)
        return self._bounded(own + gaussian_draws(rng, count, self.bench))

    def _bounded(self, draws: Array) -> Array:
        """Draws (count, p) clipped to the bounds of the parameters."""
        rows = usual_parameters(self.names, self.design)
        return np.clip(draws, [row.low for row in rows], [row.high for row in rows])

    def lens(self, value: Array | None = None) -> Lens:
        """The lens with as-built diameters and distance; ``value`` as one row of
        :meth:`samples`.
        """
        return as_built.built_lens(self.design, self.parameters(value))

    @property
    def diameters(self) -> DiameterMap:
        """The as-built diameter map."""
        return self.lens().diameters

    def pillars(self, value: Array | None = None) -> Array:
        """(y, x) complex transmission of every as-built pillar at normal incidence,
        wave-front errors included.
        """
        return as_built.as_built_transmission(
            self.design, self.response, self.parameters(value)
        )

    def psf(self) -> "psfs.PsfStack":
        """PSFs (angle, depth, y, x) at the true depths of the captures, as fine as the
        light, on the fitted window.

        Computed anew by each call: seconds for a lens of a millimetre.
        """
        side = max(self.measured.shape[1:])
        centre_um = float(self.depth_um.mean())
        depth_um = true_depth(self.parameters(), self.depth_um, centre_um)
        depths = np.unique(np.round(depth_um, 3))
        angles = tuple(
            (float(a), float(b)) for a, b in np.unique(self.angle_rad, axis=0)
        )
        samples = side * required_oversampling(self.design, self.pixel_um)
        view = psfs.View(tuple(depths.tolist()), angles, side * self.pixel_um, samples)
        return self.psf_stack(view, tolerance=1e-3)

    def psf_stack(
        self, view: "psfs.View", value: Array | None = None, *, tolerance: float = 1e-4
    ) -> "psfs.PsfStack":
        """PSFs (angle, depth, y, x) of the lens as built.

        Windows are centred on the chief ray of the best fit. That of a draw is moved by
        the difference of both decentres: draws then differ by the uncertainty of the
        lens, not by a gradient of the bias that the decentre compensates.

        Args:
            view: angles, depths and window.
            value: (p,) fitted parameters, a row of :meth:`samples`; default: the best.
            tolerance: relative error.

        Raises:
            PropagationError: as :func:`metalens.psf.psf_stack`.
        """
        x = self.parameters(value)
        best = self.parameters()
        dx, dy = (
            float(x[PLACE[name]] - best[PLACE[name]])
            for name in ("decentre_x_um", "decentre_y_um")
        )
        more: dict[str, Any] = {"offset_um": (dx, dy), "tolerance": tolerance}
        return as_built.psf_stack(self.design, self.response, x, view, **more)

    def psf_posterior(self, view: "psfs.View", *, draws: int = 8) -> float:
        """Relative L2 error of :meth:`psf_stack` from the uncertainty of the lens.

        Root mean square over draws from its posterior, at the worst field angle.
        Accuracy: a quarter, from 8 draws.
        """
        best = self.psf_stack(view, tolerance=1e-3).intensity
        square = np.zeros(len(best))
        for value in self.lens_samples(draws, seed=0):
            off = self.psf_stack(view, value, tolerance=1e-3).intensity - best
            square += (off**2).sum((1, 2, 3)) / (best**2).sum((1, 2, 3))
        return float(np.sqrt(square.max() / draws))

    def save(self, path: str | Path) -> None:
        """Write an as-built file (kind ``asbuilt``); the design lies inside, so that it
        can be used alone.
        """
        arrays, attributes = store.flatten_record(self)
        arrays["diameter_um"] = np.asarray(self.diameters.diameter_um, float)
        more: dict[str, Any] = {"attributes": attributes, "provenance": self.provenance}
        store.save(path, "asbuilt", arrays, **more)

    @staticmethod
    @typed_reader
    def load(path: str | Path) -> "AsBuilt":
        """Read an as-built file.

        Raises:
            StoreError: not an as-built file.
        """
        return store.load_record(path, "asbuilt", AsBuilt)
