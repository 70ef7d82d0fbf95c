"""Rules on a mask made anywhere: pillars at any place and turn, shapes of any outline, checked layer by layer.

Shapes that touch are one shape, as a writer exposes them. Convex ones that stand alone are measured polygon to
polygon, those that can be near each other found by sorting their places; all others edge against edge.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from layout.files import MaskContent, flat, hierarchy
from layout.process import Rules, compiled
from layout.rules import edges as facing
from layout.rules import near
from layout.rules.report import DrcReport, Violation
from layout.shapes import convex, region
from metalens.ground.arrays import Array
from metalens.ground.errors import MaskFileError

MOST_SHAPES = 4_000_000  # that are checked or shown at once in less than 1 GB, however small the file
_EACH_BYTE = 4  # more of them for each byte: our densest masks, pillars of few sizes as OASIS arrays, hold 3.8
_AT_ONCE = 1 << 18  # shapes that are held to the grid at once
_ROUNDED = 1e-6  # of a step of a grid that is no whole number of units


@dataclass(frozen=True, eq=False, slots=True)
class _Layer:
    """Shapes of one layer number: different outlines, and (n,) int32 which each is, with its place x, y."""

    outlines: list[Array]
    cells: list[str]
    kind: Array
    x: Array
    y: Array

    @property
    def discs(self) -> near.Discs:
        """Circles around the shapes, about the middles of their boxes."""
        middle = np.array([(o.min(0) + o.max(0)) / 2 for o in self.outlines])
        reach = np.array([np.hypot(*(o - m).T).max() for o, m in zip(self.outlines, middle, strict=True)])
        return near.Discs(self.x, self.y, self.kind, middle, reach)

    def points(self, n: int) -> Array:
        """(m, 2) corners of shape ``n``."""
        return np.asarray(self.outlines[self.kind[n]] + np.array([self.x[n], self.y[n]], np.int64))

    def box(self, *members: int) -> tuple[int, int, int, int]:
        """Left, bottom, right, top of some shapes."""
        corners = np.concatenate([self.points(n) for n in members])
        (left, bottom), (right, top) = corners.min(0).tolist(), corners.max(0).tolist()
        return left, bottom, right, top


def most_of(path: Path) -> int:
    """Shapes that a mask file is taken apart to, where its user sets no other limit."""
    return MOST_SHAPES + _EACH_BYTE * path.stat().st_size


def check(content: MaskContent, rules: Rules, *, skip: Sequence[int] = (), most: int = MOST_SHAPES) -> DrcReport:
    """Gap, feature and grid of every shape below the top cells, each layer number (all its datatypes) by itself.

    Args:
        skip: layer numbers that are not drawn in the resist (outlines, write fields).
        most: shapes that are taken apart.

    Raises:
        MaskFileError: no top cell, a hierarchy that is broken, more than ``most`` shapes or 4e6
            pairs of shapes that can be closer than the rule.
    """
    if not content.tops:
        raise MaskFileError("the mask has no top cell: its cells place each other in a circle")
    hierarchy.refuse_beyond(content, most)
    report = DrcReport.empty(content, rules)
    for number, layer in _layers(content, skip):
        report.pillars += len(layer.kind)
        _off_grid(layer, rules, content.unit_nm, report)
        _check_layer(layer, rules, report, f"layer {number}")
    return report


def _layers(content: MaskContent, skip: Sequence[int]) -> Iterator[tuple[int, _Layer]]:
    """(layer number, its shapes), rising."""
    found: dict[int, list[list[flat.Shapes]]] = {}
    for group in flat.alike(content, lambda s: None if s.layer[0] in skip else s.layer[0]).values():
        found.setdefault(group[0].layer[0], []).append(group)
    for number in sorted(found):
        yield number, _layer(found.pop(number))


def _layer(groups: list[list[flat.Shapes]]) -> _Layer:
    """All of them, those of one outline together; they are let go on the way."""
    outlines = [_plain(np.asarray(group[0].outline, np.int64)) for group in groups]
    cells = [group[0].cell for group in groups]
    total, at = sum(len(shape.x) for group in groups for shape in group), 0
    kind, x, y = (np.empty(total, np.int32) for _ in range(3))
    for number, group in enumerate(groups):
        while group:
            shape = group.pop()
            some = slice(at, at + len(shape.x))
            kind[some], x[some], y[some] = number, shape.x, shape.y
            at = some.stop
    return _Layer(outlines, cells, kind, x, y)


def _plain(points: Array) -> Array:
    """Corners without repeats and without those on a straight line."""
    points = points[(points != np.roll(points, 1, axis=0)).any(1)]
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    return np.asarray(points[before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]])


def _is_convex(points: Array) -> bool:
    before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
    if (before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]).min() <= 0:
        return False
    turned = np.unwrap(np.arctan2(after[:, 1], after[:, 0]))
    return bool(turned[-1] - turned[0] < 2 * math.pi)


def _check_layer(layer: _Layer, rules: Rules, report: DrcReport, name: str) -> None:
    gap = rules.minimum_gap_nm / report.unit_nm
    one, two = near.pairs(layer.discs, gap)
    apart = _distances(layer, one, two)
    touch = apart <= 0
    alone = np.array([_is_convex(o) for o in layer.outlines])[layer.kind]
    alone[one[touch]] = alone[two[touch]] = False
    _features(layer, alone, rules, report)
    both = alone[one] & alone[two] & (apart < gap - 1e-9)
    for a, b, value in zip(one[both].tolist(), two[both].tolist(), apart[both].tolist(), strict=True):
        text = f"{layer.cells[layer.kind[a]]} to {layer.cells[layer.kind[b]]}, {name}"
        value *= report.unit_nm
        report.add("gap", 1, Violation("gap", layer.box(a, b), value, rules.minimum_gap_nm, text))
    least = apart[both].min(initial=math.inf) * report.unit_nm  # of pairs further apart only some were looked at
    report.minimum_gap_nm = min(report.minimum_gap_nm, float(least))
    beside = np.unique(np.concatenate([one[alone[one] & ~alone[two]], two[alone[two] & ~alone[one]]]))
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


def _distances(layer: _Layer, one: Array, two: Array) -> Array:
    """(n,) between shapes, of hulls where they are not convex: 0 and below where they touch or meet."""
    hulls = [o if _is_convex(o) else _hull(o) for o in layer.outlines]
    moves = (layer.x[two].astype(np.int64) - layer.x[one], layer.y[two].astype(np.int64) - layer.y[one])
    keys = zip(layer.kind[one].tolist(), layer.kind[two].tolist(), *(m.tolist() for m in moves), strict=True)
    known: dict[tuple[int, int, int, int], float] = {}
    apart = np.empty(len(one))
    for n, key in enumerate(keys):
        if key not in known:
            known[key] = convex.gap(hulls[key[0]], hulls[key[1]], key[2], key[3])
        apart[n] = known[key]
    return apart


def _hull(points: Array) -> Array:
    from scipy.spatial import ConvexHull

    return np.asarray(points[ConvexHull(points).vertices])


def _features(layer: _Layer, alone: Array, rules: Rules, report: DrcReport) -> None:
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


def _by_edges(
    layer: _Layer, groups: list[list[int]], beside: Array, rules: Rules, report: DrcReport, name: str
) -> None:
    """Groups of shapes that are not convex or touch, as merged contours, with the convex shapes beside them."""
    lines, owner = [], []
    for number, members in enumerate([*groups, *([n] for n in beside.tolist())]):
        shapes = [layer.points(n) for n in members]
        whole = len(shapes) == 1 and _is_convex(shapes[0])
        contours = [_plain(c) for c in (shapes if whole else region.union(shapes))]
        for contour in contours:
            known = _is_convex(contour) and (whole or not _holds(contour, contours))
            if known and number < len(groups):
                _narrow(contour, rules, report, name)
            lines.append(np.hstack([contour, np.roll(contour, -1, axis=0)]))
            owner.append(np.full(len(contour), facing.KNOWN if known else number))
    edge, shape = np.concatenate(lines), np.concatenate(owner)
    feature, gap = (v / report.unit_nm for v in (rules.minimum_feature_nm, rules.minimum_gap_nm))
    for a, b, kind, away in facing.facing(edge, shape, feature, gap).tolist():
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


def _off_grid(layer: _Layer, rules: Rules, unit_nm: float, report: DrcReport) -> None:
    """Corners that do not lie on the grid of the process."""
    step = rules.grid_nm / unit_nm
    if step == 1:
        return
    whole = step == round(step)
    bad = [_residue(outline, step) for outline in layer.outlines]
    for first in range(0, len(layer.kind), _AT_ONCE):
        some = slice(first, first + _AT_ONCE)
        kind, place = layer.kind[some], np.column_stack([layer.x[some], layer.y[some]])
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
