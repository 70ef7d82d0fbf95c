"""Rules on a mask made anywhere: pillars at any place and turn, shapes of any outline, checked layer by layer.

Shapes that touch are one shape, as a writer exposes them. Convex ones that stand alone are measured polygon to
polygon, those that can be near each other found by sorting their places; all others edge against edge.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from layout.files import MaskContent, Turn
from layout.process import Rules, compiled
from layout.rules import copies, near, nested
from layout.rules import edges as facing
from layout.rules import layer as layers
from layout.rules.layer import Layer
from layout.rules.report import MOST_SHOWN, DrcReport, Violation
from layout.shapes import convex, region
from metalens.ground.arrays import Array
from metalens.ground.errors import MaskFileError

MOST_SHAPES = 4_000_000  # that are checked or shown at once in less than 1 GB, however small the file
_EACH_BYTE = 4  # more of them for each byte: our densest masks, pillars of few sizes as OASIS arrays, hold 3.8
_AT_ONCE = 1 << 18  # shapes that are held to the grid at once
_ROUNDED = 1e-6  # of a step of a grid that is no whole number of units


def most_of(path: Path) -> int:
    """Shapes that a mask file is taken apart to, where its user sets no other limit."""
    return MOST_SHAPES + _EACH_BYTE * path.stat().st_size


def check(content: MaskContent, rules: Rules, *, skip: Sequence[int] = (), most: int = MOST_SHAPES) -> DrcReport:
    """Gap, feature and grid of every shape below the top cells, each layer number (all its datatypes) by itself.

    Large cells that are placed again and again are looked at once, but for what stands near other shapes: a wafer of
    one die takes little more than the die, and every copy is counted.

    Args:
        skip: layer numbers that are not drawn in the resist (outlines, write fields).
        most: shapes that are taken apart.

    Raises:
        MaskFileError: no top cell, a hierarchy that is broken, more than ``most`` shapes or 4e6
            pairs of shapes that can be closer than the rule.
    """
    if not content.tops:
        raise MaskFileError("the mask has no top cell: its cells place each other in a circle")
    parts = copies.found(content)
    copies.refuse_beyond(parts, content, most)
    parts = copies.with_places(parts, content)
    report = DrcReport.empty(content, rules)
    step, gap = (v / content.unit_nm for v in (rules.grid_nm, rules.minimum_gap_nm))
    whole, offsets = parts.times.keys() - {copies.ROOT}, parts.offsets(step)
    groups = {name: layers.groups(content, parts.tops(content, name), skip, whole) for name in parts.times}
    for number in sorted({number for some in groups.values() for number in some}):
        drawn = {name: layers.gathered(some.pop(number)) for name, some in groups.items() if number in some}
        for name, layer in nested.separate(parts, drawn, gap, most):
            report.pillars += len(layer.kind) * parts.times[name]
            own = DrcReport.empty(content, rules)
            _check_layer(layer, rules, own, f"layer {number}")
            _copied(report, own, parts.times[name], name, partial(parts.copies, name, MOST_SHOWN))
            for offset, times in offsets[name].items():
                own = DrcReport.empty(content, rules)
                _off_grid(layer, rules, own, offset)
                _copied(report, own, times, name, partial(parts.copies, name, MOST_SHOWN, step=step, offset=offset))
    return report


def _copied(
    report: DrcReport, own: DrcReport, times: int, name: str, places: Callable[[], list[tuple[Turn, int, int]]]
) -> None:
    """Enter what was found of a cell for all its copies; it is listed for the first of them, as far as lists go."""
    for rule, count in own.counts.items():
        report.counts[rule] += times * count
    report.minimum_gap_nm = min(report.minimum_gap_nm, own.minimum_gap_nm)
    report.minimum_feature_nm = min(report.minimum_feature_nm, own.minimum_feature_nm)
    shown = Counter(v.rule for v in report.violations)
    said = f"; in each of {times:,} copies of {name}" if name != copies.ROOT else ""
    for turn, x, y in places() if own.violations else []:
        listed = [v for v in own.violations if shown[v.rule] < MOST_SHOWN]
        if not listed:
            return
        boxes = turn.boxes(np.array([v.box for v in listed])) + np.array([x, y, x, y])
        for found, box in zip(listed, boxes.tolist(), strict=True):
            shown[found.rule] += 1
            if shown[found.rule] <= MOST_SHOWN:
                report.violations.append(dataclasses.replace(found, box=tuple(box), text=found.text + said))


def _check_layer(layer: Layer, rules: Rules, report: DrcReport, name: str) -> None:
    gap = rules.minimum_gap_nm / report.unit_nm
    one, two = near.pairs(layer.discs, gap)
    apart = layer.distances(one, two)
    touch = apart <= 0
    alone = np.array([layers.is_convex(o) for o in layer.outlines])[layer.kind]
    alone[one[touch]] = alone[two[touch]] = False
    _features(layer, alone, rules, report)
    both = alone[one] & alone[two] & (apart < gap - 1e-9)
    for a, b, value in zip(one[both].tolist(), two[both].tolist(), apart[both].tolist(), strict=True):
        text = f"{layer.cells[layer.kind[a]]} to {layer.cells[layer.kind[b]]}, {name}"
        value *= report.unit_nm
        report.add("gap", 1, Violation("gap", layer.box(a, b), value, rules.minimum_gap_nm, text))
    least = apart[both].min(initial=math.inf) * report.unit_nm  # of pairs further apart only some were looked at
    report.minimum_gap_nm = min(report.minimum_gap_nm, float(least))
    close = apart < gap
    beside = np.unique(np.concatenate([one[close & alone[one] & ~alone[two]], two[close & alone[two] & ~alone[one]]]))
    other = np.flatnonzero(~alone)
    if len(other):
        _by_edges(layer, _joined(other, one[touch], two[touch]), beside, rules, report, name)


def _joined(members: Array, one: Array, two: Array) -> list[list[int]]:
    """Members in groups that touch: pairs ``one`` and ``two`` do."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.searchsorted(members, one), np.searchsorted(members, two)
    graph = coo_matrix((np.ones(len(one), np.int8), ends), (len(members), len(members)))
    label = connected_components(graph, directed=False)[1]
    order = np.argsort(label, kind="stable")
    starts = np.flatnonzero(np.diff(label[order], prepend=-1))
    return [some.tolist() for some in np.split(members[order], starts[1:])]


def _features(layer: Layer, alone: Array, rules: Rules, report: DrcReport) -> None:
    """Widths of convex shapes that stand alone."""
    for kind in np.flatnonzero(counted(layer.kind, alone, np.zeros(len(layer.outlines), np.int64))).tolist():
        width = convex.width(layer.outlines[kind]) * report.unit_nm
        report.minimum_feature_nm = min(report.minimum_feature_nm, width)
        if width < rules.minimum_feature_nm - 1e-9:
            for n in np.flatnonzero((layer.kind == kind) & alone).tolist():
                text = layer.cells[kind]
                report.add("feature", 1, Violation("feature", layer.box(n), width, rules.minimum_feature_nm, text))


@compiled
def counted(kind: Array, alone: Array, out: Array) -> Array:
    """Shapes of each kind that stand alone, added to ``out``."""
    for n in range(kind.shape[0]):
        if alone[n]:
            out[kind[n]] += 1
    return out


def _by_edges(layer: Layer, groups: list[list[int]], beside: Array, rules: Rules, report: DrcReport, name: str) -> None:
    """Groups of shapes that are not convex or touch, as merged contours, with the convex shapes beside them."""
    lines, owner, lone = [], [], []
    for number, members in enumerate([*groups, *([n] for n in beside.tolist())]):
        shapes = [layer.points(n) for n in members]
        whole = len(shapes) == 1 and layers.is_convex(shapes[0])
        contours = [layers.plain(c) for c in (shapes if whole else region.union(shapes))]
        for contour in contours:
            known = layers.is_convex(contour) and (whole or not _holds(contour, contours))
            if known and number < len(groups):
                _narrow(contour, rules, report, name)
            lines.append(np.hstack([contour, np.roll(contour, -1, axis=0)]))
            owner.append(np.full(len(contour), facing.KNOWN if known else number))
            lone.append(np.full(len(contour), number >= len(groups)))
    edge, shape, measured = np.concatenate(lines), np.concatenate(owner), np.concatenate(lone)
    feature, gap = (v / report.unit_nm for v in (rules.minimum_feature_nm, rules.minimum_gap_nm))
    for a, b, kind, away in facing.facing(edge, shape, feature, gap).tolist():
        if measured[int(a)] and measured[int(b)]:  # two convex shapes that stand alone
            continue
        corners = np.concatenate([edge[int(a)].reshape(2, 2), edge[int(b)].reshape(2, 2)])
        box = (*corners.min(0).tolist(), *corners.max(0).tolist())
        rule, limit = ("feature", rules.minimum_feature_nm) if kind == facing.WIDTH else ("gap", rules.minimum_gap_nm)
        value = away * report.unit_nm
        report.add(rule, 1, Violation(rule, box, value, limit, f"edges of {name}"))
        if kind == facing.WIDTH:
            report.minimum_feature_nm = min(report.minimum_feature_nm, value)
        else:
            report.minimum_gap_nm = min(report.minimum_gap_nm, value)


def _holds(contour: Array, others: list[Array]) -> bool:
    """Whether another contour lies within a convex one: it has a hole."""
    edges = np.roll(contour, -1, axis=0) - contour
    for other in others:
        to = other[0] - contour
        if other is not contour and (edges[:, 0] * to[:, 1] >= edges[:, 1] * to[:, 0]).all():
            return True
    return False


def _narrow(contour: Array, rules: Rules, report: DrcReport, name: str) -> None:
    """Width of a convex contour that shapes have together."""
    width = convex.width(contour) * report.unit_nm
    report.minimum_feature_nm = min(report.minimum_feature_nm, width)
    if width < rules.minimum_feature_nm - 1e-9:
        box = (*contour.min(0).tolist(), *contour.max(0).tolist())
        report.add("feature", 1, Violation("feature", box, width, rules.minimum_feature_nm, f"shape of {name}"))


def _off_grid(layer: Layer, rules: Rules, report: DrcReport, offset: copies.Offset) -> None:
    """Corners that do not lie on the grid of the process, which the cell lies off by ``offset``."""
    step = rules.grid_nm / report.unit_nm
    if step == 1:
        return
    whole = step == round(step)
    bad = [_residue(outline, step) for outline in layer.outlines]
    for first in range(0, len(layer.kind), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        kind, place = layer.kind[some], np.column_stack([layer.x[some], layer.y[some]]) + np.array(offset)
        off = np.mod(place + np.array([r if r is not None else (0.0, 0.0) for r in bad])[kind], step)
        apart = (np.minimum(off, step - off) > (0 if whole else _ROUNDED)).any(1)
        apart |= np.array([r is None for r in bad])[kind]
        for n in (np.flatnonzero(apart) + first).tolist():
            violation = Violation("off-grid", layer.box(n), 0.0, float(rules.grid_nm), layer.cells[layer.kind[n]])
            report.add("off-grid", 1, violation)


def _residue(outline: Array, step: float) -> tuple[float, float] | None:
    """Where all corners lie on a grid of ``step``, from its points; None where they lie on different ones."""
    off = np.mod(outline - outline[0] + step / 2, step) - step / 2
    return None if np.abs(off).max() > _ROUNDED else tuple(np.mod(outline[0], step).tolist())
