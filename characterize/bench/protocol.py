"""Optimal design of captures: source depths, field angles and exposures of most Fisher
information on the lens.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from characterize.inference import (
    FitImages,
    SearchTask,
    UnmodelledShifts,
    invert_information,
    uncertainty,
    unmodelled_effects,
)
from characterize.model import (
    NAMES,
    PARAMETERS,
    PLACE,
    ForwardModel,
    FrameSetting,
    KnownValue,
    parameter_vector,
    unfitted_sizes,
    usual_parameters,
)
from metalens.core.arrays import Array
from metalens.core.errors import FitError, nearest_name_hint
from metalens.fabrication import Sensitivity
from metalens.lens import Lens

REACH = uncertainty.REACH
# (depth, angle) pairs that a fit needs to be tested on frames left out
_LEAST_PLACES = 4
# defocus at the rim below which images count as in focus: there, even errors change
# them in second order only
_DEFOCUS_WAVES = 0.5


@dataclass(frozen=True, slots=True)
class IntervalRequirement:
    """An interval that the session is to give: half of the 95 % interval of a
    parameter, in its unit.

    name: of the parameter. within: half of its 95 % interval, with what the session
    cannot tell.
    """

    name: str
    within: float

    def __post_init__(self) -> None:
        if self.name not in PLACE:
            raise FitError(
                f"wanted {self.name!r}: no such "
                f"parameter{nearest_name_hint(self.name, NAMES)}"
            )
        if not (self.within > 0 and math.isfinite(self.within)):
            raise FitError(
                f"wanted {self.name}: within = {self.within}; need a finite number "
                "above 0"
            )


@dataclass(frozen=True, slots=True)
class BenchProtocol:
    """What the bench can do; TOML of ``metalens capture --protocol``.

    depths_um: (nearest, farthest) source depth; depth_count: candidates between them,
    even in 1/z.
    angles_deg: field angles along x. exposures: relative exposure times.
    frames: how many may be taken. criterion: D (determinant) or A (mean variance).
    peak_e: electrons in the brightest pixel of all candidates at exposure 1.
    full_well_e, read_noise_e: of the sensor.
    pixel_um, pixels: of the sensor and of the window about the image.
    free, known: as in the metrology of ``metalens fit``; what ``capture.toml`` will
    state, with sigma = 0, too.
    wanted: intervals (name, within): no more frames are taken than they need (of four
    depths and angles at least), and
    what falls short is said.
    """

    depths_um: tuple[float, float]
    depth_count: int = 13
    angles_deg: tuple[float, ...] = (0.0,)
    exposures: tuple[float, ...] = (1.0,)
    frames: int = 8
    criterion: Literal["D", "A"] = "A"
    peak_e: float = 8000.0
    full_well_e: float = field(default=10000.0, metadata={"above": 0})
    read_noise_e: float = 2.0
    pixel_um: float = 3.0
    pixels: int = field(default=32, metadata={"above": 0})
    free: tuple[str, ...] = ()
    known: tuple[KnownValue, ...] = ()
    wanted: tuple[IntervalRequirement, ...] = ()

    def __post_init__(self) -> None:
        nearest, farthest = self.depths_um
        if not (0 < nearest < farthest and self.depth_count >= 2 and self.frames >= 1):
            raise FitError(
                f"depths_um {self.depths_um}, depth_count {self.depth_count}, frames "
                f"{self.frames}: need "
                "0 < nearest < farthest, two depths or more and one frame or more"
            )
        if not (
            self.angles_deg
            and self.exposures
            and min(self.exposures) > 0
            and min(self.peak_e, self.pixel_um) > 0
        ):
            raise FitError(
                "need at least one of angles_deg and exposures; exposures, peak_e and "
                "pixel_um above 0"
            )


@dataclass(frozen=True, eq=False, slots=True)
class CapturePlan:
    """Frames to take, the most informative first, with expected standard errors.

    depth_um, angle_deg, exposure: (n,) of the frames.
    names, sigma: (p,) parameters and their standard errors within the model.
    unstated_sigma: (p,) standard deviation by causes that nobody states.
    warnings: sentences on what these frames leave open.
    """

    depth_um: Array
    angle_deg: Array
    exposure: Array
    names: tuple[str, ...]
    sigma: Array
    unstated_sigma: Array
    warnings: tuple[str, ...] = ()


def plan_captures(
    lens: Lens, protocol: BenchProtocol, response: Sensitivity
) -> CapturePlan:
    """Optimal capture plan of a lens: the frames of most Fisher information, with the
    expected standard errors.

    Frames are chosen by :func:`choose_frames` and cut to those that the required
    intervals need. Standard errors are sqrt(diag((prior + sum of information)^-1)).

    Accuracy: of the Fisher matrix at the nominal lens; errors of the real one change
    the weights in second order.

    Args:
        lens: the design.
        protocol: range of the bench and aim of the plan.
        response: what height, index and sidewall do to the pillars.

    Raises:
        FitError: as :class:`ForwardModel`.
    """
    names, prior = _parameters(lens, protocol)
    candidates, information = candidate_information(lens, protocol, response, names)
    place_of = np.unique(candidates[:, :2], axis=0, return_inverse=True)[1].ravel()
    chosen = choose_frames(
        information,
        prior,
        protocol.frames,
        criterion=protocol.criterion,
        names=names,
        place=place_of,
    )
    unstated = _unstated_shifts(lens, protocol, response, candidates[chosen])
    count = _sufficient_count(
        information[chosen],
        prior,
        names,
        protocol.wanted,
        unstated.sigma,
        least=_least_count(candidates[chosen]),
    )
    chosen = chosen[:count]
    covariance = invert_information(prior + information[chosen].sum(0))
    sigma = np.sqrt(np.diag(covariance))
    depth, angle, exposure = candidates[chosen].T
    warnings = (
        *_missed_requirements(names, sigma, unstated, protocol.wanted, count),
        *_place_warnings(candidates[chosen]),
        *_focus_warnings(lens, protocol, depth),
    )
    return CapturePlan(depth, angle, exposure, names, sigma, unstated.sigma, warnings)


def _unstated_shifts(
    lens: Lens, protocol: BenchProtocol, response: Sensitivity, frames: Array
) -> UnmodelledShifts:
    """Expected shifts of the parameters by causes outside the model, for a fit of
    frames of peak ``peak_e``.

    Args:
        frames: (n, 3) depth in um, angle in degrees, relative exposure.
    """
    known = {value.name: value for value in protocol.known}
    sizes = unfitted_sizes(known, lens)
    angles = np.stack([np.radians(frames[:, 1]), np.zeros(len(frames))], 1)
    setting = FrameSetting(
        frames[:, 0],
        angles,
        frames[:, 2],
        protocol.pixel_um,
        protocol.pixels,
        protocol.pixels,
    )
    model = ForwardModel(lens, setting, response)
    x = parameter_vector({name: value.value for name, value in known.items()})
    brightest = (model.images(x)[0] / frames[:, 2, None, None]).max()
    x[PLACE["log_gain"]] = math.log(protocol.peak_e / brightest)
    image = model.images(x)[0]
    saturated = image >= protocol.full_well_e
    ones = np.ones_like(image)
    data = FitImages(image, ones > 0, saturated, ones * protocol.read_noise_e**2, ones)
    free = tuple(
        name for name in protocol.free if name not in known or known[name].sigma > 0
    )
    return unmodelled_effects.expected_shifts(
        SearchTask(model, data, x, known, None, free, sizes)
    )


def _least_count(frames: Array) -> int:
    """Number of leading frames that lie at ``_LEAST_PLACES`` pairs of depth and angle;
    all frames where there are fewer pairs.
    """
    places = [
        len({tuple(place) for place in frames[: number + 1, :2].tolist()})
        for number in range(len(frames))
    ]
    return next(
        (number + 1 for number, count in enumerate(places) if count >= _LEAST_PLACES),
        len(frames),
    )


def _sufficient_count(
    information: Array,
    prior: Array,
    names: tuple[str, ...],
    requirements: Sequence[IntervalRequirement],
    unstated_sigma: Array,
    *,
    least: int,
) -> int:
    """Number of leading frames that reach all required intervals with what nobody
    states, at least ``least``; all frames where they do not reach them.

    A requirement that the unstated causes alone exceed is one on the model's interval.

    Args:
        information: (frames, p, p) of each chosen frame.
        prior: (p, p) information known beforehand.
        unstated_sigma: (p,) standard deviation by unstated causes.
    """
    limits = {}
    for requirement in requirements:
        if requirement.name in names:
            index = names.index(requirement.name)
            variance = (requirement.within / REACH) ** 2 - unstated_sigma[index] ** 2
            limits[index] = (
                variance if variance > 0 else (requirement.within / REACH) ** 2
            )
    for count in range(least, len(information)) if limits else ():
        covariance = invert_information(prior + information[:count].sum(0))
        if all(covariance[index, index] <= most for index, most in limits.items()):
            return count
    return len(information)


def _missed_requirements(
    names: tuple[str, ...],
    sigma: Array,
    unstated: UnmodelledShifts,
    requirements: Sequence[IntervalRequirement],
    count: int,
) -> list[str]:
    """Sentences on required intervals that are not reached: by how much more light, or
    which causes to state.

    Args:
        sigma: (p,) standard errors within the model.
        count: number of chosen frames.
    """
    sentences = []
    for requirement in requirements:
        if requirement.name not in names:
            sentences.append(
                f"{requirement.name} is fixed, not fitted: no frame changes its "
                "interval"
            )
            continue
        index = names.index(requirement.name)
        within_model = REACH * float(sigma[index])
        unstated_half = REACH * float(unstated.sigma[index])
        total = math.hypot(within_model, unstated_half)
        expected = f"{requirement.name} will be known to +- {total:.2g}, wanted +- {requirement.within:.2g}"
        if unstated_half >= requirement.within:
            causes = [
                unstated.causes[cause]
                for cause in np.argsort(-unstated.by_cause[:, index])[:3]
            ]
            sentences.append(
                f"{expected}: within the model it is +- {within_model:.2g}, more "
                "frames do not help; state what else there "
                f"is or is not, first of all {', '.join(causes)} (capture.toml, "
                "[[known]])"
            )
        elif total > requirement.within * (1 + 1e-9):
            light_factor = within_model**2 / (requirement.within**2 - unstated_half**2)
            sentences.append(
                f"{expected}: {light_factor:.1f} times the light "
                f"({math.ceil(count * light_factor)} such frames), other depths or "
                "angles, or an independent measurement"
            )
    return sentences


def _place_warnings(frames: Array) -> list[str]:
    """Warning that (n, 3) frames lie at fewer than ``_LEAST_PLACES`` pairs of depth and
    angle; empty otherwise.
    """
    places = len({tuple(place) for place in frames[:, :2].tolist()})
    if places >= _LEAST_PLACES:
        return []
    consequence = "is refused" if places == 1 else "cannot be tested on frames left out"
    return [
        f"frames at {places} of the depths and angles: a fit of fewer than "
        f"{2 if places == 1 else 4} {consequence}; "
        "allow more frames"
    ]


def _focus_warnings(lens: Lens, protocol: BenchProtocol, chosen_um: Array) -> list[str]:
    """Warning that all frames are in focus, or all on one side of it; empty otherwise.

    Defocus at the rim in waves: radius² / 2 * |1/z - 1/z_focus| / wavelength.
    """
    focus = lens.source_distance_um
    if not (math.isfinite(focus) and focus > 0):
        return []
    extremes = np.array([*protocol.depths_um, chosen_um.min(), chosen_um.max()])
    waves = (
        lens.diameters.radius_um**2
        / 2
        * np.abs(1 / extremes - 1 / focus)
        / lens.wavelength_um
    )
    sentences = []
    if waves.max() < _DEFOCUS_WAVES:
        sentences.append(
            f"all depths are in focus (defocus of {waves.max():.2g} waves at most): a "
            "symmetric lens in focus fixes "
            "its bias, height and even aberrations poorly; go on to half a wave or "
            "more on both sides"
        )
    elif chosen_um.min() > focus or chosen_um.max() < focus:
        side = "farther" if chosen_um.min() > focus else "nearer"
        sentences.append(
            f"all frames are {side} than the focus at {focus:.4g} um: the signs of "
            "astigmatism, of spherical "
            "aberration and of the bias hang on defocus alone; take some on the other "
            "side"
        )
    return sentences


def candidate_information(
    lens: Lens, protocol: BenchProtocol, response: Sensitivity, names: tuple[str, ...]
) -> tuple[Array, Array]:
    """((c, 3) depth in um, angle in degrees, exposure; (c, p, p) Fisher information) of
    every candidate frame.

    Information: sum over unsaturated pixels of t² dI/dp dI/dq / (t I + read noise²),
    with image I in electrons at exposure 1 and relative exposure t.

    Args:
        lens: the design.
        protocol: what the bench can do.
        response: what height, index and sidewall do to the pillars.
        names: of the parameters.
    """
    nearest, farthest = protocol.depths_um
    depths = 1 / np.linspace(1 / nearest, 1 / farthest, protocol.depth_count)
    pairs = np.array(
        [(depth, angle) for angle in protocol.angles_deg for depth in depths]
    )
    angles = np.stack([np.radians(pairs[:, 1]), np.zeros(len(pairs))], 1)
    setting = FrameSetting(
        pairs[:, 0],
        angles,
        np.ones(len(pairs)),
        protocol.pixel_um,
        protocol.pixels,
        protocol.pixels,
    )
    model = ForwardModel(lens, setting, response)
    x = parameter_vector(
        {known.name: known.value for known in protocol.known if known.name in PLACE}
    )
    x[PLACE["log_gain"]] = math.log(protocol.peak_e / model.images(x)[0].max())
    images, slopes = model.images(x, names)
    if slopes is None:
        raise FitError("the model gave no derivatives")
    rows, information = [], []
    for exposure in protocol.exposures:
        light = np.maximum(images * exposure, 0)
        weight = (
            (light < protocol.full_well_e)
            / (light + protocol.read_noise_e**2)
            * exposure**2
        )
        information.append(
            np.einsum("inyx,nyx,jnyx->nij", slopes, weight, slopes, optimize=True)
        )
        rows.append(np.column_stack([pairs, np.full(len(pairs), exposure)]))
    return np.concatenate(rows), np.concatenate(information)


def choose_frames(
    information: Array,
    prior: Array,
    count: int,
    *,
    criterion: str,
    names: tuple[str, ...],
    place: Array | None = None,
) -> list[int]:
    """Indices of ``count`` candidates by greedy choice, then exchanges until none
    helps; a candidate may be chosen again.

    An optimum has hardly more places than its model has parameters, and none to test
    the model with. So the first choices go to new places until there are
    ``_LEAST_PLACES``.

    Args:
        information: (candidates, p, p) of each frame.
        prior: (p, p) information known beforehand.
        count: frames to choose.
        criterion: D or A, as :func:`design_criterion`.
        names: (p,) names of the fitted parameters.
        place: (candidates,) number of the depth and angle; None without that rule.
    """
    chosen: list[int] = []
    total = prior.copy()
    places = np.arange(len(information)) if place is None else place
    least = 0 if place is None else min(_LEAST_PLACES, count, len(set(places.tolist())))

    def best_candidate(base: Array, other_frames: list[int]) -> int:
        used = np.unique(places[other_frames])
        allowed = (
            ~np.isin(places, used) if len(used) < least else np.ones(len(places), bool)
        )
        return int(
            np.argmax(
                [
                    design_criterion(base + candidate, criterion, names)
                    if is_allowed
                    else -np.inf
                    for candidate, is_allowed in zip(information, allowed, strict=True)
                ]
            )
        )

    for _ in range(count):
        chosen.append(best_candidate(total, chosen))
        total = total + information[chosen[-1]]
    for _ in range(10):
        before = list(chosen)
        for i, previous in enumerate(before):
            base = total - information[previous]
            chosen[i] = best_candidate(base, chosen[:i] + chosen[i + 1 :])
            total = base + information[chosen[i]]
        if chosen == before:
            break
    return chosen


def design_criterion(
    information: Array, criterion: str, names: tuple[str, ...]
) -> float:
    """Figure of merit of a design: det(F)^(1/p) (D), or p / trace(F^-1) (A), with the
    information F in typical units of the parameters.

    Args:
        information: (p, p) of all frames.
        criterion: D or A.
        names: (p,) names of the parameters.
    """
    unit = np.array([PARAMETERS[PLACE[name]].scale for name in names])
    values = np.maximum(np.linalg.eigvalsh(information * np.outer(unit, unit)), 1e-12)
    return float(
        np.exp(np.log(values).mean())
        if criterion == "D"
        else len(values) / (1 / values).sum()
    )


def _parameters(lens: Lens, protocol: BenchProtocol) -> tuple[tuple[str, ...], Array]:
    """Names of the fitted parameters, and their (p, p) prior information,
    diag(sigma^-2).
    """
    known = {k.name: k for k in protocol.known}
    exact = {k.name for k in protocol.known if k.sigma == 0}
    fitted = (
        {p.name for p in PARAMETERS if p.free} | set(protocol.free) | set(known)
    )  # NAMES has no unfitted ones
    names = tuple(name for name in NAMES if name in fitted - exact)
    sigma = [
        known[row.name].sigma if row.name in known else row.sigma
        for row in usual_parameters(names, lens)
    ]
    return names, np.diag([value**-2.0 for value in sigma])
