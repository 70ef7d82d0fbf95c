"""Cell study: which pitch and height cover a full turn of phase smoothly, as JSON
and a figure.

Cells that are solved are kept beside the output (NAME.resume): after an interruption
the same command goes on.
"""

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from metalens.cli import load_above
from metalens.commands.common import DistributedOptions, Output
from metalens.core import config
from metalens.core.units import nm
from metalens.library import CellStudy, SweepJournal, plots
from metalens.library import study as cell_study


@dataclass(frozen=True)
class Options(DistributedOptions):
    """Options of ``metalens study``.

    Attributes:
        config: STUDY.toml with pitches, heights, wavelengths, material or cell, and
            limits; the project's own without.
        process: PROCESS.toml whose printable pillars and gaps, the strictest of all
            pitches and heights, take the place
            of min_diameter_um and min_gap_um (worked out for round pillars).
        output: folder for cell_study.json and cell_study.png; NAME.resume beside it
            keeps solved cells until it is complete.
    """

    config: tyro.conf.Positional[Path | None] = None
    process: Path | None = None
    output: Output = Path("cell_study")


def run(options: Options) -> int:
    """Compare the cells; exit 1 where none covers a full turn at all wavelengths.

    Args:
        options: of the command line.
    """
    study = CellStudy()
    if options.config is not None:
        study = config.load(options.config, CellStudy, empty=False)
    if options.process is not None:
        study = _printable(options.process, study)
    with options.claim_folder(options.output) as draft, options.shared():
        journal = SweepJournal(
            options.output.with_name(options.output.name + ".resume"), study
        )
        verdicts = cell_study.run_study(study, options.console, journal=journal)
        plots.write_study(draft.path, study, verdicts)
    journal.finish()
    best = cell_study.best_cell(verdicts)
    return options.console.report(
        f"{options.output}: the lowest cell with a full turn everywhere",
        {
            "pitch_um": best and best[0],
            "height_um": best and best[1],
            "cells": len(verdicts),
        },
        failures=[] if best else ["no cell covers a full turn at all wavelengths"],
    )


def _printable(path: Path, study: CellStudy) -> CellStudy:
    """The study with the limits of a process file, through a package above this one
    that the command line names.
    """
    module = load_above("process")
    shapes = itertools.product(study.pitches_um, study.heights_um)
    limits = [
        module.printable_limits(path, pitch_um=pitch, height_um=height)
        for pitch, height in shapes
    ]
    thinnest, gap = (max(values) for values in zip(*limits, strict=True))
    return replace(study, min_diameter_um=thinnest * nm, min_gap_um=gap * nm)
