"""Optimal design of captures: source depths, field angles and exposures of most Fisher
information on the lens.
"""

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from characterize.inference import (
    REACH,
    FitImages,
    SearchTask,
    UnmodelledShifts,
    invert_information,
    unmodelled_effects,
)
from characterize.model import (
    NAMES,
    PLACE,
    ForwardModel,
    FrameSetting,
    KnownValue,
    parameter_vector,
    typical_scales,
    unfitted_sizes,
)
from metalens.core.arrays import Array
from metalens.core.errors import FitError, nearest_name_hint
from metalens.fabrication import Sensitivity
from metalens.lens import Lens

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
    within: float = field(metadata={"above": 0})

    def __post_init__(self) -> None:
        if self.name not in PLACE:
            raise FitError(
                f"wanted {self.name!r}: no such "
                f"parameter{nearest_name_hint(self.name, NAMES)}"
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
    peak_e: float = field(default=8000.0, metadata={"above": 0})
    full_well_e: float = field(default=10000.0, metadata={"above": 0})
    read_noise_e: float = 2.0
    pixel_um: float = field(default=3.0, metadata={"above": 0})
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
        if not (self.angles_deg and self.exposures and min(self.exposures) > 0):
            raise FitError("need angles_deg, and exposures above 0")


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
    frames = candidate_frames(protocol)
    task = _expected_fit(lens, protocol, response, frames)
    names = task.names
    prior = np.diag(task.prior.sigma**-2.0)
    designed = task.at_start()
    candidates = np.concatenate(
        [frames * [1, 1, exposure] for exposure in protocol.exposures]
    )
    information = np.concatenate(
        [
            frame_information(designed.image, designed.slopes, exposure, protocol)
            for exposure in protocol.exposures
        ]
    )
    place = np.unique(candidates[:, :2], axis=0, return_inverse=True)[1].ravel()
    chosen = choose_frames(information, prior, place, protocol, names)
    unstated = unmodelled_effects.expected_shifts(
        _expected_fit(lens, protocol, response, candidates[chosen])
    )
    wanted = [one for one in protocol.wanted if one.name in names]
    within = np.array([one.within for one in wanted])
    indices = [names.index(one.name) for one in wanted]
    room = within**2 - (REACH * unstated.sigma[indices]) ** 2
    # an interval that the unstated causes alone exceed is one within the model
    limits = np.sqrt(np.where(room > 0, room, within**2)) / REACH
    places = [len(set(place[chosen[: i + 1]].tolist())) for i in range(len(chosen))]
    least = next(
        (i + 1 for i, n in enumerate(places) if n >= _LEAST_PLACES), len(chosen)
    )
    for count in range(least if wanted else len(chosen), len(chosen) + 1):
        fisher = prior + information[chosen[:count]].sum(0)
        sigma = np.sqrt(np.diag(invert_information(fisher)))
        if (sigma[indices] <= limits).all():
            break
    chosen = chosen[:count]
    missed = [_missed_interval(one, names, sigma, unstated, count) for one in wanted]
    missed += [
        f"{one.name} is fixed, not fitted: no frame changes its interval"
        for one in protocol.wanted
        if one.name not in names
    ]
    if places[count - 1] < _LEAST_PLACES:
        few = "fewer than 2 is refused"
        if places[count - 1] > 1:
            few = f"fewer than {_LEAST_PLACES} cannot be tested on frames left out"
        missed.append(
            f"frames at {places[count - 1]} of the depths and angles: a fit of {few}; "
            "allow more frames"
        )
    depth, angle, exposure = candidates[chosen].T
    warnings = (*filter(None, missed), *_focus_warnings(lens, protocol, depth))
    return CapturePlan(depth, angle, exposure, names, sigma, unstated.sigma, warnings)


def _missed_interval(
    wanted: IntervalRequirement,
    names: tuple[str, ...],
    sigma: Array,
    unstated: UnmodelledShifts,
    count: int,
) -> str:
    """Sentence on a required interval that is not reached: by how much more light, or
    which causes to state; empty where it is reached.

    Args:
        wanted: interval of one of the parameters.
        names: (p,) parameters.
        sigma: (p,) standard errors within the model.
        unstated: shifts by causes that nobody states.
        count: number of chosen frames.
    """
    index = names.index(wanted.name)
    within_model = REACH * float(sigma[index])
    unstated_half = REACH * float(unstated.sigma[index])
    total = math.hypot(within_model, unstated_half)
    room = wanted.within**2 - unstated_half**2
    expected = (
        f"{wanted.name} will be known to +- {total:.2g}, wanted +- {wanted.within:.2g}"
    )
    factor = within_model**2 / room if room > 0 else 0.0
    if factor > 1 + 1e-9:
        return (
            f"{expected}: {factor:.1f} times the light ({math.ceil(count * factor)} "
            "such frames), other depths or angles, or an independent measurement"
        )
    if room > 0:
        return ""
    worst = np.argsort(-unstated.by_cause[:, index])[:3]
    causes = ", ".join(unstated.causes[cause] for cause in worst)
    return (
        f"{expected}: within the model it is +- {within_model:.2g}, more frames do not "
        f"help; state what else there is or is not, first of all {causes} "
        "(capture.toml, [[known]])"
    )


def _expected_fit(
    lens: Lens, protocol: BenchProtocol, response: Sensitivity, frames: Array
) -> SearchTask:
    """Fit of frames that were not taken yet: those of the lens as designed, with the
    light of ``peak_e`` in the brightest pixel at exposure 1.

    Args:
        frames: (n, 3) depth in um, angle in degrees, relative exposure.
    """
    depth_um, angle_deg, exposure = frames.T
    angles = np.stack([np.radians(angle_deg), np.zeros(len(frames))], 1)
    side = protocol.pixels
    setting = FrameSetting(depth_um, angles, exposure, protocol.pixel_um, side, side)
    model = ForwardModel(lens, setting, response)
    known = {value.name: value for value in protocol.known}
    sizes = unfitted_sizes(known, lens)
    x = parameter_vector({name: stated.value for name, stated in known.items()})
    light = model.images(x)[0]
    brightness = protocol.peak_e / (light / exposure[:, None, None]).max()
    x[PLACE["log_gain"]] = math.log(brightness)
    image = model.images(x)[0]
    ones = np.ones_like(image)
    saturated = image >= protocol.full_well_e
    data = FitImages(image, ones > 0, saturated, ones * protocol.read_noise_e**2, ones)
    free = tuple(
        name for name in protocol.free if name not in known or known[name].sigma > 0
    )
    return SearchTask(model, data, x, known, free, sizes)


def _focus_warnings(lens: Lens, protocol: BenchProtocol, chosen_um: Array) -> list[str]:
    """Warning that all frames are in focus, or all on one side of it; empty otherwise.

    Defocus at the rim in waves: radius² / 2 * |1/z - 1/z_focus| / wavelength.
    """
    focus = lens.source_distance_um
    if not (math.isfinite(focus) and focus > 0):
        return []
    nearest, farthest = chosen_um.min(), chosen_um.max()
    extremes = np.array([*protocol.depths_um, nearest, farthest])
    defocus_um = lens.diameters.radius_um**2 / 2 * np.abs(1 / extremes - 1 / focus)
    waves = defocus_um.max() / lens.wavelength_um
    if waves < _DEFOCUS_WAVES:
        return [
            f"all depths are in focus (defocus of {waves:.2g} waves at most): a "
            "symmetric lens in focus fixes its bias, height and even aberrations "
            "poorly; go on to half a wave or more on both sides"
        ]
    if nearest <= focus <= farthest:
        return []
    side = "farther" if nearest > focus else "nearer"
    return [
        f"all frames are {side} than the focus at {focus:.4g} um: the signs of "
        "astigmatism, of spherical aberration and of the bias hang on defocus alone; "
        "take some on the other side"
    ]


def candidate_frames(protocol: BenchProtocol) -> Array:
    """(c, 3) depth in um, angle in degrees and exposure 1 of the frames that the bench
    can take, depths even in 1/z.

    Args:
        protocol: what the bench can do.
    """
    nearest, farthest = protocol.depths_um
    depths = 1 / np.linspace(1 / nearest, 1 / farthest, protocol.depth_count)
    angle, depth = np.meshgrid(protocol.angles_deg, depths, indexing="ij")
    return np.stack([depth.ravel(), angle.ravel(), np.ones(depth.size)], 1)


def frame_information(
    images: Array, slopes: Array, exposure: float, protocol: BenchProtocol
) -> Array:
    """(n, p, p) Fisher information of every frame at a relative exposure t: sum over
    unsaturated pixels of t² dI/dp dI/dq / (t I + read noise²).

    Args:
        images: (n, y, x) light I at exposure 1, electrons.
        slopes: (p, n, y, x) derivatives of ``images``.
        exposure: relative exposure t.
        protocol: full well and read noise of the sensor.
    """
    light = np.maximum(images * exposure, 0)
    variance_e2 = light + protocol.read_noise_e**2
    weight = (light < protocol.full_well_e) / variance_e2 * exposure**2
    return np.asarray(
        np.einsum("inyx,nyx,jnyx->nij", slopes, weight, slopes, optimize=True)
    )


def choose_frames(
    information: Array,
    prior: Array,
    place: Array,
    protocol: BenchProtocol,
    names: tuple[str, ...],
) -> list[int]:
    """Indices of the candidates to take, by greedy choice, then exchanges until none
    helps (Fedorov); a candidate may be chosen again.

    An optimum has hardly more places than its model has parameters, and none to test
    the model with. So the first choices go to new places until there are
    ``_LEAST_PLACES``.

    Args:
        information: (candidates, p, p) of each frame.
        prior: (p, p) information known beforehand.
        place: (candidates,) number of the depth and angle.
        protocol: number of frames and criterion.
        names: (p,) names of the fitted parameters.
    """
    least = min(_LEAST_PLACES, protocol.frames, len(set(place.tolist())))
    chosen: list[int] = []
    for _ in range(11):
        before = list(chosen)
        for position in range(protocol.frames):
            others = chosen[:position] + chosen[position + 1 :]
            base = prior + information[others].sum(0)
            used = np.unique(place[others])
            merits = [
                design_criterion(base + one, protocol.criterion, names)
                if len(used) >= least or here not in used
                else -np.inf
                for one, here in zip(information, place, strict=True)
            ]
            chosen[position : position + 1] = [int(np.argmax(merits))]
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
    unit = typical_scales(names)
    values = np.maximum(np.linalg.eigvalsh(information * np.outer(unit, unit)), 1e-12)
    return float(
        np.exp(np.log(values).mean())
        if criterion == "D"
        else len(values) / (1 / values).sum()
    )
