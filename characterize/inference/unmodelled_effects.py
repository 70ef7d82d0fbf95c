"""Causes that the fit leaves out: each leans the residuals its own way, and is looked
for along that (score test).
"""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from characterize.captures import shift_frames
from characterize.inference import systematic_effects
from characterize.inference.leastsquares import FitSolution
from characterize.inference.multistart import SearchTask
from characterize.inference.systematic_effects import ImageChange
from characterize.model import PLACE, background_planes
from metalens.core.arrays import Array

# significance of one cause: with 28 causes one fit in 350 reports an absent one
CHANCE = 1e-4
# Bayes factor above which a cause is fitted: by chance in one fit of 100 or fewer
ODDS = 10.0
_SHIFTS, _NEAREST_PX, _FARTHEST_PX = 400, 3, 14  # of a ghost: number and range
# sigma of chi-square above which dark spots are tested; their spacing over the radius
_PATCHY, _SPOT = 3.0, 0.2

_CURES = {
    systematic_effects.LAMP: "state the light of every frame, by a monitor diode, in proportion as "
    "exposure_s of stage.csv",
    systematic_effects.WINDOWS: "cut the frames of every angle about its chief ray, distance times "
    "tan(angle) off that on the axis",
}


@dataclass(frozen=True, slots=True)
class ResidualFinding:
    """Structure of the residuals in addition to noise, in words, and its significance in sigma."""

    words: str
    sigma: float


def decisive_findings(
    findings: Sequence[ResidualFinding], sigma: float = 5.0
) -> list[str]:
    """Findings beyond ``sigma``, in words: no fit with one passes its checks.

    Args:
        findings: what residuals hold.
    """
    return [finding.words for finding in findings if finding.sigma > sigma]


@dataclass(frozen=True, slots=True)
class ScoreTest:
    """Score test of one cause: its words, chi-square by which the residuals lean along
    it, degrees of freedom, and the chance of that.

    frees: parameters that describe it. stated: whether one is stated without an error:
    it is not fitted then. odds: for it, as large as is assumed, against its absence; 0
    where no size is known.
    """

    cause: str
    chi2: float
    degrees: int
    chance: float
    frees: tuple[str, ...] = ()
    odds: float = 0.0
    stated: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class ScoreTests:
    """Score tests, the least probable by chance first, at a fit, and the causes of
    assumed size as changes (k, pixels) over the noise, of one standard deviation each.
    """

    tests: list[ScoreTest]
    fit: "FitAtMode"
    unstated: tuple[ImageChange, ...]

    def shifts(self) -> "UnmodelledShifts":
        """Shifts of the parameters by causes that nobody stated: the marginal less the
        conditional covariance of one joint Gaussian posterior.

        Causes have factors c of their changes, N(0, 1) or, where the change is well
        known, their posterior (:meth:`FitAtMode.amounts`). The parameters shift by M c
        with M = K⁻¹ A Gᵀ; second moments are summed over the causes.
        """
        p = len(self.fit.names)
        sizes = [len(cause.images) for cause in self.unstated]
        changes = [cause.images for cause in self.unstated]
        every = np.concatenate([np.empty((0, len(self.fit.residual))), *changes])
        number = np.repeat(np.arange(len(sizes)), sizes)
        exact = np.array([not cause.roughly for cause in self.unstated], bool)[number]
        bench = np.array([not cause.of_mask for cause in self.unstated], bool)[number]
        # of a change of 0 the posterior is the prior
        covariance, pull = self.fit.amounts(every * exact[:, None])
        amount = covariance @ pull
        second = covariance + np.outer(amount, amount)
        moved = self.fit.moved_by(every)

        def moment(some: Array) -> Array:
            part = moved[:, some]
            return np.asarray(part @ second[np.ix_(some, some)] @ part.T)

        by_cause = [np.diag(moment(number == k)) for k in range(len(sizes))]
        return UnmodelledShifts(
            tuple(cause.cause for cause in self.unstated),
            np.sqrt(np.maximum(by_cause, 0)).reshape(-1, p),
            moment(np.ones(len(every), bool)),
            moment(bench),
            moved @ amount,
            np.sqrt(np.maximum(np.diag(moved @ covariance @ moved.T), 0)),
        )


@dataclass(frozen=True, eq=False, slots=True)
class UnmodelledShifts:
    """Root mean square shift of each parameter by each effect that nobody stated:
    causes, (c, p) shifts.

    covariance: (p, p) second moment of the shifts by all of them. bench: the same by
    those that the lens leaves behind
    with the bench; the others act on its light as the parameters do that took them up.
    mean, spread: (p,) expected shift of each parameter by all of them, given the
    frames, and its standard deviation.
    """

    causes: tuple[str, ...]
    by_cause: Array
    covariance: Array
    bench: Array
    mean: Array
    spread: Array

    @property
    def sigma(self) -> Array:
        """(p,) standard deviation of the shifts by all causes."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


def run_score_tests(task: SearchTask, mode: FitSolution) -> ScoreTests:
    """Score tests of every cause that is not fitted, at the end of a fit.

    Each cause changes the images by G; tested is whether the residuals lean along the
    part of G that the fit does not take up. Image and slopes are those of the fit.
    Where chi-square exceeds 1, noise is scaled by its root.

    Args:
        task: model, frames, priors and arrangement of the search.
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
        task.names,
        fitted,
        fitted @ fitted.T + np.diag(weight),
        (np.clip(mode.residual_sigma, -6, 6) * (root > 0)).ravel() / over,
        task.data.shared(mode.image) * root,
        (mode.value - task.prior.mean) * weight / over,
    )
    tests, unstated = list[ScoreTest](), list[ImageChange]()
    by_name = dict(zip(task.names, mode.slopes, strict=True))
    for effect in systematic_effects.systematic_changes(task, x, by_name):
        change = (effect.images * root).reshape(len(effect.images), -1)
        test = dataclasses.replace(
            fit.score_test(effect.cause, change),
            frees=effect.frees,
            stated=effect.stated,
        )
        if effect.positive and fit.residual_changes(change)[1][0] <= 0:
            test = ScoreTest(effect.cause, 0.0, 0, 1.0)
        if np.any(effect.sigma):
            assumed = np.reshape(effect.sigma, (-1, 1)) * change
            unstated.append(dataclasses.replace(effect, images=assumed))
            if test.frees and not test.stated:
                test = dataclasses.replace(test, odds=fit.odds(assumed))
        tests.append(test)
    tests.append(_ghost(task, x, mode.image, root, fit))
    pixels = max(float((root > 0).sum()), 1.0)
    if mode.chi2_per_dof > 1 + _PATCHY * math.sqrt(2 / pixels):
        tests.append(_patch(task, x, root, fit))
    tests = [test for test in tests if test.degrees]
    tests.sort(key=lambda test: (test.chance, -test.chi2))
    return ScoreTests(tests, fit, tuple(unstated))


def expected_score_tests(task: SearchTask) -> UnmodelledShifts:
    """Shifts by unfitted causes to be expected of frames not taken yet.

    At the task's start, with residuals of 0.
    """
    image, slopes = task.model.images(task.start, task.names)
    p = len(task.names)
    value = task.start[[PLACE[name] for name in task.names]]
    none = np.zeros_like(image)
    mode = FitSolution(
        value,
        np.eye(p),
        np.eye(p),
        image,
        none,
        1.0,
        0.0,
        True,
        "",
        0,
        np.zeros(p),
        np.asarray(slopes),
    )
    return run_score_tests(task, mode).shifts()


def to_fit(
    score_tests: list[ScoreTest], *, stuck: bool = False, most: int = 5
) -> list[ScoreTest]:
    """Causes to fit next: those that have parameters and may explain the frames.

    Those that the residuals lean to beyond chance; else those whose odds exceed
    ``ODDS``, likeliest first. At most ``most``.

    Args:
        score_tests: score tests.
        stuck: a parameter ran to its bound: any unstated cause may be behind it.
        most: causes that are fitted in turn to see which explains most.
    """
    free = [test for test in score_tests if test.frees]
    clear = [test for test in free if test.chance < CHANCE]
    likely = sorted(
        (test for test in free if test.odds > ODDS), key=lambda test: -test.odds
    )
    if stuck:
        clear = [test for test in free if not test.stated]
    return (clear or likely)[:most]


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
    first = clear[0]
    others = [test.cause for test in clear[1:4]]
    more = f"; {', '.join(others)} would explain much of it too" if others else ""
    cure = _CURES.get(first.cause, "state it, free it, or mend the bench")
    sigma = float(stats.norm.isf(max(first.chance, 1e-300) / 2))
    why = "as stated" if first.stated else "not fitted"
    said = (
        f"residuals lean towards {first.cause}, which is {why} ({sigma:.1f} sigma: "
        f"chi-square {first.chi2:.0f} with {first.degrees} degrees of freedom){more}: "
        f"intervals hold only if it is absent; {cure}"
    )
    return [ResidualFinding(said, sigma)]


@dataclass(frozen=True, eq=False, slots=True)
class FitAtMode:
    """The fit at its mode: slopes (p, pixels) over the noise, their information with
    the priors, and the residuals.

    shared: (2, n, y, x) errors of dark and of flat that are one in all frames, over the
    noise. pull: (p,) of the
    priors, which the residuals along the slopes balance at the mode.
    """

    names: tuple[str, ...]
    slopes: Array
    information: Array
    residual: Array
    shared: Array
    pull: Array

    def score_test(self, cause: str, changes: Array) -> ScoreTest:
        """Score test of a cause by its changes G (k, pixels).

        Score s = G'ᵀr of the part G' that the fit does not take up; chi-square sᵀS⁻¹s
        with S its scatter. Directions taken up to all but a thousandth are left out.
        """
        size = np.sqrt((changes**2).sum(1))
        changes = changes[size > 0] / size[size > 0, None]
        if not len(changes):
            return ScoreTest(cause, 0.0, 0, 1.0)
        left, score = self.residual_changes(changes)
        values, vectors = np.linalg.eigh(changes @ left.T)
        vectors = vectors[:, values > 1e-3]
        degrees = vectors.shape[1]
        if not degrees:
            return ScoreTest(cause, 0.0, 0, 1.0)
        scatter = vectors.T @ (changes @ left.T + self.shared_scatter(left)) @ vectors
        chi2 = float(score @ vectors @ np.linalg.solve(scatter, vectors.T @ score))
        return ScoreTest(cause, chi2, degrees, float(stats.chi2.sf(chi2, degrees)))

    def residual_changes(self, changes: Array) -> tuple[Array, Array]:
        """(k, pixels) changes less what the fit takes up, and their (k,) scores.

        G' = G - M J of changes G, with shifts M and slopes J. The score is G'ᵀr + Mᵀ
        pull, which equals Gᵀr at the mode and does not change to first order off it.
        """
        moved = self.moved_by(changes).T
        left = changes - moved @ self.slopes
        return left, left @ self.residual + moved @ self.pull

    def moved_by(self, changes: Array) -> Array:
        """(p, k) shift M of the parameters by (k, pixels) changes."""
        return np.asarray(np.linalg.solve(self.information, self.slopes @ changes.T))

    def odds(self, changes: Array) -> float:
        """Bayes factor of a cause against its absence, at most exp(100).

        With t = H S⁻¹ s and C = (1 + H S⁻¹ H)⁻¹, integration over its factors c,
        N(0, 1), gives exp(tᵀC t / 2) (det C)^½.

        Args:
            changes: (k, pixels) of one standard deviation each.
        """
        covariance, weighted = self.amounts(changes)
        explained = float(weighted @ covariance @ weighted) / 2
        log_odds = explained + float(np.linalg.slogdet(covariance)[1]) / 2
        return math.exp(min(log_odds, 100.0))

    def amounts(self, changes: Array) -> tuple[Array, Array]:
        """Posterior of the factors c of (k, pixels) changes G of one standard deviation
        each, given the frames: (k, k) covariance C and (k,) H S⁻¹ s, of mean C H S⁻¹ s.

        With H = GᵀG' and S the scatter of their scores s, C = (1 + H S⁻¹ H)⁻¹.
        """
        left, score = self.residual_changes(changes)
        effect = changes @ left.T
        scatter = effect + self.shared_scatter(left)
        scatter += max(1e-9 * float(np.trace(scatter)), 1e-300) * np.eye(len(scatter))
        weight = np.linalg.solve(scatter, effect)
        return np.linalg.inv(np.eye(len(effect)) + effect @ weight), weight.T @ score

    def shared_scatter(self, left: Array) -> Array:
        """(k, k) additional scatter of scores by errors that all frames share.

        Errors of dark and of flat; less what of the dark is in the noise already.

        Args:
            left: (k, pixels) changes that the fit does not take up.
        """
        shape = self.shared.shape[1:]
        dark, flat = (
            (left.reshape(-1, *shape) * error).sum(1).reshape(len(left), -1)
            for error in self.shared
        )
        counted = left * self.shared[0].ravel()
        return np.asarray(dark @ dark.T + flat @ flat.T - counted @ counted.T)


def _strongest(
    changes: Iterable[Array], root: Array, fit: FitAtMode
) -> tuple[float, int, float]:
    """The change above 0 that explains most: (chi-square, index, chance).

    The chance is that of the best of all changes (Bonferroni).

    Args:
        changes: (n, y, x) each.
        root: (n, y, x) 1 / sigma of the pixels.
    """
    best, index, count = 0.0, 0, 0
    for image in changes:
        change = (image * root).reshape(1, -1)
        left, score = fit.residual_changes(change)
        effect = float((change * left).sum())
        if effect > 1e-3 * float((change**2).sum()) and score[0] > 0:
            chi2 = float(score[0]) ** 2 / (
                effect + float(fit.shared_scatter(left)[0, 0])
            )
            best, index = max((best, index), (chi2, count))
        count += 1
    return best, index, min(1.0, count * float(stats.chi2.sf(best, 1)) / 2)


def _ghost(
    task: SearchTask, x: Array, image: Array, root: Array, fit: FitAtMode
) -> ScoreTest:
    """Score test of a ghost: a fainter, shifted copy of the light at any shift.

    Up to about ``_SHIFTS`` shifts of ``_NEAREST_PX`` to ``_FARTHEST_PX`` pixels.
    """
    light = image - background_planes(x, task.model.setting)
    reach = min(_FARTHEST_PX, min(light.shape[1:]) // 2 - 1)
    steps = range(-reach, reach + 1)
    places = [
        (i, j) for i in steps for j in steps if max(abs(i), abs(j)) >= _NEAREST_PX
    ]
    places = places[:: math.ceil(len(places) / _SHIFTS)] if places else []
    copies = (shift_frames(light, shift) for shift in places)
    best, _, chance = _strongest(copies, root, fit)
    words = "a ghost: a fainter, shifted copy of the light"
    return ScoreTest(words, best, int(bool(places)), chance)


def _patch(task: SearchTask, x: Array, root: Array, fit: FitAtMode) -> ScoreTest:
    """Score test of a patch of the lens without light, at any place.

    Light missing from a small spot changes the intensity by -2 Re(E* E_s), linear in
    its depth.
    """
    u, v = _places()
    names = [f"residual_{k}" for k in range(len(u))]
    dark = np.asarray(task.model.with_residual(_spots).images(x, names)[1])
    best, place, chance = _strongest(dark, root, fit)
    x_um, y_um = (task.model.lens.diameters.radius_um * part[place] for part in (u, v))
    words = (
        f"a patch without light or pillars about x {x_um:.0f}, y {y_um:.0f} um of the "
        "lens"
    )
    return ScoreTest(words, best, 1, chance)


def _places() -> tuple[Array, Array]:
    """(places,) u and v of spots on the lens, a spot's width apart."""
    t = np.arange(-1, 1 + _SPOT / 2, _SPOT)
    u, v = (part.ravel() for part in np.meshgrid(t, t))
    inside = np.hypot(u, v) <= 1
    return u[inside], v[inside]


def _spots(u: Array, v: Array) -> Array:
    """(spots, *shape) i times Gaussian spots: as a phase, light that falls to exp(-1)
    of its amplitude there.
    """
    places = zip(*_places(), strict=True)
    return np.stack(
        [
            1j * np.exp(-((u - a) ** 2 + (v - b) ** 2) / (_SPOT / 1.5) ** 2)
            for a, b in places
        ]
    )
