"""Edges that face each other too near, entered into a report: all counted, the first of
them listed with a box.
"""

from collections.abc import Iterator

import numpy as np

from layout.rules import edges as facing
from layout.rules.report import DrcReport, Violation
from metalens.ground.arrays import Array

Limits = tuple[
    tuple[str, float], tuple[str, float]
]  # (rule, nm) of widths and of spaces


def entered(
    report: DrcReport, edges: Array, found: Array, limits: Limits, text: str
) -> None:
    """Enter pairs that face each other.

    Args:
        edges: (m, 4) edges. found: (n, 4) pairs of them, as
            :func:`layout.rules.edges.facing` gives.
    """
    for kind, (rule, limit) in zip((facing.WIDTH, facing.SPACE), limits, strict=True):
        some = found[found[:, 2] == kind]
        report.add_all(
            rule, len(some), _shown(some, edges, report.unit_nm, rule, limit, text)
        )
        least = float(some[:, 3].min(initial=np.inf)) * report.unit_nm
        if rule == "feature":
            report.minimum_feature_nm = min(report.minimum_feature_nm, least)
        else:
            report.minimum_gap_nm = min(report.minimum_gap_nm, least)


def _shown(
    found: Array, edges: Array, unit_nm: float, rule: str, limit: float, text: str
) -> Iterator[Violation]:
    for row in found:
        corners = edges[row[:2].astype(np.int64)].reshape(4, 2)
        box = (*corners.min(0).tolist(), *corners.max(0).tolist())
        yield Violation(rule, box, float(row[3]) * unit_nm, limit, text)
