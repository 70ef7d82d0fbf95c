"""report.html of a mask: what is drawn, whether it keeps the rules, what was written and how
it was checked.
"""

from pathlib import Path

from layout.arrange import separation
from layout.commands import pictures
from layout.commands.job import FloorplanWork, LayoutJob
from layout.drc.report import DrcReport, format_size
from layout.formats.library import MaskLibrary
from layout.pec.psf import PointExposure, point_exposure
from layout.process.process import ExposureSettings
from metalens.core import report
from metalens.core.report import Figure, KeyFigure, Section, Table
from metalens.core.units import nm

_LISTED = 50  # rows of a table


def write_mask_page(job: LayoutJob, target: Path) -> None:
    """Write report.html of one lens, and die.png.

    Args:
        job: of the command.
        target: folder.
    """
    die_png = pictures.plot_die(job.plan, job.drc)
    (target / "die.png").write_bytes(die_png)
    sections = [
        Section(
            "Die",
            "Seen from the pillar side, in the coordinates of the lens: +y is up, so the "
            "first row of the diameter map is the lowest. The F stands in the upper left "
            "corner. metalens view shows every polygon.",
            [Figure(die_png, "The whole die.", wide=True)],
        ),
        _rules(job.drc),
        *_exposure(job),
    ]
    if job.options.study:
        from layout.study import page as study_page

        rates = study_page.rates_by_light(job.source)
        sections += study_page.study_sections(
            job.source, job.process, job.fields, rates
        )
    read_back = {
        name: "; ".join(outcome.differences) or "as planned"
        for name, outcome in job.compared.items()
    }
    sections.append(_files(job.written, read_back))
    drc = job.drc
    pillars = int(job.plan.lattices[0].counts(len(job.plan.classes))[1:].sum())
    violations = sum(drc.counts.values())
    report.write_report(
        target / "report.html",
        f"Mask {job.plan.name}",
        sections,
        lead=f"{job.verdict} A {job.source.profile} lens for "
        f"{job.source.wavelength_um / nm:.0f} nm, {2 * job.drawn.radius_um / 1e3:.4g} mm "
        f"across, as {pillars:,} pillars ({drc.shapes:,} on the die) in "
        f"{len(job.plan.classes)} cells; process “{job.process.name}”.",
        key_figures=[
            KeyFigure("pillars", f"{drc.shapes:,}"),
            KeyFigure("smallest gap", format_size(drc.minimum_space_nm)),
            KeyFigure("thinnest pillar", format_size(drc.minimum_width_nm)),
            KeyFigure("violations", f"{violations:,}", violations == 0),
        ],
    )


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
        items.append(
            Table(
                keys,
                rows,
                "Violations by rule, layer and cell; mask.lyrdb marks their places.",
            )
        )
    return Section("Design rules", drc_report.summary + ".", items)


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
        f"to {100 * point.fit_error:.2g} % of the whole from that of the table."
    )


def _files(written: dict[str, int], read_back: dict[str, str]) -> Section:
    """Section on the files: sizes, and outcome of reading back."""
    rows = [
        [name, f"{size / 1e6:.3f}", read_back.get(name, "not read back")]
        for name, size in written.items()
    ]
    text = "Each mask file was read back: every cell, polygon vertex and placement."
    return Section(
        "Files", text, [Table(("file", "MB", "read back and compared"), rows)]
    )


# arrangements


def write_floorplan_page(work: FloorplanWork, library: MaskLibrary) -> None:
    """Write report.html of an arrangement, die.png (and wafer.png).

    Args:
        work: of the command.
        library: mask that was written.
    """
    die_png = pictures.plot_floorplan(work.placed, work.near)
    (work.folder / "die.png").write_bytes(die_png)
    notes = " ".join(f"{note}." for note in work.notes)
    figure = Figure(die_png, "Parts on the die.", wide=True)
    text = f"Seen from the pillar side, +y up. {notes}".strip()
    sections = [Section("Die", text, [figure])]
    dies = 1
    if work.dies is not None and work.record.wafer is not None:
        dies = len(work.dies.index)
        box = separation.extent_um(work.placed)
        wafer_png = pictures.plot_wafer(work.record.wafer, work.dies, box)
        (work.folder / "wafer.png").write_bytes(wafer_png)
        caption = "Dies within the edge exclusion, and marks."
        text = f"{dies:,} whole dies; dies.csv lists them."
        figure = Figure(wafer_png, caption, wide=True)
        sections.append(Section("Wafer", text, [figure]))
    read_back = {
        name: "DIFFERENT" if name in work.different else "as planned"
        for name in work.written
    }
    sections.append(_checks(work))
    sections.append(_files(work.written, read_back))
    lead = (
        f"{work.verdict} {len(work.lenses)} lenses on a die; process "
        f"“{work.process.name}”. doses.csv: one dose for each layer and datatype; "
        "job.txt: places, charge and doses; fields.csv: write fields of the lenses."
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


def _checks(work: FloorplanWork) -> Section:
    """Verdict on each part, and what stands too near what."""
    rows = [
        [name, f"{lens['pillars']:,}", "; ".join(lens["failures"]) or "passes"]
        for name, lens in work.lenses.items()
    ]
    rows += [
        [name, f"{drc.shapes:,}", drc.violated or "passes"]
        for name, drc in work.rules.items()
    ]
    rows += [[name, "", "NOT CHECKED"] for name in work.unchecked]
    caption = "Each lens has a report of its own, in the folder of its name."
    items = [Table(("part", "shapes", "verdict"), rows, caption)]
    if work.near:
        near = [
            [violation.text, violation.value / 1e3, violation.limit / 1e3]
            for violation in work.near[:_LISTED]
        ]
        head = ("what", "distance / µm", "needed / µm")
        items.append(Table(head, near, "Parts that stand too near each other."))
    text = [*work.failures, *work.warnings]
    if not work.failures:
        checked = "Every part that was checked" if work.unchecked else "Every part"
        text.append(
            f"{checked} is within the design rules, and all stand far enough from each "
            "other."
        )
    return Section("Checks", "\n\n".join(text), items)
