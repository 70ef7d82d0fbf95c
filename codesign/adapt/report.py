"""The page of a retraining: accuracy before and after it, and the next mask."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from characterize.next_mask import NextMask, table_rows
from codesign.adapt.train import LensPsfs, RetrainingOutcome
from metalens.core import report
from metalens.core.report import Figure, Section, Table

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

    psfs: of the lenses that trained and judged. mask: correction of the next mask.
    cautions: in words.
    """

    outcome: RetrainingOutcome
    psfs: LensPsfs
    mask: NextMask
    cautions: Sequence[str] = ()


def write_retraining_page(path: Path, story: RetrainingResults) -> None:
    """Write report.html.

    Args:
        path: of the file. story: everything that the page shows.
    """
    outcome, psfs = story.outcome, story.psfs
    judge = (
        "the true lens of the virtual bench"
        if psfs.known
        else "other lenses of the posterior"
    )
    lead = f"A network trained on for the lens that was really made; judged on {judge}, on eyes it never saw."
    text = (
        "Mean absolute error of the slippage over its three axes. Intervals are over frames. The nominal network was "
        "trained on for as many steps as the others, so that no case is credited with more training. The finer image "
        "is formed at a quarter of the run's tolerance: a ratio near 1 says that results do not depend on it.\n\nPSFs of "
        f"the fitted lens differ from the nominal ones by {psfs.errors['fitted']:.1%} "
        "(relative L2 over all depths), those "
        f"of the lens that judges by {psfs.errors['judge']:.1%}. Training drew "
        f"{len(psfs.drawn)} lenses from the posterior; "
        f"{gap_text(outcome)}."
    )
    bars = Figure(plot_error_bars(outcome), "Slippage error, with its 95 % interval.")
    sections = [
        Section("Accuracy", text, [bars, accuracy_table(outcome)]),
        _mask_section(story.mask),
    ]
    if story.cautions:
        sections.append(Section("Read with care", "\n\n".join(story.cautions)))
    report.write_report(path, "Retrained on the lens as built", sections, lead=lead)


def gap_text(outcome: RetrainingOutcome) -> str:
    """The gap that the made lens opens, with its standard error, and the share of it
    that retraining wins back.

    Args:
        outcome: accuracy of all cases.
    """
    recovered = outcome.recovered
    won = (
        "nothing to win back beyond chance"
        if recovered is None
        else f"{recovered:.0%} won back"
    )
    return f"gap {outcome.gap_mm:.3f} +- {outcome.gap_sigma_mm:.3f} mm, {won}"


def accuracy_table(outcome: RetrainingOutcome) -> Table:
    """Table of slippage errors with intervals, and mask IoU, a row a case.

    Args:
        outcome: accuracy of all cases.
    """
    columns = {
        "slippage error / mm": "slip_mm",
        "from": "slip_low_mm",
        "to (95 %)": "slip_high_mm",
        "on a finer image / mm": "finer_slip_mm",
        "ratio": "finer_ratio",
        "axial / mm": "axial_mm",
        "lateral / mm": "lateral_mm",
        "pupil IoU": "iou",
    }
    rows = [
        [CASES[name], *(values.get(key, "–") for key in columns.values())]
        for name, values in outcome.rows().items()
    ]
    return Table(["case", *columns], rows, digits=3)


def plot_error_bars(outcome: RetrainingOutcome) -> bytes:
    """PNG of a bar chart: slippage error of every case with its 95 % interval.

    Args:
        outcome: accuracy of all cases.
    """
    rows = outcome.rows()
    figure, axes = report.make_figure(size=(6.4, 2.6))
    middle, low, high = (
        np.array([values[f"slip_{end}mm"] for values in rows.values()])
        for end in ("", "low_", "high_")
    )
    names = [CASES[name] for name in rows]
    axes.barh(names, middle, xerr=[middle - low, high - middle], ecolor="#444")
    axes.invert_yaxis()
    axes.set(xlabel="slippage error / mm")
    axes.grid(axis="y", visible=False)
    return report.figure_png(figure)


def _mask_section(mask: NextMask) -> Section:
    """Gain of each step of the next mask, and its bias table; or why there is none."""
    gain = Table(
        ("next lens", "Strehl ratio", "light"),
        [(step.name, step.strehl, step.light) for step in mask.steps],
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
        table_rows(mask.plan),
        "Written to no file: see above." if mask.refused else note,
    )
    text = (
        "The new bias table takes off the mean bias of the fit, and gives every pillar the diameter at which the "
        "process as it is (height, index, sidewall) makes the designed phase. lens_corrected.h5 also takes off what "
        "varies over the lens; draw it with the new table. The spacer is no matter of the mask: the last row sets it "
        "right as well."
    )
    if mask.uneven and not mask.refused:
        text += f"\n\nNo lens_corrected.h5 is written: {mask.uneven}."
    if mask.refused:
        text = f"{mask.refused[0].upper()}{mask.refused[1:]}.\n\nWhat it would be, by the best fit alone: {text}"
    return Section("The next mask", text, [gain, table])
