"""Widths and spaces of the fixed figures of a die: marks, labels, verniers, the
openings of the aperture.
"""

import numpy as np

from layout.mask import UNDRAWN, MaskPlan, tone
from layout.process import Rules
from layout.rules import edges as facing
from layout.rules.entered import entered
from layout.rules.layer import plain
from layout.rules.report import DrcReport
from layout.shapes import region
from metalens.ground.arrays import Array


def figures_kept(plan: MaskPlan, rules: Rules, report: DrcReport) -> None:
    """Least width and space of each layer number of the figures, pieces of all doses
    together, edge against edge.
    """
    layers: dict[int, list[Array]] = {}
    for figure in plan.figures:
        if figure.name not in UNDRAWN:
            for layer, drawn in figure.polygons.items():
                layers.setdefault(layer[0], []).extend(
                    np.asarray(p, np.int64) for p in drawn
                )
    limits = rules.minimum_feature_nm, rules.minimum_gap_nm
    for number, polygons in layers.items():
        _facing(region.union(polygons), limits, f"figures of layer {number}", report)


def frame_kept(plan: MaskPlan, rules: Rules, report: DrcReport) -> None:
    """A negative tone: what is drawn around the lattices is as wide as a gap, what it
    spares as wide as a feature.

    Squares of empty sites are whole lattice squares beside others; they cannot be
    narrower than the pitch.
    """
    drawn = [tone.lattice_box(lattice, plan.grid) for lattice in plan.lattices]
    outside = {
        layer
        for figure in plan.figures
        if figure.name == "APERTURE"
        for layer in figure.polygons
    }
    for figure in plan.figures:
        if figure.name not in (*UNDRAWN, "CLEAR"):
            drawn += [
                p
                for layer, shapes in figure.polygons.items()
                if layer not in outside
                for p in shapes
            ]
    limits = rules.minimum_gap_nm, rules.minimum_feature_nm
    _facing(
        region.union(drawn),
        limits,
        "frame of the negative tone",
        report,
        rules=("gap", "feature"),
    )


def _facing(
    contours: list[Array],
    limits: tuple[float, float],
    text: str,
    report: DrcReport,
    *,
    rules: tuple[str, str] = ("feature", "gap"),
) -> None:
    """Widths and spaces of contours below their limits, as violations of the two rules."""
    whole = [
        plain(c) for c in contours
    ]  # an edge is one, of however many pieces it is made
    lines = [np.hstack([c, np.roll(c, -1, axis=0)]) for c in whole]
    if not lines:
        return
    edge, unit = np.concatenate(lines), report.unit_nm
    shape = np.zeros(len(edge), np.int64)  # holes belong to what is around them
    found = facing.facing(edge, shape, limits[0] / unit, limits[1] / unit)
    entered(report, edge, found, ((rules[0], limits[0]), (rules[1], limits[1])), text)
