"""The error budget as a page and a chart."""

import math
from pathlib import Path

from codesign.budget.entry import MEASURED, TOTAL, BudgetEntry
from metalens.core import report


def write_budget_page(path: Path, rows: list[BudgetEntry]) -> None:
    """One page: chart, table, how each number was found."""
    keys = [
        report.KeyFigure(
            "gaze error of all links", f"{math.degrees(rows[-1].gaze_rad):.2g}°"
        ),
        report.KeyFigure(
            "largest", max(counted_entries(rows[:-1]), key=lambda r: r.gaze_rad).link
        ),
    ]
    for row in rows:
        if row.link == MEASURED:
            keys.insert(
                1,
                report.KeyFigure(
                    "measured on the same frames", f"{math.degrees(row.gaze_rad):.2g}°"
                ),
            )
    lead = "What each link of the chain costs, carried through pillars, PSFs and images of eyes to the gaze that is read."
    report.write_report(
        path, "Error budget", [budget_section(rows)], lead=lead, key_figures=keys
    )


def counted_entries(rows: list[BudgetEntry]) -> list[BudgetEntry]:
    """Those that the sum holds and that are known."""
    return [r for r in rows if r.counted and not math.isnan(r.gaze_rad)]


def budget_section(rows: list[BudgetEntry]) -> report.Section:
    """Chart and table for any page."""
    cells = [
        (
            r.link,
            *(
                "–" if math.isnan(v) else f"{v:.2g}"
                for v in (r.phase_rad, r.psf, math.degrees(r.gaze_rad))
            ),
            r.method,
        )
        for r in rows
    ]
    head = ("link", "phase / rad", "PSF, relative", "gaze / deg", "how it was found")
    words = (
        "From the true pupil to the answer one cause more at a time, from there to the pillars each changed alone in "
        "the true image. The method of a row says who read the gaze: the run's network, or the linear estimator of "
        "least variance that knows the lens and the population but not the subject. What a reader was trained with is "
        "shown switched off and is not in the sum."
    )
    picture = report.Figure(
        plot_budget(rows), "Gaze error of each link, log scale.", wide=True
    )
    return report.Section(
        "Error budget",
        words,
        (
            picture,
            report.Table(
                head,
                cells,
                "Mean angles over eyes; the sum is the root of their squares.",
            ),
        ),
    )


def plot_budget(rows: list[BudgetEntry]) -> bytes:
    """Bars of the gaze error, the largest on top."""
    shown = sorted(
        (r for r in rows if r.gaze_rad > 0 and (r.counted or r.link == MEASURED)),
        key=lambda r: r.gaze_rad,
    )
    figure, axes = report.make_figure(size=(7.5, 0.5 + 0.32 * len(shown)))
    colours = ["#444" if r.link in (MEASURED, TOTAL) else "#1f6feb" for r in shown]
    axes.barh(
        [r.link for r in shown],
        [math.degrees(r.gaze_rad) for r in shown],
        color=colours,
    )
    axes.set(xscale="log", xlabel="gaze error / deg")
    axes.grid(axis="y", visible=False)
    return report.figure_png(figure)
