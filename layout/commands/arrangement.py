"""``metalens layout ARRANGEMENT.toml``: every lens written and checked by itself, then all
put together in one mask.
"""

import dataclasses
import json
from typing import Any

from layout.arrange import assembly, parts, separation, wafer
from layout.arrange.record import CellPart, DieFloorplan, PartInstances, WaferSettings
from layout.commands import make, page
from layout.commands.job import FloorplanWork, LayoutJob, Options
from layout.drc.klayout import write_lyp
from layout.drc.lattice import check_plan
from layout.drc.library import check_library
from layout.formats import compare, job_files
from layout.formats.files import placement_limit
from layout.formats.library import MaskLibrary, library_of
from layout.formats.reading import read_mask
from layout.mask import build
from layout.mask.marks import CLEAR_UM
from layout.mask.plan import MaskPlan
from layout.process import process as processes
from layout.process.process import LayerNumber
from layout.verify.exposure import verify_exposure
from metalens.core import config, store
from metalens.core.errors import ProcessError

_LISTED = 12  # spaces between parts that are listed one by one
_MARK = "WMARK"  # cell of a mark of the wafer


def make_floorplan(options: Options) -> int:
    """Make the mask; exit 1 where a rule is broken, a dose is missing or a file does
    not read back as planned.

    Args:
        options: of the command.
    """
    record = config.load(options.lens, DieFloorplan)
    named = [part.file for part in record.parts]
    process = processes.load_process(options.process)
    if not options.dose:
        exposure = dataclasses.replace(process.exposure, correct=False)
        process = dataclasses.replace(process, exposure=exposure)
    inputs = [options.lens.parent / file for file in named]
    with options.claim_folder(options.output, inputs=inputs) as draft, options.shared():
        work = FloorplanWork(options, record, process, draft.path, options.console.say)
        library = _whole(work)
        _write(work, library)
        work.say("report")
        _accompany(work, library)
    return options.console.judged(
        _values(work, library), _text(work, library), work.failures
    )


def _refuse_negative(work: FloorplanWork) -> None:
    """Raises: ProcessError: gaps are drawn, and something stands on the die that the
    frame of a lens does not include.
    """
    record = work.record
    size = work.record.wafer
    alone = all(record.furnished(part) for part in record.lens) and not record.cell
    alone &= record.die is None and not (size and size.marks)
    if work.process.tone == "negative" and not alone:
        raise ProcessError(
            "tone = 'negative' draws the die around each lens: need lenses that are "
            "furnished, and no [die], [[cell]] or wafer.marks"
        )


def _whole(work: FloorplanWork) -> MaskLibrary:
    """The die of the record, or its wafer."""
    record = work.record
    layers = work.process.layers
    _refuse_negative(work)
    if record.wafer is not None:
        wafer.refuse_marks_off(record.wafer)
    work.placed, marks = _parts(work)
    work.say("room between parts")
    work.near = separation.check_separation(work.placed, work.process)
    spaces = [
        f"{violation.text}: {violation.value / 1e3:.3f} um apart, "
        f"need {violation.limit / 1e3:.4g}"
        for violation in work.near
    ]
    unlisted = len(spaces) - _LISTED
    work.failures += spaces[:_LISTED] + ([f"{unlisted} more"] if unlisted > 0 else [])
    name = record.name if record.wafer is None else f"{record.name}_DIE"
    kept: frozenset[LayerNumber] = frozenset({layers.outline, layers.fields})
    die = assembly.die_cell(name, work.placed, kept=kept)
    return die if record.wafer is None else _stepped(work, record.wafer, die, marks)


def _parts(
    work: FloorplanWork,
) -> tuple[list[assembly.PartPlacement], parts.DieComponent | None]:
    """Everything that stands on the die, and the alignment mark of the wafer.

    All lenses and frames are drawn first, and corrected together, so that they share
    one series of doses.
    """
    record = work.record
    process = work.process
    size = work.record.wafer
    files = [assembly.PartPlacement(_cell_part(work, p), p.at) for p in record.cell]
    drawings = []
    for part in record.lens:
        path = work.options.lens.parent / part.file
        options = dataclasses.replace(work.options, lens=path, name=part.name)
        options.console.say(f"{part.name}: {part.file}")
        furniture: build.Furniture = "die" if record.furnished(part) else "aperture"
        drawings.append(make.draw_lens(options, furniture=furniture))
    plans = {drawing.plan.name: drawing.plan for drawing in drawings}
    if record.die is not None:
        sketches = [
            assembly.PartPlacement(
                parts.of_plan(part.name, plans[part.name], process, corrected=False),
                part.at,
            )
            for part in record.lens
        ]
        exposed_um = separation.extent_um([*sketches, *files], exposed=True)
        left, _, right, _ = exposed_um.tolist()
        plans["DIE"] = build.die_surroundings(
            drawings[0].source,
            process,
            name="DIE",
            size_um=record.die.size_um,
            clear_um=max(-left, right) + separation.reach_um(process),
            label=record.die.label or record.name,
        )
    if size is not None and size.marks:
        plans[_MARK] = build.wafer_mark(
            drawings[0].source,
            process,
            name=_MARK,
            mark_um=size.mark_um,
            width_um=size.mark_width_um,
        )
    work.say("dose")
    doses = make.correct_doses([*plans.values()], process, corrected=work.corrected)
    solved = dict(zip(plans, doses, strict=True))
    mark = _frame_part(work, solved[_MARK][0]) if _MARK in solved else None
    placed = [
        assembly.PartPlacement(_lens_part(work, drawing, solved[part.name]), part.at)
        for part, drawing in zip(record.lens, drawings, strict=True)
    ]
    placed += files
    if record.die is not None:
        around = _frame_part(work, solved["DIE"][0])
        placed.append(assembly.PartPlacement(around, (PartInstances(),)))
    return placed, mark


def _lens_part(
    work: FloorplanWork, drawing: LayoutJob, solved: make.SolvedPlan
) -> parts.DieComponent:
    """A lens, with mask, report and job sheet in a folder of its own."""
    name = drawing.options.name
    folder = work.folder / name
    folder.mkdir()
    work.options.console.say(f"{name}: mask and report")
    job = make.make_mask(drawing, folder, solved)
    work.failures += [f"{name}: {text}" for text in job.failures]
    work.lenses[name] = make.values_of(job)
    work.splits[name] = job.fields
    return parts.of_plan(name, job.plan, work.process, corrected=job.dose is not None)


def _frame_part(work: FloorplanWork, plan: MaskPlan) -> parts.DieComponent:
    """What stands around the lenses as a part of the die, checked and verified."""
    name = plan.name
    process = work.process
    work.say(f"{name}: check")
    work.judge_rules(name, check_plan(plan, process.rules))
    if work.corrected and process.exposure.csv is None:
        work.say(f"{name}: verify exposure")
        exposure = verify_exposure(library_of(plan), plan, plan.doses, process)
        if not exposure.ok:
            work.failures.append(
                f"{name}: exposure off by {100 * exposure.worst_exposure:.2g} % and "
                f"{exposure.worst_nm:.2g} nm"
            )
    return parts.of_plan(name, plan, process, corrected=work.corrected)


def _cell_part(work: FloorplanWork, part: CellPart) -> parts.DieComponent:
    """A cell of a mask file as a part of the die, checked and with its doses.

    Args:
        work: of the command; receives notes and failures.
        part: file, cell and relative dose.

    Raises:
        MaskFileError: the file is missing, too large or cannot be read.
    """
    path = work.options.lens.parent / part.file
    content = read_mask(path)
    content.refuse_beyond(placement_limit(path))
    component = parts.of_file(
        part.name,
        path,
        content,
        work.process,
        cell=part.cell,
        relative_dose=part.relative_dose,
    )
    skipped = component.library.skipped
    empty = sum(count for kind, count in skipped.items() if "without area" in kind)
    work.notes += [
        f"{count} {kind} of {path.name} are left out: they draw nothing"
        for count, kind in ((skipped["text"], "texts"), (empty, "shapes without area"))
        if count
    ]
    if part.checked:
        layers = work.process.layers
        skip = {layers.outline[0], layers.fields[0]}
        drawn = {number for number, _ in component.library.layers}
        work.say(f"{part.name}: check")
        chosen = [(number, None) for number in sorted(drawn - skip)]
        report = check_library(component.library, work.process.rules, layers=chosen)
        work.judge_rules(part.name, report)
    else:
        work.unchecked.append(part.name)
    if work.corrected and component.uncorrected:
        names = ", ".join(f"{a}/{b}" for a, b in component.uncorrected)
        doses = {component.library.doses[layer] for layer in component.uncorrected}
        work.failures.append(
            f"{part.name}: {sum(component.uncorrected.values()):,} shapes on {names} of "
            f"{part.file} get the relative dose "
            f"{', '.join(f'{dose:g}' for dose in sorted(doses))} without proximity "
            "correction; correct the file and lay its doses.csv beside it, or set "
            "exposure.correct = false"
        )
    return component


def _stepped(
    work: FloorplanWork,
    size: WaferSettings,
    die: MaskLibrary,
    mark: parts.DieComponent | None,
) -> MaskLibrary:
    """The wafer: as many whole dies as it holds, and its marks.

    Args:
        work: of the command; receives the dies and failures.
        size: of the wafer, raster and marks.
        die: cells of a die.
        mark: alignment mark; None: no marks.
    """
    scatter_um = separation.reach_um(work.process)
    exposed_box = separation.extent_um(work.placed, exposed=True)
    need = max(scatter_um, work.process.rules.minimum_gap_nm / 1e3)
    for axis, pitch in enumerate(size.pitch_um):
        between = pitch - float(exposed_box[2 + axis] - exposed_box[axis])
        if between < need:
            work.failures.append(
                f"wafer.pitch_um: dies are {between:.3f} um apart along {'xy'[axis]}, "
                f"need {need:.4g}"
            )
    left, bottom, right, top = separation.extent_um(work.placed).tolist()
    margin = max(scatter_um, CLEAR_UM)
    die_um = left, bottom, right, top
    work.dies = wafer.usable_dies(size, die_um, around_marks_um=margin)
    steps = wafer.step_and_repeat(die.name, work.dies, units_per_um=assembly.PER_UM)
    at = tuple(
        PartInstances(1e3 * place.x_mm, 1e3 * place.y_mm) for place in size.marks
    )
    marks = None if mark is None else assembly.PartPlacement(mark, at)
    return assembly.wafer_cell(work.record.name, die, steps, marks)


def _write(work: FloorplanWork, library: MaskLibrary) -> None:
    """Write the mask files of the options, and read each back."""
    for name, write in make.mask_writers(work.options).items():
        path = work.folder / name
        work.say(f"write {name}")
        write(library, path)
        work.say(f"read back {name}")
        content = read_mask(path, make.MOST_READ, keep=make.KEPT)
        differences = compare.mask_differences(library, content)
        work.failures += [
            f"{name} does not read back as planned: {text}" for text in differences
        ]
        work.different |= {name} if differences else set()
        work.written[name] = path.stat().st_size


def _accompany(work: FloorplanWork, library: MaskLibrary) -> None:
    """Dose table, layers, write fields, list of dies, job sheet, values, report."""
    work.areas_um2 = library.areas_um2()
    fields = list(assembly.place_fields(work.placed, work.splits))
    job_files.write_fields(fields, work.folder / "fields.csv")
    work.notes += [
        f"{name}: copies that are turned by no quarter have no write fields"
        for name in assembly.without_fields(work.placed, work.splits)
    ]
    write_lyp(library, work.folder / "mask.lyp")
    job_files.write_dose_table(library, work.process, work.folder / "doses.csv")
    limit = work.process.exposure.maximum_classes
    aperture = work.process.layers.aperture[0]
    dose_count = len(
        {round(d, 6) for (n, _), d in library.doses.items() if n != aperture}
    )
    if dose_count > limit:
        work.failures.append(
            f"{dose_count} doses on the mask, exposure.maximum_classes = {limit}"
        )
    texts = {
        "process.toml": config.dumps(work.process),
        "arrangement.toml": config.dumps(work.record),
        "job.txt": "\n".join(_sheet(work, library, len(fields))) + "\n",
        "layout.json": json.dumps(_values(work, library), indent=1) + "\n",
    }
    if work.dies is not None:
        pairs = zip(work.dies.index.tolist(), work.dies.place_um.tolist(), strict=True)
        texts["dies.csv"] = "die,column,row,x_um,y_um\n" + "".join(
            f"{n},{column},{row},{x:.4f},{y:.4f}\n"
            for n, ((column, row), (x, y)) in enumerate(pairs, 1)
        )
    for name, text in texts.items():
        store.write_text(work.folder / name, text)
    page.write_floorplan_page(work, library)


def _values(work: FloorplanWork, library: MaskLibrary) -> dict[str, Any]:
    """Values of layout.json of an arrangement."""
    return {
        "ok": not work.failures,
        "failures": work.failures,
        "notes": work.notes,
        "unchecked": work.unchecked,
        "charge_uC": job_files.charge_uC(work.areas_um2, library.doses, work.process),
        "dies": 1 if work.dies is None else len(work.dies.index),
        "cells": len(library.cells),
        "doses": len(library.doses),
        "files": work.written,
        "lenses": work.lenses,
    }


def _sheet(work: FloorplanWork, library: MaskLibrary, fields: int) -> list[str]:
    """Lines of the job sheet: parts, files, fields and doses.

    The job sheet of each lens is in its own folder.
    """
    process = work.process
    size = work.record.wafer
    lines = [
        f"JOB SHEET  mask {library.name}  process {process.name!r}  "
        f"tone {process.tone}",
        work.verdict,
        *work.notes,
        "",
        "Files:",
    ]
    lines += [f"  {n:<16} {b:>14,} bytes" for n, b in sorted(work.written.items())]
    lines += [
        "",
        "On the die (x, y in um, turn in degrees counter-clockwise after the mirror; "
        "+y up):",
    ]
    for part in work.record.parts:
        for at in part.at:
            copies = at.columns * at.rows
            many = f", {at.columns} x {at.rows} copies" if copies > 1 else ""
            turned = f", turned by {at.turn_deg:g}" if at.turn_deg else ""
            mirrored = ", mirrored" if at.mirrored else ""
            lines.append(
                f"  {part.name:<12} ({at.x_um:.3f}, {at.y_um:.3f}){many}{turned}"
                f"{mirrored}; {part.file}"
            )
    many = ""
    if work.dies is not None and size is not None:
        dies = len(work.dies.index)
        many = f" of a die, {dies} dies"
        lines += [
            "",
            f"Wafer of {size.diameter_mm:g} mm: {dies} whole dies, "
            f"{size.edge_exclusion_mm:g} mm from its edge; dies.csv",
        ]
        lines += [
            f"  alignment mark at ({m.x_mm:g}, {m.y_mm:g}) mm" for m in size.marks
        ]
    areas = work.areas_um2
    return [
        *lines,
        "",
        *job_files.charge_lines(job_files.charge_uC(areas, library.doses, process)),
        f"Write fields: {fields}{many}, part by part, in the order of fields.csv",
        "  they cover the pillars of the lenses alone",
        "",
        *job_files.dose_lines(areas, library.doses, library.layer_names, process),
    ]


def _text(work: FloorplanWork, library: MaskLibrary) -> str:
    """Summary for a person: verdict, notes, files and time."""
    target = work.options.output
    lines = [] if work.failures and not work.unchecked else [work.verdict]
    lines += work.notes
    lines += [
        f"  {target / name}: {size / 1e6:.3g} MB, read back"
        for name, size in work.written.items()
    ]
    dies = "" if work.dies is None else f"{len(work.dies.index):,} dies, "
    lines.append(f"  {dies}{len(library.cells):,} cells; {target / 'report.html'}")
    return "\n".join(lines)
