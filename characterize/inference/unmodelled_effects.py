"""One joint covariance of fitted parameters and effects that nobody stated, and score
tests of every effect that the fit leaves out.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from characterize.captures import shift_frames
from characterize.inference import systematic_effects
from characterize.inference.leastsquares import FitSolution, SolverSettings
from characterize.inference.multistart import SearchTask
from characterize.inference.systematic_effects import ImageChange
from characterize.model import PLACE, background_planes
from metalens.core.arrays import Array

# significance of one cause: with 28 causes one fit in 350 reports an absent one
CHANCE = 1e-4
# Bayes factor above which a cause is fitted: by chance in one fit of 100 or fewer
ODDS = 10.0
_SHIFTS, _NEAREST_PX, _FARTHEST_PX = 400, 3, 14  # of a ghost: number and range
_CLIP = 6.0  # largest residual that counts, sigma

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


def decisive_findings(findings: Sequence[ResidualFinding]) -> list[str]:
    """Findings beyond 5 sigma, in words: no fit with one passes its checks.

    Args:
        findings: what residuals hold.
    """
    return [finding.words for finding in findings if finding.sigma > 5]


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

    def score_test(self, cause: str, changes: Array, *, positive: bool) -> ScoreTest:
        """Score test (Rao) of a cause by its changes G (k, pixels).

        Chi-square sᵀS⁻¹s of the scores s with their scatter S. Directions taken up to
        all but a thousandth are left out. Where the amount is ``positive``, a score
        below 0 speaks for none.
        """
        none = ScoreTest(cause, 0.0, 0, 1.0)
        size = np.sqrt((changes**2).sum(1))
        changes = changes[size > 0] / size[size > 0, None]
        left, score, _ = self.project_out(changes)
        values, vectors = np.linalg.eigh(changes @ left.T)
        vectors = vectors[:, values > 1e-3]
        degrees = vectors.shape[1]
        if not degrees or (positive and score[0] <= 0):
            return none
        scatter = vectors.T @ (changes @ left.T + self.shared_scatter(left)) @ vectors
        chi2 = float(score @ vectors @ np.linalg.solve(scatter, vectors.T @ score))
        return ScoreTest(cause, chi2, degrees, float(stats.chi2.sf(chi2, degrees)))

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

    def unmodelled_shifts(self, effects: Sequence[ImageChange]) -> UnmodelledShifts:
        """Marginal less conditional covariance of the parameters: M C Mᵀ by the
        posterior C of the ``effects``, whose changes are (k, pixels) of one standard
        deviation each.
        """
        pixels = self.slopes.shape[1]
        every = np.concatenate([np.empty((0, pixels)), *(e.images for e in effects)])
        number = np.repeat(np.arange(len(effects)), [len(e.images) for e in effects])
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


def run_score_tests(
    task: SearchTask, mode: FitSolution
) -> tuple[list[ScoreTest], UnmodelledShifts]:
    """Score tests of every cause that is not fitted, the least probable by chance
    first, and what causes of assumed size add to the covariance.

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
        fitted,
        fitted @ fitted.T + np.diag(weight),
        (np.clip(mode.residual_sigma, -_CLIP, _CLIP) * (root > 0)).ravel() / over,
        task.data.shared(mode.image) * root,
        (mode.value - task.prior.mean) * weight / over,
    )
    tests, assumed = list[ScoreTest](), list[ImageChange]()
    by_name = dict(zip(task.names, mode.slopes, strict=True))
    for effect in systematic_effects.systematic_changes(task, x, by_name):
        change = (effect.images * root).reshape(len(effect.images), -1)
        test = fit.score_test(effect.cause, change, positive=effect.positive)
        odds = 0.0
        if np.any(effect.sigma):
            change = np.reshape(effect.sigma, (-1, 1)) * change
            assumed.append(dataclasses.replace(effect, images=change))
            if effect.frees and not effect.stated:
                odds = fit.odds(change)
        tests.append(
            dataclasses.replace(
                test, frees=effect.frees, stated=effect.stated, odds=odds
            )
        )
    tests.append(_ghost(task, x, mode.image, root, fit))
    tests = [test for test in tests if test.degrees]
    tests.sort(key=lambda test: (test.chance, -test.chi2))
    return tests, fit.unmodelled_shifts(assumed)


def expected_shifts(task: SearchTask) -> UnmodelledShifts:
    """What unstated effects add to the covariance of a fit of frames not taken yet.

    At the task's start, with residuals of 0.
    """
    start = task.start[[PLACE[name] for name in task.names]]
    mode = task.posed().fit(start, SolverSettings(iterations=0))
    return run_score_tests(task, mode)[1]


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
    words = "a ghost: a fainter, shifted copy of the light"
    best = ScoreTest(words, 0.0, int(bool(places)), 1.0)
    for shift in places[:: math.ceil(len(places) / _SHIFTS) or 1]:
        copy = (shift_frames(light, shift) * root).reshape(1, -1)
        best = max(
            best, fit.score_test(words, copy, positive=True), key=lambda test: test.chi2
        )
    chance = min(1.0, min(len(places), _SHIFTS) * best.chance / 2)
    return dataclasses.replace(best, chance=chance)
