"""Causes that the fit leaves out: each leans the residuals its own way, and is looked
for along that (score test).
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from characterize.captures import shift_frames
from characterize.inference import causes
from characterize.inference.leastsquares import FitSolution
from characterize.inference.multistart import SearchTask
from characterize.model import PLACE, background_planes
from metalens.core.arrays import Array

# of one cause to be spoken of where there is none: one fit in 350 with the 28 of a
# small lens
CHANCE = 1e-4
# for a cause of plausible size from which on it is fitted: by chance in one fit of 100
# or fewer
ODDS = 10.0
_SEEN = 4.0  # sigma of what the fit leaves of a cause, above which it would be found
_SHIFTS, _NEAREST_PX, _FARTHEST_PX = 400, 3, 14  # of a ghost
_PATCHY, _SPOT = (
    3.0,
    0.2,
)  # sigma of chi-square from which on dark spots are looked for; their distance over the radius


@dataclass(frozen=True, slots=True)
class ResidualFinding:
    """What the residuals hold beside noise, in words, and its significance in sigma."""

    words: str
    sigma: float


def decisive_findings(
    found: Sequence[ResidualFinding], sigma: float = 5.0
) -> list[str]:
    """Findings beyond ``sigma``, in words: no fit with one passes its checks.

    Args:
        found: what residuals hold.
    """
    return [one.words for one in found if one.sigma > sigma]


@dataclass(frozen=True, slots=True)
class ScoreTest:
    """One cause: its words, chi-square by which the residuals lean along it, its
    degrees, and the chance of that.

    taken: what takes it up, in words, where the fit cannot tell it from what is fitted;
    empty where it can.
    frees: parameters that describe it. stated: whether one is stated without an error:
    it is not fitted then. odds: for it, as large as is assumed, against its absence; 0
    where no size is known.
    """

    cause: str
    chi2: float
    degrees: int
    chance: float
    taken: str = ""
    frees: tuple[str, ...] = ()
    odds: float = 0.0
    stated: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class ScoreTests:
    """What was looked for beside the fit: leans, the most telling first, of every cause
    that can be distinguished or is
    taken for something else; the fit, and the causes that are assumed as changes
    (k, pixels) over the noise, of
    one standard deviation each. roughly: those whose change is known too roughly for
    the frames to bound them.
    of_mask: those that stay with the lens when it leaves the bench."""

    leans: list[ScoreTest]
    fit: "FitAtMode"
    unstated: dict[str, Array]
    roughly: frozenset[str] = frozenset()
    of_mask: frozenset[str] = frozenset()

    def shifts(self) -> "UnmodelledShifts":
        """What the causes may have done to the parameters; see
        :meth:`FitAtMode.amounts`.
        """
        names, p = tuple(self.unstated), len(self.fit.names)
        if not names:
            return UnmodelledShifts.none(p)
        every = np.concatenate([self.unstated[name] for name in names])
        moved, open_ = self.fit.moved_by(every), np.eye(len(every))
        amount = np.zeros(len(every))
        exact = np.concatenate(
            [
                np.full(len(part), name not in self.roughly)
                for name, part in self.unstated.items()
            ]
        )
        if exact.any():
            part, pull = self.fit.amounts(every[exact])
            open_[np.ix_(exact, exact)], amount[exact] = part, part @ pull
        second = open_ + np.outer(amount, amount)
        first = np.cumsum([0, *(len(self.unstated[name]) for name in names)])
        own = [slice(a, b) for a, b in itertools.pairwise(first.tolist())]
        by_cause = [
            np.einsum("pi,ij,pj->p", moved[:, some], second[some, some], moved[:, some])
            for some in own
        ]
        off = np.concatenate(
            [
                np.full(len(part), name not in self.of_mask)
                for name, part in self.unstated.items()
            ]
        )
        bench = moved[:, off] @ second[np.ix_(off, off)] @ moved[:, off].T
        spread = np.einsum("pi,ij,pj->p", moved, open_, moved)
        return UnmodelledShifts(
            names,
            np.sqrt(np.maximum(by_cause, 0)),
            moved @ second @ moved.T,
            bench,
            moved @ amount,
            np.sqrt(np.maximum(spread, 0)),
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

    @classmethod
    def none(cls, p: int) -> "UnmodelledShifts":
        """Every cause stated."""
        nothing = np.zeros((0, p)), np.zeros((p, p)), np.zeros((p, p))
        return cls((), *nothing, np.zeros(p), np.zeros(p))

    @property
    def sigma(self) -> Array:
        """(p,) standard deviation of the shifts by all causes."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


def run_score_tests(task: SearchTask, mode: FitSolution) -> ScoreTests:
    """Look for every cause that is not fitted, by the image and the slopes that a fit
    ended with.

    Args:
        task: model, frames, priors and arrangement of the search.
        mode: the fit it is judged at.
    """
    x, image, slopes = task.all_of(mode.value), mode.image, mode.slopes
    root = np.where(
        task.data.usable & ~task.data.saturated,
        1 / np.sqrt(task.data.variance(image)),
        0.0,
    )
    rest = (np.clip(mode.residual_sigma, -6, 6) * (root > 0)).ravel()
    fitted = (slopes * root).reshape(len(task.names), -1)
    known = fitted @ fitted.T + np.diag(task.prior.sigma**-2.0)
    spread = max(1.0, mode.chi2_per_dof)
    pull = (mode.value - task.prior.mean) * task.prior.sigma**-2.0
    over = math.sqrt(spread)
    fit = FitAtMode(
        task.names,
        fitted,
        known,
        rest / over,
        task.data.shared(image) * root,
        pull / over,
    )
    found, unstated = [], {}
    roughly: set[str] = set()
    of_mask: set[str] = set()
    for one in causes.systematic_changes(
        task, x, dict(zip(task.names, slopes, strict=True))
    ):
        change = (one.images * root).reshape(len(one.images), -1)
        if np.any(one.sigma):
            unstated[one.cause] = np.reshape(one.sigma, (-1, 1)) * change
            roughly |= {one.cause} if one.roughly else set()
            of_mask |= {one.cause} if one.of_mask else set()
        if one.sought:
            taken = (
                fit.taken(change[0], one.amount, one.amount_text)
                if one.amount_text
                else ""
            )
            odds = (
                fit.odds(unstated[one.cause])
                if one.cause in unstated and one.frees and not one.stated
                else 0.0
            )
            lean = fit.lean(one.cause, change)
            found.append(
                dataclasses.replace(
                    lean, taken=taken, frees=one.frees, odds=odds, stated=one.stated
                )
            )
    found.append(_ghost(task, x, image, root, fit))
    if mode.chi2_per_dof > 1 + _PATCHY * math.sqrt(
        2 / max(float((root > 0).sum()), 1.0)
    ):
        found.append(_patch(task, x, root, fit))
    named = sorted(
        (one for one in found if one.degrees or one.taken),
        key=lambda one: (one.chance, -one.chi2),
    )
    return ScoreTests(named, fit, unstated, frozenset(roughly), frozenset(of_mask))


def expected_score_tests(task: SearchTask) -> UnmodelledShifts:
    """Shifts that a fit of frames to come will allow for: at the task's start, of frames
    that are as expected there.
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
    found: list[ScoreTest], *, stuck: bool = False, most: int = 5
) -> list[ScoreTest]:
    """Causes that free parameters describe and that may explain the frames, likeliest
    first; with those that are stated otherwise without an error.

    Those that the residuals lean to beyond chance; else those that are likelier there
    than not.

    Args:
        found: score tests.
        stuck: a parameter ran to its bound, so that any cause may stand behind it.
        most: causes that are fitted in turn to see which explains most.
    """
    some = [one for one in found if one.frees]
    clear = [one for one in some if one.chance < CHANCE]
    likely = sorted((one for one in some if one.odds > ODDS), key=lambda one: -one.odds)
    if stuck:
        clear = [one for one in some if not one.stated]
    return (clear or likely)[:most]


def score_test_text(found: list[ScoreTest]) -> list[ResidualFinding]:
    """The cause that the residuals lean to most, with those that are as likely.

    Nothing where all is chance. Its significance is that of a normal variable which is
    as improbable.

    Args:
        found: score tests, the most telling first.
    """
    clear = [one for one in found if one.chance < CHANCE]
    if not clear:
        return []
    first = clear[0]
    alike = [one.cause for one in clear[1:4]]
    more = f"; {', '.join(alike)} would explain much of it too" if alike else ""
    cure = "state it, free it, or mend the bench"
    if first.cause == causes.LAMP:
        cure = (
            "state the light of every frame, by a monitor diode, in proportion as "
            "exposure_s of stage.csv"
        )
    sigma = float(stats.norm.isf(max(first.chance, 1e-300) / 2))
    why = "as stated" if first.stated else "not fitted"
    said = (
        f"residuals lean towards {first.cause}, which is {why} ({sigma:.1f} sigma: "
        f"chi-square {first.chi2:.0f} with {first.degrees} degrees of freedom){more}: "
        f"intervals hold only if it is absent; {cure}"
    )
    return [ResidualFinding(said, sigma)]


def misplaced_windows_text(found: list[ScoreTest]) -> list[str]:
    """Whether windows of single field angles lie off, in words: what they explain is
    half of what any cause does.

    The fit then bends the lens, or turns the frames, until the spots of all angles lie
    where their windows are.

    Args:
        found: score tests.
    """
    most = max((one.chi2 - one.degrees for one in found), default=0.0)
    return [
        f"{one.cause} explains what is left (chi-square {one.chi2:.0f} with {one.degrees} degrees): one decentre is "
        "fitted for all angles; cut the frames of every angle about its chief ray, distance times tan(angle) off that "
        "on the axis, or fit the angles one by one"
        for one in found
        if one.cause == causes.WINDOWS
        and one.chance < CHANCE
        and one.chi2 - one.degrees >= most / 2
    ]


def undetectable_effects(found: list[ScoreTest]) -> list[str]:
    """Unfitted effects that the frames cannot distinguish from fitted parameters, with
    those parameters.

    Args:
        found: score tests.
    """
    return [f"{one.cause} is not fitted: {one.taken}" for one in found if one.taken]


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
    known: Array
    rest: Array
    shared: Array
    pull: Array

    def lean(self, cause: str, changes: Array) -> ScoreTest:
        """Score test of (k, pixels) changes; directions of which the fit takes up all
        but a thousandth are left out.
        """
        size = np.sqrt((changes**2).sum(1))
        changes = changes[size > 0] / size[size > 0, None]
        if not len(changes):
            return ScoreTest(cause, 0.0, 0, 1.0)
        left, score = self.left(changes)
        values, vectors = np.linalg.eigh(changes @ left.T)
        vectors = vectors[:, values > 1e-3]
        degrees = vectors.shape[1]
        if not degrees:
            return ScoreTest(cause, 0.0, 0, 1.0)
        scatter = vectors.T @ (changes @ left.T + self.in_common(left)) @ vectors
        chi2 = float(score @ vectors @ np.linalg.solve(scatter, vectors.T @ score))
        return ScoreTest(cause, chi2, degrees, float(stats.chi2.sf(chi2, degrees)))

    def left(self, changes: Array) -> tuple[Array, Array]:
        """(k, pixels) what the fit does not take up of changes G, and (k,) their scores
        Gᵀr.

        As G'ᵀr + Mᵀ pull, which is the same at the mode and feels no small step that
        the fit is off it.
        """
        moved = self.moved_by(changes).T
        left = changes - moved @ self.slopes
        return left, left @ self.rest + moved @ self.pull

    def moved_by(self, changes: Array) -> Array:
        """(p, k) shift M of the parameters by (k, pixels) changes."""
        return np.asarray(np.linalg.solve(self.known, self.slopes @ changes.T))

    def odds(self, changes: Array) -> float:
        """For (k, pixels) changes of one standard deviation each, in some amount,
        against their absence (Bayes factor).

        With t = H S⁻¹ s and C = (1 + H S⁻¹ H)⁻¹ the amounts c, N(0, 1), integrate to
        exp(tᵀC t / 2) (det C)^½.
        """
        open_, weighted = self.amounts(changes)
        size = (
            float(weighted @ open_ @ weighted) / 2
            + float(np.linalg.slogdet(open_)[1]) / 2
        )
        return math.exp(min(size, 100.0))

    def amounts(self, changes: Array) -> tuple[Array, Array]:
        """Posterior of the factors c of (k, pixels) changes G of one standard deviation
        each, given the frames: (k, k) covariance C and (k,) H S⁻¹ s, of mean C H S⁻¹ s.

        With H = GᵀG' and S the scatter of their scores s, C = (1 + H S⁻¹ H)⁻¹.
        """
        left, score = self.left(changes)
        seen = changes @ left.T
        scatter = seen + self.in_common(left)
        scatter += max(1e-9 * float(np.trace(scatter)), 1e-300) * np.eye(len(scatter))
        weight = np.linalg.solve(scatter, seen)
        return np.linalg.inv(np.eye(len(seen)) + seen @ weight), weight.T @ score

    def in_common(self, left: Array) -> Array:
        """(k, k) by which scores scatter more since errors of dark and flat are one in
        all frames.
        """
        shape = self.shared.shape[1:]
        dark, flat = (
            (left.reshape(-1, *shape) * one).sum(1).reshape(len(left), -1)
            for one in self.shared
        )
        counted = left * self.shared[0].ravel()
        return np.asarray(dark @ dark.T + flat @ flat.T - counted @ counted.T)

    def taken(self, change: Array, amount: float, amount_text: str) -> str:
        """What the parameters would do with a change of the images; empty where it does
        nothing.

        Of ``amount``, or as much of it as would not be seen: of what they leave
        ``_SEEN`` sigma or less. Nothing: no
        parameter moves by one sigma. ``amount_text``: the cause's amount in words, with a
        place for the number.
        """
        moved = np.linalg.solve(self.known, self.slopes @ change)
        left = math.sqrt(
            max(float(change @ change - (self.slopes @ change) @ moved), 0.0)
        )
        share = min(1.0, _SEEN / max(left, 1e-12))
        step = share * moved / np.sqrt(np.diag(np.linalg.inv(self.known)))
        most = [i for i in np.argsort(-np.abs(step))[:3] if abs(step[i]) > 1]
        parts = ", ".join(
            f"{self.names[i]} {share * moved[i]:+.2g} ({abs(step[i]):.1f} sigma)"
            for i in most
        )
        return (
            f"{amount_text.format(share * amount)} would be taken for {parts}; state it if there is any"
            if most
            else ""
        )


def _strongest(
    changes: Iterable[Array], root: Array, fit: FitAtMode
) -> tuple[float, int, float]:
    """(chi-square, index, chance) of the one of many (n, y, x) changes above 0 that
    explains most; its chance is that of the best of all.
    """
    best, place, count = 0.0, 0, 0
    for one in changes:
        change = (one * root).reshape(1, -1)
        left, score = fit.left(change)
        seen = float((change * left).sum())
        if seen > 1e-3 * float((change**2).sum()) and score[0] > 0:
            chi2 = float(score[0]) ** 2 / (seen + float(fit.in_common(left)[0, 0]))
            best, place = max((best, place), (chi2, count))
        count += 1
    return best, place, min(1.0, count * float(stats.chi2.sf(best, 1)) / 2)


def _ghost(
    task: SearchTask, x: Array, image: Array, root: Array, fit: FitAtMode
) -> ScoreTest:
    """The shift of the light at which a fainter copy of it explains most."""
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
    """The place on the lens whose light, left out, explains most.

    The light that is left out of a spot is linear in its depth, as long as it is a
    small share of all: -2 Re(E* E_s).
    """
    u, v = _places()
    names = [f"residual_{k}" for k in range(len(u))]
    model = task.model.with_residual(np.zeros(len(u)), _spots)
    dark = np.asarray(model.images(x, names)[1])
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


def _spots(u: Array, v: Array, count: int) -> Array:
    """(count, *shape) i times Gaussian spots: as a phase, light that falls to exp(-1)
    of its amplitude there.
    """
    places = zip(*_places(), strict=True)
    return np.stack(
        [
            1j * np.exp(-((u - a) ** 2 + (v - b) ** 2) / (_SPOT / 1.5) ** 2)
            for a, b in places
        ][:count]
    )
