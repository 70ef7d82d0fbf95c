"""What the frames leave open: profiles of every parameter, and draws where a parabola does not hold.

The profile of a parameter is the least misfit over all others as it is moved; where it rises by 3.84 lie the ends of
its 95 % interval (Wilks 1938), however the valley bends. Draws solve the fit anew for perturbed data and prior means
(randomised maximum likelihood: Kitanidis 1995, Oliver et al. 1996): exact where the model is linear, and along a bent
valley as the frames allow. Noise and outlier weights are those at the mode; steps reuse its Jacobian, brought up to
date by what each of them gave (Broyden 1965), so that one costs an image and no derivatives. Where a profile ends, a
descent with those of a mode far away stops too high: they are put together from those of the mode and of other ends,
and computed where the trapezium rule from the mode says that these do not hold.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from characterize.inference.leastsquares import Data, Model, Prior, Settings
from metalens.ground import threads
from metalens.ground.arrays import Array

REACH = 1.959964  # of a 95 % interval, in sigma
BENT = 0.25  # sigma by which images may miss their linear prediction at 2 sigma: moves the ends of an interval by 6 %
PARABOLIC = (0.85, 1.18)  # end of an interval over that of the parabola
DRAWS = 96
_HOLDS = 0.4  # sigma by which slopes put together may miss what the images are from the mode on
_CLOSE, _OVER, _ROUNDS, _CHECKS, _SOLVES = 0.08, 1.0, 5, 4, 5
_HUBER = Settings().huber


@dataclass(frozen=True, eq=False, slots=True)
class Profile:
    """One parameter: 95 % interval, and the rise of -2 ln L at ``value`` (points,) with the rest fitted."""

    low: float
    high: float
    value: Array
    rise: Array
    parabolic: bool


@dataclass(frozen=True, eq=False, slots=True)
class Spot:
    """A place with its residual, and the slopes that are believed there."""

    x: Array
    rest: Array
    slopes: Array

    @property
    def misfit(self) -> float:
        """Sum of squares of the residual."""
        return float(self.rest @ self.rest)


class Valley:
    """The misfit about a mode: -2 ln posterior less a constant, with the noise held.

    known: image and Jacobian at the mode, where they have been computed.
    above: of a place that is no mode, the mode (p,) and the rise of -2 ln L from there.
    met: ways from the mode to where slopes were computed, and how they change on them; a copy goes on with its own.
    """

    def __init__(
        self,
        model: Model,
        data: Data,
        mode: Array,
        prior: Prior,
        *,
        known: tuple[Array, Array] | None = None,
        above: tuple[Array, float] | None = None,
    ) -> None:
        image, jacobian = model(mode, True) if known is None else known
        noise = np.sqrt(data.variance(image))
        self._model, self._data, self.prior, self.mode = model, data, prior, np.array(mode, float)
        self.above: tuple[Array, float] = above or (self.mode, 0.0)
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
        self.covariance = (vectors / np.maximum(values, 1e-13)) @ vectors.T / np.outer(size, size)
        self._sigmas = (vectors * np.sqrt(np.maximum(values, 0))).T * size
        self.met: tuple[tuple[Array, Array], ...] = ()
        self._beside: dict[int, list[Spot] | None] = {}

    @property
    def sigma(self) -> Array:
        """(p,) of the parabola."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def calibration(self) -> Array:
        """(p, p) covariance by what all frames have in common beyond the noise of each: errors of dark and flat.

        C AᵀW S W A C with S the covariance of the pixels by them, less what of it is in the noise already.
        """
        p = len(self.mode)
        slopes = self.slopes[:-p].reshape(*self._image.shape, p)
        dark, light = self._data.shared(self._image) * self._root.reshape(self._image.shape)
        flat, floor = ((slopes * c[..., None]).sum(0).reshape(-1, p) for c in (light, dark))
        counted = (slopes * dark[..., None]).reshape(-1, p)
        spread = flat.T @ flat + floor.T @ floor - counted.T @ counted
        return np.asarray(self.covariance @ spread @ self.covariance)

    def rise(self, spot: Spot) -> float:
        """Of -2 ln L from the mode to a spot."""
        return spot.misfit - self.least + self.above[1]

    def along(self, i: int) -> Array:
        """(p,) how all parameters go when one is moved by one sigma and the rest are fitted, by the parabola."""
        return np.asarray(self.covariance[:, i] / self.sigma[i])

    def residual(self, x: Array, image: Array | None = None) -> Array:
        """(pixels + p,) of which the sum of squares is the misfit."""
        image = self._model(x, False)[0] if image is None else image
        return np.concatenate([self._pixels(image), (x - self.prior.mean) * self._pull])

    def inside(self, x: Array) -> Array:
        """Within the bounds."""
        return np.asarray(np.clip(x, self.prior.low, self.prior.high))

    def bend(self, i: int, held: int | None = None) -> float:
        """Sigma by which images 2 sigma to either side miss the parabola's prediction; inf with a bound between.

        held: a parameter that stays where it is, the sigma being what is left then.
        """
        if held is None:
            ends = self.beside(i)
        else:
            left = self.covariance[:, i] - self.covariance[:, held] * (
                self.covariance[i, held] / self.covariance[held, held]
            )
            ends = self._both_ways(left / math.sqrt(max(float(left[i]), 1e-300)))
        if ends is None:
            return math.inf
        return float(np.linalg.norm((ends[0].rest + ends[1].rest) / 2 - self.bottom))

    def beside(self, i: int) -> list[Spot] | None:
        """Where the parabola goes 2 sigma up and down one parameter; None with a bound between."""
        if i not in self._beside:
            self._beside[i] = self._both_ways(self.along(i))
        return self._beside[i]

    def _both_ways(self, way: Array) -> list[Spot] | None:
        places = [self.mode + sign * 2 * way for sign in (1, -1)]
        if any((self.inside(x) != x).any() for x in places):
            return None
        return [Spot(x, self.residual(x), self.slopes) for x in places]

    def descend(
        self,
        x: Array,
        *,
        held: int | None = None,
        shift: Array | float = 0.0,
        rounds: int = _SOLVES,
        least: float = 0.02,
        slopes: Array | None = None,
    ) -> tuple[Array, float]:
        """The least misfit from ``x`` on, one parameter ``held``: (place, misfit). ``shift``: added to the residual.

        slopes: those to begin with, of :meth:`slopes_at`, where those of the mode do not hold.
        """
        begin = Spot(x, self.residual(x) + shift, self.slopes if slopes is None else slopes)
        found = self.lowered(begin, held=held, shift=shift, rounds=rounds, least=least)
        return found.x, found.misfit

    def lowered(
        self,
        begin: Spot,
        *,
        held: int | None = None,
        shift: Array | float = 0.0,
        rounds: int = _SOLVES,
        least: float = 0.02,
    ) -> Spot:
        """The least misfit from a spot on, its slopes brought up to date; see :meth:`descend`."""
        x, rest, slopes, value, damping = begin.x, begin.rest, begin.slopes, begin.misfit, 1e-6
        free = np.array([j for j in range(len(x)) if j != held])
        for _ in range(rounds):
            part = slopes[:, free]
            curvature, gradient = part.T @ part, part.T @ rest
            size = np.diag(np.diag(curvature)) * damping
            step = np.zeros(len(x))
            step[free] = -np.linalg.lstsq(curvature + size, gradient, rcond=1e-14)[0]
            there = self.inside(x + step)
            step = there - x
            expected = -float(step[free] @ (2 * gradient + curvature @ step[free]))
            if expected < least:
                break
            after = self.residual(there) + shift
            lower = float(after @ after)
            measure = slopes.T @ (slopes @ step)
            along = float(step @ measure)
            if along > 0:
                slopes = slopes + np.multiply.outer(after - rest - slopes @ step, measure / along)
            if lower < value:
                x, rest, value = there, after, lower
            else:
                damping = max(damping * 30, 1e-2)
        return Spot(x, rest, slopes)

    def slopes_at(self, x: Array, rest: Array | None = None) -> Array:
        """(pixels + p, p) derivatives of :meth:`residual`: by how they change towards places met before, or computed.

        Along each of those as far as ``x`` lies that way. They hold where half their sum with those of the mode gives
        the residual at ``x`` (``rest``, where it is known) to ``_HOLDS`` sigma (trapezium rule).
        """
        slopes, way = self.slopes, x - self.mode
        for place, change in self.met:
            along, reach = self._sigmas @ place, self._sigmas @ way
            share = float(np.clip(along @ reach / max(float(along @ along), 1e-300), 0.0, 1.5))
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


def profile(valley: Valley, i: int, *, level: float = REACH**2) -> tuple[Profile, Array | None]:
    """The profile of one parameter out to a rise of ``level``; second: a place below the mode, if one was met."""
    goal, mode, sigma = math.sqrt(level), valley.mode, float(valley.sigma[i])
    points, better, ends = [(float(mode[i]), 0.0)], None, []
    straight = valley.bend(i) < BENT
    for sign in (-1, 1):
        place = float(valley.inside(mode + sign * goal * sigma)[i])
        if not straight:
            found = end(valley, i, sign, goal)
            place, better = found.place, found.lower if better is None else better
            points += found.seen
        ends.append(place)
    if straight:
        points += [(float(mode[i] + s * sigma), s * s) for s in (-2.5, -1.96, -1.0, 1.0, 1.96, 2.5)]
    points.sort()
    ratio = [(ends[1] - mode[i]) / (goal * sigma), (mode[i] - ends[0]) / (goal * sigma)]
    plain = straight or all(PARABOLIC[0] < r < PARABOLIC[1] for r in ratio)
    value, rise = np.array(points).T
    return Profile(ends[0], ends[1], value, rise, plain), better


@dataclass(frozen=True, eq=False, slots=True)
class End:
    """Of a profile: place, points met (value, rise), a place below the mode if one was met, whether it was reached."""

    place: float
    seen: list[tuple[float, float]]
    lower: Array | None = None
    reached: bool = True


def end(valley: Valley, i: int, sign: int, goal: float, begin: Array | None = None) -> End:
    """Where the profile crosses ``goal`` squared on one side; from (p,) ``begin``, or where the parabola goes."""
    lowest, bound = float(valley.above[0][i]), valley.prior.low[i] if sign < 0 else valley.prior.high[i]
    beside = valley.beside(i) if begin is None else None
    begin = valley.mode + sign * goal * valley.along(i) if begin is None else begin
    here = beside[0 if sign > 0 else 1] if beside else _spot(valley, begin)
    held = False  # the slopes are those that hold here
    seen: list[tuple[float, float]] = []
    for turn in range(_ROUNDS + _CHECKS):
        before, here = here, valley.lowered(here, held=i)
        found, x, rise = here, here.x, valley.rise(here)
        held = held and float(np.linalg.norm(here.rest - before.rest)) < _OVER
        seen.append((float(x[i]), max(rise, 0.0)))
        if rise < -0.5:
            return End(float(x[i]), seen, x)
        root = math.sqrt(max(rise, 1e-6))
        done = abs(root - goal) < _CLOSE or (x[i] == bound and root < goal)
        if held and done:
            break
        if not held and (done or root > goal + _OVER / 2 or turn == _ROUNDS - 1):  # again, with slopes that hold there
            here, seen, held = Spot(x, here.rest, valley.slopes_at(x, here.rest)), [], True
        else:
            held = held and abs(root - goal) < _OVER / 2
            here = _spot(valley, x + _onwards(here, i, float(x[i] - lowest), (root, goal)), here.slopes)
    gone = float(found.x[i]) - lowest  # 0 where the mode is on the bound
    more = np.clip(_onwards(found, i, gone, (root, goal))[i] / gone, -0.2, 0.25) if gone else 0.0
    place = lowest + gone * (1 + float(more))
    place = float(np.clip(place, valley.prior.low[i], valley.prior.high[i]))
    return End(place, seen or [(float(found.x[i]), max(rise, 0.0))], reached=done or abs(root - goal) < _OVER / 2)


def _spot(valley: Valley, x: Array, slopes: Array | None = None) -> Spot:
    """Inside the bounds."""
    x = valley.inside(x)
    return Spot(x, valley.residual(x), valley.slopes if slopes is None else slopes)


def _onwards(here: Spot, i: int, gone: float, roots: tuple[float, float]) -> Array:
    """(p,) step along the profile's tangent, from where the root of the rise is the first to where it is the second.

    By Newton's rule, or in proportion to the way ``gone`` where the root falls outwards; between 0.35 and 2 times that
    way in all.
    """
    root, goal = roots
    free = np.array([j for j in range(len(here.x)) if j != i])
    part = here.slopes[:, free]
    way = np.zeros(len(here.x))
    way[i] = 1.0
    way[free] = -np.linalg.lstsq(part.T @ part, part.T @ here.slopes[:, i], rcond=1e-14)[0]
    slope = float(here.rest @ (here.slopes @ way)) / root
    share = 1 + (goal - root) / (slope * gone) if slope * gone > 0.2 * root else goal / root
    return np.asarray(way * gone * (float(np.clip(share, 0.35, 2.0)) - 1))


def draws(valleys: Sequence[Valley], count: int = DRAWS, *, seed: int = 0) -> Array:
    """(count, p) draws of the posterior around its modes, each mode as often as its share of the probability."""
    rng = np.random.default_rng(seed)
    chosen = [valleys[k] for k in rng.choice(len(valleys), count, p=shares(valleys))]

    def one(of: tuple[Valley, Array]) -> Array:
        valley, shift = of
        start = valley.inside(valley.mode - valley.covariance @ (valley.slopes.T @ shift))
        return valley.descend(start, shift=shift, rounds=4, least=0.1)[0]

    return np.array(threads.each(one, [(valley, rng.standard_normal(len(valley.bottom))) for valley in chosen]))


def shares(valleys: Sequence[Valley]) -> Array:
    """(k,) probability of every mode by Laplace's rule: exp(-misfit / 2) times the volume of its parabola."""
    half = [-v.least / 2 + half_volume(v) for v in valleys]
    weight = np.exp(np.array(half) - max(half))
    return np.asarray(weight / weight.sum())


def half_volume(valley: Valley) -> float:
    """Half the log determinant of a parabola's covariance."""
    unit = valley.covariance / np.outer(valley.sigma, valley.sigma)
    return float(np.linalg.slogdet(unit)[1] / 2 + np.log(valley.sigma).sum())
