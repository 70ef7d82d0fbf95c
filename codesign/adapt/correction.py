"""What the next lithography run should draw: a bias table from the as-built lens, a
corrected map, their gain, and whether the lens is known well enough for them.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from characterize.inference import AsBuilt
from characterize.model import PLACE, process_state_of
from codesign.optics import MadeLens, PixelPsfStack
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
from metalens.lens import DiameterMap, Lens

_RAYS = 8  # of the places where the corrected map is judged
DRAWS = 24
# standard deviation of the table's entries beyond which it is no table: the step of
# drawn diameters
WIDE_NM = 2.0
_SETTLED = (  # word of a cause, and what states it
    ("side wall", "the side wall by a cross-section ([[known]] sidewall_deg)"),
    ("refractive index", "the index by ellipsometry ([[known]] index)"),
    (
        "pixel pitch",
        "the pixel pitch in the light by a target of known period (pixel_sigma_um of capture.toml)",
    ),
    (
        "illumination",
        "the light on the lens by a frame of the lamp alone ([[known]] light_x, light_y, light_r)",
    ),
    (
        "glass",
        "the glass in the beam (glass_um, glass_tilt_x_deg, glass_tilt_y_deg of capture.toml)",
    ),
    ("write fields", "the overlay of the write fields ([[known]] stitching_nm)"),
    ("source", "the size of the source (pinhole_um of capture.toml)"),
    ("spectrum", "the spectrum ([[known]] bandwidth_nm)"),
    (
        "tilt of the lens",
        "the tilt of the lens, by frames at opposite field angles ([[known]] tilt_x_deg, tilt_y_deg)",
    ),
    (
        "saddle",
        "diameters round the rim by micrographs ([[known]] bias_a_nm, bias_o_nm)",
    ),
)
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
class LensProposal:
    """One state of the next lens: its PSFs, Strehl ratio against the designed wave
    front, and light.
    """

    name: str
    stack: PixelPsfStack
    strehl: float
    light: float


@dataclass(frozen=True, eq=False, slots=True)
class CorrectionTable:
    """A bias table, (knots,) each: see :class:`MaskCorrection`."""

    drawn_nm: Array
    bias_nm: Array
    designed_um: Array
    wanted_um: Array


def propose_correction(
    design: Lens, x: Array, *, response: Sensitivity, old: Bias
) -> MaskCorrection:
    """The correction that fitted parameters ask for.

    Args:
        x: all parameters of the fit. old: bias that the present mask was drawn with.
        design: as designed. response: of the pillars to height, index and side wall.

    Raises:
        ConfigError: the table would be steeper than the layout can invert.
    """
    made = correction_table(
        design, x, response=response, old=old, range_um=printed_um(design)
    )
    return MaskCorrection(
        made.drawn_nm,
        made.bias_nm,
        old.at(made.drawn_nm),
        made.designed_um,
        made.wanted_um,
        _evened(design, x),
    )


def printed_um(design: Lens) -> tuple[float, float]:
    """(least, largest) diameter of the design's pillars."""
    diameter = design.diameters.diameter_um
    return float(diameter.min(where=diameter > 0, initial=np.inf)), float(
        diameter.max()
    )


def correction_table(
    design: Lens,
    x: Array,
    *,
    response: Sensitivity,
    old: Bias,
    range_um: tuple[float, float],
    knots: int = 13,
) -> CorrectionTable:
    """The bias table alone, without a look at the pillars: what many draws of a
    posterior are asked for.

    Args:
        design: as designed. x: all parameters of a lens, in the fit's order.
        response: of the pillars to height, index and side wall.
        old: of the present mask. range_um: least and largest diameter of the design.
        knots: of the table.

    Raises:
        ConfigError: the table would be steeper than the layout can invert.
    """
    designed = np.linspace(*range_um, knots)
    wanted = _wanted_um(design, designed, x, response)
    drawn = old.drawn_nm(wanted * 1e3 - process_state_of(x)["bias_nm"])
    bias = designed * 1e3 - drawn
    slope = np.diff(bias) / np.diff(drawn)
    if np.abs(slope).max() > STEEPEST:
        raise ConfigError(
            f"the table would change by {np.abs(slope).max():.2f} nm per nm, the layout takes {STEEPEST}: the as-built "
            "lens is too far from its design for a table; correct height or index in the process instead"
        )
    return CorrectionTable(drawn, bias, designed, wanted)


def next_lenses(
    made: MadeLens, plan: MaskCorrection, x_fit: Array, x_true: Array
) -> list[LensProposal]:
    """The lens as made, with the new table, with the corrected map too, and at the
    corrected distance besides.

    Args:
        x_fit: what the correction was made from. x_true: what the process really does;
            both all parameters.
        plan: proposed correction of the next mask.
    """
    tabled = _drawn_with(made.design, plan, x_fit)
    full = made.redrawn(_drawn_with(plan.lens, plan, x_fit))
    placed = x_true.copy()
    placed[PLACE["distance_um"]] -= x_fit[PLACE["distance_um"]]
    cases = (
        ("as made", made, x_true),
        ("new bias table", made.redrawn(tabled), x_true),
        ("table and corrected map", full, x_true),
        ("and the spacer set right", full, placed),
    )
    goal = made.wave()
    out = []
    for name, lens, x in cases:
        wave = lens.wave(x)
        out.append(
            LensProposal(
                name,
                lens.stack(x),
                wavefront_overlap(wave, goal),
                float((abs(wave) ** 2).sum() / (abs(goal) ** 2).sum()),
            )
        )
    return out


def loss_reason(before: LensProposal, after: LensProposal) -> str:
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
    """Strehl ratio of one wave against another on the same nodes: |<a, b>|² / (<a, a>
    <b, b>), best piston.

    Args:
        other: the one it is compared with.
    """
    cross = abs(np.vdot(one, other)) ** 2
    return float(cross / ((abs(one) ** 2).sum() * (abs(other) ** 2).sum()))


def uneven_nm(x: Array) -> Array:
    """(places,) nm that the corrected map takes off at the axis, half-way and along the
    rim, of all parameters.

    Args:
        x: all parameters of a lens, in the fit's order.
    """
    turn = 2 * np.pi * np.arange(_RAYS) / _RAYS
    rho = np.repeat([0.5, 1.0], _RAYS)
    u, v = (np.append(0.0, rho * np.tile(way(turn), 2)) for way in (np.cos, np.sin))
    return np.asarray(
        process_state_of(x).bias_um(u, v) * 1e3 - process_state_of(x)["bias_nm"]
    )


def write_correction(
    folder: Path, plan: MaskCorrection, *, evened: bool = True
) -> None:
    """bias.csv and bias.toml (the [bias] table of PROCESS.toml), and lens_corrected.h5
    where it is ``evened``.

    Args:
        folder: of the files. plan: proposed correction of the next mask.
    """
    rows = [
        f"{d:.3f},{b:.3f}" for d, b in zip(plan.drawn_nm, plan.bias_nm, strict=True)
    ]
    store.write_text(folder / "bias.csv", "\n".join(["drawn_nm,bias_nm", *rows]) + "\n")
    pairs = ", ".join(
        f"[{d:.3f}, {b:.3f}]" for d, b in zip(plan.drawn_nm, plan.bias_nm, strict=True)
    )
    store.write_text(folder / "bias.toml", f"[bias]\ntable_nm = [{pairs}]\n")
    if evened:
        lenses.save(folder / "lens_corrected.h5", plan.lens)


def present_bias(path: Path | None) -> Bias:
    """The bias that a mask was drawn with, from its PROCESS.toml; none without a file.

    Args:
        path: of the file; None without one.

    Raises:
        ConfigError, ProcessError: as :func:`metalens.fabrication.of_process`.
    """
    return Bias() if path is None else of_process(path).bias


def _wanted_um(design: Lens, designed: Array, x: Array, response: Sensitivity) -> Array:
    """Made diameters whose phase in the process as it is equals the designed one, up to
    a piston.

    Of pillars that lose their form as their edges move: by the phase of the designed
    ones with all edges moved so far.
    """
    low, high = design.proxy.domain_um
    fine = np.linspace(low, min(high, 0.999 * design.diameters.pitch_um), 4001)
    wave = design.wavelength_um
    now, meant = (
        np.unwrap(
            np.angle(
                perturbed_transmission(
                    design.proxy, response, fine, wave, made.answers()
                )
            )
        )
        for made in (process_state_of(x), State.of())
    )
    inside = (fine >= designed[0]) & (fine <= designed[-1])
    piston = float((now - meant)[inside].mean())
    goal = np.interp(designed, fine, meant) + piston

    def made(size: float) -> Array:
        rate = response.by_edges((fine + size) / 2)
        return np.maximum.accumulate(
            now if rate is None else now + (fine - size) * rate.imag
        )

    return np.array(
        [
            np.interp(g, made(size), fine)
            for size, g in zip(designed.tolist(), goal.tolist(), strict=True)
        ]
    )


def _evened(design: Lens, x: Array) -> Lens:
    d = design.diameters
    constant = process_state_of(x)["bias_nm"] * 1e-3
    change = np.empty(d.diameter_um.shape, np.float32)
    for first in range(0, len(change), 256):
        rows = slice(first, first + 256)
        u, v = np.meshgrid(d.x_um / d.radius_um, d.y_um[rows] / d.radius_um)
        change[rows] = process_state_of(x).bias_um(u, v) - constant
    return _with_diameters(design, d.diameter_um - change, d.diameter_um > 0)


def _drawn_with(design: Lens, plan: MaskCorrection, x_fit: Array) -> Lens:
    """The lens whose diameters, made by a process of that bias, are those that the new
    table aims at.
    """
    d = design.diameters.diameter_um
    aim = (
        np.interp(d, plan.designed_um, plan.wanted_um - plan.designed_um)
        - process_state_of(x_fit)["bias_nm"] * 1e-3
    )
    return _with_diameters(design, d + aim, d > 0, keep=False)


def _with_diameters(
    design: Lens, diameter_um: Array, there: Array, *, keep: bool = True
) -> Lens:
    """The lens with other diameters, kept within the proxy's domain unless a bias will
    bring them back into it.
    """
    low, high = design.proxy.domain_um if keep else (1e-3, np.inf)
    top = min(high, 0.999 * design.diameters.pitch_um)
    inside = np.where(there, np.clip(diameter_um, low, top), 0).astype(np.float32)
    return dataclasses.replace(
        design,
        diameters=DiameterMap(inside, design.diameters.pitch_um),
        profile=f"{design.profile}, corrected",
    )


def table_rows(plan: MaskCorrection) -> list[tuple[Any, ...]]:
    """Rows of the table for people: drawn diameter, present bias, new bias, designed
    and aimed diameter, nm.

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


@dataclass(frozen=True, slots=True)
class CorrectionPart:
    """A part of a correction, in words, and the parameters that it follows."""

    words: str
    names: tuple[str, ...]


TABLE = CorrectionPart(
    "the bias table", ("bias_nm", "height_nm", "index", "sidewall_deg")
)
MAP = CorrectionPart(
    "what varies over the lens",
    ("bias_x_nm", "bias_y_nm", "bias_r_nm", "bias_a_nm", "bias_o_nm"),
)


@dataclass(frozen=True, eq=False, slots=True)
class CorrectionSpread:
    """How the posterior spreads a correction.

    table_nm: (draws, knots) that of every draw. sigma_nm: (knots,) its standard
    deviation. words: why it is
    refused, and what to capture or measure; empty where it may be used.
    """

    table_nm: Array
    sigma_nm: Array
    words: str

    @property
    def usable(self) -> bool:
        """Whether the posterior is narrow enough."""
        return not self.words


def judge_correction(
    result: AsBuilt,
    table: Callable[[Array], Array],
    *,
    part: CorrectionPart = TABLE,
    wide_nm: float = WIDE_NM,
    seed: int = 5,
) -> CorrectionSpread:
    """What every draw of the posterior would ask for, and whether they agree.

    Args:
        table: (knots,) of the bias table, or of what is taken off at some places of the
            lens, nm, of all parameters of
            one lens. part: which of them.
        result: of the fit. wide_nm: largest standard deviation of a usable correction.
        seed: of the random generator.
    """
    try:
        drawn = np.array(
            [table(result.parameters(row)) for row in result.samples(DRAWS, seed=seed)]
        )
    except ConfigError as refusal:
        return CorrectionSpread(
            np.empty((0, 0)),
            np.empty(0),
            f"no correction: for lenses of the posterior {refusal}",
        )
    sigma = drawn.std(axis=0, ddof=1)
    if sigma.max() <= wide_nm:
        return CorrectionSpread(drawn, sigma, "")
    ranges = [
        (name, *result.interval(name)) for name in part.names if name in result.names
    ]
    intervals = ", ".join(
        f"{name} {low:.3g} to {high:.3g}" for name, low, high in ranges
    )
    return CorrectionSpread(
        drawn,
        sigma,
        f"no correction: the posterior leaves {part.words} open by {sigma.max():.1f} nm (1 sigma, at most "
        f"{wide_nm:g} allowed; {intervals}). Settle it by {_settled(result, table, sigma, (part, wide_nm))}",
    )


def _settled(
    result: AsBuilt,
    table: Callable[[Array], Array],
    sigma: Array,
    wanted: tuple[CorrectionPart, float],
) -> str:
    """What would make the table narrow, the most telling first: causes to state, and
    frames where these say too little.

    By the table's slopes along every parameter that it follows; a cause moves all of
    them together, at most by the sum.
    """
    (part, wide_nm), best, place = (
        wanted,
        table(result.parameters()),
        int(np.argmax(sigma)),
    )
    slopes = np.zeros(len(result.names))
    for i, name in enumerate(result.names):
        if name in part.names:
            moved = result.value.copy()
            moved[i] += 0.1 * result.sigma[i]
            slopes[i] = (table(result.parameters(moved)) - best)[place] / (
                0.1 * result.sigma[i]
            )
    own = float(np.sqrt(slopes @ result.within_covariance @ slopes))
    by_cause = result.by_cause @ np.abs(slopes) if len(result.causes) else np.empty(0)
    worst = [
        k
        for k in np.argsort(-by_cause)
        if by_cause[k] > max(by_cause.max() / 4, 0.2 * wide_nm)
    ]
    ways = [way for k in worst for word, way in _SETTLED if word in result.causes[k]]
    more = (
        [_FRAMES]
        if own > 0.7 * wide_nm or not ways
        else ["the diameters themselves by micrographs (metalens measure)"]
    )
    return "; ".join([*dict.fromkeys(ways), *more])
