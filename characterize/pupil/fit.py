"""Maximum-likelihood phase retrieval from a through-focus stack, scored on planes that
the fit never saw.
"""

import dataclasses
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from characterize.captures import ElectronFrames, to_electrons
from characterize.captures.capture import Capture
from characterize.inference import (
    FitImages,
    FitSolution,
    GaussianPrior,
    SolverSettings,
    leastsquares,
)
from characterize.pupil.model import RELATIVE_PRIOR, PupilModel, PupilSpec
from characterize.pupil.score import (
    StackAgreement,
    measure_agreement,
    predict_by_splines,
    pupil_problems,
)
from metalens.core import config, store
from metalens.core.arrays import Array
from metalens.core.errors import CaptureError, FitError, FitRefused

_STORED = (
    "value",
    "sigma",
    "position_um",
    "measured",
    "predicted",
    "residual_sigma",
    "phase_rad",
    "amplitude",
)
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
    between: of the same planes by a cubic spline along the stack, without physics.
    optics: (name, value, standard error) of what was freed.
    cautions: degeneracies and corrections in words. problems: checks that failed, with
    their cause.
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
    between: StackAgreement | None
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
    """Fit phase, amplitude, drift, stage errors, blur, gains and backgrounds to all
    planes; with ``judge`` also to some of them, tested on the others.

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
    stated, frames = complete_spec(spec, capture), to_electrons(capture)
    position_um = stage_positions_um(capture, stated)
    data, bead = crop_to_bead(frames, stated)
    whole = PupilModel(stated, position_um)
    mean = initial_parameters(whole, data, bead)
    enough = judge and len(position_um) > 2 * sparse
    model, optics = fit_optics(whole, data, mean, sparse if enough else 1)
    mean = transfer_parameters(mean, whole, model)

    held_out = between = None
    if enough:
        start, held_out, between = score_held_out(model, data, mean, sparse)
    else:
        start = fit_low_orders(model, data, mean)
    solution = maximize_likelihood(model, data, start, mean)
    agreement = measure_agreement(
        solution.image, data, model.background(solution.value)
    )
    stopped = "" if solution.converged else solution.reason
    problems = pupil_problems(held_out or agreement, stopped)
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
        between=between,
        optics=optics,
        chi2_per_dof=solution.chi2_per_dof,
        converged=solution.converged,
        reason=solution.reason,
        cautions=(*frames.corrections, *describe_limits(stated, solution, optics)),
        problems=tuple(problems),
    )


def save(
    path: str | Path, fit: PupilFit, provenance: store.Provenance | None = None
) -> None:
    """Write a pupil file (HDF5, kind ``pupil``).

    Args:
        path: the file to write.
        fit: the fitted pupil.
        provenance: inputs and settings, for the record.
    """
    arrays = {name: getattr(fit, name) for name in _STORED}
    for name in ("names", "cautions", "problems"):
        arrays[name] = np.array(getattr(fit, name) or ("",))
    known = [n for n in config.dumps(fit.spec).splitlines() if not n.endswith("nan")]
    about: dict[str, store.Attribute] = {
        "spec": "\n".join(known) + "\n",
        "chi2_per_dof": fit.chi2_per_dof,
        "converged": fit.converged,
        "reason": fit.reason,
    }
    about |= {f"fitted_{name}": value for name, value, _ in fit.optics}
    for label in ("agreement", "held_out", "between"):
        score = getattr(fit, label)
        if score is not None:
            entries = dataclasses.asdict(score).items()
            about |= {f"{label}_{key}": value for key, value in entries}
    store.save(path, "pupil", arrays, attributes=about, provenance=provenance)


def complete_spec(spec: PupilSpec, capture: Capture) -> PupilSpec:
    """Wavelength and pixel from the capture where not stated; a window no larger than
    the frame.

    Args:
        spec: as given.
        capture: the stack with its metadata.

    Raises:
        CaptureError: neither of them states the wavelength or the pixel.
    """
    found = {}
    for name in ("wavelength_um", "pixel_um"):
        value = getattr(spec, name)
        found[name] = getattr(capture, name) if math.isnan(value) else value
        if math.isnan(found[name]):
            raise CaptureError(
                f"{name} is missing: give it in the pupil file or in capture.toml; it "
                "cannot be fitted"
            )
    window = min(spec.window, *capture.frames.shape[1:])
    return replace(spec, window=window, **found)


def stage_positions_um(capture: Capture, spec: PupilSpec) -> Array:
    """(n,) stage positions from the sharpest plane: of the capture, or by ``step_um``.

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
    """Square region of interest about the bead, moved inwards at the edges of the
    frame; the bead's (row, column) from the middle of it.

    The brightest spot of a difference of Gaussians is the bead, which no background
    gradient moves.

    Args:
        frames: the whole stack in electrons.
        spec: gives the side of the window and, where stated, the bead's place.
    """
    shape, window = frames.electrons.shape, spec.window
    center = spec.center
    if center is None:
        middle = np.median(frames.electrons, axis=(1, 2), keepdims=True)
        filled = np.where(frames.usable, frames.electrons, middle)
        spot = ndimage.gaussian_filter(filled, (0, 1, 1))
        spot -= ndimage.gaussian_filter(filled, (0, window / 4, window / 4))
        bright = np.sort(spot, axis=0)[-3:].mean(0)
        row, column = np.unravel_index(int(bright.argmax()), bright.shape)
        center = int(row), int(column)
    half = window // 2
    first = np.clip(np.subtract(center, half), 0, np.subtract(shape[1:], window))
    top, left = first.tolist()
    cut = (slice(None), slice(top, top + window), slice(left, left + window))
    electrons, usable, saturated, variance_e2, scale = (
        np.broadcast_to(getattr(frames, name), shape)[cut]
        for name in ("electrons", "usable", "saturated", "variance_e2", "scale")
    )
    data = FitImages(electrons, usable, saturated, variance_e2, scale, spec.model_error)
    return data, (center[0] - half - top, center[1] - half - left)


def initial_parameters(
    model: PupilModel, data: FitImages, bead: tuple[int, int]
) -> Array:
    """(p,) parameters: unaberrated pupil, blur of half a pixel, light and background of
    the data.

    Args:
        model: gives the parameter vector.
        data: region of interest.
        bead: (row, column) of the bead from the middle of the window.

    Raises:
        FitError: no light above the background.
    """
    x = np.zeros(sum(model.sizes.values()))
    level = np.percentile(data.electrons, 20, axis=(1, 2))
    light = (data.electrons - level[:, None, None]).sum((1, 2)).max()
    if light <= 0:
        raise FitError(
            "no light above the background in the window; check center and window"
        )
    parts, pixel_um = model.unpack(x), model.spec.pixel_um
    parts["background"][:], parts["gain"][:] = level, math.log(light)
    parts["blur"][:] = 0.5 * pixel_um
    parts["drift_y"][0], parts["drift_x"][0] = np.array(bead) * pixel_um
    return x


def fit_optics(
    model: PupilModel, data: FitImages, mean: Array, every: int
) -> tuple[PupilModel, Optics]:
    """Model with the optics that ``spec.free`` names, fitted with low orders of the
    pupil; (name, value, standard error) of each.

    Where the images fix products only (aperture times pixel, say), the priors about the
    stated values decide.

    Args:
        model: with the stated values.
        data: its planes.
        mean: (p,) mean of the prior.
        every: distance of the planes that are used: the others judge it too.
    """
    spec = model.spec
    if not spec.free:
        return model, ()
    low = _lower(spec, 6, 2)
    planes = np.arange(0, len(model.position_um), every)
    part = PupilModel(low, model.position_um[planes])
    part_mean = transfer_parameters(mean, model, part)
    some = data.planes(planes)
    start = fit_low_orders(part, some, part_mean)
    found = maximize_likelihood(part, some, start, part_mean, iterations=40, step=0.1)
    optics, position_um = part.optics_at(found.value)
    longer = float(np.ptp(position_um) / np.ptp(part.position_um))
    step_um = longer * float(np.abs(np.diff(model.position_um)).mean())
    widened = found.covariance * max(1.0, found.chi2_per_dof)
    sigma = part.unpack(np.sqrt(np.diag(widened)))["optics"].tolist()
    values = [step_um if n == "step_um" else getattr(optics, n) for n in spec.free]
    fitted = zip(spec.free, values, sigma, strict=True)
    orders = {n: getattr(spec, n) for n in ("phase_order", "amplitude_order")}
    known = replace(
        optics, free=(), stage_sigma_um=model.stage_sigma_um, model=spec.model, **orders
    )
    return PupilModel(known, longer * model.position_um), tuple(
        (name, value, value * relative) for name, value, relative in fitted
    )


def score_held_out(
    model: PupilModel, data: FitImages, mean: Array, every: int
) -> tuple[Array, StackAgreement, StackAgreement]:
    """Fit every n-th plane, predict the planes between, compare with a cubic spline
    through the same planes.

    The stage is taken as exact here, as stage errors of planes left out are unknown.

    Args:
        model: of all planes.
        data: all planes.
        mean: (p,) mean of the prior of ``model``.
        every: distance of the fitted planes; the last plane is fitted too.

    Returns:
        (p,) parameters of ``model`` to start from, score of the pupil, of the spline.
    """
    planes = np.arange(len(data.electrons))
    fitted = np.union1d(planes[::every], planes[-1])
    hidden = np.setdiff1d(planes, fitted)
    exact = replace(model.spec, stage_sigma_um=0.0)
    part = PupilModel(exact, model.position_um[fitted])
    some = data.planes(fitted)
    part_mean = transfer_parameters(mean, model, part)
    start = fit_low_orders(part, some, part_mean)
    solution = maximize_likelihood(part, some, start, part_mean)
    value = transfer_parameters(solution.value, part, model)
    background = model.background(value)[hidden]
    rest = data.planes(hidden)
    spline = predict_by_splines(model.position_um, data, fitted, hidden)
    pupil = model.images(value, False)[0][hidden]
    return (
        value,
        measure_agreement(pupil, rest, background),
        measure_agreement(spline, rest, background),
    )


def fit_low_orders(model: PupilModel, data: FitImages, mean: Array) -> Array:
    """(p,) start of a fit: the best of three fits of radial order 4, begun at spherical
    aberrations of 0, 0.8 and -0.8 rad.

    Args:
        model: of all orders.
        data: its planes.
        mean: (p,) parameters to begin with, mean of the prior.
    """
    low = PupilModel(replace(_lower(model.spec, 4, 0), free=()), model.position_um)
    low_mean, solutions = transfer_parameters(mean, model, low), []
    for spherical_rad in (0.0, 0.8, -0.8):
        start = low_mean.copy()
        start[low.phase_indices.index((4, 0))] = spherical_rad
        solutions.append(maximize_likelihood(low, data, start, low_mean, iterations=12))
    best = min(solutions, key=lambda solution: solution.merit)
    return transfer_parameters(best.value, low, model)


def _lower(spec: PupilSpec, phase: int, amplitude: int) -> PupilSpec:
    """The specification with orders of at most so much."""
    return replace(
        spec,
        phase_order=min(spec.phase_order, phase),
        amplitude_order=min(spec.amplitude_order, amplitude),
    )


def transfer_parameters(x: Array, source: PupilModel, target: PupilModel) -> Array:
    """(p,) parameters for a model of other orders, planes or optics: gains and
    backgrounds interpolated along the axis, new orders and stage errors 0.

    Args:
        x: parameters of ``source``.
        source: model of the same stack.
        target: model of nested orders, over the same range of planes.
    """
    order = np.argsort(source.position_um)
    out = np.zeros(sum(target.sizes.values()))
    into = target.unpack(out)
    for name, values in source.unpack(x).items():
        if name in ("gain", "background"):
            place, along = target.position_um, source.position_um[order]
            into[name][:] = np.interp(place, along, values[order])
        else:
            count = min(len(values), target.sizes[name])
            into[name][:count] = values[:count]
    return out


def maximize_likelihood(
    model: PupilModel,
    data: FitImages,
    start: Array,
    mean: Array,
    *,
    iterations: int = 60,
    step: float = 1.0,
) -> FitSolution:
    """Levenberg-Marquardt with Gaussian priors: smooth pupils, gains within 30 %.

    Args:
        model: images and derivatives.
        data: measured planes.
        start: (p,) parameters.
        mean: (p,) mean of the prior.
        iterations: at most.
        step: standard errors of a step at which it stops.
    """
    width, spec = np.full(len(start), np.inf), model.spec
    low = np.full(len(start), -np.inf)
    high = np.full(len(start), np.inf)
    sigma, least, most = (model.unpack(one) for one in (width, low, high))
    sigma["phase"][:] = [3.0 * min(1.0, 4 / n) ** 3 for n, _ in model.phase_indices]
    sigma["amplitude"][:] = [0.5 / n for n, _ in model.amplitude_indices]
    sigma["drift_x"][:] = sigma["drift_y"][:] = 10 * spec.pixel_um
    if model.sizes["stage"]:
        sigma["stage"][:] = model.stage_sigma_um
    sigma["gain"][:] = 0.3
    sigma["optics"][:] = [RELATIVE_PRIOR[name] for name in spec.free]
    # the derivative by the blur vanishes at 0
    least["blur"][:], most["blur"][:] = 0.05 * spec.pixel_um, 4 * spec.pixel_um
    least["optics"][:], most["optics"][:] = -0.3, 0.3
    settings = SolverSettings(
        iterations=iterations, step_tolerance=step, near=2.0, secant=True
    )
    return leastsquares.fit_levenberg_marquardt(
        model.images,
        data,
        start,
        prior=GaussianPrior(mean, width, low, high),
        settings=settings,
    )


def describe_limits(
    spec: PupilSpec, solution: FitSolution, optics: Optics
) -> list[str]:
    """Degeneracies and misfits of a fit in words.

    Args:
        spec: as stated.
        solution: the fit.
        optics: fitted optics.
    """
    words = []
    for name, value, sigma in optics:
        before = getattr(spec, name)
        given = f", stated {before:.4g}" if math.isfinite(before) else ""
        words.append(f"{name} = {value:.4g} +- {sigma:.2g} was fitted{given}")
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
