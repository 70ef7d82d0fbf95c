"""Pictures of a mask for its report: the die, its exposure, the wafer."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from layout.arrange import assembly, separation
from layout.arrange.record import WaferSettings
from layout.arrange.wafer import WaferDies
from layout.drc.report import DrcReport, RuleViolation
from layout.mask.plan import MaskPlan
from layout.shapes import rectilinear
from layout.verify.report import ExposureReport
from metalens.core import report
from metalens.core.arrays import Array

_FILLED = ("marks", "label")
_COLOURS = ("#d1495b", "#355070", "#1f6feb", "#888", "#2a9d8f")


def _add_polygons(axes: Any, corners: list[Array], fill: str, edge: str) -> None:
    """Polygons in one colour on matplotlib axes."""
    from matplotlib.collections import PolyCollection

    style: dict[str, Any] = {"facecolors": fill, "edgecolors": edge, "lw": 0.8}
    axes.add_collection(PolyCollection(corners, **style))


def plot_die(plan: MaskPlan, drc_report: DrcReport) -> bytes:
    """Everything on the die as PNG: figures by layer number, lattices as boxes.

    Args:
        plan: of the mask.
        drc_report: whose violations are marked by crosses.
    """
    figure, axes = report.make_figure(size=(7.2, 6.6))
    scale = plan.unit_nm * 1e-3
    drawn: dict[str, list[Array]] = {
        "pillars": [rectilinear.box_corners(lattice.box) for lattice in plan.lattices]
    }
    for cell in plan.figures:
        for layer, polygons in sorted(cell.polygons.items()):
            name = plan.layer_names.get(layer, "layer").split("_dose_")[0]
            drawn.setdefault(f"{name} {layer[0]}", []).extend(polygons)
    for n, (name, shapes) in enumerate(drawn.items()):
        colour = _COLOURS[n % len(_COLOURS)]
        fill = colour if name.startswith(_FILLED) else "none"
        _add_polygons(axes, [p * scale for p in shapes], fill, colour)
        axes.plot([], [], color=colour, label=name)
    if drc_report.violations:
        places = np.array([violation.centre for violation in drc_report.violations])
        axes.plot(*places.T * scale, "x", color="red", ms=4, mew=1, label="violations")
    axes.autoscale_view()
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.09), ncols=6, fontsize=8)
    axes.set(aspect="equal", xlabel="x / µm", ylabel="y / µm")
    return report.figure_png(figure)


def plot_verification(verification: ExposureReport) -> bytes:
    """Difference of resist and drawn diameters over the die as PNG.

    Args:
        verification: of a written mask.
    """
    figure, axes = report.make_figure(size=(5.2, 4.2))
    left, bottom, right, top = verification.box_um
    extent = (left, right, bottom, top)
    picture = axes.imshow(
        verification.map_nm, origin="lower", extent=extent, cmap="coolwarm"
    )
    axes.grid(False)
    axes.set(xlabel="x / µm", ylabel="y / µm", title="mean over a picture point")
    figure.colorbar(picture, ax=axes, label="resist - drawn / nm", shrink=0.8)
    return report.figure_png(figure)


# arrangements


def plot_floorplan(
    placed: Sequence[assembly.PartPlacement], near: Sequence[RuleViolation]
) -> bytes:
    """Boxes of the parts of a die by exposure as PNG; crosses where they are too near.

    Args:
        placed: parts on the die.
        near: places where they are too near each other.
    """
    figure, axes = report.make_figure(size=(7.2, 6.6))
    axes.grid(False)
    for part in separation.standing_parts(placed):
        for colour, boxes in zip(_COLOURS, part.part.boxes.values(), strict=False):
            shapes = [rectilinear.box_corners(box) for box in part.moved(boxes)]
            corners = [shape / assembly.PER_UM for shape in shapes]
            _add_polygons(axes, corners, f"{colour}55", "none")
        x, y = part.x / assembly.PER_UM, part.y / assembly.PER_UM
        axes.annotate(part.part.name, (x, y), fontsize=7, ha="center", va="center")
    if near:
        x, y = np.array([violation.centre for violation in near]).T / assembly.PER_UM
        axes.plot(x, y, "x", color="red", ms=6, mew=1.5)
    box = separation.extent_um(placed)
    left, bottom, right, top = box.tolist()
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axes.set(xlabel="x / µm", ylabel="y / µm")
    return report.figure_png(figure)


def plot_wafer(size: WaferSettings, dies: WaferDies, box_um: Array) -> bytes:
    """Dies and marks of a wafer as PNG.

    Args:
        size: of the wafer.
        dies: that it holds.
        box_um: (4,) left, bottom, right, top of a die.
    """
    figure, ax = report.make_figure(size=(6.4, 6.2))
    corner = rectilinear.box_corners(box_um / 1e3)
    shapes = list(dies.place_um[:, None] / 1e3 + corner)
    _add_polygons(ax, shapes, "#1f6feb55", "#355070")
    turn = np.linspace(0, 2 * np.pi, 400)
    radius = size.diameter_mm / 2
    for r, line in ((radius, "-"), (radius - size.edge_exclusion_mm, ":")):
        ax.plot(r * np.cos(turn), r * np.sin(turn), line, color="#444", lw=1)
    for mark in size.marks:
        ax.plot(mark.x_mm, mark.y_mm, "+", color="#d1495b", ms=9)
    ax.set(aspect="equal", xlabel="x / mm", ylabel="y / mm")
    return report.figure_png(figure)
