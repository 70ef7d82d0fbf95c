"""Mask correction from an as-built lens: bias table, corrected diameter map, predicted
gain, and whether the posterior is narrow enough for them.
"""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from characterize.inference import AsBuilt
from characterize.model import PLACE, as_built, parameter_vector, process_state_of
from metalens import lens as lenses
from metalens.core import store
from metalens.core.arrays import Array
from metalens.core.errors import ConfigError
from metalens.fabrication import (
    STEEPEST,
    Bias,
    Sensitivity,
    State,
    of_process,
    perturbed_transmission,
)
from metalens.lens import Lens
from metalens.optics.paths import axial_path_difference

# largest standard deviation of usable table entries: the step of drawn diameters
WIDE_NM = 2.0
_FRAMES = (
    "frames at source depths on both sides of focus where the spot is several pixels wide (metalens capture lens.h5 "
    "--plan lists the best), frames at a field angle, diameters from micrographs (metalens measure) or the height "
    "(AFM) as [[known]]"
)


@dataclass(frozen=True, eq=False, slots=True)
class MaskCorrection:
    """Proposal for the next mask.

    drawn_nm, bias_nm: (knots,) the new bias table: made less drawn diameter, as
    ``layout`` takes it.
    old_nm: (knots,) bias of the present table at the same drawn diameters.
    wanted_um: (knots,) made diameter that gives the designed phase in the process as it
    is, for ``designed_um``.
    lens: the design with the unevenness of the bias taken off every pillar; to be drawn
    with the new table.
    """

    drawn_nm: Array
    bias_nm: Array
    old_nm: Array
    designed_um: Array
    wanted_um: Array
    lens: Lens


@dataclass(frozen=True, eq=False, slots=True)
class PredictedLens:
    """Simulated lens after a step of the correction.

    name: the step. lens, parameters: diameters, and all parameters of the fit's order.
    strehl: Strehl ratio against the designed wave front. light: transmitted power over
    that of the design.
    """

    name: str
    lens: Lens
    parameters: Array
    strehl: float
    light: float


@dataclass(frozen=True, eq=False, slots=True)
class NextMask:
    """Correction of the next mask, its predicted gain, and what speaks against it.

    steps: simulated lens after each step; Strehl ratio and light are means over the
    lenses that stood for the truth.
    refused: why there is no correction; uneven: why the map alone is not corrected;
    empty where they are usable.
    """

    plan: MaskCorrection
    steps: list[PredictedLens]
    refused: str
    uneven: str

    @property
    def summary(self) -> str:
        """Predicted gain, or why there is none, in words."""
        if self.refused:
            return self.refused
        before, table, both = self.steps[:3]
        words = f"predicted Strehl ratio {table.strehl:.3f} with the new bias table"
        if not self.uneven:
            words += f", {both.strehl:.3f} with the corrected map too"
        words += f", for {before.strehl:.3f} as made"
        return f"{words}; bias table alone: {self.uneven}" if self.uneven else words


def plan_next_mask(
    result: AsBuilt, *, old: Bias, truths: Sequence[Array] | None = None
) -> NextMask:
    """Correction of the next mask from a fit, judged by posterior and simulated gain.

    Refused where the table's standard deviation over the posterior is above 2 nm, or
    where the simulated lens has a lower Strehl ratio with it.

    Args:
        result: of the fit.
        old: bias that the present mask was drawn with.
        truths: all parameters of lenses that stand for the real one; None: three draws
            from the posterior.

    Raises:
        ConfigError: as :func:`propose_correction`.
    """
    design, response, best = result.design, result.response, result.parameters()
    plan = propose_correction(design, best, response=response, old=old)
    if truths is None:
        truths = [result.parameters(row) for row in result.samples(3, seed=7)]
    lenses_of_truths = [
        predict_lenses(plan, design, response, best, truth) for truth in truths
    ]
    steps = [
        dataclasses.replace(
            each[0],
            strehl=float(np.mean([lens.strehl for lens in each])),
            light=float(np.mean([lens.light for lens in each])),
        )
        for each in zip(*lenses_of_truths, strict=True)
    ]

    def bias_table_nm(x: Array) -> Array:
        return _bias_table(design, x, response, old)[-1]

    table_open = reason_left_open(result, TABLE, bias_table_nm)
    map_open = reason_left_open(result, MAP, uneven_nm)
    return NextMask(
        plan,
        steps,
        refused=table_open or loss_reason(steps[0], steps[1]),
        uneven=map_open or loss_reason(steps[1], steps[2]),
    )


def propose_correction(
    design: Lens, x: Array, *, response: Sensitivity, old: Bias
) -> MaskCorrection:
    """Bias table and corrected diameter map for fitted process parameters.

    Drawn diameter = mask rule at (corrected diameter - bias of the process); the table
    is designed minus drawn, at evenly spaced designed diameters.

    Args:
        design: as designed. x: all parameters of a lens, in the fit's order.
        response: of the pillars to height, index and side wall.
        old: bias that the present mask was drawn with.

    Raises:
        ConfigError: pillars of two sizes, or the table would be steeper than the layout
            can invert.
    """
    designed_um, corrected_um, drawn_nm, bias_nm = _bias_table(design, x, response, old)
    return MaskCorrection(
        drawn_nm,
        bias_nm,
        old.at(drawn_nm),
        designed_um,
        corrected_um,
        _with_even_bias(design, x),
    )


def _bias_table(
    design: Lens, x: Array, response: Sensitivity, old: Bias
) -> tuple[Array, Array, Array, Array]:
    """Designed and corrected diameters in um, drawn diameters and bias in nm.

    Each is (knots,). Arguments as of :func:`propose_correction`.

    Raises:
        ConfigError: as :func:`propose_correction`.
    """
    if design.pairs is not None:
        raise ConfigError("pillars of two sizes have no bias table of one size")
    diameter = design.diameters.diameter_um
    least = float(diameter.min(where=diameter > 0, initial=np.inf))
    designed_um = np.linspace(least, float(diameter.max()), 13)
    corrected_um = _corrected_diameters_um(design, designed_um, x, response)
    drawn_nm = old.drawn_nm(corrected_um * 1e3 - process_state_of(x)["bias_nm"])
    bias_nm = designed_um * 1e3 - drawn_nm
    slope = float(np.abs(np.diff(bias_nm) / np.diff(drawn_nm)).max())
    if slope > STEEPEST:
        raise ConfigError(
            f"the table would change by {slope:.2f} nm per nm, the layout takes {STEEPEST}: the as-built "
            "lens is too far from its design for a table; correct height or index in the process instead"
        )
    return designed_um, corrected_um, drawn_nm, bias_nm


def predict_lenses(
    plan: MaskCorrection,
    design: Lens,
    response: Sensitivity,
    x_fit: Array,
    x_true: Array,
) -> list[PredictedLens]:
    """Simulated lenses of each step of a correction, with their Strehl ratios.

    The lens as made, then with the new table, then with the corrected map too, and last
    at the corrected sensor distance. Summed over every pillar, on the axis.

    Args:
        plan: proposed correction of the next mask.
        design: as designed.
        response: of the pillars to height, index and side wall.
        x_fit: parameters that the correction was computed from.
        x_true: parameters of the real process. Both hold all parameters.
    """
    with_table = _drawn_with(design, plan, x_fit)
    with_map = _drawn_with(plan.lens, plan, x_fit)
    x_spacer = x_true.copy()
    x_spacer[PLACE["distance_um"]] -= x_fit[PLACE["distance_um"]]
    steps = (
        ("as made", design, x_true),
        ("new bias table", with_table, x_true),
        ("table and corrected map", with_map, x_true),
        ("and the spacer set right", with_map, x_spacer),
    )
    goal = _wave(design, response, parameter_vector())
    power = float((abs(goal) ** 2).sum())
    predicted = []
    for name, lens, x in steps:
        wave = _wave(lens, response, x)
        light = float((abs(wave) ** 2).sum()) / power
        overlap = wavefront_overlap(wave, goal)
        predicted.append(PredictedLens(name, lens, x, overlap, light))
    return predicted


def _wave(lens: Lens, response: Sensitivity, x: Array) -> Array:
    """(y, x) wave behind every pillar, with the defocus of a wrong sensor distance.

    The wavelength of the bench's source does not count.
    """
    x = x.copy()
    x[PLACE["wavelength_nm"]] = 0.0
    radius2 = lens.diameters.x_um**2 + lens.diameters.y_um[:, None] ** 2
    distance = lens.sensor_distance_um
    defocus_um = axial_path_difference(
        radius2, distance + float(x[PLACE["distance_um"]])
    ) - axial_path_difference(radius2, distance)
    wave = as_built.as_built_transmission(lens, response, x)
    return np.asarray(wave * np.exp(2j * np.pi / lens.wavelength_um * defocus_um))


def loss_reason(before: PredictedLens, after: PredictedLens) -> str:
    """Why a step of the correction is not written: the simulated lens is worse with it;
    empty where it is not.

    Args:
        before: lens without the step of the correction. after: lens with it.
    """
    if after.strehl >= before.strehl:
        return ""
    return (
        f"no correction: the simulated lens is worse with it, Strehl ratio "
        f"{after.strehl:.3f} ({after.name}) against {before.strehl:.3f} ({before.name})"
    )


def wavefront_overlap(one: Array, other: Array) -> float:
    """Strehl ratio |<a, b>|² / (<a, a> <b, b>) of one wave against another, best
    piston.

    Args:
        one: wave. other: reference wave on the same nodes.
    """
    cross = abs(np.vdot(one, other)) ** 2
    return float(cross / ((abs(one) ** 2).sum() * (abs(other) ** 2).sum()))


def uneven_nm(x: Array, *, angles: int = 8) -> Array:
    """(points,) deviation of the bias from its mean, nm: what the corrected map
    subtracts.

    At the axis, at half the radius and along the rim.

    Args:
        x: all parameters of a lens, in the fit's order.
        angles: points along each circle.
    """
    angle = 2 * np.pi * np.arange(angles) / angles
    rho = np.repeat([0.5, 1.0], angles)
    u = np.append(0.0, rho * np.tile(np.cos(angle), 2))
    v = np.append(0.0, rho * np.tile(np.sin(angle), 2))
    state = process_state_of(x)
    return np.asarray(state.bias_um(u, v) * 1e3 - state["bias_nm"])


def write_correction(
    folder: Path, plan: MaskCorrection, *, evened: bool = True, prefix: str = ""
) -> None:
    """Write bias.csv, bias.toml (the [bias] table of PROCESS.toml) and
    lens_corrected.h5.

    Args:
        folder: of the files. plan: proposed correction of the next mask.
        evened: write the lens file too.
        prefix: of the names of the files.
    """
    knots = list(zip(plan.drawn_nm, plan.bias_nm, strict=True))
    rows = [f"{drawn:.3f},{bias:.3f}" for drawn, bias in knots]
    lines = ["drawn_nm,bias_nm", *rows]
    store.write_text(folder / f"{prefix}bias.csv", "\n".join(lines) + "\n")
    pairs = ", ".join(f"[{drawn:.3f}, {bias:.3f}]" for drawn, bias in knots)
    store.write_text(folder / f"{prefix}bias.toml", f"[bias]\ntable_nm = [{pairs}]\n")
    if evened:
        lenses.save(folder / f"{prefix}lens_corrected.h5", plan.lens)


def present_bias(path: Path | None) -> Bias:
    """The bias that a mask was drawn with, from its PROCESS.toml; none without a file.

    Args:
        path: of the file; None without one.

    Raises:
        ConfigError, ProcessError: as :func:`metalens.fabrication.of_process`.
    """
    return Bias() if path is None else of_process(path).bias


def _corrected_diameters_um(
    design: Lens, designed: Array, x: Array, response: Sensitivity
) -> Array:
    """(knots,) diameters whose phase in the process is the designed one, up to a
    piston.

    The phase over 4001 diameters is inverted by interpolation. For pillars that change
    form as their edges move, it is that of the designed pillar with all edges moved.

    Args:
        designed: (knots,) um. x: all parameters of a lens, in the fit's order.
    """
    low, high = design.proxy.domain_um
    fine = np.linspace(low, min(high, 0.999 * design.diameters.pitch_um), 4001)
    wave = design.wavelength_um
    process_phase, design_phase = (
        np.unwrap(
            np.angle(
                perturbed_transmission(
                    design.proxy, response, fine, wave, state.response_amounts()
                )
            )
        )
        for state in (process_state_of(x), State.of())
    )
    inside = (fine >= designed[0]) & (fine <= designed[-1])
    piston = float((process_phase - design_phase)[inside].mean())
    goal = np.interp(designed, fine, design_phase) + piston

    def phase_of_moved_edges(size: float) -> Array:
        rate = response.by_edges((fine + size) / 2)
        if rate is None:
            return np.maximum.accumulate(process_phase)
        return np.maximum.accumulate(process_phase + (fine - size) * rate.imag)

    return np.array(
        [
            np.interp(phase, phase_of_moved_edges(size), fine)
            for size, phase in zip(designed.tolist(), goal.tolist(), strict=True)
        ]
    )


def _with_even_bias(design: Lens, x: Array) -> Lens:
    """The design with the bias's deviation from its mean subtracted from every
    diameter.
    """
    state = process_state_of(x)
    diameter = design.diameters.diameter_um
    uneven_um = as_built.on_pillars(design.diameters, state.bias_um)
    uneven_um -= state["bias_nm"] * 1e-3
    return _with_diameters(design, diameter - uneven_um, diameter > 0)


def _drawn_with(design: Lens, plan: MaskCorrection, x_fit: Array) -> Lens:
    """The design with diameters that its process turns into those of the new table.

    D + (corrected - designed)(D) - fitted bias, um; the corrected diameters are
    interpolated between the knots of the table.
    """
    d = design.diameters.diameter_um
    change = (
        np.interp(d, plan.designed_um, plan.wanted_um - plan.designed_um)
        - process_state_of(x_fit)["bias_nm"] * 1e-3
    )
    return _with_diameters(design, d + change, d > 0, limit=False)


def _with_diameters(
    design: Lens, diameter_um: Array, printed: Array, *, limit: bool = True
) -> Lens:
    """The lens with other diameters, clipped to the proxy's domain and the pitch.

    Args:
        printed: (y, x) where there is a pillar; elsewhere the diameter is 0.
        limit: clip to the domain; False where a bias will return them into it.
    """
    low, high = design.proxy.domain_um if limit else (1e-3, np.inf)
    top = min(high, 0.999 * design.diameters.pitch_um)
    clipped = np.where(printed, np.clip(diameter_um, low, top), 0).astype(np.float32)
    return dataclasses.replace(
        design,
        diameters=dataclasses.replace(design.diameters, diameter_um=clipped),
        profile=f"{design.profile}, corrected",
        neighbours=None,
    )


def table_rows(plan: MaskCorrection) -> list[tuple[Any, ...]]:
    """Rows of the printed table: drawn diameter, present bias, new bias, designed and
    corrected diameter, all in nm.

    Args:
        plan: proposed correction of the next mask.
    """
    columns = (
        plan.drawn_nm,
        plan.old_nm,
        plan.bias_nm,
        plan.designed_um * 1e3,
        plan.wanted_um * 1e3,
    )
    return [tuple(float(v) for v in row) for row in zip(*columns, strict=True)]


# parts of a correction in words, and the parameters that each follows
TABLE = "the bias table", ("bias_nm", "height_nm", "index", "sidewall_deg")
MAP = (
    "what varies over the lens",
    ("bias_x_nm", "bias_y_nm", "bias_r_nm", "bias_a_nm", "bias_o_nm"),
)


def reason_left_open(
    result: AsBuilt,
    part: tuple[str, tuple[str, ...]],
    correction_nm: Callable[[Array], Array],
    *,
    count: int = 24,
) -> str:
    """Why the posterior leaves a correction too open to be used, and what to measure.

    Empty where its standard deviation over ``count`` draws is at most ``WIDE_NM``
    everywhere.

    Args:
        result: of the fit.
        part: ``TABLE`` or ``MAP``.
        correction_nm: (knots,) nm from all parameters of one lens: the bias table, or
            the deviation that the map subtracts.
        count: draws from the posterior; their standard deviation is known to
            1 / sqrt(2 count), 14 %.
    """
    draws = result.samples(count, seed=5)
    try:
        corrections = [correction_nm(result.parameters(row)) for row in draws]
    except ConfigError as refusal:
        return f"no correction: for lenses of the posterior {refusal}"
    sigma = float(np.std(corrections, axis=0, ddof=1).max())
    if sigma <= WIDE_NM:
        return ""
    words, of_part = part
    names = [name for name in of_part if name in result.names]
    intervals = ", ".join(
        "{} {:.3g} to {:.3g}".format(name, *result.interval(name)) for name in names
    )
    causes = dict.fromkeys(cause for name in names for cause in result.most(name))
    state = f"a statement on {', '.join(causes)} (capture.toml, [[known]]), " * any(
        causes
    )
    return (
        f"no correction: the posterior leaves {words} open by {sigma:.1f} nm (1 sigma, at most "
        f"{WIDE_NM:g} allowed; {intervals}). Settle it by {state}{_FRAMES}"
    )
