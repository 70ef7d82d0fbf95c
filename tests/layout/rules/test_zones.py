"""Exclusion zones by clipping each pillar, and structures of a die by the distances of
all their boxes.
"""

import itertools
import math

import numpy as np

from layout.mask import MaskPlan
from layout.mask.plan import Figure, Lattice, PillarClass
from layout.process import Rules, Zone
from layout.rules import zones
from layout.rules.report import DrcReport

RNG = np.random.default_rng(31)
WEDGES = (
    np.array([[-70, -20], [50, -60], [90, 10], [20, 80]]),
    np.array([[-30, -110], [40, -10], [-60, 30]]),
    np.array([[-20, -20], [20, -20], [20, 20], [-20, 20]]),
)  # anticlockwise, none symmetric but the last
CLASSES = tuple(
    PillarClass(f"D{k}", 100.0 + k, 50, (1, k), outline)
    for k, outline in enumerate(WEDGES)
)


def lattice(name, classes, *, x0, y0):
    """410 units from column to column, 365 from row to row."""
    rows, columns = classes.shape
    return Lattice(
        name,
        rows,
        columns,
        410,
        x0,
        y0,
        lambda a, b: classes[a:b],
        classes,
        row_pitch=365,
    )


def shared(outline, box):
    """Area that a convex outline has in common with a box (left, bottom, right, top):
    cut by one side after another.
    """
    corners = outline.astype(float)
    for axis, sign, limit in (
        (0, 1, box[0]),
        (1, 1, box[1]),
        (0, -1, box[2]),
        (1, -1, box[3]),
    ):
        depth, kept = sign * (corners[:, axis] - limit), []
        for k in range(len(corners)):
            a, b = corners[k - 1], corners[k]
            if depth[k - 1] * depth[k] < 0:
                kept.append(a + (b - a) * depth[k - 1] / (depth[k - 1] - depth[k]))
            if depth[k] >= 0:
                kept.append(b)
        if len(kept) < 3:
            return 0.0
        corners = np.array(kept)
    x, y = corners.T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2


def test_pillars_that_share_area_with_a_zone_are_counted_and_shown_in_their_boxes():
    """Two lattices with rows closer than columns, units of 2 nm; zones smaller than a
    pillar, between them, over many
    sites and beyond the lens."""
    plan = MaskPlan(
        "TOP",
        CLASSES,
        (
            lattice(
                "LENS", RNG.integers(0, 4, (7, 9)).astype(np.uint8), x0=-1640, y0=1095
            ),
            lattice(
                "TEST", RNG.integers(0, 4, (3, 5)).astype(np.uint8), x0=4000, y0=-300
            ),
        ),
        unit_nm=2.0,
    )
    seen = 0
    for _ in range(80):
        low, size = (
            RNG.uniform((-4.5, -3.5), (10.5, 2.5)),
            RNG.choice([0.05, 0.9, 2.3, 5.0], 2) * RNG.uniform(0.3, 1),
        )
        zone = Zone(*low, *size, name="pad")
        box = (
            low[0] * 500,
            low[1] * 500,
            (low[0] + size[0]) * 500,
            (low[1] + size[1]) * 500,
        )
        want = set()
        for part in plan.lattices:
            for row, column in np.argwhere(part.array):
                outline = WEDGES[part.array[row, column] - 1] + (
                    part.x0 + 410 * column,
                    part.y0 - 365 * row,
                )
                if shared(outline, box) > 0:
                    want.add((*outline.min(0).tolist(), *outline.max(0).tolist()))
        rules = Rules(exclusion=(zone,))
        report = DrcReport.empty(plan, rules)
        zones.in_zones(plan, rules, report, 1000)
        assert report.counts["exclusion"] == len(want)
        assert {violation.box for violation in report.violations} == want
        assert all(
            violation.text.endswith(" in pad") for violation in report.violations
        )
        few = DrcReport.empty(plan, rules)
        zones.in_zones(plan, rules, few, 3)
        assert len(few.violations) == min(3, len(want))
        assert few.counts["exclusion"] == len(want)
        seen += len(want) > 1
    assert seen > 10


def test_every_two_structures_are_a_gap_apart_box_to_box():
    """Marks and a label around a lens in units of 2 nm: distances of all boxes of
    unlike structures, corners aslant;
    what is not exposed lies over them, and shapes of one structure may touch."""
    rules = Rules(minimum_gap_nm=140.0)
    classes = np.ones((4, 6), np.uint8)
    lens = lattice("LENS", classes, x0=-1025, y0=547)
    around = (
        -1025 - 110,
        547 - 3 * 365 - 110,
        -1025 + 5 * 410 + 110,
        547 + 110,
    )  # 110: farthest corner of a class
    for _ in range(40):
        figures, boxes = [], {"LENS": [around]}
        for name, count in (("MARKS", 6), ("LABEL", 5), ("OUTLINE", 3)):
            low = RNG.integers((-1700, -1200), (1600, 1000), (count, 2))
            size = RNG.integers(20, 300, (count, 2))
            boxes[name] = [
                (*a.tolist(), *(a + b).tolist()) for a, b in zip(low, size, strict=True)
            ]
            corners = [
                np.array([[a, b], [c, b], [c, d], [a, d]]) for a, b, c, d in boxes[name]
            ]
            figures.append(
                Figure(name, {(3, 0): tuple(corners[:2]), (3, 1): tuple(corners[2:])})
            )
        plan = MaskPlan("TOP", CLASSES, (lens,), tuple(figures), unit_nm=2.0)
        want = []
        for one, two in itertools.combinations(("LENS", "MARKS", "LABEL"), 2):
            for a, b in itertools.product(boxes[one], boxes[two]):
                dx, dy = (max(a[i] - b[i + 2], b[i] - a[i + 2], 0) for i in (0, 1))
                if math.hypot(dx, dy) < 70:
                    joined = (
                        min(a[0], b[0]),
                        min(a[1], b[1]),
                        max(a[2], b[2]),
                        max(a[3], b[3]),
                    )
                    want.append(
                        (joined, round(2 * math.hypot(dx, dy), 9), f"{one} to {two}")
                    )
        report = DrcReport.empty(plan, rules)
        zones.structures_apart(plan, rules, report)
        told = [(v.box, round(v.value, 9), v.text) for v in report.violations]
        assert sorted(told) == sorted(want)
        assert report.counts["structures"] == len(want) > 0
