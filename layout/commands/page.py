"""report.html of a mask: what will be made, whether it can be, what was written and how
it was checked.
"""

from pathlib import Path

import numpy as np

from layout.commands import pictures
from layout.commands.job import LayoutJob
from layout.drc import DrcReport, format_size
from layout.formats import DxfWindow, handover
from layout.mask import MaskPlan
from layout.pec.psf import PointExposure
from layout.process import ExposureSettings
from layout.shapes import polygon
from metalens.core import report
from metalens.core.report import Figure, KeyFigure, Section, Table
from metalens.core.units import nm

_LISTED = 40  # write fields in the report
_ROWS = 1024  # of the lens that are counted at once


def draw_pictures(plan: MaskPlan, found: DrcReport) -> dict[str, bytes]:
    """{file name: picture} of what will be written."""
    return {
        "die.png": pictures.whole_die(plan, found),
        "pillars.png": pictures.plot_pillars(
            plan, (DxfWindow(0, 0, 8), pictures.edge_window(plan, 8))
        ),
        "diameters.png": pictures.plot_diameters(plan),
        "margins.png": pictures.plot_margins(found),
    }


def write_mask_page(job: LayoutJob, shots: dict[str, bytes], target: Path) -> None:
    """Write report.html and the pictures (:func:`draw_pictures`) beside it."""
    for name, png in shots.items():
        (target / name).write_bytes(png)
    sections = [
        _overview(job, shots),
        _rules(job, shots),
        _classes(job, shots),
        _doses(job),
        _verified(job),
        _fields(job),
        _files(job),
    ]
    if job.options.study:
        from layout.study import page as study_page

        answers = study_page.answers_of(job.source)
        job.answers_error = max(one.error for one in answers.values())
        sections[-1:-1] = study_page.study_sections(
            job.source, job.process, job.fields, answers
        )
    report.write_report(
        target / "report.html",
        f"Mask {job.plan.name}",
        [section for section in sections if section is not None],
        lead=_lead(job),
        key_figures=_key_figures(job),
    )


def _lead(job: LayoutJob) -> str:
    source, lattice = job.source, job.plan.lattices[0]
    own = sum(int(np.count_nonzero(block)) for _, block in lattice.blocks(_ROWS))
    die = (
        f" ({job.drc.shapes:,} on the die, with its test arrays)"
        if job.drc.shapes != own
        else ""
    )
    return (
        f"{job.verdict} A {source.profile} lens for {source.wavelength_um / nm:.0f} nm, "
        f"{2 * job.made.radius_um / 1e3:.4g} mm "
        f"across, as {own:,} pillars{die} in {len(job.plan.classes)} cells; process “{job.process.name}”."
    )


def _key_figures(job: LayoutJob) -> list[KeyFigure]:
    found = job.drc
    broken = sum(found.counts.values())
    same = all(outcome.ok for outcome in job.compared.values())
    return [
        KeyFigure("pillars", f"{found.shapes:,}"),
        KeyFigure(
            "smallest gap",
            format_size(found.minimum_space_nm),
            found.counts["space"] + found.counts["overlap"] == 0,
        ),
        KeyFigure(
            "thinnest pillar",
            format_size(found.minimum_width_nm),
            found.counts["width"] == 0,
        ),
        KeyFigure("violations", f"{broken:,}", broken == 0),
        KeyFigure("files read back", "as planned" if same else "DIFFERENT", same),
    ]


def _overview(job: LayoutJob, shots: dict[str, bytes]) -> Section:
    text = (
        "Two lithography steps: the pillar layer (with marks, label, dose-test array and witness cells) and the "
        "aperture layer, which draws the openings of the opaque film. The F stands in the upper left "
        "corner. The mask is seen from the pillar side, against the light, in the coordinates of the lens: +y is up "
        "here, so the first row of the diameter map is the lowest."
    )
    items = [
        Figure(
            shots["die.png"],
            "The whole die. Colour: share of the area that pillars cover, averaged.",
            wide=True,
        ),
        Figure(
            shots["pillars.png"],
            "Polygons as they are written, in the middle and at the rim.",
            wide=True,
        ),
    ]
    return Section("Die", text, items)


def _rules(job: LayoutJob, shots: dict[str, bytes]) -> Section:
    found = job.drc
    rows = [
        [rule, _limit(rule, found.limits[rule]), count]
        for rule, count in found.counts.items()
    ]
    items: list[Figure | Table] = [
        Figure(
            shots["margins.png"],
            "What was found (bar) beside what is allowed (line).",
            wide=True,
        ),
        Table(
            ("rule", "limit", "violations"),
            rows,
            "Checked on the drawn polygons, all pillars.",
        ),
    ]
    if found.worst:
        tallies = [
            [e["rule"], e["layer"], e["cell"], e["count"], e["worst"], e["limit"]]
            for e in found.worst[:50]
        ]
        head = ("rule", "layer", "cell", "violations", "worst", "limit")
        items.append(Table(head, tallies, "Violations by rule, layer and cell."))
        places = [
            [
                v.rule,
                f"({v.centre[0]:.0f}, {v.centre[1]:.0f})",
                v.value,
                v.limit,
                v.text,
            ]
            for v in found.violations[:50]
        ]
        items.append(
            Table(
                ("rule", "(x, y) / nm", "measured", "needed", "where"),
                places,
                "The first violations; mask.lyrdb marks up to 500 of each rule.",
            )
        )
    return Section("Design rules", found.summary + ".", items)


def _limit(rule: str, value: float) -> str:
    units = {"density": " %", "corner": " degrees"}
    return f"{100 * value if rule == 'density' else value:g}{units.get(rule, ' nm')}"


def _shaped(job: LayoutJob) -> Section:
    """Of pillars that are not round."""
    turned = job.source.diameters.angle_rad is not None
    turns = (
        f" and turns in steps of {job.process.rules.angle_step_deg:g} degrees"
        if turned
        else ""
    )
    two = job.source.pairs is not None
    shape = (
        f"{job.source.cell.shape.kind} of its own width and length"
        if two
        else job.source.cell.shape.name
    )
    area = [made.twice_area / 2 for made in job.plan.classes]
    rows = [
        ["classes", len(area)],
        ["least area / nm²", min(area)],
        ["largest area / nm²", max(area)],
    ]
    text = (
        f"Each is a {shape}, drawn in sizes in steps of {job.process.rules.diameter_step_nm} nm"
        f"{turns}, its corners on the grid; rounding by the etch is not made up for."
    )
    return Section("Pillars", text, [Table(("what", "value"), rows)])


def _classes(job: LayoutJob, shots: dict[str, bytes]) -> Section:
    if not job.plan.classes[0].round:
        return _shaped(job)
    shapes = {made.diameter_units: made for made in job.plan.classes}
    grid = job.plan.grid
    made = [
        polygon.PillarShape(shapes[d].outline / grid, d / grid) for d in sorted(shapes)
    ]
    picked = np.unique(np.linspace(0, len(made) - 1, 12).round().astype(int))
    unit = grid * job.plan.unit_nm
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
        f"Diameters are drawn in steps of {job.process.rules.diameter_step_nm} nm after the bias was taken off; "
        f"that rounds each by at most {job.made.cells.rounding_nm:g} nm. Polygons have the area of their circle to "
        f"{100 * worst:.3f} %."
    )
    head = (
        "diameter / nm",
        "width / nm",
        "vertices",
        "shots",
        "area error / %",
        "edge error / nm",
    )
    picture = Figure(shots["diameters.png"], "Pillars of each diameter.", wide=True)
    items: list[Figure | Table] = [picture, Table(head, rows)]
    return Section("Pillars", text, items)


def _doses(job: LayoutJob) -> Section | None:
    doses = job.made.dose
    if doses is None:
        return None
    count = len(doses.ladder.factors)
    rows = [
        [
            "one dose",
            100 * doses.before.worst,
            100 * doses.before.rms,
            doses.before.diameter_nm,
        ],
        [
            f"{count} doses",
            100 * doses.after.worst,
            100 * doses.after.rms,
            doses.after.diameter_nm,
        ],
    ]
    head = ("", "worst / %", "rms / %", "diameter / nm")
    used = [made.dose for made in job.plan.classes]
    table = [
        [*layer, f"{dose:.4f}", job.plan.layer_names.get(layer, "")]
        for layer, dose in sorted(job.plan.doses.items())
    ]
    text = (
        f"Proximity correction of lens, dose test, witness cells, marks and label together: relative dose "
        f"{min(used):.3f} to {max(used):.3f}, a datatype each (doses.csv). Every edge of every shape is exposed within "
        f"{100 * doses.worst:.2g} % of what it should be; known to {100 * doses.error:.2g} %."
        f"{_table_said(job.process.exposure, doses.point)}"
    )
    sheet = Table(
        ("layer", "datatype", "relative dose", "name"),
        table,
        "The dose table, as in doses.csv.",
    )
    return Section(
        "Dose",
        text,
        [
            Table(
                head,
                rows,
                "Error of the exposure at the pillar edges of the lens, and what it does.",
            ),
            sheet,
        ],
    )


def _table_said(exposure: ExposureSettings, point: PointExposure) -> str:
    """What the Gaussians leave out of a measured table: energy that the two figures
    before it do not know of.
    """
    if exposure.csv is None:
        return ""
    return (
        f" The point exposure is the table {exposure.csv.name}, as {len(point.weights)} Gaussians: the energy within "
        f"any radius differs by up to {100 * point.fit_error:.2g} % of the whole from that of the table, besides."
    )


def _verified(job: LayoutJob) -> Section | None:
    """What the written files and their dose table make."""
    if not job.verified:
        return None
    rows = [
        [
            name,
            f"{c.pillars:,}",
            f"{len(c.edges.x_um):,}",
            f"{100 * c.worst_exposure:.2f}",
            f"{100 * c.error:.2g}",
            f"{c.worst_nm:.2f}",
            f"{c.thinnest_top_nm:.0f} to {c.widest_foot_nm:.0f}",
            "yes" if c.ok else "NO",
        ]
        for name, c in job.verified.items()
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
        "The files and doses.csv, read back and exposed again. Shared with the correction: the Gaussians of the process "
        "file, the threshold (half of what a wide area receives) and the method of the field on nodes. That field is "
        "compared with direct sums over the exact shapes at sample pillars, which are judged too; edges of marks and "
        "labels are in closed form. Pillars of lens and witness cells and the edges of marks and "
        "labels; the dose test is predicted and not judged. made.h5 (up to 16 million sites) is the lens of "
        "the predicted diameters: give it to metalens psf, or to this command with --study."
    )
    items: list[Figure | Table] = [
        Table(head, rows),
        Figure(picture, "Predicted less drawn diameter.", wide=True),
    ]
    return Section("Exposure as written", text, items)


def _fields(job: LayoutJob) -> Section:
    split = job.fields
    text = (
        f"Fields that hold pillars: {split.used} ({split.mode}), {split.size_um[0]:.1f} by {split.size_um[1]:.1f} µm "
        f"at most; no border cuts a pillar: they keep {split.clearance_um / nm:.0f} nm. A raster centred on the axis "
        f"would have cut {split.cut_before:,} pillars. fields.csv lists them in the order of writing, row by row and "
        f"back; job.txt is the sheet for the operator, with currents left open."
    )
    steps = handover.field_sequence(split)
    rows = [
        [
            s.sequence,
            f"{s.x_um:.3f}",
            f"{s.y_um:.3f}",
            f"{s.width_um:.3f}",
            f"{s.height_um:.3f}",
            f"{s.pillars:,}",
        ]
        for s in steps[:_LISTED]
    ]
    fields = Table(
        handover.FIELD_HEAD, rows, f"The first {len(rows)} of {len(steps)} fields."
    )
    charges = [
        [step, f"{charge:.4g}", f"{charge * 1e3 / 3600:.3g}"]
        for step, charge in handover.charge_uC(
            handover.areas_um2(job.plan), job.plan.doses, job.process
        ).items()
    ]
    charge = Table(
        ("step", "charge / µC", "hours at 1 nA"),
        charges,
        "Without stage and settling times.",
    )
    marks = Table(
        ("x / µm", "y / µm", "width / µm", "height / µm"),
        handover.marks_um(job.plan),
        "Marks.",
        digits=6,
    )
    return Section("Job sheet", text, [charge, fields, marks])


def _files(job: LayoutJob) -> Section:
    rows = []
    for name, size in job.written.items():
        outcome = job.compared.get(name)
        verdict = (
            "not read back"
            if outcome is None
            else ("as planned" if outcome.ok else "; ".join(outcome.differences))
        )
        rows.append([name, f"{size / 1e6:.3f}", verdict])
    times = [[stage, seconds] for stage, seconds in job.seconds.items()]
    items = [
        Table(("file", "MB", "read back and compared"), rows),
        Table(
            ("stage", "seconds"), times, "On the machine that made the mask.", digits=3
        ),
    ]
    return Section(
        "Files",
        "Each mask file was read back: every pillar at its site, every polygon vertex.",
        items,
    )
