"""report.html of a mask: what will be made, whether it can be, what was written and how
it read back.
"""

from pathlib import Path

from layout.commands import pictures
from layout.commands.job import FloorplanWork, LayoutJob
from layout.drc.report import DrcReport, format_size
from layout.formats.library import MaskLibrary
from layout.pec.psf import point_exposure
from layout.process.process import ExposureSettings
from metalens.core import report
from metalens.core.report import Figure, KeyFigure, Section, Table
from metalens.core.units import nm

_LISTED = 50  # rows of a table


def write_mask_page(job: LayoutJob, target: Path) -> None:
    """Write report.html of one lens, and die.png.

    Args:
        job: all that is known of the mask.
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
        job.rates_error = max(one.error for one in rates.values())
        sections += study_page.study_sections(
            job.source, job.process, job.fields, rates
        )
    read_back = {
        name: "; ".join(outcome.differences) or "as planned"
        for name, outcome in job.compared.items()
    }
    sections.append(_files(job.written, read_back, job.seconds))
    pillars = int(job.plan.lattices[0].counts(len(job.plan.classes))[1:].sum())
    violations = sum(job.drc.counts.values())
    gap = format_size(job.drc.minimum_space_nm)
    width = format_size(job.drc.minimum_width_nm)
    report.write_report(
        target / "report.html",
        f"Mask {job.plan.name}",
        sections,
        lead=f"{job.verdict} A {job.source.profile} lens for "
        f"{job.source.wavelength_um / nm:.0f} nm, {2 * job.made.radius_um / 1e3:.4g} mm "
        f"across, as {pillars:,} pillars ({job.drc.shapes:,} on the die) in "
        f"{len(job.plan.classes)} cells; process “{job.process.name}”.",
        key_figures=[
            KeyFigure("pillars", f"{job.drc.shapes:,}"),
            KeyFigure("smallest gap", gap),
            KeyFigure("thinnest pillar", width),
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
            "Limits in nm, corners in degrees, density as a share.",
        )
    ]
    if drc_report.worst:
        keys = ("rule", "layer", "cell", "count", "worst", "limit")
        rows = [[entry[key] for key in keys] for entry in drc_report.worst[:_LISTED]]
        text = "Violations by rule, layer and cell; mask.lyrdb marks their places."
        items.append(Table(keys, rows, text))
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
            f"{_fit_text(job.process.exposure)}"
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


def _fit_text(exposure: ExposureSettings) -> str:
    """What the Gaussians leave out of a measured table."""
    if exposure.csv is None:
        return ""
    point = point_exposure(exposure)
    return (
        f" The point exposure is the table {exposure.csv.name}, as "
        f"{len(point.weights)} Gaussians: the energy within any radius differs by up "
        f"to {100 * point.fit_error:.2g} % of the whole from that of the table."
    )


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


def write_floorplan_page(work: FloorplanWork, library: MaskLibrary) -> None:
    """Write report.html of an arrangement.

    Args:
        work: all that is known of it.
        library: cells of the mask.
    """
    verdicts = {name: values["ok"] for name, values in work.lenses.items()}
    verdicts |= {name: drc.ok for name, drc in work.rules.items()}
    rows = [[name, "passes" if ok else "FAILS"] for name, ok in verdicts.items()]
    dies = 1 if work.dies is None else len(work.dies.index)
    caption = "Each lens has a report of its own, in the folder of its name."
    passed = "Every part is within the design rules, and all stand far enough apart."
    text = "\n\n".join(work.failures or [passed, *work.notes])
    report.write_report(
        work.folder / "report.html",
        f"Mask {library.name}",
        [
            Section("Checks", text, [Table(("part", "verdict"), rows, caption)]),
            _files(work.written, work.read_back, work.stages.seconds),
        ],
        lead=f"{work.verdict} {len(work.lenses)} lenses on a die, {dies:,} whole dies; "
        f"process “{work.process.name}”. job.txt: places, charge and doses; doses.csv; "
        "fields.csv: write fields of the lenses; dies.csv: places of the dies.",
    )
