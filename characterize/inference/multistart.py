"""Modes of the posterior by multistart: short fits from many starts, the best of them
to the end.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from characterize.inference import leastsquares
from characterize.inference.frame_alignment import FrameArrangement, few_frames
from characterize.inference.leastsquares import (
    FitImages,
    FitProblem,
    FitSolution,
    GaussianPrior,
    SolverSettings,
)
from characterize.model import (
    NAMES,
    PARAMETERS,
    PLACE,
    ForwardModel,
    KnownValue,
    parameter_vector,
    usual_parameters,
)
from metalens.core import threads
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.lens import Lens

WAVES_RAD = 0.9
MODES_WITHIN = 10.0  # rise of -2 ln L up to which another mode is reported
_EVEN = ("astigmatism_rad", "oblique_astigmatism_rad", "spherical_rad")
_OFF_PX = 0.1  # off the decentre that windows may stay
_PLACES = (-2.1, -1.4, -0.7, 0.0, 0.7, 1.4, 2.1)  # of starts, in sigma of the prior
_TRIAL = SolverSettings.short(iterations=6, step_tolerance=0.5)
# beyond MODES_WITHIN: rise up to which an unfinished fit is followed to its end
_WORTH = 10.0


@dataclass(frozen=True, eq=False, slots=True)
class SearchTask:
    """What is searched: the model and its data, all start values, what is known, what is
    free.

    unfitted: how large is stated to be what no parameter describes
    (``characterize.model.UNFITTED``).
    """

    model: ForwardModel
    data: FitImages
    start: Array
    known: dict[str, KnownValue]
    free: tuple[str, ...] = ()
    unfitted: dict[str, float] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the fitted parameters."""
        return names_of(self.known, self.free)

    @property
    def prior(self) -> GaussianPrior:
        """Of the fitted parameters."""
        return prior_of(self.names, self.known, self.model.lens)

    def posed(self, frames: Array | None = None) -> FitProblem:
        """The least-squares problem of all frames, or of those of index ``frames``."""
        model, data = self.model, self.data
        if frames is not None:
            model, data = model.only(frames), data.planes(frames)
        return FitProblem(named_images(model, self.names, self.start), data, self.prior)

    def at_start(self) -> FitSolution:
        """Images, slopes and covariance at the start, without a step."""
        start = self.start[[PLACE[name] for name in self.names]]
        return self.posed().fit(start, SolverSettings(iterations=0))

    def all_of(self, value: Array) -> Array:
        """All parameters where the fitted ones have a value."""
        return with_values(
            self.start, dict(zip(self.names, value.tolist(), strict=True))
        )


def named_images(
    model: ForwardModel, names: Sequence[str], base: Array
) -> leastsquares.Model:
    """Images of ``model`` as a function of the parameters ``names``; the others as in
    ``base`` (all parameters).
    """
    place = [PLACE[name] for name in names]

    def images(values: Array, jacobian: bool) -> tuple[Array, Array | None]:
        x = base.copy()
        x[place] = values
        return model.images(x, names if jacobian else None)

    return images


def search_modes(
    task: SearchTask, arrangement: FrameArrangement
) -> tuple[SearchTask, list[FitSolution]]:
    """Modes of the posterior, best first, within ``MODES_WITHIN`` of the best.

    A short fit to a few frames from the nominal lens places the windows; it is
    continued on all frames, and :func:`find_other_modes` starts from its end.

    Args:
        task: model, frames and priors of the search.
        arrangement: how the frames lie.

    Returns:
        (the task with its windows fixed at the light, modes).
    """
    few = few_frames(task.model.setting)
    first = short_fit(task, few, starting_point(task, arrangement))
    task = hold_windows(task, first.value)
    return task, find_other_modes(task, [refine_fit(task, first.value)])


def find_other_modes(
    task: SearchTask, ends: list[FitSolution], *, rounds: int = 3
) -> list[FitSolution]:
    """The modes, and those that other starts lead to, until the best stays.

    Starts are mirror images of the best (:func:`mirrored_starts`), and places along the
    bias (:func:`starts_along_bias`).

    Args:
        task: model, frames and priors of the search.
        ends: fits of the modes so far, best first.
        rounds: largest number of repetitions.
    """
    for _ in range(rounds):
        best = ends[0]
        starts = [*mirrored_starts(task, best), *starts_along_bias(task, best)]
        ends = distinct_modes([*ends, *follow_starts(task, ends, starts)])
        if ends[0].merit > best.merit - 1:
            break
    return ends


def starts_along_bias(task: SearchTask, best: FitSolution) -> list[Array]:
    """(p,) starts at biases across their prior, the others at their conditional mean;
    none where the bias is fixed.

    Args:
        task: model, frames and priors of the search.
        best: the best fit so far.
    """
    if "bias_nm" not in task.names:
        return []
    i = task.names.index("bias_nm")
    prior = task.prior
    along = best.covariance[:, i] / best.covariance[i, i]
    sigma = min(prior.sigma[i], (prior.high[i] - prior.low[i]) / 4)
    places = prior.mean[i] + sigma * np.array(_PLACES)
    starts = best.value + np.multiply.outer(places - best.value[i], along)
    return list(np.clip(starts, prior.low, prior.high))


def follow_starts(
    task: SearchTask,
    ends: Sequence[FitSolution],
    begins: Sequence[Array],
    *,
    most: int = 2,
) -> list[FitSolution]:
    """Modes that some starts lead to: short fits, the best of these to the end.

    At most ``most``, none equal to one of ``ends`` or to another.

    Args:
        task: model, frames and priors of the search.
        ends: the fits so far, best first.
        begins: (p,) starts.
        most: largest number of fits that are followed to their ends.
    """
    problem = task.posed()

    def attempt(begin: Array) -> FitSolution | None:
        try:
            return problem.fit(begin, _TRIAL, ends[0].slopes)
        except FitError:  # outside the model's range
            return None

    far = [x for x in begins if all(sigma_distance(x, end) > 2.0 for end in ends)]
    trials = [trial for trial in threads.run_each(attempt, far) if trial is not None]
    modes = list(ends)
    for trial in sorted(trials, key=lambda trial: trial.merit):
        if (
            len(modes) < len(ends) + most
            and trial.merit < ends[0].merit + MODES_WITHIN + _WORTH
            and all(sigma_distance(trial.value, mode) > 1.0 for mode in modes)
        ):
            modes.append(refine_fit(task, trial.value, trial.slopes))
    return modes[len(ends) :]


def mirrored_starts(task: SearchTask, best: FitSolution) -> list[Array]:
    """(p,) starts with the sign of some parameters reversed.

    Near focus the opposite even aberrations give nearly the same images, and so does
    the reversed bias field, as images depend almost only on products of its parts. In
    turn: the even aberrations; the whole bias field, where it differs from 0 by its
    sigma; each such gradient, and these together. The other parameters take their
    conditional mean.

    Args:
        task: model, frames and priors of the search.
        best: fit that is reversed.
    """
    value, covariance = best.value, best.covariance
    rows = usual_parameters(task.names, task.model.lens)
    field = [i for i, row in enumerate(rows) if row.reversible]
    even = [i for i, row in enumerate(rows) if row.name in _EVEN]
    clear = [
        i
        for i in field
        if rows[i].name != "bias_nm" and abs(value[i]) > math.sqrt(covariance[i, i])
    ]
    off = 0.0  # squared distance of the whole field from 0, in sigma
    if field:
        inverse = leastsquares.invert_information(covariance[np.ix_(field, field)])
        off = float(value[field] @ inverse @ value[field])
    out = []
    sets = [even, field if off > 1 else [], *([i] for i in clear), clear]
    for some in (list(key) for key in dict.fromkeys(map(tuple, sets)) if key):
        # conditional mean of the others where these change sign
        block = np.linalg.solve(covariance[np.ix_(some, some)], -2 * value[some])
        moved = value + covariance[:, some] @ block
        out.append(np.clip(moved, task.prior.low, task.prior.high))
    return out


def hold_windows(task: SearchTask, value: Array) -> SearchTask:
    """The task with its windows fixed at the fitted decentre.

    Windows start at the light, up to a pixel off the decentre, as a prism of the bias
    moves light too. At NA 0.2 and 6000 electrons half a pixel shifts trefoil by 0.7
    sigma.

    Args:
        task: model, frames and priors.
        value: (p,) fitted parameters.
    """
    model = task.model
    x = task.all_of(value)
    middle = float(x[PLACE["decentre_x_um"]]), float(x[PLACE["decentre_y_um"]])
    off = max(abs(a - b) for a, b in zip(middle, model.grid.middle_um, strict=True))
    if off < _OFF_PX * model.setting.pixel_um:
        return task
    return dataclasses.replace(task, model=model.about(middle))


def place_windows(
    task: SearchTask, ends: list[FitSolution]
) -> tuple[SearchTask, list[FitSolution]]:
    """The task with windows fixed at the best mode, and the modes (``ends``) fitted again
    there."""
    moved = hold_windows(task, ends[0].value)
    if moved is task:
        return task, ends
    best = refine_fit(moved, ends[0].value, ends[0].slopes)
    others = (refine_fit(moved, end.value, end.slopes) for end in ends[1:])
    return moved, distinct_modes([best, *others])


def widen_search(task: SearchTask, begin: Array) -> list[FitSolution]:
    """Modes with more parameters, from where the usual ones led; empty where they lead
    out of the model's range.

    Args:
        task: model, frames and priors of the search.
        begin: (parameters,) start of the search.
    """
    try:
        best = refine_fit(task, opened_start(task, begin))
        return find_other_modes(task, [best])
    except FitError:
        return []


def widen_priors(
    task: SearchTask, ends: list[FitSolution], names: Sequence[str]
) -> tuple[SearchTask, list[FitSolution]]:
    """The task with wider priors where the best mode is beyond two of their sigma, and
    the modes fitted again.

    The prior's standard deviation is then the distance of the estimate from its mean
    (type-II maximum likelihood), so that it hardly pulls.

    Args:
        task: model, frames and priors of the search.
        ends: the modes, best first.
        names: of the parameters whose priors are in doubt.
    """
    rows = zip(
        task.names, ends[0].value, task.prior.mean, task.prior.sigma, strict=True
    )
    wide = {
        name: KnownValue(name, float(mean), abs(float(value - mean)))
        for name, value, mean, sigma in rows
        if name in names and abs(value - mean) > 2 * sigma
    }
    if not wide:
        return task, ends
    task = dataclasses.replace(task, known=task.known | wide)
    return task, distinct_modes(
        [refine_fit(task, end.value, end.slopes) for end in ends]
    )


def merit_with(task: SearchTask, best: FitSolution, frees: Sequence[str]) -> float:
    """-2 ln posterior of a short fit with further parameters, from where the best is;
    infinite where they lead out of the model's range.

    Args:
        task: model, frames and priors of the search.
        frees: names of the parameters that are fitted too.
    """
    more = dataclasses.replace(task, free=(*task.free, *frees))
    begin = opened_start(more, task.all_of(best.value))
    settings = SolverSettings(iterations=12, step_tolerance=0.3, near=1.0, finish=False)
    try:
        return more.posed().fit(begin, settings).merit
    except FitError:
        return math.inf


def distinct_modes(ends: Sequence[FitSolution]) -> list[FitSolution]:
    """Ends that are not the same, best first, within ``MODES_WITHIN`` of the best.

    Args:
        ends: fits that were led to an end.
    """
    modes: list[FitSolution] = []
    for end in sorted(ends, key=lambda e: e.merit):
        likely = end.merit < modes[0].merit + MODES_WITHIN if modes else True
        if likely and all(sigma_distance(end.value, mode) > 1.0 for mode in modes):
            modes.append(end)
    return modes


def sigma_distance(value: Array, end: FitSolution) -> float:
    """Distance of a place from the end of a fit, in sigma of its own parabola.

    Args:
        value: (p,) the place.
        end: of the fit.
    """
    step = value - end.value
    square = step @ leastsquares.invert_information(end.covariance) @ step
    return float(math.sqrt(max(square, 0.0)))


def short_fit(task: SearchTask, few: Array, begin: Array) -> FitSolution:
    """Short fit on few frames; its prior keeps wave-front errors near 0.

    Args:
        task: model, frames and priors of the search.
        few: indices of the frames.
        begin: all parameters.
    """
    problem = task.posed(few)
    waves = np.array([name.endswith("_rad") for name in task.names])
    sigma = np.where(
        waves, np.minimum(problem.prior.sigma, WAVES_RAD / 2), problem.prior.sigma
    )
    prior = dataclasses.replace(problem.prior, sigma=sigma)
    return dataclasses.replace(problem, prior=prior).fit(
        opened_start(task, begin), SolverSettings.short(4, 1.0)
    )


def refine_fit(
    task: SearchTask, value: Array, slopes: Array | None = None
) -> FitSolution:
    """A fit to the end.

    Args:
        task: model, frames and priors of the search.
        value: (p,) where the fit begins.
        slopes: (p, n, y, x) Jacobian of a place close by.
    """
    return task.posed().fit(value, SolverSettings(iterations=80), slopes)


def opened_start(task: SearchTask, x: Array) -> Array:
    """(p,) fitted ones of all parameters; sizes that have no slope at 0 start off it.

    Args:
        task: with the names of the fitted ones.
        x: all parameters.
    """
    off = {"pinhole_um": 5.0, "bandwidth_nm": 0.5, "glass_um": 50.0}
    return np.array([x[PLACE[name]] or off.get(name, 0.0) for name in task.names])


def names_of(known: dict[str, KnownValue], free: Sequence[str]) -> tuple[str, ...]:
    """Names of the fitted parameters: usual, freed, or stated with an error.

    Without those stated exactly that are not freed.

    Args:
        known: stated values by name.
        free: names of further parameters.
    """
    for name in free:
        parameter_vector({name: 0.0})
    fitted = {p.name for p in PARAMETERS if p.free} | set(free)
    fitted |= {k.name for k in known.values() if k.sigma > 0}
    fitted -= {k.name for k in known.values() if k.sigma == 0 and k.name not in free}
    return tuple(name for name in NAMES if name in fitted)


def prior_of(
    names: Sequence[str], known: dict[str, KnownValue], lens: Lens
) -> GaussianPrior:
    """Priors of the fitted parameters: as stated, else usual for such a lens.

    Args:
        names: (p,) names of the fitted parameters.
        known: stated values by name.
        lens: the design.
    """
    table = usual_parameters(names, lens)
    entries = [known.get(name) for name in names]
    mean = [k.value if k else p.start for k, p in zip(entries, table, strict=True)]
    sigma = [
        k.sigma if k and k.sigma > 0 else p.sigma
        for k, p in zip(entries, table, strict=True)
    ]
    return GaussianPrior(
        np.array(mean),
        np.array(sigma),
        np.array([p.low for p in table]),
        np.array([p.high for p in table]),
    )


def with_values(x: Array, values: dict[str, float]) -> Array:
    """All parameters, some set by name.

    Args:
        x: all parameters, in the order of ``PARAMETERS``.
        values: by name.
    """
    out = x.copy()
    for name, value in values.items():
        out[PLACE[name]] = value
    return out


def starting_point(task: SearchTask, arrangement: FrameArrangement) -> Array:
    """All parameters of the nominal lens, placed by the frames.

    Stage zero, distance, decentre, background and gain are estimated from the frames.

    Args:
        task: model, frames and priors of the search.
        arrangement: how the frames lie.
    """
    model, data = task.model, task.data
    glow = model.setting.glow
    level = float(np.median((data.electrons / glow)[data.usable]))
    values = {
        "stage_zero_um": arrangement.stage_zero_um,
        "distance_um": arrangement.distance_um,
        "background_e": level,
        "decentre_x_um": arrangement.middle_um[0],
        "decentre_y_um": arrangement.middle_um[1],
    }
    x = with_values(task.start, values)
    light = model.images(with_values(x, {"background_e": 0.0}))[0]
    keep = data.usable & ~data.saturated
    # least-squares brightness of the design over the frames
    gain = (light * (data.electrons - level * glow))[keep].sum()
    gain /= (light[keep] ** 2).sum()
    return with_values(x, {"log_gain": math.log(max(float(gain), 1e-12))})
