"""Which frames to take: source depths, field angles and exposures that tell most about
the lens (optimal design).
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
    missing,
    uncertainty,
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
# depths and angles, from which on a fit is tested on frames left out; one frame is
# refused
_LEAST_PLACES = 4
# at the rim: below, images are those of the focus, in which even errors act in second
# order
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
                f"wanted {self.name!r}: no such parameter{nearest_name_hint(self.name, NAMES)}"
            )
        if not (self.within > 0 and math.isfinite(self.within)):
            raise FitError(
                f"wanted {self.name}: within = {self.within}; need a finite number above 0"
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
        near, far = self.depths_um
        if not (0 < near < far and self.depth_count >= 2 and self.frames >= 1):
            raise FitError(
                f"depths_um {self.depths_um}, depth_count {self.depth_count}, frames {self.frames}: need "
                "0 < nearest < farthest, two depths or more and one frame or more"
            )
        if not (
            self.angles_deg
            and self.exposures
            and min(self.exposures) > 0
            and min(self.peak_e, self.pixel_um) > 0
        ):
            raise FitError(
                "need at least one of angles_deg and exposures; exposures, peak_e and pixel_um above 0"
            )


@dataclass(frozen=True, eq=False, slots=True)
class CapturePlan:
    """Frames to take, in the order of what each adds.

    depth_um, angle_deg, exposure: (n,) of the chosen frames. names, sigma: (p,)
    expected standard errors with them,
    within the model. untold: (p,) standard deviation of what causes that nobody states
    may add.
    even_sigma: (p,) with as many frames evenly spread over the depths at exposure 1 and
    the first angle.
    gain: (n,) criterion after each frame, relative to the last (1 at the end).
    warnings: what these frames will not tell, in words.
    """

    depth_um: Array
    angle_deg: Array
    exposure: Array
    names: tuple[str, ...]
    sigma: Array
    even_sigma: Array
    untold: Array
    gain: Array
    warnings: tuple[str, ...] = ()


def plan_captures(
    lens: Lens, protocol: BenchProtocol, response: Sensitivity
) -> CapturePlan:
    """D-optimal capture plan of a lens: the frames of most Fisher information, with the
    expected intervals.

    Accuracy: of the Fisher matrix at the nominal lens; errors of the real one change
    the weights in second order.

    Args:
        protocol: what the bench can do.
        response: what height, index and sidewall do to the pillars.

    Raises:
        FitError: as :class:`ForwardModel`.
    """
    names, prior = _parameters(lens, protocol)
    candidates, information = candidate_information(lens, protocol, response, names)
    place = np.unique(candidates[:, :2], axis=0, return_inverse=True)[1].ravel()
    chosen = choose_frames(
        information,
        prior,
        protocol.frames,
        criterion=protocol.criterion,
        names=names,
        place=place,
    )
    unstated = _unstated(lens, protocol, response, candidates[chosen])
    wanted = _left(names, unstated.sigma, protocol.wanted)
    chosen = chosen[
        : _needed(
            information, prior, chosen, names, wanted, least=_least(candidates[chosen])
        )
    ]
    even = _even(candidates, protocol, len(chosen))
    values = [
        design_criterion(
            prior + information[chosen[: i + 1]].sum(0), protocol.criterion, names
        )
        for i in range(len(chosen))
    ]
    covariances = [
        invert_information(prior + information[pick].sum(0)) for pick in (chosen, even)
    ]
    sigma, even_sigma = (np.sqrt(np.diag(c)) for c in covariances)
    depth, angle, exposure = candidates[chosen].T
    words = (
        *_short(names, sigma, unstated, protocol.wanted, len(chosen)),
        *_few(candidates[chosen]),
        *_blind(lens, protocol, depth),
    )
    gain = np.array(values) / values[-1]
    return CapturePlan(
        depth, angle, exposure, names, sigma, even_sigma, unstated.sigma, gain, words
    )


def _unstated(
    lens: Lens, protocol: BenchProtocol, response: Sensitivity, frames: Array
) -> UnmodelledShifts:
    """What a fit of (n, 3) frames (depth, angle in degrees, exposure), as bright as
    asked for, will allow for.
    """
    known = {k.name: k for k in protocol.known}
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
    x = parameter_vector({name: k.value for name, k in known.items()})
    brightest = (model.images(x)[0] / frames[:, 2, None, None]).max()
    x[PLACE["log_gain"]] = math.log(protocol.peak_e / brightest)
    image = model.images(x)[0]
    full, ones = image >= protocol.full_well_e, np.ones_like(image)
    data = FitImages(image, ones > 0, full, ones * protocol.read_noise_e**2, ones)
    free = tuple(
        name for name in protocol.free if name not in known or known[name].sigma > 0
    )
    return missing.expected_score_tests(
        SearchTask(model, data, x, known, None, free, sizes)
    )


def _left(
    names: tuple[str, ...], untold: Array, wanted: Sequence[IntervalRequirement]
) -> list[IntervalRequirement]:
    """What the model's own errors may take of the wanted intervals; all where what
    is unstated takes more.
    """
    left = []
    for one in wanted:
        beside = (
            REACH * float(untold[names.index(one.name)]) if one.name in names else 0.0
        )
        rest = one.within**2 - beside**2
        left.append(IntervalRequirement(one.name, math.sqrt(rest)) if rest > 0 else one)
    return left


def _least(frames: Array) -> int:
    """How many of (n, 3) frames, in their order, lie at ``_LEAST_PLACES`` depths and
    angles; all where none do.
    """
    places = [
        len({tuple(place) for place in frames[: n + 1, :2].tolist()})
        for n in range(len(frames))
    ]
    return next(
        (n + 1 for n, count in enumerate(places) if count >= _LEAST_PLACES), len(frames)
    )


def _needed(
    information: Array,
    prior: Array,
    chosen: list[int],
    names: tuple[str, ...],
    wanted: Sequence[IntervalRequirement],
    *,
    least: int,
) -> int:
    """How many of the chosen frames, in their order, give all intervals that are
    wanted; all of them where none do.
    """
    places = [(names.index(w.name), w.within) for w in wanted if w.name in names]
    if not places:
        return len(chosen)
    for count in range(least, len(chosen)):
        sigma = np.sqrt(
            np.diag(invert_information(prior + information[chosen[:count]].sum(0)))
        )
        if all(REACH * sigma[i] <= within for i, within in places):
            return count
    return len(chosen)


def _short(
    names: tuple[str, ...],
    sigma: Array,
    unstated: UnmodelledShifts,
    wanted: Sequence[IntervalRequirement],
    count: int,
) -> list[str]:
    """Intervals that are wanted and not reached, with the light that they would take,
    or what must be stated.
    """
    words = []
    for one in wanted:
        if one.name not in names:
            words.append(
                f"{one.name} is held, not fitted: no frame changes its interval"
            )
            continue
        i = names.index(one.name)
        own = REACH * float(sigma[i])
        untold = REACH * float(unstated.sigma[i])
        expected = f"{one.name} will be known to +- {math.hypot(own, untold):.2g}, wanted +- {one.within:.2g}"
        if untold >= one.within:
            most = [
                unstated.causes[k] for k in np.argsort(-unstated.by_cause[:, i])[:3]
            ]
            words.append(
                f"{expected}: within the model it is +- {own:.2g}, more frames do not help; state what else there is or is "
                f"not, first of all {', '.join(most)} (capture.toml, [[known]])"
            )
        elif math.hypot(own, untold) > one.within * (1 + 1e-9):
            more = own**2 / (one.within**2 - untold**2)
            words.append(
                f"{expected}: {more:.1f} times the light "
                f"({math.ceil(count * more)} such frames), other depths or angles, or an independent measurement"
            )
    return words


def _few(frames: Array) -> list[str]:
    """That (n, 3) frames lie at too few depths and angles for a fit to test itself, or
    for one at all.
    """
    places = len({tuple(place) for place in frames[:, :2].tolist()})
    if places >= _LEAST_PLACES:
        return []
    fate = "is refused" if places == 1 else "cannot be tested on frames left out"
    return [
        f"frames at {places} of the depths and angles: a fit of fewer than {2 if places == 1 else 4} {fate}; "
        "allow more frames"
    ]


def _blind(lens: Lens, protocol: BenchProtocol, chosen_um: Array) -> list[str]:
    """Ranges of depth whose images hide what is to be found: all in focus, or on one
    side of it.
    """
    focus = lens.source_distance_um
    if not (math.isfinite(focus) and focus > 0):
        return []
    ends = np.array([*protocol.depths_um, chosen_um.min(), chosen_um.max()])
    waves = (
        lens.diameters.radius_um**2
        / 2
        * np.abs(1 / ends - 1 / focus)
        / lens.wavelength_um
    )
    words = []
    if waves.max() < _DEFOCUS_WAVES:
        words.append(
            f"all depths are in focus (defocus of {waves.max():.2g} waves at most): a symmetric lens in focus fixes "
            "its bias, height and even aberrations poorly; go on to half a wave or more on both sides"
        )
    elif chosen_um.min() > focus or chosen_um.max() < focus:
        side = "farther" if chosen_um.min() > focus else "nearer"
        words.append(
            f"all frames are {side} than the focus at {focus:.4g} um: the signs of astigmatism, of spherical "
            "aberration and of the bias hang on defocus alone; take some on the other side"
        )
    return words


def candidate_information(
    lens: Lens, protocol: BenchProtocol, response: Sensitivity, names: tuple[str, ...]
) -> tuple[Array, Array]:
    """((c, 3) depth, angle in degrees, exposure; (c, p, p) Fisher information) of every
    candidate frame.

    Args:
        lens: the design.
        protocol: what the bench can do.
        response: what height, index and sidewall do to the pillars.
        names: of the parameters.
    """
    near, far = protocol.depths_um
    depths = 1 / np.linspace(1 / near, 1 / far, protocol.depth_count)
    pairs = np.array([(z, a) for a in protocol.angles_deg for z in depths])
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
    x = parameter_vector({k.name: k.value for k in protocol.known if k.name in PLACE})
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
    """Indices of ``count`` candidates (any may come again): greedy, then exchanges as
    long as they help.

    place: (c,) equal for candidates of one depth and angle; ``_LEAST_PLACES`` of them
    are kept, where there are so
    many. An optimum has hardly more places than its model needs, and nothing to test
    that model with.

    Args:
        information: (candidates, p, p) of each frame.
        prior: (p, p) information known beforehand.
        criterion: which optimality is asked for.
        names: (p,) names of the fitted parameters.
    """
    chosen: list[int] = []
    total = prior.copy()
    where = np.arange(len(information)) if place is None else place
    least = 0 if place is None else min(_LEAST_PLACES, count, len(set(where.tolist())))

    def best(base: Array, others: list[int]) -> int:
        taken = np.unique(where[others])
        new = (
            ~np.isin(where, taken) if len(taken) < least else np.ones(len(where), bool)
        )
        return int(
            np.argmax(
                [
                    design_criterion(base + one, criterion, names) if some else -np.inf
                    for one, some in zip(information, new, strict=True)
                ]
            )
        )

    for _ in range(count):
        chosen.append(best(total, chosen))
        total = total + information[chosen[-1]]
    for _ in range(10):
        before = list(chosen)
        for i, old in enumerate(before):
            base = total - information[old]
            chosen[i] = best(base, chosen[:i] + chosen[i + 1 :])
            total = base + information[chosen[i]]
        if chosen == before:
            break
    return chosen


def design_criterion(
    information: Array, criterion: str, names: tuple[str, ...]
) -> float:
    """What is to be large: det^(1/p) in typical units (D), or p over the sum of
    variances in typical units (A).

    Args:
        information: (p, p) of all frames.
        criterion: which optimality is asked for.
        names: of the parameters.
    """
    unit = np.array([PARAMETERS[PLACE[name]].scale for name in names])
    values = np.maximum(np.linalg.eigvalsh(information * np.outer(unit, unit)), 1e-12)
    return float(
        np.exp(np.log(values).mean())
        if criterion == "D"
        else len(values) / (1 / values).sum()
    )


def _parameters(lens: Lens, protocol: BenchProtocol) -> tuple[tuple[str, ...], Array]:
    """Names of what will be fitted, and what is known of it beforehand as (p, p)
    information.
    """
    known = {k.name: k for k in protocol.known}
    held = {k.name for k in protocol.known if k.sigma == 0}
    wanted = (
        {p.name for p in PARAMETERS if p.free} | set(protocol.free) | set(known)
    )  # the unfitted are in no NAMES
    names = tuple(name for name in NAMES if name in wanted - held)
    sigma = [
        known[row.name].sigma if row.name in known else row.sigma
        for row in usual_parameters(names, lens)
    ]
    return names, np.diag([s**-2.0 for s in sigma])


def _even(candidates: Array, protocol: BenchProtocol, count: int) -> list[int]:
    usual = np.flatnonzero(
        (candidates[:, 1] == protocol.angles_deg[0])
        & (candidates[:, 2] == protocol.exposures[0])
    )
    return [
        int(usual[i]) for i in np.linspace(0, len(usual) - 1, count).round().astype(int)
    ]
