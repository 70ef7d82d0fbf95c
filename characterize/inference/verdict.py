"""What a finished fit is worth: checks with their causes, structure in the residuals, and two verdicts in words."""

import math

import numpy as np

from characterize.captures import Gain
from characterize.inference.leastsquares import Prior, Solution
from characterize.inference.missing import Unstated
from characterize.inference.search import WAVES_RAD
from characterize.model import PARAMETERS, PLACE
from metalens.ground.arrays import Array

MISFIT, LEAST_PEAK_E = 1.15, 100.0
_BEYOND = 2.0  # sigma beyond a bound at which a value inside it is no longer believed
_STRUCTURE = 4.5  # sigma by which residuals of neighbours may go together; a thousand frames of noise reach 4


def explained(solution: Solution, gain: Gain) -> bool:
    """Whether chi-square is that of noise: within 15 %, or four of its own sigma where pixels or flats are few."""
    chance = 4 * math.hypot(chance_of(solution), gain.gain_sigma_e / gain.gain_e)
    return solution.chi2_per_dof <= 1 + max(MISFIT - 1, min(chance, 0.5))


def left_over(solution: Solution) -> bool:
    """Whether the frames hold more than noise, but not so much that they are of something else."""
    return 3 * chance_of(solution) < solution.chi2_per_dof - 1 < 30


def chance_of(solution: Solution) -> float:
    """Standard deviation of chi-square per degree of freedom over the pixels that count."""
    return math.sqrt(2 / max(float((solution.residual_sigma != 0).sum()), 1.0))


def problems(names: tuple[str, ...], solution: Solution, gain: Gain) -> list[str]:
    """Checks of a finished fit, each with the cause it points to; bounds are judged by :func:`held_back`."""
    words = []
    if not solution.converged:
        words.append(f"not converged ({solution.reason})")
    peak = float((solution.image - np.median(solution.image)).max())
    if gain.known and peak < LEAST_PEAK_E:
        words.append(
            f"too little light: brightest pixel {peak:.0f} electrons above background, need {LEAST_PEAK_E:.0f} or more "
            "for intervals that hold; expose longer, or average frames"
        )
    outliers = float((np.abs(solution.residual_sigma) > 6).mean())
    if gain.known and not explained(solution, gain):
        frame = int(np.argmax((solution.residual_sigma**2).mean((1, 2))))
        words.append(
            f"chi-square per degree of freedom is {solution.chi2_per_dof:.2f}, not 1: the model does not explain "
            f"the frames (worst: frame {frame}); another lens, a shifted or repeated frame, a ghost, a wrong gain"
        )
    if gain.known and outliers > 0.02:
        words.append(
            f"{outliers:.1%} of the pixels lie beyond 6 sigma: a ghost, wrong saturation level or misplaced frame"
        )
    wave = math.hypot(*(v for n, v in zip(names, solution.value.tolist(), strict=True) if n.endswith("_rad")))
    if wave > WAVES_RAD:
        words.append(f"aberrations of {wave:.2f} rad rms are no tolerance of this design: captures of another lens")
    return words


def held_back(names: tuple[str, ...], solution: Solution, prior: Prior) -> list[str]:
    """:func:`at_bounds` in words."""
    return [
        f"{name} ran to its bound {value:g}: the true value lies outside, or the frames are misread"
        for name, value in at_bounds(names, solution, prior)
    ]


def at_bounds(names: tuple[str, ...], solution: Solution, prior: Prior) -> list[tuple[str, float]]:
    """Parameters that a bound holds back, one which is not the natural zero of a blur.

    The frames want them beyond it by more than ``_BEYOND`` sigma; where they say so little that a value inside is
    nearly as good, the bound is the end of an interval and no fault.
    """
    ends = zip(names, solution.value.tolist(), solution.beyond.tolist(), prior.low, prior.high, strict=True)
    blurs = ("pinhole_um", "bandwidth_nm", "crosstalk_px", "glass_um")
    return [
        (n, v)
        for n, v, out, low, high in ends
        if (v >= high and out > _BEYOND) or (v <= low and out < -_BEYOND and n not in blurs)
    ]


def structure(residual_sigma: Array, shared: Array | None = None) -> list[str]:
    """What chi-square does not see, in words: residuals that go together from pixel to pixel or from frame to frame.

    Of noise, the mean product of neighbours scatters about 0 by one over the root of their number. Errors of dark and
    flat are the same in every frame: their part of the products is expected.

    Args:
        shared: (2, n, y, x) standard deviations of such errors over the noise, by dark and by flat, see
            :meth:`characterize.inference.leastsquares.Data.shared`.
    """
    r = np.clip(residual_sigma, -6, 6)
    dark, flat = np.zeros((2, *r.shape)) if shared is None else shared * (r != 0)
    r = r / np.sqrt(1 + flat**2)
    words = []
    sides = np.array([_together(r[:, :, 1:], r[:, :, :-1]), _together(r[:, 1:], r[:, :-1])])
    worst = int(np.argmax(sides.max(0)))
    if sides.max() > _STRUCTURE:
        words.append(
            f"residuals of frame {worst} go together from pixel to pixel ({sides[:, worst].max():.1f} sigma): more "
            "is there than the parameters describe; see the residual map"
        )
    if len(r) > 1:
        frames = _from_frame_to_frame(r, dark / np.sqrt(1 + flat**2), flat / np.sqrt(1 + flat**2))
        if frames > _STRUCTURE:
            words.append(f"residuals go together from frame to frame ({frames:.1f} sigma): the same is missed in each")
    levels = r.mean((1, 2)) * math.sqrt(max(r[0].size, 1))
    if np.abs(levels).max() > _STRUCTURE + 0.5:
        at = int(np.argmax(np.abs(levels)))
        words.append(
            f"frame {at} is brighter or darker than the model by {abs(levels[at]):.1f} sigma: exposure or lamp"
        )
    return words


def _from_frame_to_frame(r: Array, dark: Array, flat: Array) -> float:
    """Sum of products of neighbouring frames less what is expected of it, over its standard deviation.

    Of T = rᵀ A r with A = 1/2 beside the diagonal and covariance K in each pixel: tr AK and 2 tr AKAK.
    """
    expected, variance = 0.0, 0.0
    for row in range(r.shape[1]):
        some = [part[:, row].T for part in (dark, flat)]
        k = sum(np.einsum("pi,pj->pij", one, one) for one in some)
        np.einsum("pii->pi", k)[:] = r[:, row].T != 0
        ak = np.zeros_like(k)
        ak[:, 1:] += k[:, :-1] / 2
        ak[:, :-1] += k[:, 1:] / 2
        expected += float(np.einsum("pii->", ak))
        variance += 2 * float(np.einsum("pij,pji->", ak, ak))
    return (float((r[1:] * r[:-1]).sum()) - expected) / math.sqrt(max(variance, 1.0))


def _together(one: Array, other: Array) -> Array:
    """(n,) mean product of neighbours over its standard deviation."""
    product = one * other
    return np.asarray(product.sum((1, 2)) / np.sqrt(np.maximum((product != 0).sum((1, 2)), 1)))


def process_verdict(names: tuple[str, ...], low: Array, high: Array, told: Array, unstated: Unstated) -> str:
    """Which causes the frames fix, and which come from prior knowledge or only with others.

    ``told``: (p,) interval over that of the prior alone, 1 where the frames say nothing. Numbers are those with what
    ``unstated`` causes may have moved; where these are too large, a cause is known in the model alone, and so said.
    """
    causes = [i for i, n in enumerate(names) if n.endswith(("_nm", "_rad", "_deg")) or n == "index"]
    own = (high - low) / 3.92
    close = [i for i in causes if own[i] <= PARAMETERS[PLACE[names[i]]].scale]
    whole = np.hypot(own, unstated.sigma)
    good = [i for i in close if whole[i] <= PARAMETERS[PLACE[names[i]]].scale]
    known = ", ".join(f"{names[i]} +- {whole[i]:.2g}" for i in good) or "no cause alone"
    prior = [names[i] for i in causes if told[i] > 0.7]
    more = f"; from prior knowledge only: {', '.join(prior)}" if prior else ""
    moved = [i for i in close if i not in good]
    if moved:
        worst = np.argsort(-(unstated.by_cause[:, moved] / own[moved]).max(1))[:3]
        parts = ", ".join(f"{names[i]} +- {own[i]:.2g} (else +- {whole[i]:.2g})" for i in moved)
        without = ", ".join(unstated.causes[k].removeprefix("a ").removeprefix("an ") for k in worst)
        more = f"; within the model only, that is without {without}: {parts}" + more
    open_ = [i for i in causes if i not in close and told[i] <= 0.7]
    middle, reach = (low + high) / 2, 1.96 * whole
    wide = ", ".join(f"{names[i]} {middle[i] - reach[i]:.3g} to {middle[i] + reach[i]:.3g}" for i in open_)
    return f"the process is known to {known}" + (f"; loosely: {wide}" if wide else "") + more
