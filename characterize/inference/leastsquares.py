"""Maximum likelihood for images: Levenberg-Marquardt with model-based weights,
censoring, outliers and priors.

The score of a Poisson count plus Gaussian noise, sum (d - I) dI / (I + v), is that of a
weighted least-squares
problem whose weights follow the model, so iterating the weights gives the
maximum-likelihood estimate (quasi-score
equations, McCullagh and Nelder). A saturated pixel says only "at least this much": it
pulls while the model
is below it and is silent above. Residuals beyond ``huber`` sigma count linearly (Huber
1964).
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from characterize.inference import constrained
from characterize.inference.constrained import BallConstraint
from metalens.core.arrays import Array
from metalens.core.errors import FitError

# sigma of a step from which on images tell slopes: they are rounded by a thousandth of
# one or two
_TELLING = 0.03
Model = Callable[[Array, bool], tuple[Array, Array | None]]
"""(parameters, with Jacobian) -> (images (n, y, x), Jacobian (p, n, y, x) or None)."""


@dataclass(frozen=True, eq=False, slots=True)
class FitImages:
    """What is fitted, in electrons: images, masks, variance at zero light, shot-noise
    scale.

    model_error: standard deviation of the model itself, as a share of the light in a
    pixel; added to the noise.
    common_floor: share of ``variance_e2`` that is one error in all frames.
    common_light: relative error of the light of
        a pixel that is one in all frames, not in the variance. Neither weighs; both
        widen intervals.
    count_e: electrons of a count, over ``scale`` apart, where pixels are rounded
    counts; 0 where they are means.
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
        """(2, n, y, x) electrons of one standard deviation of what is one error in all
        frames: by dark, by flat.

        The first is part of the noise of every frame, the second is not.
        """
        return np.stack(
            [
                np.sqrt(self.common_floor * self.variance_e2),
                self.common_light * np.maximum(image, 0),
            ]
        )

    def planes(self, index: Array) -> "FitImages":
        """Some of the frames."""
        return self.arranged(lambda part: part[index])

    def arranged(self, change: Callable[[Array], Array]) -> "FitImages":
        """The same of frames that are laid otherwise, or of some of them."""
        parts = {one.name: getattr(self, one.name) for one in dataclasses.fields(self)}
        moved: dict[str, Any] = {
            name: change(part)
            for name, part in parts.items()
            if isinstance(part, np.ndarray)
        }
        return dataclasses.replace(self, **moved)


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
        return cls(np.array(start, float), wide, -wide, wide)


@dataclass(frozen=True, slots=True)
class SolverSettings:
    """When to stop, and how far an outlier is (sigma).

    secant: between exact Jacobians the last one is brought up to date by the images
    that each step gave (Broyden 1965);
        steps that look final, and those that fail, are checked with an exact one.
    near: sigma that an exact Jacobian still holds for: shorter steps go on with it.
    finish: the Jacobian at the end is exact, or was so within ``near``.
    miss: share of what a step changes by which images may miss their prediction before
    the Jacobian is made anew.
    bounded: steps that a bound or ``ball`` stops are the best ones inside (NLopt), not
    clipped.
    """

    iterations: int = 40
    step_tolerance: float = 0.02
    huber: float = 6.0
    secant: bool = False
    near: float = 0.3
    miss: float = math.inf
    finish: bool = True
    bounded: bool = False
    ball: BallConstraint | None = None


@dataclass(frozen=True, eq=False, slots=True)
class FitSolution:
    """Estimate with covariance.

    value: (p,). covariance: (p, p) inverse of the Fisher information with the priors'.
    information: (p, p) Fisher information of the data alone.
    image, residual_sigma: (n, y, x) model, and (data - model) / sigma, 0 where masked
    or silent.
    chi2_per_dof: reduced chi-square of the pixels within ``huber``, over its
    expectation.
    merit: robust chi-square with priors, to
    compare starts.
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


def fit_levenberg_marquardt(
    model: Model,
    data: FitImages,
    start: Array,
    *,
    prior: GaussianPrior | None = None,
    settings: SolverSettings | None = None,
    slopes: Array | None = None,
) -> FitSolution:
    """Levenberg-Marquardt from one start, with the Jacobian there or with ``slopes``
    (p, n, y, x) from places close by.

    Stops when a full step moves every combination of parameters by less than
    ``step_tolerance`` sigma.

    Raises:
        FitError: the model is not finite at the start, or no pixel is usable.
    """
    settings, prior = settings or SolverSettings(), prior or GaussianPrior.none(start)
    x = np.clip(np.asarray(start, float), prior.low, prior.high)
    if not data.usable.any():
        raise FitError("no usable pixel in the fit window; check masks and crop")
    damping, converged, reason = (
        1e-3,
        False,
        f"stopped after {settings.iterations} iterations",
    )
    state, iteration = _linearise(model, data, x, prior, settings, slopes), 0
    while iteration < settings.iterations:
        iteration += 1
        step, image, damping, accepted = _step(
            model, data, state, prior, settings, damping
        )
        moved = math.sqrt(max(float(step @ state.curvature @ step), 0.0))
        done = not accepted or moved < settings.step_tolerance * (1 + damping)
        fresh = state.travel <= settings.near if accepted else state.travel == 0
        if not fresh and (done or moved < settings.near):
            x = state.x + step if accepted else state.x
            state, damping = _linearise(model, data, x, prior, settings), 1e-3
            continue
        if accepted and not done and _missed(state, step, image) > settings.miss:
            state = _linearise(model, data, state.x + step, prior, settings)
        elif accepted and settings.secant:
            state = _secant(data, state, step, image, prior, settings, moved=moved)
        elif accepted and state.travel + moved <= settings.near:
            state = _state(
                data,
                (state.x + step, image, state.jacobian),
                prior,
                settings,
                travel=state.travel + moved,
            )
        elif accepted:
            state = _linearise(model, data, state.x + step, prior, settings)
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
    """Share of the change by a step, each in sigma of the pixels, that the Jacobian did
    not foresee.
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
    """The problem after a step, with the least change of the Jacobian that explains how
    the images changed.

    J + (dI - J s) sᵀC / (sᵀC s), where C, the curvature, is the natural measure of a
    step. After one of less than
    ``_TELLING`` sigma the Jacobian stays: how images are rounded (float32), over so
    short a way, would be taken for
    slopes, and all that a fit ends in, covariance and a quick model put right by its
    slopes, with it.
    """
    jacobian = state.jacobian
    if moved >= _TELLING:
        measure = state.curvature @ step
        missed = (image - state.image) - np.tensordot(step, jacobian, 1)
        jacobian = jacobian + np.multiply.outer(
            measure / max(float(step @ measure), 1e-300), missed
        )
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
    x, image, jacobian = at
    noise = np.sqrt(data.variance(image))
    residual = _residual(data, image, noise)
    weight = (
        _robust(residual, settings.huber)
        * data.usable
        * ~(data.saturated & (residual == 0))
    )
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
    """A step that lowers the misfit at the weights of ``state``: (step, image there,
    next damping, found).
    """
    before = _merit(data, state.image, state.x, state.noise, prior, settings)
    size = np.sqrt(np.maximum(np.diag(state.curvature), 1e-300))
    scaled = state.curvature / np.outer(size, size)
    blocked = ((state.x <= prior.low) & (state.gradient > 0)) | (
        (state.x >= prior.high) & (state.gradient < 0)
    )
    free = np.flatnonzero(~blocked)
    step, image = np.zeros_like(state.x), state.image
    for _ in range(10 if state.travel == 0 else 2):
        matrix = scaled[np.ix_(free, free)] + damping * np.eye(len(free))
        step = np.zeros_like(state.x)
        step[free] = (
            -np.linalg.lstsq(matrix, state.gradient[free] / size[free], rcond=1e-14)[0]
            / size[free]
        )
        step = _inside(
            state, step, matrix if len(free) == len(step) else None, prior, settings
        )
        image, _ = model(state.x + step, False)
        if np.isfinite(image).all():
            after = _merit(data, image, state.x + step, state.noise, prior, settings)
            if after <= before * (1 + 1e-12):
                return step, image, max(damping / 5, 1e-10), True
        damping *= 6
    return step, image, damping, False


def _inside(
    state: _State,
    step: Array,
    damped: Array | None,
    prior: GaussianPrior,
    settings: SolverSettings,
) -> Array:
    """The step kept inside bounds and ball: clipped, or the best one there."""
    clipped = np.asarray(np.clip(state.x + step, prior.low, prior.high) - state.x)
    held = settings.ball is None or settings.ball.inside(state.x + clipped)
    if not settings.bounded or (held and np.array_equal(clipped, step)):
        return clipped

    size = np.sqrt(np.maximum(np.diag(state.curvature), 1e-300))
    matrix = state.curvature if damped is None else damped * np.outer(size, size)
    found = constrained.constrained_step(
        matrix,
        state.gradient,
        state.x,
        low=prior.low,
        high=prior.high,
        ball=settings.ball,
    )
    if found.any():
        return found
    return (
        clipped
        if held or settings.ball is None
        else settings.ball.share(state.x, clipped) * clipped
    )


def _merit(
    data: FitImages,
    image: Array,
    x: Array,
    noise: Array,
    prior: GaussianPrior,
    settings: SolverSettings,
) -> float:
    size = np.abs(_residual(data, image, noise))
    loss = np.where(
        size <= settings.huber, size**2, settings.huber * (2 * size - settings.huber)
    )
    pull = np.where(np.isfinite(prior.sigma), (x - prior.mean) / prior.sigma, 0.0)
    return float((loss * data.usable).sum() + (pull**2).sum())


def _residual(data: FitImages, image: Array, noise: Array) -> Array:
    """(data - model) / sigma; at saturated pixels only as far as the model falls short."""
    residual = (data.electrons - image) / noise
    return np.where(data.saturated, np.maximum(residual, 0), residual)


def _robust(residual: Array, huber: float) -> Array:
    return np.asarray(np.minimum(1.0, huber / np.maximum(np.abs(residual), huber)))


def _solution(
    data: FitImages,
    state: _State,
    prior: GaussianPrior,
    settings: SolverSettings,
    ended: tuple[bool, str, int],
) -> FitSolution:
    counted = data.usable & ~data.saturated
    shown = state.residual * data.usable
    inlier = counted & (np.abs(state.residual) <= settings.huber)
    dof = max(int(inlier.sum()) * _inlier_variance(settings.huber) - len(state.x), 1.0)
    chi2 = float((state.residual[inlier] ** 2).sum()) / dof
    log_noise = float(2 * np.log(state.noise[counted]).sum())
    merit = _merit(data, state.image, state.x, state.noise, prior, settings) + log_noise
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
