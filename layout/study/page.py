"""Sections of a mask's report on what the process does to the light: stitching,
tolerance.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from layout.mask.fields import FieldPlan
from layout.process.process import Process
from layout.study import stitching, tolerance
from layout.study.sensitivity import LogSensitivities, compute_sensitivities
from layout.study.stitching import StitchReport
from layout.study.tolerance import ToleranceReport
from metalens.core import report
from metalens.core.arrays import Array
from metalens.core.report import Figure, Section, Table
from metalens.core.units import deg
from metalens.fabrication import PairSensitivities, pair_sensitivities
from metalens.lens import Lens

Answers = Mapping[
    str, LogSensitivities | PairSensitivities
]  # of light along "x" and "y"; of pillars of one size under ""


def answers_of(lens: Lens) -> Answers:
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
    lens: Lens, process: Process, plan: FieldPlan, answers: Answers
) -> list[Section]:
    """Sections on stitching and tolerance.

    Pillars of two sizes have two sections for light along x and two for light along y.
    It takes half a minute for a 1 mm lens, most of it for the solver and the Monte
    Carlo.

    Args:
        lens: as designed.
        process: spread and write field.
        plan: write fields.
        answers: :func:`answers_of` the lens.
    """
    if lens.pairs is None:
        return _of_light(lens, process, plan, answers[""])
    return [
        replace(section, title=f"{section.title}, light along {light}")
        for light, answer in answers.items()
        for section in _of_light(
            lens.seen("x" if light == "x" else "y"), process, plan, answer
        )
    ]


def _of_light(
    lens: Lens,
    process: Process,
    plan: FieldPlan,
    answers: LogSensitivities | PairSensitivities,
) -> list[Section]:
    """Sections on stitching and tolerance for one polarisation."""
    return [_stitching(lens, plan, process), tolerance_section(lens, process, answers)]


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
        [
            "move of its centroid / nm",
            float(study.moved_nm.mean()),
            float(study.moved_nm.max()),
        ],
    ]
    text = (
        f"Each of {study.fields} fields misplaced by up to ±{study.stitching_nm:g} nm along x and y, evenly spread, "
        f"{len(study.strehl)} draws; the common shift, which only moves the image, is taken out."
    )
    items: list[Figure | Table] = [
        Figure(
            _stitched(study),
            "The focus, and what the worst draw changes in it.",
            wide=True,
        ),
        Table(("", "mean", "worst"), rows, digits=5),
    ]
    return Section("Stitching", text, items)


def _stitched(study: StitchReport) -> bytes:
    """PNG of the focus in dB, and of its change in the worst draw."""
    from scipy.signal import resample

    perfect, worst = (
        resample(
            resample(image, 6 * image.shape[0], axis=0), 6 * image.shape[1], axis=1
        )
        for image in (study.psf, study.worst_psf)
    )
    figure, axes = report.make_figure(1, 2, size=(7.8, 3.2))
    edge = float(study.window.x_um[-1])
    extent = (-edge, edge, edge, -edge)
    level = 10 * np.log10(np.maximum(perfect / perfect.max(), 1e-5))
    change = 100 * (worst - perfect) / perfect.max()
    largest = float(abs(change).max())
    pictures = [
        axes[0].imshow(level, extent=extent, vmin=-40, vmax=0),
        axes[1].imshow(
            change, extent=extent, vmin=-largest, vmax=largest, cmap="RdBu_r"
        ),
    ]
    for ax, picture, title, unit in zip(
        axes, pictures, ("perfect fields", "change"), ("dB", "% of peak"), strict=True
    ):
        ax.set(title=title, xlabel="x / µm", ylabel="y / µm")
        ax.grid(visible=False)
        figure.colorbar(picture, ax=ax, label=unit)
    return report.figure_png(figure)


def tolerance_section(
    lens: Lens, process: Process, answers: LogSensitivities | PairSensitivities
) -> Section:
    """Each cause alone and all together, and what the numbers are not of.

    Args:
        lens: as designed.
        process: spread.
        answers: sensitivities of the pillars.
    """
    study = tolerance.analyse_tolerance(lens, process, sens=answers)
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
    bands = [
        [
            name,
            *(float(value) for value in study.band(name)),
            float(getattr(study.nominal, name)[0]),
        ]
        for name in ("strehl", "efficiency", "psf_change")
    ]
    route = (
        "the diameter through the proxy"
        if lens.pairs is None
        else "both sizes through the table of the library"
    )
    text = (
        "Each cause alone, the worse of both signs of its standard deviation; phase: rms over the pillars about their "
        f"mean. Then all together, {len(study.draws.strehl)} draws. Height, wall and index enter through "
        f"derivatives of the solver (known to {100 * answers.error:.0f} %), {route}; the "
        f"reduced model of {study.rank} dimensions misses {100 * study.error:.1g} % of t."
    ) + _beside(lens, process)
    items: list[Figure | Table] = [
        Table(
            head,
            rows,
            "Effect of each cause. I(z): axial information (Eq. 11), summed over the depths.",
            digits=3,
        ),
        Figure(
            _bands(study),
            "5 to 95 % of the draws (shade, bars), median, and the designed lens (dashes).",
            wide=True,
        ),
        Table(("", "5 %", "50 %", "95 %", "as designed"), bands),
    ]
    return Section("Tolerance", text, items)


def _beside(lens: Lens, process: Process) -> str:
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


def _bands(study: ToleranceReport) -> bytes:
    """PNG of the bands of the PSF along x and of the information over depth."""
    from scipy.signal import resample

    figure, axes = report.make_figure(1, 2, size=(7.8, 3.0))
    x = study.window.x_um
    fine = np.arange(8 * len(x)) * (x[1] - x[0]) / 8 + x[0]
    low, middle, high = (
        _finer(curve, resample(curve, len(fine))) for curve in study.band("psf")
    )
    axes[0].fill_between(fine, low, high, alpha=0.3)
    axes[0].plot(fine, middle)
    axes[0].plot(fine, resample(study.nominal.psf[0], len(fine)), "k--", lw=0.8)
    reach = 8 * float(x[1] - x[0])
    axes[0].set(
        xlabel="x / µm", ylabel="intensity / designed peak", xlim=(-reach, reach)
    )
    low, middle, high = study.band("information")
    depth = study.depths_um / 1e3
    axes[1].errorbar(depth, middle, [middle - low, high - middle], fmt="o", capsize=4)
    axes[1].plot(depth, study.nominal.information[0], "k_", ms=14)
    axes[1].set(xlabel="depth / mm", ylabel="I(z) / µm⁻²", yscale="log")
    return report.figure_png(figure)


def _finer(samples: Array, interpolated: Array) -> Array:
    """Intensity between samples; interpolation may dip below zero by its ripple."""
    return np.asarray(np.clip(interpolated, 0, 1.05 * samples.max()))
