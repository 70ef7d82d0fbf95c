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
_LEAST_UPDATE = 0.03
# relative error of the predicted change of the images above which the Jacobian is
# computed anew
_RENEWED_ABOVE = 0.6
REACH = 1.959964  # sigma of a 95 % interval
HUBER = 6.0  # sigma beyond which a residual counts linearly
_JACOBI = special.roots_jacobi(4, 1.0, 0.0)  # of (1 - s) f(s) over s from -1 to 1
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
    """

    electrons: Array
    usable: Array
    saturated: Array
    variance_e2: Array
    scale: Array
    model_error: float = 0.0
    common_floor: float | Array = 0.0
    common_light: float = 0.0

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
            weight / self.variance(image + (1 + node) / 2 * off)
            for node, weight in zip(*_JACOBI, strict=True)
        )
        return np.asarray(off**2 / 2 * integral)

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

    near: length of steps, sigma, over which an exact Jacobian is trusted: it is updated
    by the images of each step (Broyden 1965), and steps that look final, and those that
    fail, are checked with an exact one beyond.
    finish: the Jacobian at the end is exact, or was so within ``near``.
    """

    iterations: int = 40
    step_tolerance: float = 0.02
    near: float = 0.3
    finish: bool = True

    @classmethod
    def short(cls, iterations: int, step_tolerance: float) -> "SolverSettings":
        """Of a fit whose Jacobian is exact at its start alone."""
        return cls(iterations, step_tolerance, near=math.inf, finish=False)


@dataclass(frozen=True, eq=False, slots=True)
class FitSolution:
    """Estimate with covariance.

    value: (p,). covariance: (p, p) inverse of the Fisher information with the priors'.
    information: (p, p) Fisher information of the data alone.
    image, residual_sigma: (n, y, x) model, and (data - model) / sigma, 0 where masked
    or silent.
    chi2_per_dof: reduced chi-square of the pixels within ``HUBER`` sigma.
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
    beyond: Array
    slopes: Array


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


@dataclass(frozen=True, eq=False, slots=True)
class FitProblem:
    """Images by parameters, the frames they are fitted to, and prior knowledge."""

    model: Model
    data: FitImages
    prior: GaussianPrior

    def merit(self, x: Array) -> float:
        """-2 ln posterior at (p,) parameters ``x``, but for a constant."""
        return self._merit(self.model(x, False)[0], x)

    def with_fixed(self, i: int, value: float) -> "FitProblem":
        """The same with parameter number ``i`` fixed at ``value``."""
        low, high = self.prior.low.copy(), self.prior.high.copy()
        low[i] = high[i] = value
        prior = dataclasses.replace(self.prior, low=low, high=high)
        return dataclasses.replace(self, prior=prior)

    def fit(
        self,
        start: Array,
        settings: SolverSettings | None = None,
        slopes: Array | None = None,
    ) -> FitSolution:
        """Maximum posterior of the parameters by Levenberg-Marquardt from one start.

        Steps solve (C + damping diag C) s = -g with curvature C and gradient g of the
        weighted residuals and the prior. The fit stops when a full step moves every
        combination of parameters by less than ``step_tolerance`` sigma.

        Args:
            start: (p,) parameters.
            settings: when to stop.
            slopes: (p, n, y, x) Jacobian of a place close by, to begin with; computed
                without it.

        Raises:
            FitError: the model is not finite at the start, or no pixel is usable.
        """
        settings = settings or SolverSettings()
        near = settings.near
        if not self.data.usable.any():
            raise FitError("no usable pixel in the fit window; check masks and crop")
        x = np.clip(np.asarray(start, float), self.prior.low, self.prior.high)
        state = self._linearise(x, slopes)
        damping = 1e-3
        converged = False
        reason = f"stopped after {settings.iterations} iterations"
        for _ in range(settings.iterations):
            step, image, damping, accepted = self._step(state, damping)
            x = state.x + step if accepted else state.x
            moved = math.sqrt(max(float(step @ state.curvature @ step), 0.0))
            done = not accepted or moved < settings.step_tolerance * (1 + damping)
            # the Jacobian is exact, or was computed close enough
            fresh = state.travel <= near if accepted else state.travel == 0
            if not fresh and (done or moved < near):
                # what looks final is checked with an exact Jacobian
                state = self._linearise(x)
                damping = 1e-3
                continue
            if accepted:
                state = self._advance(state, step, image, final=done)
            if done:
                converged = moved < 10 * settings.step_tolerance
                reason = (
                    f"last step moved {moved:.2g} sigma"
                    if converged
                    else "no step lowers the misfit"
                )
                break
        if settings.finish and state.travel > near:
            state = self._linearise(state.x)
        return self._solution(state, converged, reason)

    def _linearise(self, x: Array, slopes: Array | None = None) -> _State:
        """The problem at (p,) ``x``, with an exact Jacobian or with ``slopes``.

        Raises:
            FitError: the images are not finite.
        """
        image, jacobian = self.model(x, slopes is None)
        jacobian = jacobian if slopes is None else slopes
        if jacobian is None or not np.isfinite(image).all():
            raise FitError(
                "the model is not finite at these parameters; bound them or correct the start"
            )
        travel = 0.0 if slopes is None else math.inf
        return self._state(x, image, jacobian, travel)

    def _advance(
        self, state: _State, step: Array, image: Array, *, final: bool
    ) -> _State:
        """The problem after a step, with the Jacobian updated by the images (Broyden),
        or computed anew where it missed ``_RENEWED_ABOVE`` of their change.

        J + (dI - J s) sᵀC / (sᵀC s), with the curvature C as the metric: the least
        change that explains dI. After a step of less than ``_LEAST_UPDATE`` sigma the
        Jacobian stays: rounding of the images (float32) over so short a step would be
        mistaken for slopes. Covariance and corrected fast models depend on these.
        """
        x = state.x + step
        jacobian = state.jacobian
        change = image - state.image
        missed = change - np.tensordot(step, jacobian, 1)
        root = np.sqrt(state.weight) / state.noise
        size = max(float(np.linalg.norm(change * root)), 1e-300)
        if not final and float(np.linalg.norm(missed * root)) > _RENEWED_ABOVE * size:
            return self._linearise(x)
        measure = state.curvature @ step
        square = max(float(step @ measure), 1e-300)
        moved = math.sqrt(square)
        if moved >= _LEAST_UPDATE:
            jacobian = jacobian + np.multiply.outer(measure / square, missed)
        return self._state(x, image, jacobian, state.travel + moved)

    def _state(self, x: Array, image: Array, jacobian: Array, travel: float) -> _State:
        """Gradient, curvature and weights of the problem at a point.

        Args:
            travel: sigma from the point where the Jacobian was computed.
        """
        prior = self.prior
        noise, residual, weight = pixel_weights(self.data, image)
        root = np.sqrt(weight)
        scaled = jacobian.reshape(len(x), -1) * (root / noise).ravel()
        information = scaled @ scaled.T
        pull = np.where(
            np.isfinite(prior.sigma), (x - prior.mean) / prior.sigma**2, 0.0
        )
        return _State(
            x,
            image,
            jacobian,
            travel,
            residual,
            weight,
            -scaled @ (root * residual).ravel() + pull,
            information + np.diag(prior.sigma**-2.0),
            information,
            noise,
        )

    def _step(self, state: _State, damping: float) -> tuple[Array, Array, float, bool]:
        """A step that lowers the misfit: (step, image there, next damping, accepted).

        Damping grows by 6 until -2 ln posterior does not rise; parameters blocked by a
        bound stay. Two attempts with an approximate Jacobian, ten with an exact one.
        """
        x, low, high = state.x, self.prior.low, self.prior.high
        limit = self._merit(state.image, x) * (1 + 1e-12)
        size = np.sqrt(np.maximum(np.diag(state.curvature), 1e-300))
        scaled = state.curvature / np.outer(size, size)
        # at a bound, with the gradient beyond it
        blocked = ((x <= low) & (state.gradient > 0)) | (
            (x >= high) & (state.gradient < 0)
        )
        free = np.flatnonzero(~blocked)
        gradient = state.gradient[free] / size[free]
        step, image = np.zeros_like(x), state.image
        for _ in range(10 if state.travel == 0 else 2):
            matrix = scaled[np.ix_(free, free)] + damping * np.eye(len(free))
            step = np.zeros_like(x)
            step[free] = -np.linalg.lstsq(matrix, gradient, rcond=1e-14)[0] / size[free]
            step = np.clip(x + step, low, high) - x
            image, _ = self.model(x + step, False)
            finite = bool(np.isfinite(image).all())
            if finite and self._merit(image, x + step) <= limit:
                return step, image, max(damping / 5, 1e-10), True
            damping *= 6
        return step, image, damping, False

    def _merit(self, image: Array, x: Array) -> float:
        """Deviance, linear beyond ``HUBER`` sigma, and the squared pull of the prior."""
        prior = self.prior
        size = np.sqrt(self.data.deviance(image))
        loss = np.where(size <= HUBER, size**2, HUBER * (2 * size - HUBER))
        pull = np.where(np.isfinite(prior.sigma), (x - prior.mean) / prior.sigma, 0.0)
        return float(loss.sum() + (pull**2).sum())

    def _solution(self, state: _State, converged: bool, reason: str) -> FitSolution:
        """The solution at the end of a fit: covariance, reduced chi-square."""
        counted = self.data.usable & ~self.data.saturated
        inlier = counted & (np.abs(state.residual) <= HUBER)
        dof = max(int(inlier.sum()) - len(state.x), 1)
        covariance = invert_information(state.curvature)
        return FitSolution(
            state.x,
            covariance,
            state.information,
            state.image,
            state.residual * self.data.usable,
            float((state.residual[inlier] ** 2).sum()) / dof,
            self._merit(state.image, state.x),
            converged,
            reason,
            beyond=-covariance @ state.gradient / np.sqrt(np.diag(covariance)),
            slopes=state.jacobian,
        )


def pixel_weights(data: FitImages, image: Array) -> tuple[Array, Array, Array]:
    """Noise, residual over the noise, and robust weight of every pixel, (n, y, x) each.

    Args:
        data: what is fitted.
        image: (n, y, x) model.

    Returns:
        (noise in electrons, (data - model) / noise with saturated pixels only as far as
        the model falls short, weight from 0 to 1).
    """
    noise = np.sqrt(data.variance(image))
    residual = (data.electrons - image) / noise
    residual = np.where(data.saturated, np.maximum(residual, 0), residual)
    size = np.sqrt(data.deviance(image))
    weight = np.minimum(1.0, HUBER / np.maximum(size, HUBER))
    silent = ~data.usable | (data.saturated & (residual == 0))
    return noise, residual, np.where(silent, 0.0, weight)


def shared_error_scatter(changes: Array, shared: Array) -> Array:
    """(k, k) scatter of sums over all pixels of ``changes`` times errors that all
    frames share, less what the noise of the single frames already contains of it.

    Args:
        changes: (k, n, y, x) over the noise.
        shared: (2, n, y, x) errors of dark and of flat (:meth:`FitImages.shared`), over
            the noise.
    """
    dark, flat = (
        (changes * error).sum(1).reshape(len(changes), -1) for error in shared
    )
    counted = (changes * shared[0]).reshape(len(changes), -1)
    return np.asarray(dark @ dark.T + flat @ flat.T - counted @ counted.T)


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
