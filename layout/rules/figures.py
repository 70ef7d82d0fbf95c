"""Widths and spaces of the fixed figures of a die: marks, labels, verniers, the openings of the aperture."""

import numpy as np

from layout.mask import MaskPlan
from layout.process import Rules
from layout.rules import edges as facing
from layout.rules.report import DrcReport, Violation
from layout.shapes import region
from metalens.ground.arrays import Array

UNDRAWN = ("OUTLINE", "FIELDS")  # figures for people: no resist sees them


def figures_kept(plan: MaskPlan, rules: Rules, report: DrcReport) -> None:
    """Least width and space of each layer number of the figures, pieces of all doses together, edge against edge."""
    layers: dict[int, list[Array]] = {}
    for figure in plan.figures:
        if figure.name not in UNDRAWN:
            for layer, drawn in figure.polygons.items():
                layers.setdefault(layer[0], []).extend(np.asarray(p, np.int64) for p in drawn)
    for number, polygons in layers.items():
        _layer(region.union(polygons), number, rules, report)


def _layer(contours: list[Array], number: int, rules: Rules, report: DrcReport) -> None:
    lines = [np.hstack([c, np.roll(c, -1, axis=0)]) for c in contours]
    if not lines:
        return
    edge, unit = np.concatenate(lines), report.unit_nm
    shape = np.zeros(len(edge), np.int64)  # holes belong to what is around them
    found = facing.facing(edge, shape, rules.minimum_feature_nm / unit, rules.minimum_gap_nm / unit)
    for a, b, kind, away in found.tolist():
        corners = np.concatenate([edge[int(a)].reshape(2, 2), edge[int(b)].reshape(2, 2)])
        box = (*corners.min(0).tolist(), *corners.max(0).tolist())
        rule, limit = ("feature", rules.minimum_feature_nm) if kind == facing.WIDTH else ("gap", rules.minimum_gap_nm)
        report.add(rule, 1, Violation(rule, box, away * unit, limit, f"figures of layer {number}"))
        if kind == facing.WIDTH:
            report.minimum_feature_nm = min(report.minimum_feature_nm, away * unit)
        else:
            report.minimum_gap_nm = min(report.minimum_gap_nm, away * unit)
