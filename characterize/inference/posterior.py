"""What the frames leave open about a mode: the misfit as a function, and draws where a
parabola does not hold.

Draws solve the fit anew for perturbed data and prior means (randomised maximum
likelihood: Kitanidis 1995, Oliver et
al. 1996): exact where the model is linear, and along a bent valley as the frames allow.
Noise and outlier weights are
those at the mode; steps reuse its Jacobian, brought up to date by what each of them
gave (Broyden 1965), so that one
costs an image and no derivatives. Far from the mode slopes are put together from those
of the mode and of other places
(:mod:`ends`), and computed where the trapezium rule from the mode says that these do
not hold.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from characterize.inference import constrained
from characterize.inference.leastsquares import (
    FitImages,
    GaussianPrior,
    Model,
    SolverSettings,
)
from metalens.core import threads
from metalens.core.arrays import Array

REACH = 1.959964  # of a 95 % interval, in sigma
PARABOLIC = (0.85, 1.18)  # end of an interval over that of the parabola
DRAWS = 96
# sigma by which slopes put together may miss what the images are from the mode on
_HOLDS = 0.4
_SOLVES = 5
# sigma of a step from which on images tell slopes: rounding by 0.002 makes these 2 %
# longer
_TELLING = 0.01
_HUBER = SolverSettings().huber


@dataclass(frozen=True, eq=False, slots=True)
class ResidualPoint:
    """A place with its residual, and the slopes that are believed there."""

    x: Array
    rest: Array
    slopes: Array

    @property
    def misfit(self) -> float:
        """Sum of squares of the residual."""
        return float(self.rest @ self.rest)


class LocalMode:
    """The misfit about a mode: -2 ln posterior less a constant, with the noise held.

    known: image and Jacobian at the mode, where they have been computed.
    above: rise of -2 ln L from the best mode to this one, or to a place that is no
    mode.
    met: ways from the mode to where slopes were computed, and how they change on them;
    a copy goes on with its own.
    """

    def __init__(
        self,
        model: Model,
        data: FitImages,
        mode: Array,
        prior: GaussianPrior,
        *,
        known: tuple[Array, Array] | None = None,
        above: float = 0.0,
    ) -> None:
        image, jacobian = model(mode, True) if known is None else known
        noise = np.sqrt(data.variance(image))
        self._model, self._data, self.prior, self.mode, self.above = (
            model,
            data,
            prior,
            np.array(mode, float),
            above,
        )
        self._root = np.where(data.usable, 1 / noise, 0.0).ravel()
        first = np.abs(self._pixels(image))
        self._root *= np.sqrt(np.minimum(1, _HUBER / np.maximum(first, _HUBER)))
        self._image = image
        self._pull = np.where(np.isfinite(prior.sigma), 1 / prior.sigma, 0.0)
        self.slopes = self._columns(image, np.asarray(jacobian))
        self.bottom = self.residual(self.mode, image)
        self.least = float(self.bottom @ self.bottom)
        curvature = self.slopes.T @ self.slopes
        size = np.sqrt(np.maximum(np.diag(curvature), 1e-300))
        values, vectors = np.linalg.eigh(curvature / np.outer(size, size))
        self.covariance = (
            (vectors / np.maximum(values, 1e-13)) @ vectors.T / np.outer(size, size)
        )
        self._sigmas = (vectors * np.sqrt(np.maximum(values, 0))).T * size
        self.met: tuple[tuple[Array, Array], ...] = ()

    @property
    def sigma(self) -> Array:
        """(p,) of the parabola."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def calibration(self) -> Array:
        """(p, p) covariance by what all frames have in common beyond the noise of each:
        errors of dark and flat.

        C AᵀW S W A C with S the covariance of the pixels by them, less what of it is in
        the noise already.
        """
        p = len(self.mode)
        slopes = self.slopes[:-p].reshape(*self._image.shape, p)
        dark, light = self._data.shared(self._image) * self._root.reshape(
            self._image.shape
        )
        flat, floor = (
            (slopes * c[..., None]).sum(0).reshape(-1, p) for c in (light, dark)
        )
        counted = (slopes * dark[..., None]).reshape(-1, p)
        spread = flat.T @ flat + floor.T @ floor - counted.T @ counted
        return np.asarray(self.covariance @ spread @ self.covariance)

    def along(self, i: int) -> Array:
        """(p,) how all parameters go when one is moved by one sigma and the rest are
        fitted, by the parabola.
        """
        return np.asarray(self.covariance[:, i] / self.sigma[i])

    def residual(self, x: Array, image: Array | None = None) -> Array:
        """(pixels + p,) of which the sum of squares is the misfit."""
        image = self._model(x, False)[0] if image is None else image
        return np.concatenate([self._pixels(image), (x - self.prior.mean) * self._pull])

    def inside(self, x: Array) -> Array:
        """Within the bounds."""
        return np.asarray(np.clip(x, self.prior.low, self.prior.high))

    def bend(self, i: int) -> float:
        """Sigma by which images 2 sigma to either side miss the parabola's prediction;
        inf with a bound between.
        """
        places = [self.mode + sign * 2 * self.along(i) for sign in (1, -1)]
        if any((self.inside(x) != x).any() for x in places):
            return math.inf
        up, down = (self.residual(x) for x in places)
        return float(np.linalg.norm((up + down) / 2 - self.bottom))

    def descend(
        self,
        begin: Array,
        *,
        shift: Array | float = 0.0,
        rounds: int = _SOLVES,
        least: float = 0.02,
    ) -> tuple[Array, float]:
        """The least misfit from a place on: (place, misfit), slopes brought up to date.
        ``shift``: of the residual.
        """
        x, rest, slopes, damping = (
            begin,
            self.residual(begin) + shift,
            self.slopes,
            1e-6,
        )
        value = float(rest @ rest)
        for _ in range(rounds):
            curvature, gradient = slopes.T @ slopes, slopes.T @ rest
            curved = curvature + np.diag(np.diag(curvature)) * damping
            there = x - np.linalg.lstsq(curved, gradient, rcond=1e-14)[0]
            if (self.inside(there) != there).any():
                there = self.inside(
                    x
                    + constrained.bounded_quadratic_step(
                        curved, gradient, self.prior.low - x, self.prior.high - x
                    )
                )
            step = there - x
            if -float(step @ (2 * gradient + curvature @ step)) < least:
                break
            after = self.residual(there) + shift
            lower = float(after @ after)
            slopes = broyden_update(slopes, step, after - rest - slopes @ step)
            if lower < value:
                x, rest, value = there, after, lower
            else:
                damping = max(damping * 30, 1e-2)
        return x, value

    def slopes_at(self, x: Array, rest: Array | None = None) -> Array:
        """(pixels + p, p) derivatives of :meth:`residual`: by how they change towards
        places met before, or computed.

        Along each of those as far as ``x`` lies that way. They hold where half their
        sum with those of the mode gives
        the residual at ``x`` (``rest``, where it is known) to ``_HOLDS`` sigma
        (trapezium rule).
        """
        slopes, way = self.slopes, x - self.mode
        for place, change in self.met:
            along, reach = self._sigmas @ place, self._sigmas @ way
            share = float(
                np.clip(along @ reach / max(float(along @ along), 1e-300), 0.0, 1.5)
            )
            slopes, way = slopes + share * change, way - share * place
        step = x - self.mode
        rest = self.residual(x) if rest is None else rest
        missed = rest - self.bottom - (self.slopes + slopes) @ (step / 2)
        if float(np.linalg.norm(missed)) < _HOLDS:
            return slopes
        image, jacobian = self._model(x, True)
        exact = self._columns(image, np.asarray(jacobian))
        self.met += ((way, exact - slopes),)
        return exact

    def _columns(self, image: Array, jacobian: Array) -> Array:
        silent = (self._data.saturated & (image >= self._data.electrons)).ravel()
        columns = (jacobian.reshape(len(jacobian), -1) * (self._root * ~silent)).T
        return np.concatenate([columns, np.diag(self._pull)])

    def _pixels(self, image: Array) -> Array:
        rest = image - self._data.electrons
        rest = np.where(self._data.saturated, np.minimum(rest, 0), rest)
        return np.asarray(rest.ravel() * self._root)


def draw_posterior(
    valleys: Sequence[LocalMode], count: int = DRAWS, *, seed: int = 0
) -> Array:
    """(count, p) draws of the posterior around its modes, each mode as often as its
    share of the probability.
    """
    rng = np.random.default_rng(seed)
    chosen = [
        valleys[k]
        for k in rng.choice(len(valleys), count, p=mode_probabilities(valleys))
    ]

    def one(of: tuple[LocalMode, Array]) -> Array:
        valley, shift = of
        start = valley.inside(
            valley.mode - valley.covariance @ (valley.slopes.T @ shift)
        )
        return valley.descend(start, shift=shift, rounds=4, least=0.1)[0]

    return np.array(
        threads.run_each(
            one,
            [(valley, rng.standard_normal(len(valley.bottom))) for valley in chosen],
        )
    )


def mode_probabilities(valleys: Sequence[LocalMode]) -> Array:
    """(k,) probability of every mode by Laplace's rule, see :func:`log_evidence`."""
    log = np.array([log_evidence(valley) for valley in valleys])
    weight = np.exp(log - log.max())
    return np.asarray(weight / weight.sum())


def log_evidence(valley: LocalMode) -> float:
    """ln of a mode's evidence over that of the best, but for a constant (Laplace).

    -rise / 2 + ln det(C) / 2 with the rise of -2 ln posterior, which holds the
    normalisation of the noise at each mode, and the covariance C of its parabola.
    """
    unit = valley.covariance / np.outer(valley.sigma, valley.sigma)
    volume = float(np.linalg.slogdet(unit)[1] / 2 + np.log(valley.sigma).sum())
    return volume - valley.above / 2


def broyden_update(slopes: Array, step: Array, missed: Array) -> Array:
    """(n, p) slopes with the least change that explains by what the residual (n,)
    missed theirs (Broyden 1965).

    After a step of less than ``_TELLING`` sigma of the images they stay: what it missed
    is rounding.
    """
    measure = slopes.T @ (slopes @ step)
    along = float(step @ measure)
    return (
        slopes + np.multiply.outer(missed, measure / along)
        if along >= _TELLING**2
        else slopes
    )
