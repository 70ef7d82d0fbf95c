"""``metalens layout ARRANGEMENT.toml``: every lens made and checked by itself, then all
put together in one mask.
"""

import csv
import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from layout.arrange import (
    Floorplan,
    Placement,
    WaferSettings,
    apart,
    job_file,
    joined,
    parts,
    wafer,
)
from layout.commands import arranged_page, make
from layout.commands import placed as standing
from layout.commands.check import read_mask
from layout.commands.job import Options
from layout.commands.placed import FloorplanWork
from layout.commands.stages import StageTimes
from layout.drc import write_lyp
from layout.formats import (
    MaskAssembly,
    compare,
    doses,
    gdsii_write,
    handover,
    oasis_write,
)
from layout.mask import build
from layout.process import LayerNumber, announce_compilation
from layout.process import process as processes
from metalens.core import config, store
from metalens.core.errors import ProcessError

_LISTED = 12  # gaps that are told one by one


def run(options: Options) -> int:
    """Make the mask; exit 1 where a rule is broken, a dose is missing or a file does
    not read back as planned.
    """
    record = config.load(options.lens, Floorplan)
    named = [part.file for part in record.lens] + [part.file for part in record.cell]
    process = (
        processes.Process()
        if options.process is None
        else processes.load_process(options.process)
    )
    if not options.dose:
        process = dataclasses.replace(
            process, exposure=dataclasses.replace(process.exposure, correct=False)
        )
    inputs = [options.lens.parent / file for file in named]
    with (
        options.claim_folder(options.output, inputs=inputs) as draft,
        options.shared(),
        announce_compilation(options.console.say),
    ):
        work = FloorplanWork(
            options, record, process, draft.path, StageTimes(options.console.say)
        )
        made = _whole(work)
        _write(work, made)
        with work.stages("report"):
            _accompany(work, made)
    return options.console.judged(_values(work, made), _text(work, made), work.failures)


def _refuse_negative(work: FloorplanWork) -> None:
    """Raises: ProcessError: gaps are drawn, and something stands on the die that the
    frame of a lens does not know.
    """
    record, size = work.record, work.record.wafer
    alone = all(record.furnished(part) for part in record.lens) and not record.cell
    alone &= record.die is None and not (size and size.marks)
    if work.process.tone == "negative" and not alone:
        raise ProcessError(
            "tone = 'negative' draws the die around each lens: need lenses that are furnished, "
            "and no [die], [[cell]] or wafer.marks"
        )


def _whole(work: FloorplanWork) -> MaskAssembly:
    """The die of the record, or its wafer."""
    record = work.record
    _refuse_negative(work)
    if record.wafer is not None:
        wafer.refuse_marks_off(record.wafer)
    placed, marks = _parts(work)
    with work.stages("room between parts"):
        work.placed, work.near = placed, apart.check_separation(placed, work.process)
    told = [
        f"{v.text}: {v.value / 1e3:.3f} um apart, need {v.limit / 1e3:.4g}"
        for v in work.near
    ]
    work.failures += told[:_LISTED] + (
        [f"{len(told) - _LISTED} more"] if len(told) > _LISTED else []
    )
    layers = work.process.layers
    name = record.name if record.wafer is None else f"{record.name}_DIE"
    kept: frozenset[LayerNumber] = frozenset({layers.outline, layers.fields})
    one = joined.die_cell(name, placed, kept=kept)
    if record.wafer is None:
        return one
    return _stepped(work, record.wafer, one, marks)


def _parts(
    work: FloorplanWork,
) -> tuple[list[joined.PartPlacement], parts.DieComponent | None]:
    """What stands on the die, and the alignment mark of the wafer.

    Everything that is corrected here is drawn first, so that all of it shares one
    series of doses.
    """
    record, process = work.record, work.process
    files = [
        joined.PartPlacement(standing.cell_part(work, part), part.at)
        for part in record.cell
    ]
    lenses = [standing.draw_lens(work, part) for part in record.lens]
    made = [drawing.made for drawing in lenses]
    if record.die is not None:
        sketches = [
            joined.PartPlacement(
                parts.plan_extents(part.name, one.plan, process), part.at
            )
            for part, one in zip(record.lens, made, strict=True)
        ]
        made.append(standing.draw_surroundings(work, record.die, sketches + files))
    has_marks = record.wafer is not None and bool(record.wafer.marks)
    if record.wafer is not None and has_marks:
        made.append(standing.draw_wafer_mark(work, record.wafer))
    with work.stages("dose classes"):
        made = build.assign_doses(made, process)
    mark = standing.written_part(work, made.pop()) if has_marks else None
    placed = [
        joined.PartPlacement(standing.lens_part(work, drawing, one), part.at)
        for part, drawing, one in zip(record.lens, lenses, made, strict=False)
    ]
    placed += files
    if record.die is not None:
        around = standing.written_part(work, made[-1])
        placed.append(joined.PartPlacement(around, (Placement(),)))
    return placed, mark


def _stepped(
    work: FloorplanWork,
    size: WaferSettings,
    one: MaskAssembly,
    mark: parts.DieComponent | None,
) -> MaskAssembly:
    """The wafer: as many whole dies as it holds, and its marks."""
    placed = work.placed
    box = apart.extent_of_copies(placed) / joined.PER_UM
    scattered = apart.reach_um(work.process)
    inner = apart.extent_of_copies(placed, exposed=True) / joined.PER_UM
    need = max(scattered, work.process.rules.minimum_gap_nm / 1e3)
    for axis, pitch in enumerate(size.pitch_um):
        between = pitch - float(inner[2 + axis] - inner[axis])
        if between < need:
            work.failures.append(
                f"wafer.pitch_um: dies are {between:.3f} um apart along {'xy'[axis]}, need {need:.4g}"
            )
    left, bottom, right, top = box.tolist()
    work.dies = wafer.usable_dies(
        size,
        (left, bottom, right, top),
        around_marks_um=max(scattered, joined.MARGIN_UM),
    )
    steps = wafer.step_and_repeat(one.name, work.dies, units_per_um=joined.PER_UM)
    at = tuple(Placement(1e3 * place.x_mm, 1e3 * place.y_mm) for place in size.marks)
    marks = None if mark is None else joined.PartPlacement(mark, at)
    return joined.wafer_cell(work.record.name, one, steps, marks)


def _write(work: FloorplanWork, made: MaskAssembly) -> None:
    """The files that were asked for, each read back."""
    options = work.options
    neither = not (options.oasis or options.gds)
    if options.oasis or neither:
        _one(work, made, "mask.oas", oasis_write.write_oasis)
    if options.gds or neither:
        _one(work, made, "mask.gds", gdsii_write.write_gdsii)


def _one(
    work: FloorplanWork,
    made: MaskAssembly,
    name: str,
    write: Callable[[MaskAssembly, Path], None],
) -> None:
    path = work.folder / name
    with work.stages(f"write {name}"):
        write(made, path)
    with work.stages(f"read back {name}"):
        content = read_mask(path, make.MOST_READ, keep=make.KEPT)
        found = compare.mask_differences(made, content)
    work.failures += [f"{name} does not read back as planned: {text}" for text in found]
    work.unlike |= {name} if found else set()
    work.written[name] = path.stat().st_size


def _accompany(work: FloorplanWork, made: MaskAssembly) -> None:
    """Dose table, layers, write fields, list of dies, job sheet, values, report."""
    work.areas_um2 = job_file.areas_um2(made)
    fields = list(job_file.place_fields(work.placed, work.splits))
    job_file.write_fields(fields, work.folder / "fields.csv")
    turned = job_file.without_fields(work.placed, work.splits)
    work.notes += [
        f"{name}: copies that are turned by no quarter have no write fields"
        for name in turned
    ]
    write_lyp(made, work.folder / "mask.lyp")
    doses.write_dose_table(made, work.process, work.folder / "doses.csv")
    most = work.process.exposure.maximum_classes
    aperture = work.process.layers.aperture[0]
    held = len({round(d, 6) for (n, _), d in made.doses.items() if n != aperture})
    if held > most:
        work.failures.append(
            f"{held} doses on the mask, exposure.maximum_classes = {most}"
        )
    if work.dies is not None:
        text = io.StringIO()
        out = csv.writer(text, lineterminator="\n")
        out.writerow(("die", "column", "row", "x_um", "y_um"))
        for n, (index, place) in enumerate(
            zip(work.dies.index.tolist(), work.dies.place_um.tolist(), strict=True), 1
        ):
            out.writerow([n, *index, *(f"{v:.4f}" for v in place)])
        store.write_text(work.folder / "dies.csv", text.getvalue())
    store.write_text(work.folder / "process.toml", config.dumps(work.process))
    store.write_text(work.folder / "arrangement.toml", config.dumps(work.record))
    store.write_text(
        work.folder / "job.txt", "\n".join(_sheet(work, made, len(fields))) + "\n"
    )
    store.write_text(
        work.folder / "layout.json", json.dumps(_values(work, made), indent=1) + "\n"
    )
    arranged_page.write_floorplan_page(work, made)


def _values(work: FloorplanWork, made: MaskAssembly) -> dict[str, Any]:
    return {
        "ok": not work.failures,
        "failures": work.failures,
        "notes": work.notes,
        "unchecked": work.unchecked,
        "charge_uC": handover.charge_uC(work.areas_um2, made.doses, work.process),
        "dies": 1 if work.dies is None else len(work.dies.index),
        "cells": len(made.cells),
        "doses": len(made.doses),
        "files": work.written,
        "lenses": work.lenses,
        "seconds": work.stages.seconds,
    }


def _sheet(work: FloorplanWork, made: MaskAssembly, fields: int) -> list[str]:
    """The job sheet: what stands where, and its doses; what is said of each lens lies
    in its folder.
    """
    process = work.process
    lines = [
        f"JOB SHEET  mask {made.name}  process {process.name!r}  tone {process.tone}",
        work.verdict,
        *work.notes,
        "",
        "Files:",
        *(
            f"  {name:<16} {size:>14,} bytes"
            for name, size in sorted(work.written.items())
        ),
        "",
        "On the die (x, y in um, turn in degrees counter-clockwise after the mirror; +y up):",
    ]
    every = [(part.name, part.file, part.at) for part in work.record.lens]
    every += [(part.name, part.file, part.at) for part in work.record.cell]
    for name, file, places in every:
        for at in places:
            many = (
                f", {at.columns} x {at.rows} copies" if at.columns * at.rows > 1 else ""
            )
            turned = f", turned by {at.turn_deg:g}" if at.turn_deg else ""
            mirrored = ", mirrored" if at.mirrored else ""
            lines.append(
                f"  {name:<12} ({at.x_um:.3f}, {at.y_um:.3f}){many}{turned}{mirrored}; {file}"
            )
    if work.dies is not None and work.record.wafer is not None:
        size = work.record.wafer
        lines += [
            "",
            f"Wafer of {size.diameter_mm:g} mm: {len(work.dies.index)} whole dies, {size.edge_exclusion_mm:g} mm from "
            "its edge; dies.csv",
            *(
                f"  alignment mark at ({mark.x_mm:g}, {mark.y_mm:g}) mm"
                for mark in size.marks
            ),
        ]
    areas = work.areas_um2
    charges = handover.charge_uC(areas, made.doses, process)
    many = "" if work.dies is None else f" of a die, {len(work.dies.index)} dies"
    return [
        *lines,
        "",
        *handover.charge_lines(charges),
        f"Write fields: {fields}{many}, part by part, in the order of fields.csv",
        "  they cover the pillars of the lenses alone",
        "",
        *handover.dose_lines(areas, made.doses, made.layer_names, process),
    ]


def _text(work: FloorplanWork, made: MaskAssembly) -> str:
    target = work.options.output
    lines = [*([] if work.failures and not work.unchecked else [work.verdict])]
    lines += work.notes
    lines += [
        f"  {target / name}: {size / 1e6:.3g} MB, read back"
        for name, size in work.written.items()
    ]
    dies = "" if work.dies is None else f"{len(work.dies.index):,} dies, "
    lines.append(
        f"  {dies}{len(made.cells):,} cells; {target / 'report.html'}; {sum(work.stages.seconds.values()):.1f} s"
    )
    return "\n".join(lines)
