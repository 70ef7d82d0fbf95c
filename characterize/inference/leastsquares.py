"""Maximum likelihood for images: Levenberg-Marquardt with model-based weights,
censoring, outliers and priors.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from metalens.core.arrays import Array
from metalens.core.errors import FitError

# sigma of the least step that updates slopes: images are rounded to about 1e-3 sigma
_TELLING = 0.03
# relative error of the predicted change of the images above which the Jacobian is
# computed anew
_MISSED = 0.6
HUBER = 6.0  # sigma beyond which a residual counts linearly
_NODES, _WEIGHTS = special.roots_jacobi(4, 1.0, 0.0)
_JACOBI = (_NODES + 1) / 2, _WEIGHTS / 4  # of (1 - s) f(s) over s from 0 to 1
Model = Callable[[Array, bool], tuple[Array, Array | None]]
"""(parameters, with Jacobian) -> (images (n, y, x), Jacobian (p, n, y, x) or None)."""


@dataclass(frozen=True, eq=False, slots=True)
class FitImages:
    """Frames to fit, in electrons, with masks and noise.

    variance_e2: at zero light. scale: light over its shot-noise variance.
    model_error: standard deviation of the model, as a share of the light in a pixel;
    added to the noise.
    common_floor: share of ``variance_e2`` that is one error in all frames.
    common_light: relative error of a pixel's light that is one in all frames, not in
    the variance. Both widen intervals and do not change the weights.
    count_e: electrons of a count, ``count_e / scale`` in a pixel, where pixels are
    rounded counts; 0 where they are means.
    """

    electrons: Array
    usable: Array
    saturated: Array
    variance_e2: Array
    scale: Array
    model_error: float = 0.0
    common_floor: float | Array = 0.0
    common_light: float = 0.0
    count_e: float = 0.0

    def variance(self, image: Array) -> Array:
        """(n, y, x) variance of a pixel whose expected light is ``image``."""
        light = np.maximum(image, 0)
        return self.variance_e2 + light / self.scale + (self.model_error * light) ** 2

    def shared(self, image: Array) -> Array:
        """(2, n, y, x) standard deviations of errors that all frames share: dark, flat.

        The first is part of the noise of every frame, the second is not.
        """
        return np.stack(
            [
                np.sqrt(self.common_floor * self.variance_e2),
                self.common_light * np.maximum(image, 0),
            ]
        )

    def deviance(self, image: Array) -> Array:
        """(n, y, x) quasi-deviance of every pixel, 0 where it says nothing.

        2 times the integral of (d - t) / v(t) over t from image I to count d
        (McCullagh and Nelder 1989, 9.2): its derivative by I is the quasi-score of a
        Poisson count with Gaussian noise. Accuracy: 4 points of Gauss and Jacobi, 1e-3
        where the variance v changes tenfold.
        """
        off = np.where(self.usable, self.electrons - image, 0.0)
        off = np.where(self.saturated, np.maximum(off, 0.0), off)
        integral = sum(
            weight / self.variance(image + share * off)
            for share, weight in zip(*_JACOBI, strict=True)
        )
        return np.asarray(2 * off**2 * integral)

    def planes(self, index: Array) -> "FitImages":
        """Some of the frames."""
        return self.arranged(lambda part: part[index])

    def arranged(self, change: Callable[[Array], Array]) -> "FitImages":
        """The same of frames that are laid otherwise, or of some of them."""
        fields = dataclasses.fields(self)
        values = {field.name: getattr(self, field.name) for field in fields}
        changed: dict[str, Any] = {
            name: change(value)
            for name, value in values.items()
            if isinstance(value, np.ndarray)
        }
        return dataclasses.replace(self, **changed)


@dataclass(frozen=True, eq=False, slots=True)
class GaussianPrior:
    """Gaussian knowledge of the parameters: mean and sigma (inf: nothing known), (p,)
    each; hard bounds, (p,) each.
    """

    mean: Array
    sigma: Array
    low: Array
    high: Array

    @classmethod
    def none(cls, start: Array) -> "GaussianPrior":
        """Nothing known: no pull, no bounds."""
        wide = np.full(len(start), np.inf)
        return cls(np.array(start, float), wide, -wide, wide.copy())


@dataclass(frozen=True, slots=True)
class SolverSettings:
    """When a fit stops, how it treats outliers, and when it renews the Jacobian.

    huber: sigma beyond which a residual counts linearly.
    near: length of steps, sigma, over which an exact Jacobian is trusted: it is updated
    by the images of each step (Broyden 1965), and steps that look final, and those that
    fail, are checked with an exact one beyond.
    finish: the Jacobian at the end is exact, or was so within ``near``.
    """

    iterations: int = 40
    step_tolerance: float = 0.02
    huber: float = HUBER
    near: float = 0.3
    finish: bool = True


@dataclass(frozen=True, eq=False, slots=True)
class FitSolution:
    """Estimate with covariance.

    value: (p,). covariance: (p, p) inverse of the Fisher information with the priors'.
    information: (p, p) Fisher information of the data alone.
    image, residual_sigma: (n, y, x) model, and (data - model) / sigma, 0 where masked
    or silent.
    chi2_per_dof: reduced chi-square of the pixels within ``huber``, over its
    expectation.
    merit: -2 ln posterior, but for a constant (:meth:`FitProblem.merit`).
    converged, reason: why it stopped.
    beyond: (p,) sigma from each value to where the parabola has its least: 0 but for
    bounds that hold it back.
    slopes: (p, n, y, x) Jacobian that the fit ended with, exact or brought up to date;
    one close by may begin with it.
    """

    value: Array
    covariance: Array
    information: Array
    image: Array
    residual_sigma: Array
    chi2_per_dof: float
    merit: float
    converged: bool
    reason: str
    iterations: int
    beyond: Array
    slopes: Array


@dataclass(frozen=True, eq=False, slots=True)
class FitProblem:
    """Images by parameters, the frames they are fitted to, and prior knowledge."""

    model: Model
    data: FitImages
    prior: GaussianPrior

    def merit(self, x: Array) -> float:
        """-2 ln posterior at (p,) parameters ``x``, but for a constant."""
        return _merit(self.data, self.model(x, False)[0], x, self.prior)

    def fit(
        self,
        start: Array,
        settings: SolverSettings | None = None,
        slopes: Array | None = None,
    ) -> FitSolution:
        """:func:`fit_levenberg_marquardt` from (p,) ``start`` with ``settings`` and
        ``slopes`` (p, n, y, x) of a place close by.
        """
        return fit_levenberg_marquardt(
            self.model,
            self.data,
            start,
            prior=self.prior,
            settings=settings,
            slopes=slopes,
        )

    def with_fixed(self, i: int, value: float) -> "FitProblem":
        """The same with parameter number ``i`` fixed at ``value``."""
        low, high = self.prior.low.copy(), self.prior.high.copy()
        low[i] = high[i] = value
        prior = dataclasses.replace(self.prior, low=low, high=high)
        return dataclasses.replace(self, prior=prior)


def fit_levenberg_marquardt(
    model: Model,
    data: FitImages,
    start: Array,
    *,
    prior: GaussianPrior | None = None,
    settings: SolverSettings | None = None,
    slopes: Array | None = None,
) -> FitSolution:
    """Maximum posterior of the parameters by Levenberg-Marquardt from one start.

    Steps solve (C + damping diag C) s = -g with curvature C and gradient g of the
    weighted residuals and the prior. The fit stops when a full step moves every
    combination of parameters by less than ``step_tolerance`` sigma.

    Args:
        model: (parameters, with Jacobian) -> (images, Jacobian or None).
        data: frames, masks and noise.
        start: (p,) parameters.
        prior: prior knowledge of the fitted parameters.
        settings: when to stop.
        slopes: (p, n, y, x) Jacobian of a place close by, to begin with; computed
            without it.

    Raises:
        FitError: the model is not finite at the start, or no pixel is usable.
    """
    settings = settings or SolverSettings()
    prior = prior or GaussianPrior.none(start)
    x = np.clip(np.asarray(start, float), prior.low, prior.high)
    if not data.usable.any():
        raise FitError("no usable pixel in the fit window; check masks and crop")
    damping = 1e-3
    converged = False
    reason = f"stopped after {settings.iterations} iterations"
    state = _linearise(model, data, x, prior, settings, slopes)
    iteration = 0
    while iteration < settings.iterations:
        iteration += 1
        step, image, damping, accepted = _step(
            model, data, state, prior, settings, damping
        )
        moved = math.sqrt(max(float(step @ state.curvature @ step), 0.0))
        done = not accepted or moved < settings.step_tolerance * (1 + damping)
        # the Jacobian is exact, or was computed close enough
        fresh = state.travel <= settings.near if accepted else state.travel == 0
        if not fresh and (done or moved < settings.near):
            # what looks final is checked with an exact Jacobian
            x = state.x + step if accepted else state.x
            state = _linearise(model, data, x, prior, settings)
            damping = 1e-3
            continue
        if accepted and not done and _missed(state, step, image) > _MISSED:
            state = _linearise(model, data, state.x + step, prior, settings)
        elif accepted:
            state = _secant(data, state, step, image, prior, settings, moved=moved)
        if done:
            converged = moved < 10 * settings.step_tolerance
            reason = (
                f"last step moved {moved:.2g} sigma"
                if converged
                else "no step lowers the misfit"
            )
            break
    if settings.finish and state.travel > settings.near:
        state = _linearise(model, data, state.x, prior, settings)
    return _solution(data, state, prior, settings, (converged, reason, iteration))


@dataclass(frozen=True, eq=False, slots=True)
class _State:
    """The problem about a point; travel: sigma from where the Jacobian was computed,
    not only brought up to date.
    """

    x: Array
    image: Array
    jacobian: Array
    travel: float
    residual: Array
    weight: Array
    gradient: Array
    curvature: Array
    information: Array
    noise: Array


def _linearise(
    model: Model,
    data: FitImages,
    x: Array,
    prior: GaussianPrior,
    settings: SolverSettings,
    slopes: Array | None = None,
) -> _State:
    """The problem at (p,) ``x``, with an exact Jacobian or with ``slopes``.

    Raises:
        FitError: the images are not finite.
    """
    image, jacobian = model(x, slopes is None)
    jacobian = jacobian if slopes is None else slopes
    if jacobian is None or not np.isfinite(image).all():
        raise FitError(
            "the model is not finite at these parameters; bound them or correct the start"
        )
    return _state(
        data,
        (x, image, jacobian),
        prior,
        settings,
        travel=0.0 if slopes is None else math.inf,
    )


def _missed(state: _State, step: Array, image: Array) -> float:
    """Relative error of the Jacobian's prediction of a step, in sigma of the pixels.

    |dI - J s| / |dI| for the change dI of the images by the step s.
    """
    root = np.sqrt(state.weight) / state.noise
    change = (image - state.image) * root
    left = change - np.tensordot(step, state.jacobian, 1) * root
    return float(np.linalg.norm(left) / max(float(np.linalg.norm(change)), 1e-300))


def _secant(
    data: FitImages,
    state: _State,
    step: Array,
    image: Array,
    prior: GaussianPrior,
    settings: SolverSettings,
    *,
    moved: float,
) -> _State:
    """The problem after a step, with the Jacobian updated by the images (Broyden).

    J + (dI - J s) sᵀC / (sᵀC s), with the curvature C as the metric: the least change
    that explains dI. After a step of less than ``_TELLING`` sigma the Jacobian stays:
    rounding of the images (float32) over so short a step would be mistaken for slopes.
    Covariance and corrected fast models depend on these.
    """
    jacobian = state.jacobian
    if moved >= _TELLING:
        measure = state.curvature @ step
        missed = (image - state.image) - np.tensordot(step, jacobian, 1)
        share = measure / max(float(step @ measure), 1e-300)
        jacobian = jacobian + np.multiply.outer(share, missed)
    return _state(
        data,
        (state.x + step, image, jacobian),
        prior,
        settings,
        travel=state.travel + moved,
    )


def _state(
    data: FitImages,
    at: tuple[Array, Array, Array],
    prior: GaussianPrior,
    settings: SolverSettings,
    *,
    travel: float = 0.0,
) -> _State:
    """Gradient, curvature and weights of the problem at a point.

    Args:
        at: (parameters, image, Jacobian).
        travel: sigma from the point where the Jacobian was computed.
    """
    x, image, jacobian = at
    noise, residual, weight = pixel_weights(data, image, settings.huber)
    root = np.sqrt(weight)
    scaled = jacobian.reshape(len(x), -1) * (root / noise).ravel()
    information = scaled @ scaled.T
    pull = np.where(np.isfinite(prior.sigma), (x - prior.mean) / prior.sigma**2, 0.0)
    gradient = -scaled @ (root * residual).ravel() + pull
    curvature = information + np.diag(prior.sigma**-2.0)
    return _State(
        x,
        image,
        jacobian,
        travel,
        residual,
        weight,
        gradient,
        curvature,
        information,
        noise,
    )


def _step(
    model: Model,
    data: FitImages,
    state: _State,
    prior: GaussianPrior,
    settings: SolverSettings,
    damping: float,
) -> tuple[Array, Array, float, bool]:
    """A step that lowers the misfit: (step, image there, next damping, accepted).

    Damping grows by 6 until -2 ln posterior does not rise; parameters blocked by a
    bound stay. Two attempts with an approximate Jacobian, ten with an exact one.
    """
    before = _merit(data, state.image, state.x, prior, settings.huber)
    size = np.sqrt(np.maximum(np.diag(state.curvature), 1e-300))
    scaled = state.curvature / np.outer(size, size)
    # at a bound, with the gradient beyond it
    blocked = ((state.x <= prior.low) & (state.gradient > 0)) | (
        (state.x >= prior.high) & (state.gradient < 0)
    )
    free = np.flatnonzero(~blocked)
    step, image = np.zeros_like(state.x), state.image
    for _ in range(10 if state.travel == 0 else 2):
        matrix = scaled[np.ix_(free, free)] + damping * np.eye(len(free))
        step = np.zeros_like(state.x)
        gradient = state.gradient[free] / size[free]
        step[free] = -np.linalg.lstsq(matrix, gradient, rcond=1e-14)[0] / size[free]
        step = np.clip(state.x + step, prior.low, prior.high) - state.x
        image, _ = model(state.x + step, False)
        if np.isfinite(image).all():
            after = _merit(data, image, state.x + step, prior, settings.huber)
            if after <= before * (1 + 1e-12):
                return step, image, max(damping / 5, 1e-10), True
        damping *= 6
    return step, image, damping, False


def _merit(
    data: FitImages, image: Array, x: Array, prior: GaussianPrior, huber: float = HUBER
) -> float:
    """Deviance, linear beyond ``huber`` sigma, and the squared pull of the prior."""
    size = np.sqrt(data.deviance(image))
    loss = np.where(size <= huber, size**2, huber * (2 * size - huber))
    pull = np.where(np.isfinite(prior.sigma), (x - prior.mean) / prior.sigma, 0.0)
    return float(loss.sum() + (pull**2).sum())


def pixel_weights(
    data: FitImages, image: Array, huber: float = HUBER
) -> tuple[Array, Array, Array]:
    """Noise, residual over the noise, and robust weight of every pixel, (n, y, x) each.

    Args:
        data: what is fitted.
        image: (n, y, x) model.
        huber: sigma of an outlier.

    Returns:
        (noise in electrons, (data - model) / noise with saturated pixels only as far as
        the model falls short, weight from 0 to 1).
    """
    noise = np.sqrt(data.variance(image))
    residual = (data.electrons - image) / noise
    residual = np.where(data.saturated, np.maximum(residual, 0), residual)
    size = np.sqrt(data.deviance(image))
    weight = np.minimum(1.0, huber / np.maximum(size, huber))
    silent = ~data.usable | (data.saturated & (residual == 0))
    return noise, residual, np.where(silent, 0.0, weight)


def _solution(
    data: FitImages,
    state: _State,
    prior: GaussianPrior,
    settings: SolverSettings,
    ended: tuple[bool, str, int],
) -> FitSolution:
    """The solution at the end of a fit: covariance, reduced chi-square.

    Args:
        ended: (converged, reason, iterations).
    """
    counted = data.usable & ~data.saturated
    shown = state.residual * data.usable
    inlier = counted & (np.abs(state.residual) <= settings.huber)
    dof = max(int(inlier.sum()) * _inlier_variance(settings.huber) - len(state.x), 1.0)
    chi2 = float((state.residual[inlier] ** 2).sum()) / dof
    merit = _merit(data, state.image, state.x, prior, settings.huber)
    covariance = invert_information(state.curvature)
    return FitSolution(
        state.x,
        covariance,
        state.information,
        state.image,
        shown,
        chi2,
        merit,
        *ended,
        beyond=-covariance @ state.gradient / np.sqrt(np.diag(covariance)),
        slopes=state.jacobian,
    )


def _inlier_variance(huber: float) -> float:
    """Variance of a standard normal variable that is known to lie within +-huber.

    1 - 2 h phi(h) / (2 Phi(h) - 1): what a pixel adds to chi-square on average where
    residuals beyond ``huber`` are left out.
    """
    if not math.isfinite(huber):
        return 1.0
    density = math.exp(-(huber**2) / 2) / math.sqrt(2 * math.pi)
    return 1 - 2 * huber * density / math.erf(huber / math.sqrt(2))


def invert_information(matrix: Array) -> Array:
    """Inverse of a symmetric, possibly nearly singular information matrix, scaled so
    that units do not matter.
    """
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-60))
    values, vectors = np.linalg.eigh(matrix / np.outer(size, size))
    values = np.maximum(values, 1e-13)
    return np.asarray((vectors / values) @ vectors.T / np.outer(size, size))


def gaussian_draws(rng: np.random.Generator, count: int, covariance: Array) -> Array:
    """(count, p) Gaussian draws about 0 of a (p, p) ``covariance``, from ``rng``."""
    values, vectors = np.linalg.eigh(covariance)
    normal = rng.standard_normal((count, len(values)))
    return np.asarray(normal * np.sqrt(np.maximum(values, 0)) @ vectors.T)
