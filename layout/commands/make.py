"""One lens to its mask in a folder: quantised, dosed, checked, written, read back,
verified, with its companions.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from layout.commands import page
from layout.commands.job import LayoutJob, Options
from layout.drc.klayout import write_lyp, write_lyrdb
from layout.drc.lattice import check_plan
from layout.drc.report import DrcReport
from layout.formats import compare, dxf, gdsii_write, job_files, oasis_write
from layout.formats.library import MaskLibrary
from layout.formats.reading import read_mask
from layout.mask import build, fields
from layout.mask.plan import MaskPlan
from layout.pec import correct
from layout.pec.correct import DoseLadder
from layout.process import process as processes
from layout.process.process import LayerNumber
from layout.verify.exposure import verify_exposure
from layout.verify.report import ExposureReport
from layout.verify.written_lens import LensRows
from metalens import lens as lenses
from metalens.core import config, store
from metalens.core.arrays import Array
from metalens.core.units import nm
from metalens.lens import Lens

MOST_MADE = (
    1 << 24
)  # sites of a lens whose predicted diameters are handed on as made.h5
KEPT = (
    1 << 16
)  # placements of a cell that are stored when a file is read back; of more only sums
MOST_READ = 2**40
SolvedPlan = tuple[MaskPlan, DoseLadder | None]  # dose None: every dose is 1


def draw_lens(options: Options, *, furniture: build.Furniture = "die") -> LayoutJob:
    """The plan of the lens of a command, before any correction, and its write fields.

    Args:
        options: of the command.
        furniture: what stands on the die with the lens.
    """
    say = options.console.say
    say("read")
    source = (lenses.load if options.study else lenses.load_out_of_core)(options.lens)
    if options.study:
        from layout.study.focus import check_study_lens

        check_study_lens(source)
    process = processes.load_process(options.process)
    say("classes")
    drawn = build.draw_mask(source, process, name=options.name, furniture=furniture)
    say("write fields")
    write_fields = fields.split_write_fields(
        source.diameters, process, pillar_classes=drawn.cells
    )
    report = DrcReport.empty(drawn.plan.unit_nm, process.rules)
    return LayoutJob(
        options, source, process, drawn, write_fields, drawn.plan, report, say
    )


def correct_doses(
    plans: Sequence[MaskPlan], process: processes.Process, *, corrected: bool
) -> list[SolvedPlan]:
    """Plans that are written in one job, with their doses.

    Args:
        plans: of lenses and of what stands around them.
        process: layers, and the point exposure.
        corrected: whether every shape gets a dose of its own.
    """
    if not (corrected and plans):
        return [(plan, None) for plan in plans]
    return list(correct.correct_plans(plans, process.exposure))


def make_mask(
    job: LayoutJob, folder: Path, solved: SolvedPlan | None = None
) -> LayoutJob:
    """Write the mask of a lens and all that goes with it into a folder.

    Args:
        job: with the lens drawn.
        folder: that exists.
        solved: plan with the doses of a job of several masks; None: of this one alone.
    """
    process = job.process
    if solved is None:
        is_corrected = job.options.dose and process.exposure.corrected
        job.say("dose")
        (solved,) = correct_doses([job.plan], process, corrected=is_corrected)
    plan, job.dose = solved
    job.plan = fields.with_fields(plan, job.fields, process)
    job.say("check")
    foot_nm = _feet(job.plan, job.source, process)
    job.drc = check_plan(job.plan, process.rules, foot_nm=foot_nm)
    job_files.write_dose_table(job.plan, process, folder / "doses.csv")
    _write_masks(job, folder)
    job.say("report")
    _accompany(job, folder)
    store.write_text(
        folder / "layout.json", json.dumps(values_of(job), indent=1) + "\n"
    )
    return job


def _feet(plan: MaskPlan, source: Lens, rules: processes.Process) -> Array:
    """(classes,) larger diameter of foot and top of each class after the etch, nm.

    Isolated pillars count where the bias makes them wider.

    Args:
        plan: drawn diameters.
        source: with the height of the pillars.
        rules: process.
    """
    drawn_nm = np.array([pillar.diameter_nm for pillar in plan.classes])
    made_nm = rules.made_diameter_nm(drawn_nm) + max(0.0, rules.bias.isolated_nm)
    top, foot = rules.top_foot_nm(made_nm, source.cell.height_um / nm)
    return np.maximum(top, foot)


def mask_writers(
    options: Options,
) -> dict[str, Callable[[MaskPlan | MaskLibrary, Path], None]]:
    """{file name: writer} of the mask files that are asked for; of none: both.

    Args:
        options: of the command.
    """
    writers: dict[str, Callable[[MaskPlan | MaskLibrary, Path], None]] = {}
    if options.oasis or not options.gds:
        writers["mask.oas"] = oasis_write.write_oasis
    if options.gds or not options.oasis:
        writers["mask.gds"] = gdsii_write.write_gdsii
    return writers


def _write_masks(job: LayoutJob, target: Path) -> None:
    """Write the mask files of the options, and read each back."""
    options = job.options
    plan = job.plan
    for name, write in mask_writers(options).items():
        job.say(f"write {name}")
        write(plan, target / name)
        _read_back(job, target / name)
    if options.dxf:
        path = target / "mask.dxf"
        job.say("write DXF")
        dxf.write_dxf(plan, path, window=options.window)
        job.written[path.name] = path.stat().st_size
    if options.stl or options.step:
        _write_solids(job, target)


def _write_solids(job: LayoutJob, target: Path) -> None:
    """STL and STEP of the pillars in the window."""
    from layout import solids

    options = job.options
    window = job.options.window
    tile = solids.cut_tile(
        job.source,
        job.process,
        side_um=window.size_um,
        centre_um=(window.x_um, window.y_um),
    )
    for is_wanted, form, write in (
        (options.stl, "STL", solids.write_stl),
        (options.step, "STEP", solids.write_step),
    ):
        if is_wanted:
            path = target / f"pillars.{form.lower()}"
            job.say(f"write {form}")
            write(path, tile)
            job.written[path.name] = path.stat().st_size


def _read_back(job: LayoutJob, path: Path) -> None:
    """Read a mask file back: compare it with the plan, verify its exposure.

    Files of the same polygons share one exposure report.
    """
    name, plan = path.name, job.plan
    job.say(f"read back {name}")
    content = read_mask(path, MOST_READ, keep=KEPT)
    job.compared[name] = compare.compare(plan, content)
    is_verifiable = job.process.exposure.known and job.process.tone == "positive"
    if is_verifiable and job.compared[name].ok:
        job.say(f"verify exposure {name}")
        job.verified[name] = next(iter(job.verified.values()), None) or _verified(
            job, content, job_files.read_dose_table(path.with_name("doses.csv"))
        )
    job.written[name] = path.stat().st_size


def _verified(
    job: LayoutJob, content: MaskLibrary, table: Mapping[LayerNumber, float]
) -> ExposureReport:
    """Exposure report of a file; keeps the lens that comes out, up to a size."""
    lattice = job.plan.lattices[0]
    if lattice.rows * lattice.columns <= MOST_MADE:
        job.predicted = LensRows(job.plan)
    return verify_exposure(
        content,
        job.plan,
        table,
        job.process,
        keep=job.predicted.take if job.predicted else None,
    )


def _accompany(job: LayoutJob, target: Path) -> None:
    """Layer properties, markers, job sheet and report."""
    write_lyp(job.plan, target / "mask.lyp")
    write_lyrdb(job.drc, job.plan.name, target / "mask.lyrdb")
    store.write_text(target / "process.toml", config.dumps(job.process))
    job_files.write_fields(job_files.field_sequence(job.fields), target / "fields.csv")
    sheet = job_files.job_sheet(
        job.plan, job.process, job.fields, job.written, job.verdict
    )
    store.write_text(target / "job.txt", sheet)
    if job.predicted is not None:
        lenses.save(target / "made.h5", job.predicted.lens(job.source))
    page.write_mask_page(job, target)


def values_of(job: LayoutJob) -> dict[str, Any]:
    """What layout.json says.

    Args:
        job: that has been written.
    """
    drc = job.drc
    return {
        "ok": job.ok,
        "failures": job.failures,
        "pillars": drc.shapes,
        "classes": len(job.plan.classes),
        "diameters": len(job.drawn.cells.diameters_nm),
        **drc.sizes,
        "maximum_density": drc.maximum_density,
        "violations": drc.counts,
        "worst": drc.worst,
        "files": job.written,
        "exposure": {
            name: {
                "worst_relative": verified.worst_exposure,
                "field_error": verified.error,
                "worst_diameter_nm": verified.worst_nm,
                "pillars": verified.pillars,
                "edges": len(verified.edges.x_um),
            }
            for name, verified in job.verified.items()
        },
        "differences": {
            name: list(outcome.differences) for name, outcome in job.compared.items()
        },
    }
