"""Dark level of rounded counts whose noise is below a count, by their likelihood."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from metalens.core.arrays import Array

# counts from the median of pixels that are not hot; levels of a pixel that are summed
_NORMAL_RANGE, _LEVELS = 3, 61
_TYPICAL = (0.15, 0.1)  # prior medians of noise and of the scatter of levels, counts


def _score(off: Array, noise: Array) -> tuple[Array, Array]:
    """(d ln P / dm, ln P) of rounded counts, P = Phi((d + 1/2)/s) - Phi((d - 1/2)/s).

    Args:
        off: count less expected light d, in counts.
        noise: standard deviation s before rounding, in counts.
    """
    distance = np.abs(off)
    # distance of both edges of the count, in sigma
    lower_edge = (distance - 0.5) / noise
    upper_edge = (distance + 0.5) / noise
    log_lower = special.log_ndtr(-lower_edge)
    log_upper = special.log_ndtr(-upper_edge)
    log_chance = log_lower + np.log1p(-np.exp(log_upper - log_lower))
    log_edge = -(lower_edge**2) / 2 - math.log(2 * math.pi) / 2
    density_ratio = np.exp(log_edge - log_chance) * -np.expm1(-distance / noise**2)
    return np.sign(off) * density_ratio / noise, log_chance


@dataclass(frozen=True, eq=False, slots=True)
class DarkStatistics:
    """Level and noise of repeated dark frames before rounding, in counts.

    level: (y, x) of every pixel. error: (y, x) standard error of it, common to all
    frames.
    noise: standard deviation of a pixel from frame to frame.
    """

    level: Array
    error: Array
    noise: float

    @classmethod
    def of(cls, frames: Array) -> "DarkStatistics":
        """Maximum-likelihood level and noise of (n, y, x) counts whose noise is below
        one.

        Pixels' levels scatter normally about a common level; common level, noise and
        scatter are fitted. Few values do not fix noise and scatter, so both have a
        log-normal prior about ``_TYPICAL``, a factor of two wide. Pixels more than
        ``_NORMAL_RANGE`` counts off are hot: their level is their mean.

        Args:
            frames: (n, y, x) counts.
        """
        counts = np.asarray(frames, float)
        middle = float(np.rint(np.median(counts)))
        values = np.arange(-_NORMAL_RANGE, _NORMAL_RANGE + 1)
        histograms = np.stack(
            [(counts == middle + value).sum(0) for value in values], -1
        ).reshape(-1, len(values))
        is_normal = histograms.sum(1) == len(counts)
        patterns, pattern_of, pattern_counts = np.unique(
            histograms[is_normal], axis=0, return_inverse=True, return_counts=True
        )
        start = float((counts.mean(0).ravel()[is_normal] - middle).mean())
        typical = np.array([start, math.log(_TYPICAL[0]), math.log(_TYPICAL[1])])

        def unlikely(x: Array) -> float:
            deviation = (x[1:] - typical[1:]) / math.log(2)
            return float(deviation @ deviation) / 2 - float(
                pattern_counts
                @ special.logsumexp(_levels(x, patterns, values)[1], axis=1)
            )

        solution = optimize.minimize(
            unlikely,
            typical,
            method="Nelder-Mead",
            options={"xatol": 1e-3, "fatol": 1e-3},
        )
        levels, log_weight = _levels(solution.x, patterns, values)
        share = special.softmax(log_weight, axis=1)
        mean = share @ levels
        spread = np.sqrt(np.maximum(share @ levels**2 - mean**2, 0.0))
        level = counts.mean(0).ravel()
        error = np.full(is_normal.shape, counts.std() / math.sqrt(len(counts)))
        level[is_normal] = middle + mean[pattern_of.ravel()]
        error[is_normal] = spread[pattern_of.ravel()]
        return cls(
            level.reshape(counts.shape[1:]),
            error.reshape(counts.shape[1:]),
            math.exp(solution.x[1]),
        )


def _levels(x: Array, patterns: Array, values: Array) -> tuple[Array, Array]:
    """(levels,) levels that a pixel may have, and (patterns, levels) log-likelihood
    plus log-prior of each.

    Args:
        x: common level, ln noise, ln scatter of the levels.
        patterns: (patterns, values) how often a pixel read each value.
        values: (values,) counts relative to the middle.
    """
    normals = np.linspace(-4, 4, _LEVELS)
    levels = x[0] + math.exp(x[2]) * normals
    log_chance = np.maximum(
        _score(values - levels[:, None], np.full((1, 1), math.exp(x[1])))[1], -1e4
    )
    return levels, patterns @ log_chance.T - normals**2 / 2
