"""What physics leaves over: a smooth phase over the aperture, without a formula, kept
only where unseen frames improve.

The phase is a sum of thin-plate modes (:mod:`thinplate`), each held towards zero by its
bending energy.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from characterize.inference import leastsquares
from characterize.inference.leastsquares import (
    FitImages,
    FitSolution,
    GaussianPrior,
    SolverSettings,
)
from characterize.model import MODES, PLACE, ForwardModel, prior_rad, thin_plate_basis
from metalens.core.arrays import Array

MOST_RAD = 0.6


@dataclass(frozen=True, eq=False, slots=True)
class ResidualPhaseFit:
    """A fit with the residual phase, and what it did for frames that it had not seen.

    solution: of all frames, the ``modes`` after the physical parameters.
    before, after: chi-square of frames left out, per pixel, without and with the phase.
    """

    solution: FitSolution
    modes: Array
    before: float
    after: float

    @property
    def rms_rad(self) -> float:
        """Of the phase over the aperture."""
        return float(np.linalg.norm(self.modes))


def fit_residual_phase(
    model: ForwardModel,
    data: FitImages,
    names: Sequence[str],
    start: Array,
    *,
    base: Array,
    prior: GaussianPrior,
) -> ResidualPhaseFit | None:
    """The fit with a residual phase; None unless frames left out improve by more than
    chance allows.

    Every second depth is left out, then the others: fitted without and with the phase
    from ``start`` (p,), the
    physical parameters alone. ``base``: all parameters.
    """
    n = len(data.electrons)
    if n < 4:
        return None
    order = np.argsort(model.setting.depth_um, kind="stable")
    joint = _with_modes(prior)
    wide = np.concatenate([start, np.zeros(MODES)])
    scores = np.zeros(2)
    settings = SolverSettings(
        iterations=12, step_tolerance=0.3, secant=True, near=1.0, finish=False
    )
    for seen, hidden in ((order[::2], order[1::2]), (order[1::2], order[::2])):
        part, rest = data.planes(np.sort(seen)), data.planes(np.sort(hidden))
        here, there = model.only(np.sort(seen)), model.only(np.sort(hidden))
        for i, (begin, known) in enumerate(((start, prior), (wide, joint))):
            found = leastsquares.fit_levenberg_marquardt(
                residual_phase_problem(here, names, base),
                part,
                begin,
                prior=known,
                settings=settings,
            )
            scores[i] += _misfit(
                residual_phase_problem(there, names, base), rest, found.value
            )
    count = float((data.usable & ~data.saturated).sum())
    if scores[1] > scores[0] - max(4 * math.sqrt(2 * count), 0.02 * scores[0]):
        return None
    settings = dataclasses.replace(
        settings, iterations=40, step_tolerance=0.02, near=0.3, finish=True
    )
    found = leastsquares.fit_levenberg_marquardt(
        residual_phase_problem(model, names, base),
        data,
        wide,
        prior=joint,
        settings=settings,
    )
    p = len(names)
    physical = dataclasses.replace(
        found,
        value=found.value[:p],
        covariance=found.covariance[:p, :p],
        information=_without_modes(found.information, p),
        beyond=found.beyond[:p],
        slopes=found.slopes[:p],
    )
    return ResidualPhaseFit(
        physical, found.value[p:], scores[0] / count, scores[1] / count
    )


def residual_phase_problem(
    model: ForwardModel, names: Sequence[str], base: Array
) -> leastsquares.Model:
    """Images by the named parameters, and by the modes where values are left behind
    them; the others as in ``base``.
    """
    place, p = [PLACE[name] for name in names], len(names)

    def images(values: Array, jacobian: bool) -> tuple[Array, Array | None]:
        x = base.copy()
        x[place] = values[:p]
        of = (
            model.with_residual(values[p:], thin_plate_basis)
            if len(values) > p
            else model
        )
        wanted = [*names, *(f"residual_{k}" for k in range(len(values) - p))]
        return of.images(x, wanted if jacobian else None)

    return images


def _with_modes(prior: GaussianPrior) -> GaussianPrior:
    wide, zero = np.full(MODES, np.inf), np.zeros(MODES)
    parts = (
        (prior.mean, zero),
        (prior.sigma, prior_rad()),
        (prior.low, -wide),
        (prior.high, wide),
    )
    mean, sigma, low, high = (np.concatenate(part) for part in parts)
    return GaussianPrior(mean, sigma, low, high)


def _without_modes(information: Array, p: int) -> Array:
    """(p, p) information on the first parameters when the modes, known to their prior,
    are unknown too.
    """
    inner = information[p:, p:] + np.diag(prior_rad() ** -2.0)
    return np.asarray(
        information[:p, :p]
        - information[:p, p:] @ np.linalg.solve(inner, information[p:, :p])
    )


def _misfit(model: leastsquares.Model, data: FitImages, value: Array) -> float:
    image, _ = model(value, False)
    keep = data.usable & ~data.saturated
    return float(
        np.minimum((data.electrons - image) ** 2 / data.variance(image), 36.0)[
            keep
        ].sum()
    )
