"""The page of a retraining: what the made lens cost, what training on bought back, what
the next mask should draw.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from characterize.next_mask import NextMask, table_rows
from codesign.adapt.train import RetrainingOutcome
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

    psf_errors: of the fitted lens and of the judging lens, relative to the nominal one.
    drawn: lenses of the posterior that training saw. known: whether the truth judges.
    mask: correction of the next mask. cautions: in words.
    """

    outcome: RetrainingOutcome
    psf_errors: tuple[float, float]
    drawn: int
    known: bool
    mask: NextMask
    cautions: Sequence[str] = ()


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
        if story.known
        else "lenses of the posterior not seen before"
    )
    lead = f"A network trained on for the lens that was really made; judged on {judge}, on eyes it never saw."
    text = (
        "Mean absolute error of the slippage over its three axes. Intervals are over frames. The nominal network was "
        "trained on for as many steps as the others, so that no case is credited with more training. The finer image "
        "is formed at a quarter of the run's tolerance: a ratio near 1 says that results do not depend on it.\n\nPSFs of "
        f"the fitted lens differ from the nominal ones by {story.psf_errors[0]:.1%} (relative L2 over all depths), those "
        f"of the lens that judges by {story.psf_errors[1]:.1%}. Training drew {story.drawn} lenses from the posterior."
    )
    bars = Figure(plot_error_bars(outcome), "Slippage error, with its 95 % interval.")
    sections = [
        Section("Accuracy", text, [bars, accuracy_table(outcome)]),
        _mask_section(story.mask),
    ]
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
