"""What a finished fit is worth: checks with their causes, structure in the residuals,
and two verdicts in words.
"""

import functools
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from characterize.captures import SensorNoise
from characterize.inference.leastsquares import (
    FitSolution,
    GaussianPrior,
    SolverSettings,
)
from characterize.inference.multistart import WAVES_RAD, SearchTask
from characterize.inference.uncertainty import FitPosterior
from characterize.inference.unmodelled_effects import ResidualFinding
from characterize.model import FitParameter, KnownValue, background_planes
from metalens.core import threads
from metalens.core.arrays import Array
from metalens.fabrication import wavelength_scale
from metalens.lens import Lens

MISFIT, LEAST_PEAK_E = 1.15, 100.0
_BEYOND = 2.0  # sigma beyond a bound at which a value inside it is no longer believed
# wavelength range over which phases of pillars change by 0.02 rad
_ONE_COLOUR_NM = 2.0
# significance of correlated residuals; a thousand frames of noise reach 4
_STRUCTURE = 4.5


def is_chi_square_consistent(solution: FitSolution, gain: SensorNoise) -> bool:
    """Whether chi-square is that of noise: within 15 %, or four of its own sigma where
    pixels or flats are few.

    Args:
        solution: the fit that is judged.
        gain: noise of the sensor.
    """
    return solution.chi2_per_dof <= 1 + _allowed(solution, gain)


def quantization_text(gain: SensorNoise, *, whole: bool) -> list[str]:
    """How counts too coarse for their noise were fitted, in words; empty for others.

    Args:
        gain: noise of the sensor.
        whole: the frames are counts and no means of them: fitted as rounded.
    """
    if gain.coarse:
        said = (
            f"counts are {gain.gain_e:.3g} electrons apart and noise in the dark is {gain.read_noise_e:.2g}: rounding "
            "is no noise there, but one error wherever light is alike, and "
        )
        exact = "they are fitted as rounded counts; more bits, or a higher gain of the camera, tell more"
        rough = "of merged exposures intervals within the model are too narrow; save more bits, or raise the camera's gain"
        return [said + (exact if whole else rough)]
    return []


def too_quiet(solution: FitSolution, gain: SensorNoise) -> list[str]:
    """Whether frames have less noise than the noise model says, in words.

    Chi-square may be as far below 1 as above; half of it where no gain is known.
    Counts too coarse for their noise are not judged: in the middle of a count most
    pixels tell nothing.

    Args:
        solution: the fit that is judged.
    """
    if gain.coarse or solution.chi2_per_dof >= 1 - _allowed(solution, gain):
        return []
    return [
        f"chi-square per degree of freedom is {solution.chi2_per_dof:.2f}, far below 1: "
        "the frames have less noise than the noise model says, so intervals and tests do "
        "not hold; averaged or smoothed frames, an offset that weighs as light (no dark "
        "frame), dark frames of a longer exposure, or a gain of other counts: state "
        "gain_e, read_noise_e and offset of these frames, or add dark.tif and flat.tif"
    ]


def _allowed(solution: FitSolution, gain: SensorNoise) -> float:
    """Deviation of reduced chi-square from 1 that noise and the gain's error allow."""
    chance = 4 * math.hypot(chance_of(solution), gain.gain_sigma_e / gain.gain_e)
    return max(MISFIT - 1, min(chance, 0.5))


def chance_of(solution: FitSolution) -> float:
    """Standard deviation of chi-square per degree of freedom over the pixels that
    count.

    Args:
        solution: the fit that is judged.
    """
    return math.sqrt(2 / max(float((solution.residual_sigma != 0).sum()), 1.0))


def fit_problems(
    names: tuple[str, ...], solution: FitSolution, gain: SensorNoise
) -> list[str]:
    """Checks of a finished fit, each with the cause it points to; bounds are judged by
    :func:`held_back`.

    Args:
        names: (p,) names of the fitted parameters.
        solution: the fit that is judged.
        gain: noise of the sensor.
    """
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
    if gain.known and not is_chi_square_consistent(solution, gain):
        frame = int(np.argmax((solution.residual_sigma**2).mean((1, 2))))
        words.append(
            f"chi-square per degree of freedom is {solution.chi2_per_dof:.2f}, not 1: the model does not explain "
            f"the frames (worst: frame {frame}); another lens, a shifted or repeated frame, a ghost, a wrong gain"
        )
    if gain.known and outliers > 0.02:
        words.append(
            f"{outliers:.1%} of the pixels lie beyond 6 sigma: a ghost, wrong saturation level or misplaced frame"
        )
    by_name = zip(names, solution.value.tolist(), strict=True)
    wave = math.hypot(*(value for name, value in by_name if name.endswith("_rad")))
    if wave > WAVES_RAD:
        words.append(
            f"aberrations of {wave:.2f} rad rms are no tolerance of this design: captures of another lens, or counts "
            "that are not in proportion to the light (a gamma, as pictures of 8 bits have)"
        )
    return words


def held_back(
    names: tuple[str, ...], solution: FitSolution, prior: GaussianPrior
) -> list[str]:
    """:func:`at_bounds` in words.

    Args:
        names: (p,) names of the fitted parameters.
        solution: the fit that is judged.
        prior: prior knowledge of the fitted parameters.
    """
    return [
        f"{name} ran to its bound {value:g}: the true value lies outside, or the frames are misread"
        for name, value in at_bounds(names, solution, prior)
    ]


def at_bounds(
    names: tuple[str, ...], solution: FitSolution, prior: GaussianPrior
) -> list[tuple[str, float]]:
    """(name, value) of parameters that a bound holds back, but for blurs at 0.

    The frames favour values beyond it by more than ``_BEYOND`` sigma. Where a value
    inside is nearly as good, the bound is the end of an interval and no fault.

    Args:
        names: (p,) names of the fitted parameters.
        solution: the fit that is judged.
        prior: prior knowledge of the fitted parameters.
    """
    ends = zip(
        names,
        solution.value.tolist(),
        solution.beyond.tolist(),
        prior.low,
        prior.high,
        strict=True,
    )
    blurs = ("pinhole_um", "bandwidth_nm", "crosstalk_px", "glass_um")
    return [
        (name, value)
        for name, value, beyond, low, high in ends
        if (value >= high and beyond > _BEYOND)
        or (value <= low and beyond < -_BEYOND and name not in blurs)
    ]


def spectrum_text(lens: Lens, known: Mapping[str, KnownValue]) -> list[str]:
    """Whether pillars were solved for the colours of a stated spectrum, in words;
    beyond, ``designed`` holds them.

    Args:
        lens: the design.
        known: stated values by name.
    """
    bandwidth_nm = known["bandwidth_nm"].value if "bandwidth_nm" in known else 0.0
    low, high = (edge * 1e3 for edge in lens.proxy.wavelengths_um)
    first, last = (lens.wavelength_um * 1e3 + reach * bandwidth_nm for reach in (-2, 2))
    room = max(high - low, _ONE_COLOUR_NM * wavelength_scale(lens.wavelength_um))
    if low - room <= first and last <= high + room:
        return []
    return [
        f"the light reaches from {first:.0f} to {last:.0f} nm, the pillars are known from {low:.0f} to {high:.0f} nm: "
        f"beyond {low - room:.0f} and {high + room:.0f} nm they are taken to be the same; sweep the library over it"
    ]


def correlated_residuals_text(
    residual_sigma: Array, shared: Array | None = None
) -> list[ResidualFinding]:
    """Correlations between residuals that chi-square does not show.

    For noise, the mean product of neighbours scatters about 0 by one over the root of
    their number. Errors of dark and flat are the same in every frame: their part of the
    products is expected.

    Args:
        residual_sigma: (n, y, x) residuals over their noise; 0 where a pixel is masked
            or saturated.
        shared: (2, n, y, x) standard deviations of such errors over the noise, by dark
            and by flat, see
            :meth:`characterize.inference.leastsquares.FitImages.shared`.
    """
    r = np.clip(residual_sigma, -6, 6)
    shared = np.zeros((2, *r.shape)) if shared is None else shared * (r != 0)
    total = np.sqrt(1 + shared[1] ** 2)
    r = r / total
    found = []
    sides = np.array(
        [_together(r[:, :, 1:], r[:, :, :-1]), _together(r[:, 1:], r[:, :-1])]
    )
    worst = int(np.argmax(sides.max(0)))
    if sides.max() > _STRUCTURE:
        words = (
            f"residuals of frame {worst} go together from pixel to pixel "
            f"({sides.max():.1f} sigma): more is there than the parameters describe; "
            "see the residual map"
        )
        found.append(ResidualFinding(words, float(sides.max())))
    if len(r) > 1:
        frames = _from_frame_to_frame(r, shared / total)
        if frames > _STRUCTURE:
            words = (
                f"residuals go together from frame to frame ({frames:.1f} sigma): the "
                "same is missed in each"
            )
            found.append(ResidualFinding(words, frames))
    levels = np.abs(r.sum((1, 2)) / np.sqrt(np.maximum((r != 0).sum((1, 2)), 1)))
    at = int(np.argmax(levels))
    if levels[at] > _STRUCTURE + 0.5:
        words = (
            f"frame {at} is brighter or darker than the model by "
            f"{levels[at]:.1f} sigma: exposure or lamp"
        )
        found.append(ResidualFinding(words, float(levels[at])))
    return found


def _from_frame_to_frame(r: Array, shared: Array) -> float:
    """Correlation of residuals in neighbouring frames, in standard deviations.

    T = rᵀ A r, A = 1/2 next to the diagonal, less its expectation tr AK and over the
    root of its variance 2 tr AKAK, with K the covariance of the frames in each pixel.

    Args:
        r: (n, y, x) residuals.
        shared: (2, n, y, x) errors of dark and of flat over the noise, which all frames
            share.
    """
    n = len(r)
    k = np.einsum("ciyx,cjyx->yxij", shared, shared)
    np.einsum("yxii->yxi", k)[:] = np.moveaxis(r != 0, 0, -1)
    ak = (np.eye(n, k=1) + np.eye(n, k=-1)) / 2 @ k
    expected = float(np.einsum("yxii->", ak))
    variance = 2 * float(np.einsum("yxij,yxji->", ak, ak))
    return (float((r[1:] * r[:-1]).sum()) - expected) / math.sqrt(max(variance, 1.0))


def _together(first: Array, second: Array) -> Array:
    """(n,) mean product of neighbours over its standard deviation."""
    product = first * second
    return np.asarray(
        product.sum((1, 2)) / np.sqrt(np.maximum((product != 0).sum((1, 2)), 1))
    )


def process_verdict(
    rows: Sequence[FitParameter], low: Array, high: Array, prior_share: Array
) -> str:
    """Sentence on which process parameters are known to their typical uncertainty,
    which loosely, and which from prior knowledge only.

    Args:
        rows: (p,) of the fitted parameters, for this lens.
        low: (p,) lower ends of the total 95 % intervals.
        high: (p,) upper ends.
        prior_share: (p,) statistical interval over that of the prior alone; 1 where the
            frames add nothing.
    """
    known, loosely, prior = list[str](), list[str](), list[str]()
    for row, a, b, share in zip(rows, low, high, prior_share, strict=True):
        sigma = (b - a) / 3.92
        if not (row.name.endswith(("_nm", "_rad", "_deg")) or row.name == "index"):
            continue
        if share > 0.7:
            prior.append(row.name)
        elif sigma <= row.scale:
            known.append(f"{row.name} +- {sigma:.2g}")
        else:
            loosely.append(f"{row.name} {a:.3g} to {b:.3g}")
    words = [f"the process is known to {', '.join(known) or 'no cause alone'}"]
    words += [f"loosely: {', '.join(loosely)}"] if loosely else []
    words += [f"from prior knowledge only: {', '.join(prior)}"] if prior else []
    return "; ".join(words)


def psf_verdict(task: SearchTask, posterior: FitPosterior, held_out: float) -> str:
    """Sentence on the expected relative L2 error of the images at the captured depths
    and angles, √(tr(C JJᵀ) / |I|²), without background and at the brightness of the best.

    Args:
        task: model, frames, priors and arrangement of the search.
        posterior: the posterior, with its covariance C.
        held_out: reduced chi-square of frames left out; nan without such.
    """
    best = posterior.best
    background = background_planes(task.all_of(best.value), task.model.setting)
    light = (best.image - background).ravel()
    power = float(light @ light)
    lens = [i for i, name in enumerate(task.names) if not name.startswith("background")]
    slopes = best.slopes[lens].reshape(len(lens), -1)
    slopes = slopes - np.outer(slopes @ light / power, light)
    square = posterior.covariance[np.ix_(lens, lens)] * (slopes @ slopes.T)
    tested = ""
    if not math.isnan(held_out):
        tested = f"; frames left out agree within {held_out:.2f} times their noise"
    error = math.sqrt(max(float(square.sum()), 0.0) / power)
    return f"the PSF is known to {error:.1%} at the captured depths and angles{tested}"


def hold_out_chi_square(task: SearchTask, mode: FitSolution) -> float:
    """Reduced chi-square of frames left out of a fit (cross-validation).

    About 1 where model and intervals hold; nan with fewer than four frames.

    Args:
        task: model, frames and priors.
        mode: the fit of all frames.
    """
    n = len(task.data.electrons)
    if n < 4:
        return float("nan")
    order = np.argsort(task.model.setting.depth_um, kind="stable")
    # every second depth is fitted and the others are predicted, then the reverse
    halves = [
        (np.sort(fitted), np.sort(hidden))
        for fitted, hidden in itertools.permutations((order[::2], order[1::2]))
    ]
    predict = functools.partial(_held_out, task, mode)
    total, count = np.sum(threads.run_each(predict, halves), 0)
    return float(total / max(count, 1))


def _held_out(
    task: SearchTask, mode: FitSolution, halves: tuple[Array, Array]
) -> tuple[float, int]:
    """(chi-square, pixels) of frames that are predicted from a fit to the others.

    Residuals are over noise and uncertainty of the prediction, at most 6 sigma.

    Args:
        halves: indices of the fitted and of the predicted frames.
    """
    fitted, hidden = (task.posed(index) for index in halves)
    settings = SolverSettings(
        iterations=6, step_tolerance=0.3, near=math.inf, finish=False
    )
    part = fitted.fit(mode.value, settings, mode.slopes[:, halves[0]])
    data = hidden.data
    image = hidden.model(part.value, False)[0]
    keep = data.usable & ~data.saturated
    slopes = mode.slopes[:, halves[1]][:, keep]
    # variance of the prediction, e²
    by_fit = np.einsum("iN,ij,jN->N", slopes, part.covariance, slopes, optimize=True)
    variance = data.variance(image)[keep] + by_fit
    square = (data.electrons - image)[keep] ** 2 / variance
    return float(np.minimum(square, 36.0).sum()), int(keep.sum())
