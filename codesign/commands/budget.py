"""lens.h5 -> error budget: every link of the chain as phase, PSF and gaze error, each
and how it was determined.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from characterize.inference import AsBuilt
from codesign.adapt import source as finished
from codesign.commands.options.budget import Options
from codesign.evaluate.error_budget import (
    MEASURED,
    TOTAL,
    BudgetEntry,
    BudgetInputs,
    ErrorBudget,
)
from metalens import lens, library
from metalens.core import report, store
from metalens.core.errors import ConfigError
from metalens.core.store import typed_reader
from metalens.fabrication import of_process
from metalens.psf import Source, spectrum


def run(options: Options) -> int:
    """Compute, write, report; exit 1 where the error of the device's image is above its
    tolerance.

    Args:
        options: of the command line.
    """
    target = options.output
    if target.suffix != ".h5":
        raise ConfigError(f"{target}: need a name that ends in .h5")
    made = lens.load_plain(options.lens)
    inputs = _budget_inputs(options)
    if inputs.fwhm_nm:
        # an impossible spectrum is refused before the work
        spectrum.spectrum_points(Source(made.wavelength_um * 1e3, inputs.fwhm_nm))
    with options.claim(target, companions=(".html", ".png")) as draft:
        weights = options.run / "checkpoint.safetensors" if options.run else None
        files = [
            options.lens,
            options.library,
            options.process,
            options.asbuilt,
            weights,
        ]
        origin = store.Provenance(
            config=f"fwhm_nm = {inputs.fwhm_nm}\n",
            inputs={file.name: store.sha256(file) for file in files if file},
        )
        budget = ErrorBudget(made, inputs)
        links = options.console.track(budget.entries(), total=19, label="links")
        rows = list(links)
        save_budget(draft.path, rows, origin)
        write_budget_page(draft.path.with_suffix(".html"), rows)
        store.write_bytes(draft.path.with_suffix(".png"), plot_budget(rows))
    values: dict[str, Any] = {"rows": [dataclasses.asdict(row) for row in rows]}
    total = rows[-1]
    values |= {
        "gaze_error_deg": math.degrees(total.gaze_rad), "psf_error": total.psf, "light": "",
    }  # fmt: skip
    for row in rows:
        if row.link == MEASURED:
            values["measured_deg"] = math.degrees(row.gaze_rad)
            values["closure"] = total.gaze_rad / row.gaze_rad
    words = budget_table(rows).text
    if made.one_light:  # pillars of one size that treat x and y differently
        values["light"] = f"for {made.one_light} alone: {made.cell.described}"
        words += f"\n{values['light']}"
    return options.console.judged(values, words, budget.above)


def save_budget(
    path: Path, rows: list[BudgetEntry], provenance: store.Provenance
) -> None:
    """Write a budget file (kind ``budget``).

    Args:
        path: of the file. rows: of the budget. provenance: of the file.
    """
    arrays = {
        name: np.array([getattr(row, name) for row in rows])
        for name in BudgetEntry.__slots__
    }
    arrays["counted"] = arrays["counted"].astype(np.uint8)
    store.save(path, "budget", arrays, provenance=provenance)


@typed_reader
def load_budget(path: Path) -> list[BudgetEntry]:
    """Read a budget file.

    Args:
        path: of the file.

    Raises:
        StoreError: not a budget file.
    """
    arrays = store.load(path, "budget").arrays
    columns = {name: arrays[name].tolist() for name in BudgetEntry.__slots__}
    for name in ("link", "method"):
        columns[name] = [
            word.decode() if isinstance(word, bytes) else word for word in columns[name]
        ]
    columns["counted"] = [bool(value) for value in columns["counted"]]
    return [BudgetEntry(*row) for row in zip(*columns.values(), strict=True)]


def write_budget_page(path: Path, rows: list[BudgetEntry]) -> None:
    """One page: chart, table, how each number was determined.

    Args:
        path: to write. rows: of the budget.
    """
    words = (
        "From the true pupil to the predicted gaze one cause more at a time, from there to the pillars each changed "
        "alone in the device's image. What a network was trained with is shown switched off and is not in the sum. "
        "Without a run nothing reads gaze."
    )
    picture = report.Figure(
        plot_budget(rows), "Error of each link, log scale.", wide=True
    )
    section = report.Section("Error budget", words, (picture, budget_table(rows)))
    report.write_report(path, "Error budget", [section])


def budget_table(rows: list[BudgetEntry]) -> report.Table:
    """A row a link, for page and terminal.

    Args:
        rows: of the budget.
    """
    head = ("link", "phase / rad", "PSF, relative", "gaze / deg", "method")
    caption = "Mean angles over eyes; the sum is the root of their squares."
    cells = []
    for row in rows:
        values = row.phase_rad, row.psf, math.degrees(row.gaze_rad)
        shown = ("–" if math.isnan(value) else f"{value:.2g}" for value in values)
        cells.append((row.link, *shown, row.method))
    return report.Table(head, cells, caption)


def plot_budget(rows: list[BudgetEntry]) -> bytes:
    """PNG bar chart of the gaze error of every link, the largest on top.

    Without a run of the PSF error.

    Args:
        rows: of the budget.
    """
    gaze = any(row.gaze_rad > 0 for row in rows)

    def value(row: BudgetEntry) -> float:
        return math.degrees(row.gaze_rad) if gaze else row.psf

    shown = [r for r in rows if value(r) > 0 and (r.counted or r.link == MEASURED)]
    shown.sort(key=value)
    figure, axes = report.make_figure(size=(7.5, 0.7 + 0.32 * len(shown)))
    colours = ["#444" if r.link in (MEASURED, TOTAL) else "#1f6feb" for r in shown]
    axes.barh([r.link for r in shown], [value(r) for r in shown], color=colours)
    label = "gaze error / deg" if gaze else "relative L2 error of the PSFs"
    axes.set(xscale="log", xlabel=label)
    axes.grid(axis="y", visible=False)
    return report.figure_png(figure)


def _budget_inputs(options: Options) -> BudgetInputs:
    """Inputs of the budget from the files of the command line."""
    if options.led_fwhm_nm < 0:
        raise ConfigError(f"--led-fwhm-nm {options.led_fwhm_nm:g}: need 0 or more")
    return BudgetInputs(
        fwhm_nm=options.led_fwhm_nm,
        mask=of_process(options.process) if options.process else None,
        library=library.load(options.library) if options.library else None,
        asbuilt=AsBuilt.load(options.asbuilt) if options.asbuilt else None,
        run=finished.load_finished_run(options.run) if options.run else None,
        frames=options.frames,
    )
