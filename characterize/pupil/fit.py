"""Maximum-likelihood phase retrieval from a through-focus stack, scored on planes left
out of the fit.
"""

import dataclasses
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from characterize.captures import ElectronFrames, to_electrons
from characterize.captures.capture import Capture
from characterize.inference import (
    FitImages,
    FitProblem,
    FitSolution,
    GaussianPrior,
    SolverSettings,
)
from characterize.pupil.model import RELATIVE_PRIOR, PupilModel, PupilSpec
from characterize.pupil.score import StackAgreement, measure_agreement, pupil_problems
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError, FitError, FitRefused

Optics = tuple[tuple[str, float, float], ...]


@dataclass(frozen=True, eq=False, slots=True)
class PupilFit:
    """Retrieved pupil of a stack.

    names, value, sigma: parameters with standard errors (widened where chi2_per_dof is
    above 1).
    measured, predicted: (n, y, x) windows in electrons; every plane of ``predicted`` by
    the fit of all planes.
    phase_rad, amplitude: (nodes, nodes) pupil maps, nan and 0 outside the aperture.
    agreement: of all planes with their fit. held_out: of planes left out, predicted
    from a fit of the others; None where too few.
    optics: (name, value, standard error) of what was freed.
    cautions: degeneracies and corrections in words. problems: failed checks with their
    cause.
    """

    spec: PupilSpec
    names: tuple[str, ...]
    value: Array
    sigma: Array
    position_um: Array
    measured: Array
    predicted: Array
    residual_sigma: Array
    phase_rad: Array
    amplitude: Array
    agreement: StackAgreement
    held_out: StackAgreement | None
    optics: Optics
    chi2_per_dof: float
    converged: bool
    reason: str
    cautions: tuple[str, ...]
    problems: tuple[str, ...] = ()


def fit_pupil(
    capture: Capture,
    spec: PupilSpec,
    *,
    judge: bool = True,
    sparse: int = 2,
    insist: bool = False,
) -> PupilFit:
    """Pupil of a through-focus stack by maximum likelihood.

    Fitted are phase, amplitude, drift, stage errors, blur, gains and backgrounds of all
    planes. With ``judge`` some planes are fitted first and predict the others.

    Args:
        capture: through-focus stack of one bead, in counts.
        spec: what is known of optics and stage.
        judge: whether planes are left out and predicted.
        sparse: 2 fits every second plane first and predicts the others, 3 every third.
        insist: return a pupil that fails its checks (problems filled) instead of
            refusing it.

    Raises:
        CaptureError: wavelength, pixel or stage positions unknown.
        FitError: too few planes, no bead, or refused by a check of
            :func:`characterize.pupil.score.pupil_problems`.
    """
    full_spec = complete_spec(spec, capture)
    frames = to_electrons(capture)
    position_um = stage_positions_um(capture, full_spec)
    data, bead = crop_to_bead(frames, full_spec)
    first_model = PupilModel(full_spec, position_um)
    mean = initial_parameters(first_model, data, bead)
    enough_planes = judge and len(position_um) > 2 * sparse
    model, optics = fit_optics(first_model, data, mean, sparse if enough_planes else 1)
    mean = transfer_parameters(mean, first_model, model)

    held_out = None
    if enough_planes:
        start, held_out = score_held_out(model, data, mean, sparse)
    else:
        start = fit_low_orders(model, data, mean)
    solution = maximize_likelihood(model, data, start, mean)
    agreement = measure_agreement(
        solution.image, data, model.background(solution.value)
    )
    stop_reason = "" if solution.converged else solution.reason
    problems = pupil_problems(held_out or agreement, stop_reason)
    if problems and not insist:
        raise FitRefused("fit refused: " + "; ".join(problems))
    phase, amplitude = model.pupil_maps(solution.value)
    return PupilFit(
        spec=model.spec,
        names=tuple(name for group in model.names().values() for name in group),
        value=solution.value,
        sigma=np.sqrt(np.diag(solution.covariance) * max(1.0, solution.chi2_per_dof)),
        position_um=model.position_um,
        measured=data.electrons,
        predicted=solution.image,
        residual_sigma=solution.residual_sigma,
        phase_rad=phase,
        amplitude=amplitude,
        agreement=agreement,
        held_out=held_out,
        optics=optics,
        chi2_per_dof=solution.chi2_per_dof,
        converged=solution.converged,
        reason=solution.reason,
        cautions=(*frames.corrections, *describe_limits(full_spec, solution, optics)),
        problems=tuple(problems),
    )


def save_pupil(
    path: str | Path, fit: PupilFit, provenance: store.Provenance | None = None
) -> None:
    """Write a pupil file (HDF5, kind ``pupil``).

    Args:
        path: the file to write.
        fit: the fitted pupil.
        provenance: inputs and settings, for the record.
    """
    arrays, attributes = store.flatten_record(fit)
    attributes |= {f"fitted_{name}": value for name, value, _ in fit.optics}
    for label in ("agreement", "held_out"):
        if score := getattr(fit, label):
            del attributes[label]
            entries = dataclasses.asdict(score).items()
            attributes |= {f"{label}_{key}": value for key, value in entries}
    store.save(path, "pupil", arrays, attributes=attributes, provenance=provenance)


def complete_spec(spec: PupilSpec, capture: Capture) -> PupilSpec:
    """Specification with the wavelength and pixel of the capture where it states none,
    and a window no larger than the frame.

    Args:
        spec: as stated by the user.
        capture: the stack with its metadata.

    Raises:
        CaptureError: neither of them states the wavelength or the pixel.
    """
    values = {}
    for name in ("wavelength_um", "pixel_um"):
        value = getattr(spec, name)
        values[name] = getattr(capture, name) if math.isnan(value) else value
        if math.isnan(values[name]):
            raise CaptureError(
                f"{name} is missing: give it in the pupil file or in capture.toml; it "
                "cannot be fitted"
            )
    window = min(spec.window, *capture.frames.shape[1:])
    return replace(spec, window=window, **values)


def stage_positions_um(capture: Capture, spec: PupilSpec) -> Array:
    """(n,) stage positions of the planes in um, relative to the sharpest plane.

    The origin is the mean position, weighted by how far a plane's peak exceeds half of
    the highest peak.

    Args:
        capture: frames and their positions.
        spec: ``step_um`` overrides the positions.

    Raises:
        FitError: fewer than three planes.
        CaptureError: no positions.
    """
    frames = np.asarray(capture.frames, float)
    if len(frames) < 3:
        raise FitError(f"{len(frames)} planes: a pupil needs three or more")
    position_um = np.asarray(capture.position_um, float)
    if not math.isnan(spec.step_um):
        position_um = np.arange(len(frames)) * spec.step_um
    if not np.isfinite(position_um).all():
        raise CaptureError(
            "stage positions are missing: give step_um in the pupil file, or a "
            "stage.csv"
        )
    peak = frames.max((1, 2)) - np.median(frames, axis=(1, 2))
    weight = np.maximum(peak - peak.max() / 2, 0)
    return np.asarray(position_um - np.average(position_um, weights=weight))


def crop_to_bead(
    frames: ElectronFrames, spec: PupilSpec
) -> tuple[FitImages, tuple[int, int]]:
    """Square window about the bead, and the bead's (row, column) from its middle.

    The bead is the brightest spot of a difference of Gaussians, which a background
    gradient does not move. At the edge of the frame the window is moved inwards.

    Args:
        frames: the whole stack in electrons.
        spec: gives the side of the window and, where stated, the bead's place.
    """
    shape = frames.electrons.shape
    window = spec.window
    center = spec.center
    if center is None:
        median_e = np.median(frames.electrons, axis=(1, 2), keepdims=True)
        filled = np.where(frames.usable, frames.electrons, median_e)
        contrast = ndimage.gaussian_filter(filled, (0, 1, 1))
        contrast -= ndimage.gaussian_filter(filled, (0, window / 4, window / 4))
        brightness = np.sort(contrast, axis=0)[-3:].mean(0)
        row, column = np.unravel_index(int(brightness.argmax()), brightness.shape)
        center = int(row), int(column)
    half = window // 2
    corner = np.clip(np.subtract(center, half), 0, np.subtract(shape[1:], window))
    top, left = corner.tolist()
    inner = (slice(None), slice(top, top + window), slice(left, left + window))
    parts: dict[str, Any] = {
        name: np.broadcast_to(getattr(frames, name), shape)[inner]
        for name in ("electrons", "usable", "saturated", "variance_e2", "scale")
    }
    data = FitImages(**parts, model_error=spec.model_error)
    return data, (center[0] - half - top, center[1] - half - left)


def initial_parameters(
    model: PupilModel, data: FitImages, bead: tuple[int, int]
) -> Array:
    """(p,) start parameters: unaberrated pupil, blur of half a pixel, gain and
    background from the data.

    Background of a plane: its 20th percentile, electrons. Gain: logarithm of the light
    of the brightest plane above it.

    Args:
        model: gives the parameter vector.
        data: region of interest.
        bead: (row, column) of the bead from the middle of the window.

    Raises:
        FitError: no light above the background.
    """
    x = np.zeros(sum(model.sizes.values()))
    background_e = np.percentile(data.electrons, 20, axis=(1, 2))
    light_e = (data.electrons - background_e[:, None, None]).sum((1, 2)).max()
    if light_e <= 0:
        raise FitError(
            "no light above the background in the window; check center and window"
        )
    groups = model.unpack(x)
    pixel_um = model.spec.pixel_um
    groups["background"][:] = background_e
    groups["gain"][:] = math.log(light_e)
    groups["blur"][:] = 0.5 * pixel_um
    groups["drift_y"][0], groups["drift_x"][0] = np.array(bead) * pixel_um
    return x


def fit_optics(
    model: PupilModel, data: FitImages, mean: Array, every: int
) -> tuple[PupilModel, Optics]:
    """Model with the fitted values of the optics named by ``spec.free``, and (name,
    value, standard error) of each.

    The fit uses every n-th plane and low orders of the pupil. Where the images fix
    products only (aperture times pixel, say), the priors about the stated values
    decide. Standard errors are widened by sqrt(chi² / dof) where that is above 1.

    Args:
        model: model with the stated values.
        data: all planes of ``model``.
        mean: (p,) mean of the prior.
        every: the fit takes planes 0, every, 2 every, ...
    """
    spec = model.spec
    if not spec.free:
        return model, ()
    low_spec = _lower(spec, 6, 2)
    planes = np.arange(0, len(model.position_um), every)
    low_model = PupilModel(low_spec, model.position_um[planes])
    low_mean = transfer_parameters(mean, model, low_model)
    low_data = data.planes(planes)
    start = fit_low_orders(low_model, low_data, low_mean)
    solution = maximize_likelihood(
        low_model, low_data, start, low_mean, iterations=40, step=0.1
    )
    optics, position_um = low_model.optics_at(solution.value)
    stage_factor = float(np.ptp(position_um) / np.ptp(low_model.position_um))
    step_um = stage_factor * float(np.abs(np.diff(model.position_um)).mean())
    covariance = solution.covariance * max(1.0, solution.chi2_per_dof)
    sigma = low_model.unpack(np.sqrt(np.diag(covariance)))["optics"].tolist()
    values = [
        step_um if quantity == "step_um" else getattr(optics, quantity)
        for quantity in spec.free
    ]
    fitted = zip(spec.free, values, sigma, strict=True)
    fitted_spec = replace(
        optics,
        free=(),
        stage_sigma_um=model.stage_sigma_um,
        model=spec.model,
        phase_order=spec.phase_order,
        amplitude_order=spec.amplitude_order,
    )
    return PupilModel(fitted_spec, stage_factor * model.position_um), tuple(
        (name, value, value * relative) for name, value, relative in fitted
    )


def score_held_out(
    model: PupilModel, data: FitImages, mean: Array, every: int
) -> tuple[Array, StackAgreement]:
    """Agreement of held-out planes with a fit of the others.

    The stage is taken as exact here: stage errors of held-out planes are unknown.

    Args:
        model: of all planes.
        data: all planes.
        mean: (p,) mean of the prior of ``model``.
        every: distance of the fitted planes; the last plane is fitted too.

    Returns:
        (p,) parameters of ``model`` to start from, score of the held-out planes.
    """
    planes = np.arange(len(data.electrons))
    fitted = np.union1d(planes[::every], planes[-1])
    hidden = np.setdiff1d(planes, fitted)
    exact = replace(model.spec, stage_sigma_um=0.0)
    part_model = PupilModel(exact, model.position_um[fitted])
    fitted_data = data.planes(fitted)
    part_mean = transfer_parameters(mean, model, part_model)
    start = fit_low_orders(part_model, fitted_data, part_mean)
    solution = maximize_likelihood(part_model, fitted_data, start, part_mean)
    value = transfer_parameters(solution.value, part_model, model)
    predicted = model.images(value, False)[0][hidden]
    background = model.background(value)[hidden]
    return value, measure_agreement(predicted, data.planes(hidden), background)


def fit_low_orders(model: PupilModel, data: FitImages, mean: Array) -> Array:
    """(p,) start of a fit: the most likely of three fits of radial order 4, started at
    spherical aberrations of 0, 0.8 and -0.8 rad.

    Args:
        model: model of all orders.
        data: its planes.
        mean: (p,) parameters to start from, and mean of the prior.
    """
    low = PupilModel(replace(_lower(model.spec, 4, 0), free=()), model.position_um)
    low_mean = transfer_parameters(mean, model, low)
    solutions = []
    for spherical_rad in (0.0, 0.8, -0.8):
        start = low_mean.copy()
        start[low.phase_indices.index((4, 0))] = spherical_rad
        solutions.append(maximize_likelihood(low, data, start, low_mean, iterations=12))
    best = min(solutions, key=lambda solution: solution.merit)
    return transfer_parameters(best.value, low, model)


def _lower(spec: PupilSpec, phase_order: int, amplitude_order: int) -> PupilSpec:
    """The specification with Zernike orders of at most ``phase_order`` and
    ``amplitude_order``.
    """
    return replace(
        spec,
        phase_order=min(spec.phase_order, phase_order),
        amplitude_order=min(spec.amplitude_order, amplitude_order),
    )


def transfer_parameters(x: Array, source: PupilModel, target: PupilModel) -> Array:
    """(p,) parameters of ``target`` that describe the same pupil as ``x`` of
    ``source``.

    Gains and backgrounds are interpolated along the axis. Orders and stage errors that
    ``source`` lacks are 0.

    Args:
        x: parameters of ``source``.
        source: model of the same stack.
        target: model of nested orders, over the same range of planes.
    """
    order = np.argsort(source.position_um)
    result = np.zeros(sum(target.sizes.values()))
    groups = target.unpack(result)
    for name, values in source.unpack(x).items():
        if name in ("gain", "background"):
            source_um = source.position_um[order]
            groups[name][:] = np.interp(target.position_um, source_um, values[order])
        else:
            count = min(len(values), target.sizes[name])
            groups[name][:count] = values[:count]
    return result


def maximize_likelihood(
    model: PupilModel,
    data: FitImages,
    start: Array,
    mean: Array,
    *,
    iterations: int = 60,
    step: float = 1.0,
) -> FitSolution:
    """Levenberg-Marquardt fit of a pupil with Gaussian priors and bounds.

    Prior standard deviations: phase of order n, 3 min(1, 4 / n)³ rad; log-amplitude of
    order n, 0.5 / n; log-gain, 0.3; drift, 10 pixels; optics, :data:`RELATIVE_PRIOR`.

    Args:
        model: expected images and their derivatives.
        data: measured planes.
        start: (p,) parameters to start from.
        mean: (p,) mean of the prior.
        iterations: largest number of iterations.
        step: the fit stops at steps of fewer standard errors.
    """
    spec = model.spec
    sigma = np.full(len(start), np.inf)
    lower = np.full(len(start), -np.inf)
    upper = np.full(len(start), np.inf)
    sigma_of, lower_of, upper_of = (
        model.unpack(vector) for vector in (sigma, lower, upper)
    )
    sigma_of["phase"][:] = [3.0 * min(1.0, 4 / n) ** 3 for n, _ in model.phase_indices]
    sigma_of["amplitude"][:] = [0.5 / n for n, _ in model.amplitude_indices]
    sigma_of["drift_x"][:] = sigma_of["drift_y"][:] = 10 * spec.pixel_um
    if model.sizes["stage"]:
        sigma_of["stage"][:] = model.stage_sigma_um
    sigma_of["gain"][:] = 0.3
    sigma_of["optics"][:] = [RELATIVE_PRIOR[name] for name in spec.free]
    # the derivative by the blur vanishes at 0
    lower_of["blur"][:] = 0.05 * spec.pixel_um
    upper_of["blur"][:] = 4 * spec.pixel_um
    lower_of["optics"][:] = -0.3
    upper_of["optics"][:] = 0.3
    settings = SolverSettings(iterations=iterations, step_tolerance=step, near=2.0)
    prior = GaussianPrior(mean, sigma, lower, upper)
    return FitProblem(model.images, data, prior).fit(start, settings)


def describe_limits(
    spec: PupilSpec, solution: FitSolution, optics: Optics
) -> list[str]:
    """Sentences on the fitted optics, the degeneracies and the misfit of a fit.

    Args:
        spec: specification before the optics were fitted.
        solution: the fit.
        optics: (name, value, standard error) of the fitted optics.
    """
    words = []
    for name, value, sigma in optics:
        stated = getattr(spec, name)
        stated_text = f", stated {stated:.4g}" if math.isfinite(stated) else ""
        words.append(f"{name} = {value:.4g} +- {sigma:.2g} was fitted{stated_text}")
    words += [
        "the images cannot tell the direction of the stage: a reversed stack gives the "
        "phase turned by 180 degrees with the other sign",
        "stage zero and the defocus term are one quantity; lateral position and tilt "
        "are one quantity",
    ]
    if solution.chi2_per_dof > 1.5:
        words.append(
            f"chi-square per degree of freedom is {solution.chi2_per_dof:.2f}: the "
            "images hold more than this model; errors are widened by its root"
        )
    if not spec.bead_um:
        words.append("no bead size given: it is part of the fitted blur")
    return words
