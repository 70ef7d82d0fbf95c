"""report.html of a mask: what will be made, whether it can be, what was written and how
it was checked.
"""

from pathlib import Path
from typing import Any

import numpy as np

from layout.commands import pictures
from layout.commands.job import FloorplanWork, LayoutJob
from layout.drc.report import DrcReport, format_size
from layout.formats import handover
from layout.formats.dxf import DxfWindow
from layout.formats.library import MaskLibrary, library_of
from layout.mask.plan import MaskPlan
from layout.pec.psf import PointExposure, point_exposure
from layout.process.process import ExposureSettings, Process
from layout.shapes import polygon
from metalens.core import report
from metalens.core.report import Figure, KeyFigure, Section, Table
from metalens.core.units import nm

_LISTED = 50  # rows of a table


def draw_pictures(plan: MaskPlan, drc_report: DrcReport) -> dict[str, bytes]:
    """{file name: picture} of what will be written.

    Args:
        plan: of the die.
        drc_report: its design-rule check.
    """
    windows = DxfWindow(0, 0, 8), pictures.edge_window(plan, 8)
    return {
        "die.png": pictures.plot_die(plan, drc_report),
        "pillars.png": pictures.plot_pillars(plan, windows),
        "diameters.png": pictures.plot_diameters(plan),
    }


def write_mask_page(job: LayoutJob, shots: dict[str, bytes], target: Path) -> None:
    """Write report.html of one lens, and its pictures.

    Args:
        job: of the command.
        shots: from :func:`draw_pictures`.
        target: folder.
    """
    for name, png in shots.items():
        (target / name).write_bytes(png)
    sections = [
        Section(
            "Die",
            "Two lithography steps: the pillar layer (with marks, label, dose-test "
            "array and witness cells) and the aperture layer, which draws the openings "
            "of the opaque film. The F stands in the upper left corner. The mask is "
            "seen from the pillar side, against the light, in the coordinates of the "
            "lens: +y is up here, so the first row of the diameter map is the lowest.",
            [
                Figure(
                    shots["die.png"],
                    "The whole die. Colour: share of the area that pillars cover, "
                    "averaged.",
                    wide=True,
                ),
                Figure(
                    shots["pillars.png"],
                    "Polygons as they are written, in the middle and at the rim.",
                    wide=True,
                ),
            ],
        ),
        _rules(job.drc),
        _classes(job, shots),
        *_exposure(job),
        _job_sheet(job),
    ]
    if job.options.study:
        from layout.study import page as study_page

        answers = study_page.answers_of(job.source)
        job.answers_error = max(one.error for one in answers.values())
        sections += study_page.study_sections(
            job.source, job.process, job.fields, answers
        )
    read_back = {
        name: "; ".join(outcome.differences) or "as planned"
        for name, outcome in job.compared.items()
    }
    sections.append(_files(job.written, read_back, job.seconds))
    report.write_report(
        target / "report.html",
        f"Mask {job.plan.name}",
        sections,
        lead=_lead(job),
        key_figures=_key_figures(job),
    )


def _lead(job: LayoutJob) -> str:
    """First paragraph of the report: verdict, lens, and number of pillars."""
    source = job.source
    classes = job.plan.classes
    pillars = int(job.plan.lattices[0].counts(len(classes))[1:].sum())
    die = ""
    if job.drc.shapes != pillars:
        die = f" ({job.drc.shapes:,} on the die, with its test arrays)"
    return (
        f"{job.verdict} A {source.profile} lens for {source.wavelength_um / nm:.0f} nm, "
        f"{2 * job.made.radius_um / 1e3:.4g} mm across, as {pillars:,} pillars{die} in "
        f"{len(classes)} cells; process “{job.process.name}”."
    )


def _key_figures(job: LayoutJob) -> list[KeyFigure]:
    """Key figures of a mask: pillars, smallest sizes, violations, files."""
    drc = job.drc
    counts = drc.counts
    as_planned = all(outcome.ok for outcome in job.compared.values())
    violations = sum(counts.values())
    too_close = counts["space"] + counts["overlap"]
    gap, width = map(format_size, (drc.minimum_space_nm, drc.minimum_width_nm))
    return [
        KeyFigure("pillars", f"{drc.shapes:,}"),
        KeyFigure("smallest gap", gap, too_close == 0),
        KeyFigure("thinnest pillar", width, counts["width"] == 0),
        KeyFigure("violations", f"{violations:,}", violations == 0),
        KeyFigure(
            "files read back", "as planned" if as_planned else "DIFFERENT", as_planned
        ),
    ]


def _rules(drc_report: DrcReport) -> Section:
    """Section on the design rules: limits, counts, and the first violations."""
    items: list[Figure | Table] = [
        Table(
            ("rule", "limit", "violations"),
            [
                [rule, drc_report.limits[rule], n]
                for rule, n in drc_report.counts.items()
            ],
            "Checked on the drawn polygons, all pillars; limits in nm, corners in "
            "degrees, density as a share.",
        )
    ]
    if drc_report.worst:
        keys = ("rule", "layer", "cell", "count", "worst", "limit")
        rows = [[entry[key] for key in keys] for entry in drc_report.worst[:_LISTED]]
        items.append(Table(keys, rows, "Violations by rule, layer and cell."))
        places = [
            [v.rule, "({:.0f}, {:.0f})".format(*v.centre), v.value, v.limit, v.text]
            for v in drc_report.violations[:_LISTED]
        ]
        head = ("rule", "(x, y) / nm", "measured", "needed", "where")
        text = "The first violations; mask.lyrdb marks up to 500 of each rule."
        items.append(Table(head, places, text))
    return Section("Design rules", drc_report.summary + ".", items)


def _classes(job: LayoutJob, shots: dict[str, bytes]) -> Section:
    """Section on the drawn pillars: sizes and steps, and for discs a table of polygons.

    Args:
        job: of the command.
        shots: pictures, from :func:`draw_pictures`.
    """
    rules = job.process.rules
    classes = job.plan.classes
    if not classes[0].round:
        shape = job.source.cell.shape
        area = [made.twice_area / 2 for made in classes]
        two = job.source.pairs is not None
        kind = f"{shape.kind} of its own width and length" if two else shape.name
        turned = job.source.diameters.angle_rad is not None
        turns = f" and turns in steps of {rules.angle_step_deg:g} degrees" * turned
        return Section(
            "Pillars",
            f"Each is a {kind}, drawn in sizes in steps of {rules.diameter_step_nm} nm"
            f"{turns}, its corners on the grid; rounding by the etch is not made up "
            f"for. {len(area)} classes of {min(area):,.0f} to {max(area):,.0f} nm².",
        )
    shapes = {made.diameter_units: made for made in classes}
    grid = job.plan.grid
    unit = job.plan.grid * job.plan.unit_nm
    made = [
        polygon.PillarShape(shapes[d].outline / grid, d / grid) for d in sorted(shapes)
    ]
    picked = np.unique(np.linspace(0, len(made) - 1, 12).round().astype(int))
    rows = [
        [
            m.diameter * unit,
            m.width * unit,
            len(m.points),
            m.shots,
            f"{100 * m.area_error:+.3f}",
            m.edge_error * unit,
        ]
        for m in (made[i] for i in picked)
    ]
    worst = max(abs(m.area_error) for m in made)
    text = (
        f"Diameters are drawn in steps of {rules.diameter_step_nm} nm after the bias "
        f"was taken off; that rounds each by at most {job.made.cells.rounding_nm:g} nm. "
        f"Polygons have the area of their circle to {100 * worst:.3f} %."
    )
    head = "diameter / nm, width / nm, vertices, shots, area error / %, edge error / nm"
    picture = Figure(shots["diameters.png"], "Pillars of each diameter.", wide=True)
    return Section("Pillars", text, [picture, Table(head.split(", "), rows)])


def _exposure(job: LayoutJob) -> list[Section]:
    """Doses, and what the written files and their dose table make."""
    sections = []
    if job.dose is not None:
        used = [pillar.dose for pillar in job.plan.classes]
        text = (
            "Proximity effect correction of lens, dose test, witness cells, marks and "
            f"label together: relative dose {min(used):.3f} to {max(used):.3f} in "
            f"{len(job.dose.factors)} steps, a datatype each (doses.csv)."
            f"{_fit_text(job.process.exposure, point_exposure(job.process.exposure))}"
        )
        sections.append(Section("Dose", text))
    if not job.verified:
        return sections
    rows = [
        [
            name,
            f"{verified.pillars:,}",
            f"{len(verified.edges.x_um):,}",
            f"{100 * verified.worst_exposure:.2f}",
            f"{100 * verified.error:.2g}",
            f"{verified.worst_nm:.2f}",
            f"{verified.thinnest_top_nm:.0f} to {verified.widest_foot_nm:.0f}",
            "yes" if verified.ok else "NO",
        ]
        for name, verified in job.verified.items()
    ]
    head = (
        "file",
        "pillars",
        "points on marks and labels",
        "worst exposure / %",
        "field less direct sums / %",
        "worst width / nm",
        "thinnest top to widest foot / nm",
        f"within {100 * job.process.exposure.tolerance:g} % and 1 nm",
    )
    picture = pictures.plot_verification(next(iter(job.verified.values())))
    text = (
        "The files and doses.csv, read back and exposed again. Shared with the "
        "correction: the Gaussians of the process file, the threshold (half of what a "
        "wide area receives) and the field on nodes. That field is compared with "
        "direct sums over the exact shapes at sample pillars, which are judged too; "
        "edges of marks and labels are in closed form. The dose test is predicted and "
        "not judged. made.h5 (up to 16 million sites) is the lens of the predicted "
        "diameters: give it to metalens psf, or to this command with --study."
    )
    map_figure = Figure(picture, "Predicted less drawn diameter.", wide=True)
    sections.append(
        Section("Exposure as written", text, [Table(head, rows), map_figure])
    )
    return sections


def _fit_text(exposure: ExposureSettings, point: PointExposure) -> str:
    """What the Gaussians leave out of a measured table."""
    if exposure.csv is None:
        return ""
    return (
        f" The point exposure is the table {exposure.csv.name}, as "
        f"{len(point.weights)} Gaussians: the energy within any radius differs by up "
        f"to {100 * point.fit_error:.2g} % of the whole from that of the table, besides."
    )


def _job_sheet(job: LayoutJob) -> Section:
    """Section on write fields and charge."""
    split = job.fields
    text = (
        f"Fields that hold pillars: {split.used} ({split.mode}), {split.size_um[0]:.1f} "
        f"by {split.size_um[1]:.1f} µm at most; no border cuts a pillar: they keep "
        f"{split.clearance_um / nm:.0f} nm. A raster centred on the axis would have cut "
        f"{split.cut_before:,} pillars. fields.csv lists them in the order of writing; "
        "job.txt is the sheet for the operator, with currents left open."
    )
    areas = library_of(job.plan).areas_um2()
    charge = handover.charge_uC(areas, job.plan.doses, job.process)
    return Section("Job sheet", text, [_charge(charge)])


def _charge(charges: dict[str, float]) -> Table:
    """Table of the charge of each step, and its time at 1 nA."""
    rows = [
        [step, f"{charge_uC:.4g}", f"{charge_uC / 3.6:.3g}"]
        for step, charge_uC in charges.items()
    ]
    head = ("step", "charge / µC", "hours at 1 nA")
    return Table(head, rows, "Without stage and settling times.")


def _files(
    written: dict[str, int], read_back: dict[str, str], seconds: dict[str, float]
) -> Section:
    """Section on the files: sizes, outcome of reading back, and times."""
    rows = [
        [name, f"{size / 1e6:.3f}", read_back.get(name, "not read back")]
        for name, size in written.items()
    ]
    items = [
        Table(("file", "MB", "read back and compared"), rows),
        Table(("stage", "seconds"), list(map(list, seconds.items())), digits=3),
    ]
    text = "Each mask file was read back: every cell, polygon vertex and placement."
    return Section("Files", text, items)


# arrangements


def write_floorplan_page(work: FloorplanWork, library: MaskLibrary) -> None:
    """Write report.html of an arrangement, die.png (and wafer.png).

    Args:
        work: of the command.
        library: mask that was written.
    """
    shots = {"die.png": pictures.plot_floorplan(work.placed, work.near)}
    notes = " ".join(f"{note}." for note in work.notes)
    sections = [
        Section(
            "Die",
            f"Seen from the pillar side, +y up. {notes}".strip(),
            [Figure(shots["die.png"], "Parts on the die.", wide=True), _places(work)],
        )
    ]
    dies = 1
    if work.dies is not None and work.record.wafer is not None:
        dies = len(work.dies.index)
        box = pictures.floorplan_box_um(work.placed)
        shots["wafer.png"] = pictures.plot_wafer(work.record.wafer, work.dies, box)
        caption = "Dies within the edge exclusion, and marks."
        text = f"{dies:,} whole dies; dies.csv lists them."
        shown = Figure(shots["wafer.png"], caption, wide=True)
        sections.append(Section("Wafer", text, [shown]))
    for name, png in shots.items():
        (work.folder / name).write_bytes(png)
    read_back = {
        name: "DIFFERENT" if name in work.different else "as planned"
        for name in work.written
    }
    charges = handover.charge_uC(work.areas_um2, library.doses, work.process)
    sections += [
        _checks(work),
        Section(
            "Dose",
            "One dose for each layer and datatype: doses.csv; write fields of the "
            "lenses: fields.csv.",
            [_charge(charges), _dose_table(library, work.process)],
        ),
        _files(work.written, read_back, work.stages.seconds),
    ]
    pillars = sum(
        values["pillars"]
        * sum(copies.count for copies in placement.copies(placement.part.top))
        for placement in work.placed
        for name, values in work.lenses.items()
        if name == placement.part.name
    )
    lead = (
        f"{work.verdict} {len(work.lenses)} lenses with {pillars:,} pillars on a die; "
        f"process “{work.process.name}”."
    )
    report.write_report(
        work.folder / "report.html",
        f"Mask {library.name}",
        sections,
        lead=lead,
        key_figures=[
            KeyFigure("parts", str(len(work.placed))),
            KeyFigure("dies", f"{dies:,}"),
            KeyFigure("doses", str(len(library.doses))),
            KeyFigure("what fails", str(len(work.failures)), not work.failures),
        ],
    )


def _dose_table(library: MaskLibrary, process: Process) -> Table:
    """Table of the dose of each layer and datatype."""
    base = process.exposure.base_uC_cm2
    rows = [
        [*layer, f"{dose:.6f}", dose * base, library.layer_names.get(layer, "")]
        for layer, dose in sorted(library.doses.items())
    ]
    return Table(("layer", "datatype", "relative dose", "µC/cm²", "name"), rows)


def _places(work: FloorplanWork) -> Table:
    """Table of the parts and their places."""
    files = {part.name: str(part.file) for part in work.record.parts}
    rows = [
        [
            placement.part.name,
            files.get(placement.part.name, "own"),
            at.x_um,
            at.y_um,
            f"{at.turn_deg:g}{' mirrored' * at.mirrored}",
            at.columns * at.rows,
        ]
        for placement in work.placed
        for at in placement.at
    ]
    head = ("part", "file", "x / µm", "y / µm", "turn / degrees", "copies")
    text = f"The first {min(_LISTED, len(rows))} of {len(rows)} places."
    return Table(head, rows[:_LISTED], text, digits=8)


def _checks(work: FloorplanWork) -> Section:
    """Rules, exposure and read-back of each part, and what stands too near what."""
    rows = [_lens_row(name, values) for name, values in work.lenses.items()]
    for name, drc in work.rules.items():
        sizes = map(format_size, (drc.minimum_space_nm, drc.minimum_width_nm))
        broken = sum(drc.counts.values())
        verdict = "FAILS" if broken else "passes"
        rows.append([name, f"{drc.shapes:,}", *sizes, broken, "", "", verdict])
    rows += [[name, *[""] * 6, "NOT CHECKED"] for name in work.unchecked]
    columns = "part, shapes, least gap, least feature, broken rules, exposure, "
    columns += "read back, verdict"
    caption = "Each lens has a report of its own, in the folder of its name."
    items = [Table(columns.split(", "), rows, caption)]
    if work.near:
        near = [
            [violation.text, violation.value / 1e3, violation.limit / 1e3]
            for violation in work.near[:_LISTED]
        ]
        head = ("what", "apart / µm", "needed / µm")
        items.append(Table(head, near, "Parts that stand too near each other."))
    text = [*work.failures, *work.warnings]
    if not work.failures:
        checked = "Every part that was checked" if work.unchecked else "Every part"
        text.append(
            f"{checked} is within the design rules, and all stand far enough from each "
            "other."
        )
    return Section("Checks", "\n\n".join(text), items)


def _lens_row(name: str, values: dict[str, Any]) -> list[Any]:
    """Of layout.json of a lens."""
    exposed = [
        f"{100 * exposure['worst_relative']:.2f} %, {exposure['worst_diameter_nm']:.2f} nm"
        for exposure in values["exposure"].values()
    ]
    return [
        name,
        f"{values['pillars']:,}",
        format_size(values["minimum_space_nm"]),
        format_size(values["minimum_width_nm"]),
        sum(values["violations"].values()),
        exposed[0] if exposed else "not verified",
        "DIFFERENT" if any(values["differences"].values()) else "as planned",
        "passes" if values["ok"] else "FAILS",
    ]
