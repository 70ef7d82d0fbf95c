"""The page of a retraining: what the made lens cost, what training on bought back, what
the next mask should draw.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from characterize.next_mask import MaskCorrection, NextMask, PredictedLens, table_rows
from codesign.adapt.train import LensPsfs, RetrainingOutcome
from metalens.core import report
from metalens.core.report import Figure, KeyFigure, Section, Table

CASES = {
    "designed": "nominal lens, network as it came",
    "nominal": "nominal lens, trained on as long",
    "before": "made lens, before retraining",
    "after": "made lens, after retraining",
    "known": "made lens, truth known in training",
}


@dataclass(frozen=True, eq=False, slots=True)
class RetrainingResults:
    """Content of the page.

    apart: PSF errors of the fitted lens and of the judging lens, relative to the
    nominal one. curves: {job: (step, loss)}. proposals: states of the next lens with
    their PSF and slippage errors, mm. cautions: in words.
    """

    outcome: RetrainingOutcome
    lenses: LensPsfs
    apart: tuple[float, float]
    curves: dict[str, tuple[list[int], list[float]]]
    mask: NextMask
    proposals: Sequence[tuple[PredictedLens, float, float]]
    cautions: Sequence[str] = field(default_factory=tuple)


def write_retraining_page(path: Path, story: RetrainingResults) -> None:
    """Write report.html.

    Args:
        path: of the file. story: everything that the page shows.
    """
    outcome = story.outcome
    keys = [
        KeyFigure("slippage error, nominal lens", f"{outcome.nominal.slip_mm:.3f} mm"),
        KeyFigure("made lens, before", f"{outcome.before.slip_mm:.3f} mm"),
        KeyFigure("made lens, after", f"{outcome.after.slip_mm:.3f} mm"),
        KeyFigure(
            "share of the gap won back",
            _recovered_text(outcome),
            None if outcome.recovered is None else outcome.recovered >= 0.9,
        ),
    ]
    judge = (
        "the true lens of the virtual bench"
        if story.lenses.known
        else "lenses of the posterior not seen before"
    )
    lead = f"A network trained on for the lens that was really made; judged on {judge}, on eyes it never saw."
    sections = [_accuracy_section(story), _psf_section(story), _mask_section(story)]
    if story.cautions:
        sections.append(Section("Read with care", "\n\n".join(story.cautions)))
    report.write_report(
        path, "Retrained on the lens as built", sections, lead=lead, key_figures=keys
    )


def _recovered_text(o: RetrainingOutcome) -> str:
    return "no gap beyond chance" if o.recovered is None else f"{o.recovered:.0%}"


def accuracy_table(outcome: RetrainingOutcome) -> Table:
    """Table of slippage errors with intervals, and mask IoU, a row a case.

    Args:
        outcome: accuracy of all cases.
    """
    head = (
        "case",
        "slippage error / mm",
        "95 % interval",
        "on a finer image / mm",
        "ratio",
        "axial / mm",
        "lateral / mm",
        "pupil IoU",
    )
    rows: list[tuple[Any, ...]] = []
    for name, v in outcome.rows().items():
        interval = f"{v['slip_low_mm']:.3f} to {v['slip_high_mm']:.3f}"
        rows.append(
            (
                CASES[name],
                v["slip_mm"],
                interval,
                v.get("finer_slip_mm", "–"),
                v.get("finer_ratio", "–"),
                v["axial_mm"],
                v["lateral_mm"],
                v["iou"],
            )
        )
    return Table(head, rows, digits=3)


def _accuracy_section(story: RetrainingResults) -> Section:
    """Accuracy of all cases as bars and table, and training curves."""
    text = (
        "Mean absolute error of the slippage over its three axes. Intervals are over frames. The nominal network was "
        "trained on for as many steps as the others, so that no case is credited with more training. The finer image "
        "is formed at a quarter of the run's tolerance: a ratio near 1 says that results do not depend on it."
    )
    return Section(
        "Accuracy",
        text,
        [
            Figure(
                plot_error_bars(story.outcome),
                "Slippage error, with its 95 % interval.",
            ),
            accuracy_table(story.outcome),
            Figure(_loss_picture(story), "Loss while training on."),
        ],
    )


def plot_error_bars(outcome: RetrainingOutcome) -> bytes:
    """PNG of a bar chart: slippage error of every case with its 95 % interval.

    Args:
        outcome: accuracy of all cases.
    """
    rows = outcome.rows()
    figure, axes = report.make_figure(size=(6.4, 2.6))
    position = np.arange(len(rows))[::-1]
    values = [v["slip_mm"] for v in rows.values()]
    intervals = [
        [v["slip_mm"] - v["slip_low_mm"] for v in rows.values()],
        [v["slip_high_mm"] - v["slip_mm"] for v in rows.values()],
    ]
    colours = {"before": "#d1495b", "after": "#2a9d8f"}
    axes.barh(
        position,
        values,
        xerr=intervals,
        color=[colours.get(n, "#9db4d8") for n in rows],
        height=0.62,
        ecolor="#444",
    )
    axes.set_yticks(position, [CASES[n] for n in rows])
    axes.set(xlabel="slippage error / mm")
    axes.grid(axis="y", visible=False)
    return report.figure_png(figure)


def _loss_picture(story: RetrainingResults) -> bytes:
    """PNG of the task loss of every job over the step, moving average of a
    twentieth.
    """
    labels = {
        "nominal": "nominal lens",
        "retrained": "as built",
        "known": "truth known",
    }
    figure, axes = report.make_figure(size=(6.4, 2.4))
    for name, (step, loss) in story.curves.items():
        width = max(1, len(loss) // 20)
        smooth = np.convolve(loss, np.ones(width) / width, mode="valid")
        axes.plot(step[width - 1 :], smooth, label=labels[name])
    axes.set(xlabel="step", ylabel="task loss")
    axes.legend()
    return report.figure_png(figure)


def _psf_section(story: RetrainingResults) -> Section:
    """PSF differences of fitted and judging lens, and their pictures."""
    fitted, judged = story.apart
    text = (
        f"PSFs of the fitted lens differ from the nominal ones by {fitted:.1%} (relative L2 over all depths), those of "
        f"the lens that judges by {judged:.1%}. Training drew {len(story.lenses.drawn)} lenses from the posterior."
    )
    caption = "Square root of the PSFs on the samples of training, by depth: nominal, fitted, and the lens that judges."
    return Section("Light", text, [Figure(_psf_picture(story), caption, wide=True)])


def _psf_picture(story: RetrainingResults) -> bytes:
    """PNG of PSFs (square root) at seven depths: nominal, fitted and judging lens."""
    lenses = story.lenses
    rows = (
        ("nominal", lenses.nominal),
        ("as built", lenses.best),
        ("true" if lenses.known else "a draw", lenses.judges[0]),
    )
    depth_indices = np.unique(
        np.linspace(0, len(lenses.nominal.depths_um) - 1, 7).round().astype(int)
    )
    figure, axes = report.make_figure(
        len(rows),
        len(depth_indices),
        size=(1.15 * len(depth_indices), 3.6),
        squeeze=False,
    )
    for column, depth in enumerate(depth_indices):
        peak = max(float(s.intensity[depth].max()) for _, s in rows)
        for row, (label, stack) in enumerate(rows):
            axes[row, column].imshow(
                stack.intensity[depth].clamp_min(0).sqrt().numpy(),
                vmin=0,
                vmax=peak**0.5,
            )
            axes[row, column].set(xticks=[], yticks=[])
            axes[row, column].grid(visible=False)
            axes[row, 0].set_ylabel(label)
        axes[0, column].set_title(
            f"{float(lenses.nominal.depths_um[depth]) * 1e-3:.1f} mm"
        )
    return report.figure_png(figure)


def _mask_section(story: RetrainingResults) -> Section:
    """Gain of each step of the next mask, and its bias table; or why there is none."""
    gain_columns = (
        "next lens",
        "PSF error",
        "Strehl ratio",
        "light",
        "slippage error / mm, network not retrained",
    )
    rows = [
        (p.name, error, p.strehl, p.light, slip) for p, error, slip in story.proposals
    ]
    gain = Table(
        gain_columns,
        rows,
        "Simulated with the lens that judges as the truth; Strehl and light against the design.",
        digits=3,
    )
    columns = (
        "drawn / nm",
        "present bias / nm",
        "new bias / nm",
        "designed / nm",
        "aimed at / nm",
    )
    note = "bias.toml holds the new table for PROCESS.toml."
    table = Table(
        columns,
        table_rows(story.mask.plan),
        "Written to no file: see above." if story.mask.refused else note,
    )
    text = (
        "The new bias table takes off the mean bias of the fit, and gives every pillar the diameter at which the "
        "process as it is (height, index, sidewall) makes the designed phase. lens_corrected.h5 also takes off what "
        "varies over the lens; draw it with the new table. The spacer is no matter of the mask: the last row sets it "
        "right as well."
    )
    if story.mask.uneven and not story.mask.refused:
        text += f"\n\nNo lens_corrected.h5 is written: {story.mask.uneven}."
    if story.mask.refused:
        text = f"{story.mask.refused[0].upper()}{story.mask.refused[1:]}.\n\nWhat it would be, by the best fit alone: {text}"
    return Section(
        "The next mask",
        text,
        [
            gain,
            Figure(_bias_picture(story.mask.plan), "Bias: made less drawn diameter."),
            table,
        ],
    )


def _bias_picture(plan: MaskCorrection) -> bytes:
    """PNG of present and new bias over drawn diameter."""
    figure, axes = report.make_figure(size=(5.2, 2.6))
    axes.plot(plan.drawn_nm, plan.old_nm, "--", color="#888", label="present table")
    axes.plot(plan.drawn_nm, plan.bias_nm, "o-", label="new table")
    axes.set(xlabel="drawn diameter / nm", ylabel="bias / nm")
    axes.legend()
    return report.figure_png(figure)
