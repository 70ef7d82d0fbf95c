"""One lens to its mask in a folder: quantised, dosed, checked, written, read back,
verified, with its companions.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from layout.commands import page
from layout.commands.job import LayoutJob, Options, StageTimes
from layout.drc.klayout import write_lyp, write_lyrdb
from layout.drc.lattice import check_plan
from layout.formats import (
    compare,
    dxf,
    gdsii_read,
    gdsii_write,
    job_files,
    oasis_read,
    oasis_write,
)
from layout.formats.library import MaskLibrary
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


@dataclass(frozen=True, eq=False, slots=True)
class DrawnLens:
    """A lens as it is drawn, before any correction."""

    options: Options
    source: Lens
    process: processes.Process
    made: build.DrawnMask
    stages: StageTimes

    @property
    def corrected(self) -> bool:
        """Whether every shape gets a dose of its own."""
        return self.options.dose and self.process.exposure.corrected


def draw_lens(options: Options, *, furniture: build.Furniture = "die") -> DrawnLens:
    """The plan of the lens of a command, before any correction.

    Args:
        options: of the command.
        furniture: what stands on the die with the lens.
    """
    stages = StageTimes(options.console.say)
    with stages("read"):
        source = (lenses.load if options.study else lenses.load_out_of_core)(
            options.lens
        )
        if options.study:
            from layout.study.focus import check_study_lens

            check_study_lens(source)
        process = (
            processes.Process()
            if options.process is None
            else processes.load_process(options.process)
        )
    with stages("classes"):
        mask = build.draw_mask(source, process, name=options.name, furniture=furniture)
    return DrawnLens(options, source, process, mask, stages)


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
    return list(correct.correct_plans(plans, process.exposure, process.layers))


def make_mask(
    drawing: DrawnLens, folder: Path, solved: SolvedPlan | None = None
) -> LayoutJob:
    """Write the mask of a lens and all that goes with it into a folder.

    Args:
        drawing: of the lens.
        folder: that exists.
        solved: plan with the doses of a job of several masks; None: of this one alone.
    """
    if solved is None:
        with drawing.stages("dose"):
            (solved,) = correct_doses(
                [drawing.made.plan], drawing.process, corrected=drawing.corrected
            )
    job = _checked(drawing, *solved)
    job_files.write_dose_table(job.plan, job.process, folder / "doses.csv")
    _write_masks(job, folder)
    with job.stages("report"):
        _accompany(job, folder)
    store.write_text(
        folder / "layout.json", json.dumps(values_of(job), indent=1) + "\n"
    )
    return job


def _checked(drawing: DrawnLens, plan: MaskPlan, dose: DoseLadder | None) -> LayoutJob:
    """A job whose write fields are planned and whose design rules are checked."""
    source = drawing.source
    process = drawing.process
    stages = drawing.stages
    mask = drawing.made
    with stages("write fields"):
        write_fields = fields.split_write_fields(
            source.diameters, process, pillar_classes=mask.cells
        )
        plan = fields.with_fields(plan, write_fields, process)
    with stages("check"):
        drc = check_plan(plan, process.rules, foot_nm=_feet(plan, source, process))
    return LayoutJob(
        drawing.options, source, process, mask, dose, write_fields, plan, drc, stages
    )


def _feet(plan: MaskPlan, source: Lens, rules: processes.Process) -> Array:
    """(classes,) larger diameter of foot and top of each class after the etch, nm.

    Isolated pillars count where the bias makes them wider.

    Args:
        plan: drawn diameters.
        source: with the height of the pillars.
        rules: process.
    """
    drawn_nm = np.array([made.diameter_nm for made in plan.classes])
    made = rules.made_diameter_nm(drawn_nm) + max(0.0, rules.bias.isolated_nm)
    top, foot = rules.top_foot_nm(made, source.cell.height_um / nm)
    return np.maximum(top, foot)


def _write_masks(job: LayoutJob, target: Path) -> None:
    """Write the mask files of the options, and read each back."""
    options = job.options
    plan = job.plan
    if options.writes_oasis:
        path = target / "mask.oas"
        with job.stages("write OASIS"):
            oasis_write.write_oasis(plan, path)
        _read_back(job, path, oasis_read.read_oasis)
    if options.writes_gds:
        path = target / "mask.gds"
        with job.stages("write GDSII"):
            gdsii_write.write_gdsii(plan, path)
        _read_back(job, path, gdsii_read.read_gdsii)
    if options.dxf:
        path = target / "mask.dxf"
        with job.stages("write DXF"):
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
            with job.stages(f"write {form}"):
                write(path, tile)
            job.written[path.name] = path.stat().st_size


def _read_back(job: LayoutJob, path: Path, read: Callable[..., MaskLibrary]) -> None:
    """Read a mask file back: compare it with the plan, verify its exposure."""
    with job.stages(f"read back {path.suffix[1:]}"):
        content = read(path, limit=MOST_READ, keep=KEPT)
        job.compared[path.name] = compare.compare(job.plan, content)
        table = job_files.read_dose_table(path.with_name("doses.csv"))
    if _is_verifiable(job) and job.compared[path.name].ok:
        with job.stages(f"verify exposure {path.suffix[1:]}"):
            job.verified[path.name] = _verified(job, content, table)
    job.written[path.name] = path.stat().st_size


def _is_verifiable(job: LayoutJob) -> bool:
    """Whether the point exposure is known, and pillars are written."""
    return job.process.exposure.known and job.process.tone == "positive"


def _verified(
    job: LayoutJob, content: MaskLibrary, table: Mapping[LayerNumber, float]
) -> ExposureReport:
    """Exposure report of a file; files of the same polygons share one report."""
    if job.verified:
        return next(iter(job.verified.values()))
    lattice = job.plan.lattices[0]
    keeps_rows = not job.verified and lattice.rows * lattice.columns <= MOST_MADE
    job.made_rows = LensRows(job.plan) if keeps_rows else job.made_rows
    keep = job.made_rows.take if keeps_rows and job.made_rows else None
    return verify_exposure(
        content,
        job.plan,
        table,
        job.process,
        height_um=job.source.cell.height_um,
        keep=keep,
    )


def _accompany(job: LayoutJob, target: Path) -> None:
    """Layer properties, markers, job sheet and report."""
    write_lyp(job.plan, target / "mask.lyp")
    write_lyrdb(job.drc, job.plan.name, target / "mask.lyrdb")
    store.write_text(target / "process.toml", config.dumps(job.process))
    job_files.write_fields(job_files.field_sequence(job.fields), target / "fields.csv")
    store.write_text(target / "job.txt", job.sheet)
    if job.made_rows is not None:
        lenses.save(target / "made.h5", job.made_rows.lens(job.source))
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
        "diameters": len(job.made.cells.diameters_nm),
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
        "rates_error": job.rates_error,
        "seconds": job.seconds,
    }
