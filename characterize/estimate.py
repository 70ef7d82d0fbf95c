"""Bench captures and a design to the lens that was made: maximum likelihood from several starts, checked, explained."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from characterize import knowable, leastsquares, made, residual, thinplate
from characterize.arrange import MIRRORED, TURNS, Arrangement, arrange, rearranged
from characterize.asbuilt import AsBuilt
from characterize.capture import Capture
from characterize.clean import Gain, clean
from characterize.forward import ForwardModel, Setting, true_depth
from characterize.leastsquares import Ball, Data, Prior, Settings, Solution
from characterize.parameters import NAMES, PARAMETERS, PLACE, Known, vector
from characterize.pillars import Sensitivity
from characterize.prepare import data_of, merged, setting_of, stated
from characterize.slopes import slopes
from metalens.errors import FitError, FitRefused
from metalens.lens import Lens
from metalens.psf_lens import View
from metalens.psf_record import PsfStack
from metalens.store import Array

MISFIT, LIKENESS, LEAST_PEAK_E, WAVES_RAD = 1.15, 0.45, 100.0, 0.9
_LEANING_RAD = 0.3  # of the starts that look for a twin
MORE = ("pinhole_um", "bandwidth_nm", "bias_a_nm", "bias_o_nm", "tilt_x_deg", "tilt_y_deg")


@dataclass(frozen=True, slots=True)
class Options:
    """How to fit.

    free: parameters to fit beyond the usual ones. known: metrology, as priors.
    window: largest side in pixels of what is fitted. scan_um: half range of the stage-zero search.
    insist: return a result that fails its checks (problems filled) instead of refusing it.
    """

    free: tuple[str, ...] = ()
    known: tuple[Known, ...] = ()
    window: int = 48
    scan_um: float | None = None
    insist: bool = False


def fit(
    capture: Capture, lens: Lens, options: Options | None = None, *, response: Sensitivity | None = None
) -> AsBuilt:
    """The as-built lens behind a capture.

    Args:
        response: what height, index and sidewall do to the pillars; from the cell solvers without it.

    Raises:
        CaptureError: depths, pixel or wavelength missing, or frames unusable.
        FitError: refused, with the cause: another lens, a model that cannot explain the frames, a parameter at its
            bound, no convergence.
    """
    options = options or Options()
    capture, frames = merged(capture, clean(capture))
    setting, window = setting_of(capture, options.window)
    model = ForwardModel(lens, setting, response or slopes(lens, sidewall=_fits(options, "sidewall_deg")))
    data = data_of(frames, window)
    known = {k.name: k for k in (*stated(capture, lens), *options.known)}
    start = vector({name: k.value for name, k in known.items()})
    scan = options.scan_um if options.scan_um is not None else 0.12 * float(np.median(setting.depth_um))
    found = arrange(model, data, scan_um=scan, start=start)
    _check_likeness(found, lens)
    cautions = [*frames.corrections, *_arranged_words(found)]
    if model.response.error > 0.1:
        cautions.append(f"slopes of the pillars by height and index are known to {model.response.error:.0%} only")
    data = _rearranged(data, found)
    names, solution = _search(model, data, start, known, found, options)
    prior = prior_of(names, known, lens.sensor_distance_um)
    if not _explained(solution, frames.gain) or _at_bounds(names, solution, prior):
        (plain,) = _starts(model, data, start, found, biases_nm=(0.0,))
        twins = _twins(plain, _full(names, solution, start))
        again = _search(model, data, start, known, found, options, begins=twins)[1]
        solution = min(solution, again, key=lambda s: s.merit)
    if not _explained(solution, frames.gain) and not set(MORE) <= set(names):
        more = dataclasses.replace(options, free=(*options.free, *MORE))
        wider = _wider(model, data, _full(names, solution, start), known, found, more) or (names, solution)
        if wider[1].chi2_per_dof < 0.97 * solution.chi2_per_dof:
            names, solution = wider
            cautions.append(f"the usual parameters did not explain the frames: {', '.join(MORE)} fitted too")
    if frames.gain.known and _left_over(solution):
        prior = prior_of(names, known, lens.sensor_distance_um)
        rest = residual.attempt(model, data, names, solution.value, base=start, prior=prior)
        if rest is not None:
            model, solution = model.with_residual(rest.modes, thinplate.basis), rest.solution
            cautions.append(
                f"a smooth phase of {rest.rms_rad:.2g} rad rms beyond the parameters is kept: chi-square of frames "
                f"left out falls from {rest.before:.2f} to {rest.after:.2f} a pixel"
            )
    result = _result(capture, lens, model, data, names, solution, start, known, cautions, frames.gain)
    if result.problems and not options.insist:
        raise FitRefused("fit refused: " + "; ".join(result.problems))
    return result


def _fits(options: Options, name: str) -> bool:
    return name in options.free or any(k.name == name for k in options.known)


def _check_likeness(found: Arrangement, lens: Lens) -> None:
    if found.likeness < LIKENESS:
        raise FitRefused(
            f"fit refused: the frames look like no image of this lens (best correlation {found.likeness:.2f}); "
            f"they are of another lens than this {lens.profile} one, far from the stated depths, or dark"
        )


def _arranged_words(found: Arrangement) -> list[str]:
    words = []
    if found.clearly:
        words.append(f"frames fit the design only {found.words}: used so")
    if found.reordered:
        words.append(f"frames fit the stated depths only in the order {found.order.tolist()}: used so")
    if found.alike:
        which = ", ".join((TURNS + MIRRORED)[k] for k in found.alike)
        words.append(
            f"the design looks the same {which}: the orientation of the frames cannot be seen as far as these go; "
            "gradients, coma, astigmatism, trefoil and decentre are along the camera's axes"
        )
    if not found.order_seen:
        words.append(
            "images of neighbouring depths differ by less than the noise: the order of the frames cannot be seen"
        )
    return words


def _rearranged(data: Data, found: Arrangement) -> Data:
    part = [rearranged(a, found) for a in (data.electrons, data.usable, data.saturated, data.variance_e2, data.scale)]
    return Data(part[0], part[1], part[2], part[3], part[4])


def _names(known: dict[str, Known], free: Sequence[str]) -> tuple[str, ...]:
    for name in free:
        vector({name: 0.0})
    wanted = {p.name for p in PARAMETERS if p.free} | set(free)
    wanted |= {k.name for k in known.values() if k.sigma > 0}
    wanted -= {k.name for k in known.values() if k.sigma == 0 and k.name not in free}
    return tuple(name for name in NAMES if name in wanted)


def prior_of(names: Sequence[str], known: dict[str, Known], distance_um: float) -> Prior:
    """Priors of the fitted parameters: metrology where there is, else what is usual.

    distance_um: lens to sensor by design; it may be wrong by a quarter, so that no search runs into the lens.
    """
    table = [PARAMETERS[PLACE[name]] for name in names]
    entries = [known.get(name) for name in names]
    mean = [k.value if k else p.start for k, p in zip(entries, table, strict=True)]
    sigma = [k.sigma if k and k.sigma > 0 else p.sigma for k, p in zip(entries, table, strict=True)]
    reach = [distance_um / 4 if p.name == "distance_um" else math.inf for p in table]
    low = [max(p.low, -r) for p, r in zip(table, reach, strict=True)]
    high = [min(p.high, r) for p, r in zip(table, reach, strict=True)]
    return Prior(np.array(mean), np.array(sigma), np.array(low), np.array(high))


def _search(
    model: ForwardModel,
    data: Data,
    start: Array,
    known: dict[str, Known],
    found: Arrangement,
    options: Options,
    *,
    begins: list[Array] | None = None,
) -> tuple[tuple[str, ...], Solution]:
    """Short fits from each start, or from ``begins``, the best one to the end."""
    names = _names(known, options.free)
    prior, base = prior_of(names, known, model.lens.sensor_distance_um), start.copy()
    place = [PLACE[name] for name in names]
    begins = begins or _starts(model, data, start, found)
    if "pinhole_um" in names and base[PLACE["pinhole_um"]] == 0:
        begins = [_with(x, {"pinhole_um": 5.0}) for x in begins]
    if "bandwidth_nm" in names and base[PLACE["bandwidth_nm"]] == 0:
        begins = [_with(x, {"bandwidth_nm": 0.5}) for x in begins]
    few = _few(model.setting)
    waves = Ball(np.array([i for i, name in enumerate(names) if name.endswith("_rad")]), WAVES_RAD)
    short = Settings(iterations=4, step_tolerance=1.0, secant=True, finish=False, bounded=True, ball=waves)
    part, seen = residual.problem(model.only(few), names, base), data.planes(few)
    tries = [leastsquares.fit(part, seen, x[place], prior=prior, settings=short) for x in begins]
    best = min(tries, key=lambda t: t.merit)
    settings = Settings(iterations=80, secant=True)
    return names, leastsquares.fit(
        residual.problem(model, names, base), data, best.value, prior=prior, settings=settings
    )


def _wider(
    model: ForwardModel, data: Data, start: Array, known: dict[str, Known], found: Arrangement, options: Options
) -> tuple[tuple[str, ...], Solution] | None:
    """A search with more parameters from where the usual ones led; None where they lead out of the model's range."""
    try:
        return _search(model, data, start, known, found, options, begins=[start])
    except FitError:
        return None


def _few(setting: Setting) -> Array:
    """Frames that tell the starts apart: the ends and the middle of the depths at every angle."""
    chosen: list[int] = []
    for angle in np.unique(setting.angle_rad, axis=0):
        index = np.flatnonzero((setting.angle_rad == angle).all(1))
        by_depth = index[np.argsort(setting.depth_um[index], kind="stable")]
        chosen += by_depth[np.unique(np.linspace(0, len(index) - 1, 4).round().astype(int))].tolist()
    return np.unique(chosen)


def _with(x: Array, values: dict[str, float]) -> Array:
    out = x.copy()
    for name, value in values.items():
        out[PLACE[name]] = value
    return out


def _starts(
    model: ForwardModel, data: Data, start: Array, found: Arrangement, *, biases_nm: Sequence[float] = (0.0, 8.0, -8.0)
) -> list[Array]:
    """Nominal, and the twins of the global bias; stage zero, place, gain and background read off the frames."""
    pixel = model.setting.pixel_um
    level = float(np.median(data.electrons[data.usable]))
    base = _with(
        start,
        {
            "stage_zero_um": found.stage_zero_um,
            "decentre_x_um": float(np.clip(-found.shift_px[1] * pixel, -50, 50)),
            "decentre_y_um": float(np.clip(-found.shift_px[0] * pixel, -50, 50)),
            "background_e": level,
        },
    )
    starts = []
    for bias in biases_nm:
        x = _with(base, {"bias_nm": base[PLACE["bias_nm"]] + bias})
        light = model.images(_with(x, {"background_e": 0.0}))[0]
        keep = data.usable & ~data.saturated
        gain = float((light * (data.electrons - level))[keep].sum() / (light[keep] ** 2).sum())
        starts.append(_with(x, {"log_gain": math.log(max(gain, 1e-12))}))
    return starts


def _twins(plain: Array, found: Array) -> list[Array]:
    """Starts for a search that ended in a wrong valley.

    About its focus a lens with the opposite even aberrations gives nearly the same images, and the plain start lies
    between the two: either sign of both astigmatisms, and what was found with its even aberrations reversed.
    """
    even = ("astigmatism_rad", "oblique_astigmatism_rad", "spherical_rad")
    leaning = [_with(plain, {name: size}) for name in even[:2] for size in (_LEANING_RAD, -_LEANING_RAD)]
    return [*leaning, _with(found, {name: -float(found[PLACE[name]]) for name in even})]


def _explained(solution: Solution, gain: Gain) -> bool:
    """Whether chi-square is that of noise: within 15 %, or four of its own sigma where pixels or flats are few."""
    chance = 4 * math.hypot(_chance(solution), gain.gain_sigma_e / gain.gain_e)
    return solution.chi2_per_dof <= 1 + max(MISFIT - 1, min(chance, 0.5))


def _left_over(solution: Solution) -> bool:
    """Whether the frames hold more than noise, but not so much that they are of something else."""
    return 3 * _chance(solution) < solution.chi2_per_dof - 1 < 30


def _chance(solution: Solution) -> float:
    """Standard deviation of chi-square per degree of freedom over the pixels that count."""
    return math.sqrt(2 / max(float((solution.residual_sigma != 0).sum()), 1.0))


def _full(names: tuple[str, ...], solution: Solution, start: Array) -> Array:
    return _with(start, dict(zip(names, solution.value.tolist(), strict=True)))


def _result(
    capture: Capture,
    lens: Lens,
    model: ForwardModel,
    data: Data,
    names: tuple[str, ...],
    solution: Solution,
    start: Array,
    known: dict[str, Known],
    cautions: list[str],
    gain: Gain,
) -> AsBuilt:
    prior = prior_of(names, known, lens.sensor_distance_um)
    fitted = dict(zip(names, solution.value.tolist(), strict=True))
    bench = {k: v for k, v in fitted.items() if k.startswith(("log_gain", "background", "decentre", "crosstalk"))}
    problems = _problems(names, solution, prior, gain)
    clipped = float(data.saturated.mean())
    if problems and clipped > 0.1:
        problems.insert(0, f"{clipped:.0%} of the pixels are saturated: too little is left to fit; expose shorter")
    left = float(np.linalg.norm(model.modes))
    if left > residual.MOST_RAD:
        problems.append(f"a phase of {left:.2f} rad rms is left that no parameter explains: captures of another lens")
    held = {name: float(start[PLACE[name]]) for name in NAMES if name not in fitted}
    return AsBuilt(
        design=lens,
        response=model.response,
        psf=_psf(lens, model, _full(names, solution, start)),
        names=names,
        value=solution.value,
        covariance=_with_gain(names, solution, gain),
        information=solution.information,
        held=held,
        depth_um=model.setting.depth_um,
        angle_rad=model.setting.angle_rad,
        pixel_um=capture.pixel_um,
        measured=data.electrons,
        predicted=solution.image,
        residual_modes=model.modes,
        nominal=model.with_residual(np.empty(0), thinplate.basis).images(_with(start, bench))[0],
        residual_sigma=solution.residual_sigma,
        chi2_per_dof=solution.chi2_per_dof,
        converged=solution.converged,
        reason=solution.reason,
        identifiable=tuple(knowable.identifiable(names, solution.information, prior.sigma)),
        degeneracies=tuple(knowable.degeneracies(names, solution.covariance, prior.sigma)),
        cautions=tuple(cautions),
        problems=tuple(problems),
    )


def _psf(lens: Lens, model: ForwardModel, x: Array) -> PsfStack:
    """PSFs of the as-built lens at the true depths of the frames, as fine as the light is, on the fitted window."""
    s = model.setting
    depths = np.unique(np.round(true_depth(x, s, model.stage_centre_um), 3))
    side = max(s.rows, s.columns)
    samples = side * model.grid.oversample
    angles = tuple((float(a[0]), float(a[1])) for a in np.unique(s.angle_rad, axis=0))
    view = View(tuple(depths.tolist()), angles, side * s.pixel_um, samples)
    return made.psf_stack(lens, model.response, x, view, modes=model.modes, tolerance=1e-3)


def _with_gain(names: tuple[str, ...], solution: Solution, gain: Gain) -> Array:
    """Covariance with the error of the sensor's gain, which scales everything that is counted in electrons."""
    relative = min(gain.gain_sigma_e / gain.gain_e, 1.0)
    by_gain = np.zeros(len(names))
    for i, name in enumerate(names):
        if name.startswith("background"):
            by_gain[i] = solution.value[i] * relative
        elif name == "log_gain":
            by_gain[i] = relative
    return np.asarray(solution.covariance + np.outer(by_gain, by_gain))


def _problems(names: tuple[str, ...], solution: Solution, prior: Prior, gain: Gain) -> list[str]:
    """Checks of a finished fit, each with the cause it points to."""
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
    if gain.known and not _explained(solution, gain):
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
    for name, value in _at_bounds(names, solution, prior):
        words.append(f"{name} ran to its bound {value:g}: the true value lies outside, or the frames are misread")
    return words


def _at_bounds(names: tuple[str, ...], solution: Solution, prior: Prior) -> list[tuple[str, float]]:
    """Parameters that ended on a bound which is not the natural zero of a blur."""
    ends = zip(names, solution.value.tolist(), prior.low, prior.high, strict=True)
    blurs = ("pinhole_um", "bandwidth_nm", "crosstalk_px")
    return [(n, v) for n, v, low, high in ends if v >= high or (v <= low and n not in blurs)]
