"""Sections of a mask's report on what the process does to the light: stitching,
tolerance.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from layout.mask.fields import FieldPlan
from layout.process.process import Process
from layout.study import stitching, tolerance
from layout.study.sensitivity import compute_sensitivities
from metalens.core.report import Section, Table
from metalens.core.units import deg
from metalens.fabrication import ResponseRates, pair_sensitivities
from metalens.lens import Lens

RatesByLight = Mapping[
    str, ResponseRates
]  # of light along "x" and "y"; of pillars of one size under ""


def rates_by_light(lens: Lens) -> RatesByLight:
    """Sensitivities of the pillars to height, wall, index and the like, by the solver.

    Args:
        lens: as designed.

    Raises:
        CellError, MaterialError: from the solver of the pillar.
    """
    return (
        {"": compute_sensitivities(lens)}
        if lens.pairs is None
        else pair_sensitivities(lens)
    )


def study_sections(
    lens: Lens, process: Process, plan: FieldPlan, rates: RatesByLight
) -> list[Section]:
    """Sections on stitching and tolerance.

    Pillars of two sizes have two sections for light along x and two for light along y.
    It takes half a minute for a 1 mm lens, most of it for the solver and the Monte
    Carlo.

    Args:
        lens: as designed.
        process: spread and write field.
        plan: write fields.
        rates: :func:`rates_by_light` of the lens.
    """
    if lens.pairs is None:
        return _of_light(lens, process, plan, rates[""])
    return [
        replace(section, title=f"{section.title}, light along {light}")
        for light, answer in rates.items()
        for section in _of_light(
            lens.for_polarization("x" if light == "x" else "y"), process, plan, answer
        )
    ]


def _of_light(
    lens: Lens, process: Process, plan: FieldPlan, rates: ResponseRates
) -> list[Section]:
    """Sections on stitching and tolerance for one polarisation."""
    return [_stitching(lens, plan, process), tolerance_section(lens, process, rates)]


def _stitching(lens: Lens, plan: FieldPlan, process: Process) -> Section:
    """Section on the effect of misplaced write fields."""
    study = stitching.simulate_stitching(lens, plan, process)
    rows = [
        ["peak of the PSF", float(study.strehl.mean()), float(study.strehl.min())],
        [
            "change of the PSF, relative L2",
            float(study.change.mean()),
            float(study.change.max()),
        ],
    ]
    text = (
        f"Each of {study.fields} fields misplaced by up to ±{study.stitching_nm:g} nm along x and y, evenly spread, "
        f"{len(study.strehl)} draws; the common shift, which only moves the image, is taken out."
    )
    return Section("Stitching", text, [Table(("", "mean", "worst"), rows, digits=5)])


def tolerance_section(lens: Lens, process: Process, rates: ResponseRates) -> Section:
    """Each cause alone and all together, and what the numbers are not of.

    Args:
        lens: as designed.
        process: spread.
        rates: sensitivities of the pillars.
    """
    study = tolerance.analyse_tolerance(lens, process, sens=rates)
    rows = [
        [
            effect.cause,
            effect.deviation,
            effect.phase_rad,
            *(
                100 * value
                for value in (
                    effect.strehl,
                    effect.efficiency,
                    effect.psf,
                    effect.information,
                )
            ),
        ]
        for effect in study.effects
    ]
    head = (
        "cause",
        "deviation",
        "phase / rad",
        "peak / %",
        "efficiency / %",
        "PSF / %",
        "I(z) / %",
    )
    draws, nominal = study.draws, study.nominal
    bands = [
        [name, *np.percentile(values, (5, 50, 95)).tolist(), float(designed[0])]
        for name, values, designed in (
            ("peak", draws.strehl, nominal.strehl),
            ("efficiency", draws.efficiency, nominal.efficiency),
            ("change of the PSF", draws.psf_change, nominal.psf_change),
            *(
                (f"I(z) at {depth_um / 1e3:.4g} mm / µm⁻²", values, designed)
                for depth_um, values, designed in zip(
                    study.depths_um,
                    draws.information.T,
                    nominal.information.T,
                    strict=True,
                )
            ),
        )
    ]
    route = (
        "the diameter through the proxy"
        if lens.pairs is None
        else "both sizes through the table of the library"
    )
    text = (
        "Each cause alone, the worse of both signs of its standard deviation; phase: rms over the pillars about their "
        f"mean. Then all together, {len(study.draws.strehl)} draws. Height, wall and index enter through "
        f"derivatives of the solver (known to {100 * rates.error:.0f} %), {route}; the "
        f"reduced model of {study.rank} dimensions misses {100 * study.error:.1g} % of t."
    ) + _limits_text(lens, process)
    about = (
        "Effect of each cause. I(z): axial information (Eq. 11), summed over depths."
    )
    quantiles = ("", "5 %", "50 %", "95 %", "as designed")
    tables = [Table(head, rows, about, digits=3), Table(quantiles, bands, digits=4)]
    return Section("Tolerance", text, tables)


def _limits_text(lens: Lens, process: Process) -> str:
    """Text on what the tolerances leave out.

    That is light that keeps its handedness, and sidewalls of the process that differ
    from those of the cell by more than the spread.
    """
    text = ""
    wall = lens.cell.sidewall_rad / deg
    etched = process.etch.sidewall_deg
    if lens.hand:
        text += (
            " All of it for the light that changes hand: what keeps its hand has no focus, and lies under the image "
            "as a haze of no more than what the converted light lacks."
        )
    if abs(etched - wall) > process.spread.sidewall_deg:
        text += (
            f" The pillars are studied with the walls of their cell, {wall:.3g} deg from upright; the process makes "
            f"{etched:.3g} deg, which is beyond its spread: sweep and design with sidewall_rad = {etched * deg:.3g} "
            "in [cell]."
        )
    return text
