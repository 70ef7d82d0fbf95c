"""Effects that the fit leaves out: what each does to the images, its score test, and one
joint covariance of fitted parameters and effects that nobody stated.
"""

import contextlib
import copy
import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, stats

from characterize.captures import shift_frames
from characterize.inference.leastsquares import FitSolution, shared_error_scatter
from characterize.inference.multistart import SearchTask
from characterize.model import LIGHT, PARAMETERS, PLACE, background_planes, type_b_sigma
from metalens.core.arrays import Array
from metalens.core.errors import FitError
from metalens.fabrication import CDError, ResponseError, names_of_kind
from metalens.lens import Lens

# significance of one cause: with 28 causes one fit in 350 reports an absent one
CHANCE = 1e-4
# Bayes factor above which a cause is fitted: by chance in one fit of 100 or fewer
ODDS = 10.0
_SHIFTS, _NEAREST_PX, _FARTHEST_PX = 400, 3, 14  # of a ghost: number and range
_CLIP = 6.0  # largest residual that counts, sigma
# amounts by which the causes are probed
_STOP_UM = 3.0
_WALL_DEG = 1.5
# share below which a turn of light is the error of its slopes: that light is round
_ROUND = 0.02

_TILTED = {"glass_um": 100.0, "glass_tilt_x_deg": 0.0, "glass_tilt_y_deg": 0.0}
_SQUARE = ("pinhole_um", "bandwidth_nm")  # blur acts as the square of its size
_OF_MASK = {*names_of_kind(CDError), *names_of_kind(ResponseError)}


@dataclass(frozen=True, eq=False, slots=True)
class SystematicEffect:
    """An effect that is not fitted, and (k, n, y, x) changes of the images by it.

    sigma: standard deviation of the factor of each change, assumed where nobody states
    it; one for all or one for each, 0 for none.
    frees: parameters that describe the effect. stated: whether one of these is stated
    without an error: it is not fitted then.
    of_mask: the effect belongs to the lens itself. positive: its amount cannot be
    below 0. cure: what to do where the residuals lean to it.
    """

    cause: str
    images: Array
    sigma: float | Array = 0.0
    frees: tuple[str, ...] = ()
    stated: bool = False
    of_mask: bool = False
    positive: bool = False
    cure: str = "state it, free it, or mend the bench"

    @property
    def has_size(self) -> bool:
        """Whether it is taken to have some size."""
        return bool(np.any(self.sigma))

    def standardize_changes(self, changes: Array) -> Array:
        """(k, pixels) ``changes`` by it, of one standard deviation each."""
        return np.reshape(self.sigma, (-1, 1)) * changes


@dataclass(frozen=True, slots=True)
class ResidualFinding:
    """Structure of the residuals in addition to noise, in words, and its significance in sigma."""

    words: str
    sigma: float


@dataclass(frozen=True, eq=False, slots=True)
class ScoreTest:
    """Score test of one effect: chi-square by which the residuals lean along it, degrees
    of freedom, and the chance of that.

    odds: for it, as large as is assumed, against its absence; 0 where no size is known
    or no parameter describes it.
    """

    effect: SystematicEffect
    chi2: float = 0.0
    degrees: int = 0
    chance: float = 1.0
    odds: float = 0.0


@dataclass(frozen=True, eq=False, slots=True)
class UnmodelledShifts:
    """What effects that nobody stated add to the covariance of the parameters.

    covariance: (p, p) marginal less conditional covariance of the joint posterior of
    parameters and effects. mean: (p,) shift from its optimum to that of the parameters
    alone. bench: the part of ``covariance`` by effects that the lens leaves behind with
    the bench; the others act on its light as the parameters do that took them up.
    causes, by_cause: (c, p) standard deviation by each.
    """

    causes: tuple[str, ...]
    by_cause: Array
    covariance: Array
    bench: Array
    mean: Array

    @property
    def sigma(self) -> Array:
        """(p,) standard deviation that all effects add in quadrature."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


@dataclass(frozen=True, eq=False, slots=True)
class FitAtMode:
    """Normal equations at the mode: slopes J (p, pixels) over the noise, information K
    with the priors, and the residuals r.

    shared: (2, n, y, x) errors of dark and of flat that are one in all frames, over the
    noise. pull: (p,) of the priors, which the residuals along the slopes balance at the
    mode.
    """

    slopes: Array
    information: Array
    residual: Array
    shared: Array
    pull: Array

    def project_out(self, changes: Array) -> tuple[Array, Array, Array]:
        """(k, pixels) changes G less what the fit takes up, their (k,) scores, and the
        (k, p) shifts M of the parameters that take it up.

        G' = G - M J with M = G Jᵀ K⁻¹. The score G'ᵀr + Mᵀ pull equals Gᵀr at the mode
        and does not change to first order off it.
        """
        moved = np.linalg.solve(self.information, self.slopes @ changes.T).T
        left = changes - moved @ self.slopes
        return left, left @ self.residual + moved @ self.pull, moved

    def score_test(self, effect: SystematicEffect, changes: Array) -> ScoreTest:
        """Score test (Rao) of an effect by its changes G (k, pixels).

        Chi-square sᵀS⁻¹s of the scores s with their scatter S. Directions taken up to
        all but a thousandth are left out. Where the amount is positive, a score below 0
        speaks for none.
        """
        size = np.sqrt((changes**2).sum(1))
        unit = changes[size > 0] / size[size > 0, None]
        left, score, _ = self.project_out(unit)
        values, vectors = np.linalg.eigh(unit @ left.T)
        vectors = vectors[:, values > 1e-3]
        degrees = vectors.shape[1]
        if not degrees or (effect.positive and score[0] <= 0):
            return ScoreTest(effect)
        scatter = vectors.T @ (unit @ left.T + self.shared_scatter(left)) @ vectors
        chi2 = float(score @ vectors @ np.linalg.solve(scatter, vectors.T @ score))
        chance = float(stats.chi2.sf(chi2, degrees))
        likely = effect.has_size and effect.frees and not effect.stated
        odds = self.odds(effect.standardize_changes(changes)) if likely else 0.0
        return ScoreTest(effect, chi2, degrees, chance, odds)

    def joint_amounts(self, changes: Array) -> tuple[Array, Array, Array]:
        """Joint posterior of the factors c of (k, pixels) changes G of one standard
        deviation each: (k, k) covariance C, (k,) H S⁻¹ s of the mean C H S⁻¹ s, and the
        (k, p) shifts M of the parameters.

        H = G G'ᵀ is the Schur complement of the parameters in the normal matrix of
        both, S = H + errors that all frames share the scatter of the scores s, and
        C = (1 + H S⁻¹ H)⁻¹.
        """
        left, score, moved = self.project_out(changes)
        effect = changes @ left.T
        scatter = effect + self.shared_scatter(left)
        scatter += max(1e-9 * float(np.trace(scatter)), 1e-300) * np.eye(len(scatter))
        weight = np.linalg.solve(scatter, effect)
        covariance = np.linalg.inv(np.eye(len(effect)) + effect @ weight)
        return covariance, weight.T @ score, moved

    def odds(self, changes: Array) -> float:
        """Bayes factor of a cause against its absence, at most exp(100).

        With t = H S⁻¹ s and C of :meth:`joint_amounts`, integration over its factors c,
        N(0, 1), gives exp(tᵀC t / 2) (det C)^½.

        Args:
            changes: (k, pixels) of one standard deviation each.
        """
        covariance, weighted, _ = self.joint_amounts(changes)
        explained = float(weighted @ covariance @ weighted) / 2
        log_odds = explained + float(np.linalg.slogdet(covariance)[1]) / 2
        return math.exp(min(log_odds, 100.0))

    def unmodelled_shifts(
        self, effects: Sequence[SystematicEffect], changes: Sequence[Array]
    ) -> UnmodelledShifts:
        """Marginal less conditional covariance of the parameters: M C Mᵀ by the
        posterior C of the ``effects``, whose ``changes`` are (k, pixels) of one
        standard deviation each.
        """
        every = np.concatenate([np.empty((0, self.slopes.shape[1])), *changes])
        number = np.repeat(np.arange(len(effects)), [len(change) for change in changes])
        of_bench = np.array([not e.of_mask for e in effects], bool)[number]
        covariance, weighted, moved = self.joint_amounts(every)

        def moment(some: Array) -> Array:
            part = moved[some]
            return np.asarray(part.T @ covariance[np.ix_(some, some)] @ part)

        variances = [np.diag(moment(number == k)) for k in range(len(effects))]
        return UnmodelledShifts(
            tuple(effect.cause for effect in effects),
            np.sqrt(np.maximum(variances, 0)).reshape(-1, len(self.slopes)),
            moment(number >= 0),
            moment(of_bench),
            covariance @ weighted @ moved,
        )

    def shared_scatter(self, left: Array) -> Array:
        """(k, k) additional scatter of the scores of ``left`` (k, pixels) by errors
        that all frames share (:func:`leastsquares.shared_error_scatter`).
        """
        changes = left.reshape(-1, *self.shared.shape[1:])
        return shared_error_scatter(changes, self.shared)


def run_score_tests(
    task: SearchTask, mode: FitSolution
) -> tuple[list[ScoreTest], UnmodelledShifts]:
    """Score tests of every cause that is not fitted, the least probable by chance
    first, and what causes of assumed size add to the covariance.

    Each cause changes the images by G; tested is whether the residuals lean along the
    part of G that the fit does not take up. Image and slopes are those of the fit.
    Where chi-square exceeds 1, noise is scaled by its root.

    Args:
        task: model, frames and priors of the search.
        mode: the fit it is judged at.
    """
    x = task.all_of(mode.value)
    # 1 / sigma of every pixel, 0 where it is not counted
    counted = task.data.usable & ~task.data.saturated
    root = np.where(counted, 1 / np.sqrt(task.data.variance(mode.image)), 0.0)
    fitted = (mode.slopes * root).reshape(len(task.names), -1)
    weight = task.prior.sigma**-2.0
    over = math.sqrt(max(1.0, mode.chi2_per_dof))
    fit = FitAtMode(
        fitted,
        fitted @ fitted.T + np.diag(weight),
        (np.clip(mode.residual_sigma, -_CLIP, _CLIP) * (root > 0)).ravel() / over,
        task.data.shared(mode.image) * root,
        (mode.value - task.prior.mean) * weight / over,
    )
    by_name = dict(zip(task.names, mode.slopes, strict=True))
    tests, assumed, changes = list[ScoreTest](), list[SystematicEffect](), list[Array]()
    for effect in systematic_effects(task, x, by_name):
        change = (effect.images * root).reshape(len(effect.images), -1)
        tests.append(fit.score_test(effect, change))
        if effect.has_size:
            assumed.append(effect)
            changes.append(effect.standardize_changes(change))
    tests.append(_ghost(task, x, mode.image, root, fit))
    tests = [test for test in tests if test.degrees]
    tests.sort(key=lambda test: (test.chance, -test.chi2))
    return tests, fit.unmodelled_shifts(assumed, changes)


def expected_shifts(task: SearchTask) -> UnmodelledShifts:
    """What unstated effects add to the covariance of a fit of frames not taken yet.

    At the task's start, with residuals of 0.
    """
    return run_score_tests(task, task.at_start())[1]


def effects_to_fit(
    score_tests: list[ScoreTest], *, stuck: bool = False
) -> list[ScoreTest]:
    """Causes to fit next: those that have parameters and may explain the frames.

    Those that the residuals lean to beyond chance; else those whose odds exceed
    ``ODDS``, likeliest first. At most five.

    Args:
        score_tests: score tests.
        stuck: a parameter ran to its bound: any unstated cause may be behind it.
    """
    free = [test for test in score_tests if test.effect.frees]
    clear = [test for test in free if test.chance < CHANCE]
    likely = sorted(
        (test for test in free if test.odds > ODDS), key=lambda test: -test.odds
    )
    if stuck:
        clear = [test for test in free if not test.effect.stated]
    return (clear or likely)[:5]


def score_test_text(score_tests: list[ScoreTest]) -> list[ResidualFinding]:
    """Sentence on the cause that the residuals lean to most, with the next three.

    Empty where all is chance. Significance in sigma of a normal variable of equal
    probability.

    Args:
        score_tests: score tests, the most telling first.
    """
    clear = [test for test in score_tests if test.chance < CHANCE]
    if not clear:
        return []
    first, effect = clear[0], clear[0].effect
    others = [test.effect.cause for test in clear[1:4]]
    more = f"; {', '.join(others)} would explain much of it too" if others else ""
    sigma = float(stats.norm.isf(max(first.chance, 1e-300) / 2))
    why = "as stated" if effect.stated else "not fitted"
    said = (
        f"residuals lean towards {effect.cause}, which is {why} ({sigma:.1f} sigma: "
        f"chi-square {first.chi2:.0f} with {first.degrees} degrees of freedom){more}: "
        f"intervals hold only if it is absent; {effect.cure}"
    )
    return [ResidualFinding(said, sigma)]


def _ghost(
    task: SearchTask, x: Array, image: Array, root: Array, fit: FitAtMode
) -> ScoreTest:
    """Score test of a ghost: a fainter, shifted copy of the light at any shift.

    The shift that explains most, of about ``_SHIFTS`` by ``_NEAREST_PX`` to
    ``_FARTHEST_PX`` pixels; its chance is that of the best of all (Bonferroni).
    """
    light = image - background_planes(x, task.model.setting)
    reach = min(_FARTHEST_PX, min(light.shape[1:]) // 2 - 1)
    steps = range(-reach, reach + 1)
    places = [
        (i, j) for i in steps for j in steps if max(abs(i), abs(j)) >= _NEAREST_PX
    ]
    ghost = SystematicEffect(
        "a ghost: a fainter, shifted copy of the light", light, positive=True
    )
    best = ScoreTest(ghost, degrees=int(bool(places)))
    for shift in places[:: math.ceil(len(places) / _SHIFTS) or 1]:
        copy = (shift_frames(light, shift) * root).reshape(1, -1)
        best = max(best, fit.score_test(ghost, copy), key=lambda test: test.chi2)
    chance = min(1.0, min(len(places), _SHIFTS) * best.chance / 2)
    return dataclasses.replace(best, chance=chance)


def systematic_effects(
    task: SearchTask, x: Array, slopes: dict[str, Array]
) -> Iterator[SystematicEffect]:
    """Changes of the images by every systematic effect that is not fitted.

    Args:
        task: model, frames and priors of the search.
        x: all parameters, in the order of ``PARAMETERS``.
        slopes: derivatives of the images by the fitted parameters.
    """
    model = task.model
    image = model.images(x)[0]
    yield from _of_model(task, x, image)
    if "sidewall_deg" not in task.names or model.lens.cell.sidewall_rad == 0:
        leaning = model.with_walls(math.radians(_WALL_DEG)).images(x)[0] - image
        yield SystematicEffect(
            "a side wall that leans about half height",
            leaning[None],
            (assumed_size(task, "sidewall_deg") / _WALL_DEG) ** 2,
            of_mask=True,
            positive=True,
        )
    light = image - background_planes(x, model.setting)
    yield SystematicEffect("vibration or blur along one direction", _along_one(light))
    yield SystematicEffect(
        "pixels of 2 x 2 with different shares of the light (a raw colour mosaic)",
        _of_mosaic(light),
    )
    yield SystematicEffect(
        "counts that are not in proportion to the light (a gamma)", _of_gamma(light)
    )
    # derivatives by the place of every pixel, per pixel
    across = np.asarray(model.images(x, ("decentre_x_um", "decentre_y_um"))[1])
    across *= model.setting.pixel_um
    if len(image) > 2:
        yield from _of_frames(light, slopes, across)
    yield from _of_pixels(task, across)
    yield from _of_stop(task, x, image)
    fixed = tuple(name for name in LIGHT if name not in task.names)
    if fixed:
        frees = tuple(name for name in fixed if not is_stated_exactly(task, name))
        yield SystematicEffect(
            "uneven illumination",
            np.asarray(model.images(x, fixed)[1]),
            np.array([assumed_size(task, name) for name in fixed]),
            frees or fixed,
            not frees,
        )
    phases = functools.partial(write_field_phases, model.lens)
    names = [f"residual_{k}" for k in range(32)]
    yield SystematicEffect(
        "write fields out of place, or another smooth phase error",
        np.asarray(model.with_residual(phases).images(x, names)[1]),
        assumed_size(task, "stitching_nm") * 1e-3,
        of_mask=True,
    )


def _of_model(task: SearchTask, x: Array, image: Array) -> Iterator[SystematicEffect]:
    """Changes by parameters of the model that are not fitted, each by its probe amount.

    Tilts of the glass without glass are those of a plate of 100 um.
    """
    for row in (row for row in PARAMETERS if row.effect):
        name, amount = row.name, row.probe
        base: dict[str, float] = {}
        if name.startswith("glass_tilt") and x[PLACE["glass_um"]] == 0:
            if "glass_um" in task.known:
                continue
            base = _TILTED
        if name in task.names:
            continue
        before, after = x.copy(), x.copy()
        for key, value in base.items():
            before[PLACE[key]] = after[PLACE[key]] = value
        after[PLACE[name]] += amount
        # a spectrum beyond the proxy's range, or a plate that does not fit, is skipped
        with contextlib.suppress(FitError):
            first = task.model.images(before)[0] if base else image
            change = task.model.images(after)[0] - first
            yield SystematicEffect(
                row.effect.format(before[PLACE["glass_um"]]),
                change[None],
                (assumed_size(task, name) / amount) ** (2 if name in _SQUARE else 1),
                ("glass_um", name) if base else (name,),
                is_stated_exactly(task, name),
                of_mask=name in _OF_MASK,
                positive=before[PLACE[name]] <= row.low,
            )


def _of_frames(
    light: Array, slopes: dict[str, Array], across: Array
) -> Iterator[SystematicEffect]:
    """Changes of single frames: brightness, shifts, blur, stage, and wavelength drift.

    Args:
        light: (n, y, x) images without background.
        slopes: derivatives of the images by the fitted parameters.
        across: (2, n, y, x) derivatives by a shift along x and along y.
    """
    yield SystematicEffect(
        "a lamp or exposure that changes from frame to frame",
        _each(light),
        cure="state the light of every frame, by a monitor diode, in proportion as "
        "exposure_s of stage.csv",
    )
    yield SystematicEffect(
        "shifts from frame to frame", np.concatenate([*map(_each, across)])
    )
    yield SystematicEffect(
        "vibration or blur in single frames", _each(_curvature(light))
    )
    if "stage_zero_um" in slopes:
        yield SystematicEffect(
            "a stage error in single frames", _each(slopes["stage_zero_um"])
        )
    if "wavelength_nm" in slopes:
        ramp = np.linspace(-1, 1, len(light))[:, None, None]
        yield SystematicEffect(
            "a wavelength that drifts", (slopes["wavelength_nm"] * ramp)[None]
        )


def _of_pixels(task: SearchTask, across: Array) -> Iterator[SystematicEffect]:
    """Changes by pixels at other places: turned axes, a larger pitch along y, and
    windows of one field angle that are off along x and y.

    The first angle is left out, as decentre moves all windows.

    Args:
        across: (2, n, y, x) derivatives by a shift of a pixel along x and along y.
    """
    setting = task.model.setting
    by_x, by_y = across
    # (y, x) of the pixels from the window's middle
    y, x = (edge * n / 2 for edge, n in zip(setting.edges, by_x.shape[1:], strict=True))
    turned = np.radians(x * by_y - y * by_x)  # by one degree from +x to +y
    if np.abs(turned).max() > _ROUND * np.radians(np.abs(x * by_y)).max():
        size_deg = assumed_size(task, "camera_turn_deg")
        yield SystematicEffect("a camera that is turned", turned[None], size_deg)
    yield SystematicEffect("pixels that are not as high as wide", (y * by_y)[None])
    groups = task.model.groups[1:]
    if groups:
        moved = np.zeros((len(groups), *across.shape))
        for k, group in enumerate(groups):
            moved[k, :, group.index] = across[:, group.index].swapaxes(0, 1)
        changes = moved.reshape(-1, *by_x.shape)
        yield SystematicEffect(
            "a window off the chief ray at a field angle",
            changes,
            assumed_size(task, "window_px"),
            cure="cut the frames of every angle about its chief ray, distance times "
            "tan(angle) off that on the axis",
        )


def _of_stop(task: SearchTask, x: Array, image: Array) -> Iterator[SystematicEffect]:
    """Changes by an aperture stop off its place, along x and along y.

    The illuminated part of the lens moves, as by a tilt of the lens.
    """
    stop = task.model.lens.layers.stop
    if stop is None:
        return
    model = copy.copy(task.model)
    for along in (0, 1):
        centre = np.add(stop.centre_um, _STOP_UM * np.eye(2)[along])
        moved = dataclasses.replace(
            stop, centre_um=(float(centre[0]), float(centre[1]))
        )
        layers = dataclasses.replace(task.model.lens.layers, stop=moved)
        model.lens = dataclasses.replace(task.model.lens, layers=layers)
        depth_um = model.setting.depth_um
        model.groups = [g.shaded(model.lens, depth_um) for g in task.model.groups]
        yield SystematicEffect(
            f"an aperture stop off along {'xy'[along]}",
            (model.images(x)[0] - image)[None],
            assumed_size(task, "stop_um") / _STOP_UM,
        )


def is_stated_exactly(task: SearchTask, name: str) -> bool:
    """Whether a parameter is stated without an error: it stays as stated, whatever the
    residuals lean to.

    Args:
        task: with what is known.
        name: of the parameter.
    """
    return name in task.known and task.known[name].sigma == 0


def assumed_size(task: SearchTask, name: str) -> float:
    """Standard deviation of a cause: as stated, else a Type B estimate.

    0 where it is fixed as stated.

    Args:
        task: with what is known, and the sizes that are stated.
        name: of a parameter, or of an unfitted effect.
    """
    if name in task.unfitted:
        return task.unfitted[name]
    stated = task.known.get(name)
    if stated is None:
        return type_b_sigma(name, task.model.lens)
    if name == "sidewall_deg":  # the model has upright walls: the mean counts too
        return math.hypot(stated.sigma, stated.value)
    return stated.sigma


def write_field_phases(lens: Lens, u: Array, v: Array) -> Array:
    """(32, *shape) phases of one write field that is moved by 1 um along x, then along
    y, at places (u, v) on the lens over its radius, rad.

    Four fields across the lens each way. The focusing phase has the slope
    k x (1 / hypot(r, d) + 1 / hypot(r, s)) at place x along the axis, with focal
    distance d and source distance s.
    """
    radius = lens.diameters.radius_um
    r = radius * np.hypot(u, v)
    sine = 1 / np.hypot(r, lens.reduced_um)
    if lens.source_distance_um > 0:
        sine = sine + 1 / np.hypot(r, lens.source_distance_um)
    sine *= 2 * math.pi / lens.wavelength_um * radius
    row, column = (np.clip(np.floor(2 * (w + 1)), 0, 3) for w in (v, u))
    inside = 4 * row + column == np.arange(16).reshape(-1, *(1,) * u.ndim)
    return np.concatenate([inside * sine * u, inside * sine * v])


def _each(change: Array) -> Array:
    """(n, n, y, x): every frame's change alone."""
    out = np.zeros((len(change), *change.shape))
    out[np.arange(len(change)), np.arange(len(change))] = change
    return out


def _along_one(light: Array) -> Array:
    """(2, n, y, x) changes by a directional blur: xx - yy and 2 xy second differences.

    A blur of variance s² wider along x than along y, or along one diagonal than along
    the other, changes the light by s²/2 of these. Round blur has parameters of its
    own.
    """
    xx, yy = (
        ndimage.correlate1d(light, [1.0, -2.0, 1.0], axis, mode="nearest")
        for axis in (2, 1)
    )
    return np.stack([xx - yy, 2 * np.gradient(np.gradient(light, axis=1), axis=2)])


def _of_gamma(light: Array) -> Array:
    """(1, n, y, x): I^(1 + e) of light I over its peak is I + e I ln I."""
    share = np.maximum(light / light.max(), 1e-6)
    return np.asarray((share * np.log(share))[None])


def _of_mosaic(light: Array) -> Array:
    """(3, n, y, x): light of every second pixel, as waves over rows, columns and both;
    the fourth share is the gain.
    """
    y, x = ((-1.0) ** np.arange(n) for n in light.shape[1:])
    return np.stack([light * y[:, None], light * x, light * y[:, None] * x])


def _curvature(light: Array) -> Array:
    return np.stack([ndimage.laplace(frame, mode="nearest") for frame in light])
