"""The error budget as a page and a chart."""

import math
from pathlib import Path

from codesign.budget.links import Entry
from metalens.ground import report


def write(path: Path, rows: list[Entry]) -> None:
    """One page: chart, table, how each number was found."""
    keys = [
        report.KeyFigure("gaze error of all links", f"{math.degrees(rows[-1].gaze_rad):.2g}°"),
        report.KeyFigure("largest", max(rows[:-1], key=lambda r: r.gaze_rad).link),
    ]
    lead = (
        "What each link of the chain costs, carried through pillars, PSFs and images of eyes to the gaze that is read."
    )
    report.write(path, "Error budget", [section(rows)], lead=lead, key_figures=keys)


def section(rows: list[Entry]) -> report.Section:
    """Chart and table for any page."""
    cells = [
        (
            r.link,
            *("–" if math.isnan(v) else f"{v:.2g}" for v in (r.phase_rad, r.psf, math.degrees(r.gaze_rad))),
            r.method,
        )
        for r in rows
    ]
    head = ("link", "phase / rad", "PSF, relative", "gaze / deg", "how it was found")
    words = (
        "Each link is changed alone. Gaze is read by the linear estimator of least variance that knows the lens and "
        "the population but not the subject: a network has its own, larger, error and reacts in its own way."
    )
    picture = report.Figure(chart(rows), "Gaze error of each link, log scale.", wide=True)
    return report.Section("Error budget", words, (picture, report.Table(head, cells, "Root mean squares over eyes.")))


def chart(rows: list[Entry]) -> bytes:
    """Bars of the gaze error, the largest on top."""
    shown = sorted((r for r in rows if r.gaze_rad > 0), key=lambda r: r.gaze_rad)
    figure, axes = report.canvas(size=(7.5, 0.5 + 0.32 * len(shown)))
    colours = ["#444" if r.link == rows[-1].link else "#1f6feb" for r in shown]
    axes.barh([r.link for r in shown], [math.degrees(r.gaze_rad) for r in shown], color=colours)
    axes.set(xscale="log", xlabel="gaze error / deg")
    axes.grid(axis="y", visible=False)
    return report.png(figure)
