"""Gaze of one person from few points, with what is common to people learned from
others: a linear mixed model.
"""

from dataclasses import dataclass

import numpy as np

from codesign.gaze.readings import NetworkReadings
from metalens.core.arrays import Array
from metalens.core.errors import TrainingError

# of expectation maximisation: answers stand by then, variances near 0 still fall
ROUNDS = 40
KAPPA_DEG, OTHERS_DEG = (
    5.0,
    1.0,
)  # first guess of how people differ: by an offset, and by any other term a unit
LEAST = 1e-9  # deg²: a variance that people do not show stays above 0


@dataclass(frozen=True, eq=False, slots=True)
class MixedModel:
    """What people have in common, and how far they differ.

    mean: (terms, 2) β. variance: (terms, 2) τ². noise: (2,) σ², all of answers in
    degrees.
    """

    mean: Array
    variance: Array
    noise: Array

    def own(self, design: Array, answers: Array) -> Array:
        """(terms, 2) coefficients β + u of one person, the mean under the prior given
        its frames.

        Args:
            design: (n, terms). answers: (n, 2).
        """
        return np.stack(
            [self.mean[:, k] + self._of(design, answers, k)[0] for k in range(2)], 1
        )

    def _of(self, design: Array, answers: Array, k: int) -> tuple[Array, Array]:
        """Mean (terms,) and covariance (terms, terms) of u in one answer."""
        cov = np.linalg.inv(
            design.T @ design / self.noise[k] + np.diag(1 / self.variance[:, k])
        )
        return cov @ (
            design.T @ (answers[:, k] - design @ self.mean[:, k])
        ) / self.noise[k], cov


def fit_mixed_model(
    design: Array, answers: Array, person: Array, *, first: Array, rounds: int = ROUNDS
) -> MixedModel:
    """The model of greatest likelihood, from ``rounds`` of expectation maximisation.

    Args:
        design: (n, terms). answers: (n, 2), deg. person: (n,) numbers of people.
        first: (terms,) variances to begin from.

    Raises:
        TrainingError: fewer than two people, or fewer frames than terms.
    """
    people = [np.flatnonzero(person == p) for p in np.unique(person)]
    if len(people) < 2 or len(design) <= design.shape[1]:
        raise TrainingError(
            f"{len(design)} frames of {len(people)} people tell not how people differ in {design.shape[1]} terms: give "
            "two people or more, and more frames than terms"
        )
    mean = np.linalg.lstsq(design, answers, rcond=None)[0]
    found = MixedModel(
        mean,
        np.repeat(first[:, None], 2, 1),
        np.maximum((answers - design @ mean).var(0), LEAST),
    )
    for _ in range(rounds):
        found = _again(found, design, answers, people)
    return found


def _again(
    found: MixedModel, design: Array, answers: Array, people: list[Array]
) -> MixedModel:
    """One round: u of everybody given the model, then the model given them (both with
    their covariances).
    """
    mean, variance, noise = (
        np.empty_like(v) for v in (found.mean, found.variance, found.noise)
    )
    for k in range(2):
        effects = [found._of(design[rows], answers[rows], k) for rows in people]
        theirs = np.zeros(len(design))
        for rows, (u, _) in zip(people, effects, strict=True):
            theirs[rows] = design[rows] @ u
        mean[:, k] = np.linalg.lstsq(design, answers[:, k] - theirs, rcond=None)[0]
        variance[:, k] = (
            np.mean([u**2 + np.diag(cov) for u, cov in effects], axis=0) + LEAST
        )
        left = ((answers[:, k] - design @ mean[:, k] - theirs) ** 2).sum()
        unsure = sum(
            np.sum((design[rows] @ cov) * design[rows])
            for rows, (_, cov) in zip(people, effects, strict=True)
        )
        noise[k] = (left + unsure) / len(design) + LEAST
    return MixedModel(mean, variance, noise)


@dataclass(frozen=True, eq=False, slots=True)
class PopulationPrior:
    """Mixed-effects prior of the map from network readings to gaze, over people.

    model: of the terms. middle, spread: (7,) of the readings over people, the unit of
    every term.
    """

    model: MixedModel
    middle: Array
    spread: Array

    def terms(self, read: NetworkReadings) -> Array:
        """(n, 36) the constant, the readings in their units, and their products.

        Args:
            read: pupil, slippage and axis as a network reads them.
        """
        return _terms(_joined_readings(read), self.middle, self.spread)

    def person(self, read: NetworkReadings, gaze_deg: Array) -> "MixedModelPerson":
        """Calibrate a person who looked at ``gaze_deg`` (n, 2), across and down.

        Args:
            read: pupil, slippage and axis as a network reads them.

        Raises:
            TrainingError: fewer than 3 points, or readings without an axis.
        """
        if len(read) < 3:
            raise TrainingError(
                f"a personal calibration from {len(read)} points, need 3 or more"
            )
        return MixedModelPerson(
            self, self.model.own(self.terms(read), gaze_deg - _axis(read))
        )


@dataclass(frozen=True, eq=False, slots=True)
class MixedModelPerson:
    """A calibrated person. people: the prior. coefficients: (36, 2) of this person's
    terms, deg.
    """

    people: PopulationPrior
    coefficients: Array

    def __call__(self, read: NetworkReadings) -> Array:
        """(n, 2) gaze across and down, deg."""
        return np.asarray(_axis(read) + self.people.terms(read) @ self.coefficients)


def learn_population(
    read: NetworkReadings, gaze_deg: Array, person: Array
) -> PopulationPrior:
    """Fit the mixed-effects prior of gaze to the readings of many people.

    Args:
        read: of n frames. gaze_deg: (n, 2) where was looked, across and down. person:
            (n,) whose frame it is.

    Raises:
        TrainingError: too few people or frames, or readings without an axis.
    """
    together = _joined_readings(read)
    middle, spread = together.mean(0), np.maximum(together.std(0), 1e-9)
    design = _terms(together, middle, spread)
    first = np.full(design.shape[1], OTHERS_DEG**2)
    first[0] = KAPPA_DEG**2
    return PopulationPrior(
        fit_mixed_model(design, gaze_deg - _axis(read), person, first=first),
        middle,
        spread,
    )


def _axis(read: NetworkReadings) -> Array:
    if read.axis_deg is None:
        raise TrainingError(
            "the readings hold no optic axis, which gaze is told from here; calibrate by the sphere"
        )
    return read.axis_deg


def _joined_readings(read: NetworkReadings) -> Array:
    return np.concatenate([_axis(read), read.pupil_mm, read.slip_mm], 1)


def _terms(together: Array, middle: Array, spread: Array) -> Array:
    x = (together - middle) / spread
    one, other = np.triu_indices(x.shape[1])
    return np.concatenate([np.ones((len(x), 1)), x, x[:, one] * x[:, other]], 1)
