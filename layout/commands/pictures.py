"""Pictures of a mask for its report: the die, and its exposure."""

from typing import Any

import numpy as np

from layout.drc.report import DrcReport
from layout.mask.plan import MaskPlan
from layout.shapes import rectilinear
from layout.verify.report import ExposureReport
from metalens.core import report
from metalens.core.arrays import Array

_FILLED = ("marks", "label")
_COLOURS = ("#d1495b", "#355070", "#1f6feb", "#888", "#2a9d8f")


def plot_die(plan: MaskPlan, drc_report: DrcReport) -> bytes:
    """Everything on the die as PNG: figures by layer number, lattices as boxes.

    Args:
        plan: of the mask.
        drc_report: whose violations are marked by crosses.
    """
    from matplotlib.collections import PolyCollection

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
        style: dict[str, Any] = {"facecolors": fill, "edgecolors": colour, "lw": 0.8}
        axes.add_collection(PolyCollection([p * scale for p in shapes], **style))
        axes.plot([], [], color=colour, label=name)
    if drc_report.violations:
        places = np.array([violation.centre for violation in drc_report.violations])
        axes.plot(*places.T * scale, "x", color="red", ms=4, mew=1, label="violations")
    axes.autoscale_view()
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.09), ncols=6, fontsize=8)
    axes.set(aspect="equal", xlabel="x / µm", ylabel="y / µm")
    return report.figure_png(figure)


def plot_verification(verification: ExposureReport) -> bytes:
    """Difference of resist and drawn diameters over the die, and its histogram, as PNG.

    Args:
        verification: of the written mask.
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
