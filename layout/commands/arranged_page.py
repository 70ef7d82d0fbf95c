"""report.html of an arrangement: what stands where on the die, its doses, counts and
checks.
"""

from typing import Any

import numpy as np

from layout.arrange import apart, joined, seen
from layout.commands.placed import FloorplanWork
from layout.drc import format_size
from layout.formats import MaskAssembly, handover
from layout.shapes import rectilinear
from metalens.core import report
from metalens.core.arrays import Array
from metalens.core.report import Figure, KeyFigure, Section, Table

_POINTS = 600  # of the picture, each way
_LISTED = 60


def write_floorplan_page(work: FloorplanWork, made: MaskAssembly) -> None:
    """Write report.html and die.png (and wafer.png) beside the masks."""
    box = apart.extent_of_copies(work.placed)
    die = _die(work, box)
    (work.folder / "die.png").write_bytes(die)
    items: list[Figure | Table] = [
        Figure(die, "Share of the area that is covered, averaged.", wide=True),
        _places(work),
    ]
    sections = [Section("Die", _text(work), items)]
    if work.dies is not None:
        shot = _wafer(work, box)
        (work.folder / "wafer.png").write_bytes(shot)
        text = f"{len(work.dies.index):,} whole dies; dies.csv lists them."
        sections.append(
            Section(
                "Wafer",
                text,
                [Figure(shot, "Dies within the edge exclusion, and marks.", wide=True)],
            )
        )
    sections += [_checks(work), _doses(work, made), _files(work)]
    figures = [
        KeyFigure("parts", str(len(work.placed))),
        KeyFigure("dies", f"{1 if work.dies is None else len(work.dies.index):,}"),
        KeyFigure("doses", str(len(made.doses))),
        KeyFigure("what fails", str(len(work.failures)), not work.failures),
    ]
    report.write_report(
        work.folder / "report.html",
        f"Mask {made.name}",
        sections,
        lead=f"{work.verdict} {_lead(work)}",
        key_figures=figures,
    )


def _lead(work: FloorplanWork) -> str:
    pillars = sum(
        values["pillars"] * _number(work, name) for name, values in work.lenses.items()
    )
    return f"{len(work.lenses)} lenses with {pillars:,} pillars on a die; process “{work.process.name}”."


def _number(work: FloorplanWork, name: str) -> int:
    """Copies of a part on the die."""
    return sum(
        c.count
        for one in work.placed
        if one.part.name == name
        for c in one.copies(one.part.top)
    )


def _text(work: FloorplanWork) -> str:
    notes = " ".join(f"{note}." for note in work.notes)
    return f"Seen from the pillar side, +y up, as a microscope of the picture's resolution sees it. {notes}".strip()


def _die(work: FloorplanWork, box: Array) -> bytes:
    view = seen.DensityView.over(box, _POINTS)
    images = seen.coverage_map(work.placed, work.process, view)
    count = max(1, len(images))
    figure, axes = report.make_figure(1, count, size=(6.4 * count, 5.6), squeeze=False)
    x, y = (
        (low, low + n * view.side)
        for low, n in ((view.left, view.columns), (view.bottom, view.rows))
    )
    for ax, (kind, image) in zip(axes[0], sorted(images.items()), strict=False):
        extent = [v / joined.PER_UM for v in (*x, *y)]
        shown = ax.imshow(
            100 * image,
            origin="lower",
            extent=extent,
            cmap="viridis",
            interpolation="nearest",
        )
        ax.grid(False)
        ax.set(xlabel="x / µm", ylabel="y / µm", title=kind)
        figure.colorbar(shown, ax=ax, label="area covered / %", shrink=0.8)
        _named(ax, work)
    return report.figure_png(figure)


def _named(ax: Any, work: FloorplanWork) -> None:
    """Names of the parts where they stand, and crosses where they are too near."""
    for one in work.placed:
        for at in one.at[:_LISTED]:
            ax.annotate(
                one.part.name,
                (at.x_um, at.y_um),
                color="white",
                fontsize=7,
                ha="center",
                va="center",
            )
    if work.near:
        x, y = np.array([v.centre for v in work.near]).T / joined.PER_UM
        ax.plot(x, y, "x", color="red", ms=6, mew=1.5)


def _wafer(work: FloorplanWork, box: Array) -> bytes:
    from matplotlib.collections import PolyCollection

    size, dies = work.record.wafer, work.dies
    if size is None or dies is None:
        return b""
    figure, ax = report.make_figure(size=(6.4, 6.2))
    corner = rectilinear.box_corners(box / joined.PER_UM / 1e3)
    ax.add_collection(
        PolyCollection(
            list(dies.place_um[:, None] / 1e3 + corner),
            facecolors="#1f6feb55",
            edgecolors="#355070",
            linewidths=0.4,
        )
    )
    turn, radius = np.linspace(0, 2 * np.pi, 400), size.diameter_mm / 2
    for r, style in ((radius, "-"), (radius - size.edge_exclusion_mm, ":")):
        ax.plot(r * np.cos(turn), r * np.sin(turn), style, color="#444", lw=1)
    for mark in size.marks:
        ax.plot(mark.x_mm, mark.y_mm, "+", color="#d1495b", ms=9)
    ax.set(aspect="equal", xlabel="x / mm", ylabel="y / mm")
    return report.figure_png(figure)


def _places(work: FloorplanWork) -> Table:
    files = {part.name: str(part.file) for part in work.record.lens}
    files |= {part.name: str(part.file) for part in work.record.cell}
    rows = []
    for one in work.placed:
        left, bottom, right, top = (one.part.extent / joined.PER_UM).tolist()
        for at in one.at:
            turned = f"{at.turn_deg:g}{' mirrored' if at.mirrored else ''}"
            size = f"{right - left:.3f} x {top - bottom:.3f}"
            rows.append(
                [
                    one.part.name,
                    files.get(one.part.name, "own"),
                    at.x_um,
                    at.y_um,
                    turned,
                    at.columns * at.rows,
                    size,
                ]
            )
    head = ("part", "file", "x / µm", "y / µm", "turn / degrees", "copies", "size / µm")
    most = (
        f"The first {_LISTED} of {len(rows)} places."
        if len(rows) > _LISTED
        else "Where each part stands."
    )
    return Table(head, rows[:_LISTED], most, digits=8)


def _checks(work: FloorplanWork) -> Section:
    """Rules, exposure and read-back of each part, and what stands too near what."""
    rows = [_lens_row(name, values) for name, values in work.lenses.items()]
    for name, found in work.rules.items():
        broken = sum(found.counts.values())
        sizes = [
            f"{found.shapes:,}",
            format_size(found.minimum_space_nm),
            format_size(found.minimum_width_nm),
            broken,
        ]
        rows.append([name, *sizes, "", "", "FAILS" if broken else "passes"])
    rows += [[name, *[""] * 6, "NOT CHECKED"] for name in work.unchecked]
    head = (
        "part",
        "shapes",
        "least gap",
        "least feature",
        "broken rules",
        "exposure",
        "read back",
        "verdict",
    )
    items: list[Figure | Table] = [
        Table(
            head, rows, "Each lens has a report of its own, in the folder of its name."
        )
    ]
    if work.near:
        near = [[v.text, v.value / 1e3, v.limit / 1e3] for v in work.near[:_LISTED]]
        items.append(
            Table(
                ("what", "apart / µm", "needed / µm"),
                near,
                "Parts that stand too near each other.",
            )
        )
    return Section("Checks", _verdicts(work), items)


def _verdicts(work: FloorplanWork) -> str:
    """What fails and what was not checked, in words."""
    said = list(work.failures)
    said += [
        f"NOT CHECKED: the design rules of {name} (checked = false)."
        for name in work.unchecked
    ]
    if not work.failures:
        who = "Every part that was checked" if work.unchecked else "Every part"
        said.append(
            f"{who} is within the design rules, and all stand far enough from each other."
        )
    return "\n\n".join(said)


def _lens_row(name: str, values: dict[str, Any]) -> list[Any]:
    """Of layout.json of a lens."""
    exposed = [
        f"{100 * e['worst_relative']:.2f} %, {e['worst_diameter_nm']:.2f} nm"
        for e in values["exposure"].values()
    ]
    same = "DIFFERENT" if any(values["differences"].values()) else "as planned"
    sizes = [
        f"{values['pillars']:,}",
        format_size(values["minimum_space_nm"]),
        format_size(values["minimum_width_nm"]),
    ]
    found = [
        sum(values["violations"].values()),
        exposed[0] if exposed else "not verified",
        same,
    ]
    return [name, *sizes, *found, "passes" if values["ok"] else "FAILS"]


def _doses(work: FloorplanWork, made: MaskAssembly) -> Section:
    base = work.process.exposure.base_uC_cm2
    rows = [
        [*layer, f"{dose:.6f}", dose * base, made.layer_names.get(layer, "")]
        for layer, dose in sorted(made.doses.items())
    ]
    head = ("layer", "datatype", "relative dose", "µC/cm²", "name")
    charges = handover.charge_uC(work.areas_um2, made.doses, work.process)
    charge = Table(
        ("step", "charge / µC", "hours at 1 nA"),
        [[step, f"{q:.4g}", f"{q / 3.6:.3g}"] for step, q in charges.items()],
        "Of the whole mask, without stage and settling times.",
    )
    return Section(
        "Dose",
        "One dose for each layer and datatype, as in doses.csv; write fields of the "
        "lenses in fields.csv.",
        [charge, Table(head, rows)],
    )


def _files(work: FloorplanWork) -> Section:
    written = work.written.items()
    rows = [
        [n, f"{s / 1e6:.3f}", "DIFFERENT" if n in work.unlike else "as planned"]
        for n, s in written
    ]
    times = [[stage, seconds] for stage, seconds in work.stages.seconds.items()]
    items = [
        Table(("file", "MB", "read back"), rows),
        Table(("stage", "seconds"), times, digits=3),
    ]
    return Section(
        "Files", "Each file was read back: every cell, shape and copy.", items
    )
