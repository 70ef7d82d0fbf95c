"""What a finished fit is worth: checks with their causes, structure in the residuals,
and two verdicts in words.
"""

import copy
import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from characterize.captures import SensorNoise
from characterize.inference.leastsquares import (
    FitProblem,
    FitSolution,
    GaussianPrior,
    SolverSettings,
)
from characterize.inference.missing import ResidualFinding, UnmodelledShifts
from characterize.inference.multistart import WAVES_RAD, SearchTask, named_images
from characterize.inference.uncertainty import FitPosterior
from characterize.model import FitParameter, ForwardModel, KnownValue
from metalens.core import threads
from metalens.core.arrays import Array
from metalens.fabrication import wavelength_scale
from metalens.lens import Lens

MISFIT, LEAST_PEAK_E = 1.15, 100.0
_BEYOND = 2.0  # sigma beyond a bound at which a value inside it is no longer believed
_SHOWN = 24  # draws whose images give the predicted error at depths in between
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
    dark, flat = np.zeros((2, *r.shape)) if shared is None else shared * (r != 0)
    total = np.sqrt(1 + flat**2)
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
        frames = _from_frame_to_frame(r, dark / total, flat / total)
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


def _from_frame_to_frame(r: Array, dark: Array, flat: Array) -> float:
    """Correlation of residuals in neighbouring frames, in standard deviations.

    T = rᵀ A r, A = 1/2 next to the diagonal, less its expectation tr AK and over the
    root of its variance 2 tr AKAK, with K the covariance of the frames in each pixel.

    Args:
        r: (n, y, x) residuals.
        dark: (n, y, x) shared error of the dark over the noise.
        flat: (n, y, x) the same of the flat.
    """
    expected, variance = 0.0, 0.0
    for row in range(r.shape[1]):
        shared = [part[:, row].T for part in (dark, flat)]
        # covariance K of the frames in every pixel, of unit variance
        k = sum(np.einsum("pi,pj->pij", error, error) for error in shared)
        np.einsum("pii->pi", k)[:] = r[:, row].T != 0
        ak = np.zeros_like(k)
        ak[:, 1:] += k[:, :-1] / 2
        ak[:, :-1] += k[:, 1:] / 2
        expected += float(np.einsum("pii->", ak))
        variance += 2 * float(np.einsum("pij,pji->", ak, ak))
    return (float((r[1:] * r[:-1]).sum()) - expected) / math.sqrt(max(variance, 1.0))


def _together(first: Array, second: Array) -> Array:
    """(n,) mean product of neighbours over its standard deviation."""
    product = first * second
    return np.asarray(
        product.sum((1, 2)) / np.sqrt(np.maximum((product != 0).sum((1, 2)), 1))
    )


def process_verdict(
    rows: Sequence[FitParameter],
    low: Array,
    high: Array,
    prior_share: Array,
    unstated: UnmodelledShifts,
) -> str:
    """Sentence on which causes the frames determine.

    The others come from prior knowledge, or are determined only within the model, where
    unstated causes may have shifted them too much, or loosely.

    Args:
        rows: (p,) of the fitted parameters, for this lens.
        low: (p,) lower ends of statistical 95 %.
        high: (p,) upper ends of statistical 95 %.
        prior_share: (p,) interval over that of the prior alone; 1 where the frames add
            nothing.
        unstated: shifts by causes that nobody stated.
    """
    names = [row.name for row in rows]
    causes = [
        i
        for i, n in enumerate(names)
        if n.endswith(("_nm", "_rad", "_deg")) or n == "index"
    ]
    # standard deviations: statistical, and with the shifts by unstated causes
    own = (high - low) / 3.92
    close = [i for i in causes if own[i] <= rows[i].scale]
    whole = np.hypot(own, unstated.sigma)
    good = [i for i in close if whole[i] <= rows[i].scale]
    known = ", ".join(f"{names[i]} +- {whole[i]:.2g}" for i in good) or "no cause alone"
    prior = [names[i] for i in causes if prior_share[i] > 0.7]
    more = f"; from prior knowledge only: {', '.join(prior)}" if prior else ""
    moved = [i for i in close if i not in good]
    if moved:
        worst = np.argsort(-(unstated.by_cause[:, moved] / own[moved]).max(1))[:3]
        parts = ", ".join(
            f"{names[i]} +- {own[i]:.2g} (else +- {whole[i]:.2g})" for i in moved
        )
        without = ", ".join(
            unstated.causes[k].removeprefix("a ").removeprefix("an ") for k in worst
        )
        more = f"; within the model only, that is without {without}: {parts}" + more
    open_ = [i for i in causes if i not in close and prior_share[i] <= 0.7]
    middle = (low + high) / 2
    reach = 1.96 * whole
    wide = ", ".join(
        f"{names[i]} {middle[i] - reach[i]:.3g} to {middle[i] + reach[i]:.3g}"
        for i in open_
    )
    loosely = f"; loosely: {wide}" if wide else ""
    return f"the process is known to {known}" + loosely + more


def predicted_error(task: SearchTask, posterior: FitPosterior) -> tuple[float, float]:
    """Expected NRMSE of the as-built images: at the captured depths, and half-way
    between them.

    Args:
        task: model, frames, priors and arrangement of the search.
        posterior: the posterior.
    """
    values = _shown(task, posterior)
    best = posterior.best.value
    model = task.model.quick()  # accurate to a few percent of the differences
    between = models_between_depths(model)
    return _spread(task, model, best, values), _spread(task, between, best, values)


def predicted_aside(
    task: SearchTask, posterior: FitPosterior
) -> tuple[float, float] | None:
    """Expected NRMSE of as-built images off the captured field angles.

    At the captured depths, as :func:`predicted_error`.

    Args:
        task: model, frames, priors and arrangement of the search.
        posterior: the posterior.

    Returns:
        (half-way between neighbouring angles, half a step beyond the outermost); None
        of frames at one angle.
    """
    angles = largest_angle_gap(task.model.setting.angle_rad)
    if angles is None:
        return None
    values = _shown(task, posterior)
    models = [_at_angle(task.model, angle).quick() for angle in angles]
    between_them, beyond = (
        _spread(task, model, posterior.best.value, values) for model in models
    )
    return between_them, beyond


def largest_angle_gap(angle_rad: Array) -> tuple[Array, Array] | None:
    """(x, y) middle of the widest gap between neighbouring field angles (n, 2), and
    half a step beyond the outermost; None for one angle.

    Args:
        angle_rad: (n, 2) field angles, rad.
    """
    angles = np.unique(angle_rad, axis=0)
    if len(angles) < 2:
        return None
    distances = np.hypot(*(angles[:, None] - angles).T)
    np.fill_diagonal(distances, np.inf)
    nearest = angles[distances.argmin(1)]
    wide = int(distances.min(1).argmax())
    outer = int(np.hypot(*(angles - angles.mean(0)).T).argmax())
    middle = (angles[wide] + nearest[wide]) / 2
    return middle, angles[outer] + (angles[outer] - nearest[outer]) / 2


def _at_angle(model: ForwardModel, angle_rad: Array) -> ForwardModel:
    """The model of all its depths at one field angle."""
    s = model.setting
    angles_rad = np.broadcast_to(angle_rad, s.angle_rad.shape)
    setting = dataclasses.replace(s, angle_rad=angles_rad)
    return ForwardModel(model.lens, setting, model.response).about(model.grid.middle_um)


def _shown(task: SearchTask, posterior: FitPosterior) -> Array:
    """(draws, p) parameters of the posterior, within the bounds.

    Its own draws, or Gaussian ones where there are none.
    """
    if len(posterior.draws):
        values = posterior.draws[:_SHOWN]
    else:
        size, vectors = np.linalg.eigh(posterior.covariance)
        normal = np.random.default_rng(0).standard_normal((_SHOWN, len(size)))
        normal = normal * np.sqrt(np.maximum(size, 0))
        values = posterior.best.value + normal @ vectors.T
    return np.clip(values, task.prior.low, task.prior.high)


def _spread(task: SearchTask, model: ForwardModel, best: Array, values: Array) -> float:
    """Relative rms error of the images over draws of the parameters (draws, p).

    Root of the mean of |image - best|² / |best|², without background and at the
    brightness of the best.
    """
    images = named_images(model, task.names, task.start)
    dark = [i for i, name in enumerate(task.names) if name.startswith("background")]

    def light(x: Array) -> Array:
        x = x.copy()
        x[dark] = 0.0
        return np.asarray(images(x, False)[0])

    mean = light(best)

    def squared_error(x: Array) -> float:
        image = light(x)
        # least-squares brightness
        image *= (image * mean).sum() / max(float((image**2).sum()), 1e-300)
        return float(((image - mean) ** 2).sum())

    total = sum(threads.run_each(squared_error, values))
    return float(np.sqrt(total / len(values) / (mean**2).sum()))


def models_between_depths(model: ForwardModel) -> ForwardModel:
    """The model half-way, in 1/z, between neighbouring depths at each angle.

    The farthest frame takes the last of these depths too.
    """
    part = copy.copy(model)
    s = model.setting
    depth = s.depth_um.copy()
    for group in model.groups:
        order = group.index[np.argsort(s.depth_um[group.index], kind="stable")]
        if len(order) > 1:
            inverse = 1 / s.depth_um[order]
            middle = (inverse[1:] + inverse[:-1]) / 2
            depth[order] = 1 / np.append(middle, middle[-1])
    part.setting = dataclasses.replace(s, depth_um=depth)
    return part


def left_out(task: SearchTask, mode: FitSolution) -> float:
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
    predict = functools.partial(_unseen, task, mode)
    total, count = np.sum(threads.run_each(predict, halves), 0)
    return float(total / max(count, 1))


def _unseen(
    task: SearchTask, mode: FitSolution, halves: tuple[Array, Array]
) -> tuple[float, int]:
    """(chi-square, pixels) of frames that are predicted from a fit to the others.

    Residuals are over noise and uncertainty of the prediction, at most 6 sigma.

    Args:
        halves: indices of the fitted and of the predicted frames.
    """
    fitted, hidden = halves
    images = named_images(task.model.only(fitted), task.names, task.start)
    problem = FitProblem(images, task.data.planes(fitted), task.prior)
    settings = SolverSettings(
        iterations=6, step_tolerance=0.3, secant=True, near=math.inf, finish=False
    )
    part = problem.fit(mode.value, settings, mode.slopes[:, fitted])
    data = task.data.planes(hidden)
    predict = named_images(task.model.only(hidden), task.names, task.start)
    image = predict(part.value, False)[0]
    keep = data.usable & ~data.saturated
    slopes = mode.slopes[:, hidden][:, keep]
    # variance of the prediction, e²
    by_fit = np.einsum("iN,ij,jN->N", slopes, part.covariance, slopes, optimize=True)
    variance = data.variance(image)[keep] + by_fit
    square = (data.electrons - image)[keep] ** 2 / variance
    return float(np.minimum(square, 36.0).sum()), int(keep.sum())
