"""LENS... to Tables 1 and 3 and Figs. 5 and 7 of the paper: information about
depth, and about whole scenes.
"""
# ruff: noqa: RUF009  (records of settings are frozen)

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from codesign.commands.evaluate import distinct_names
from codesign.commands.options.optics import Options
from codesign.evaluate import (
    MeasurementSettings,
    ReaderConfig,
    SensitivityScenes,
    judge_lenses,
    reader,
)
from codesign.evaluate import optics as evaluate_optics
from codesign.eye import states_at
from metalens import design
from metalens import lens as lenses
from metalens.core import config, store
from metalens.core.errors import ConfigError, PropagationError
from metalens.core.report import Figure, Section, write_report
from metalens.lens import Lens

SPREAD = "brings no light together in one bright spot of the sensor: its beams are shown by psf --far-field"


@dataclass(frozen=True, slots=True)
class OpticsSettings:
    """The content of OPTICS.toml; every key may be left out.

    axial: how the axial information is measured. scenes: what the scene
    table is made of. reader: what the reference reader sees, with ``--reader``.
    """

    axial: MeasurementSettings = MeasurementSettings()
    scenes: SensitivityScenes = SensitivityScenes()
    reader: ReaderConfig = ReaderConfig()


def run(options: Options) -> int:
    """Measure, print, draw, write; exit 1 where an error of PSFs or images is above
    what is aimed at.

    Args:
        options: of the command line.
    """
    if not options.lenses:
        raise ConfigError("no lens to evaluate; give at least one lens file")
    settings = OpticsSettings()
    if options.config is not None:
        settings = config.load(options.config, OpticsSettings, empty=False)
    if options.scenes is not None:
        settings = dataclasses.replace(
            settings, scenes=dataclasses.replace(settings.scenes, count=options.scenes)
        )
    compared = {
        name: lenses.load_plain(path)
        for name, path in zip(
            distinct_names([path.stem for path in options.lenses]),
            options.lenses,
            strict=True,
        )
    }
    folder = options.output
    with options.claim_folder(folder) as draft:
        values, text = _measure(options, settings, compared, draft.path)
    words = f"{text}\n\n{folder}: tables.txt, optics.json, two pictures, report.html"
    return options.console.judged(values, words, values["failures"])


def _measure(
    options: Options, settings: OpticsSettings, compared: dict[str, Lens], folder: Path
) -> tuple[dict[str, Any], str]:
    """Axial information and scene energies of all lenses; the numbers, and tables.

    Writes tables, numbers, pictures and page into the folder.
    """
    console, first = options.console, next(iter(compared.values()))
    setting = settings.axial.about(first)
    states = states_at(torch.arange(settings.scenes.count), settings.scenes.seed)
    axial, remarks = {}, {}
    for name, lens in console.track(
        compared.items(), total=len(compared), label="PSFs"
    ):
        axial[name] = evaluate_optics.measure_axial_information(lens, setting)
        if not design.lens_has_focus(lens):
            remarks[name] = f"{name} {SPREAD}"
    try:
        energies = evaluate_optics.scene_energies(
            list(compared.values()), states, settings.scenes
        )
    except PropagationError as error:
        raise ConfigError("; ".join([str(error), *remarks.values()])) from error
    scenes = dict(zip(compared, energies, strict=True))
    tables = [
        evaluate_optics.axial_table(axial, setting, list(remarks.values())),
        evaluate_optics.scene_table(scenes),
    ]
    values = evaluate_optics.table_values(axial, scenes, setting)
    values["failures"] = evaluate_optics.table_failures(axial, scenes, setting)
    for name in compared:
        values["lenses"][name]["focuses"] = name not in remarks
    if options.reader:
        steps = judge_lenses(compared, settings.reader)
        judged = dict(console.track(steps, total=len(compared), label="reader"))
        about = dataclasses.asdict(settings.reader)
        values["reader"] = {"settings": about, "lenses": judged}
        tables.append(reader.reader_table(judged, settings.reader))
    text = "\n\n".join(table.text for table in tables)
    store.write_text(folder / "tables.txt", text + "\n")
    store.write_text(folder / "optics.json", json.dumps(values, indent=1) + "\n")
    pictures = {
        "axial": evaluate_optics.plot_axial_information(axial, setting),
        "scenes": evaluate_optics.plot_scenes(scenes),
    }
    for name, picture in pictures.items():
        store.write_bytes(folder / f"{name}.png", picture)
    figures = [
        Figure(png, evaluate_optics.CAPTIONS[name], wide=True)
        for name, png in pictures.items()
    ]
    sections = [Section("Pictures", items=figures), Section("Tables", items=tables)]
    write_report(folder / "report.html", "Comparison of lenses", sections)
    return values, text
