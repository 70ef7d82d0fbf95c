"""Gaze of one person from few points, with what is common to people learned from
others: a linear mixed model.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from codesign.gaze.readings import NetworkReadings
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import StoreError, TrainingError
from metalens.core.store import typed_reader

LEAST = 1e-9  # deg²: lower bound of variances


@dataclass(frozen=True, eq=False, slots=True)
class MixedModel:
    """Linear mixed model: mean over people, and their variance.

    mean: (terms, 2) β. variance: (terms, 2) τ². noise: (2,) σ², all of gaze in degrees.
    """

    mean: Array
    variance: Array
    noise: Array

    def own(self, design: Array, gaze_deg: Array) -> Array:
        """(terms, 2) coefficients β + u of one person: posterior mean from that
        person's frames.

        Args:
            design: (n, terms). gaze_deg: (n, 2).
        """
        columns = [
            self.mean[:, k] + self._effects(design, gaze_deg, k)[0] for k in range(2)
        ]
        return np.stack(columns, 1)

    def _effects(self, design: Array, gaze_deg: Array, k: int) -> tuple[Array, Array]:
        """Posterior mean (terms,) and covariance (terms, terms) of u in component k.

        C = (X^T X / σ² + diag(1 / τ²))⁻¹, u = C X^T (y - X β) / σ².
        """
        cov = np.linalg.inv(
            design.T @ design / self.noise[k] + np.diag(1 / self.variance[:, k])
        )
        residual = gaze_deg[:, k] - design @ self.mean[:, k]
        return cov @ (design.T @ residual) / self.noise[k], cov


def fit_mixed_model(
    design: Array, gaze_deg: Array, person: Array, *, first: Array, rounds: int = 40
) -> MixedModel:
    """Linear mixed model of largest likelihood, by ``rounds`` of expectation
    maximisation.

    Args:
        design: (n, terms). gaze_deg: (n, 2), deg. person: (n,) numbers of people.
        first: (terms,) initial variances. rounds: of expectation maximisation.

    Raises:
        TrainingError: fewer than two people, or fewer frames than terms.
    """
    people = [np.flatnonzero(person == p) for p in np.unique(person)]
    if len(people) < 2 or len(design) <= design.shape[1]:
        raise TrainingError(
            f"{len(design)} frames of {len(people)} people tell not how people differ in {design.shape[1]} terms: give "
            "two people or more, and more frames than terms"
        )
    mean = np.linalg.lstsq(design, gaze_deg, rcond=None)[0]
    model = MixedModel(
        mean,
        np.repeat(first[:, None], 2, 1),
        np.maximum((gaze_deg - design @ mean).var(0), LEAST),
    )
    for _ in range(rounds):
        model = _em_step(model, design, gaze_deg, people)
    return model


def _em_step(
    model: MixedModel, design: Array, gaze_deg: Array, people: list[Array]
) -> MixedModel:
    """One round of expectation maximisation.

    E: effects u of everybody by the model. M: mean, variances and noise by those
    effects and their covariances.

    Args:
        people: rows of the design of each person.
    """
    mean, variance, noise = (
        np.empty_like(v) for v in (model.mean, model.variance, model.noise)
    )
    for k in range(2):
        effects = [model._effects(design[rows], gaze_deg[rows], k) for rows in people]
        personal = np.zeros(len(design))
        for rows, (u, _) in zip(people, effects, strict=True):
            personal[rows] = design[rows] @ u
        mean[:, k] = np.linalg.lstsq(design, gaze_deg[:, k] - personal, rcond=None)[0]
        variance[:, k] = (
            np.mean([u**2 + np.diag(cov) for u, cov in effects], axis=0) + LEAST
        )
        residual = ((gaze_deg[:, k] - design @ mean[:, k] - personal) ** 2).sum()
        uncertainty = sum(
            np.sum((design[rows] @ cov) * design[rows])
            for rows, (_, cov) in zip(people, effects, strict=True)
        )
        noise[k] = (residual + uncertainty) / len(design) + LEAST
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
        return _quadratic_terms(_joined_readings(read), self.middle, self.spread)

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
            self, self.model.own(self.terms(read), gaze_deg - _axis_deg(read))
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
        return np.asarray(_axis_deg(read) + self.people.terms(read) @ self.coefficients)


def learn_population(
    read: NetworkReadings, gaze_deg: Array, person: Array
) -> PopulationPrior:
    """Fit the mixed-effects prior of gaze to the readings of many people.

    Args:
        read: of n frames. gaze_deg: (n, 2) true gaze, across and down.
        person: (n,) whose frame it is.

    Raises:
        TrainingError: too few people or frames, or readings without an axis.
    """
    readings = _joined_readings(read)
    middle, spread = readings.mean(0), np.maximum(readings.std(0), 1e-9)
    design = _quadratic_terms(readings, middle, spread)
    # deg², between people: of the offset (kappa), and of any other term per unit
    first = np.ones(design.shape[1])
    first[0] = 25.0
    return PopulationPrior(
        fit_mixed_model(design, gaze_deg - _axis_deg(read), person, first=first),
        middle,
        spread,
    )


def _axis_deg(read: NetworkReadings) -> Array:
    """(n, 2) angles of the optic axis, deg.

    Raises:
        TrainingError: readings without an axis.
    """
    if read.axis_deg is None:
        raise TrainingError(
            "the readings hold no optic axis, which gaze is read from here; calibrate by the sphere"
        )
    return read.axis_deg


def _joined_readings(read: NetworkReadings) -> Array:
    """(n, 7) axis in deg, pupil and slippage in mm."""
    return np.concatenate([_axis_deg(read), read.pupil_mm, read.slip_mm], 1)


def _quadratic_terms(readings: Array, middle: Array, spread: Array) -> Array:
    """(n, 36) constant, 7 normalised readings x, and their 28 products."""
    x = (readings - middle) / spread
    first, second = np.triu_indices(x.shape[1])
    return np.concatenate([np.ones((len(x), 1)), x, x[:, first] * x[:, second]], 1)


KIND = "people"
SHAPES = {
    "mean": (36, 2),
    "variance": (36, 2),
    "noise": (2,),
    "middle": (7,),
    "spread": (7,),
}


def save_people(
    path: Path, people: PopulationPrior, *, provenance: store.Provenance | None = None
) -> None:
    """Write a file of kind ``people``: β, τ² and σ² in deg and deg², middle and spread
    of the readings in deg and mm.

    Args:
        path: of the file. provenance: of the file.

    Raises:
        OSError: the target cannot be written (the old file stays).
    """
    model = people.model
    arrays = {"mean": model.mean, "variance": model.variance, "noise": model.noise}
    store.save(
        path,
        KIND,
        arrays | {"middle": people.middle, "spread": people.spread},
        provenance=provenance,
    )


@typed_reader
def load_people(path: Path) -> PopulationPrior:
    """Read a file of kind ``people``.

    Args:
        path: of the file.

    Raises:
        StoreError: no such file, another kind, or entries that no people can have.
    """
    arrays = store.load(path, KIND).arrays
    values = {name: np.asarray(arrays[name], dtype=float) for name in SHAPES}
    odd = [
        name
        for name, shape in SHAPES.items()
        if values[name].shape != shape
        or not np.isfinite(values[name]).all()
        or (name in ("variance", "noise", "spread") and values[name].min() <= 0)
    ]
    if odd:
        raise StoreError(
            f"{path}: {', '.join(odd)} of a shape or value that no people have; edited: make it again"
        )
    *model, middle, spread = values.values()
    return PopulationPrior(MixedModel(*model), middle, spread)
