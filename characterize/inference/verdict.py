"""What a finished fit is worth: checks with their causes, structure in the residuals,
and two verdicts in words.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from characterize.captures import SensorNoise
from characterize.inference.leastsquares import REACH, FitSolution, GaussianPrior
from characterize.inference.multistart import WAVES_RAD, SearchTask
from characterize.inference.uncertainty import FitPosterior
from characterize.inference.unmodelled_effects import ResidualFinding
from characterize.model import FitParameter, KnownValue, background_planes
from metalens.core.arrays import Array
from metalens.fabrication import wavelength_scale
from metalens.lens import Lens

MISFIT, LEAST_PEAK_E = 1.15, 100.0
_BEYOND = 2.0  # sigma beyond a bound at which a value inside it is no longer believed
# wavelength range over which phases of pillars change by 0.02 rad
_ONE_COLOUR_NM = 2.0
# significance of correlated residuals; a thousand frames of noise reach 4
_STRUCTURE = 4.5


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
    """Deviation of reduced chi-square from 1 that is no fault: 15 %, or four of its own
    sigma, with the gain's error, where pixels or flats are few; half at most.
    """
    counted = max(float((solution.residual_sigma != 0).sum()), 1.0)
    chance = math.hypot(math.sqrt(2 / counted), gain.gain_sigma_e / gain.gain_e)
    return max(MISFIT - 1, min(4 * chance, 0.5))


def fit_problems(
    names: tuple[str, ...], solution: FitSolution, gain: SensorNoise
) -> list[str]:
    """Checks of a finished fit, each with the cause it points to; bounds are judged by
    :func:`bounds_text`.

    Args:
        names: (p,) names of the fitted parameters.
        solution: the fit that is judged.
        gain: noise of the sensor.
    """
    words = []
    if gain.coarse:
        words.append(
            f"counts are {gain.gain_e:.3g} electrons apart and noise in the dark is {gain.read_noise_e:.2g}: rounding "
            "is no noise there, but one error of all pixels of equal light; save more "
            "bits, or raise the camera's gain"
        )
    if not solution.converged:
        words.append(f"not converged ({solution.reason})")
    peak = float((solution.image - np.median(solution.image)).max())
    if gain.known and peak < LEAST_PEAK_E:
        words.append(
            f"too little light: brightest pixel {peak:.0f} electrons above background, need {LEAST_PEAK_E:.0f} or more "
            "for intervals that hold; expose longer, or average frames"
        )
    outliers = float((np.abs(solution.residual_sigma) > 6).mean())
    if gain.known and solution.chi2_per_dof > 1 + _allowed(solution, gain):
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


def bounds_text(
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
    residual_sigma: Array, flat_sigma: Array | float = 0.0
) -> list[ResidualFinding]:
    """Correlations between residuals that chi-square does not show.

    For noise, the mean product of neighbours scatters about 0 by one over the root of
    their number.

    Args:
        residual_sigma: (n, y, x) residuals over their noise; 0 where a pixel is masked
            or saturated.
        flat_sigma: (n, y, x) standard deviation of the error by the flat, over the
            noise.
    """
    r = np.clip(residual_sigma, -6, 6) / np.sqrt(1 + np.square(flat_sigma))
    findings = []
    sides = np.array(
        [
            neighbour_correlation(r[:, :, 1:], r[:, :, :-1]),
            neighbour_correlation(r[:, 1:], r[:, :-1]),
        ]
    )
    worst = int(np.argmax(sides.max(0)))
    if sides.max() > _STRUCTURE:
        words = (
            f"residuals of frame {worst} go together from pixel to pixel "
            f"({sides.max():.1f} sigma): more is there than the parameters describe; "
            "see the residual map"
        )
        findings.append(ResidualFinding(words, float(sides.max())))
    levels = np.abs(r.sum((1, 2)) / np.sqrt(np.maximum((r != 0).sum((1, 2)), 1)))
    at = int(np.argmax(levels))
    if levels[at] > _STRUCTURE + 0.5:
        words = (
            f"frame {at} is brighter or darker than the model by "
            f"{levels[at]:.1f} sigma: exposure or lamp"
        )
        findings.append(ResidualFinding(words, float(levels[at])))
    return findings


def neighbour_correlation(first: Array, second: Array) -> Array:
    """(n,) mean product of neighbours over its standard deviation.

    Args:
        first: (n, y, x) residuals.
        second: those of their neighbours.
    """
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
        sigma = (b - a) / (2 * REACH)
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


def psf_verdict(task: SearchTask, posterior: FitPosterior) -> str:
    """Sentence on the expected relative L2 error of the images at the captured depths
    and angles, √(tr(C JJᵀ) / |I|²), without background and at the brightness of the best.

    Args:
        task: model, frames and priors of the search.
        posterior: the posterior, with its covariance C.
    """
    best = posterior.best
    background = background_planes(task.all_of(best.value), task.model.setting)
    light = (best.image - background).ravel()
    power = float(light @ light)
    lens = [i for i, name in enumerate(task.names) if not name.startswith("background")]
    slopes = best.slopes[lens].reshape(len(lens), -1)
    slopes = slopes - np.outer(slopes @ light / power, light)
    square = posterior.covariance[np.ix_(lens, lens)] * (slopes @ slopes.T)
    error = math.sqrt(max(float(square.sum()), 0.0) / power)
    return f"the PSF is known to {error:.1%} at the captured depths and angles"
