"""Fit of a generic pupil to a through-focus stack, judged on planes that the fit never
saw.
"""

import dataclasses
import functools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from characterize.captures import ElectronFrames, to_electrons
from characterize.captures import capture as captures
from characterize.inference import (
    FitImages,
    FitSolution,
    GaussianPrior,
    SolverSettings,
    leastsquares,
)
from characterize.pupil import check as pupilcheck
from characterize.pupil.free import Optics, fit_free_settings, freed_text
from characterize.pupil.judge import (
    StackAgreement,
    measure_agreement,
    predict_by_splines,
)
from characterize.pupil.record import PupilModel, PupilSpec, stage_sigma_um
from metalens.core import config, store
from metalens.core.arrays import Array
from metalens.core.errors import FitError, FitRefused


@dataclass(frozen=True, eq=False, slots=True)
class PupilFit:
    """The pupil that explains a stack.

    names, value, sigma: parameters with 1 sigma intervals (widened where chi2_per_dof
    is above 1).
    measured, predicted: (n, y, x) windows in electrons; every plane of ``predicted`` by
    the fit of all planes.
    phase_rad, amplitude: (nodes, nodes) pupil maps, nan and 0 outside the aperture.
    held_out: agreement on planes left out, predicted from a fit of the others, or None
    where not judged.
    between: the same of a cubic spline along the stack through the planes that were
    fitted, pixel by pixel.
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
    optics: tuple[tuple[str, float, float], ...]
    chi2_per_dof: float
    converged: bool
    reason: str
    cautions: tuple[str, ...]
    problems: tuple[str, ...] = ()


def fit_pupil(
    capture: captures.Capture,
    spec: PupilSpec,
    *,
    judge: bool = True,
    sparse: int = 2,
    insist: bool = False,
) -> PupilFit:
    """Fit phase, amplitude, drift, blur, gains and backgrounds; with ``judge`` also of
    some planes, tested on others.

    Args:
        capture: frames in counts.
        spec: what is known of optics and stage.
        sparse: of which planes alone: every second, third ...
        insist: return a pupil that fails its checks (problems filled) instead of
            refusing it.

    Raises:
        CaptureError: wavelength, pixel or stage positions unknown.
        FitError: too few planes, no bead, or refused: no convergence, planes out of
            order, predictions too poor.
    """
    spec, frames = _complete(spec, capture), to_electrons(capture)
    position = _positions(capture, spec)
    stated = dataclasses.replace(spec, stage_sigma_um=stage_sigma_um(spec, position))
    data, background, notes = _crop(frames, stated)
    spec, position, optics = _freed(stated, position, data, sparse if judge else 1)
    held_out, between, start = _judge(
        spec, position, data, background, sparse if judge else len(position)
    )
    model, solution = _fit(spec, position, data, start)
    phase, amplitude = _maps(model, solution.value)
    agreement = measure_agreement(solution.image, data, background)
    stopped = "" if solution.converged else solution.reason
    score = held_out or agreement
    share = pupilcheck.unexplained_share(score.nrmse, data, background)
    problems = pupilcheck.pupil_problems(data, score.ncc, share, stopped)
    notes += pupilcheck.pupil_warnings(share, stopped)
    if problems and not insist:
        raise FitRefused("fit refused: " + "; ".join(problems))
    return PupilFit(
        spec=spec,
        names=tuple(model.names()),
        value=solution.value,
        sigma=np.sqrt(np.diag(solution.covariance) * max(1.0, solution.chi2_per_dof)),
        position_um=position,
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
        cautions=(
            *frames.corrections,
            *notes,
            *freed_text(stated, optics),
            *_cautions(spec, solution),
        ),
        problems=tuple(problems),
    )


def save(
    path: str | Path, fit: PupilFit, provenance: store.Provenance | None = None
) -> None:
    """Write a pupil file (kind ``pupil``).

    Args:
        path: the file to write.
        fit: the fitted pupil.
        provenance: inputs and settings, for the record.
    """
    arrays = {
        key: getattr(fit, key)
        for key in (
            "value",
            "sigma",
            "position_um",
            "measured",
            "predicted",
            "residual_sigma",
            "phase_rad",
            "amplitude",
        )
    }
    arrays |= {
        "names": np.array(fit.names),
        "cautions": np.array(fit.cautions),
        "problems": np.array(fit.problems or ("",)),
    }
    about: dict[str, store.Attribute] = {
        "spec": _spec_text(fit.spec),
        "chi2_per_dof": fit.chi2_per_dof,
        "converged": fit.converged,
        "reason": fit.reason,
    }
    about |= {f"fitted_{name}": value for name, value, _ in fit.optics}
    for label, score in (
        ("agreement", fit.agreement),
        ("held_out", fit.held_out),
        ("between", fit.between),
    ):
        if score is not None:
            about |= {
                f"{label}_{key}": value
                for key, value in dataclasses.asdict(score).items()
            }
    store.save(path, "pupil", arrays, attributes=about, provenance=provenance)


def _spec_text(spec: PupilSpec) -> str:
    return (
        "\n".join(
            line for line in config.dumps(spec).splitlines() if not line.endswith("nan")
        )
        + "\n"
    )


def _complete(spec: PupilSpec, capture: captures.Capture) -> PupilSpec:
    wave = (
        capture.wavelength_um if math.isnan(spec.wavelength_um) else spec.wavelength_um
    )
    pixel = capture.pixel_um if math.isnan(spec.pixel_um) else spec.pixel_um
    window = min(spec.window, *capture.frames.shape[1:])
    return dataclasses.replace(spec, wavelength_um=wave, pixel_um=pixel, window=window)


def _positions(capture: captures.Capture, spec: PupilSpec) -> Array:
    """Stage positions about the sharpest plane, from the capture or from step_um."""
    if len(capture.frames) < 3:
        raise FitError(
            f"{len(capture.frames)} planes: a pupil needs three or more through focus"
        )
    stated = capture.position_um
    if not math.isnan(spec.step_um) or not np.isfinite(stated).all():
        stated = np.arange(len(capture.frames)) * spec.step_um
    frames = np.asarray(capture.frames, float)
    sharp = frames.max((1, 2)) - np.median(frames, axis=(1, 2))
    weight = np.maximum(sharp - 0.5 * sharp.max(), 0)
    return np.asarray(stated - (weight * stated).sum() / weight.sum())


def _crop(
    frames: ElectronFrames, spec: PupilSpec
) -> tuple[FitImages, float, list[str]]:
    """The window about the bead, moved inwards where it would reach over the edge; the
    background level; notes.
    """
    total = np.where(frames.usable, frames.electrons, np.nan)
    background = float(np.nanmedian(total))
    row, column = spec.center or _find(total - _plane(total) - background)
    sides = zip((row, column), total.shape[1:], strict=True)
    first = [
        int(np.clip(place - spec.window // 2, 0, side - spec.window))
        for place, side in sides
    ]
    notes = []
    if first != [row - spec.window // 2, column - spec.window // 2]:
        notes.append(
            f"the bead at row {row}, column {column} is near the edge: the window is not centred on it"
        )
    cut = (slice(None), *(slice(f, f + spec.window) for f in first))
    floor, scale = (
        np.broadcast_to(a, total.shape)[cut] for a in (frames.variance_e2, frames.scale)
    )
    plane = _plane(total[cut])
    seen = total[cut] - background
    if np.ptp(plane) > 0.02 * np.nanmax(seen):
        background = float(np.nanpercentile(total[cut] - plane, 20))
        notes.append(
            f"a background plane of {np.ptp(plane):.3g} e across the window was taken off"
        )
    else:
        plane = np.zeros_like(plane)
    electrons = frames.electrons[cut] - plane
    data = FitImages(
        electrons,
        frames.usable[cut],
        frames.saturated[cut],
        floor,
        scale,
        spec.model_error,
    )
    return data, background, notes


def _plane(frames: Array) -> Array:
    """(y, x) tilt of the background, of mean 0: least squares on the rim of the median
    plane, without its outliers.
    """
    bad = np.isnan(frames).all(0)
    level = np.where(bad, np.nan, np.nanmedian(np.where(bad, 0, frames), axis=0))
    ny, nx = level.shape
    y, x = np.mgrid[-1 : 1 : ny * 1j, -1 : 1 : nx * 1j]
    rim = np.isfinite(level) & ((np.abs(x) > 0.8) | (np.abs(y) > 0.8))
    design = np.stack([np.ones(ny * nx), x.ravel(), y.ravel()], 1)
    keep = rim.ravel()
    for _ in range(3):
        found = np.linalg.lstsq(design[keep], level.ravel()[keep], rcond=None)[0]
        rest = level.ravel() - design @ found
        spread = 1.4826 * np.median(np.abs(rest[keep]))
        keep = rim.ravel() & (np.abs(rest) <= 3 * max(spread, 1e-9))
    return np.asarray(found[1] * x + found[2] * y)


def _find(light: Array) -> tuple[int, int]:
    """Row and column of the light's centre in the brightest planes; ``light`` (n, y, x)
    is nan where masked.
    """
    light = np.nan_to_num(light)
    peak = np.sort(ndimage.gaussian_filter(light, (0, 1, 1)), axis=0)[-3:].mean(0)
    row, column = (int(i) for i in np.unravel_index(int(peak.argmax()), peak.shape))
    return row, column


def _freed(
    spec: PupilSpec, position: Array, data: FitImages, sparse: int
) -> tuple[PupilSpec, Array, Optics]:
    """What is free, from every ``sparse``-th plane, so that the others judge it too."""
    seen = np.arange(0, len(position), sparse if len(position) >= 2 * sparse + 1 else 1)
    part, planes = position[seen], data.planes(seen)
    coarse = functools.partial(_coarse, spec, part, planes)
    made, optics, longer = fit_free_settings(
        spec, part, planes, coarse, step_um=float(np.abs(np.diff(position)).mean())
    )
    return made, longer * position, optics


def _judge(
    spec: PupilSpec, position: Array, data: FitImages, background: float, sparse: int
) -> tuple[StackAgreement | None, StackAgreement | None, Array | None]:
    """Every ``sparse``-th plane fitted, the others predicted, by the pupil and by a
    spline through the same planes.

    Gains and backgrounds between neighbours, drift from its polynomial; all planes
    where they are stated, as it is not
    seen how far those left out stand off. Also the parameters of all planes so found,
    where a fit of all of them
    starts. Nothing of too few planes.
    """
    if len(position) < 2 * sparse + 1:
        return None, None, None
    seen = np.arange(0, len(position), sparse)
    hidden = np.setdiff1d(np.arange(seen[-1]), seen)
    exact = dataclasses.replace(spec, stage_sigma_um=0.0)
    fitted, solution = _fit(exact, position[seen], data.planes(seen))
    model = PupilModel(
        exact,
        position,
        phase_order=spec.phase_order,
        amplitude_order=spec.amplitude_order,
    )
    model.span_um = fitted.span_um
    shared = fitted.layout().size - 2 * len(seen)
    order = np.argsort(position[seen])
    gain, level = (
        np.interp(
            position,
            position[seen][order],
            solution.value[shared + k * len(seen) :][: len(seen)][order],
        )
        for k in (0, 1)
    )
    x = np.concatenate([solution.value[:shared], gain, level])
    predicted, rest = model.images(x, False)[0][hidden], data.planes(hidden)
    start = np.insert(
        x,
        fitted.layout().off.start,
        np.zeros(len(position) if spec.stage_sigma_um > 0 else 0),
    )
    between = predict_by_splines(position, data, seen, hidden)
    return (
        measure_agreement(predicted, rest, background),
        measure_agreement(between, rest, background),
        start,
    )


def _fit(
    spec: PupilSpec, position: Array, data: FitImages, start: Array | None = None
) -> tuple[PupilModel, FitSolution]:
    """Low orders from several starts, the best one on to all orders; all orders at once
    from a known ``start``.
    """
    model = PupilModel(
        spec,
        position,
        phase_order=spec.phase_order,
        amplitude_order=spec.amplitude_order,
    )
    if start is None:
        start = _coarse(spec, position, data, model)
    settings = SolverSettings(iterations=60, step_tolerance=1.0, near=2.0, secant=True)
    return model, leastsquares.fit_levenberg_marquardt(
        model.images, data, start, prior=_prior(model, start), settings=settings
    )


def _coarse(
    spec: PupilSpec, position: Array, data: FitImages, model: PupilModel
) -> Array:
    coarse = PupilModel(spec, position, phase_order=4, amplitude_order=0)
    starts = [_start(coarse, data, spherical) for spherical in (0.0, 0.8, -0.8)]
    settings = SolverSettings(
        iterations=12, step_tolerance=1.0, near=1.0, secant=True, finish=False
    )
    tries = [
        leastsquares.fit_levenberg_marquardt(
            coarse.images, data, s, prior=_prior(coarse, s), settings=settings
        )
        for s in starts
    ]
    return _grow(min(tries, key=lambda t: t.merit).value, coarse, model)


def _start(model: PupilModel, data: FitImages, spherical: float) -> Array:
    layout = model.layout()
    x = np.zeros(layout.size)
    x[model.phase_indices.index((4, 0))] = spherical
    x[layout.size - 2 * layout.frames - 1] = 0.5 * model.spec.pixel_um
    shift = _offset(data) * model.spec.pixel_um
    first = layout.phase + layout.amplitude
    x[[first, first + layout.drift]] = shift[::-1]
    edge = np.concatenate([data.electrons[:, 0], data.electrons[:, -1]], axis=1)
    level = np.percentile(edge, 20, axis=1)
    light = (data.electrons - level[:, None, None]).sum((1, 2)).max()
    if light <= 0:
        raise FitError(
            "no light above the background in the window; check center and window"
        )
    x[-2 * layout.frames : -layout.frames] = math.log(light)
    x[-layout.frames :] = level
    return x


def _offset(data: FitImages) -> Array:
    """(y, x) pixels from the window's centre to the bead, where it is more than a
    quarter of the window; else 0.
    """
    light = np.where(data.usable, data.electrons, np.nanmedian(data.electrons))
    peak = ndimage.gaussian_filter(light, (0, 1, 1)).max(0)
    place = (
        np.array(np.unravel_index(int(peak.argmax()), peak.shape))
        - np.array(peak.shape) // 2
    )
    return np.asarray(place * (np.abs(place).max() > peak.shape[0] / 8), float)


def _grow(value: Array, small: PupilModel, large: PupilModel) -> Array:
    """Parameters of the larger model with the added orders at zero."""
    a, b = small.layout(), large.layout()
    phase, amplitude, *_ = a.split(value)
    add = np.zeros(b.phase - len(phase)), np.zeros(b.amplitude - len(amplitude))
    return np.concatenate(
        [phase, add[0], amplitude, add[1], value[a.phase + a.amplitude :]]
    )


def _prior(model: PupilModel, start: Array) -> GaussianPrior:
    """Smoothness: coefficients of higher orders are smaller; gains of frames scatter by
    30 % about their start.
    """
    layout = model.layout()
    sigma = np.full(layout.size, np.inf)
    sigma[: layout.phase] = [3.0 * min(1.0, 4 / n) ** 3 for n, _ in model.phase_indices]
    sigma[layout.phase :][: layout.amplitude] = [
        0.5 / n for n, _ in model.amplitude_indices
    ]
    blur = layout.size - 2 * layout.frames - 1
    drift = slice(layout.phase + layout.amplitude, layout.off.start)
    sigma[drift], sigma[layout.off] = 10 * model.spec.pixel_um, model.stage_sigma_um
    mean = np.zeros(layout.size)
    mean[drift] = start[drift]
    mean[blur:] = start[blur:]
    sigma[blur + 1 :][: layout.frames] = 0.3
    low, high = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
    low[blur], high[blur] = 0.05 * model.spec.pixel_um, 4 * model.spec.pixel_um
    return GaussianPrior(mean, sigma, low, high)


def _maps(model: PupilModel, value: Array) -> tuple[Array, Array]:
    phase, amplitude, *_ = model.layout().split(value)
    shape = (model.nodes, model.nodes)
    angle, level = np.full(shape, np.nan), np.zeros(shape)
    angle[model.inside] = phase @ model.phase_basis
    level[model.inside] = np.exp(amplitude @ model.amplitude_basis)
    return angle, level


def _cautions(spec: PupilSpec, solution: FitSolution) -> list[str]:
    words = [
        "reversing the stack turns the phase by 180 degrees about the axis and flips its sign: the order of the stage "
        "cannot be seen in the images alone",
        "stage zero and the defocus term are one quantity; sideways position and tilt are one quantity",
    ]
    if solution.chi2_per_dof > 1.5:
        words.append(
            f"chi-square per degree of freedom is {solution.chi2_per_dof:.2f}: the images hold more than this model; "
            "intervals are widened by its root"
        )
    if not spec.bead_um:
        words.append("no bead size given: it is part of the fitted blur")
    return words
