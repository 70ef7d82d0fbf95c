"""Pictures of a mask for its report: the die, its exposure, the wafer."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from layout.arrange import assembly, separation
from layout.arrange.record import WaferSettings
from layout.arrange.wafer import WaferDies
from layout.drc.report import DrcReport, Violation
from layout.mask.plan import MaskPlan, PillarArray
from layout.shapes import rectilinear
from layout.verify.report import ExposureReport
from metalens.core import report
from metalens.core.arrays import Array

_FILLED = ("marks", "label")
_COLOURS = ("#d1495b", "#355070", "#1f6feb", "#888", "#2a9d8f")
_POINTS = 700  # of a picture, each way


def plot_die(plan: MaskPlan, drc_report: DrcReport) -> bytes:
    """Everything on the die as PNG; lattices as the share of the area that pillars
    cover, violations as crosses.

    Args:
        plan: of the die.
        drc_report: its design-rule check.
    """
    figure, axes = report.make_figure(size=(7.2, 6.6))
    axes.grid(False)
    scale = plan.unit_nm * 1e-3
    images = [_coverage(plan, lattice) for lattice in plan.lattices]
    shares = np.concatenate([image[np.isfinite(image)] for image in images])
    picture, reach = None, 0.0
    for lattice, image in zip(plan.lattices, images, strict=True):
        left = lattice.x0 - lattice.pitch / 2
        top = lattice.y0 + lattice.down / 2
        right = left + lattice.columns * lattice.pitch
        bottom = top - lattice.rows * lattice.down
        extent = np.array([left, right, bottom, top]) * scale
        reach = max(reach, float(np.abs(extent).max()))
        picture = axes.imshow(
            image,
            extent=extent.tolist(),
            vmin=shares.min(initial=50),
            vmax=shares.max(initial=50),
            cmap="viridis",
            interpolation="nearest",
        )
    reach = max(reach, _draw_figures(axes, plan, scale))
    if drc_report.violations:
        x, y = (
            np.array([violation.centre for violation in drc_report.violations]).T
            * scale
        )
        axes.plot(x, y, "x", color="red", ms=4, mew=1, label="violations")
    if axes.get_legend_handles_labels()[0]:
        place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.09)}
        axes.legend(**place, ncols=6, frameon=False, fontsize=8)
    span = (-1.03 * reach, 1.03 * reach)
    axes.set(xlim=span, ylim=span, aspect="equal", xlabel="x / µm", ylabel="y / µm")
    if picture is not None:
        figure.colorbar(
            picture, ax=axes, label="area that pillars cover / %", shrink=0.8
        )
    return report.figure_png(figure)


def plot_verification(verification: ExposureReport) -> bytes:
    """Difference of resist and drawn diameters over the die, and its histogram, as PNG.

    Args:
        verification: of a written mask.
    """
    figure, (at_left, at_right) = report.make_figure(1, 2, size=(8.2, 3.6))
    left, bottom, right, top = verification.box_um
    extent = (left, right, bottom, top)
    picture = at_left.imshow(
        verification.map_nm, origin="lower", extent=extent, cmap="coolwarm"
    )
    at_left.grid(False)
    at_left.set(xlabel="x / µm", ylabel="y / µm", title="mean over a picture point")
    figure.colorbar(picture, ax=at_left, label="resist - drawn / nm", shrink=0.8)
    edges, pillars = verification.histogram
    at_right.stairs(pillars, edges, fill=True)
    at_right.set(xlabel="resist - drawn diameter / nm", ylabel="pillars", yscale="log")
    return report.figure_png(figure)


def _coverage(plan: MaskPlan, lattice: PillarArray) -> Array:
    """(rows, columns) share of the area that pillars cover, per cent, averaged over
    squares of sites; NaN where there is none. Every n-th pillar would show moiré rings.
    """
    step = max(1, -(-max(lattice.rows, lattice.columns) // _POINTS))
    areas = np.array([0.0, *(pillar.twice_area / 2 for pillar in plan.classes)])
    percent_of_class = 100 * areas / (lattice.pitch * lattice.down)
    edges = np.arange(0, lattice.columns, step)
    rows = []
    for _, block in lattice.blocks(step):
        sites = len(block) * np.diff(np.r_[edges, lattice.columns])
        rows.append(np.add.reduceat(percent_of_class[block].sum(0), edges) / sites)
    covered = np.array(rows)
    return np.where(covered > 0, covered, np.nan)


def _draw_figures(axes: Any, plan: MaskPlan, scale: float) -> float:
    """Draw figures, all doses of a layer number together; how far they reach, um."""
    from matplotlib.collections import PolyCollection

    drawn: dict[int, list[Array]] = {}
    names: dict[int, str] = {}
    for figure in plan.figures:
        for layer, polygons in sorted(figure.polygons.items()):
            drawn.setdefault(layer[0], []).extend(
                polygon * scale for polygon in polygons
            )
            names.setdefault(layer[0], plan.layer_names.get(layer, "layer"))
    for n, (number, shapes) in enumerate(sorted(drawn.items())):
        name = names[number].split("_dose_")[0]
        colour = _COLOURS[n % len(_COLOURS)]
        fill, edge = (colour, "none") if name in _FILLED else ("none", colour)
        style: dict[str, Any] = {
            "facecolors": fill,
            "edgecolors": edge,
            "linewidths": 0.8,
        }
        axes.add_collection(PolyCollection(shapes, **style))
        axes.plot([], [], color=colour, label=f"{name} {number}")
    reaches = [
        float(np.abs(polygon).max()) for shapes in drawn.values() for polygon in shapes
    ]
    return max(reaches, default=0.0)


# arrangements


def plot_floorplan(
    placed: Sequence[assembly.PartPlacement], near: Sequence[Violation]
) -> bytes:
    """Boxes of the parts of a die by exposure as PNG; crosses where they are too near.

    Args:
        placed: parts on the die.
        near: places where they are too near each other.
    """
    from matplotlib.collections import PolyCollection

    figure, axes = report.make_figure(size=(7.2, 6.6))
    axes.grid(False)
    for part in separation.standing_parts(placed):
        for colour, boxes in zip(_COLOURS, part.part.boxes.values(), strict=False):
            shapes = [rectilinear.box_corners(box) for box in part.moved(boxes)]
            corners = [shape / assembly.PER_UM for shape in shapes]
            style: dict[str, Any] = {"facecolors": f"{colour}55", "edgecolors": "none"}
            axes.add_collection(PolyCollection(corners, **style))
        x, y = part.x / assembly.PER_UM, part.y / assembly.PER_UM
        axes.annotate(part.part.name, (x, y), fontsize=7, ha="center", va="center")
    if near:
        x, y = np.array([violation.centre for violation in near]).T / assembly.PER_UM
        axes.plot(x, y, "x", color="red", ms=6, mew=1.5)
    box = separation.extent_of_copies(placed) / assembly.PER_UM
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
    from matplotlib.collections import PolyCollection

    figure, ax = report.make_figure(size=(6.4, 6.2))
    corner = rectilinear.box_corners(box_um / 1e3)
    shapes = list(dies.place_um[:, None] / 1e3 + corner)
    style: dict[str, Any] = {
        "facecolors": "#1f6feb55",
        "edgecolors": "#355070",
        "linewidths": 0.4,
    }
    ax.add_collection(PolyCollection(shapes, **style))
    turn = np.linspace(0, 2 * np.pi, 400)
    radius = size.diameter_mm / 2
    for r, line in ((radius, "-"), (radius - size.edge_exclusion_mm, ":")):
        ax.plot(r * np.cos(turn), r * np.sin(turn), line, color="#444", lw=1)
    for mark in size.marks:
        ax.plot(mark.x_mm, mark.y_mm, "+", color="#d1495b", ms=9)
    ax.set(aspect="equal", xlabel="x / mm", ylabel="y / mm")
    return report.figure_png(figure)
