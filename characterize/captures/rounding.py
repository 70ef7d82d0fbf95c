"""Counts that are coarser than their noise: what a rounded count says of the light, in
closed form.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from metalens.core.arrays import Array

_SMOOTH = 1.0  # counts of noise from which on rounding is a variance of 1/12 to 1e-8
_REACH = 9.0  # sigma to the farthest count that is summed
_LEAST = 1e-6  # information of a count on its light, counts⁻²: less says nothing
_NEAR, _LEVELS = (
    3,
    61,
)  # counts about the middle that are no hot pixel; levels of a pixel that are summed
_USUAL = (
    0.15,
    0.1,
)  # counts of noise and of the scatter of pixels' levels where frames do not tell


def quantization_score(off: Array, noise: Array) -> tuple[Array, Array]:
    """What a count says of the light under it: (score, expected information), counts⁻¹
    and counts⁻².

    d ln P / dm at the count, and the sum of (dP/dm)² / P over all counts there could
    be.

    Args:
        off: count less expected light, in counts. noise: standard deviation before
            rounding, in counts, above 0.
    """
    off, noise = np.broadcast_arrays(np.asarray(off, float), np.asarray(noise, float))
    score = np.asarray(off / (noise**2 + 1 / 12))
    information = np.asarray(1 / (noise**2 + 1 / 12))
    some = noise < _SMOOTH
    if some.any():
        x, s = off[some], noise[some]
        score[some] = _score(x, s)[0]
        known, nearest = np.zeros_like(x), x - np.rint(x)
        for other in range(
            -math.ceil(_REACH * s.max()) - 1, math.ceil(_REACH * s.max()) + 2
        ):
            slope, log_chance = _score(nearest + other, s)
            known += slope**2 * np.exp(log_chance)
        information[some] = np.maximum(known, _LEAST)
    return score, information


def _score(off: Array, noise: Array) -> tuple[Array, Array]:
    """d ln P / dm and ln P of counts that stand ``off`` from the light."""
    far = np.abs(off)
    near, beyond = (
        (far - 0.5) / noise,
        (far + 0.5) / noise,
    )  # sigma to both edges of the count
    log_near = special.log_ndtr(-near)
    log_beyond = special.log_ndtr(-beyond)
    log_chance = log_near + np.log1p(-np.exp(log_beyond - log_near))
    log_edge = -(near**2) / 2 - math.log(2 * math.pi) / 2
    edges = np.exp(log_edge - log_chance) * -np.expm1(-far / noise**2)
    return np.sign(off) * edges / noise, log_chance


@dataclass(frozen=True, eq=False, slots=True)
class DarkStatistics:
    """Mean and variance of repeated dark frames, in counts.

    level: (y, x) of every pixel before rounding. error: (y, x) standard deviation of
    it, one in all frames.
    noise: standard deviation of a pixel from frame to frame before rounding.
    """

    level: Array
    error: Array
    noise: float

    @classmethod
    def of(cls, frames: Array) -> "DarkStatistics":
        """Of (n, y, x) counts whose noise is below one, by the likelihood of all
        pixels' counts together.

        Pixels' levels scatter about a common one. Frames of one or two values tell only
        how noise, scatter and distance
        to the edge of a count compare, so ``_USUAL`` noise and scatter, each to a
        factor of two, are taken as known.
        Pixels farther off than ``_NEAR`` counts are hot: as they read.
        """
        counts = np.asarray(frames, float)
        middle = float(np.rint(np.median(counts)))
        values = np.arange(-_NEAR, _NEAR + 1)
        often = np.stack([(counts == middle + v).sum(0) for v in values], -1).reshape(
            -1, len(values)
        )
        near = often.sum(1) == len(counts)
        kinds, kind, many = np.unique(
            often[near], axis=0, return_inverse=True, return_counts=True
        )
        start = float((counts.mean(0).ravel()[near] - middle).mean())
        usual = np.array([start, math.log(_USUAL[0]), math.log(_USUAL[1])])

        def unlikely(x: Array) -> float:
            away = (x[1:] - usual[1:]) / math.log(2)
            return float(away @ away) / 2 - float(
                many @ special.logsumexp(_levels(x, kinds, values)[1], axis=1)
            )

        found = optimize.minimize(
            unlikely,
            usual,
            method="Nelder-Mead",
            options={"xatol": 1e-3, "fatol": 1e-3},
        )
        place, weight = _levels(found.x, kinds, values)
        share = special.softmax(weight, axis=1)
        mean = share @ place
        spread = np.sqrt(np.maximum(share @ place**2 - mean**2, 0.0))
        level = counts.mean(0).ravel()
        error = np.full(near.shape, counts.std() / math.sqrt(len(counts)))
        level[near], error[near] = middle + mean[kind.ravel()], spread[kind.ravel()]
        return cls(
            level.reshape(counts.shape[1:]),
            error.reshape(counts.shape[1:]),
            math.exp(found.x[1]),
        )


def _levels(x: Array, kinds: Array, values: Array) -> tuple[Array, Array]:
    """(levels,) a pixel may have, and (kinds, levels) ln of each one's share with what
    was read there.

    Args:
        x: common level, ln noise, ln scatter of the levels. kinds: (kinds, values) how
            often each value was read.
    """
    normal = np.linspace(-4, 4, _LEVELS)
    place = x[0] + math.exp(x[2]) * normal
    log_chance = np.maximum(
        _score(values - place[:, None], np.full((1, 1), math.exp(x[1])))[1], -1e4
    )
    return place, kinds @ log_chance.T - normal**2 / 2
