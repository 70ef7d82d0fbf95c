"""report.html of a mask: what will be made, whether it can be, what was written and how it was checked."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from layout import pictures, polygon
from layout.dxf import Window
from metalens import report
from metalens.report import Figure, KeyFigure, Section, Table
from metalens.units import nm

if TYPE_CHECKING:
    from layout.command import Job


def write(job: "Job", target: Path) -> None:
    """Write report.html and the pictures beside it."""
    shots = {
        "die.png": pictures.whole_die(job.plan, job.drc),
        "pillars.png": pictures.pillars(job.plan, (Window(0, 0, 8), pictures.edge_window(job.plan, 8))),
        "diameters.png": pictures.diameters(job.plan),
        "margins.png": pictures.margins(job.drc),
    }
    for name, png in shots.items():
        (target / name).write_bytes(png)
    sections = [_overview(job, shots), _rules(job, shots), _classes(job, shots), _doses(job), _fields(job), _files(job)]
    if job.options.study:
        from layout import study_page

        sections[-1:-1] = study_page.sections(job.source, job.process, job.fields)
    report.write(
        target / "report.html",
        f"Mask {job.plan.name}",
        [section for section in sections if section is not None],
        lead=_lead(job),
        key_figures=_key_figures(job),
    )


def _lead(job: "Job") -> str:
    source = job.source
    return (
        f"A {source.profile} lens for {source.wavelength_um / nm:.0f} nm, {2 * job.made.radius_um / 1e3:.4g} mm "
        f"across, as {job.drc.pillars:,} pillars in {len(job.plan.classes)} cells; process “{job.process.name}”."
    )


def _key_figures(job: "Job") -> list[KeyFigure]:
    found = job.drc
    broken = sum(found.counts.values())
    same = all(outcome.ok for outcome in job.compared.values())
    return [
        KeyFigure("pillars", f"{found.pillars:,}"),
        KeyFigure("smallest gap", f"{found.minimum_gap_nm:.1f} nm", found.counts["gap"] + found.counts["overlap"] == 0),
        KeyFigure("thinnest pillar", f"{found.minimum_feature_nm:.1f} nm", found.counts["feature"] == 0),
        KeyFigure("violations", f"{broken:,}", broken == 0),
        KeyFigure("files read back", "as planned" if same else "DIFFERENT", same),
    ]


def _overview(job: "Job", shots: dict[str, bytes]) -> Section:
    text = (
        "Two lithography steps: the pillar layer (with marks, label, dose-test array and witness cells) and the "
        "aperture layer, which draws the openings of the opaque film. The F stands in the upper left "
        "corner. The mask is seen from the pillar side, against the light, in the coordinates of the lens: +y is up "
        "here, so the first row of the diameter map is the lowest."
    )
    items = [
        Figure(shots["die.png"], "The whole die. Colour: drawn diameter.", wide=True),
        Figure(shots["pillars.png"], "Polygons as they are written, in the middle and at the rim.", wide=True),
    ]
    return Section("Die", text, items)


def _rules(job: "Job", shots: dict[str, bytes]) -> Section:
    found = job.drc
    rows = [[rule, found.limits[rule], count] for rule, count in found.counts.items()]
    items: list[Figure | Table] = [
        Figure(shots["margins.png"], "What was found (bar) beside what is allowed (line).", wide=True),
        Table(("rule", "limit", "violations"), rows, "Checked on the drawn polygons, all pillars."),
    ]
    if found.violations:
        places = [
            [v.rule, f"({v.centre[0]:.0f}, {v.centre[1]:.0f})", v.value, v.limit, v.text] for v in found.violations[:50]
        ]
        head = ("rule", "(x, y) / nm", "found", "needed", "where")
        items.append(Table(head, places, "The first violations; mask.lyrdb marks up to 500 of each rule."))
    return Section("Design rules", found.summary + ".", items)


def _classes(job: "Job", shots: dict[str, bytes]) -> Section:
    shapes = {made.diameter_units: made for made in job.plan.classes}
    grid = job.plan.grid
    made = [polygon.PillarShape(shapes[d].outline / grid, d / grid) for d in sorted(shapes)]
    picked = np.unique(np.linspace(0, len(made) - 1, 12).round().astype(int))
    unit = grid * job.plan.unit_nm
    rows = [
        [m.diameter * unit, len(m.points), m.shots, f"{100 * m.area_error:+.3f}", m.edge_error * unit]
        for m in (made[i] for i in picked)
    ]
    worst = max(abs(m.area_error) for m in made)
    text = (
        f"Diameters are drawn in steps of {job.process.rules.diameter_step_nm} nm after the bias was taken off; "
        f"that rounds each by at most {job.made.cells.rounding_nm:g} nm. Polygons have the area of their circle to "
        f"{100 * worst:.3f} %."
    )
    head = ("diameter / nm", "vertices", "shots", "area error / %", "edge error / nm")
    picture = Figure(shots["diameters.png"], "Pillars of each diameter.", wide=True)
    items: list[Figure | Table] = [picture, Table(head, rows), _frontier(made, unit)]
    return Section("Pillars", text, items)


def _frontier(made: list[polygon.PillarShape], unit_nm: float) -> Table:
    """What other numbers of vertices would give and cost, for five of the diameters."""
    picked = np.unique(np.linspace(0, len(made) - 1, 5).round().astype(int))
    sizes = [made[i].diameter * unit_nm for i in picked]
    rows = [
        [p.shape, p.vertices, *(f"{v:.2f}" for v in (1e4 * p.area_error, p.edge_error_nm, p.corners, p.shots))]
        for p in polygon.frontier(sizes, grid_nm=unit_nm, vertices=(12, 16, 24, 32, 48, 64))
    ]
    head = ("shape", "at most", "area error / 1e-4", "edge error / nm", "vertices", "shots")
    return Table(head, rows, "Worst errors and mean cost of a pillar by number of vertices, on this grid.")


def _doses(job: "Job") -> Section | None:
    doses = job.made.dose
    if doses is None:
        return None
    rows = [
        ["one dose", 100 * doses.before.worst, 100 * doses.before.rms, doses.before.diameter_nm],
        [f"{len(doses.factors)} doses", 100 * doses.after.worst, 100 * doses.after.rms, doses.after.diameter_nm],
    ]
    head = ("", "worst / %", "rms / %", "diameter / nm")
    text = (
        f"Proximity correction: relative dose {doses.factors.min():.3f} to {doses.factors.max():.3f}, one datatype of "
        f"the pillar layer each. Exposure at the pillar edges is known to {100 * doses.error:.2g} %."
    )
    return Section("Dose", text, [Table(head, rows, "Error of the exposure at the pillar edges, and what it does.")])


def _fields(job: "Job") -> Section:
    split = job.fields
    text = (
        f"Fields that hold pillars: {split.used} ({split.mode}), {split.size_um[0]:.1f} by {split.size_um[1]:.1f} µm "
        f"at most; no border cuts a pillar: they keep {split.clearance_um / nm:.0f} nm. A raster centred on the axis "
        f"would have cut {split.cut_before:,} pillars."
    )
    return Section("Write fields", text)


def _files(job: "Job") -> Section:
    rows = []
    for name, size in job.written.items():
        outcome = job.compared.get(name)
        verdict = (
            "not read back" if outcome is None else ("as planned" if outcome.ok else "; ".join(outcome.differences))
        )
        rows.append([name, f"{size / 1e6:.3f}", verdict])
    times = [[stage, seconds] for stage, seconds in job.seconds.items()]
    items = [
        Table(("file", "MB", "read back and compared"), rows),
        Table(("stage", "seconds"), times, "On the machine that made the mask.", digits=3),
    ]
    return Section("Files", "Each mask file was read back: every pillar at its site, every polygon vertex.", items)
