"""Where a fit may end: short fits from many starts, the best of them to the end, and
every other valley as good.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from characterize.captures import relative_orientation
from characterize.inference import leastsquares
from characterize.inference.arrange import FrameArrangement, few_frames
from characterize.inference.leastsquares import (
    FitImages,
    FitProblem,
    FitSolution,
    GaussianPrior,
    SolverSettings,
)
from characterize.inference.prepare import LeftOut, lit_part
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
from metalens.fabrication import wavelength_scale
from metalens.lens import Lens

WAVES_RAD = 0.9
MODES_WITHIN = 10.0  # rise of -2 ln L up to which another valley is reported
_LEANING_RAD = 0.3  # of the starts that look for a twin
_ALONG_NM, _ASIDE_UM = (
    9.0,
    50.0,
)  # bias by which starts are moved along the valley; where windows begin at most
_PROMISING, _MOST, _AGAIN = 40.0, 2, 3
_HELD_PX = 0.1  # off the decentre that windows may be held
# sigma of a prior to either side that is scanned, and of a step
_REACH, _STEP, _MINIMA = 2.5, 0.35, 3
_SCANNED = SolverSettings(
    iterations=5, step_tolerance=1.0, secant=True, near=math.inf, miss=0.7, finish=False
)
_ONWARD = SolverSettings(
    iterations=25, step_tolerance=0.3, secant=True, near=1.0, finish=False
)
# beyond MODES_WITHIN: rise up to which an unfinished fit is followed to its end
_WORTH = 10.0


@dataclass(frozen=True, eq=False, slots=True)
class SearchTask:
    """What is searched: the model and its data, all start values, what is known, how
    the frames lie, what is free.

    found: None before frames are there: no search begins without it.
    unfitted: how large is stated to be what no parameter describes
    (``characterize.model.UNFITTED``).
    left_out: what is added to images and slopes of the model; see
    :func:`correct_surrogate`.
    """

    model: ForwardModel
    data: FitImages
    start: Array
    known: dict[str, KnownValue]
    found: FrameArrangement | None
    free: tuple[str, ...] = ()
    unfitted: dict[str, float] = field(default_factory=dict)
    left_out: LeftOut | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Of the fitted parameters."""
        return names_of(self.known, self.free)

    @property
    def prior(self) -> GaussianPrior:
        """Of the fitted parameters."""
        return prior_of(self.names, self.known, self.model.lens)

    def problem(self, frames: Array | None = None) -> leastsquares.Model:
        """Images of all frames, or roughly of some."""
        model = self.model if frames is None else self.model.only(frames)
        if self.left_out is None:
            return named_images(
                model if frames is None else model.quick(), self.names, self.start
            )
        return self.left_out.added(named_images(model, self.names, self.start), frames)

    def posed(self, frames: Array | None = None) -> FitProblem:
        """The least-squares problem of all frames, or of those of index ``frames`` with
        rough images.
        """
        data = self.data if frames is None else self.data.planes(frames)
        return FitProblem(self.problem(frames), data, self.prior)

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


def correct_surrogate(task: SearchTask, at: FitSolution) -> SearchTask:
    """The task by a quick model put right at a fit, where there is light: a third of
    the work for an image, or less.

    Few terms leave out a percent or two of the light, and of a change of the light. All
    lenses that explain the frames
    give images a few sigma apart: what is left out differs among them by about a tenth
    of one (a test holds it on a
    small lens; on 1 mm, two tenths were met where images are 20 sigma apart).
    """
    lit = lit_part(task.model, task.data, task.all_of(at.value), at.image)
    quick = dataclasses.replace(task, model=task.model.quick(*lit), left_out=None)
    image, slopes = quick.problem()(at.value, True)
    beside = np.ones(at.image.shape[1:], bool)
    beside[lit] = False
    return dataclasses.replace(
        quick,
        left_out=LeftOut(
            at.value, at.image - image, at.slopes - np.asarray(slopes), beside
        ),
    )


def choose_orientation(tasks: Sequence[SearchTask]) -> SearchTask:
    """Of tasks that differ by how the frames lie the one that a short fit to some of
    them makes likeliest.

    The first unless another is better by what a short fit may be off, and still is once
    both go on; those within that
    cannot be told from it.
    """
    if len(tasks) == 1:
        return tasks[0]
    few = few_frames(tasks[0].model.setting)
    tries = [
        _short(task, few, starting_points(task, biases_nm=(0.0,)))[0] for task in tasks
    ]
    merits = np.array([one.merit for one in tries])
    if merits[0] >= merits.min() + _PROMISING:
        for k in (0, int(merits.argmin())):
            merits[k] = tasks[k].posed(few).fit(tries[k].value, _ONWARD).merit
    best = 0 if merits[0] < merits.min() + _PROMISING else int(merits.argmin())
    found = [task.found for task in tasks if task.found is not None]
    near = [
        one
        for one, merit in zip(found, merits, strict=True)
        if merit < merits[best] + _PROMISING
    ]
    turns = {
        relative_orientation(found[best].orientation, o.orientation)
        for o in near
        if o.reordered == found[best].reordered
    }
    alike = {*found[best].alike, *turns} - {0}
    return dataclasses.replace(
        tasks[best],
        found=dataclasses.replace(found[best], alike=tuple(sorted(alike)), others=()),
    )


def search_modes(
    task: SearchTask, *, begins: Sequence[Array] = ()
) -> tuple[SearchTask, list[FitSolution]]:
    """The valleys that explain the frames, best first, the others within
    ``MODES_WITHIN`` of it; and the task with its
    windows held where the best has them.

    Short fits on a few frames from the nominal lens, the twins of its bias and leaning
    wave fronts, or from ``begins``;
    the best to the end, most of the way by the quick model. Then from what it found
    with even aberrations reversed and
    moved along its weakest valley: whatever of all these promises as much is fitted to
    the end too.
    """
    few = few_frames(task.model.setting)
    plain = starting_points(task)
    first = _short(task, few, list(begins) or [*plain, *_leaning(plain[0])])
    task = hold_windows(task, first[0].value)
    near = _nearer(task, first[0].value)
    best = _long(task, near.value, near.slopes)
    tries = sorted(
        [*first[1:], *_short(task, few, _twins(task, best))], key=lambda t: t.merit
    )
    floor = min(tries[0].merit, first[0].merit)
    promising = [t.value for t in tries if t.merit < floor + _PROMISING]
    about = correct_surrogate(task, best)
    return task, add_mirrored_starts(
        about,
        distinct_modes([best, *follow_starts(about, best, promising[: 2 * _MOST])]),
    )


def add_mirrored_starts(task: SearchTask, ends: list[FitSolution]) -> list[FitSolution]:
    """The modes, and fits started from their reversed bias gradients: near focus both
    signs give similar frames.

    Args:
        task: model, frames, priors and arrangement of the search.
        ends: fits of the modes so far.
    """
    for _ in range(_AGAIN):
        best = ends[0]
        begins = [
            b
            for b in bias_reversals(task, best)
            if all(_apart(b, end) > 2.0 for end in ends)
        ]
        ends = distinct_modes([*ends, *follow_starts(task, best, begins)])
        if ends[0].merit > best.merit - 1:
            break
    return ends


def scan_parameter(
    task: SearchTask, modes: Sequence[FitSolution], i: int
) -> list[FitSolution]:
    """The modes with those that a scan of parameter number ``i`` leads to, best first.

    It is held at places across its prior with all others fitted to a few frames, from
    the best mode outwards; minima on the way are followed with all free, on all frames.

    Args:
        task: model, frames, priors and arrangement of the search.
    """
    kept = list(modes)
    for _ in range(_AGAIN):
        best, few = kept[0], few_frames(task.model.setting)
        problem = task.posed(few)
        here = dataclasses.replace(
            best,
            merit=problem.merit(best.value),
            image=best.image[few],
            slopes=best.slopes[:, few],
        )
        scan = functools.partial(_scan_side, problem, here, i)
        sides = threads.run_each(scan, (-1, 1))
        stops = [*sides[0][::-1], here, *sides[1]]
        wall = np.array([math.inf, *(one.merit for one in stops), math.inf])
        low = np.flatnonzero((wall[1:-1] <= wall[:-2]) & (wall[1:-1] <= wall[2:]))
        begins = [stops[k].value for k in low[np.argsort(wall[1:-1][low])]]
        begins = [x for x in begins if x[i] != best.value[i]][:_MINIMA]
        kept = distinct_modes([*kept, *follow_starts(task, best, begins)])
        if kept[0].merit > best.merit - 1:
            break
    return kept


def _scan_side(
    problem: FitProblem, mode: FitSolution, i: int, sign: int
) -> list[FitSolution]:
    """Fits with one parameter held at places from the mode to one end of its prior."""
    prior, own = problem.prior, math.sqrt(float(mode.covariance[i, i]))
    wide, middle = float(prior.sigma[i]), float(prior.mean[i])
    if not math.isfinite(wide):
        wide, middle = 3 * own, float(mode.value[i])
    end = float(np.clip(middle + sign * _REACH * wide, prior.low[i], prior.high[i]))
    count = max(math.ceil(sign * (end - float(mode.value[i])) / (_STEP * wide)), 0)
    out, here = list[FitSolution](), mode
    for goal in np.linspace(float(mode.value[i]), end, count + 1)[1:].tolist():
        way = here.covariance[:, i] / here.covariance[i, i] * (goal - here.value[i])
        here = problem.held(i, goal).fit(here.value + way, _SCANNED, here.slopes)
        out.append(here)
    return out


def follow_starts(
    task: SearchTask, best: FitSolution, begins: Sequence[Array]
) -> list[FitSolution]:
    """Where some starts lead: a few steps on all frames, and to the end what promises
    as much as the best.

    At most ``_MOST`` ends, none that leads to the best itself or to another.

    Args:
        task: model, frames, priors and arrangement of the search.
        begins: (p,) starts.
    """
    settings = SolverSettings(
        iterations=6, step_tolerance=0.5, secant=True, near=1.0, finish=False
    )
    ends: list[FitSolution] = []
    for begin in begins:
        if len(ends) == _MOST:
            break
        if any(_apart(begin, end) < 2.0 for end in [best, *ends]):
            continue
        one = task.posed().fit(begin, settings)
        if one.merit < best.merit + MODES_WITHIN + _WORTH and all(
            _apart(one.value, e) > 2.0 for e in [best, *ends]
        ):
            ends.append(_long(task, one.value, one.slopes))
    return ends


def bias_reversals(task: SearchTask, best: FitSolution) -> list[Array]:
    """Starts with the sign of some biases turned round, all other parameters going
    along as the parabola says.

    The whole field of the bias first, where it stands off 0 by its sigma: near focus
    images show products of its parts
    nearly alone, which are the same for a field of the other sign. Then each gradient
    that does, and these together.

    Args:
        task: model, frames, priors and arrangement of the search.
        best: fit that is reversed.
    """
    value, covariance = best.value, best.covariance
    rows = usual_parameters(task.names, task.model.lens)
    whole = [i for i, row in enumerate(rows) if row.reversible]
    places = [i for i in whole if task.names[i] != "bias_nm"]
    off = (
        float(
            value[whole]
            @ leastsquares.invert_information(covariance[np.ix_(whole, whole)])
            @ value[whole]
        )
        if whole
        else 0.0
    )
    far = [i for i in places if abs(value[i]) > math.sqrt(covariance[i, i])]
    turned = [whole if off > 1 else [], *([i] for i in far), far]
    out = []
    for some in (list(one) for one in dict.fromkeys(map(tuple, turned)) if one):
        block = np.linalg.solve(covariance[np.ix_(some, some)], -2 * value[some])
        moved = value + covariance[:, some] @ block
        out.append(np.clip(moved, task.prior.low, task.prior.high))
    return out


def refine_fit(task: SearchTask, value: Array) -> FitSolution:
    """A fit to the end from values of the fitted parameters.

    Args:
        task: model, frames, priors and arrangement of the search.
        value: (p,) where the fit begins.
    """
    return _long(task, value)


def hold_windows(task: SearchTask, value: Array) -> SearchTask:
    """The task with its windows held where values of the fitted parameters have them.

    Frames begin where the light lies, up to a pixel off the decentre (a prism of the
    bias moves light too): at NA 0.2
    and 6000 electrons half a pixel each way moves trefoil by 0.7 sigma.

    Args:
        value: (p,) fitted parameters.
    """
    model, x = task.model, task.all_of(value)
    middle = float(x[PLACE["decentre_x_um"]]), float(x[PLACE["decentre_y_um"]])
    off = max(abs(a - b) for a, b in zip(middle, model.grid.middle_um, strict=True))
    return (
        task
        if off < _HELD_PX * model.setting.pixel_um
        else dataclasses.replace(task, model=model.about(middle))
    )


def place_windows(
    task: SearchTask, ends: list[FitSolution]
) -> tuple[SearchTask, list[FitSolution]]:
    """The task with its windows held where the best end has them, and the ends followed
    there.
    """
    there = hold_windows(task, ends[0].value)
    if there is task:
        return task, ends
    best = _long(there, ends[0].value, ends[0].slopes)
    about = correct_surrogate(there, best)
    return there, distinct_modes(
        [best, *(_long(about, end.value, end.slopes) for end in ends[1:])]
    )


def widen_search(
    task: SearchTask, begin: Array
) -> tuple[SearchTask, list[FitSolution]] | None:
    """A search with more parameters from where the usual ones led; None where they lead
    out of the model's range.

    Args:
        task: model, frames, priors and arrangement of the search.
        begin: (p,) start of the search.
    """
    try:
        return search_modes(task, begins=[begin])
    except FitError:
        return None


def merit_with(task: SearchTask, best: FitSolution, frees: Sequence[str]) -> float:
    """-2 ln posterior of a short fit with further parameters, from where the best is;
    infinite where they lead out of the model's range.

    Args:
        task: model, frames, priors and arrangement of the search.
        frees: names of the parameters that are fitted too.
    """
    more = dataclasses.replace(task, free=(*task.free, *frees), left_out=None)
    x = task.all_of(best.value)
    begin = with_values(x, _opened(more, x))[[PLACE[name] for name in more.names]]
    settings = SolverSettings(
        iterations=12, step_tolerance=0.3, secant=True, near=1.0, finish=False
    )
    try:
        found = more.posed().fit(begin, settings)
    except FitError:
        return math.inf
    return found.merit


def distinct_modes(ends: Sequence[FitSolution]) -> list[FitSolution]:
    """Ends that are not the same, best first, within ``MODES_WITHIN`` of the best.

    Args:
        ends: fits that were led to an end.
    """
    kept: list[FitSolution] = []
    for one in sorted(ends, key=lambda e: e.merit):
        near = one.merit < kept[0].merit + MODES_WITHIN if kept else True
        if near and all(_apart(one.value, other) > 1.0 for other in kept):
            kept.append(one)
    return kept


def _apart(value: Array, end: FitSolution) -> float:
    """Distance in sigma of the end's own parabola."""
    step = value - end.value
    return float(
        math.sqrt(
            max(step @ leastsquares.invert_information(end.covariance) @ step, 0.0)
        )
    )


def _short(task: SearchTask, few: Array, begins: Sequence[Array]) -> list[FitSolution]:
    """Short fits on few frames from several starts, best first; wave-front errors by a
    prior that keeps them near 0.
    """
    place = [PLACE[name] for name in task.names]
    problem = task.posed(few)
    waves = np.array([name.endswith("_rad") for name in task.names])
    sigma = np.where(
        waves, np.minimum(problem.prior.sigma, WAVES_RAD / 2), problem.prior.sigma
    )
    problem = dataclasses.replace(
        problem, prior=dataclasses.replace(problem.prior, sigma=sigma)
    )
    short = SolverSettings(
        iterations=4, step_tolerance=1.0, secant=True, near=math.inf, finish=False
    )

    def one(begin: Array) -> FitSolution:
        opened = with_values(begin, _opened(task, begin))
        return problem.fit(opened[place], short)

    return sorted(threads.run_each(one, begins), key=lambda t: t.merit)


def _long(task: SearchTask, value: Array, slopes: Array | None = None) -> FitSolution:
    """A fit to the end; ``slopes`` (p, n, y, x): of a place close by."""
    settings = SolverSettings(iterations=80, secant=True)
    return task.posed().fit(value, settings, slopes)


def _nearer(task: SearchTask, value: Array) -> FitSolution:
    """Near the lowest place on all frames, by a quick model put right where a short fit
    ended.
    """
    at = task.posed().fit(value, SolverSettings(iterations=0))
    settings = SolverSettings(
        iterations=20, step_tolerance=0.3, secant=True, near=1.0, finish=False
    )
    return correct_surrogate(task, at).posed().fit(at.value, settings, at.slopes)


def _opened(task: SearchTask, x: Array) -> dict[str, float]:
    """Sizes that have no slope at 0 start off it."""
    off = {"pinhole_um": 5.0, "bandwidth_nm": 0.5, "glass_um": 50.0}
    return {
        name: size
        for name, size in off.items()
        if name in task.names and x[PLACE[name]] == 0
    }


def names_of(known: dict[str, KnownValue], free: Sequence[str]) -> tuple[str, ...]:
    """What is fitted: the usual, what is asked for, what is known with an error.

    Args:
        free: names of further parameters.
    """
    for name in free:
        parameter_vector({name: 0.0})
    wanted = {p.name for p in PARAMETERS if p.free} | set(free)
    wanted |= {k.name for k in known.values() if k.sigma > 0}
    wanted -= {k.name for k in known.values() if k.sigma == 0 and k.name not in free}
    return tuple(name for name in NAMES if name in wanted)


def prior_of(
    names: Sequence[str], known: dict[str, KnownValue], lens: Lens
) -> GaussianPrior:
    """Priors of the fitted parameters: metrology where there is, else what is usual for
    such a lens.

    Args:
        names: (p,) names of the fitted parameters.
        known: stated values by name.
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


def window_um(found: FrameArrangement, model: ForwardModel) -> tuple[float, float]:
    """(x, y) of the window's middle from the chief ray, as the light lies in the
    frames.

    Args:
        found: how the frames lie.
        model: the forward model.
    """
    most = _ASIDE_UM * wavelength_scale(model.lens.wavelength_um)
    x, y = (
        float(np.clip(-shift * model.setting.pixel_um, -most, most))
        for shift in found.shift_px[::-1]
    )
    return x, y


def starting_points(
    task: SearchTask, *, biases_nm: Sequence[float] = (0.0, 8.0, -8.0)
) -> list[Array]:
    """Nominal, and the twins of the global bias (for 0.85 um); stage zero, place, gain,
    background off the frames.

    Args:
        task: model, frames, priors and arrangement of the search.
        biases_nm: bias of each start, nm at 0.85 um.
    """
    model, data, found = task.model, task.data, task.found
    if found is None:
        raise FitError("a search begins where the frames lie; arrange them first")
    place = window_um(found, model)
    level = float(np.median((data.electrons / model.setting.glow)[data.usable]))
    lies = {
        "stage_zero_um": found.stage_zero_um,
        "distance_um": found.distance_um,
        "background_e": level,
    }
    base = with_values(
        task.start, lies | {"decentre_x_um": place[0], "decentre_y_um": place[1]}
    )
    out = []
    for bias in biases_nm:
        x = with_values(
            base,
            {
                "bias_nm": base[PLACE["bias_nm"]]
                + bias * wavelength_scale(model.lens.wavelength_um)
            },
        )
        light = model.images(with_values(x, {"background_e": 0.0}))[0]
        keep = data.usable & ~data.saturated
        gain = float(
            (light * (data.electrons - level * model.setting.glow))[keep].sum()
            / (light[keep] ** 2).sum()
        )
        out.append(with_values(x, {"log_gain": math.log(max(gain, 1e-12))}))
    return out


def _leaning(plain: Array) -> list[Array]:
    """About its focus a lens with the opposite even aberrations gives nearly the same
    images.

    The plain start lies between the two: either sign of both astigmatisms.
    """
    even = ("astigmatism_rad", "oblique_astigmatism_rad")
    return [
        with_values(plain, {name: size})
        for name in even
        for size in (_LEANING_RAD, -_LEANING_RAD)
    ]


def _twins(task: SearchTask, best: FitSolution) -> list[Array]:
    """What was found with its even aberrations reversed, and moved along the valley of
    the bias to either side.
    """
    found = task.all_of(best.value)
    even = ("astigmatism_rad", "oblique_astigmatism_rad", "spherical_rad")
    out = [with_values(found, {name: -float(found[PLACE[name]]) for name in even})]
    if "bias_nm" in task.names:
        i = task.names.index("bias_nm")
        far_nm = _ALONG_NM * wavelength_scale(task.model.lens.wavelength_um)
        along = far_nm * best.covariance[:, i] / best.covariance[i, i]
        for sign in (1, -1):
            moved = np.clip(best.value + sign * along, task.prior.low, task.prior.high)
            out.append(task.all_of(moved))
    return out
